//! How bodies move between the moments at which they are known: on as they did, and the less surely the longer.

use crate::geometry::{Covariance, PoseWithCovariance, Se3};
use nalgebra::{Matrix6, Vector6};

/// What a robot may speed up or slow down by, m/s² and rad/s², standard deviation.
const ACCELERATION: [f64; 2] = [0.5, 0.5];
/// The speed of a robot of which nobody knows how it moves, m/s and rad/s, standard deviation.
const SPEED_UNKNOWN: [f64; 2] = [1.5, 1.0];

/// How a body moves: (ρ, φ) in its own frame, m and rad, a second.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Twist(Vector6<f64>);

impl Twist {
    /// Between two poses so many seconds apart; `None` if no time passed.
    pub(super) fn between(from: &Se3, to: &Se3, secs: f64) -> Option<Self> {
        let twist = from.local(to) / secs;
        (secs > 0.0 && twist.iter().all(|x| x.is_finite())).then_some(Self(twist))
    }
}

/// Where a body is so many seconds after (or before) it was at `t`, a time with a standard deviation of `sigma_secs`,
/// and how sure that is.
pub(super) fn moved_on(t: &PoseWithCovariance, twist: Option<Twist>, secs: f64, sigma_secs: f64) -> PoseWithCovariance {
    let rates = twist.map_or(SPEED_UNKNOWN, |Twist(v)| [0, 3].map(|k| v.fixed_rows::<3>(k).norm()));
    let sigmas = match twist {
        Some(_) => ACCELERATION.map(|change| 0.5 * change * secs * secs),
        None => SPEED_UNKNOWN.map(|speed| speed * secs),
    };
    let [way, turn] = [0, 1].map(|k| sigmas[k] * sigmas[k] + (rates[k] * sigma_secs) * (rates[k] * sigma_secs));
    let step = Se3::exp(&twist.map_or_else(Vector6::zeros, |twist| twist.0 * secs));
    let back = step.inverse().adjoint();
    let told = back * t.covariance.matrix() * back.transpose();
    let more = Matrix6::from_diagonal(&Vector6::new(way, way, way, turn, turn, turn));
    PoseWithCovariance { pose: t.pose * step, covariance: Covariance::new_or_wider(told + more) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_body_moves_on_as_it_did_and_the_less_sure_the_longer() {
        let from = Se3::exp(&Vector6::new(1.0, 2.0, 0.5, 0.1, -0.2, 0.7));
        let twist = Vector6::new(0.8, 0.1, 0.0, 0.0, 0.0, 0.3);
        let to = from * Se3::exp(&(twist * 2.0));
        assert_eq!(Twist::between(&from, &to, 0.0), None);
        assert_eq!(Twist::between(&from, &to, -1.0), None);
        let found = Twist::between(&from, &to, 2.0).unwrap();
        assert!((found.0 - twist).norm() < 1e-12);
        let t = PoseWithCovariance { pose: to, covariance: Covariance::from_sigmas([0.01; 6]).unwrap() };
        let later = moved_on(&t, Some(found), 1.5, 0.0);
        assert!((from * Se3::exp(&(twist * 3.5))).local(&later.pose).norm() < 1e-12);
        let earlier = moved_on(&later, Some(found), -1.5, 0.0);
        assert!(to.local(&earlier.pose).norm() < 1e-12);
        let sigma = |t: &PoseWithCovariance| t.covariance.sigmas()[2];
        assert!((sigma(&moved_on(&t, Some(found), 0.0, 0.0)) - 0.01).abs() < 1e-12);
        assert!(sigma(&later) > 0.5 * ACCELERATION[0] * 1.5 * 1.5 && sigma(&earlier) > sigma(&later));
        let late = sigma(&moved_on(&t, Some(found), 0.0, 0.5));
        assert!((late - 0.01f64.hypot(0.5 * twist.fixed_rows::<3>(0).norm())).abs() < 1e-9, "{late}");
        assert!(sigma(&moved_on(&t, None, 1.5, 0.0)) > SPEED_UNKNOWN[0] * 1.5);
    }
}

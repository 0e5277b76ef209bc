//! Odometry drift laid on true motion, from a seed: what stands in for a robot's own SLAM where a data set has only the
//! true poses. Each step is disturbed by a Gaussian whose covariance is then stated with the keyframe, so the
//! recording's uncertainty is honest by construction.

use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3};
use nalgebra::Vector6;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// How a step's standard deviations grow with the step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Drift {
    /// Translation, each axis: a share of the distance of the step…
    pub per_metre: f64,
    /// …plus this, m.
    pub floor_m: f64,
    /// Rotation, each axis: degrees per step.
    pub step_deg: f64,
}

impl Drift {
    /// Odometry of `truth` (`t_world_body` of each keyframe) in a frame that begins at the first body pose:
    /// `t_frame_body` with the covariance of the motion since the previous keyframe. The first keyframe states that of
    /// a step of no length.
    ///
    /// # Errors
    /// [`CovarianceError`] if a step's covariance is out of range (no drift at all, or a step of many kilometres).
    pub fn odometry(&self, truth: &[Se3], seed: u64) -> Result<Vec<PoseWithCovariance>, CovarianceError> {
        let mut dice = ChaCha8Rng::seed_from_u64(seed);
        let mut pose = Se3::identity();
        let mut odometry = Vec::with_capacity(truth.len());
        for (index, t_world_body) in truth.iter().enumerate() {
            let previous = if index == 0 { t_world_body } else { &truth[index - 1] };
            let motion = previous.inverse() * *t_world_body;
            let sigmas = self.sigmas(motion.translation.norm());
            if index != 0 {
                let noise = Vector6::from_fn(|axis, _| sigmas[axis] * normal(&mut dice));
                pose = pose * motion.retract(&noise);
            }
            odometry.push(PoseWithCovariance { pose, covariance: Covariance::from_sigmas(sigmas)? });
        }
        Ok(odometry)
    }

    /// Standard deviations (ρ, φ) of a step of this length.
    fn sigmas(&self, step_m: f64) -> [f64; 6] {
        let (t, r) = (self.floor_m + self.per_metre * step_m, self.step_deg.to_radians());
        [t, t, t, r, r, r]
    }
}

impl std::fmt::Display for Drift {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { per_metre, floor_m, step_deg } = self;
        write!(f, "{} % of the step + {} mm and {step_deg}° each axis and step", per_metre * 100.0, floor_m * 1000.0)
    }
}

/// A standard normal number (Box–Muller).
fn normal(dice: &mut ChaCha8Rng) -> f64 {
    // (0, 1], so that the logarithm is finite.
    let mut uniform = || ((dice.next_u64() >> 11) as f64 + 1.0) / (1u64 << 53) as f64;
    let (u, v) = (uniform(), uniform());
    (-2.0 * libm::log(u)).sqrt() * libm::cos(core::f64::consts::TAU * v)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix6;

    const DRIFT: Drift = Drift { per_metre: 0.01, floor_m: 0.001, step_deg: 0.2 };

    fn circle(n: usize) -> Vec<Se3> {
        let step = Se3::exp(&Vector6::new(0.1, 0.0, 0.02, 0.0, 0.0, 0.05));
        std::iter::successors(Some(Se3::exp(&Vector6::new(3.0, 1.0, 0.0, 0.2, 0.0, 1.0))), |t| Some(*t * step))
            .take(n)
            .collect()
    }

    #[test]
    fn the_stated_covariance_is_that_of_the_noise() {
        let truth = circle(4001);
        let odometry = DRIFT.odometry(&truth, 7).unwrap();
        assert_eq!(odometry[0].pose, Se3::identity());
        let mut d2 = 0.0;
        let mut scatter = Matrix6::zeros();
        for (truth, odometry) in truth.windows(2).zip(odometry.windows(2)) {
            let motion = truth[0].inverse() * truth[1];
            let error = motion.local(&(odometry[0].pose.inverse() * odometry[1].pose));
            d2 += odometry[1].covariance.mahalanobis_squared(&error) / 4000.0;
            scatter += error * error.transpose() / 4000.0;
        }
        // χ²₆ averaged over 4,000 draws: 6 ± 4 · √(12/4000).
        assert!((d2 - 6.0).abs() < 0.22, "{d2}");
        let off = (scatter[(0, 1)] / scatter[(0, 0)])
            .abs()
            .max((scatter[(0, 4)] / (scatter[(0, 0)] * scatter[(4, 4)]).sqrt()).abs());
        assert!(off < 0.07, "axes must be independent: {off}");
    }

    #[test]
    fn a_seed_is_a_drift() {
        let truth = circle(20);
        assert_eq!(DRIFT.odometry(&truth, 1).unwrap(), DRIFT.odometry(&truth, 1).unwrap());
        assert_ne!(DRIFT.odometry(&truth, 1).unwrap(), DRIFT.odometry(&truth, 2).unwrap());
    }
}

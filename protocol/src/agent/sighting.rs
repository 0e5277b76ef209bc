//! Sightings: direct measurements of another robot's body, carried to the anchors that the two bodies are known by.
//!
//! Nobody stands still meanwhile. Our body is known where its last keyframe was, the other's where its last beacon says,
//! and the sighting came between: each body is taken to have moved on as it did before, and its pose is widened by how
//! it may have sped up, slowed down or turned. What is too old to say much is refused.

use super::Agent;
use super::io::Sighting;
use super::ledger::BATCHES_WAITING_MAX;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use crate::ids::SubmapId;
use crate::wire::fact::{Fact, SightingFact};
use nalgebra::{Matrix6, Vector3, Vector6};

/// Largest time between a sighting and the keyframe or beacon that tells where a robot was, s.
pub const SIGHTING_AGE_SECS_MAX: f64 = 5.0;
/// A beacon tells where a robot was at its last keyframe: so long before it is heard, s.
const BEACON_LATE_SECS: f64 = 0.3;
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

/// Where a body is so many seconds after (or before) it was at `t`, and how sure that is.
fn moved_on(t: &PoseWithCovariance, twist: Option<Twist>, secs: f64) -> PoseWithCovariance {
    let sigmas = match twist {
        Some(_) => ACCELERATION.map(|change| 0.5 * change * secs * secs),
        None => SPEED_UNKNOWN.map(|speed| speed * secs),
    };
    let [way, turn] = sigmas.map(|sigma| sigma * sigma);
    let step = Se3::exp(&twist.map_or_else(Vector6::zeros, |twist| twist.0 * secs));
    let back = step.inverse().adjoint();
    let told = back * t.covariance.matrix() * back.transpose();
    let more = Matrix6::from_diagonal(&Vector6::new(way, way, way, turn, turn, turn));
    PoseWithCovariance { pose: t.pose * step, covariance: Covariance::new_or_wider(told + more) }
}

impl Agent {
    /// A direct measurement of another robot becomes a fact, or is refused.
    pub(super) fn on_sighting(&mut self, sighting: &Sighting) {
        if self.is_receive_only() {
            return self.reject(Some(self.me.robot), "sighting: receive-only", "it cannot be kept now");
        }
        if self.is_overloaded() {
            let detail = format!("{BATCHES_WAITING_MAX} batches wait for the disk; the store is too slow");
            return self.reject(Some(self.me.robot), "sighting: overload", &detail);
        }
        match self.sighting_fact(sighting) {
            Ok(fact) => _ = self.write(self.me.frame.epoch, &Fact::Sighting(fact)),
            Err(detail) => self.reject(Some(self.me.robot), "sighting", detail),
        }
    }

    fn sighting_fact(&self, sighting: &Sighting) -> Result<SightingFact, &'static str> {
        let t_body_other = parse(sighting)?;
        let seen = self.replica.members().find(|(_, name)| **name == sighting.robot).map(|(id, _)| id);
        let seen = seen.filter(|id| *id != self.me.robot).ok_or("names no other robot of the roster")?;
        let (index, t_i_body, stamp) = self.mapper.body().ok_or("came before the first submap was finished")?;
        let own_age = sighting.stamp.secs_since(stamp);
        if own_age.abs() > SIGHTING_AGE_SECS_MAX {
            return Err(
                "is too far in time from the last keyframe; hand over keyframes more often, with the same clock",
            );
        }
        let beacon = self.gossip.beacon(seen).ok_or("names a robot of which no pose beacon was heard yet")?;
        let age = self.now.since(beacon.since).as_secs_f64() + BEACON_LATE_SECS;
        if age > SIGHTING_AGE_SECS_MAX {
            return Err("names a robot whose last keyframe is too old, by its beacons; lower its gossip.pose_secs");
        }
        let t_i_body = moved_on(&t_i_body, self.mapper.twist(), own_age);
        let t_j_other = moved_on(&beacon.content.t_anchor_body, beacon.twist, age);
        let t_i_j = t_i_body.compose(&t_body_other).compose(&t_j_other.inverse());
        let i = SubmapId { frame: self.me.frame, index };
        Ok(SightingFact { stamp: sighting.stamp, i, j: beacon.content.anchor, t_i_j })
    }
}

fn parse(sighting: &Sighting) -> Result<PoseWithCovariance, &'static str> {
    let [x, y, z, qx, qy, qz, qw] = sighting.t_body_other;
    let translation = Vector3::new(x, y, z);
    if translation.iter().any(|v| !v.is_finite()) {
        return Err("has a translation that is not finite");
    }
    let rotation = So3::from_xyzw([qx, qy, qz, qw]).ok_or("has a quaternion of zero length or not finite")?;
    let mut p = Matrix6::zeros();
    let mut upper = sighting.covariance.iter();
    for r in 0..6 {
        for c in r..6 {
            let v = upper.next().copied().unwrap_or(f64::NAN);
            (p[(r, c)], p[(c, r)]) = (v, v);
        }
    }
    let covariance = Covariance::new(p).map_err(|_| "has a covariance that is not positive definite")?;
    Ok(PoseWithCovariance { pose: Se3::new(rotation, translation), covariance })
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
        let later = moved_on(&t, Some(found), 1.5);
        assert!((from * Se3::exp(&(twist * 3.5))).local(&later.pose).norm() < 1e-12);
        let earlier = moved_on(&later, Some(found), -1.5);
        assert!(to.local(&earlier.pose).norm() < 1e-12);
        let sigma = |t: &PoseWithCovariance| t.covariance.sigmas()[2];
        assert!((sigma(&moved_on(&t, Some(found), 0.0)) - 0.01).abs() < 1e-12);
        assert!(sigma(&later) > 0.5 * ACCELERATION[0] * 1.5 * 1.5 && sigma(&earlier) > sigma(&later));
        assert!(sigma(&moved_on(&t, None, 1.5)) > SPEED_UNKNOWN[0] * 1.5);
    }
}

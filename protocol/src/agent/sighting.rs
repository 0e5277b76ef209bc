//! Sightings: direct measurements of another robot's body, carried to the anchors that the two bodies are known by.
//!
//! Nobody stands still meanwhile. Our body is known where its last keyframe was, the other's where its last beacon
//! says, and the sighting came between: each body is taken to have moved on as it did before, and its pose is widened
//! by how it may have sped up, slowed down or turned. What is too old to say much is refused. A range and a bearing
//! tell a place and no rotation: then a point is carried instead of a pose.

use super::Agent;
use super::beacons::LATE_SIGMA_SECS;
use super::io::{PositionSighting, Sighting};
use super::ledger::BATCHES_WAITING_MAX;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use crate::ids::{Name, SubmapId};
use crate::time::Stamp;
use crate::wire::fact::{Fact, PositionFact, SightingFact};
use nalgebra::{Matrix3, Matrix3x6, Matrix6, Vector3, Vector6};
use std::collections::BTreeMap;

/// Largest time between a sighting and the keyframe or beacon that tells where a robot was, s.
pub const SIGHTING_AGE_SECS_MAX: f64 = 5.0;
/// What a robot may speed up or slow down by, m/s² and rad/s², standard deviation.
const ACCELERATION: [f64; 2] = [0.5, 0.5];
/// The speed of a robot of which nobody knows how it moves, m/s and rad/s, standard deviation.
const SPEED_UNKNOWN: [f64; 2] = [1.5, 1.0];
/// A sighting whose rotation has a larger standard deviation, rad, tells where the other robot is, not how it is
/// turned: no Gaussian about one rotation means much beyond.
pub const TURN_SIGMA_MAX: f64 = 0.5;
/// Another position from the same submap to the same one is stated with so much of the variance at most.
const NEWS: f64 = 0.5;

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
fn moved_on(t: &PoseWithCovariance, twist: Option<Twist>, secs: f64, sigma_secs: f64) -> PoseWithCovariance {
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

/// How sure the positions are that were stated of another robot's submap, seen from the submap that ours is known by.
#[derive(Debug, Default)]
pub(super) struct Positions {
    from: Option<SubmapId>,
    /// Sum of the variances along the axes, m².
    variances: BTreeMap<SubmapId, f64>,
}

impl Positions {
    /// Whether it says something new: of one pair of submaps the first does, and one of half the variance.
    fn is_news(&self, fact: &PositionFact) -> bool {
        let before = self.variances.get(&fact.j).filter(|_| self.from == Some(fact.i));
        before.is_none_or(|before| fact.covariance.matrix().trace() <= NEWS * before)
    }

    fn note(&mut self, fact: &PositionFact) {
        if self.from.replace(fact.i) != Some(fact.i) {
            self.variances.clear();
        }
        self.variances.insert(fact.j, fact.covariance.matrix().trace());
    }
}

/// Two bodies at the time of a sighting, each in the anchor that it is known by.
struct Meeting {
    i: SubmapId,
    j: SubmapId,
    t_i_body: PoseWithCovariance,
    t_j_other: PoseWithCovariance,
}

impl Agent {
    /// A direct measurement of another robot becomes a fact, or is refused.
    pub(super) fn on_sighting(&mut self, sighting: &Sighting) {
        if self.is_hindered("sighting: receive-only", "sighting: overload") {
            return;
        }
        match self.sighting_fact(sighting) {
            Ok(Fact::Position(fact)) => self.state_position(fact),
            Ok(fact) => _ = self.write(self.context.frame().epoch, &fact),
            Err(detail) => self.context.reject(Some(self.context.robot()), "sighting", detail),
        }
    }

    /// A direct measurement of where another robot is becomes a fact, or is refused.
    pub(super) fn on_position(&mut self, sighting: &PositionSighting) {
        if self.is_hindered("position: receive-only", "position: overload") {
            return;
        }
        match self.position_fact(sighting) {
            Ok(fact) => self.state_position(fact),
            Err(detail) => self.context.reject(Some(self.context.robot()), "position", detail),
        }
    }

    fn position_fact(&self, sighting: &PositionSighting) -> Result<PositionFact, &'static str> {
        let (p, covariance) = parse_position(sighting)?;
        Ok(self.meeting(&sighting.robot, sighting.stamp)?.position(sighting.stamp, &p, &covariance))
    }

    /// States a position, unless it is no news: sensors see a robot many times a second.
    fn state_position(&mut self, fact: PositionFact) {
        if self.positions.is_news(&fact) && self.write(self.context.frame().epoch, &Fact::Position(fact.clone())) {
            self.positions.note(&fact);
        }
    }

    /// Whether nothing can be stated now; if so it is refused under one of these names.
    fn is_hindered(&mut self, receive_only: &'static str, overload: &'static str) -> bool {
        if self.is_receive_only() {
            self.context.reject(Some(self.context.robot()), receive_only, "it cannot be kept now");
            return true;
        }
        if self.is_overloaded() {
            let detail = format!("{BATCHES_WAITING_MAX} batches wait for the disk; the store is too slow");
            self.context.reject(Some(self.context.robot()), overload, &detail);
            return true;
        }
        false
    }

    fn sighting_fact(&self, sighting: &Sighting) -> Result<Fact, &'static str> {
        let t_body_other = parse(sighting)?;
        let met = self.meeting(&sighting.robot, sighting.stamp)?;
        if t_body_other.covariance.sigmas().fixed_rows::<3>(3).max() > TURN_SIGMA_MAX {
            let turn = t_body_other.pose.rotation.matrix();
            let along = t_body_other.covariance.matrix().fixed_view::<3, 3>(0, 0).into_owned();
            let covariance = Covariance::new_or_wider(turn * along * turn.transpose());
            return Ok(Fact::Position(met.position(sighting.stamp, &t_body_other.pose.translation, &covariance)));
        }
        let t_i_j = met.t_i_body.compose(&t_body_other).compose(&met.t_j_other.inverse());
        Ok(Fact::Sighting(SightingFact { stamp: sighting.stamp, i: met.i, j: met.j, t_i_j }))
    }

    /// Where we were at `stamp`, and the robot of that name.
    fn meeting(&self, robot: &Name, stamp: Stamp) -> Result<Meeting, &'static str> {
        let seen = self.context.robot_named(robot);
        let seen = seen.filter(|id| *id != self.context.robot()).ok_or("names no other robot of the roster")?;
        let (index, t_i_body, at) = self.mapper.body().ok_or("came before the first submap was finished")?;
        let own_age = stamp.secs_since(at);
        if own_age.abs() > SIGHTING_AGE_SECS_MAX {
            return Err(
                "is too far in time from the last keyframe; hand over keyframes more often, with the same clock",
            );
        }
        let beacon = self.gossip.beacon(seen).ok_or("names a robot of which no pose beacon was heard yet")?;
        let age = self.context.now().since(beacon.since).as_secs_f64();
        if age > SIGHTING_AGE_SECS_MAX {
            return Err("names a robot whose last keyframe is too old, by its beacons; lower its gossip.pose_secs");
        }
        Ok(Meeting {
            i: SubmapId { frame: self.context.frame(), index },
            j: beacon.content.anchor,
            t_i_body: moved_on(&t_i_body, self.mapper.twist(), own_age, 0.0),
            t_j_other: moved_on(&beacon.content.t_anchor_body, beacon.twist, age, LATE_SIGMA_SECS),
        })
    }
}

impl Meeting {
    /// A point seen at `p` along our body's axes, carried to both anchors. How our body is turned moves it sideways;
    /// how the other's anchor is turned nobody knows here, so that its body is as uncertain in all directions as in the
    /// worst.
    fn position(&self, stamp: Stamp, p: &Vector3<f64>, covariance: &Covariance<3>) -> PositionFact {
        let body = &self.t_i_body;
        let r_i_body = body.pose.rotation.matrix();
        // δp_i = R (ρ + φ × p).
        let mut j = Matrix3x6::zeros();
        j.fixed_view_mut::<3, 3>(0, 0).copy_from(&r_i_body);
        j.fixed_view_mut::<3, 3>(0, 3).copy_from(&(-r_i_body * p.cross_matrix()));
        let theirs = self.t_j_other.covariance.matrix().fixed_view::<3, 3>(0, 0).into_owned();
        let total = j * body.covariance.matrix() * j.transpose()
            + r_i_body * covariance.matrix() * r_i_body.transpose()
            + Matrix3::identity() * theirs.symmetric_eigenvalues().max();
        PositionFact {
            stamp,
            i: self.i,
            j: self.j,
            p_i: (body.pose * *p).map(|x| x as f32).into(),
            p_j: self.t_j_other.pose.translation.map(|x| x as f32).into(),
            covariance: Covariance::new_or_wider(total),
        }
    }
}

fn parse_position(sighting: &PositionSighting) -> Result<(Vector3<f64>, Covariance<3>), &'static str> {
    let position = Vector3::from(sighting.position);
    if position.iter().any(|v| !v.is_finite()) {
        return Err("has a place that is not finite");
    }
    let [xx, xy, xz, yy, yz, zz] = sighting.covariance;
    let covariance = Covariance::new(Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz));
    Ok((position, covariance.map_err(|_| "has a covariance that is not positive definite")?))
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
    use crate::ids::{FrameId, RobotId};

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

    /// Of one pair of submaps the first is news, and what has half the variance; as soon as we are known by another,
    /// all is.
    #[test]
    fn a_position_is_news_once_and_where_it_is_much_surer() {
        let id = |index: u32| SubmapId { frame: FrameId { robot: RobotId([1; 8]), epoch: 1 }, index };
        let mut positions = Positions::default();
        let mut state = |i: u32, j: u32, sigma: f64| {
            let covariance = Covariance::from_sigmas([sigma; 3]).unwrap();
            let (p_i, p_j) = ([0.0; 3], [0.0; 3]);
            let fact = PositionFact { stamp: Stamp(0), i: id(i), j: id(j), p_i, p_j, covariance };
            let is_news = positions.is_news(&fact);
            if is_news {
                positions.note(&fact);
            }
            is_news
        };
        let told =
            [(0, 5, 1.0), (0, 5, 1.0), (0, 5, 0.71), (0, 5, 0.70), (0, 6, 2.0), (0, 5, 0.6), (1, 5, 2.0), (0, 5, 2.0)];
        let news = told.map(|(i, j, sigma)| state(i, j, sigma));
        assert_eq!(news, [true, false, false, true, true, false, true, true]);
    }
}

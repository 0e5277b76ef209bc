//! Sightings: direct measurements of another robot's body, carried to the anchors that the two bodies are known by.
//!
//! Nobody stands still meanwhile. Our body is known where its last keyframe was, the other's where its last beacon
//! says, and the sighting came between: each body is taken to have moved on as it did before, and its pose is widened
//! by how it may have sped up, slowed down or turned. What is too old to say much is refused. A range and a bearing
//! tell a place and no rotation: then a point is carried instead of a pose.

use super::Mapping;
use crate::agent::context::Context;
use crate::agent::io::{PositionSighting, Sighting};
use crate::agent::motion::moved_on;
use crate::agent::replication::beacons::{Beacons, LATE_SIGMA_SECS};
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use crate::ids::{Name, SubmapId};
use crate::submap::stated::TURN_SIGMA_MAX;
use crate::time::Stamp;
use crate::wire::fact::{Fact, PositionFact, SightingFact};
use nalgebra::{Matrix3, Matrix3x6, Matrix6, Vector3};
use std::collections::BTreeMap;

/// Largest time between a sighting and the keyframe or beacon that tells where a robot was, s.
pub const SIGHTING_AGE_SECS_MAX: f64 = 5.0;
/// Another position from the same submap to the same one is stated with so much of the variance at most.
const NEWS: f64 = 0.5;

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

impl Mapping {
    /// A direct measurement of another robot becomes a fact, or is refused.
    pub(in crate::agent) fn on_sighting(
        &mut self,
        context: &mut Context,
        beacons: &Beacons,
        sighting: &Sighting,
    ) -> Option<Fact> {
        match self.sighting_fact(context, beacons, sighting) {
            Ok(fact) => self.is_news(&fact).then_some(fact),
            Err(detail) => {
                context.reject(Some(context.robot()), "sighting", detail);
                None
            }
        }
    }

    /// A direct measurement of where another robot is becomes a fact, or is refused.
    pub(in crate::agent) fn on_position(
        &mut self,
        context: &mut Context,
        beacons: &Beacons,
        sighting: &PositionSighting,
    ) -> Option<Fact> {
        match self.position_fact(context, beacons, sighting) {
            Ok(fact) => Some(Fact::Position(fact)).filter(|fact| self.is_news(fact)),
            Err(detail) => {
                context.reject(Some(context.robot()), "position", detail);
                None
            }
        }
    }

    /// A sighting was written down.
    pub(in crate::agent) fn on_stated(&mut self, fact: &Fact) {
        if let Fact::Position(position) = fact {
            self.positions.note(position);
        }
    }

    /// Whether it is worth stating: sensors see a robot many times a second.
    fn is_news(&self, fact: &Fact) -> bool {
        if let Fact::Position(position) = fact { self.positions.is_news(position) } else { true }
    }

    fn position_fact(
        &self,
        context: &Context,
        beacons: &Beacons,
        sighting: &PositionSighting,
    ) -> Result<PositionFact, &'static str> {
        let (p, covariance) = parse_position(sighting)?;
        let met = self.meeting(context, beacons, &sighting.robot, sighting.stamp)?;
        Ok(met.position(sighting.stamp, &p, &covariance))
    }

    fn sighting_fact(&self, context: &Context, beacons: &Beacons, sighting: &Sighting) -> Result<Fact, &'static str> {
        let t_body_other = parse(sighting)?;
        let met = self.meeting(context, beacons, &sighting.robot, sighting.stamp)?;
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
    fn meeting(
        &self,
        context: &Context,
        beacons: &Beacons,
        robot: &Name,
        stamp: Stamp,
    ) -> Result<Meeting, &'static str> {
        let seen = context.robot_named(robot);
        let seen = seen.filter(|id| *id != context.robot()).ok_or("names no other robot of the roster")?;
        let (index, t_i_body, at) = self.body().ok_or("came before the first submap was finished")?;
        let own_age = stamp.secs_since(at);
        if own_age.abs() > SIGHTING_AGE_SECS_MAX {
            return Err(
                "is too far in time from the last keyframe; hand over keyframes more often, with the same clock",
            );
        }
        let beacon = beacons.of(seen).ok_or(
            "names a robot that is not known to be there: no pose beacon was heard, or it has not answered yet",
        )?;
        let age = context.now().since(beacon.since).as_secs_f64();
        if age > SIGHTING_AGE_SECS_MAX {
            return Err("names a robot whose last keyframe is too old, by its beacons; lower its gossip.pose_secs");
        }
        Ok(Meeting {
            i: SubmapId { frame: context.frame(), index },
            j: beacon.content.anchor,
            t_i_body: moved_on(&t_i_body, self.twist, own_age, 0.0),
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

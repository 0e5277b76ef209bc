//! Whatever arrives, no robot ever believes a number that is not one (DESIGN §8.9): every pose in a snapshot is finite
//! with a unit quaternion and a positive scale, every covariance symmetric positive definite.

use super::{Check, Sample};
use crate::truth::square;
use merganser_protocol::geometry::Covariance;
use merganser_protocol::snapshot::{PoseView, RelationView, Snapshot};

/// How far from 1 the length of a quaternion may be.
const UNIT_TOLERANCE: f64 = 1e-6;

/// See the module.
#[derive(Debug)]
pub struct SoundNumbers;

impl Check for SoundNumbers {
    fn name(&self) -> &'static str {
        "sound numbers"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        for robot in &sample.robots {
            let Some(snapshot) = &robot.snapshot else { continue };
            for (place, relation) in relations(snapshot) {
                sound(relation).map_err(|why| format!("{}: {place}: {why}", robot.name))?;
            }
            for submap in &snapshot.map.submaps {
                sound_pose(&submap.t_frame_anchor)
                    .map_err(|why| format!("{}: anchor {}#{}: {why}", robot.name, submap.frame, submap.index))?;
            }
            if !snapshot.graph.chi2.is_finite() {
                return Err(format!("{}: χ² is {}", robot.name, snapshot.graph.chi2));
            }
        }
        Ok(())
    }
}

fn relations(snapshot: &Snapshot) -> impl Iterator<Item = (String, &RelationView)> {
    let frames = snapshot.frames.frames.iter();
    let frames = frames.filter_map(|f| Some((format!("frame {}", f.frame), f.t_own_frame.as_ref()?)));
    let pairs = snapshot.frames.pairs.iter();
    let pairs = pairs.filter_map(|p| Some((format!("pair {} {}", p.a, p.b), p.t_a_b.as_ref()?)));
    let robots = snapshot.poses.robots.iter();
    let robots = robots.filter_map(|r| Some((format!("robot {}", r.robot), r.t_own_body.as_ref()?)));
    let submaps = snapshot.map.submaps.iter();
    let submaps = submaps.filter_map(|s| Some((format!("submap {}#{}", s.frame, s.index), s.t_own_anchor.as_ref()?)));
    let edges = snapshot.graph.edges.iter().map(|e| (format!("edge {} {}", e.i, e.j), &e.t_i_j));
    frames.chain(pairs).chain(robots).chain(submaps).chain(edges)
}

fn sound(relation: &RelationView) -> Result<(), String> {
    sound_pose(&relation.pose)?;
    match relation.covariance.len() {
        21 => sound_covariance::<6>(&relation.covariance),
        28 => sound_covariance::<7>(&relation.covariance),
        n => Err(format!("a covariance of {n} numbers")),
    }
}

fn sound_pose(pose: &PoseView) -> Result<(), String> {
    let norm = pose.rotation.iter().map(|x| x * x).sum::<f64>().sqrt();
    let finite = pose.translation.iter().all(|x| x.is_finite());
    if finite && (norm - 1.0).abs() <= UNIT_TOLERANCE && pose.scale > 0.0 && pose.scale.is_finite() {
        return Ok(());
    }
    Err(format!("no pose: {pose:?}"))
}

fn sound_covariance<const N: usize>(triangle: &[f64]) -> Result<(), String> {
    Covariance::new(square::<N>(triangle)).map(|_| ()).map_err(|error| error.to_string())
}

#[cfg(test)]
mod tests {
    use super::super::tests::{relation, robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use merganser_protocol::geometry::Se3;
    use std::collections::BTreeMap;

    fn verdict(spoil: impl Fn(&mut RelationView)) -> Result<(), String> {
        let mut relation = relation(Se3::identity(), 0.1);
        spoil(&mut relation);
        let robots = vec![robot("alpha", 1, &[("beta/1", relation)])];
        SoundNumbers.sample(&sample(robots, &BTreeMap::new(), &Expect::default()))
    }

    #[test]
    fn it_bites_on_each_kind_of_nonsense() {
        assert!(verdict(|_| {}).is_ok());
        assert!(verdict(|r| r.pose.translation[1] = f64::NAN).is_err());
        assert!(verdict(|r| r.pose.rotation[3] = 1.1).is_err());
        assert!(verdict(|r| r.pose.scale = 0.0).is_err());
        assert!(verdict(|r| r.covariance[0] = -1.0).is_err());
        assert!(verdict(|r| r.covariance[1] = 1.0).is_err(), "correlation above one");
        assert!(verdict(|r| r.covariance[3] = f64::INFINITY).is_err());
        assert!(verdict(|r| r.covariance.truncate(20)).is_err());
    }
}

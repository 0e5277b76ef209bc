//! The map is a function of the set (DESIGN §7, §8.2): idle robots that hold the same digest agree on every relation
//! between two frames to within 1e-9.

use super::{Check, RobotSample, Sample};
use crate::truth::similarity;
use merganser_protocol::geometry::Sim3;
use std::collections::BTreeMap;

/// Largest difference of a relation between two frames, m (or units), rad and log-scale.
const DIFFERENCE_MAX: f64 = 1e-9;

/// See the module.
#[derive(Debug)]
pub struct SameEstimate;

impl Check for SameEstimate {
    fn name(&self) -> &'static str {
        "same facts, same estimate"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        let mut by_digest: BTreeMap<_, Vec<(&str, Frames)>> = BTreeMap::new();
        for robot in &sample.robots {
            if let Some(frames) = frames(robot) {
                by_digest.entry(robot.digest).or_default().push((&robot.name, frames));
            }
        }
        for group in by_digest.values() {
            // Each against the one before: a difference anywhere shows between two neighbours.
            for pair in group.windows(2) {
                compare(pair[0].0, &pair[0].1, pair[1].0, &pair[1].1)?;
            }
        }
        Ok(())
    }
}

/// `t_own_frame` of every frame connected to the robot's own.
type Frames = BTreeMap<String, Sim3>;

fn frames(robot: &RobotSample) -> Option<Frames> {
    let snapshot = robot.snapshot.as_ref().filter(|snapshot| snapshot.status.idle)?;
    let known = snapshot.frames.frames.iter();
    let mut frames: Frames =
        known.filter_map(|f| Some((f.frame.clone(), similarity(&f.t_own_frame.as_ref()?.pose)?))).collect();
    frames.insert(snapshot.frames.own.clone(), Sim3::identity());
    Some(frames)
}

fn compare(one: &str, a: &Frames, other: &str, b: &Frames) -> Result<(), String> {
    let mut shared = a.keys().filter(|frame| b.contains_key(*frame));
    let Some(base) = shared.next() else { return Ok(()) };
    if a.keys().ne(b.keys()) {
        return Err(format!("{one} connects {:?}, {other} connects {:?}", a.keys(), b.keys()));
    }
    for frame in shared {
        let of = |frames: &Frames| frames[base].inverse() * frames[frame];
        let difference = of(a).local(&of(b)).amax();
        if difference.is_nan() || difference > DIFFERENCE_MAX {
            return Err(format!("{one} and {other} differ by {difference:e} on {base} -> {frame}"));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::super::tests::{relation, robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use merganser_protocol::geometry::{Covariance, Relative, Se3, SimWithCovariance};
    use merganser_protocol::snapshot::RelationView;
    use nalgebra::{SVector, Vector6};

    #[test]
    fn it_bites_on_the_smallest_difference() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let t_alpha_beta = Se3::exp(&Vector6::new(1.0, 2.0, 0.0, 0.0, 0.0, 0.5));
        let robots = |off: f64| {
            let t_beta_alpha = t_alpha_beta.retract(&Vector6::new(off, 0.0, 0.0, 0.0, 0.0, 0.0)).inverse();
            vec![
                robot("alpha", 1, &[("beta/1", relation(t_alpha_beta, 0.1))]),
                robot("beta", 1, &[("alpha/1", relation(t_beta_alpha, 0.1))]),
            ]
        };
        assert!(SameEstimate.sample(&sample(robots(0.0), &truth, &expect)).is_ok());
        assert!(SameEstimate.sample(&sample(robots(1e-8), &truth, &expect)).is_err());
        let mut busy = robots(1e-8);
        busy[0].snapshot.as_mut().unwrap().status.idle = false;
        assert!(SameEstimate.sample(&sample(busy, &truth, &expect)).is_ok(), "an estimate may lag behind the set");
    }

    #[test]
    fn it_bites_when_only_one_of_them_merged() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let one = robot("alpha", 1, &[("beta/1", relation(Se3::identity(), 0.1))]);
        let other = robot("beta", 1, &[]);
        assert!(SameEstimate.sample(&sample(vec![one, other], &truth, &expect)).is_err());
    }
    #[test]
    fn it_bites_on_a_difference_in_scale_alone() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let t_alpha_beta = Sim3::exp(&SVector::<f64, 7>::from([1.0, 2.0, 0.0, 0.0, 0.0, 0.5, 0.3]));
        let verdict = |off: f64| {
            let covariance = Covariance::from_sigmas([0.1; 7]).unwrap();
            let view = |sim| RelationView::from(&Relative::Similarity(SimWithCovariance { sim, covariance }));
            let other = t_alpha_beta.retract(&SVector::<f64, 7>::from([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, off])).inverse();
            let robots = vec![
                robot("alpha", 1, &[("beta/1", view(t_alpha_beta))]),
                robot("beta", 1, &[("alpha/1", view(other))]),
            ];
            SameEstimate.sample(&sample(robots, &truth, &expect))
        };
        assert!(verdict(0.0).is_ok());
        assert!(verdict(1e-8).is_err());
    }
}

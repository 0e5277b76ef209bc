//! Pose graphs with false measurements: decides which measurements count, as a swarm's robots decide (MATH §5).
//!
//! The top byte of a pose's id tells its robot. Measurements between a robot's consecutive poses are its odometry, and
//! trusted; where one is missing, a new frame begins. All others are loop closures within a frame or alignments between
//! frames, and go through the same consensus as the facts of a swarm ([`solve_map`]).

use super::{Measurement, PoseGraph, covariance_of};
use crate::config::EstimateConfig;
use crate::estimate::marginals::certain;
use crate::estimate::{AgreedAlignment, FrameChain, JointEstimate, MapProblem, Unused, solve_map};
use crate::geometry::{PoseWithCovariance, Relative, Se3};
use crate::ids::{EntryId, FrameId, RobotId, SubmapId};
use crate::wire::fact::ScaleKind;
use std::collections::BTreeMap;

/// What became of a measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Verdict {
    /// Odometry: trusted.
    Odometry,
    /// Counts, with this weight.
    Used(f64),
    /// Left out.
    Unused(Unused),
}

/// A graph solved without the measurements that contradict the rest.
#[derive(Clone, Debug)]
pub struct RobustSolved {
    /// A verdict per measurement, in their order.
    pub verdicts: Vec<Verdict>,
    /// Robots' poses by component: `t_world_pose`, the world of each component its smallest pose's.
    pub components: Vec<BTreeMap<u64, Se3>>,
    /// The map.
    pub map: JointEstimate,
    /// The frame and index of each pose.
    pub anchors: BTreeMap<u64, SubmapId>,
}

/// The robot of a pose: the top byte of its id.
pub fn robot_of(id: u64) -> u8 {
    (id >> 56) as u8
}

impl PoseGraph {
    /// Solves the graph as a swarm would.
    pub fn solve_robustly(&self, config: &EstimateConfig) -> RobustSolved {
        let odometry = self.odometry();
        let anchors = self.anchors(&odometry);
        let frames = self.frames(&odometry, &anchors);
        let mut verdicts = vec![Verdict::Unused(Unused::NotFinite); self.measurements.len()];
        odometry.values().for_each(|&k| verdicts[k] = Verdict::Odometry);
        let agreed = |(k, m): (usize, &Measurement)| {
            let (i, j) = (anchors[&m.i], anchors[&m.j]);
            let entry = EntryId { frame: i.frame.max(j.frame), seq: k as u32 };
            Some(AgreedAlignment { entry, i, j, t_i_j: Relative::Metric(measured(m)?) })
        };
        let loops = self.measurements.iter().enumerate().filter(|(k, _)| verdicts[*k] != Verdict::Odometry);
        let problem = MapProblem { frames, alignments: loops.filter_map(agreed).collect(), sightings: Vec::new() };
        let map = solve_map(&problem, config);
        for edge in map.edges() {
            if let Some(verdict) = verdicts.get_mut(edge.measurement.entry.seq as usize) {
                *verdict = edge.unused.map_or(Verdict::Used(edge.weight), Verdict::Unused);
            }
        }
        let components = components(&anchors, &map);
        RobustSolved { verdicts, components, map, anchors }
    }

    /// The measurement that ties each pose to the robot's next one: the first of them in the file.
    fn odometry(&self) -> BTreeMap<u64, usize> {
        let ids: Vec<u64> = self.poses.keys().copied().collect();
        let next: BTreeMap<u64, u64> = ids.windows(2).map(|w| (w[0], w[1])).collect();
        let mut out = BTreeMap::new();
        for (k, m) in self.measurements.iter().enumerate() {
            let (first, second) = (m.i.min(m.j), m.i.max(m.j));
            if next.get(&first) == Some(&second) && robot_of(first) == robot_of(second) {
                out.entry(first).or_insert(k);
            }
        }
        out
    }

    fn anchors(&self, odometry: &BTreeMap<u64, usize>) -> BTreeMap<u64, SubmapId> {
        let mut out: BTreeMap<u64, SubmapId> = BTreeMap::new();
        let mut last: Option<(u64, SubmapId)> = None;
        for &id in self.poses.keys() {
            let robot = RobotId([robot_of(id), 0, 0, 0, 0, 0, 0, 0]);
            let anchor = match last {
                Some((before, at)) if odometry.contains_key(&before) => SubmapId { index: at.index + 1, ..at },
                Some((_, at)) if at.frame.robot == robot => {
                    SubmapId { frame: FrameId { robot, epoch: at.frame.epoch + 1 }, index: 0 }
                }
                _ => SubmapId { frame: FrameId { robot, epoch: 0 }, index: 0 },
            };
            out.insert(id, anchor);
            last = Some((id, anchor));
        }
        out
    }

    fn frames(
        &self,
        odometry: &BTreeMap<u64, usize>,
        anchors: &BTreeMap<u64, SubmapId>,
    ) -> BTreeMap<FrameId, FrameChain> {
        let mut out: BTreeMap<FrameId, FrameChain> = BTreeMap::new();
        let mut step = None;
        for (&id, anchor) in anchors {
            let fresh = || FrameChain { scale: ScaleKind::Metric, odometry: vec![certain()] };
            let chain = out.entry(anchor.frame).or_insert_with(fresh);
            if anchor.index > 0 {
                chain.odometry.extend(step);
            }
            step = odometry.get(&id).and_then(|&k| {
                let m = &self.measurements[k];
                let t = measured(m)?;
                Some(if m.i == id { t } else { t.inverse() })
            });
        }
        out
    }
}

fn measured(m: &Measurement) -> Option<PoseWithCovariance> {
    Some(PoseWithCovariance { pose: m.t_i_j, covariance: covariance_of(&m.information)? })
}

/// Poses by component, in the coordinates of its smallest pose.
fn components(anchors: &BTreeMap<u64, SubmapId>, map: &JointEstimate) -> Vec<BTreeMap<u64, Se3>> {
    let mut out: BTreeMap<usize, BTreeMap<u64, Se3>> = BTreeMap::new();
    let mut places: BTreeMap<usize, BTreeMap<SubmapId, Se3>> = BTreeMap::new();
    for (&id, anchor) in anchors {
        let Some(component) = map.component_of(anchor.frame) else { continue };
        let place = places.entry(component).or_insert_with(|| map.values(component));
        if let Some(&pose) = place.get(anchor) {
            out.entry(component).or_default().insert(id, pose);
        }
    }
    let rebased = |mut poses: BTreeMap<u64, Se3>| {
        let origin = poses.values().next().map_or_else(Se3::identity, Se3::inverse);
        poses.values_mut().for_each(|pose| *pose = origin * *pose);
        poses
    };
    out.into_values().map(rebased).collect()
}

//! What each robot's poses hang on: decides which of its own measurements are trusted as its odometry, and where its
//! frames begin.
//!
//! A robot whose poses were made one after another has a measurement between each and the next. Where one of those is
//! missing, a new frame begins. A robot of which many are missing was numbered in another order; the first of its own
//! measurements, in the file's order, that reach each pose are its odometry then, and what they do not join is another
//! frame.

use super::super::{PoseGraph, covariance_of};
use super::robot_of;
use crate::graph::Disjoint;
use crate::ids::{FrameId, RobotId, SubmapId};
use std::collections::{BTreeMap, BTreeSet};

/// Share of a robot's steps without a measurement above which its poses are in no order of time.
const GAPS_MAX: f64 = 0.25;

/// Frames of all robots, and the measurements that hold them together.
pub(super) struct Backbone {
    /// The frame and index of each pose; indices ascend with ids.
    pub(super) anchors: BTreeMap<u64, SubmapId>,
    /// The trusted measurements.
    pub(super) trusted: BTreeSet<usize>,
    /// Per frame whose poses follow one another: the measurement between each and the next.
    pub(super) chains: BTreeMap<FrameId, Vec<usize>>,
}

impl Backbone {
    pub(super) fn of(graph: &PoseGraph) -> Self {
        let mut robots: BTreeMap<u8, Vec<u64>> = BTreeMap::new();
        for &id in graph.poses.keys() {
            robots.entry(robot_of(id)).or_default().push(id);
        }
        let mut own: BTreeMap<u8, Vec<usize>> = BTreeMap::new();
        for (k, m) in graph.measurements.iter().enumerate() {
            if robot_of(m.i) == robot_of(m.j) && covariance_of(&m.information).is_some() {
                own.entry(robot_of(m.i)).or_default().push(k);
            }
        }
        let mut out = Self { anchors: BTreeMap::new(), trusted: BTreeSet::new(), chains: BTreeMap::new() };
        for (robot, ids) in robots {
            out.add(graph, robot, &ids, own.get(&robot).map_or(&[][..], Vec::as_slice));
        }
        out
    }

    fn add(&mut self, graph: &PoseGraph, robot: u8, ids: &[u64], own: &[usize]) {
        let place: BTreeMap<u64, usize> = ids.iter().enumerate().map(|(k, &id)| (id, k)).collect();
        let ends = |k: usize| {
            let m = &graph.measurements[k];
            let (a, b) = (place[&m.i], place[&m.j]);
            (a.min(b), a.max(b))
        };
        let mut steps: BTreeMap<usize, usize> = BTreeMap::new();
        for &k in own {
            let (a, b) = ends(k);
            if b == a + 1 {
                steps.entry(a).or_insert(k);
            }
        }
        let gaps = ids.len() - 1 - steps.len();
        let is_chain = gaps as f64 <= GAPS_MAX * (ids.len() - 1) as f64;
        let mut sets = Disjoint::new(ids.len());
        for (&a, &k) in &steps {
            sets.join(a, a + 1);
            self.trusted.insert(k);
        }
        if !is_chain {
            for &k in own {
                let (a, b) = ends(k);
                if sets.join(a, b) {
                    self.trusted.insert(k);
                }
            }
        }
        // Roots are the smallest members, so that frames are numbered by their first poses.
        let mut frames: BTreeMap<usize, (FrameId, u32)> = BTreeMap::new();
        for (k, &id) in ids.iter().enumerate() {
            let epoch = frames.len() as u32;
            let robot = RobotId([robot, 0, 0, 0, 0, 0, 0, 0]);
            let (frame, next) = frames.entry(sets.root(k)).or_insert((FrameId { robot, epoch }, 0));
            self.anchors.insert(id, SubmapId { frame: *frame, index: *next });
            *next += 1;
            if is_chain {
                let chain = self.chains.entry(*frame).or_default();
                chain.extend(steps.get(&k));
            }
        }
    }
}

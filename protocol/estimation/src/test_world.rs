//! Robots that drive through one place, for tests of the whole map.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stderr,
    reason = "tests of this crate and of the core use it, and nothing else"
)]

use super::joint::*;
use super::test_graphs::*;
use crate::config::EstimateConfig;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance};
use crate::ids::{EntryId, FrameId, SubmapId};
use crate::kinds::ScaleKind;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

pub const ODOMETRY: (f64, f64) = (0.03, 0.008);
pub const ALIGNMENT: (f64, f64) = (0.04, 0.01);

/// Robots that drive through one place: the truth, and what they would state.
pub struct World {
    /// `t_world_anchor`, in metres.
    pub truth: BTreeMap<SubmapId, Se3>,
    /// `t_world_frame`; its scale is metres per unit of the frame.
    pub frames: BTreeMap<FrameId, Sim3>,
    pub problem: MapProblem,
    pub next: u32,
}

impl World {
    pub fn new(rng: &mut ChaCha8Rng, robots: u8, anchors: usize, exact: bool) -> Self {
        Self::scaled(rng, &vec![None; usize::from(robots)], anchors, exact)
    }

    /// A frame of unknown unit for each `Some(metres per unit)`.
    pub fn scaled(rng: &mut ChaCha8Rng, scales: &[Option<f64>], anchors: usize, exact: bool) -> Self {
        let (truth, frames, problem) = (BTreeMap::new(), BTreeMap::new(), MapProblem::default());
        let mut world = Self { truth, frames, problem, next: 0 };
        for (robot, scale) in (0..).zip(scales) {
            let unit = scale.unwrap_or(1.0);
            let origin = any_pose(rng, 10.0);
            let t_world_frame = Sim3::new(origin.rotation, origin.translation, unit);
            let mut pose = origin;
            let mut odometry = Vec::new();
            for index in 0..anchors {
                let step = any_step(rng);
                pose = pose * step;
                let own = Se3::new(step.rotation, step.translation / unit);
                let covariance = sigmas(ODOMETRY.0 / unit, ODOMETRY.1);
                let stated =
                    if exact { PoseWithCovariance { pose: own, covariance } } else { measured(rng, &own, covariance) };
                odometry.push(stated);
                world.truth.insert(submap(robot, index), pose);
            }
            let kind = if scale.is_some() { ScaleKind::Unknown } else { ScaleKind::Metric };
            world.frames.insert(frame(robot), t_world_frame);
            world.problem.frames.insert(frame(robot), FrameChain { scale: kind, odometry });
        }
        world
    }

    pub fn anchor(&self, id: SubmapId) -> Sim3 {
        let t = self.truth[&id];
        Sim3::new(t.rotation, t.translation, self.frames[&id.frame].scale)
    }

    /// The truth of `t_i_j` with noise (none if `rng` is `None`).
    pub fn measure(&self, rng: Option<&mut ChaCha8Rng>, i: SubmapId, j: SubmapId) -> Relative {
        let truth = self.anchor(i).inverse() * self.anchor(j);
        let unknown = |id: SubmapId| self.problem.frames[&id.frame].scale == ScaleKind::Unknown;
        if i.frame != j.frame && (unknown(i) || unknown(j)) {
            let s = self.frames[&j.frame].scale;
            let sigmas =
                [ALIGNMENT.0 / s, ALIGNMENT.0 / s, ALIGNMENT.0 / s, ALIGNMENT.1, ALIGNMENT.1, ALIGNMENT.1, 0.01];
            let delta = rng.map_or(nalgebra::SVector::zeros(), |rng| {
                nalgebra::SVector::<f64, 7>::from_fn(|k, _| sigmas[k] * normal(rng))
            });
            let covariance = Covariance::from_sigmas(sigmas).unwrap();
            return Relative::Similarity(SimWithCovariance { sim: truth.retract(&delta), covariance });
        }
        let covariance = sigmas(ALIGNMENT.0, ALIGNMENT.1);
        let pose = truth.to_se3();
        Relative::Metric(rng.map_or(PoseWithCovariance { pose, covariance }, |rng| measured(rng, &pose, covariance)))
    }

    pub fn state(&mut self, i: SubmapId, j: SubmapId, t_i_j: Relative) -> EntryId {
        let entry = EntryId { frame: i.frame, seq: self.next };
        self.next += 1;
        self.problem.alignments.push(AgreedAlignment { entry, i, j, t_i_j });
        entry
    }

    /// `count` alignments between each pair of frames, of distinct submaps.
    pub fn align_all(&mut self, rng: &mut ChaCha8Rng, count: usize, exact: bool) {
        let frames: Vec<FrameId> = self.frames.keys().copied().collect();
        for (k, &a) in frames.iter().enumerate() {
            for &b in &frames[k + 1..] {
                self.align(rng, a, b, count, exact);
            }
        }
    }

    pub fn align(&mut self, rng: &mut ChaCha8Rng, a: FrameId, b: FrameId, count: usize, exact: bool) {
        let anchors = self.problem.frames[&a].odometry.len();
        for k in 0..count {
            let (i, j) = (rng.random_range(0..anchors), (rng.random_range(0..anchors / count) * count + k) % anchors);
            let (i, j) = (SubmapId { frame: a, index: i as u32 }, SubmapId { frame: b, index: j as u32 });
            let (i, j) = if rng.random() { (i, j) } else { (j, i) };
            let t = self.measure((!exact).then_some(&mut *rng), i, j);
            self.state(i, j, t);
        }
    }

    pub fn solve(&self) -> JointEstimate {
        solve_map(&self.problem, &EstimateConfig::default())
    }

    pub fn frame_truth(&self, a: FrameId, b: FrameId) -> Sim3 {
        self.frames[&a].inverse() * self.frames[&b]
    }
}

pub fn rigid(t: &Relative) -> PoseWithCovariance {
    *t.metric().expect("a rigid relation")
}

/// Everything an estimate says, as bits.
pub fn bits(map: &JointEstimate) -> Vec<u64> {
    let mut out = vec![map.chi2.to_bits(), map.dof as u64, map.nodes as u64];
    let mut push = |t: &Relative| {
        let s = t.lifted();
        out.extend(s.sim.translation.iter().copied().chain(s.sim.rotation.xyzw()).map(f64::to_bits));
        out.extend(s.covariance.matrix().iter().map(|x| x.to_bits()));
    };
    for frames in map.components() {
        map.anchors(frames[0]).iter().for_each(|(_, t)| push(t));
    }
    map.pairs().iter().filter_map(|p| p.t_a_b.as_ref()).for_each(&mut push);
    map.edges().iter().for_each(|e| push(&e.measurement.t_i_j));
    out.extend(map.edges().iter().flat_map(|e| [e.weight.to_bits(), u64::from(e.measurement.entry.seq)]));
    out
}

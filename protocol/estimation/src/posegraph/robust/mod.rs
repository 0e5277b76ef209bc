//! Pose graphs with false measurements: decides which measurements count (MATH §5).
//!
//! The top byte of a pose's id tells its robot; a robot's own odometry is trusted (`backbone`). All other
//! measurements are loop closures, and the map decides which of them count, without ever starting from an estimate that
//! a false one could bend:
//!
//! 1. Each robot's own closures that agree with its odometry show how much noise there really is (`noise`).
//! 2. Pairs of robots go through the consensus of a swarm's frames (`seed`).
//! 3. Closures that the map contradicts are dropped and those that agree with it are let in, whichever step left them
//!    out, judged with the map's covariance (`world`); what now counts tells the noise better, and more may agree.
//! 4. Parts of the map that few closures tie are merged where those agree through them (`merge`), several together
//!    where no two can be told (`cluster`), and all begins again at 3 until nothing changes.
//!
//! The map is then solved from the closures that count, with the information that the graph states.

mod backbone;
mod cluster;
mod merge;
mod noise;
mod scale;
mod seed;
#[cfg(test)]
mod tests;
mod world;

use super::{Measurement, PoseGraph, covariance_of};
use crate::Unused;
use crate::config::EstimateConfig;
use crate::frames::scales_to;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3};
use crate::graph::{Factor, Source};
use crate::ids::{FrameId, SubmapId};
use crate::kinds::PairStatus;
use crate::solve::Solution;
use backbone::Backbone;
use noise::Noise;
use scale::Scale;
use seed::Seed;
use std::collections::{BTreeMap, BTreeSet};
use world::World;

/// Times that the noise is told anew or parts are merged, at most.
const REVISIONS_MAX: usize = 24;
/// Closures that show so much more noise than is believed are heeded before what counts is asked.
const SCALE_BEYOND: f64 = 1.3;
/// Times that the noise is told anew from each robot's own closures, at most.
const OWN_REVISIONS_MAX: usize = 16;
/// Noise that differs by less is the same.
const NOISE_SHARE: f64 = 0.05;

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
    /// How the map fits what counts.
    pub map: Fit,
    /// The frame and index of each pose.
    pub anchors: BTreeMap<u64, SubmapId>,
    /// By how much standard deviations differ from the stated ones, as all that counts shows (root of the mean variance
    /// over the six directions): decisions were made with these.
    pub sigma_scale: f64,
    solutions: Vec<Solution<SubmapId>>,
}

impl RobustSolved {
    /// Every pose in the coordinates of its component's smallest pose, with the covariance that the stated information
    /// gives.
    pub fn marginals(&self) -> BTreeMap<u64, PoseWithCovariance> {
        self.marginals_from(|_| false)
    }

    /// The same in the coordinates of each component's smallest pose that is preferred, if there is one.
    pub fn marginals_from(&self, is_preferred: impl Fn(u64) -> bool) -> BTreeMap<u64, PoseWithCovariance> {
        let ids: BTreeMap<SubmapId, u64> = self.anchors.iter().map(|(&id, &anchor)| (anchor, id)).collect();
        let mut out = BTreeMap::new();
        for solution in &self.solutions {
            let named = solution.graph().nodes().iter().filter_map(|anchor| Some((*ids.get(anchor)?, *anchor)));
            let Some((_, first)) = named.min_by_key(|(id, _)| (!is_preferred(*id), *id)) else { continue };
            for (anchor, t) in solution.relatives_to(first, &BTreeSet::new()) {
                if let (Some(&id), Some(t)) = (ids.get(&anchor), t.metric()) {
                    out.insert(id, *t);
                }
            }
        }
        out
    }
}

/// How well a map fits its measurements, with the information that they state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Weighted sum of squared residuals over all components.
    pub chi2: f64,
    /// Degrees of freedom over all components.
    pub dof: usize,
    /// Whether every component was solved and converged.
    pub converged: bool,
}

/// A measurement that is not trusted.
#[derive(Clone)]
struct Closure {
    /// Its place in the graph.
    k: usize,
    i: SubmapId,
    j: SubmapId,
    /// As stated, and with the noise there really is.
    stated: PoseWithCovariance,
    t_i_j: PoseWithCovariance,
    /// Why it does not count; `None` if it does.
    unused: Option<Unused>,
    /// How often the map contradicted it.
    drops: u8,
}

/// The robot of a pose: the top byte of its id.
pub fn robot_of(id: u64) -> u8 {
    (id >> 56) as u8
}

impl PoseGraph {
    /// Solves the graph from the measurements that do not contradict the rest.
    pub fn solve_robustly(&self, config: &EstimateConfig) -> RobustSolved {
        let backbone = Backbone::of(self);
        let mut verdicts = vec![Verdict::Unused(Unused::NotFinite); self.measurements.len()];
        backbone.trusted.iter().for_each(|&k| verdicts[k] = Verdict::Odometry);
        let closures = self.closures(&backbone);
        let mut world = World {
            config,
            trusted: BTreeMap::new(),
            nodes: BTreeMap::new(),
            spread: world::spread(&closures),
            rotations: world::rotations(&closures),
            scales: vec![1.0],
            closures,
            start: BTreeMap::new(),
            parts: Vec::new(),
        };
        for &anchor in backbone.anchors.values() {
            world.nodes.entry(anchor.frame).or_default().insert(anchor);
        }
        let noise = self.decide(&mut world, &backbone);
        self.believe(&mut world, &backbone, &Noise::stated());
        world.solve();
        for c in &world.closures {
            verdicts[c.k] = c.unused.map_or(Verdict::Used(1.0), Verdict::Unused);
        }
        let solutions = || world.parts.iter().map(|p| &p.solution);
        RobustSolved {
            verdicts,
            components: components(&backbone.anchors, &world),
            map: Fit {
                chi2: solutions().map(|s| s.chi2).sum(),
                dof: solutions().map(|s| s.dof).sum(),
                converged: solutions().all(|s| s.converged)
                    && world.parts.iter().map(|p| p.frames.len()).sum::<usize>() == world.nodes.len(),
            },
            anchors: backbone.anchors,
            sigma_scale: noise.mean(),
            solutions: solutions().cloned().collect(),
        }
    }

    /// Decides what counts; the noise at the end.
    fn decide(&self, world: &mut World<'_>, backbone: &Backbone) -> Noise {
        let mut noise = Noise::stated();
        let between = |c: &Closure| c.i.frame != c.j.frame;
        // Each robot by itself: closures between robots wait.
        self.believe(world, backbone, &noise);
        world.start = self.dead_reckoned(backbone);
        world.settle();
        for _ in 0..OWN_REVISIONS_MAX {
            let told = world.noise(&noise);
            let same = told.is_near(&noise, NOISE_SHARE);
            noise = told;
            self.believe(world, backbone, &noise);
            if same {
                break;
            }
            world.settle();
        }
        let step = |k: usize| {
            let m = &self.measurements[k];
            let t = measured(m, &noise).unwrap_or_else(crate::marginals::certain);
            if m.i < m.j { t } else { t.inverse() }
        };
        let seed = Seed::new(backbone, step, &world.closures, world.config);
        for c in world.closures.iter_mut().filter(|c| between(c)) {
            if seed.used.contains(&c.k) {
                c.unused = None;
            }
        }
        self.lay_out(world, &seed);
        let mut is_crowded = false;
        // What counted when all closures last showed more noise than was believed, and whether it did before.
        let mut raised: (Vec<usize>, bool) = (Vec::new(), false);
        for _ in 0..REVISIONS_MAX {
            world.settle();
            let shown = world.scale();
            if let Scale::Clear(_) = shown
                && !is_crowded
            {
                world.scales = scales_to(world.config.covariance_scale_max.max(1.0)).to_vec();
            }
            let told = match shown {
                _ if is_crowded => noise,
                Scale::Crowded => {
                    // What was let in at another noise is judged again.
                    is_crowded = true;
                    world.scales = vec![1.0];
                    Noise::stated()
                }
                Scale::Clear(scale) if scale > SCALE_BEYOND => {
                    let used = world.used();
                    raised = (used.clone(), used == raised.0);
                    noise.scaled(scale)
                }
                // What counts shows too little, over and over, for lack of the others.
                Scale::Clear(_) if raised.1 && raised.0 == world.used() => noise,
                Scale::Clear(_) => world.noise(&noise),
            };
            if !told.is_near(&noise, NOISE_SHARE) {
                noise = told;
                self.believe(world, backbone, &noise);
            } else if !world.admit_together() && !world.merge() && (is_crowded || !world.merge_together()) {
                // Cuts of few closures say nothing where false ones agree with each other.
                break;
            }
        }
        noise
    }

    /// Takes a noise for the true one.
    fn believe(&self, world: &mut World<'_>, backbone: &Backbone, noise: &Noise) {
        world.forget();
        world.trusted.clear();
        for &k in &backbone.trusted {
            let m = &self.measurements[k];
            let (i, j) = (backbone.anchors[&m.i], backbone.anchors[&m.j]);
            if let Some(t) = measured(m, noise) {
                let factor = Factor { label: Source::Odometry, i, j, t_i_j: Relative::Metric(t), weight: 1.0 };
                world.trusted.entry(i.frame).or_default().push(factor);
            }
        }
        for c in &mut world.closures {
            c.t_i_j.covariance = noise.of(&c.stated.covariance);
        }
    }

    fn closures(&self, backbone: &Backbone) -> Vec<Closure> {
        let loops = self.measurements.iter().enumerate().filter(|(k, _)| !backbone.trusted.contains(k));
        let closure = |(k, m): (usize, &Measurement)| {
            let (i, j) = (backbone.anchors[&m.i], backbone.anchors[&m.j]);
            let stated = measured(m, &Noise::stated())?;
            let unused = Some(Unused::Unmerged(PairStatus::Inconsistent));
            Some(Closure { k, i, j, stated, t_i_j: stated, unused, drops: 0 })
        };
        loops.filter_map(closure).collect()
    }

    /// `t_frame_anchor` along the trusted measurements.
    fn dead_reckoned(&self, backbone: &Backbone) -> BTreeMap<SubmapId, Sim3> {
        let mut neighbours: BTreeMap<SubmapId, Vec<(SubmapId, Se3)>> = BTreeMap::new();
        for &k in &backbone.trusted {
            let m = &self.measurements[k];
            let (i, j) = (backbone.anchors[&m.i], backbone.anchors[&m.j]);
            neighbours.entry(i).or_default().push((j, m.t_i_j));
            neighbours.entry(j).or_default().push((i, m.t_i_j.inverse()));
        }
        let mut out = BTreeMap::new();
        let frames: BTreeSet<FrameId> = backbone.anchors.values().map(|a| a.frame).collect();
        for frame in frames {
            let first = SubmapId { frame, index: 0 };
            out.insert(first, Sim3::identity());
            let mut next = vec![first];
            while let Some(at) = next.pop() {
                let here = out[&at];
                for (other, t) in neighbours.get(&at).into_iter().flatten() {
                    if !out.contains_key(other) {
                        out.insert(*other, here * Sim3::from_se3(t));
                        next.push(*other);
                    }
                }
            }
        }
        out
    }

    /// Puts the frames where the consensus has them, each as it solved itself.
    fn lay_out(&self, world: &mut World<'_>, seed: &Seed) {
        for frame in world.nodes.keys().copied().collect::<Vec<_>>() {
            let first = SubmapId { frame, index: 0 };
            if let (Some(told), Some(own)) = (seed.start.get(&first), world.start.get(&first)) {
                let t = (*told * own.inverse()).to_se3();
                world.place(&BTreeSet::from([frame]), &t);
            }
        }
    }
}

fn measured(m: &Measurement, noise: &Noise) -> Option<PoseWithCovariance> {
    let stated: Covariance<6> = covariance_of(&m.information)?;
    Some(PoseWithCovariance { pose: m.t_i_j, covariance: noise.of(&stated) })
}

/// Poses by component, in the coordinates of its smallest pose.
fn components(anchors: &BTreeMap<u64, SubmapId>, world: &World<'_>) -> Vec<BTreeMap<u64, Se3>> {
    let part_of: BTreeMap<FrameId, usize> =
        world.parts.iter().enumerate().flat_map(|(k, p)| p.frames.iter().map(move |&f| (f, k))).collect();
    let mut out: BTreeMap<usize, BTreeMap<u64, Se3>> = BTreeMap::new();
    for (&id, anchor) in anchors {
        if let (Some(&part), Some(pose)) = (part_of.get(&anchor.frame), world.start.get(anchor)) {
            out.entry(part).or_default().insert(id, pose.to_se3());
        }
    }
    let rebased = |mut poses: BTreeMap<u64, Se3>| {
        let origin = poses.values().next().map_or_else(Se3::identity, Se3::inverse);
        poses.values_mut().for_each(|pose| *pose = origin * *pose);
        poses
    };
    out.into_values().map(rebased).collect()
}

//! Heavy work as a value: a pure function of its data, run by the shell wherever it likes. The simulator runs jobs
//! inline and charges virtual time by [`Job::kind`]; a replay runs them again instead of storing their results.

use super::two_sided;
use crate::align::{Model, Problem, SolverConfig};
use crate::config::{AlignConfig, EstimateConfig, Sensor, SubmapConfig};
use crate::estimate::PairEstimate;
use crate::estimate::extrapolation::End;
use crate::estimate::joint::{AgreedAlignment, EdgeEstimate, MapProblem, Shortfall, Unused, solve_map_recalling};
use crate::estimate::node::Node;
use crate::estimate::optimality::Optimality;
use crate::estimate::solve::ComponentError;
use crate::estimate::verdicts::Verdicts;
use crate::geometry::Relative;
use crate::ids::{FrameId, SubmapId};
use crate::submap::landmarks::{self, LandmarkConfig, LandmarkError};
use crate::submap::planar::PlanarConfig;
use crate::submap::{
    self, Described, Features, Keypoints, RefineConfig, RefineError, RegisterConfig, RegisterError, Registered, Submap,
    Verticals,
};
use crate::wire::fact::{RefusalReason, ScaleKind};
use std::collections::BTreeMap;
use std::sync::Arc;

/// A piece of heavy work.
#[derive(Clone, Debug)]
pub enum Job {
    /// Describe a finished submap.
    Describe(Box<DescribeJob>),
    /// Align a peer's keypoints with one of our submaps.
    Align(Box<AlignJob>),
    /// Solve the joint estimate.
    Solve(Box<SolveJob>),
}

/// See [`Job::Describe`].
#[derive(Clone, Debug)]
pub struct DescribeJob {
    /// The submap, which comes back with the result.
    pub submap: Submap,
    /// How to describe it.
    pub config: SubmapConfig,
}

/// Keypoints of one submap, and the features of another to recognise them by.
pub type Look = (Arc<Keypoints>, Arc<Features>);

/// See [`Job::Align`].
#[derive(Clone, Debug)]
pub struct AlignJob {
    /// The peer's keypoints, in its anchor frame.
    pub theirs: Arc<Keypoints>,
    /// Our features, in our anchor frame.
    pub mine: Arc<Features>,
    /// The other way round, if both submaps are ours and nobody else looks: our keypoints for the other's features.
    /// Both ways must agree.
    pub back: Option<Look>,
    /// Acceptance.
    pub config: AlignConfig,
    /// Thinning voxel of our submaps, m: the unit of the noise bound.
    pub voxel_m: f64,
    /// What made our points.
    pub sensor: Sensor,
    /// Which way is up, if both submaps know.
    pub verticals: Option<Verticals>,
    /// SE(3), or SIM(3) if either side's unit is unknown.
    pub scale: ScaleKind,
    /// Seed of the sampler: our own, so that the two endpoints are independent.
    pub seed: u64,
}

/// See [`Job::Solve`].
#[derive(Clone, Debug)]
pub struct SolveJob {
    /// What is known.
    pub problem: MapProblem,
    /// How to solve it.
    pub config: EstimateConfig,
    /// The frame that views are given in.
    pub own: FrameId,
    /// Pairs of anchors whose relation is asked for.
    pub live: Vec<(SubmapId, SubmapId)>,
    /// What is known of pairs of frames from the solve before. The result does not depend on it.
    pub verdicts: Verdicts,
}

/// What a [`Job`] gave.
#[derive(Clone, Debug)]
pub enum JobResult {
    /// Of [`Job::Describe`].
    Described(Box<(Submap, Described)>),
    /// Of [`Job::Align`].
    Aligned(Result<Box<Measured>, NotAligned>),
    /// Of [`Job::Solve`].
    Solved(Box<Solved>),
}

/// What is kept of a joint estimate. The factorisation it was drawn from takes kilobytes a submap and goes.
#[derive(Clone, Debug, Default)]
pub struct Solved {
    /// `t_own_anchor` of every submap connected to our frame.
    pub anchors: BTreeMap<SubmapId, Relative>,
    /// `t_i_j` of the pairs that were asked for, cross-correlations included, where they are connected.
    pub live: BTreeMap<(SubmapId, SubmapId), Relative>,
    /// How robots go on from the last of them.
    pub ends: BTreeMap<SubmapId, End>,
    /// Every frame of the problem.
    pub frames: BTreeMap<FrameId, Placed>,
    /// Every pair of frames with an agreed alignment, ascending.
    pub pairs: Vec<PairEstimate>,
    /// Every alignment and sighting in canonical order, used or not.
    pub edges: Vec<EdgeEstimate>,
    /// Weighted sum of squared residuals.
    pub chi2: f64,
    /// Degrees of freedom.
    pub dof: usize,
    /// Anchors.
    pub nodes: usize,
    /// Whether it is proved to be the global optimum.
    pub optimality: Optimality,
    /// Whether every component was solved and converged.
    pub converged: bool,
    /// The components that were not, and why.
    pub failed: Vec<(Vec<FrameId>, Shortfall)>,
    /// For the next solve.
    pub verdicts: Verdicts,
}

impl Solved {
    /// The submaps by their indices, where the problem counted places in a chain that has gaps.
    pub(super) fn with_indices(mut self, gaps: &BTreeMap<FrameId, Vec<u32>>) -> Self {
        let index = |id: SubmapId| {
            let there = gaps.get(&id.frame).and_then(|chain| chain.get(id.index as usize));
            there.map_or(id, |index| SubmapId { index: *index, ..id })
        };
        if !gaps.is_empty() {
            self.anchors = self.anchors.into_iter().map(|(id, t)| (index(id), t)).collect();
            self.live = self.live.into_iter().map(|((i, j), t)| ((index(i), index(j)), t)).collect();
            self.ends = self.ends.into_iter().map(|(id, end)| (index(id), end)).collect();
            for AgreedAlignment { i, j, .. } in self.edges.iter_mut().map(|edge| &mut edge.measurement) {
                (*i, *j) = (index(*i), index(*j));
            }
            for edge in &mut self.edges {
                if let Some(Unused::Failed(ComponentError::UnderconstrainedNode(node))) = &mut edge.unused {
                    *node = Node::Anchor(index(node.submap()));
                }
            }
            for middle in self.pairs.iter_mut().filter_map(|pair| pair.middle.as_mut()) {
                (middle.i, middle.j) = (index(middle.i), index(middle.j));
            }
            for (_, why) in &mut self.failed {
                if let Shortfall::Unsolved(ComponentError::UnderconstrainedNode(node)) = why {
                    *node = Node::Anchor(index(node.submap()));
                }
            }
        }
        self
    }
}

/// Where a frame is.
#[derive(Clone, Debug)]
pub struct Placed {
    /// The smallest frame of its component.
    pub with: FrameId,
    /// `t_own_frame`, if it is connected to ours.
    pub t_own_frame: Option<Relative>,
}

/// An alignment that passed every gate.
#[derive(Clone, Debug)]
pub struct Measured {
    /// `t_mine_theirs`.
    pub t_mine_theirs: Relative,
    /// σ̂ of the correspondences, in our units.
    pub sigma: f64,
    /// Σ of inlier probabilities.
    pub support: f64,
    /// log₁₀ NFA.
    pub log10_nfa: f64,
}

/// Why there is no alignment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NotAligned {
    /// What the other endpoint is told.
    pub reason: RefusalReason,
    /// Another place fits as well: not the same one turned, slid or in a mirror.
    pub elsewhere: bool,
}

impl From<RefusalReason> for NotAligned {
    fn from(reason: RefusalReason) -> Self {
        Self { reason, elsewhere: false }
    }
}

/// [`NotAligned`], and in words what was found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Refused {
    /// For robots.
    pub not: NotAligned,
    /// For people.
    pub why: String,
}

impl Refused {
    fn new(not: impl Into<NotAligned>, why: impl ToString) -> Self {
        Self { not: not.into(), why: why.to_string() }
    }
}

impl Job {
    /// Does the work. Deterministic: the same job gives the same result.
    pub fn run(self) -> JobResult {
        match self {
            Self::Describe(job) => {
                let described = submap::describe(&job.submap, &job.config);
                JobResult::Described(Box::new((job.submap, described)))
            }
            Self::Align(job) => JobResult::Aligned(job.look().map(Box::new).map_err(|refused| refused.not)),
            Self::Solve(job) => JobResult::Solved(Box::new(job.run())),
        }
    }

    /// A short name for logs, statistics and cost models.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Describe(_) => "describe",
            Self::Align(_) => "align",
            Self::Solve(_) => "solve",
        }
    }

    /// Anchors and measurements that a solve is about, for cost models; 1 of other jobs.
    pub fn size(&self) -> usize {
        match self {
            Self::Describe(_) | Self::Align(_) => 1,
            Self::Solve(job) => {
                let MapProblem { frames, alignments, sightings, positions, .. } = &job.problem;
                let anchors: usize = frames.values().map(|frame| frame.odometry.len()).sum();
                anchors + alignments.len() + sightings.len() + positions.len()
            }
        }
    }
}

impl SolveJob {
    fn run(mut self) -> Solved {
        let estimate = solve_map_recalling(&self.problem, &self.config, &mut self.verdicts);
        let components = estimate.components().filter_map(|frames| Some((*frames.iter().min()?, frames)));
        let placed = |frame| estimate.frame(self.own, frame);
        let related = estimate.relatives(&self.live);
        Solved {
            anchors: estimate.anchors(self.own).into_iter().collect(),
            live: self.live.iter().copied().zip(related).filter_map(|(pair, t)| Some((pair, t?))).collect(),
            ends: estimate.ends(self.own),
            frames: components
                .flat_map(|(with, frames)| frames.iter().map(move |&f| (f, Placed { with, t_own_frame: placed(f) })))
                .collect(),
            pairs: estimate.pairs().to_vec(),
            edges: estimate.edges().to_vec(),
            chi2: estimate.chi2,
            dof: estimate.dof,
            nodes: estimate.nodes,
            optimality: estimate.optimality(),
            converged: estimate.converged,
            failed: estimate.shortfalls().map(|(frames, why)| (frames.to_vec(), why)).collect(),
            verdicts: self.verdicts,
        }
    }
}

impl AlignJob {
    /// Does the work.
    ///
    /// # Errors
    /// Why there is no alignment.
    pub fn look(&self) -> Result<Measured, Refused> {
        let there = self.one_way(&self.theirs, &self.mine, self.verticals)?;
        let Some((keypoints, features)) = &self.back else { return Ok(there) };
        let back = self.one_way(keypoints, features, self.verticals.map(Verticals::back))?;
        let t_mine_theirs = back.t_mine_theirs.inverse();
        if !two_sided::agree(&there.t_mine_theirs, &t_mine_theirs) {
            let why = "seen from the one they lie otherwise than seen from the other, by more than both claim";
            return Err(Refused::new(RefusalReason::Ambiguous, why));
        }
        let t_mine_theirs = two_sided::midway(&there.t_mine_theirs, &t_mine_theirs);
        Ok(Measured {
            t_mine_theirs: t_mine_theirs.unwrap_or(there.t_mine_theirs),
            sigma: there.sigma.max(back.sigma),
            support: there.support.min(back.support),
            log10_nfa: there.log10_nfa.max(back.log10_nfa),
        })
    }

    /// Where units are metres, clouds judge the poses that matches suggest; else the matches alone decide. In the plane
    /// all poses are tried.
    fn one_way(&self, theirs: &Keypoints, mine: &Features, verticals: Option<Verticals>) -> Result<Measured, Refused> {
        match (self.sensor, self.scale) {
            (Sensor::Laser2d, ScaleKind::Metric) => {
                self.measured(submap::planar::register(theirs, mine, &PlanarConfig::default()))
            }
            // In the plane nobody tells a scale.
            (Sensor::Laser2d | Sensor::Landmarks2d, ScaleKind::Unknown) => {
                Err(Refused::new(RefusalReason::BadInput, "what lies in a plane tells no scale; state it in metres"))
            }
            (Sensor::Landmarks2d, ScaleKind::Metric) => self.landmarks(theirs, mine, true),
            (Sensor::Landmarks, _) => upright(self.landmarks(theirs, mine, false)?, verticals),
            (Sensor::Points3d | Sensor::Lidar3d, ScaleKind::Metric) => self.register(theirs, mine, verticals),
            (Sensor::Points3d | Sensor::Lidar3d, ScaleKind::Unknown) => upright(self.align(theirs, mine)?, verticals),
        }
    }

    fn landmarks(&self, theirs: &Keypoints, mine: &Features, planar: bool) -> Result<Measured, Refused> {
        let config = LandmarkConfig { planar, solver: self.solver() };
        let found = landmarks::register(theirs, mine, &config).map_err(|e| {
            let elsewhere = matches!(e, LandmarkError::Ambiguous { elsewhere: true, .. });
            Refused::new(NotAligned { reason: RefusalReason::from(&e), elsewhere }, e)
        })?;
        let landmarks::Aligned { t_mine_theirs, sigma, support, log10_nfa } = found;
        Ok(Measured { t_mine_theirs, sigma, support, log10_nfa })
    }

    fn register(&self, theirs: &Keypoints, mine: &Features, verticals: Option<Verticals>) -> Result<Measured, Refused> {
        let config = RegisterConfig {
            solver: self.solver(),
            fit_min: self.config.fit_min,
            refine: RefineConfig::of(self.sensor),
            verticals,
            ..RegisterConfig::default()
        };
        self.measured(submap::register(theirs, mine, &config))
    }

    fn measured(&self, found: Result<Registered, RegisterError>) -> Result<Measured, Refused> {
        let found = found.map_err(|error| {
            let not = match error {
                RegisterError::Ambiguous { elsewhere, .. } | RegisterError::Aliased { elsewhere, .. } => {
                    NotAligned { reason: RefusalReason::Ambiguous, elsewhere }
                }
                RegisterError::NoConsensus { .. } | RegisterError::Tilted { .. } => RefusalReason::NoConsensus.into(),
                RegisterError::Refine(RefineError::Degenerate { .. }) => RefusalReason::Degenerate.into(),
                RegisterError::Refine(RefineError::TooFewPairs { .. }) => RefusalReason::PoorFit.into(),
                RegisterError::Refine(_) => RefusalReason::NoConsensus.into(),
                RegisterError::Solver(_)
                | RegisterError::Thinning { .. }
                | RegisterError::Crowded { .. }
                | RegisterError::NotPlanar => RefusalReason::BadInput.into(),
            };
            Refused::new(not, error)
        })?;
        self.is_no_chance(found.log10_nfa)?;
        Ok(Measured {
            t_mine_theirs: Relative::Metric(found.refined.pose),
            sigma: found.refined.rms,
            support: found.support,
            log10_nfa: found.log10_nfa,
        })
    }

    fn is_no_chance(&self, log10_nfa: f64) -> Result<(), Refused> {
        let max = self.config.log10_nfa_max;
        if log10_nfa <= max {
            return Ok(());
        }
        let why = format!(
            "by chance the best pose is as good once in 10^{:.1} tries, at least 10^{:.1} are asked for",
            -log10_nfa, -max
        );
        Err(Refused::new(RefusalReason::NoConsensus, why))
    }

    /// Matches, finds a consensus, checks the fit (MATH §4).
    fn align(&self, theirs: &Keypoints, mine: &Features) -> Result<Measured, Refused> {
        let matches = submap::match_keypoints(theirs, mine);
        let problem = Problem {
            source: &matches.source,
            target: &matches.target,
            scores: Some(&matches.scores),
            ..Problem::default()
        };
        let found = crate::align::align(&problem, &self.solver())
            .map_err(|error| Refused::new(RefusalReason::BadInput, error))?
            .map_err(|refusal| Refused::new(RefusalReason::from(refusal), refusal))?;
        let radius = self.voxel_m * 1.5;
        let fit = submap::fit(theirs, mine, &found.t_target_source.sim(), radius);
        if fit < self.config.fit_min {
            let why =
                format!("{fit:.2} of the keypoints lie near the other's surface, {:.2} must", self.config.fit_min);
            return Err(Refused::new(RefusalReason::PoorFit, why));
        }
        let t_mine_theirs = found.t_target_source;
        let (sigma, support, log10_nfa) = (found.sigma, found.support, found.log10_nfa);
        Ok(Measured { t_mine_theirs, sigma, support, log10_nfa })
    }

    fn solver(&self) -> SolverConfig {
        SolverConfig {
            model: match self.scale {
                ScaleKind::Metric => Model::Rigid,
                ScaleKind::Unknown => Model::Similarity { scale_min: 0.05, scale_max: 20.0 },
            },
            sigma_max: self.config.sigma_max_voxels * self.voxel_m,
            log10_nfa_max: self.config.log10_nfa_max,
            support_min: self.config.support_min,
            seed: self.seed,
            ..SolverConfig::default()
        }
    }
}

/// What matches alone decided, unless it tilts one submap's vertical against the other's.
fn upright(measured: Measured, verticals: Option<Verticals>) -> Result<Measured, Refused> {
    let (rotation, covariance) = match &measured.t_mine_theirs {
        Relative::Metric(p) => (p.pose.rotation, p.covariance.matrix().fixed_view::<3, 3>(3, 3).into_owned()),
        Relative::Similarity(s) => (s.sim.rotation, s.covariance.matrix().fixed_view::<3, 3>(3, 3).into_owned()),
    };
    let sigma = covariance.symmetric_eigenvalues().max().sqrt();
    match verticals {
        Some(known) if !known.allow(&rotation.matrix(), sigma) => {
            Err(Refused::new(RefusalReason::NoConsensus, "the pose tilts what both submaps know to be upright"))
        }
        _ => Ok(measured),
    }
}

//! Frame-level consensus: from many alignments between two frames, some false, to T_αβ with its covariance, or to the
//! reason why not (MATH §5: adaptive pairwise consistency).
//!
//! Every alignment is one hypothesis; nothing is sampled. Pair distances under relative trajectory covariances give a
//! graph of agreement at each of 5 covariance scales in [1, 3]. The largest cliques of each are settled: joint least
//! squares with cross-covariances, and a leave-one-out χ² test, marginalised over the scale, that drops what the others
//! do not predict. The settled sets are candidates of an explanation: one set that speaks of one transform, or two that
//! speak of two, by σ-marginalised evidence of their stacked residuals. Frames merge at a number of false alarms (NFA)
//! < 1e-4 and 3 alignments beyond doubt, unless a second set has about as many members as the first. A doubtful
//! alignment is not used, and where the answer hangs on it the frames do not merge. Alignments that contradict the set
//! make the others doubtful; those that are too vague to say anything do not. Same set of alignments, same answer to the
//! bit, in any order. Frames of which all that is known lies in one plane are decided in three degrees of freedom.
//!
//! *Measured* by `merganser-sim bench frames` over thousands of worlds: 4 true alignments against 3 of one lie merge
//! rightly in 99.1 to 99.8 %, 4 against 4 are ambiguous in 99.9 to 100 %. The NFA alone, without evidence, reaches 97
//! and merges 0.3 % of the former wrongly; the prototype of MATH §5, over 400 worlds, 97.8 and 2.3 %.

pub(super) mod clique;
mod decide;
mod doubt;
mod evidence;
mod explain;
mod gls;
mod hypothesis;
mod measured;
mod pairs;
mod planar;
mod predict;
mod promising;
mod scaled;
#[cfg(test)]
mod tests;
#[doc(hidden)]
pub mod world;

use super::trajectory::Trajectory;
use crate::config::EstimateConfig;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, Sim3, SimWithCovariance, chi2};
use measured::Measured;
pub(super) use measured::scales_to;
pub(super) use promising::promising;
pub use scaled::SimMeasurement;

/// Alignments between two frames considered at most. Of more, this many are taken evenly along the first frame: a rule
/// deaf to what an alignment claims about itself.
pub const ALIGNMENTS_MAX: usize = clique::VERTICES_MAX;

/// One alignment between submap anchor `i` of frame α and `j` of frame β.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PairAlignment<T = PoseWithCovariance> {
    /// Anchor's index in α's trajectory.
    pub i: usize,
    /// Anchor's index in β's trajectory.
    pub j: usize,
    /// The measurement.
    pub t_i_j: T,
}

/// When two frames count as aligned.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameConsensusConfig {
    /// Mutually consistent alignments needed to merge.
    pub alignments_min: usize,
    /// Largest log₁₀ NFA that merges.
    pub log10_nfa_max: f64,
    /// Largest factor by which true standard deviations may exceed the stated ones.
    pub covariance_scale_max: f64,
    /// Least edge of the box in which a false alignment may fall, in frame units; trajectories longer than that enlarge
    /// it. Also the length beside which it is small what doubtful alignments may move. Choose the reach of an
    /// alignment: about a submap's diameter.
    pub search_edge_min: f64,
    /// How a false alignment may be turned.
    pub rotations: Rotations,
}

/// The rotations over which false alignments spread.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rotations {
    /// Any heading, tilts within 0.2 rad: robots that know or keep the vertical. Never optimistic for others.
    Heading,
    /// Any rotation at all, volume 8π².
    All,
}

/// What the alignments between two frames amount to.
#[derive(Clone, Debug, PartialEq)]
pub enum FrameOutcome<T = PoseWithCovariance> {
    /// No alignment refers to anchors of both frames.
    None,
    /// Enough alignments agree: the frames are one.
    Merged(FrameConsensus<T>),
    /// What there is agrees, but it is too little to merge on, or hangs on one that may be false: to show, not to use.
    Provisional(FrameConsensus<T>),
    /// Two disjoint sets of alignments contradict each other and do about equally well.
    Ambiguous {
        /// The better set.
        best: FrameConsensus<T>,
        /// Its rival.
        rival: FrameConsensus<T>,
    },
    /// What agrees does not give the frames' scale: no alignment measures it, and the baseline between them is too
    /// short for the scale.
    BaselineTooShort {
        /// Standard deviation of log-scale that the baselines support.
        log_scale_sigma: f64,
    },
    /// Several alignments, and no set of them agrees better than chance.
    Inconsistent,
}

/// T_αβ as a set of mutually consistent alignments gives it.
#[derive(Clone, Debug, PartialEq)]
pub struct FrameConsensus<T = PoseWithCovariance> {
    /// `t_alpha_beta` with its covariance, the scale included.
    pub t_alpha_beta: T,
    /// The alignments used, as ascending positions in the caller's slice.
    pub used: Vec<usize>,
    /// Factor on standard deviations that the residuals ask for: 1 unless they are larger than chance explains, at most
    /// the configured largest.
    pub covariance_scale: f64,
    /// Log₁₀ of the number of false alarms.
    pub log10_nfa: f64,
}

impl<T> FrameOutcome<T> {
    /// The consensus that merges the frames, where there is one.
    pub fn merged(&self) -> Option<&FrameConsensus<T>> {
        match self {
            Self::Merged(consensus) => Some(consensus),
            _ => None,
        }
    }
}

impl From<&EstimateConfig> for FrameConsensusConfig {
    fn from(config: &EstimateConfig) -> Self {
        Self {
            alignments_min: config.alignments_min,
            log10_nfa_max: config.log10_nfa_max,
            covariance_scale_max: config.covariance_scale_max,
            search_edge_min: 2.0,
            rotations: Rotations::Heading,
        }
    }
}

impl Default for FrameConsensusConfig {
    fn default() -> Self {
        Self::from(&EstimateConfig::default())
    }
}

/// Aligns two metric frames; those of planar robots in their three degrees of freedom (`planar.rs`).
pub fn align_frames(
    alpha: &Trajectory,
    beta: &Trajectory,
    alignments: &[PairAlignment],
    config: &FrameConsensusConfig,
) -> FrameOutcome {
    if let Some(outcome) = planar::align(alpha, beta, alignments, config) {
        return outcome;
    }
    let rigid = alignments.iter().map(|a| (a.i, a.j, (a.t_i_j.pose, a.t_i_j.covariance, true)));
    Measured::<6, Se3>::new(alpha, beta, rigid, config)
        .outcome()
        .map(|_, pose, covariance| PoseWithCovariance { pose, covariance })
}

/// Aligns two frames of which at least one has unknown scale: `t_alpha_beta` is a similarity. Alignments measure scale
/// themselves, or leave it to the baselines between them; see [`SimMeasurement`]. The same machinery with 7 degrees of
/// freedom.
pub fn align_frames_sim<T: Copy + Into<SimMeasurement>>(
    alpha: &Trajectory,
    beta: &Trajectory,
    alignments: &[PairAlignment<T>],
    config: &FrameConsensusConfig,
) -> FrameOutcome<SimWithCovariance> {
    let similar = alignments.iter().map(|a| (a.i, a.j, a.t_i_j.into().parts()));
    Measured::<7, Sim3>::new(alpha, beta, similar, config)
        .outcome()
        .map(|_, sim, covariance| SimWithCovariance { sim, covariance })
}

impl<G, const N: usize> FrameOutcome<(G, Covariance<N>)> {
    /// `f` of the alignments used, T_αβ and its covariance.
    fn map<T>(self, f: impl Fn(&[usize], G, Covariance<N>) -> T) -> FrameOutcome<T> {
        let map = |c: FrameConsensus<(G, Covariance<N>)>| FrameConsensus {
            t_alpha_beta: f(&c.used, c.t_alpha_beta.0, c.t_alpha_beta.1),
            used: c.used,
            covariance_scale: c.covariance_scale,
            log10_nfa: c.log10_nfa,
        };
        match self {
            Self::None => FrameOutcome::None,
            Self::Merged(c) => FrameOutcome::Merged(map(c)),
            Self::Provisional(c) => FrameOutcome::Provisional(map(c)),
            Self::Ambiguous { best, rival } => FrameOutcome::Ambiguous { best: map(best), rival: map(rival) },
            Self::BaselineTooShort { log_scale_sigma } => FrameOutcome::BaselineTooShort { log_scale_sigma },
            Self::Inconsistent => FrameOutcome::Inconsistent,
        }
    }
}

/// Gate on d² of a pair at a covariance scale: two true alignments are seldom further apart.
fn gate(dimension: usize, scale: f64) -> f64 {
    chi2::P999[dimension.clamp(1, chi2::P999.len()) - 1] * scale * scale
}

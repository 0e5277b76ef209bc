//! σ-consensus at the level of correspondences: from matched points, most of them wrong, to a rigid motion or a
//! similarity with a calibrated covariance, or to a refusal that says why.
//!
//! The noise scale σ is not told, only bounded by `sigma_max`; it is marginalised in each step (MATH §4):
//! 1. `sample` proposes hypotheses from triangles of matches whose lengths agree (`graph`; for SIM(3) from matches that
//!    agree about a pair, at one scale, `scales`, and on one turn, `turns`), ranked by how many further matches agree
//!    with them, on nested prefixes of the matches (best scores first) and σ levels from tight to loose; `tally`
//!    prescores each by its own number of false alarms over all radii.
//! 2. `evidence` starts the refinement at the σ of highest evidence, of a Gaussian-inlier, uniform-outlier mixture.
//! 3. `refine` polishes by expectation-maximisation, then by the kernel density weights S(12)–S(30) of [`sigma`] where
//!    they predict held-out residuals better.
//! 4. `accept` admits by number of false alarms (`chance` measures what chance does), never by evidence; a disjoint
//!    rival makes the answer ambiguous.
//! 5. `covariance` states what is known, and refuses geometry that leaves a direction undetermined.
//!
//! Points may have covariances of their own (`noise`): search and prescore go by a typical one, all later steps by
//! each.
//!
//! Everything is a function of the *set* of matches and the seed: matches are sorted first, so their order changes
//! nothing, to the bit.

mod accept;
mod chance;
mod consensus;
mod covariance;
mod density;
mod evidence;
mod graph;
mod noise;
mod prepare;
mod refine;
mod sample;
mod scales;
pub mod sigma;
mod solve;
mod tally;
#[cfg(test)]
mod tests;
mod turns;

use crate::geometry::{Covariance, Relative};
use crate::kinds::RefusalReason;
pub use consensus::{SigmaConsensus, align};
pub use noise::CONDITION_MAX;
use thiserror::Error;

/// Matches a problem may hold; [`SolverConfig::points_max`] may lower it.
pub const POINTS_LIMIT: usize = 65_535;
/// Largest absolute coordinate accepted.
pub const COORDINATE_MAX: f64 = 1e9;

/// Matched points: `target[i]` is thought to be the place of `source[i]`, most often wrongly.
///
/// Covariances of the points' noise, where stated, need be known up to one common factor only: it is the σ that is
/// marginalised. σ̂ is then the standard deviation per axis of the match of median covariance (at scale 1).
#[derive(Clone, Copy, Debug, Default)]
pub struct Problem<'a> {
    /// Points in the source frame.
    pub source: &'a [[f64; 3]],
    /// Points in the target frame, same length.
    pub target: &'a [[f64; 3]],
    /// How trustworthy each match is, higher is better; only their order matters. Good matches are tried first.
    pub scores: Option<&'a [f64]>,
    /// Covariance of each source point, in the source frame. Of the sides, one that states none counts as exact; if
    /// neither does, all matches count as alike.
    pub source_covariances: Option<&'a [Covariance<3>]>,
    /// Covariance of each target point, in the target frame.
    pub target_covariances: Option<&'a [Covariance<3>]>,
}

/// What kind of motion is sought.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Model {
    /// SE(3): both frames share their unit.
    Rigid,
    /// SIM(3): target units per source unit lie in the given range. Residuals are then compared in the coarser of the
    /// two units (divided by min(s, 1)), so that shrinking never wins.
    Similarity {
        /// Smallest scale tried, > 0.
        scale_min: f64,
        /// Largest scale tried.
        scale_max: f64,
    },
}

impl Model {
    /// Smallest and largest scale: 1 and 1 for a rigid motion.
    pub(crate) fn scale_range(self) -> (f64, f64) {
        match self {
            Self::Rigid => (1.0, 1.0),
            Self::Similarity { scale_min, scale_max } => (scale_min, scale_max),
        }
    }
}

/// Which weights refine (and, in the result, refined) the transform.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Weighting {
    /// Whichever predicts held-out residuals better.
    Auto,
    /// Posteriors of the Gaussian and uniform mixture: efficient under Gaussian noise.
    Em,
    /// Kernel density weights, S(30): better under heavy tails and near misses.
    Kde,
}

/// Settings of [`align`].
#[derive(Clone, Debug, PartialEq)]
pub struct SolverConfig {
    /// The kind of motion.
    pub model: Model,
    /// Upper bound of the noise's standard deviation per axis, in target units. Generous is safe: 3–10 × the truth
    /// costs time and little else.
    pub sigma_max: f64,
    /// Accept below this log₁₀ of the number of false alarms.
    pub log10_nfa_max: f64,
    /// Report as [`Standing::Provisional`] what is not accepted but below this log₁₀ NFA; `None` reports no such.
    pub log10_nfa_provisional: Option<f64>,
    /// Accept from this many matches on.
    pub support_min: f64,
    /// A disjoint, itself significant alignment with this share of the support (0 to 1] makes the answer ambiguous.
    pub rival_ratio: f64,
    /// Largest standard deviation of any rotation axis, rad; beyond it the geometry counts as degenerate.
    pub rotation_sigma_max: f64,
    /// Weights of the refinement.
    pub weighting: Weighting,
    /// Orders matches of equal score. Two endpoints use different seeds, so that their answers are independent.
    pub seed: u64,
    /// Hypotheses scored per search step.
    pub hypotheses_max: usize,
    /// Matches accepted at most.
    pub points_max: usize,
}

impl Default for SolverConfig {
    fn default() -> Self {
        Self {
            model: Model::Rigid,
            sigma_max: 0.1,
            log10_nfa_max: -4.0,
            log10_nfa_provisional: None,
            support_min: 6.0,
            rival_ratio: 0.75,
            rotation_sigma_max: 0.1,
            weighting: Weighting::Auto,
            seed: 0,
            hypotheses_max: 128,
            points_max: 10_000,
        }
    }
}

/// How sure an alignment is not chance.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Standing {
    /// Below [`SolverConfig::log10_nfa_max`].
    Accepted,
    /// Below [`SolverConfig::log10_nfa_provisional`] only: confirm it by other means before use.
    Provisional,
}

/// An alignment.
#[derive(Clone, Debug, PartialEq)]
pub struct Alignment {
    /// Maps source coordinates into the target frame; covariance of the local perturbation, calibrated so that the
    /// 95 % ellipsoid covers 95 %.
    pub t_target_source: Relative,
    /// Accepted, or provisional if the configuration asks for such.
    pub standing: Standing,
    /// σ̂ per axis, target units.
    pub sigma: f64,
    /// Probability that each match is an inlier, in the order of the problem.
    pub inlier_probabilities: Vec<f64>,
    /// Sum of inlier probabilities, each distinct match counted once.
    pub support: f64,
    /// log₁₀ of the expected number of equally good alignments in random matches.
    pub log10_nfa: f64,
    /// The weights that refined it: `Em` or `Kde`.
    pub weighting: Weighting,
    /// Eigenvalues, ascending, of the information about (ρ, φ[, λ]) at the inliers' centroid, (target units)⁻² for ρ,
    /// rad⁻² for φ.
    pub information_eigenvalues: Vec<f64>,
}

/// Why there is no alignment. An answer, not an error.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum Refusal {
    /// Fewer distinct matches than an alignment needs.
    #[error("{distinct} distinct matches, {needed} needed")]
    TooFew {
        /// Matches whose source and target both differ from all others'.
        distinct: usize,
        /// Matches needed.
        needed: usize,
    },
    /// Nothing better than chance.
    #[error("best of all hypotheses has log10 NFA {log10_nfa:.1} with support {support:.1}")]
    NoConsensus {
        /// Of the best hypothesis; 0 or more means pure chance.
        log10_nfa: f64,
        /// Of the best hypothesis.
        support: f64,
    },
    /// Two alignments without a common match explain the data about equally well.
    #[error("two disjoint alignments with support {support:.1} and {rival_support:.1}")]
    Ambiguous {
        /// Of the better one.
        support: f64,
        /// Of its rival.
        rival_support: f64,
        /// How far from one another the two put the middle of the sources, in units of the sources' spread about it.
        apart: f64,
    },
    /// The inliers leave a rotation undetermined: a line or one cluster.
    #[error("rotation known to {rotation_sigma:.2} rad only: inliers on a line or in one cluster")]
    Degenerate {
        /// Largest standard deviation of a rotation axis, rad (infinite where undetermined).
        rotation_sigma: f64,
    },
}

impl From<Refusal> for RefusalReason {
    fn from(refusal: Refusal) -> Self {
        match refusal {
            Refusal::TooFew { .. } => Self::TooFew,
            Refusal::NoConsensus { .. } => Self::NoConsensus,
            Refusal::Ambiguous { .. } => Self::Ambiguous,
            Refusal::Degenerate { .. } => Self::Degenerate,
        }
    }
}

/// What is wrong with a call of [`align`].
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum AlignError {
    /// Slices of different lengths.
    #[error("{source_len} source points, {target_len} target points, {scores_len:?} scores: send one of each a match")]
    LengthMismatch {
        /// Source points.
        source_len: usize,
        /// Target points.
        target_len: usize,
        /// Scores, if any.
        scores_len: Option<usize>,
    },
    /// Covariances, but not one for each match.
    #[error("{covariances} {side} covariances for {matches} matches: send one of each")]
    CovarianceCount {
        /// `source` or `target`.
        side: &'static str,
        /// Covariances sent.
        covariances: usize,
        /// Matches sent.
        matches: usize,
    },
    /// Covariances of one side whose variances differ by more than [`CONDITION_MAX`].
    #[error("variances of {side} points differ by a factor {ratio:.1e}, 1e8 at most: widen the smallest")]
    CovarianceRange {
        /// `source` or `target`.
        side: &'static str,
        /// Largest variance in any direction, over the smallest.
        ratio: f64,
    },
    /// Too many matches.
    #[error("{len} matches exceed the limit of {max}: send the best-scored ones")]
    TooManyPoints {
        /// Matches sent.
        len: usize,
        /// Matches allowed.
        max: usize,
    },
    /// A coordinate or score is NaN, infinite or beyond [`COORDINATE_MAX`].
    #[error("match {index} holds a NaN, infinite or huge (> 1e9) number: drop it")]
    NotFinite {
        /// Index of the first such match.
        index: usize,
    },
    /// A setting is out of range.
    #[error("{field} is {value}: {help}")]
    BadConfig {
        /// The setting.
        field: &'static str,
        /// Its value.
        value: f64,
        /// How to mend it.
        help: &'static str,
    },
}

impl SolverConfig {
    /// Checks every setting.
    ///
    /// # Errors
    /// [`AlignError::BadConfig`], naming the first setting out of range.
    pub fn check(&self) -> Result<(), AlignError> {
        let positive = "use a finite value > 0";
        let in_range = |field, value: f64, min: f64, max: f64, help| {
            if (min..=max).contains(&value) { Ok(()) } else { Err(AlignError::BadConfig { field, value, help }) }
        };
        in_range("sigma_max", self.sigma_max, 1e-9, COORDINATE_MAX, positive)?;
        in_range("log10_nfa_max", self.log10_nfa_max, -1e6, 0.0, "use a value <= 0; -4 is safe")?;
        if let Some(bound) = self.log10_nfa_provisional {
            in_range("log10_nfa_provisional", bound, self.log10_nfa_max, 0.0, "use log10_nfa_max to 0")?;
        }
        in_range("support_min", self.support_min, 4.0, 1e6, "use at least 4; 6 is safe")?;
        in_range("rival_ratio", self.rival_ratio, 0.05, 1.0, "use 0.05 to 1")?;
        in_range("rotation_sigma_max", self.rotation_sigma_max, 1e-6, 3.2, "use 1e-6 to 3.2 rad")?;
        in_range("hypotheses_max", self.hypotheses_max as f64, 1.0, 1e6, "use 1 to 1000000")?;
        in_range("points_max", self.points_max as f64, 1.0, POINTS_LIMIT as f64, "use 1 to 65535")?;
        if let Model::Similarity { scale_min, scale_max } = self.model {
            in_range("scale_min", scale_min, 1e-6, 1e6, "use 1e-6 to 1e6")?;
            in_range("scale_max", scale_max, scale_min, 1e6, "use scale_min to 1e6")?;
        }
        Ok(())
    }
}

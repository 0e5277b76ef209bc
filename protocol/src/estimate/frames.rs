//! Frame-level consensus: from many alignments between two frames, some false, to T_αβ with its covariance, or to the
//! reason why not (MATH §5: adaptive pairwise consistency).
//!
//! Every alignment is one hypothesis; nothing is sampled. Pair distances under relative trajectory covariances give a
//! graph of agreement at each of 5 covariance scales in [1, 3]; the maximum clique with the smallest number of false
//! alarms wins; joint least squares with cross-covariances estimates; a leave-one-out χ² test drops what the others do
//! not predict. Frames merge at NFA < 1e-4 and 3 alignments, unless a rival disjoint clique does about as well. Same set
//! of alignments, same answer to the bit, in any order.
//!
//! *Measured*, 20 alignments, scales to 3: 4 true 100 %; 10 true v 5 that agree on a lie 100 %; 4 v 3 92 %, else
//! ambiguous; 4 v 4 ambiguous in 99 %; 1,000 sets of chance alone, none merged. ANEES at 10 alignments 5.88 of 6.

mod clique;
mod gls;
mod pairs;
#[cfg(test)]
mod tests;
#[doc(hidden)]
pub mod world;

use super::trajectory::Trajectory;
use crate::config::EstimateConfig;
use crate::geometry::{Covariance, Group, PoseWithCovariance, Se3, Sim3, SimWithCovariance};
use clique::{Set, bit};
use core::f64::consts::PI;
use gls::Gls;
use libm::pow;
use pairs::Pairs;

/// Alignments between two frames considered at most. Of more, this many are taken evenly along the first frame: a rule
/// deaf to what an alignment claims about itself.
pub const ALIGNMENTS_MAX: usize = clique::VERTICES_MAX;

/// Covariance scales tried, log-spaced from 1 to the configured largest.
const SCALES: usize = 5;
/// χ² quantiles at 99 % for 6 and 7 degrees of freedom: the gate of a pair and of a left-out member.
const CHI2_99: [f64; 2] = [16.811_893_829_770_93, 18.475_306_906_582_36];
/// A rival within this many powers of ten of the best set's NFA makes the frames ambiguous.
const RIVAL_MARGIN_LOG10: f64 = 1.0;
/// A set that agrees at a tighter gate is preferred, or searched for rivals, within this many powers of ten of the best.
const BLEND_MARGIN_LOG10: f64 = 4.0;
/// ln 400: the range of scales, 0.05 to 20, over which a false similarity may fall.
const LOG_SCALE_RANGE: f64 = 5.991_464_547_107_982;

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
    /// it. Choose the reach of an alignment: about a submap's diameter.
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
    /// What there is agrees, but it is too little to merge on: to show, not to use.
    Provisional(FrameConsensus<T>),
    /// Two disjoint sets of alignments contradict each other and do about equally well.
    Ambiguous {
        /// The better set.
        best: FrameConsensus<T>,
        /// Its rival.
        rival: FrameConsensus<T>,
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
    /// Factor on standard deviations that the residuals ask for: at least 1, at most the scale of the winning gate.
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

/// Aligns two metric frames.
pub fn align_frames(
    alpha: &Trajectory,
    beta: &Trajectory,
    alignments: &[PairAlignment],
    config: &FrameConsensusConfig,
) -> FrameOutcome {
    let rigid = alignments.iter().map(|a| (a.i, a.j, a.t_i_j.pose, a.t_i_j.covariance));
    Measured::<6, Se3>::new(alpha, beta, rigid, config)
        .outcome()
        .map(|pose, covariance| PoseWithCovariance { pose, covariance })
}

/// Aligns two frames of which at least one has unknown scale: `t_alpha_beta` is a similarity, and every alignment
/// measures scale itself. The same machinery with 7 degrees of freedom.
pub fn align_frames_sim(
    alpha: &Trajectory,
    beta: &Trajectory,
    alignments: &[PairAlignment<SimWithCovariance>],
    config: &FrameConsensusConfig,
) -> FrameOutcome<SimWithCovariance> {
    let similar = alignments.iter().map(|a| (a.i, a.j, a.t_i_j.sim, a.t_i_j.covariance));
    Measured::<7, Sim3>::new(alpha, beta, similar, config)
        .outcome()
        .map(|sim, covariance| SimWithCovariance { sim, covariance })
}

/// An alignment in either group, and where the caller had it.
struct Alignment<const N: usize, G> {
    i: usize,
    j: usize,
    t_i_j: G,
    covariance: Covariance<N>,
    position: usize,
}

/// All that was measured between two frames, in canonical order.
struct Measured<'a, const N: usize, G> {
    alpha: &'a Trajectory,
    beta: &'a Trajectory,
    alignments: Vec<Alignment<N, G>>,
    config: &'a FrameConsensusConfig,
}

/// A clique, where it was found and how good it is.
#[derive(Clone, Copy)]
struct Candidate {
    set: Set,
    scale: f64,
    log10_nfa: f64,
    hub: usize,
}

impl<'a, const N: usize, G: Group<N>> Measured<'a, N, G> {
    /// Sorts, drops exact duplicates and alignments past either trajectory's end, and thins to [`ALIGNMENTS_MAX`].
    fn new(
        alpha: &'a Trajectory,
        beta: &'a Trajectory,
        alignments: impl Iterator<Item = (usize, usize, G, Covariance<N>)>,
        config: &'a FrameConsensusConfig,
    ) -> Self {
        let mut keyed: Vec<(Vec<f64>, Alignment<N, G>)> = alignments
            .enumerate()
            .filter(|(_, (i, j, ..))| *i < alpha.len() && *j < beta.len())
            .map(|(position, (i, j, t_i_j, covariance))| {
                let key = t_i_j.log().iter().chain(covariance.matrix().iter()).copied().collect();
                (key, Alignment { i, j, t_i_j, covariance, position })
            })
            .collect();
        let order = |(a_key, a): &(Vec<f64>, Alignment<N, G>), (b_key, b): &(Vec<f64>, Alignment<N, G>)| {
            let values = || a_key.iter().zip(b_key).map(|(x, y)| x.total_cmp(y)).find(|o| o.is_ne());
            (a.i, a.j).cmp(&(b.i, b.j)).then_with(|| values().unwrap_or(core::cmp::Ordering::Equal))
        };
        // Stable: of equal ones the caller's first stays.
        keyed.sort_by(order);
        keyed.dedup_by(|a, b| order(a, b).is_eq());
        let n = keyed.len();
        let kept = n.min(ALIGNMENTS_MAX);
        let mut taken = (0..kept).map(|k| k * n / kept).peekable();
        let thinned = keyed.into_iter().enumerate().filter(|(k, _)| taken.next_if_eq(k).is_some());
        Self { alpha, beta, alignments: thinned.map(|(_, (_, a))| a).collect(), config }
    }

    fn outcome(&self) -> FrameOutcome<(G, Covariance<N>)> {
        let n = self.alignments.len();
        if n == 0 {
            return FrameOutcome::None;
        }
        let pairs = Pairs::new(self);
        let everyone = (0..n).map(bit).sum();
        let found = self.unblended(&pairs, self.largest(&pairs, everyone), everyone);
        let Some((best, consensus)) = self.settle(&pairs, found) else { return FrameOutcome::Inconsistent };
        if let Some((first, second)) = self.rivals(&pairs, &best, everyone)
            && let (Some((_, first)), Some((_, second))) = (self.settle(&pairs, first), self.settle(&pairs, second))
        {
            return FrameOutcome::Ambiguous { best: first, rival: second };
        }
        let used = consensus.used.len();
        // A single alignment has no frame-level evidence; it merges where the configuration trusts single ones.
        let significant = best.log10_nfa <= self.config.log10_nfa_max;
        if used >= self.config.alignments_min && (significant || n == 1) {
            FrameOutcome::Merged(consensus)
        } else if significant || 2 * used > n {
            FrameOutcome::Provisional(consensus)
        } else {
            FrameOutcome::Inconsistent
        }
    }

    /// The maximum cliques among `candidates` at every scale: the one with the smallest NFA.
    fn largest(&self, pairs: &Pairs, candidates: Set) -> Candidate {
        let none = Candidate { set: 0, scale: 1.0, log10_nfa: f64::INFINITY, hub: 0 };
        let at_scales = self.scales().map(|scale| self.at_scale(pairs, candidates, scale));
        at_scales.fold(none, |best, c| if c.log10_nfa < best.log10_nfa { c } else { best })
    }

    /// At a wide gate parts of a truth and of a lie may agree with each other, and a larger blend may beat the truth by
    /// little. So the tightest set about as improbable as `best` stands in for it, unless it is a part of it.
    fn unblended(&self, pairs: &Pairs, best: Candidate, everyone: Set) -> Candidate {
        self.tighter(pairs, &best, everyone).find(|c| c.set & !best.set != 0).unwrap_or(best)
    }

    /// The maximum cliques at the gates tighter than `best`'s, tightest first, that do nearly as well.
    fn tighter(&self, pairs: &Pairs, best: &Candidate, everyone: Set) -> impl Iterator<Item = Candidate> {
        let best = *best;
        let scales = self.scales().take_while(move |&scale| scale < best.scale);
        let sets = scales.map(move |scale| self.at_scale(pairs, everyone, scale));
        sets.filter(move |c| c.log10_nfa <= best.log10_nfa + BLEND_MARGIN_LOG10)
    }

    fn at_scale(&self, pairs: &Pairs, candidates: Set, scale: f64) -> Candidate {
        self.judged(pairs, clique::maximum_clique(&pairs.graph(gate(N, scale)), candidates), scale)
    }

    fn judged(&self, pairs: &Pairs, set: Set, scale: f64) -> Candidate {
        let (log10_nfa, hub) = pairs.log10_nfa::<N>(set, gate(N, scale), self.search_volume(), SCALES);
        Candidate { set, scale, log10_nfa, hub }
    }

    /// Estimates over the clique; drops, worst first, members that the others do not predict.
    fn settle(&self, pairs: &Pairs, mut found: Candidate) -> Option<(Candidate, FrameConsensus<(G, Covariance<N>)>)> {
        loop {
            let gls = Gls::solve(self, found.set, found.hub)?;
            let unpredicted = self.unpredicted(&found, &gls.left_out);
            if unpredicted != 0 {
                found = self.judged(pairs, found.set & !unpredicted, found.scale);
                continue;
            }
            // The gate's scale bounds the true one; the residuals tell how much of it is needed.
            let freedom = N as f64 * f64::from(found.set.count_ones() - 1).max(1.0);
            let scale_squared = (gls.chi_squared / freedom).clamp(1.0, found.scale * found.scale);
            let mut used: Vec<usize> = clique::vertices(found.set).map(|l| self.alignments[l].position).collect();
            used.sort_unstable();
            let covariance = Covariance::new_or_wider(gls.covariance * scale_squared);
            let consensus = FrameConsensus {
                t_alpha_beta: (gls.t_alpha_beta, covariance),
                used,
                covariance_scale: scale_squared.sqrt(),
                log10_nfa: found.log10_nfa,
            };
            return Some((found, consensus));
        }
    }

    /// The worst of the members outside the gate: a sixteenth of the set, but at least one, at a time, since one bad member
    /// spoils the prediction of others. Two members always stay.
    fn unpredicted(&self, found: &Candidate, left_out: &[f64]) -> Set {
        let members = left_out.len();
        let mut outside: Vec<(f64, usize)> = left_out
            .iter()
            .zip(clique::vertices(found.set))
            .filter(|&(&d2, _)| d2 > gate(N, found.scale))
            .map(|(&d2, l)| (d2, l))
            .collect();
        outside.sort_by(|a, b| b.0.total_cmp(&a.0));
        let dropped = (members / 16).max(1).min(members.saturating_sub(2));
        outside.iter().take(dropped).map(|&(_, l)| bit(l)).sum()
    }

    /// Two disjoint sets that contradict each other, of which the first explains the alignments nearly as well as
    /// `best` and the second nearly as well as the first.
    fn rivals(&self, pairs: &Pairs, best: &Candidate, everyone: Set) -> Option<(Candidate, Candidate)> {
        core::iter::once(*best).chain(self.tighter(pairs, best, everyone)).find_map(|first| {
            let second = self.largest(pairs, everyone & !first.set);
            let as_good = second.set.count_ones() >= first.set.count_ones()
                || second.log10_nfa <= first.log10_nfa + RIVAL_MARGIN_LOG10;
            let significant = second.log10_nfa <= self.config.log10_nfa_max;
            (significant && as_good && pairs.contradict::<N>(&first, &second)).then_some((first, second))
        })
    }

    fn scales(&self) -> impl Iterator<Item = f64> + use<'_, N, G> {
        let step = 1.0 / (SCALES - 1) as f64;
        (0..SCALES).map(move |k| pow(self.config.covariance_scale_max.max(1.0), k as f64 * step))
    }

    /// Volume into which chance would spread residuals: the box around the smaller trajectory (β's for similarities,
    /// whose residuals are in β's units), times rotations, times the range of log-scale.
    fn search_volume(&self) -> f64 {
        let of = |t: &Trajectory| t.extent().map(|edge| edge.max(self.config.search_edge_min)).product();
        let (alpha, beta): (f64, f64) = (of(self.alpha), of(self.beta));
        let (translations, scales) = if N == 7 { (beta, LOG_SCALE_RANGE) } else { (alpha.min(beta), 1.0) };
        let rotations = match self.config.rotations {
            Rotations::Heading => 2.0 * PI * 0.4 * 0.4,
            Rotations::All => 8.0 * PI * PI,
        };
        translations * rotations * scales
    }

    /// T_αβ as alignment `a` alone gives it.
    fn hypothesis(&self, a: &Alignment<N, G>) -> Option<G> {
        let (t_alpha_i, t_beta_j) = (self.alpha.pose(a.i)?, self.beta.pose(a.j)?);
        Some(G::embed(&t_alpha_i) * a.t_i_j * G::embed(&t_beta_j).inverse())
    }
}

impl<G, const N: usize> FrameOutcome<(G, Covariance<N>)> {
    fn map<T>(self, f: impl Fn(G, Covariance<N>) -> T) -> FrameOutcome<T> {
        let map = |c: FrameConsensus<(G, Covariance<N>)>| FrameConsensus {
            t_alpha_beta: f(c.t_alpha_beta.0, c.t_alpha_beta.1),
            used: c.used,
            covariance_scale: c.covariance_scale,
            log10_nfa: c.log10_nfa,
        };
        match self {
            Self::None => FrameOutcome::None,
            Self::Merged(c) => FrameOutcome::Merged(map(c)),
            Self::Provisional(c) => FrameOutcome::Provisional(map(c)),
            Self::Ambiguous { best, rival } => FrameOutcome::Ambiguous { best: map(best), rival: map(rival) },
            Self::Inconsistent => FrameOutcome::Inconsistent,
        }
    }
}

/// Gate on d² at a covariance scale.
fn gate(dimension: usize, scale: f64) -> f64 {
    CHI2_99[usize::from(dimension == 7)] * scale * scale
}

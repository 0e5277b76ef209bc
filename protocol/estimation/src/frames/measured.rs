//! All that was measured between two frames, in an order that does not depend on the caller's: the same set of
//! alignments gives the same answer to the bit.

use super::scaled::{LOG_SCALE_RANGE, Scaled};
use super::{ALIGNMENTS_MAX, FrameConsensusConfig, Rotations};
use crate::geometry::Covariance;
use crate::trajectory::Trajectory;
use core::f64::consts::PI;
use libm::pow;

/// Covariance scales tried, log-spaced from 1 to the configured largest.
pub(super) const SCALES: usize = 5;

/// An alignment in either group, and where the caller had it.
pub(super) struct Alignment<const N: usize, G> {
    pub(super) i: usize,
    pub(super) j: usize,
    pub(super) t_i_j: G,
    pub(super) covariance: Covariance<N>,
    /// Or `t_i_j` is at scale 1, to be taken [`Alignment::at`] another.
    pub(super) measures_scale: bool,
    pub(super) position: usize,
}

/// All that was measured between two frames, in canonical order.
pub(super) struct Measured<'a, const N: usize, G> {
    pub(super) alpha: &'a Trajectory,
    pub(super) beta: &'a Trajectory,
    pub(super) alignments: Vec<Alignment<N, G>>,
    pub(super) config: &'a FrameConsensusConfig,
    /// Volumes of the boxes around either trajectory, areas in the plane, each in its own unit.
    boxes: [f64; 2],
}

/// Log-spaced from 1 to `largest`.
pub(crate) fn scales_to(largest: f64) -> [f64; SCALES] {
    let step = 1.0 / (SCALES - 1) as f64;
    core::array::from_fn(|k| pow(largest, k as f64 * step))
}

impl<'a, const N: usize, G: Scaled<N>> Measured<'a, N, G> {
    /// Sorts, drops exact duplicates and alignments past either trajectory's end, and thins to [`ALIGNMENTS_MAX`].
    pub(super) fn new(
        alpha: &'a Trajectory,
        beta: &'a Trajectory,
        alignments: impl Iterator<Item = (usize, usize, (G, Covariance<N>, bool))>,
        config: &'a FrameConsensusConfig,
    ) -> Self {
        let mut keyed: Vec<(Vec<f64>, Alignment<N, G>)> = alignments
            .enumerate()
            .filter(|(_, (i, j, ..))| *i < alpha.len() && *j < beta.len())
            .map(|(position, (i, j, (t_i_j, covariance, measures_scale)))| {
                let key = t_i_j.log().iter().chain(covariance.matrix().iter()).copied().collect();
                (key, Alignment { i, j, t_i_j, covariance, measures_scale, position })
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
        let volume = |t: &Trajectory| {
            let edges = t.extent().map(|edge| edge.max(config.search_edge_min));
            if N == 3 { edges.xy().product() } else { edges.product() }
        };
        let boxes = [volume(alpha), volume(beta)];
        Self { alpha, beta, alignments: thinned.map(|(_, (_, a))| a).collect(), config, boxes }
    }

    /// The covariance scales tried, ascending from 1.
    pub(super) fn scales(&self) -> [f64; SCALES] {
        scales_to(self.config.covariance_scale_max.max(1.0))
    }

    /// Volume into which chance would spread residuals where the frames' scale is `scale`: the box around the smaller
    /// trajectory in β's unit, that of residuals, times rotations, times the range of log-scale. A scale that shrinks α
    /// shrinks its box with the residuals, so that shrinking never wins.
    pub(super) fn search_volume(&self, scale: f64) -> f64 {
        let [alpha, beta] = self.boxes;
        let rotations = match self.config.rotations {
            _ if N == 3 => 2.0 * PI,
            Rotations::Heading => 2.0 * PI * 0.4 * 0.4,
            Rotations::All => 8.0 * PI * PI,
        };
        let scales = if N == 7 { LOG_SCALE_RANGE } else { 1.0 };
        (alpha / (scale * scale * scale)).min(beta) * rotations * scales
    }

    /// T_αβ as alignment `a` gives it, at `scale` where it does not measure one.
    pub(super) fn hypothesis(&self, a: &Alignment<N, G>, scale: f64) -> Option<G> {
        let (t_alpha_i, t_beta_j) = (self.alpha.pose(a.i)?, self.beta.pose(a.j)?);
        Some(G::embed(&t_alpha_i) * a.at(scale).0 * G::embed(&t_beta_j).inverse())
    }
}

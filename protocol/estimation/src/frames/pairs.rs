//! How far each pair of alignments contradicts each other, and how surprising an agreement is (MATH §3, §5).
//!
//! Alignment m says T_αβ = T_im T_m T_jm⁻¹. Put into alignment l's residual, the absolute poses cancel to the odometry
//! between the anchors: h = log((A T_l)⁻¹ T_m B), A = t_im_il, B = t_jm_jl. It is the residual of
//! [`super::super::residual`] with A, T_m, B for T_i, T_αβ, T_j, and its four errors are independent.

use super::clique::{self, Set, bit};
use super::measured::{Alignment, Measured};
use super::scaled::{Scale, Scaled};
use crate::relative_odometry::{OdometryStep, RelativeOdometry};
use crate::residual::Residual;
use core::f64::consts::PI;
use libm::{lgamma, log};
use nalgebra::SMatrix;

/// Distances between n alignments, row = hypothesis, column = the alignment tested under it.
pub(super) struct Pairs {
    n: usize,
    /// Squared Mahalanobis distances; infinite where they are not to be had.
    distance_squared: Vec<f64>,
    /// ln √det of each residual's covariance.
    log_sqrt_det: Vec<f64>,
    /// The scale of the frames under which each residual was taken.
    scales: Vec<Scale>,
}

impl Pairs {
    pub(super) fn new<const N: usize, G: Scaled<N>>(measured: &Measured<'_, N, G>) -> Self {
        let alignments = &measured.alignments;
        let n = alignments.len();
        let mut pairs = Self {
            n,
            distance_squared: vec![0.0; n * n],
            log_sqrt_det: vec![0.0; n * n],
            scales: vec![Scale { value: 1.0, log_sigma: f64::INFINITY }; n * n],
        };
        let (alpha, beta) = (
            RelativeOdometry::new(measured.alpha, alignments.iter().map(|a| a.i)),
            RelativeOdometry::new(measured.beta, alignments.iter().map(|a| a.j)),
        );
        for (m, hypothesis) in alignments.iter().enumerate() {
            let (from_i, from_j) = (alpha.from(alpha.slot(hypothesis.i)), beta.from(beta.slot(hypothesis.j)));
            for (l, tested) in alignments.iter().enumerate().filter(|&(l, _)| l != m) {
                let (a, b) = (&from_i[alpha.slot(tested.i)], &from_j[beta.slot(tested.j)]);
                let scale = Scale::of_pair(hypothesis, tested, a, b);
                let (d2, log_sqrt_det) = distance(hypothesis, tested, a, b, scale.value);
                pairs.scales[m * n + l] = scale;
                pairs.distance_squared[m * n + l] = d2;
                pairs.log_sqrt_det[m * n + l] = log_sqrt_det;
            }
        }
        pairs
    }

    /// The scale of the frames as `member` has it together with that other of `set` with which it has it best.
    pub(super) fn scale(&self, member: usize, set: Set) -> f64 {
        let others = clique::vertices(set & !bit(member)).map(|l| self.scales[member * self.n + l]);
        others.min_by(|a, b| a.log_sigma.total_cmp(&b.log_sigma)).map_or(1.0, |s| s.value)
    }

    /// Whether m and l agree at the gate, each under the other.
    pub(super) fn agree(&self, m: usize, l: usize, gate: f64) -> bool {
        self.distance_squared[m * self.n + l] < gate && self.distance_squared[l * self.n + m] < gate
    }

    /// Neighbours of each alignment in the graph of agreement at a gate on d².
    pub(super) fn graph(&self, gate: f64) -> Vec<Set> {
        let neighbours = |m: usize| (0..self.n).filter(|&l| l != m && self.agree(m, l, gate)).map(bit).sum();
        (0..self.n).map(neighbours).collect()
    }

    /// Log₁₀ of the number of false alarms of `set`, and the member it is counted from.
    ///
    /// Under chance a residual falls evenly into the search volume; it comes as near to a hypothesis as the set's worst
    /// member does with the probability α of that ellipsoid. NFA = n (n − 1) C(n − 1, k) Π α over the k other members
    /// (n hypotheses, n − 1 radii); the smallest over members as hypotheses. No set counts as nearer than true
    /// alignments are on average, d² = N, so that one alignment told many times proves little.
    pub(super) fn log10_nfa<const N: usize, G: Scaled<N>>(
        &self,
        measured: &Measured<'_, N, G>,
        set: Set,
    ) -> (f64, usize) {
        let k = f64::from(set.count_ones().saturating_sub(1));
        let n = self.n as f64;
        let choices = log(n * (n - 1.0).max(1.0)) + lgamma(n) - lgamma(k + 1.0) - lgamma(n - k);
        let mut best = (f64::INFINITY, 0);
        for hub in clique::vertices(set) {
            let others = || clique::vertices(set & !bit(hub)).map(|l| hub * self.n + l);
            let radius_squared = others().map(|at| self.distance_squared[at]).fold(N as f64, f64::max);
            let ball = log_ball_volume(N) + 0.5 * N as f64 * log(radius_squared);
            let chance_of = |at: usize| {
                let volume = measured.search_volume(self.scales[at].value);
                (ball + self.log_sqrt_det[at] - log(volume)).min(0.0)
            };
            let chance: f64 = others().map(chance_of).sum();
            if chance < best.0 {
                best = (chance, hub);
            }
        }
        ((choices + best.0) / core::f64::consts::LN_10, best.1)
    }
}

/// d² of `tested` under `hypothesis`, and ln √det of the residual's covariance.
fn distance<const N: usize, G: Scaled<N>>(
    hypothesis: &Alignment<N, G>,
    tested: &Alignment<N, G>,
    (a, sigma_a): &OdometryStep,
    (b, sigma_b): &OdometryStep,
    scale: f64,
) -> (f64, f64) {
    let ((tested, of_tested), (hypothesis, of_hypothesis)) = (tested.at(scale), hypothesis.at(scale));
    let r = Residual::new(&G::embed(a), &tested, &hypothesis, &G::embed(b));
    let sigma: SMatrix<f64, N, N> =
        r.covariance(&G::embed_covariance(sigma_a), &G::embed_covariance(sigma_b), &of_tested)
            + r.j_alpha_beta * of_hypothesis * r.j_alpha_beta.transpose();
    let Some(c) = sigma.cholesky() else { return (f64::INFINITY, 0.0) };
    let log_sqrt_det = c.l_dirty().diagonal().iter().map(|&x| log(x)).sum();
    let d2 = c.solve(&r.h).dot(&r.h);
    (if d2.is_nan() { f64::INFINITY } else { d2 }, log_sqrt_det)
}

/// ln of the volume of the unit ball: 4π/3 in three dimensions, π³/6 in six, 16π³/105 in seven.
fn log_ball_volume(dimension: usize) -> f64 {
    let half = 0.5 * dimension as f64;
    half * log(PI) - lgamma(half + 1.0)
}

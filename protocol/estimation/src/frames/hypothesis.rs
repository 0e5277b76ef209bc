//! One explanation of the alignments: a set that agrees, what it says of T_αβ, and how unlikely chance is to do as
//! well.

use super::FrameConsensus;
use super::clique::{self, Set, bit};
use super::gls::Gls;
use super::measured::Measured;
use super::pairs::Pairs;
use super::predict::surprise;
use super::scaled::{LOG_SCALE_SIGMA_MAX, Scaled, log_scale_sigma};
use crate::geometry::Covariance;
use nalgebra::SMatrix;

/// A member this improbable, given what the others predict, is none.
const SURPRISE_MIN: f64 = 1e-3;

/// A settled set of alignments.
pub(super) struct Hypothesis<const N: usize, G> {
    pub(super) set: Set,
    pub(super) log10_nfa: f64,
    gls: Gls<N, G>,
}

impl<const N: usize, G: Scaled<N>> Hypothesis<N, G> {
    /// Estimates over `set`; drops, worst first, members that the others do not predict.
    pub(super) fn settle(measured: &Measured<'_, N, G>, pairs: &Pairs, mut set: Set) -> Option<Self> {
        loop {
            let (log10_nfa, hub) = pairs.log10_nfa(measured, set);
            let gls = Gls::solve(measured, set, start(measured, pairs, set, hub)?)?;
            match unpredicted(measured, set, &gls) {
                0 => return Some(Self { set, log10_nfa, gls }),
                some => set &= !some,
            }
        }
    }

    /// Standard deviation of log-scale, where no member measures scale and their baselines are too short for it.
    pub(super) fn lacks_scale(&self, measured: &Measured<'_, N, G>) -> Option<f64> {
        let unmeasured = clique::vertices(self.set).all(|l| !measured.alignments[l].measures_scale);
        let sigma = log_scale_sigma(&self.gls.covariance);
        (unmeasured && sigma > LOG_SCALE_SIGMA_MAX).then_some(sigma)
    }

    pub(super) fn t_alpha_beta(&self) -> &G {
        &self.gls.t_alpha_beta
    }

    /// Of the local perturbation, before any scale.
    pub(super) fn covariance(&self) -> &SMatrix<f64, N, N> {
        &self.gls.covariance
    }

    /// Adds to the covariance.
    pub(super) fn widen(&mut self, by: &SMatrix<f64, N, N>) {
        self.gls.covariance += by;
    }

    /// As an answer to the caller.
    pub(super) fn consensus(&self, measured: &Measured<'_, N, G>) -> FrameConsensus<(G, Covariance<N>)> {
        let scale_max = measured.config.covariance_scale_max.max(1.0);
        let freedom = self.gls.freedom.max(1) as f64;
        // A χ² that chance exceeds once in fifty times says nothing against the stated covariances.
        let excess = self.gls.chi_squared / freedom;
        let significant = excess > 1.0 + 2.33 * (2.0 / freedom).sqrt();
        let scale_squared = if significant { excess.clamp(1.0, scale_max * scale_max) } else { 1.0 };
        let mut used: Vec<usize> = clique::vertices(self.set).map(|l| measured.alignments[l].position).collect();
        used.sort_unstable();
        FrameConsensus {
            t_alpha_beta: (self.gls.t_alpha_beta, Covariance::new_or_wider(self.gls.covariance * scale_squared)),
            used,
            covariance_scale: scale_squared.sqrt(),
            log10_nfa: self.log10_nfa,
        }
    }
}

/// T_αβ as member `hub` of `set` has it.
pub(super) fn start<const N: usize, G: Scaled<N>>(
    measured: &Measured<'_, N, G>,
    pairs: &Pairs,
    set: Set,
    hub: usize,
) -> Option<G> {
    measured.hypothesis(&measured.alignments[hub], pairs.scale(hub, set))
}

/// The worst of the members that the others do not predict: a sixteenth of the set, but at least one, at a time, since
/// one bad member spoils the prediction of others. Two members always stay.
fn unpredicted<const N: usize, G: Scaled<N>>(measured: &Measured<'_, N, G>, set: Set, gls: &Gls<N, G>) -> Set {
    let scales = measured.scales();
    let mut outside: Vec<(f64, usize)> = gls
        .left_out
        .iter()
        .zip(clique::vertices(set))
        .map(|(left_out, l)| {
            let d2 = left_out.distance_squared;
            let dimension = measured.alignments[l].dimension();
            (surprise(dimension, d2, gls.others(d2, dimension), &scales), l)
        })
        .filter(|&(p, _)| p < SURPRISE_MIN)
        .collect();
    outside.sort_by(|a, b| a.0.total_cmp(&b.0));
    let members = gls.left_out.len();
    let dropped = (members / 16).max(1).min(members.saturating_sub(2));
    outside.iter().take(dropped).map(|&(_, l)| bit(l)).sum()
}

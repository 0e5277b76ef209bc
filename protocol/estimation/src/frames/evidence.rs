//! How much better one T_αβ explains a set of alignments than chance does: the likelihood ratio of the set's residuals
//! under one transform to residuals spread evenly over the search volume V, both the transform (flat over V) and the
//! covariance scale marginalised (MATH §4's evidence, on the stacked residuals of MATH §3).
//!
//! With k members, N dimensions, the residuals' joint covariance C and χ² at the estimate,
//! ln E = (k − 1)(ln V − N/2 ln 2π) − ½ ln|C| − ½ ln|JᵀC⁻¹J| + ln mean_s [s^−ν exp(−χ²/2s²)], ν the degrees of freedom,
//! scales weighted by 1/s: covariances are honest more often than not. It is 0 for one alignment, and adds up over sets
//! that speak of different transforms.

use super::clique::{self, Set, bit};
use super::gate;
use super::gls::{Gls, LeftOut};
use super::hypothesis;
use super::measured::{Measured, SCALES, scales_to};
use super::pairs::Pairs;
use super::scaled::Scaled;
use core::f64::consts::PI;
use libm::{exp, log};
use std::collections::BTreeMap;

/// Scales reach at least this far: the tails of what is propagated to first order are longer than Gaussian.
const SCALE_MAX_LEAST: f64 = 2.0;

/// An alignment is tried for a set if it agrees with a member at this many times the widest gate.
const NEAR: f64 = 2.0;

/// Evidence of sets, each solved once.
pub(super) struct Evidence<'a, const N: usize, G> {
    measured: &'a Measured<'a, N, G>,
    pairs: &'a Pairs,
    scales: [f64; SCALES],
    /// Those with which each alignment agrees by a wide gate.
    near: Vec<Set>,
    known: BTreeMap<Set, Known>,
}

struct Known {
    evidence: f64,
    /// Evidence without each member, in the set's order.
    without: Vec<f64>,
}

impl<'a, const N: usize, G: Scaled<N>> Evidence<'a, N, G> {
    pub(super) fn new(measured: &'a Measured<'a, N, G>, pairs: &'a Pairs) -> Self {
        Self {
            measured,
            pairs,
            scales: scales_to(measured.config.covariance_scale_max.max(SCALE_MAX_LEAST)),
            near: pairs.graph(gate(N, NEAR * measured.scales().into_iter().fold(1.0, f64::max))),
            known: BTreeMap::new(),
        }
    }

    /// ln of the evidence that `set` speaks of one transform.
    pub(super) fn of(&mut self, set: Set) -> f64 {
        self.known(set).evidence
    }

    /// What member `l` adds to `set`.
    pub(super) fn of_member(&mut self, set: Set, l: usize) -> f64 {
        let k = (set & (bit(l) - 1)).count_ones() as usize;
        let known = self.known(set);
        known.evidence - known.without.get(k).copied().unwrap_or(0.0)
    }

    /// What alignment `l` adds or would add to `set`; −∞ where it is far from all of its members.
    pub(super) fn gain(&mut self, set: Set, l: usize) -> f64 {
        if set & bit(l) != 0 {
            self.of_member(set, l)
        } else if set.count_ones() >= 2 && self.near[l] & set != 0 {
            // Infinite or no number where either set has no solution.
            let gain = self.of(set | bit(l)) - self.of(set);
            if gain.is_finite() { gain } else { f64::NEG_INFINITY }
        } else {
            f64::NEG_INFINITY
        }
    }

    fn known(&mut self, set: Set) -> &Known {
        if !self.known.contains_key(&set) {
            let known = self.solve(set).unwrap_or_else(|| Known {
                evidence: f64::NEG_INFINITY,
                without: vec![0.0; set.count_ones() as usize],
            });
            self.known.insert(set, known);
        }
        &self.known[&set]
    }

    fn solve(&self, set: Set) -> Option<Known> {
        if set.count_ones() < 2 {
            return Some(Known { evidence: 0.0, without: vec![0.0; set.count_ones() as usize] });
        }
        let (_, hub) = self.pairs.log10_nfa(self.measured, set);
        let gls = Gls::solve(self.measured, set, hypothesis::start(self.measured, self.pairs, set, hub)?)?;
        let members = set.count_ones() as usize;
        // ln V − N/2 ln 2π
        let chance = log(self.measured.search_volume(gls.t_alpha_beta.scale())) - 0.5 * N as f64 * log(2.0 * PI);
        let without = |(left_out, l): (&LeftOut, usize)| {
            if members == 2 {
                return 0.0;
            }
            let (chi_squared, freedom) = gls.others(left_out.distance_squared, self.measured.alignments[l].dimension());
            let log_sqrt_det = gls.log_sqrt_det - left_out.log_sqrt_det;
            (members - 2) as f64 * chance - log_sqrt_det + self.log_fit(chi_squared, freedom)
        };
        Some(Known {
            evidence: (members - 1) as f64 * chance - gls.log_sqrt_det
                + self.log_fit(gls.chi_squared, gls.freedom as f64),
            without: gls.left_out.iter().zip(clique::vertices(set)).map(without).collect(),
        })
    }

    /// ln mean_s [s^−ν exp(−χ²/2s²)], scales weighted by 1/s.
    fn log_fit(&self, chi_squared: f64, freedom: f64) -> f64 {
        let at = |s: f64| -freedom * log(s) - 0.5 * chi_squared / (s * s);
        let best = self.scales.iter().map(|&s| at(s)).fold(f64::NEG_INFINITY, f64::max);
        let total: f64 = self.scales.iter().map(|&s| 1.0 / s).sum();
        let mean = self.scales.iter().map(|&s| exp(at(s) - best) / s).sum::<f64>() / total;
        best + log(mean)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frames::FrameConsensusConfig;
    use crate::frames::world::{Draw, World};
    use crate::geometry::Se3;

    fn measured<'a>(world: &'a World, config: &'a FrameConsensusConfig) -> Measured<'a, 6, Se3> {
        let rigid = world.alignments.iter().map(|a| (a.i, a.j, (a.t_i_j.pose, a.t_i_j.covariance, true)));
        Measured::new(&world.alpha, &world.beta, rigid, config)
    }

    #[test]
    fn what_a_member_adds_is_what_the_set_loses_without_it() {
        let config = FrameConsensusConfig::default();
        for seed in 0..5 {
            let world = World::new(60_000 + seed, Draw { real: 6, aliased: 0, random: 0, under_reported: 1.0 });
            let measured = measured(&world, &config);
            let pairs = Pairs::new(&measured);
            let mut evidence = Evidence::new(&measured, &pairs);
            let set: Set = 0b11_1111;
            for l in 0..6 {
                let (adds, loses) = (evidence.of_member(set, l), evidence.of(set) - evidence.of(set & !bit(l)));
                // Equal but for where the residuals are linearised.
                assert!((adds - loses).abs() < 0.05 * loses && loses > 5.0, "seed {seed}: {adds} {loses}");
            }
            assert_eq!((evidence.of(1), evidence.of(0)), (0.0, 0.0));
        }
    }

    #[test]
    fn a_blend_is_worth_less_than_its_parts() {
        let config = FrameConsensusConfig::default();
        for seed in 0..20 {
            let world = World::new(61_000 + seed, Draw { real: 4, aliased: 4, random: 0, under_reported: 1.0 });
            let measured = measured(&world, &config);
            let pairs = Pairs::new(&measured);
            let mut evidence = Evidence::new(&measured, &pairs);
            let of =
                |real: bool| (0..8).filter(|&l| world.real[measured.alignments[l].position] == real).map(bit).sum();
            let (truth, lie): (Set, Set) = (of(true), of(false));
            assert!(evidence.of(truth) > 20.0 && evidence.of(lie) > 20.0, "seed {seed}");
            assert!(evidence.of(truth | lie) < evidence.of(truth) + evidence.of(lie), "seed {seed}");
        }
    }
}

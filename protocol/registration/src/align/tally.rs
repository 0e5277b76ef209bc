//! The prescore of a hypothesis: its own number of false alarms, from a histogram of squared residuals.
//!
//! The smallest NFA over all radii is marginal in σ and is what acceptance asks in the end ([`super::accept`]), so a
//! search at any σ level ranks hypotheses alike. With the chance of agreement tabled per radius it costs a few
//! additions a bin.

use super::accept;
use super::evidence::SIGMA_SPAN;
use super::refine::Context;
use libm::log;

/// Bins per octave of the squared residual: the two topmost mantissa bits of an f32.
const BITS: u32 = 2;
const SHIFT: u32 = 23 - BITS;
/// Bins: they span the squared residuals from (σ_max / [`SIGMA_SPAN`])² to ([`accept::REACH`] σ_max)².
const BINS: usize = 61;

/// What a hypothesis is worth.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Worth {
    /// −ln NFA.
    pub score: f64,
    /// Matches it is reached with.
    pub count: u32,
    /// Their largest residual, target units.
    pub radius: f64,
}

/// Tables for one problem and one pool of matches.
#[derive(Debug, Default)]
pub(super) struct Tally {
    /// ln C(n, k) + ln ((k − 3)(k − 2)).
    log_tests: Vec<f64>,
    /// Per bin: upper radius in target units, −ln α, ln π₃.
    bins: Vec<[f64; 3]>,
    /// The f32 that begins the first bin, as bits, shifted.
    first: u32,
    counts: Vec<u32>,
}

impl Tally {
    /// Prepares for a problem whose residuals are measured in `unit`.
    pub fn load(&mut self, context: &Context, count: usize, unit: f64) {
        let floor = context.sigma_max / SIGMA_SPAN / unit;
        let first = ((floor * floor) as f32).to_bits() >> SHIFT;
        if first != self.first || self.bins.is_empty() {
            self.first = first;
            let chance = &context.matches.chance;
            self.bins.clear();
            self.bins.extend((0..BINS as u32).map(|b| {
                let r = f64::from(f32::from_bits((first + b + 1) << SHIFT)).sqrt() * unit;
                [r, -log(chance.alpha(r)), log(chance.rigid_triangle(2.0 * r))]
            }));
        }
        if self.log_tests.len() != count + 1 {
            let n = count as f64;
            let mut choose = 0.0;
            self.log_tests.clear();
            self.log_tests.push(0.0);
            for k in 1..=count {
                let k = k as f64;
                choose += log((n - k + 1.0) / k);
                self.log_tests.push(choose + log(((k - 3.0) * (k - 2.0)).max(1.0)));
            }
        }
    }

    /// Forgets all residuals.
    #[inline(always)]
    pub fn clear(&mut self) {
        self.counts.clear();
        self.counts.resize(BINS, 0);
    }

    /// Counts a squared residual.
    #[inline(always)]
    pub fn add(&mut self, squared: f32) {
        let bin = (squared.to_bits() >> SHIFT).saturating_sub(self.first) as usize;
        self.counts[bin.min(BINS - 1)] += 1;
    }

    /// The smallest NFA over all radii.
    pub fn worth(&self) -> Worth {
        let mut best = Worth { score: f64::NEG_INFINITY, count: 0, radius: 0.0 };
        let mut count = 0;
        for (added, [radius, rarity, log_triangle]) in self.counts.iter().zip(&self.bins) {
            count += added;
            if *added == 0 || count < 4 {
                continue;
            }
            let score = f64::from(count - 3) * rarity - log_triangle - self.log_tests[count as usize];
            if score > best.score {
                best = Worth { score, count, radius: *radius };
            }
        }
        best
    }

    /// Residuals beyond this are not worth counting, squared, in the unit of [`Self::load`].
    pub fn limit(context: &Context, residual_unit: f64, unit: f64) -> f32 {
        let reach = accept::REACH * context.sigma_max * residual_unit / unit;
        (reach * reach) as f32
    }
}

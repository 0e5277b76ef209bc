//! Which pairs of matches agree at which scale: the scale-invariant counterpart of equal lengths.
//!
//! A pair with source length d and target length e votes for the scales from (e − τ)/d to (e + τ)/d. The range of
//! scales is cut into bins no wider than the votes of typical pairs, and each pair's first and last bin are noted once;
//! the pairs that agree at the scale of a bin are then read off by comparing bytes, and form a graph as sparse as a
//! rigid motion's.

use super::graph::{Cloud, Graph, lengths, pack};
use crate::simd::wide;
use pulp::Arch;

/// Bins at most; a bin's number is a byte.
const BINS_MAX: usize = 64;
/// Width of a bin over that of a typical pair's half vote.
const WIDTH: f64 = 2.0;
/// Length from which a pair tells its own scale, over a typical one.
const LONG: f64 = 1.0;
/// Pairs shorter than so many τ vote for nearly everything and are left out.
const LENGTH_MIN: f32 = 3.0;
/// The bins of every ordered pair.
#[derive(Debug, Default)]
pub(super) struct Scales {
    bins: usize,
    stride: usize,
    /// 255 for a pair that votes for nothing.
    first: Vec<u8>,
    last: Vec<u8>,
    /// The bin of its own ratio; 255 for a pair that is too short to tell much.
    own: Vec<u8>,
}

/// What a pair's lengths tell about scale.
#[derive(Clone, Copy, Debug)]
pub(super) struct Vote {
    /// Scales sought.
    pub range: (f64, f64),
    /// τ, target units.
    pub tolerance: f64,
    /// ...but at most this times the scale.
    pub tolerance_per_scale: f64,
}

/// How lengths become bins.
#[derive(Clone, Copy, Debug)]
struct Bins {
    tolerance: f32,
    per_scale: f32,
    root: f32,
    inverse: f32,
    top: f32,
    long: f32,
}

impl Bins {
    /// First and last bins of 64 pairs with source lengths `d` and target lengths `e`. Without branches.
    #[inline(always)]
    fn of(self, d: &[f32; 64], e: &[f32; 64], first: &mut [u8; 64], last: &mut [u8; 64], own: &mut [u8; 64]) {
        for k in 0..64 {
            let inverse_d = 1.0 / d[k];
            let ratio = e[k] * inverse_d;
            let cap = self.per_scale * ratio;
            let t = if cap < self.tolerance { cap } else { self.tolerance };
            // √((e ± t)/d) to first order in t/e, which is at most a third.
            let (middle, half) = (ratio.sqrt(), 0.5 * t / e[k]);
            let a = (middle * (1.0 - half) - self.root) * self.inverse;
            let b = (middle * (1.0 + half) - self.root) * self.inverse;
            let votes = (e[k] >= LENGTH_MIN * t) & (b >= -0.5) & (a <= self.top + 0.5) & (d[k] > 0.0);
            let never = u32::from(!votes).wrapping_neg();
            let low = if a > 0.0 { a } else { 0.0 };
            let high = if b < self.top { b } else { self.top };
            first[k] = (nearest(low) | never) as u8;
            last[k] = (nearest(high) & !never) as u8;
            let c = (middle - self.root) * self.inverse;
            let own_votes = votes & (d[k] >= self.long) & (c >= -0.5) & (c <= self.top + 0.5);
            let never = u32::from(!own_votes).wrapping_neg();
            let c = if c > 0.0 { c } else { 0.0 };
            own[k] = (nearest(c) | never) as u8;
        }
    }
}

impl Scales {
    /// Bins of the last measurement.
    pub fn bins(&self) -> usize {
        self.bins
    }

    /// Notes the bins of all pairs. Bins are equally wide in √s: between equal ratios and equal differences, which
    /// would suit noise in the source and in the target.
    pub fn measure(&mut self, arch: Arch, cloud: &Cloud, vote: &Vote) {
        let to_cloud = cloud.source_unit / cloud.unit;
        let (low, high) = (vote.range.0 * to_cloud, vote.range.1 * to_cloud);
        let typical = typical_length(cloud);
        let tolerance = vote.tolerance / cloud.unit;
        // ds = 2 √s δ at the middle of the range.
        let middle = (low * high).sqrt().sqrt();
        let span = high.sqrt() - low.sqrt();
        let width = (WIDTH * tolerance / (2.0 * middle * typical)).max(span / (BINS_MAX - 1) as f64);
        self.bins = (span / width).ceil() as usize + 1;
        self.stride = cloud.words * 64;
        for side in [&mut self.first, &mut self.last, &mut self.own] {
            side.clear();
            side.resize(cloud.count * self.stride, 0);
        }
        let bins = Bins {
            tolerance: tolerance as f32,
            per_scale: (vote.tolerance_per_scale / cloud.unit / to_cloud) as f32,
            root: low.sqrt() as f32,
            inverse: (1.0 / width) as f32,
            top: (self.bins - 1) as f32,
            long: (LONG * typical) as f32,
        };
        let (stride, first, last, own) = (self.stride, &mut self.first, &mut self.last, &mut self.own);
        wide(
            arch,
            #[inline(always)]
            || {
                let rows = first.chunks_exact_mut(stride).zip(last.chunks_exact_mut(stride));
                for (i, ((first, last), own)) in rows.zip(own.chunks_exact_mut(stride)).enumerate() {
                    let words = first.as_chunks_mut::<64>().0.iter_mut().zip(last.as_chunks_mut::<64>().0);
                    for (w, ((first, last), own)) in words.zip(own.as_chunks_mut::<64>().0).enumerate() {
                        let (d, e) = lengths(cloud, i, w * 64);
                        bins.of(&d, &e, first, last, own);
                    }
                }
            },
        );
    }

    /// Connects the pairs of which the bin is their own, each once.
    pub fn build_seeds(&self, arch: Arch, bin: usize, count: usize, seeds: &mut Graph) {
        seeds.count = count;
        seeds.words = self.stride / 64;
        seeds.rows.resize(self.own.len() / 64, 0);
        let (bin, words) = (bin as u8, seeds.words);
        let rows = seeds.rows.chunks_exact_mut(words.max(1)).zip(self.own.chunks_exact(self.stride.max(1)));
        wide(
            arch,
            #[inline(always)]
            || {
                for (i, (row, own)) in rows.enumerate() {
                    for (word, own) in row.iter_mut().zip(own.as_chunks::<64>().0).skip(i / 64) {
                        let mut flags = [0_u8; 64];
                        for k in 0..64 {
                            flags[k] = u8::from(own[k] == bin);
                        }
                        *word = pack(&flags);
                    }
                }
            },
        );
    }

    /// Connects the pairs that vote for a bin.
    pub fn build(&self, arch: Arch, bin: usize, count: usize, graph: &mut Graph) {
        graph.count = count;
        graph.words = self.stride / 64;
        graph.rows.resize(self.first.len() / 64, 0);
        let bin = bin as u8;
        let (first, last) = (self.first.as_chunks::<64>().0, self.last.as_chunks::<64>().0);
        let rows = &mut graph.rows;
        wide(
            arch,
            #[inline(always)]
            || {
                for ((row, first), last) in rows.iter_mut().zip(first).zip(last) {
                    let mut flags = [0_u8; 64];
                    for k in 0..64 {
                        flags[k] = u8::from((first[k] <= bin) & (bin <= last[k]));
                    }
                    *row = pack(&flags);
                }
            },
        );
    }
}

/// The nearest integer of a number from 0 to 255.
#[inline(always)]
fn nearest(x: f32) -> u32 {
    // Adding 2²³ leaves the rounded number in the lowest mantissa bits.
    (x + 8_388_608.0).to_bits() & 0xff
}

/// A typical distance of two sources: √2 times the median distance from their median.
fn typical_length(cloud: &Cloud) -> f64 {
    let [x, y, z] = &cloud.source;
    let mut squared: Vec<f32> = (0..cloud.count).map(|i| x[i] * x[i] + y[i] * y[i] + z[i] * z[i]).collect();
    let middle = squared.len() / 2;
    if squared.is_empty() {
        return 1.0;
    }
    let (_, median, _) = squared.select_nth_unstable_by(middle, f32::total_cmp);
    (2.0 * f64::from(*median)).sqrt().max(1e-6)
}

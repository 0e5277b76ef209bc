//! How often random matches agree by chance, measured on the problem itself: keypoints lie on walls, floors and
//! clusters, and a uniform box would call chance agreement of dense spots significant.
//!
//! Two numbers: α(r), the chance that a random target lies within r of a given place among the targets (the correlation
//! sum of the target points), and π₃(τ), the chance that a random triangle of matches has edges that agree within τ.
//! Both are extrapolated to radii rarer than the samples by the slope at the smallest radius they resolve.

use core::f64::consts::PI;
use libm::{exp2, log2};
use nalgebra::Vector3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// Target points whose pairs are counted, evenly chosen.
const PAIRED_POINTS: usize = 384;
/// Random triangles drawn.
const TRIANGLES: usize = 1024;
/// Triangles measured together.
const BATCH: usize = 64;
/// Pairs of points, and triangles, within the smallest radius that counts as resolved.
const RESOLVED_PAIRS: u32 = 64;
const RESOLVED_TRIANGLES: u32 = 32;
/// Histogram bins per octave of the squared radius: the three topmost mantissa bits of an f32.
const BINS_PER_OCTAVE: usize = 8;
/// Octaves of squared radius below and above the unit.
const OCTAVES: [usize; 2] = [60, 4];
const BINS: usize = (OCTAVES[0] + OCTAVES[1]) * BINS_PER_OCTAVE;

/// Chance agreement of one problem's matches.
#[derive(Debug)]
pub(super) struct Chance {
    /// Extents of the targets along their principal axes.
    extent: [f64; 3],
    /// Of distances of two targets.
    pairs: Tail,
    /// Of the worst disagreement of edge lengths of a triangle of matches.
    triangles: Tail,
}

impl Chance {
    /// Measures the different targets, whose robust extents along their principal axes are `extent`, and random
    /// triangles of matches; lengths are compared up to a common scale within `scale_range`.
    pub fn measure(
        source: &[Vector3<f64>],
        target: &[Vector3<f64>],
        scale_range: (f64, f64),
        extent: [f64; 3],
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let longest = extent.iter().fold(0.0_f64, |m, &l| m.max(l));
        let unit = if longest > 0.0 { longest } else { 1.0 };
        Self {
            extent,
            pairs: Tail::new(unit, RESOLVED_PAIRS, |counts| count_pairs(target, unit, counts)),
            triangles: Tail::new(unit, RESOLVED_TRIANGLES, |counts| {
                count_triangles(source, target, scale_range, unit, rng, counts)
            }),
        }
    }

    /// α(r), in (0, 1]; never less than in a uniform box, so that few samples cannot make a match seem rarer.
    pub fn alpha(&self, r: f64) -> f64 {
        let ball = 4.0 / 3.0 * PI * r * r * r;
        let volume: f64 = self.extent.iter().map(|l| l.max(4.0 / 3.0 * r)).product();
        self.pairs.within(r).max((ball / volume).min(1.0))
    }

    /// π₃(τ), in (0, 1].
    pub fn rigid_triangle(&self, tolerance: f64) -> f64 {
        self.triangles.within(tolerance)
    }

    /// The volume of a uniform box in which random targets would agree within `r` as often as here.
    pub fn volume(&self, r: f64) -> f64 {
        4.0 / 3.0 * PI * r * r * r / self.alpha(r)
    }
}

/// The distribution of a radius, from a histogram; below the radii that are resolved a power law of the same slope.
#[derive(Debug)]
struct Tail {
    unit: f64,
    /// Events closer than each bin's upper edge.
    cumulative: Vec<u32>,
    total: f64,
    /// First resolved bin, and the dimension (d ln count / d ln radius) there.
    resolved: usize,
    dimension: f64,
}

impl Tail {
    fn new(unit: f64, resolved: u32, count: impl FnOnce(&mut [u32])) -> Self {
        let mut cumulative = vec![0_u32; BINS];
        count(&mut cumulative);
        let mut total = 0;
        for bin in &mut cumulative {
            total += *bin;
            *bin = total;
        }
        let enough = resolved.min(total / 8).max(1);
        let resolved = cumulative.partition_point(|&c| c < enough).min(BINS - 1);
        let dimension = dimension(&cumulative, resolved);
        Self { unit, total: f64::from(total.max(1)), resolved, dimension, cumulative }
    }

    /// Share of events within `r`, in (0, 1].
    fn within(&self, r: f64) -> f64 {
        let at = |bin: usize| f64::from(self.cumulative[bin].max(1)) / self.total;
        // Position in bins; bin b ends at position b + 1.
        let octaves = 2.0 * log2((r / self.unit).max(1e-300)) + OCTAVES[0] as f64;
        let position = octaves * BINS_PER_OCTAVE as f64 - 1.0;
        let below = self.resolved as f64 - position;
        if below >= 0.0 {
            if self.resolved == 0 {
                // More than rounding tells apart.
                return at(0);
            }
            return at(self.resolved) * exp2(-below * self.dimension / (2 * BINS_PER_OCTAVE) as f64);
        }
        let bin = position as usize;
        if bin + 1 >= BINS {
            return 1.0;
        }
        let (low, high) = (at(bin), at(bin + 1));
        low + (high - low) * (position - bin as f64)
    }
}

/// The maximum-likelihood dimension of the events within √2 times the resolved radius: their number over their sum of
/// ln (√2 resolved radius / radius). It uses each of them, so its spread is half that of a ratio of two counts; over a
/// wider range the ends of the scene would flatten it.
fn dimension(cumulative: &[u32], resolved: usize) -> f64 {
    let top = (resolved + BINS_PER_OCTAVE).min(BINS - 1);
    let (mut sum, mut last) = (0.0, 0);
    for (bin, &count) in cumulative[..=top].iter().enumerate() {
        // ln 2 of the radius is 2 BINS_PER_OCTAVE bins.
        sum += f64::from(count - last) * (top as f64 + 0.5 - bin as f64);
        last = count;
    }
    let bins = (2 * BINS_PER_OCTAVE) as f64;
    if sum > 0.0 { (f64::from(last) * bins / (sum * core::f64::consts::LN_2)).clamp(1.0, 3.0) } else { 3.0 }
}

/// The bin of a squared radius over the unit's square. The exponent and topmost mantissa bits of an f32 are a bin
/// number, logarithmic within each octave up to 6 %.
fn bin(squared: f32) -> usize {
    const SHIFT: u32 = 23 - BINS_PER_OCTAVE.trailing_zeros();
    const FIRST: u32 = (127 - OCTAVES[0] as u32) << BINS_PER_OCTAVE.trailing_zeros();
    ((squared.to_bits() >> SHIFT).saturating_sub(FIRST) as usize).min(BINS - 1)
}

/// Adds the squared distances of all pairs of (a selection of) different points to a histogram.
fn count_pairs(points: &[Vector3<f64>], unit: f64, counts: &mut [u32]) {
    let chosen = points.len().min(PAIRED_POINTS);
    let column = |axis: usize| -> Vec<f32> {
        (0..chosen).map(|k| (points[k * points.len() / chosen][axis] / unit) as f32).collect()
    };
    let (x, y, z) = (column(0), column(1), column(2));
    let mut squared = [0.0_f32; PAIRED_POINTS];
    for i in 1..chosen {
        for j in 0..i {
            let (a, b, c) = (x[i] - x[j], y[i] - y[j], z[i] - z[j]);
            squared[j] = a * a + b * b + c * c;
        }
        for &squared in &squared[..i] {
            counts[bin(squared)] += u32::from(squared > 0.0);
        }
    }
}

/// Adds, per random triangle of matches, the largest difference of edge lengths after the best common scale.
fn count_triangles(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    (low, high): (f64, f64),
    unit: f64,
    rng: &mut ChaCha8Rng,
    counts: &mut [u32],
) {
    let n = source.len() as u64;
    if n < 3 {
        return;
    }
    // In batches by edge, so that roots and quotients vectorise.
    let (mut source_edges, mut target_edges) = ([[0.0; BATCH]; 3], [[0.0; BATCH]; 3]);
    let mut squared = [0.0_f32; BATCH];
    for _ in 0..TRIANGLES / BATCH {
        for t in 0..BATCH {
            let v = distinct_three(n, rng);
            for edge in 0..3 {
                let (a, b) = (v[edge], v[(edge + 1) % 3]);
                source_edges[edge][t] = (source[a] - source[b]).norm_squared();
                target_edges[edge][t] = (target[a] - target[b]).norm_squared();
            }
        }
        for t in 0..BATCH {
            let d = [source_edges[0][t].sqrt(), source_edges[1][t].sqrt(), source_edges[2][t].sqrt()];
            let e = [target_edges[0][t].sqrt(), target_edges[1][t].sqrt(), target_edges[2][t].sqrt()];
            let scale = ((e[0] + e[1] + e[2]) / (d[0] + d[1] + d[2]).max(1e-300)).max(low).min(high);
            let apart = |k: usize| (scale * d[k] - e[k]).abs();
            let worst = apart(0).max(apart(1)).max(apart(2)) / unit;
            squared[t] = (worst * worst) as f32;
        }
        for &squared in &squared {
            counts[bin(squared)] += 1;
        }
    }
}

/// Three different numbers below `n` ≥ 3.
fn distinct_three(n: u64, rng: &mut ChaCha8Rng) -> [usize; 3] {
    // 21 bits each suffice for the limit of matches.
    let bits = rng.next_u64();
    let below = |shift: u32, n: u64| (((bits >> shift) & 0x1f_ffff) * n) >> 21;
    let i = below(0, n);
    let mut j = i + 1 + below(21, n - 1);
    if j >= n {
        j -= n;
    }
    let mut k = below(42, n - 2);
    for taken in [i.min(j), i.max(j)] {
        k += u64::from(k >= taken);
    }
    [i as usize, j as usize, k as usize]
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::SeedableRng;

    fn points(seed: u64, n: usize, mut place: impl FnMut([f64; 3]) -> [f64; 3]) -> Vec<Vector3<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut unit = || (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
        (0..n).map(|_| Vector3::from(place([unit(), unit(), unit()]))).collect()
    }

    fn measured(seed: u64, place: impl FnMut([f64; 3]) -> [f64; 3]) -> Chance {
        let target = points(seed, 1000, place);
        Chance::measure(&target, &target, (1.0, 1.0), [1.0, 1.0, 0.0], &mut ChaCha8Rng::seed_from_u64(seed))
    }

    /// The estimates over the truth for 41 seeds: without bias, and within the spread of the few events they rest on
    /// and of a slope carried over up to four octaves. (One seed alone says nothing: it may be anywhere in that
    /// spread.)
    fn assert_unbiased(label: &str, bias_max: f64, mut ratio: impl FnMut(u64) -> f64) {
        let mut ratios: Vec<f64> = (0..41).map(&mut ratio).collect();
        ratios.sort_by(f64::total_cmp);
        assert!((0.75..bias_max).contains(&ratios[20]), "{label}: median {}", ratios[20]);
        assert!(ratios[2] > 0.45 && ratios[38] < 4.0, "{label}: {} to {}", ratios[2], ratios[38]);
    }

    #[test]
    fn alpha_of_a_uniform_cube_is_the_volume_share() {
        for r in [0.005, 0.01, 0.03, 0.1] {
            assert_unbiased(&format!("r = {r}"), 1.35, |seed| {
                measured(seed, |p| p).pairs.within(r) / (4.0 / 3.0 * PI * r * r * r)
            });
        }
        assert!(measured(0, |p| p).alpha(3.0) > 0.999);
    }

    #[test]
    fn alpha_of_a_wall_is_the_area_share() {
        for r in [0.005, 0.01, 0.02, 0.1] {
            assert_unbiased(&format!("r = {r}"), 1.35, |seed| {
                measured(seed, |[x, y, _]| [x, y, 0.0]).pairs.within(r) / (PI * r * r)
            });
        }
    }

    #[test]
    fn alpha_grows_with_r_and_stays_in_range() {
        for n in [0, 1, 2, 3, 10, 300] {
            let target = points(3, n, |p| p);
            let mut rng = ChaCha8Rng::seed_from_u64(1);
            let chance = Chance::measure(&target, &target, (1.0, 1.0), [1.0, 1.0, 0.0], &mut rng);
            let mut last = 0.0;
            for k in 0..200 {
                let alpha = chance.alpha(1e-6 * exp2(f64::from(k) * 0.15));
                assert!(alpha > 0.0 && alpha <= 1.0 && alpha >= last, "n = {n}");
                last = alpha;
            }
        }
    }

    #[test]
    fn rare_triangles_follow_the_power_law_of_common_ones() {
        // Three lengths agree independently within τ, so π₃ grows with τ³; a tenth of it is beyond 1024 draws.
        // Counted over two million triangles of such points. The ends of the scene flatten the slope of common ones, so
        // that rare ones are thought up to twice as common: the safe side.
        for (tolerance, share) in [(0.02, 9.8e-5), (0.05, 1.45e-3), (0.1, 1.1e-2)] {
            assert_unbiased(&format!("τ = {tolerance}"), 2.0, |seed| {
                let (a, b) = (points(seed, 3000, |p| p), points(seed + 1000, 3000, |p| p));
                let mut rng = ChaCha8Rng::seed_from_u64(seed);
                Chance::measure(&a, &b, (1.0, 1.0), [1.0; 3], &mut rng).rigid_triangle(tolerance) / share
            });
        }
    }

    #[test]
    fn triangles_of_the_same_shape_always_agree() {
        let p = points(3, 50, |p| p);
        let doubled: Vec<_> = p.iter().map(|x| x * 2.0).collect();
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let mut agree = |range| Chance::measure(&p, &doubled, range, [2.0; 3], &mut rng).rigid_triangle(1e-9);
        assert!(agree((0.5, 4.0)) > 0.999);
        assert!(agree((1.0, 1.0)) < 0.01);
    }

    #[test]
    fn three_are_always_different() {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        for n in 3..20 {
            for _ in 0..200 {
                let [i, j, k] = distinct_three(n, &mut rng);
                assert!(i != j && j != k && i != k && i.max(j).max(k) < n as usize);
            }
        }
    }
}

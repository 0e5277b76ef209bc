//! How often random matches agree by chance, measured on the problem itself: keypoints lie on walls, floors and clusters,
//! and a uniform box would call chance agreement of dense spots significant.
//!
//! Two numbers: α(r), the chance that a random target lies within r of a given place among the targets (the correlation
//! sum of the target points), and π₃(τ), the chance that a random triangle of matches has edges that agree within τ. Both
//! are extrapolated to radii rarer than the samples by the slope at the smallest radius they resolve.

use core::f64::consts::PI;
use libm::{exp2, log2};
use nalgebra::Vector3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;

/// Target points whose pairs are counted, evenly chosen.
const PAIRED_POINTS: usize = 256;
/// Random triangles drawn.
const TRIANGLES: usize = 2048;
/// Pairs within the smallest radius that counts as resolved.
const RESOLVED: u32 = 64;
/// Histogram bins per octave of the squared distance: the three topmost mantissa bits of an f32.
const BINS_PER_OCTAVE: usize = 8;
/// Octaves of squared distance below and above the unit.
const OCTAVES: [usize; 2] = [60, 4];
const BINS: usize = (OCTAVES[0] + OCTAVES[1]) * BINS_PER_OCTAVE;

/// Chance agreement of one problem's matches.
#[derive(Debug)]
pub(super) struct Chance {
    /// Length unit of the histogram: the longest extent.
    unit: f64,
    /// Extents of the targets along their principal axes.
    extent: [f64; 3],
    /// Pairs of targets closer than each bin's upper edge.
    cumulative: Vec<u32>,
    pairs: f64,
    /// First resolved bin, and the correlation dimension there.
    resolved: usize,
    dimension: f64,
    /// Worst disagreement of edge lengths per random triangle, ascending, target units.
    disagreements: Vec<f64>,
}

impl Chance {
    /// Measures the different targets, whose robust extents along their principal axes are `extent`, and random triangles
    /// of matches; lengths are compared up to a common scale within `scale_range`.
    pub fn measure(
        source: &[Vector3<f64>],
        target: &[Vector3<f64>],
        scale_range: (f64, f64),
        extent: [f64; 3],
        rng: &mut ChaCha8Rng,
    ) -> Self {
        let longest = extent.iter().fold(0.0_f64, |m, &l| m.max(l));
        let unit = if longest > 0.0 { longest } else { 1.0 };
        let mut cumulative = vec![0_u32; BINS];
        count_pairs(target, unit, &mut cumulative);
        let mut total = 0;
        for bin in &mut cumulative {
            total += *bin;
            *bin = total;
        }
        let enough = RESOLVED.min(total / 8).max(1);
        let resolved = cumulative.partition_point(|&c| c < enough).min(BINS - 1);
        let doubled = (resolved + 2 * BINS_PER_OCTAVE).min(BINS - 1);
        let growth = f64::from(cumulative[doubled].max(1)) / f64::from(cumulative[resolved].max(1));
        Self {
            unit,
            extent,
            pairs: f64::from(total.max(1)),
            resolved,
            dimension: log2(growth).clamp(1.0, 3.0),
            cumulative,
            disagreements: disagreements(source, target, scale_range, rng),
        }
    }

    /// α(r), in (0, 1]; never less than in a uniform box, so that few samples cannot make a match seem rarer.
    pub fn alpha(&self, r: f64) -> f64 {
        let ball = 4.0 / 3.0 * PI * r * r * r;
        let volume: f64 = self.extent.iter().map(|l| l.max(4.0 / 3.0 * r)).product();
        self.correlation(r).max((ball / volume).min(1.0))
    }

    fn correlation(&self, r: f64) -> f64 {
        let at = |bin: usize| f64::from(self.cumulative[bin].max(1)) / self.pairs;
        // Position in bins; bin b ends at position b + 1.
        let octaves = 2.0 * log2((r / self.unit).max(1e-300)) + OCTAVES[0] as f64;
        let position = octaves * BINS_PER_OCTAVE as f64 - 1.0;
        let below = self.resolved as f64 - position;
        if below >= 0.0 {
            return at(self.resolved) * exp2(-below * self.dimension / (2 * BINS_PER_OCTAVE) as f64);
        }
        let bin = position as usize;
        if bin + 1 >= BINS {
            return 1.0;
        }
        let (low, high) = (at(bin), at(bin + 1));
        low + (high - low) * (position - bin as f64)
    }

    /// π₃(τ), in (0, 1].
    pub fn rigid_triangle(&self, tolerance: f64) -> f64 {
        let agreeing = self.disagreements.partition_point(|d| *d <= tolerance);
        (agreeing as f64 + 1.0) / (self.disagreements.len() as f64 + 1.0)
    }

    /// The volume of a uniform box in which random targets would agree within `r` as often as here.
    pub fn volume(&self, r: f64) -> f64 {
        4.0 / 3.0 * PI * r * r * r / self.alpha(r)
    }
}

/// Adds the squared distances of all pairs of (a selection of) different points to a histogram.
fn count_pairs(points: &[Vector3<f64>], unit: f64, bins: &mut [u32]) {
    let chosen = points.len().min(PAIRED_POINTS);
    let column = |axis: usize| -> Vec<f32> {
        (0..chosen).map(|k| (points[k * points.len() / chosen][axis] / unit) as f32).collect()
    };
    let (x, y, z) = (column(0), column(1), column(2));
    // The exponent and topmost mantissa bits of an f32 are a bin number, logarithmic within each octave up to 6 %.
    let shift = 23 - BINS_PER_OCTAVE.trailing_zeros();
    let first = (127 - OCTAVES[0] as u32) << BINS_PER_OCTAVE.trailing_zeros();
    for i in 1..chosen {
        for j in 0..i {
            let (a, b, c) = (x[i] - x[j], y[i] - y[j], z[i] - z[j]);
            let squared = a * a + b * b + c * c;
            if squared > 0.0 {
                let bin = (squared.to_bits() >> shift).saturating_sub(first) as usize;
                bins[bin.min(BINS - 1)] += 1;
            }
        }
    }
}

/// Per random triangle of matches, the largest difference of edge lengths after the best common scale; ascending.
fn disagreements(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    (low, high): (f64, f64),
    rng: &mut ChaCha8Rng,
) -> Vec<f64> {
    let n = source.len() as u64;
    if n < 3 {
        return Vec::new();
    }
    let mut worst: Vec<f64> = (0..TRIANGLES)
        .map(|_| {
            let [i, j, k] = distinct_three(n, rng);
            let lengths = |p: &[Vector3<f64>]| [(p[i] - p[j]).norm(), (p[j] - p[k]).norm(), (p[k] - p[i]).norm()];
            let (d, e) = (lengths(source), lengths(target));
            let scale = (e.iter().sum::<f64>() / d.iter().sum::<f64>().max(1e-300)).clamp(low, high);
            d.iter().zip(&e).map(|(d, e)| (scale * d - e).abs()).fold(0.0, f64::max)
        })
        .collect();
    worst.sort_unstable_by(f64::total_cmp);
    worst
}

/// Three different numbers below `n` ≥ 3.
fn distinct_three(n: u64, rng: &mut ChaCha8Rng) -> [usize; 3] {
    // 21 bits each suffice for the limit of matches.
    let bits = rng.next_u64();
    let below = |shift: u32, n: u64| (((bits >> shift) & 0x1f_ffff) * n) >> 21;
    let i = below(0, n);
    let j = (i + 1 + below(21, n - 1)) % n;
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

    fn points(n: usize, mut place: impl FnMut([f64; 3]) -> [f64; 3]) -> Vec<Vector3<f64>> {
        let mut rng = ChaCha8Rng::seed_from_u64(3);
        let mut unit = || (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
        (0..n).map(|_| Vector3::from(place([unit(), unit(), unit()]))).collect()
    }

    fn measured(target: &[Vector3<f64>]) -> Chance {
        Chance::measure(target, target, (1.0, 1.0), [1.0, 1.0, 0.0], &mut ChaCha8Rng::seed_from_u64(1))
    }

    #[test]
    fn alpha_of_a_uniform_cube_is_the_volume_share() {
        let chance = measured(&points(1000, |p| p));
        for r in [0.01, 0.03, 0.1] {
            let ratio = chance.correlation(r) / (4.0 / 3.0 * PI * r * r * r);
            assert!((0.5..1.6).contains(&ratio), "r = {r}: {ratio}");
        }
        assert!(chance.alpha(3.0) > 0.999);
    }

    #[test]
    fn alpha_of_a_wall_is_the_area_share() {
        let chance = measured(&points(1000, |[x, y, _]| [x, y, 0.0]));
        for r in [0.01, 0.02, 0.1] {
            let ratio = chance.correlation(r) / (PI * r * r);
            assert!((0.4..1.6).contains(&ratio), "r = {r}: {ratio}");
        }
    }

    #[test]
    fn alpha_grows_with_r_and_stays_in_range() {
        for n in [0, 1, 2, 3, 10, 300] {
            let chance = measured(&points(n, |p| p));
            let mut last = 0.0;
            for k in 0..200 {
                let alpha = chance.alpha(1e-6 * exp2(f64::from(k) * 0.15));
                assert!(alpha > 0.0 && alpha <= 1.0 && alpha >= last, "n = {n}");
                last = alpha;
            }
        }
    }

    #[test]
    fn triangles_of_the_same_shape_always_agree() {
        let p = points(50, |p| p);
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

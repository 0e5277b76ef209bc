//! The source's σ-consensus weights, S(12)–S(30): a Gaussian kernel density of the residuals with Silverman's bandwidth
//! `h = k σ n^(−1/5)`, k = 1.06, marginalised over σ ~ U(0, σ_max), which closes to the exponential integral E₁:
//!
//! `w(r) = (1/n) Σ_i n^{1/5} / (2 k √(2π) σ_max) · E₁( n^{2/5} (r − r_i)² / (2 k² σ_max²) )`.
//!
//! E₁(0) is infinite, so a residual is never scored against itself (leave-one-out) and arguments are at least
//! [`ARGUMENT_MIN`]. σ_max is a largest standard deviation, not a gate.

use super::density::{Shape, Tree};
use libm::{exp, log};
use std::sync::OnceLock;

/// Silverman's constant, S(13).
pub const SILVERMAN: f64 = 1.06;
/// Smallest argument of E₁: two equal residuals count as this close instead of infinitely.
pub const ARGUMENT_MIN: f64 = 1e-6;
/// E₁ is below 1e-19 from here on, and taken as 0.
pub const ARGUMENT_MAX: f64 = 40.0;

const EULER_GAMMA: f64 = 0.577_215_664_901_532_9;
const SQRT_2PI: f64 = 2.506_628_274_631_000_2;

/// The exponential integral `E₁(x) = ∫_x^∞ e^{−t}/t dt`, relative error below 1e-14.
///
/// The power series up to 1, the continued fraction by Lentz's method beyond (Abramowitz and Stegun 5.1.11, 5.1.22).
/// Own code because results must be equal to the bit on all machines, and the crates at hand use the platform's `exp`,
/// `ln`. Infinite at 0, NaN below.
pub fn e1(x: f64) -> f64 {
    if x.is_nan() || x < 0.0 {
        f64::NAN
    } else if x == 0.0 {
        f64::INFINITY
    } else if x <= 1.0 {
        e1_series(x)
    } else {
        e1_fraction(x)
    }
}

fn e1_series(x: f64) -> f64 {
    // −γ − ln x − Σ (−x)^k / (k k!)
    let (mut term, mut sum) = (1.0, 0.0);
    for k in 1..=30 {
        let k = f64::from(k);
        term *= -x / k;
        sum += term / k;
        if term.abs() < 1e-18 {
            break;
        }
    }
    -EULER_GAMMA - log(x) - sum
}

fn e1_fraction(x: f64) -> f64 {
    let mut b = x + 1.0;
    let mut c = f64::INFINITY;
    let mut d = 1.0 / b;
    let mut h = d;
    for i in 1..=500 {
        let i = f64::from(i);
        let a = -i * i;
        b += 2.0;
        d = 1.0 / (a * d + b);
        c = b + a / c;
        let ratio = c * d;
        h *= ratio;
        if (ratio - 1.0).abs() < 1e-16 {
            break;
        }
    }
    h * exp(-x)
}

/// w(r) of S(30), the direct sum over `samples`; 0 for fewer than one sample.
///
/// `r`, `samples` and `sigma_max` > 0 share one unit; the result is per unit.
pub fn kde_weight(r: f64, samples: &[f64], sigma_max: f64) -> f64 {
    if samples.is_empty() {
        return 0.0;
    }
    let kernel = Kernel::new(samples.len(), sigma_max);
    kernel.amplitude * samples.iter().map(|s| e1(kernel.argument(r - s))).sum::<f64>() / samples.len() as f64
}

/// The constants of S(30).
#[derive(Clone, Copy, Debug)]
struct Kernel {
    /// n^{2/5} / (2 k² σ_max²)
    precision: f64,
    /// n^{1/5} / (2 k √(2π) σ_max)
    amplitude: f64,
}

impl Kernel {
    fn new(n: usize, sigma_max: f64) -> Self {
        let root = libm::pow(n as f64, 0.2);
        let h = SILVERMAN * sigma_max / root;
        Self { precision: 0.5 / (h * h), amplitude: 0.5 / (SQRT_2PI * h) }
    }

    fn argument(&self, difference: f64) -> f64 {
        (self.precision * difference * difference).max(ARGUMENT_MIN)
    }
}

/// S(30) of residual norms: leave-one-out, and reflected at 0, since norms end there. O(log n) a value.
#[derive(Clone, Debug, Default)]
pub struct NormDensity {
    samples: Vec<f64>,
    tree: Tree,
}

impl NormDensity {
    /// Replaces the samples (norms, finite and ≥ 0) without allocating anew.
    pub fn set(&mut self, samples: impl Iterator<Item = f64>) {
        self.samples.clear();
        self.samples.extend(samples);
        self.tree.set(&self.samples);
    }

    /// Number of samples.
    pub fn len(&self) -> usize {
        self.samples.len()
    }

    /// Whether there are no samples.
    pub fn is_empty(&self) -> bool {
        self.samples.is_empty()
    }

    /// Density at sample `i`, of all other samples. 0 for fewer than 2 samples.
    pub fn at_sample(&self, i: usize, sigma_max: f64) -> f64 {
        let n = self.samples.len();
        if n < 2 {
            return 0.0;
        }
        let r = self.samples[i];
        let kernel = Kernel::new(n, sigma_max);
        let sum = self.sum(r, &kernel) - pair(&kernel, r, r);
        (kernel.amplitude * sum / (n - 1) as f64).max(0.0)
    }

    /// Density at `r`, of all samples.
    pub fn at(&self, r: f64, sigma_max: f64) -> f64 {
        let n = self.samples.len();
        if n < 2 {
            return 0.0;
        }
        let kernel = Kernel::new(n, sigma_max);
        kernel.amplitude * self.sum(r, &kernel) / n as f64
    }

    fn sum(&self, r: f64, kernel: &Kernel) -> f64 {
        let root = |x: f64| (x / kernel.precision).sqrt();
        let shape = Shape { bandwidth: root(0.5), kink: root(ARGUMENT_MIN), reach: root(ARGUMENT_MAX) };
        let one = |t: f64| self.tree.sum(t, &shape, |d| e1_fast(kernel.argument(d)));
        one(r) + one(-r)
    }
}

/// [`NormDensity::at_sample`] of every sample, with samples counted in bins of a quarter of the bandwidth: O(n) for
/// all, and near enough to ask which of two densities predicts better (a sum of many logarithms: *measured* within 1 %
/// a sample).
#[derive(Clone, Debug, Default)]
pub(super) struct BinnedDensity {
    counts: Vec<f64>,
    /// Mean kernel between two samples so many bins apart.
    kernel: Vec<f64>,
    /// Σ of the kernel over all samples, at each bin.
    sums: Vec<f64>,
    width: f64,
    amplitude: f64,
}

impl BinnedDensity {
    /// Bins a bandwidth.
    const FINENESS: f64 = 4.0;
    /// Two samples of bins so near each other are averaged over where they may be.
    const NEAR: usize = 3;

    /// Replaces the samples (norms, finite and ≥ 0).
    pub fn set(&mut self, samples: impl ExactSizeIterator<Item = f64> + Clone, sigma_max: f64) {
        let n = samples.len();
        let kernel = Kernel::new(n.max(1), sigma_max);
        self.width = (0.5 / kernel.precision).sqrt() / Self::FINENESS;
        self.amplitude = kernel.amplitude / n.saturating_sub(1).max(1) as f64;
        let reach = (ARGUMENT_MAX / kernel.precision).sqrt() / self.width;
        self.kernel.clear();
        let width = self.width;
        self.kernel.extend((0..reach as usize + 2).map(|bins| Self::mean_kernel(&kernel, bins, width)));
        let highest = samples.clone().fold(0.0, f64::max);
        self.counts.clear();
        self.counts.resize((highest / self.width) as usize + 1, 0.0);
        for r in samples {
            let bin = self.bin(r);
            self.counts[bin] += 1.0;
        }
        self.sums.clear();
        self.sums.resize(self.counts.len(), 0.0);
        for (b, &count) in self.counts.iter().enumerate().filter(|(_, count)| **count > 0.0) {
            for (sum, kernel) in self.sums[b..].iter_mut().zip(&self.kernel) {
                *sum += count * kernel;
            }
            for (sum, kernel) in self.sums[..b].iter_mut().rev().zip(&self.kernel[1..]) {
                *sum += count * kernel;
            }
            // Reflected: −b lies b + 1 bins below bin 0.
            for (sum, kernel) in self.sums.iter_mut().zip(self.kernel.iter().skip(b + 1)) {
                *sum += count * kernel;
            }
        }
    }

    /// Density at a sample `r`, of all others; 0 for fewer than 2 samples.
    pub fn at_sample(&self, r: f64) -> f64 {
        let bin = self.bin(r);
        let own = self.kernel[0] + self.kernel.get(2 * bin + 1).copied().unwrap_or(0.0);
        (self.amplitude * (self.sums[bin] - own)).max(0.0)
    }

    fn bin(&self, r: f64) -> usize {
        ((r / self.width) as usize).min(self.counts.len() - 1)
    }

    /// Over both samples anywhere in their bins.
    fn mean_kernel(kernel: &Kernel, bins: usize, width: f64) -> f64 {
        let at = |apart: f64| e1_fast(kernel.argument(apart * width));
        let middle = bins as f64;
        if bins > Self::NEAR {
            return at(middle);
        }
        // Midpoints of the triangular density of their distance.
        let (mut sum, mut total) = (0.0, 0.0);
        for k in 0..16 {
            let off = (f64::from(k) - 7.5) / 8.0;
            let weight = 1.0 - off.abs();
            sum += weight * at(middle + off);
            total += weight;
        }
        sum / total
    }
}

/// Kernel between norms r and s, and between r and the reflected −s.
fn pair(kernel: &Kernel, r: f64, s: f64) -> f64 {
    e1_fast(kernel.argument(r - s)) + e1_fast(kernel.argument(r + s))
}

/// Cells of the table per octave of the argument.
const CELLS: u64 = 128;
const CELL_BITS: u32 = 52 - CELLS.trailing_zeros();

/// E₁ by cubic Hermite interpolation in a table over [`ARGUMENT_MIN`, `ARGUMENT_MAX`], 0 beyond; the error is below
/// 1e-8 of the value, and of 0.01 where that is smaller.
fn e1_fast(x: f64) -> f64 {
    static TABLE: OnceLock<Vec<[f64; 2]>> = OnceLock::new();
    if x >= ARGUMENT_MAX {
        return 0.0;
    }
    let table = TABLE.get_or_init(e1_table);
    let x = x.max(ARGUMENT_MIN);
    let cell = x.to_bits() >> CELL_BITS;
    let k = (cell - (ARGUMENT_MIN.to_bits() >> CELL_BITS)) as usize;
    let (a, b) = (f64::from_bits(cell << CELL_BITS), f64::from_bits((cell + 1) << CELL_BITS));
    let ([fa, da], [fb, db]) = (table[k], table[k + 1]);
    let h = b - a;
    let t = (x - a) / h;
    let u = 1.0 - t;
    u * u * ((1.0 + 2.0 * t) * fa + t * h * da) + t * t * ((1.0 + 2.0 * u) * fb - u * h * db)
}

/// Value and slope of E₁ at each cell's lower end.
fn e1_table() -> Vec<[f64; 2]> {
    let first = ARGUMENT_MIN.to_bits() >> CELL_BITS;
    let last = ARGUMENT_MAX.to_bits() >> CELL_BITS;
    let knot = |cell: u64| f64::from_bits(cell << CELL_BITS);
    (first..=last + 1).map(|cell| [e1(knot(cell)), -exp(-knot(cell)) / knot(cell)]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    #[test]
    fn e1_matches_reference_values() {
        // Abramowitz and Stegun tables 5.1, 5.2; digits by 50-digit arithmetic.
        let table = [
            (1e-12, 27.053_805_451_027_85),
            (0.001, 6.331_539_364_136_149),
            (0.1, 1.822_923_958_419_390_7),
            (0.5, 0.559_773_594_776_160_8),
            (1.0, 0.219_383_934_395_520_27),
            (2.0, 0.048_900_510_708_061_12),
            (2.5, 0.024_914_917_870_269_74),
            (10.0, 4.156_968_929_685_324e-6),
            (40.0, 1.036_773_261_451_656_9e-19),
        ];
        for (x, expected) in table {
            assert!((e1(x) / expected - 1.0).abs() < 1e-14, "E1({x}) = {:e}", e1(x));
        }
    }

    #[test]
    fn e1_agrees_with_a_crate_and_joins_smoothly() {
        for k in 0..4000 {
            let x = 1e-6 * libm::pow(4e7, f64::from(k) / 4000.0);
            if let Some(other) = statrs::function::exponential::integral(x, 1) {
                assert!((e1(x) / other - 1.0).abs() < 1e-13, "{x}: {:e} {other:e}", e1(x));
            }
        }
        assert!((e1_series(1.0) / e1_fraction(1.0) - 1.0).abs() < 1e-14);
        assert!(e1(0.0).is_infinite() && e1(-1.0).is_nan() && e1(f64::NAN).is_nan());
    }

    #[test]
    fn the_table_is_as_good_as_it_says() {
        for k in 0..100_000 {
            let x = ARGUMENT_MIN * libm::pow(ARGUMENT_MAX / ARGUMENT_MIN, f64::from(k) / 100_000.0);
            assert!((e1_fast(x) - e1(x)).abs() < 1e-8 * e1(x).max(0.01), "{x}: {:e} {:e}", e1_fast(x), e1(x));
        }
        assert_eq!(e1_fast(ARGUMENT_MAX), 0.0);
    }

    /// S(20): the marginal density by quadrature over σ, σ = σ_max e^{−u} to spread the peak.
    fn quadrature(r: f64, samples: &[f64], sigma_max: f64) -> f64 {
        let n = samples.len() as f64;
        let integrand = |u: f64| {
            let sigma = sigma_max * exp(-u);
            let h = SILVERMAN * sigma * libm::pow(n, -0.2);
            let sum: f64 = samples.iter().map(|s| exp(-0.5 * (r - s) * (r - s) / (h * h))).sum();
            sum / (SQRT_2PI * h * n) * sigma
        };
        // Composite Gauss-Legendre, 5 points a panel.
        let (nodes, weights) = (
            [0.0, 0.538_469_310_105_683_1, 0.906_179_845_938_664],
            [0.568_888_888_888_888_9, 0.478_628_670_499_366_5, 0.236_926_885_056_189_1],
        );
        let (panels, end) = (8000, 40.0);
        let half = 0.5 * end / f64::from(panels);
        let mut total = 0.0;
        for k in 0..panels {
            let middle = f64::from(2 * k + 1) * half;
            total += weights[0] * integrand(middle);
            for j in 1..3 {
                total += weights[j] * (integrand(middle - half * nodes[j]) + integrand(middle + half * nodes[j]));
            }
        }
        total * half / sigma_max
    }

    #[test]
    fn s30_is_the_closed_form_of_s20() {
        let samples = [0.3, 0.7, 0.9, 1.4, 2.2, 2.9, 4.0];
        for n in [1, 2, 5, 7] {
            for sigma_max in [0.4, 1.0, 5.0] {
                for r in [0.0, 0.55, 1.0, 1.9, 3.1] {
                    let (closed, direct) =
                        (kde_weight(r, &samples[..n], sigma_max), quadrature(r, &samples[..n], sigma_max));
                    let tolerance = 1e-12 * direct + 1e-16;
                    assert!((closed - direct).abs() < tolerance, "n={n} σ={sigma_max} r={r}: {closed:e} {direct:e}");
                }
            }
        }
        assert_eq!(kde_weight(1.0, &[], 1.0), 0.0);
    }

    #[test]
    fn norms_are_scored_against_all_others_and_their_reflections() {
        let samples = [0.2, 0.5, 0.9, 1.3];
        let mut density = NormDensity::default();
        density.set(samples.into_iter());
        let both = |r: f64, of: &[f64]| -> f64 {
            let kernel = Kernel::new(4, 0.8);
            let sum: f64 = of.iter().map(|s| e1(kernel.argument(r - s)) + e1(kernel.argument(r + s))).sum();
            kernel.amplitude * sum / of.len() as f64
        };
        let expected = both(0.5, &[0.2, 0.9, 1.3]);
        assert!((density.at_sample(1, 0.8) / expected - 1.0).abs() < 1e-6);
        assert!((density.at(0.6, 0.8) / both(0.6, &samples) - 1.0).abs() < 1e-6);
        density.set([0.4].into_iter());
        assert_eq!((density.at_sample(0, 1.0), density.at(0.4, 1.0), density.len()), (0.0, 0.0, 1));
    }

    #[test]
    fn bins_predict_as_well_as_the_direct_sum() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(9);
        for n in [20, 100, 400] {
            let (mut sum, rounds) = (0.0, 30);
            for _ in 0..rounds {
                let mut unit = || (rng.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
                let samples: Vec<f64> = (0..n).map(|_| 0.01 * (-2.0 * log(1.0 - unit())).sqrt()).collect();
                let (mut exact, mut binned) = (NormDensity::default(), BinnedDensity::default());
                exact.set(samples.iter().copied());
                binned.set(samples.iter().copied(), 0.007);
                sum += (0..samples.len())
                    .map(|i| (binned.at_sample(samples[i]), exact.at_sample(i, 0.007)))
                    .filter(|(a, b)| *a > 0.0 && *b > 0.0)
                    .map(|(a, b)| log(a / b))
                    .sum::<f64>();
            }
            let bias = sum / f64::from(n * rounds);
            assert!(bias.abs() < 0.02, "n = {n}: {bias}");
        }
        let mut binned = BinnedDensity::default();
        binned.set([0.4].into_iter(), 1.0);
        assert_eq!(binned.at_sample(0.4), 0.0);
    }

    #[test]
    fn any_number_of_residuals_is_summed_as_if_directly() {
        // Chi-distributed, crowded, and partly equal residuals; bandwidths from narrow to wide.
        for n in [2, 17, 100, 512, 513, 3000] {
            let samples: Vec<f64> = (0..n)
                .map(|k| {
                    let u = (f64::from(k) + 0.5) / f64::from(n);
                    match k % 4 {
                        0 => 0.02 * u * u,
                        1 => 0.01 + 1e-5 * u,
                        2 => 0.015,
                        _ => 0.08 * (1.0 - u),
                    }
                })
                .collect();
            let mut density = NormDensity::default();
            density.set(samples.iter().copied());
            for sigma in [1e-4, 0.01, 0.5] {
                let kernel = Kernel::new(samples.len(), sigma);
                let terms = |r: f64, s: f64| e1(kernel.argument(r - s)) + e1(kernel.argument(r + s));
                for i in (0..samples.len()).step_by(1 + samples.len() / 23) {
                    let r = samples[i];
                    let others = (0..samples.len()).filter(|&j| j != i).map(|j| terms(r, samples[j])).sum::<f64>();
                    let direct = kernel.amplitude * others / (samples.len() - 1) as f64;
                    let tree = density.at_sample(i, sigma);
                    let scale = direct.max(kernel.amplitude / samples.len() as f64);
                    assert!((tree - direct).abs() < 1e-6 * scale, "n = {n}, σ = {sigma}: {tree:e} {direct:e}");
                    let r = r * 1.01 + 1e-4;
                    let direct = samples.iter().map(|&s| terms(r, s)).sum::<f64>() * kernel.amplitude / f64::from(n);
                    let scale = direct.max(kernel.amplitude / f64::from(n));
                    assert!((density.at(r, sigma) - direct).abs() < 1e-6 * scale, "n = {n}, σ = {sigma}");
                }
            }
        }
    }
}

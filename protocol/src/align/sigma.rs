//! The source's σ-consensus weights, S(12)–S(30): a Gaussian kernel density of the residuals with Silverman's bandwidth
//! `h = k σ n^(−1/5)`, k = 1.06, marginalised over σ ~ U(0, σ_max), which closes to the exponential integral E₁:
//!
//! `w(r) = (1/n) Σ_i n^{1/5} / (2 k √(2π) σ_max) · E₁( n^{2/5} (r − r_i)² / (2 k² σ_max²) )`.
//!
//! E₁(0) is infinite, so a residual is never scored against itself (leave-one-out) and arguments are at least
//! [`ARGUMENT_MIN`]. σ_max is a largest standard deviation, not a gate.

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
/// The power series up to 1, the continued fraction by Lentz's method beyond (Abramowitz and Stegun 5.1.11, 5.1.22). Own
/// code because results must be equal to the bit on all machines, and the crates at hand use the platform's `exp`, `ln`.
/// Infinite at 0, NaN below.
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

/// S(30) of residual norms: leave-one-out, and reflected at 0, since norms end there.
#[derive(Clone, Debug, Default)]
pub struct NormDensity {
    samples: Vec<f64>,
}

impl NormDensity {
    /// Replaces the samples (norms, ≥ 0) without allocating anew.
    pub fn set(&mut self, samples: impl Iterator<Item = f64>) {
        self.samples.clear();
        self.samples.extend(samples);
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
        self.samples.iter().map(|&s| pair(kernel, r, s)).sum()
    }
}

/// Kernel between norms r and s, and between r and the reflected −s.
fn pair(kernel: &Kernel, r: f64, s: f64) -> f64 {
    e1_fast(kernel.argument(r - s)) + e1_fast(kernel.argument(r + s))
}

/// Cells of the table per octave of the argument.
const CELLS: u64 = 64;
const CELL_BITS: u32 = 52 - CELLS.trailing_zeros();

/// E₁ by cubic Hermite interpolation in a table over [`ARGUMENT_MIN`, `ARGUMENT_MAX`]; relative error below 1e-7, 0
/// beyond.
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

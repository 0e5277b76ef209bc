//! How surprising one alignment is to a set of others whose covariances may all be too small by an unknown factor: the
//! χ² test of a left-out member, marginalised over that factor (MATH §5).

use libm::{erfc, exp, log, sqrt};

/// Probability that a true alignment of `dimension` values lies as far out as `distance_squared` at scale 1, where the
/// covariance scale is one of `scales`, all as likely before `others` spoke: their χ² and its degrees of freedom.
pub(super) fn surprise(dimension: usize, distance_squared: f64, others: (f64, f64), scales: &[f64]) -> f64 {
    let (chi_squared, freedom) = others;
    let log_likelihood = |s: f64| -freedom * log(s) - 0.5 * chi_squared / (s * s);
    let best = scales.iter().map(|&s| log_likelihood(s)).fold(f64::NEG_INFINITY, f64::max);
    let (mut tail, mut total) = (0.0, 0.0);
    for &s in scales {
        let weight = exp(log_likelihood(s) - best);
        tail += weight * chi_squared_tail(dimension, distance_squared / (s * s));
        total += weight;
    }
    tail / total
}

/// P(χ²_N > x) for 3, 6 or 7 degrees of freedom, in closed form.
fn chi_squared_tail(dimension: usize, x: f64) -> f64 {
    let y = 0.5 * x.max(0.0);
    if y > 700.0 {
        return 0.0;
    }
    if dimension == 6 {
        return exp(-y) * (1.0 + y * (1.0 + 0.5 * y));
    }
    let root = sqrt(y);
    let more = if dimension == 7 { y / 1.5 * (1.0 + y / 2.5) } else { 0.0 };
    erfc(root) + exp(-y) * (root / 0.886_226_925_452_758 * (1.0 + more))
}

#[cfg(test)]
mod tests {
    use super::*;
    use statrs::distribution::{ChiSquared, ContinuousCDF};

    #[test]
    fn the_tails_are_those_of_chi_squared() {
        for x in [0.0, 0.3, 4.0, 16.8, 40.0, 200.0] {
            let exact = |freedom| ChiSquared::new(freedom).unwrap().sf(x);
            assert!((chi_squared_tail(3, x) - exact(3.0)).abs() < 1e-12, "{x}");
            assert!((chi_squared_tail(6, x) - exact(6.0)).abs() < 1e-12, "{x}");
            assert!((chi_squared_tail(7, x) - exact(7.0)).abs() < 1e-12, "{x}");
        }
        assert_eq!(chi_squared_tail(6, f64::INFINITY), 0.0);
    }

    #[test]
    fn others_that_fit_well_make_a_far_one_a_surprise() {
        let scales = [1.0, 1.3, 1.7, 2.3, 3.0];
        let at = |chi_squared| surprise(6, 60.0, (chi_squared, 30.0), &scales);
        assert!(at(30.0) < 1e-3 && at(150.0) > 0.05, "{} {}", at(30.0), at(150.0));
        assert!((surprise(6, 16.811_893_829_770_93, (99.0, 6.0), &[1.0]) - 0.01).abs() < 1e-9);
    }
}

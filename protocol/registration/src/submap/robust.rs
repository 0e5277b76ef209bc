//! What a residual counts that may be of a wrong pair.

/// Tuning constant of the Cauchy weight: 95 % efficiency under Gaussian noise (Holland and Welsch, 1977).
const CAUCHY: f64 = 2.385;

/// The Cauchy weight of a residual at a noise of standard deviation `sigma`, in the same unit: 1 at 0, and falling.
pub(super) fn cauchy_weight(residual: f64, sigma: f64) -> f64 {
    let x = residual / (CAUCHY * sigma);
    1.0 / (1.0 + x * x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_far_off_counts_little_and_its_sign_nothing() {
        assert_eq!(cauchy_weight(0.0, 1.0), 1.0);
        assert_eq!(cauchy_weight(2.385, 1.0), 0.5);
        assert_eq!(cauchy_weight(-3.0, 2.0), cauchy_weight(1.5, 1.0));
        assert!(cauchy_weight(100.0, 1.0) < 1e-3);
    }
}

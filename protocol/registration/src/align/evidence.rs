//! How well a motion explains all matches when σ is unknown: a mixture of Gaussian inliers and uniform outliers,
//! marginalised over ten log-spaced σ (MATH §4.1), in the spirit of S(18)–S(23) but with the outlier density explicit.

use libm::{exp, log, log1p};

/// Values of σ tried.
const SIGMAS: usize = 10;
/// σ_max over the smallest σ tried.
pub(super) const SIGMA_SPAN: f64 = 50.0;
/// Exponents r²/2σ² beyond this contribute nothing.
pub(super) const EXPONENT_MAX: f64 = 40.0;
const LOG_2PI: f64 = 1.837_877_066_409_345_3;

/// A mixture that explains residuals.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Mixture {
    /// Best σ of those tried.
    pub sigma: f64,
    /// Its inlier share ε.
    pub inlier_share: f64,
    /// ln of the marginal likelihood over "all are outliers".
    pub log_evidence: f64,
}

/// ln of (Gaussian density at 0) / (outlier density).
pub(super) fn log_peak(sigma: f64, volume: f64) -> f64 {
    log(volume) - 1.5 * LOG_2PI - 3.0 * log(sigma)
}

/// The evidence of squared residuals, ascending, of which only the small ones need be given; `n` counts all matches.
/// `None` where fewer than 4 lie near for every σ. `log_roots`, if any, are ½ ln det of each residual's normalised
/// covariance, by which its Gaussian is flatter.
pub(super) fn evidence(squared: &[f64], log_roots: &[f64], n: usize, sigma_max: f64, volume: f64) -> Option<Mixture> {
    let n = n as f64;
    let step = libm::pow(SIGMA_SPAN, 1.0 / (SIGMAS - 1) as f64);
    let mut best: Option<(f64, f64, f64)> = None;
    let mut logs = [f64::NEG_INFINITY; SIGMAS];
    let mut sigma = sigma_max / SIGMA_SPAN;
    for slot in &mut logs {
        let gate = |k: f64| squared.partition_point(|&r2| r2 < k * sigma * sigma);
        let near = gate(11.345);
        if near >= 4 {
            let close = &squared[..gate(2.0 * EXPONENT_MAX)];
            let (value, share) = profile(close, log_roots, near, n, sigma, log_peak(sigma, volume));
            *slot = value;
            if best.is_none_or(|b| value > b.0) {
                best = Some((value, sigma, share));
            }
        }
        sigma *= step;
    }
    let (top, sigma, inlier_share) = best?;
    let total: f64 = logs.iter().map(|l| exp(l - top)).sum();
    Some(Mixture { sigma, inlier_share, log_evidence: top + log(total / SIGMAS as f64) })
}

/// Log-likelihood at one σ, ε by two EM steps.
fn profile(close: &[f64], log_roots: &[f64], near: usize, n: f64, sigma: f64, log_peak: f64) -> (f64, f64) {
    let bounded = |share: f64| share.clamp(1.5 / n, 0.98_f64.max(1.5 / n));
    let mut share = bounded(near as f64 / n).min(0.98);
    let inverse = 0.5 / (sigma * sigma);
    let mut value = 0.0;
    for _ in 0..2 {
        let odds = share / (1.0 - share);
        let mut posterior = 0.0;
        value = n * log(1.0 - share);
        let mut add = |log_ratio: f64| {
            let l = exp(log_ratio) * odds;
            value += log1p(l);
            posterior += l / (1.0 + l);
        };
        if log_roots.is_empty() {
            close.iter().for_each(|r2| add(log_peak - r2 * inverse));
        } else {
            close.iter().zip(log_roots).for_each(|(r2, log_root)| add(log_peak - log_root - r2 * inverse));
        }
        let next = bounded(posterior / n).min(0.98);
        if (next - share).abs() < 1e-3 * share {
            break;
        }
        share = next;
    }
    (value, share)
}

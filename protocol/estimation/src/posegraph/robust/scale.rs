//! The scale of the noise that closures show, true and false ones together: σ-consensus over the map (MATH §4).
//!
//! What counts was chosen at the noise believed so far, and so shows no more of it. All closures whose ends the map
//! holds tell better: at each scale they are a mixture of a Gaussian and of chance spread evenly over the search
//! volume, their share by EM, and the scale of the greatest likelihood is the noise's.

use core::f64::consts::PI;
use libm::{exp, log};

/// Scales tried on either side of 1, and the factor between two.
const STEPS: i32 = 12;
const STEP: f64 = 1.2;
/// Steps of EM for the share of true closures.
const EM_STEPS: usize = 8;
/// χ²₆ that noise seldom exceeds.
const NEAR: f64 = 38.0;
/// The median of χ²₆ is 5.3; that of closures below this, among so many, is no noise's.
const MEDIAN_MIN: f64 = 3.6;
const CROWD_MIN: usize = 100;
/// Fewer closures say nothing of the scale.
const CLOSURES_MIN: usize = 4;

/// A closure's d² against the map, and ln √det of its covariance.
pub(super) type Innovation = (f64, f64);

/// What closures show of the noise's scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Scale {
    /// The factor on standard deviations under which they are the likeliest.
    Clear(f64),
    /// None: false closures crowd about the true ones, as in look-alike places, and would be taken for noise.
    Crowded,
}

impl Scale {
    /// Of closures' innovations in a search volume; 1 where too few speak.
    pub(super) fn of(innovations: &[Innovation], volume: f64) -> Self {
        if innovations.len() < CLOSURES_MIN {
            return Self::Clear(1.0);
        }
        let scales = (-STEPS..=STEPS).map(|k| libm::pow(STEP, f64::from(k)));
        let scored = scales.map(|s| (log_likelihood(innovations, volume, s), s));
        let scale = scored.max_by(|x, y| x.0.total_cmp(&y.0)).map_or(1.0, |(_, s)| s);
        let mut near: Vec<f64> =
            innovations.iter().map(|(d2, _)| d2 / (scale * scale)).filter(|&x| x <= NEAR).collect();
        near.sort_by(f64::total_cmp);
        // A crowd has no scale: half of what one seems to explain lies far within it.
        let is_crowd = near.len() >= CROWD_MIN && near[near.len() / 2] < MEDIAN_MIN;
        if scale > 1.0 && is_crowd { Self::Crowded } else { Self::Clear(scale) }
    }
}

/// ln of how much likelier a closure is to be true, at a scale, than brought there by chance.
pub(super) fn log_ratio((d2, log_sqrt_det): Innovation, volume: f64, s: f64) -> f64 {
    log(volume) - 0.5 * d2 / (s * s) - 6.0 * log(s) - log_sqrt_det - 3.0 * log(2.0 * PI)
}

/// The same, of a scale that is only known to be one of some: averaged over them.
pub(super) fn log_ratio_over(innovation: Innovation, volume: f64, scales: &[f64]) -> f64 {
    let ratios = scales.iter().map(|&s| log_ratio(innovation, volume, s));
    let most = ratios.clone().fold(f64::NEG_INFINITY, f64::max);
    if most.is_finite() { most + log(ratios.map(|r| exp(r - most)).sum::<f64>() / scales.len() as f64) } else { most }
}

/// ln of the probability that chance brings a false closure as near to the map.
pub(super) fn log_chance((d2, log_sqrt_det): Innovation, volume: f64) -> f64 {
    (3.0 * log(PI * d2) - log(6.0) + log_sqrt_det - log(volume)).min(0.0)
}

fn log_likelihood(innovations: &[Innovation], volume: f64, s: f64) -> f64 {
    let ratios: Vec<f64> = innovations.iter().map(|&x| log_ratio(x, volume, s)).collect();
    let n = ratios.len() as f64;
    let mut share = 0.5;
    for _ in 0..EM_STEPS {
        let posterior = |r: &f64| 1.0 / (1.0 + (1.0 - share) / share * exp(-r));
        share = (ratios.iter().map(posterior).sum::<f64>() / n).clamp(0.5 / n, 1.0 - 0.5 / n);
    }
    // Of each: ln(share e^r + 1 − share), without overflow.
    let of = |&r: &f64| r.max(0.0) + log(share * exp(r.min(0.0)) + (1.0 - share) * exp(-r.max(0.0)));
    ratios.iter().map(of).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sampling::{normals, rng, uniform};

    /// d² of `n` closures with a noise of scale `s`, ln √det of a tenth of a unit each.
    fn noise(seed: u64, n: usize, s: f64) -> Vec<Innovation> {
        let mut rng = rng(seed);
        (0..n).map(|_| (s * s * normals::<6>(&mut rng).norm_squared(), 6.0 * log(0.1))).collect()
    }

    #[test]
    fn the_scale_is_that_of_the_true_ones_whatever_the_others_do() {
        for (seed, s) in [(1, 1.0), (2, 3.5), (3, 0.3)] {
            let mut all = noise(seed, 40, s);
            let mut rng = rng(seed);
            all.extend((0..160).map(|_| (uniform(&mut rng, 1e3, 1e6), 6.0 * log(0.1))));
            let Scale::Clear(found) = Scale::of(&all, 1e6) else { panic!("no crowd") };
            assert!((found / s).ln().abs() < 0.25, "{found} for {s}");
        }
        assert_eq!(Scale::of(&noise(4, 3, 5.0), 1e6), Scale::Clear(1.0));
    }

    #[test]
    fn a_scale_that_is_not_known_tells_near_ones_less_and_far_ones_more() {
        let volume = 1e4;
        let at = |d2: f64| (log_ratio((d2, -9.0), volume, 1.0), log_ratio_over((d2, -9.0), volume, &[1.0, 1.7, 3.0]));
        assert_eq!(log_ratio_over((6.0, -9.0), volume, &[1.0]), log_ratio((6.0, -9.0), volume, 1.0));
        let ((sure, unsure), (far, explained)) = (at(6.0), at(60.0));
        assert!(unsure < sure && unsure > sure - log(3.0) - 1e-9, "{unsure} {sure}");
        assert!(explained > far + 10.0, "{explained} {far}");
    }

    #[test]
    fn chance_is_the_share_of_the_volume_that_is_as_near() {
        let mut rng = rng(7);
        let (edge, n) = (4.0, 200_000);
        let d2 = |rng: &mut _| (0..6).map(|_| uniform(rng, -0.5 * edge, 0.5 * edge).powi(2)).sum::<f64>();
        let near = (0..n).filter(|_| d2(&mut rng) <= 3.0).count();
        let told = exp(log_chance((3.0, 0.0), libm::pow(edge, 6.0)));
        assert!((near as f64 / f64::from(n) / told - 1.0).abs() < 0.05, "{near} {told}");
        assert_eq!(log_chance((1e9, 0.0), 1.0), 0.0, "never more than certain");
    }

    #[test]
    fn false_ones_that_crowd_about_the_truth_are_no_noise() {
        let mut all = noise(5, 150, 1.0);
        all.extend((0..150).flat_map(|k| noise(100 + k, 1, 1.0 + 0.06 * k as f64)));
        assert_eq!(Scale::of(&all, 1e9), Scale::Crowded);
    }
}

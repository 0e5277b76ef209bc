//! From a rough motion to the best one: expectation-maximisation over (motion, σ, ε), then, where they predict held-out
//! residuals better, the kernel density weights S(30) relative to the outlier density (MATH §4.2).

use super::Weighting;
use super::evidence::{self, EXPONENT_MAX, SIGMA_SPAN};
use super::noise::{self, Shapes};
use super::prepare::Matches;
use super::sigma::{BinnedDensity, NormDensity};
use super::solve::{self, Motion};
use core::f64::consts::PI;
use libm::{exp, log};

/// EM iterations at most.
const EM_ITERATIONS_MAX: usize = 50;
/// EM stops when Σp and σ change by less than this share.
const EM_TOLERANCE: f64 = 1e-7;
/// Reweightings by kernel density.
const KDE_ITERATIONS: usize = 8;
/// Residuals the kernel density is made of: those within this many σ̂.
const KDE_REACH: f64 = 8.0;
/// The standard deviation of a χ₃ norm, in σ: the spread that bounds the kernel density's bandwidth.
const CHI3_SPREAD: f64 = 0.673_4;
/// Support below which a density of residuals says little.
const KDE_SUPPORT_MIN: f64 = 20.0;
/// Held-out log-likelihood by which kernel density must win.
const KDE_MARGIN: f64 = 3.0;

/// What stays the same over all hypotheses of a problem.
#[derive(Clone, Copy, Debug)]
pub(super) struct Context<'a> {
    pub matches: &'a Matches,
    pub with_scale: bool,
    pub scale_range: (f64, f64),
    pub sigma_max: f64,
    /// Volume in which outliers fall.
    pub volume: f64,
}

impl Context<'_> {
    /// 6 or 7.
    pub fn dof(&self) -> f64 {
        if self.with_scale { 7.0 } else { 6.0 }
    }
}

/// A motion with all that was learnt about its matches.
#[derive(Clone, Debug)]
pub(super) struct Fit {
    pub motion: Motion,
    /// σ̂ of residuals divided by [`Motion::residual_unit`].
    pub sigma: f64,
    pub inlier_share: f64,
    /// Inlier probability per match.
    pub probabilities: Vec<f64>,
    /// Squared residual per match, divided by the squared residual unit; with covariances, Mahalanobis distance.
    pub squared: Vec<f64>,
    /// The residuals' normalised covariances, if not all alike.
    pub shapes: Option<Shapes>,
    pub weighting: Weighting,
}

impl Fit {
    /// Σ of inlier probabilities.
    pub fn support(&self) -> f64 {
        self.probabilities.iter().sum()
    }

    /// How much larger than a sphere a typical region of given Mahalanobis distance is.
    pub fn region(&self) -> f64 {
        self.shapes.as_ref().map_or(1.0, |s| s.volume)
    }
}

/// Buffers that refinement reuses.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    order: Vec<u32>,
    sorted: Vec<f64>,
    log_roots: Vec<f64>,
    source_used: Vec<bool>,
    target_used: Vec<bool>,
    density: NormDensity,
    binned: BinnedDensity,
    trial: Vec<f64>,
}

/// Squared residuals in units of the residual unit; with covariances, their shapes and squared Mahalanobis distances.
fn squared_residuals(matches: &Matches, motion: &Motion, out: &mut Vec<f64>) -> Option<Shapes> {
    let unit = motion.residual_unit();
    let inverse = 1.0 / (unit * unit);
    let a = motion.rotation * motion.scale;
    out.clear();
    let residuals = matches.source.iter().zip(&matches.target).map(|(p, q)| q - (a * p + motion.translation));
    let Some(noise) = &matches.noise else {
        out.extend(residuals.map(|r| r.norm_squared() * inverse));
        return None;
    };
    let shapes = noise.shapes(motion);
    out.extend(residuals.zip(&shapes.precision).map(|(r, precision)| r.dot(&(precision * r)) * inverse));
    Some(shapes)
}

/// EM from `start`; `None` if the consensus dissolves.
pub(super) fn em(context: &Context, start: Motion, scratch: &mut Scratch) -> Option<Fit> {
    let n = context.matches.len();
    let mut squared = Vec::with_capacity(n);
    let shapes = squared_residuals(context.matches, &start, &mut squared);
    let reach = 2.0 * EXPONENT_MAX * context.sigma_max * context.sigma_max;
    scratch.sorted.clear();
    scratch.log_roots.clear();
    if let Some(shapes) = &shapes {
        sort_with_shapes(&squared, reach, shapes, scratch);
    } else {
        scratch.sorted.extend(squared.iter().filter(|r2| **r2 < reach));
        scratch.sorted.sort_unstable_by(f64::total_cmp);
    }
    let mixture = evidence::evidence(&scratch.sorted, &scratch.log_roots, n, context.sigma_max, context.volume)?;
    let mut fit = Fit {
        motion: start,
        sigma: mixture.sigma,
        inlier_share: mixture.inlier_share,
        probabilities: vec![0.0; n],
        squared,
        shapes,
        weighting: Weighting::Em,
    };
    let mut support = 0.0;
    for _ in 0..EM_ITERATIONS_MAX {
        let (sigma, before) = (fit.sigma, support);
        posteriors(context, &mut fit, scratch);
        update(context, &mut fit)?;
        support = fit.support();
        if (support - before).abs() < EM_TOLERANCE * support && (fit.sigma - sigma).abs() < EM_TOLERANCE * sigma {
            break;
        }
    }
    Some(fit)
}

/// Fills `sorted` with the squares below `reach`, ascending, and `log_roots` with what belongs to each.
fn sort_with_shapes(squared: &[f64], reach: f64, shapes: &Shapes, scratch: &mut Scratch) {
    scratch.order.clear();
    scratch.order.extend((0..squared.len() as u32).filter(|&i| squared[i as usize] < reach));
    scratch.order.sort_unstable_by(|&a, &b| squared[a as usize].total_cmp(&squared[b as usize]).then(a.cmp(&b)));
    scratch.sorted.extend(scratch.order.iter().map(|&i| squared[i as usize]));
    scratch.log_roots.extend(scratch.order.iter().map(|&i| shapes.log_root[i as usize]));
}

/// Inlier posteriors at the fit's σ and ε.
fn posteriors(context: &Context, fit: &mut Fit, scratch: &mut Scratch) {
    let odds = fit.inlier_share / (1.0 - fit.inlier_share);
    let peak = exp(evidence::log_peak(fit.sigma, context.volume)) * odds;
    let inverse = 0.5 / (fit.sigma * fit.sigma);
    for (p, r2) in fit.probabilities.iter_mut().zip(&fit.squared) {
        let x = r2 * inverse;
        *p = if x < EXPONENT_MAX {
            let l = peak * exp(-x);
            l / (1.0 + l)
        } else {
            0.0
        };
    }
    if let Some(shapes) = &fit.shapes {
        // l / (1 + l) with l divided by √det C.
        for (p, log_root) in fit.probabilities.iter_mut().zip(&shapes.log_root).filter(|(p, _)| **p > 0.0) {
            *p /= *p + (1.0 - *p) * exp(*log_root);
        }
    }
    one_to_one(context.matches, fit, scratch);
}

/// Motion, residuals, σ̂ and ε from the inlier probabilities.
fn update(context: &Context, fit: &mut Fit) -> Option<()> {
    let n = fit.probabilities.len() as f64;
    let support = fit.support();
    if support < 3.0 {
        return None;
    }
    let matches = context.matches;
    let (p, q, weights) = (&matches.source, &matches.target, &fit.probabilities);
    let motion = match &fit.shapes {
        None => solve::weighted(p, q, weights, context.with_scale)?,
        Some(shapes) => noise::refit(p, q, weights, shapes, fit.motion, context.with_scale)?,
    };
    if !(context.scale_range.0..=context.scale_range.1).contains(&motion.scale) {
        return None;
    }
    fit.motion = motion;
    fit.shapes = squared_residuals(matches, &motion, &mut fit.squared);
    let sum: f64 = fit.probabilities.iter().zip(&fit.squared).filter(|(p, _)| **p > 0.0).map(|(p, r2)| p * r2).sum();
    let freedom = (3.0 * support - context.dof()).max(2.0);
    fit.sigma = (sum / freedom).sqrt().clamp(context.sigma_max / SIGMA_SPAN, context.sigma_max);
    fit.inlier_share = (support / n).clamp(2.0 / n, 1.0 - 1.0 / n);
    Some(())
}

/// Where a point is in several matches, only the one with the smallest residual keeps its probability.
fn one_to_one(matches: &Matches, fit: &mut Fit, scratch: &mut Scratch) {
    if !matches.repeats {
        return;
    }
    let n = matches.len();
    let (squared, probabilities) = (&fit.squared, &mut fit.probabilities);
    scratch.order.clear();
    scratch.order.extend((0..n as u32).filter(|&i| probabilities[i as usize] > 0.0));
    scratch.order.sort_unstable_by(|&a, &b| squared[a as usize].total_cmp(&squared[b as usize]).then(a.cmp(&b)));
    for used in [&mut scratch.source_used, &mut scratch.target_used] {
        used.clear();
        used.resize(n, false);
    }
    for &i in &scratch.order {
        let i = i as usize;
        let (s, t) = (matches.source_id[i] as usize, matches.target_id[i] as usize);
        if scratch.source_used[s] || scratch.target_used[t] {
            probabilities[i] = 0.0;
        } else {
            scratch.source_used[s] = true;
            scratch.target_used[t] = true;
        }
    }
}

/// The fit by kernel density weights, if `weighting` wants it: `Auto` does where it predicts held-out residuals better.
pub(super) fn reweight(context: &Context, fit: &Fit, weighting: Weighting, scratch: &mut Scratch) -> Option<Fit> {
    let wanted = match weighting {
        Weighting::Em => false,
        Weighting::Kde => true,
        Weighting::Auto => fit.support() >= KDE_SUPPORT_MIN && held_out_gain(context, fit, scratch) > KDE_MARGIN,
    };
    wanted.then(|| kernel_density(context, fit, scratch)).flatten()
}

/// Iterative reweighting by `p = 1 − (outlier density) / (kernel density of all residuals)`, not rising beyond σ̂.
fn kernel_density(context: &Context, start: &Fit, scratch: &mut Scratch) -> Option<Fit> {
    let mut fit = start.clone();
    fit.weighting = Weighting::Kde;
    for _ in 0..KDE_ITERATIONS {
        let inside = gather(&fit, scratch);
        let (n, spread) = (fit.squared.len() as f64, CHI3_SPREAD * fit.sigma);
        let (share, volume) = (inside as f64 / n, context.volume / fit.region());
        scratch.trial.clear();
        scratch.trial.resize(fit.squared.len(), 0.0);
        let mut ceiling = 1.0_f64;
        for (k, &i) in scratch.order.iter().enumerate() {
            let r = fit.squared[i as usize].sqrt();
            let density = share * scratch.density.at_sample(k, spread);
            let shell = outlier_shell(r.max(0.5 * fit.sigma), (1.0 - fit.inlier_share).max(1e-3), volume);
            let p = if density > 0.0 { (1.0 - shell / density).clamp(0.0, 1.0) } else { 0.0 };
            if r >= fit.sigma {
                ceiling = ceiling.min(p);
                scratch.trial[i as usize] = ceiling;
            } else {
                scratch.trial[i as usize] = p;
            }
        }
        fit.probabilities.copy_from_slice(&scratch.trial);
        one_to_one(context.matches, &mut fit, scratch);
        update(context, &mut fit)?;
    }
    Some(fit)
}

/// Fills `order` with the matches within reach, nearest first, and the density with their residuals. Returns how many.
fn gather(fit: &Fit, scratch: &mut Scratch) -> usize {
    within_reach(fit, scratch);
    let squared = &fit.squared;
    scratch.density.set(scratch.order.iter().map(|&i| squared[i as usize].sqrt()));
    scratch.order.len()
}

/// Fills `order` with the matches within reach, nearest first.
fn within_reach(fit: &Fit, scratch: &mut Scratch) {
    let reach = KDE_REACH * KDE_REACH * fit.sigma * fit.sigma;
    let squared = &fit.squared;
    scratch.order.clear();
    scratch.order.extend((0..squared.len() as u32).filter(|&i| squared[i as usize] < reach));
    scratch.order.sort_unstable_by(|&a, &b| squared[a as usize].total_cmp(&squared[b as usize]).then(a.cmp(&b)));
}

/// Density of an outlier's residual norm.
fn outlier_shell(r: f64, share: f64, volume: f64) -> f64 {
    share * 4.0 * PI * r * r / volume
}

/// Σ over residuals within reach of ln(kernel density, leave-one-out) − ln(Gaussian mixture, leave-one-out).
fn held_out_gain(context: &Context, fit: &Fit, scratch: &mut Scratch) -> f64 {
    within_reach(fit, scratch);
    let n = fit.squared.len() as f64;
    let share = scratch.order.len() as f64 / n;
    scratch.binned.set(scratch.order.iter().map(|&i| fit.squared[i as usize].sqrt()), CHI3_SPREAD * fit.sigma);
    let freedom = (3.0 * fit.support() - context.dof()).max(2.0);
    let volume = context.volume / fit.region();
    let mut gain = 0.0;
    for &i in &scratch.order {
        let (r2, p) = (fit.squared[i as usize], fit.probabilities[i as usize]);
        let r = r2.sqrt();
        let kernel = share * scratch.binned.at_sample(r);
        // σ̂² without this match.
        let variance = fit.sigma * fit.sigma;
        let left = ((freedom * variance - p * r2) / (freedom - 3.0 * p).max(1.0)).max(0.1 * variance);
        let chi3 = (2.0 / PI).sqrt() * r2 / (left * left.sqrt()) * exp(-0.5 * r2 / left);
        let gaussian = fit.inlier_share * chi3 + outlier_shell(r, 1.0 - fit.inlier_share, volume);
        if kernel > 0.0 && gaussian > 0.0 {
            gain += log(kernel / gaussian);
        }
    }
    gain
}

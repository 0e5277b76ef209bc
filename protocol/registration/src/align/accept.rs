//! Whether a consensus could be chance: the number of false alarms (NFA), the expected number of equally good
//! alignments in random matches (MATH §4.3).
//!
//! `NFA = (k − 3)(k − 2) C(n, k) π₃ α^(k − 3)`: α is the chance that a random target lies within the k-th smallest
//! residual of a given place, and π₃ the chance that a random triangle is rigid to that accuracy at all; both are
//! measured on the problem ([`super::chance`]). With covariances a match's region is an ellipsoid; the mean volume of
//! all matches' at the same Mahalanobis distance takes the sphere's place (of products over subsets the power of the
//! mean is the upper bound). It counts as the sphere of that volume for α, and of the ellipsoids' largest axes for π₃.
//! The first factors share the false alarms out among the k tried: Σ 1/((k − 3)(k − 2)) is 1 from k = 4 on, as is the
//! sum of MATH's 1/(n − 3) over all k, but a small consensus is the one in doubt. MATH's C(k, 3) is absent: it counts
//! each subset once for each of its triangles. Evidence is not used: on pure outliers it accepts 76–100 % (*measured*).

use super::prepare::Matches;
use super::refine::{Context, Fit};
use libm::{log, log10};

/// Fewest matches that can be significant.
pub(super) const COUNT_MIN: usize = 5;
/// Residuals beyond this many σ_max cannot be inliers: the 99 % quantile of χ₃.
pub(super) const REACH: f64 = 3.368_2;

/// Points closer than so many σ̂ are one piece of evidence.
const SEPARATION: f64 = 2.0;
/// Beyond so many matches nearness is not checked: they cannot all be copies of a chance few.
const THINNED_MAX: usize = 256;

/// How surprising a fit is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Significance {
    /// log₁₀ of the number of false alarms.
    pub log10_nfa: f64,
    /// Matches it is reached with.
    pub count: usize,
}

/// Buffers reused.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    order: Vec<u32>,
    source_used: Vec<bool>,
    target_used: Vec<bool>,
}

/// The smallest NFA over all inlier counts. Matches for which `taken` is true do not count; a point counts once.
pub(super) fn significance(
    context: &Context,
    fit: &Fit,
    taken: Option<&[bool]>,
    scratch: &mut Scratch,
) -> Significance {
    let matches = context.matches;
    count_once(matches, fit, context.sigma_max * REACH, taken, scratch);
    let n = matches.len();
    let floor = context.sigma_max / super::evidence::SIGMA_SPAN;
    let n_f = n as f64;
    let unit = fit.motion.residual_unit();
    let sphere = libm::cbrt(fit.region());
    let widest = matches.noise.as_ref().map_or(1.0, |noise| noise.widest(fit.motion.scale));
    let mut choose = log(n_f * (n_f - 1.0) * (n_f - 2.0) / 6.0);
    let mut best = Significance { log10_nfa: log10(n_f.max(1.0)), count: 0 };
    for (rank, &i) in scratch.order.iter().enumerate().skip(3) {
        let drawn = (rank - 2) as f64;
        choose += log((n_f - rank as f64) / (rank + 1) as f64);
        if rank + 1 < COUNT_MIN {
            continue;
        }
        let r = fit.squared[i as usize].sqrt().max(floor) * unit;
        let (rigid, alpha) = (matches.chance.rigid_triangle(2.0 * r * widest), matches.chance.alpha(r * sphere));
        let log10_nfa =
            (log(drawn * (drawn + 1.0)) + choose + log(rigid) + drawn * log(alpha)) * core::f64::consts::LOG10_E;
        if log10_nfa < best.log10_nfa {
            best = Significance { log10_nfa, count: rank + 1 };
        }
    }
    best
}

/// Matches within `reach`, nearest first, each source and each target point once, and each neighbourhood once: matches
/// whose sources (or targets) lie within [`SEPARATION`] σ̂ stand or fall together, so they are one piece of evidence.
fn count_once(matches: &Matches, fit: &Fit, reach: f64, taken: Option<&[bool]>, scratch: &mut Scratch) {
    let squared = &fit.squared;
    let free = |i: u32| taken.is_none_or(|t| !t[i as usize]);
    scratch.order.clear();
    scratch.order.extend((0..squared.len() as u32).filter(|&i| squared[i as usize] < reach * reach && free(i)));
    scratch.order.sort_unstable_by(|&a, &b| squared[a as usize].total_cmp(&squared[b as usize]).then(a.cmp(&b)));
    if scratch.order.len() <= THINNED_MAX {
        let apart = SEPARATION * fit.sigma * fit.motion.residual_unit();
        let (in_source, in_target) = ((apart / fit.motion.scale).powi(2), apart * apart);
        let mut kept = 0;
        for k in 0..scratch.order.len() {
            let (p, q) = (&matches.source[scratch.order[k] as usize], &matches.target[scratch.order[k] as usize]);
            let near = |&j: &u32| {
                (matches.source[j as usize] - p).norm_squared() < in_source
                    || (matches.target[j as usize] - q).norm_squared() < in_target
            };
            if !scratch.order[..kept].iter().any(near) {
                scratch.order[kept] = scratch.order[k];
                kept += 1;
            }
        }
        scratch.order.truncate(kept);
    }
    if !matches.repeats {
        return;
    }
    for used in [&mut scratch.source_used, &mut scratch.target_used] {
        used.clear();
        used.resize(matches.len(), false);
    }
    let (source_used, target_used) = (&mut scratch.source_used, &mut scratch.target_used);
    scratch.order.retain(|&i| {
        let (s, t) = (matches.source_id[i as usize] as usize, matches.target_id[i as usize] as usize);
        let fresh = !source_used[s] && !target_used[t];
        source_used[s] = true;
        target_used[t] = true;
        fresh
    });
}

//! The pose in the plane that matched landmarks agree on. Matches are few, so every pair of them is tried as a
//! hypothesis; the best are fitted with the covariances of both sides, and accepted by the number of false alarms: how
//! often so many wrong matches would agree by accident (MATH §4), where a label is wrong with probability
//! [`LABEL_WRONG`] and a wrong match may lie anywhere in the submap.

use super::super::planar::Se2;
use super::LandmarkError;
use nalgebra::{Matrix2, Matrix3, Vector2, Vector3};

/// Matches tried at most: the most certain ones.
pub const MATCHES_MAX: usize = 160;
/// Matches that agree, at least: two make a pose, a third could agree by accident.
pub const MATCHES_MIN: usize = 4;
/// Chance that two landmarks of one label are not the same: bar codes are misread, and moved.
pub const LABEL_WRONG: f64 = 0.1;
/// A match agrees within this squared distance (χ²₂, 99 %)...
const CHI2_MAX: f64 = 9.21;
/// ...and may be this far from a hypothesis of two matches, which are not exact themselves.
const CHI2_ROUGH: f64 = 36.0;
/// Hypotheses that are fitted.
const FITTED_MAX: usize = 24;
/// Fits of each.
const FITS: usize = 6;
/// Two poses are different answers from this squared distance on (χ²₃, beyond 1 − 1e-9).
const DIFFERENT: f64 = 45.0;

/// A landmark's place and its covariance.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Place {
    /// Where.
    pub at: Vector2<f64>,
    /// How sure.
    pub covariance: Matrix2<f64>,
}

/// Two landmarks thought to be the same.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Match {
    /// The peer's.
    pub theirs: Place,
    /// Mine.
    pub mine: Place,
    /// By label, not by looks.
    pub labelled: bool,
}

/// What the matches agree on.
#[derive(Clone, Debug, PartialEq)]
pub struct Agreed {
    /// `t_mine_theirs`.
    pub pose: Se2,
    /// Of its local perturbation (x, y, angle).
    pub covariance: Matrix3<f64>,
    /// Matches that agree, and how many of them by label.
    pub members: Vec<usize>,
    /// log₁₀ of the number of false alarms.
    pub log10_nfa: f64,
    /// Root mean square distance of the members.
    pub rms: f64,
}

/// A fitted hypothesis.
struct Fit {
    pose: Se2,
    information: Matrix3<f64>,
    members: Vec<usize>,
    chi2: f64,
}

/// Finds the pose. `area` is that in which a wrong match may lie; a rival with `rival_ratio` of the members makes the
/// answer ambiguous; the largest accepted standard deviation of the angle is `rotation_sigma_max`.
///
/// # Errors
/// [`LandmarkError`]: a refusal with its reason.
pub fn agree(matches: &[Match], area: f64, rival_ratio: f64, rotation_sigma_max: f64) -> Result<Agreed, LandmarkError> {
    let matches = &matches[..matches.len().min(MATCHES_MAX)];
    if matches.len() < MATCHES_MIN {
        return Err(LandmarkError::TooFew { matches: matches.len(), needed: MATCHES_MIN });
    }
    let mut fits: Vec<Fit> = hypotheses(matches).iter().filter_map(|pose| fit(matches, pose)).collect();
    let cost = |fit: &Fit| fit.chi2 + CHI2_MAX * (matches.len() - fit.members.len()) as f64;
    fits.sort_by(|a, b| cost(a).total_cmp(&cost(b)));
    let best = fits.first().ok_or(LandmarkError::NoConsensus { members: 0, log10_nfa: 0.0 })?;
    let members = best.members.len();
    let log10_nfa = log10_nfa(matches, best, area);
    if members < MATCHES_MIN {
        return Err(LandmarkError::NoConsensus { members, log10_nfa: log10_nfa.max(0.0) });
    }
    let different = |fit: &&Fit| {
        let off = best.pose.local(&fit.pose);
        off.dot(&(best.information * off)) > DIFFERENT
    };
    // What shares its matches with the best one is a worse fit of the same.
    let apart = |fit: &&Fit| {
        let shared = fit.members.iter().filter(|k| best.members.contains(k)).count();
        2 * shared <= fit.members.len()
    };
    let rival = fits.iter().filter(different).filter(apart).map(|fit| fit.members.len()).max().unwrap_or(0);
    if rival as f64 >= rival_ratio * members as f64 && rival >= MATCHES_MIN - 1 {
        return Err(LandmarkError::Ambiguous { members, rival, elsewhere: false });
    }
    let covariance = best.information.try_inverse().unwrap_or(Matrix3::from_diagonal_element(f64::INFINITY));
    let rotation_sigma = covariance[(2, 2)].sqrt();
    if !covariance.iter().all(|x| x.is_finite()) || rotation_sigma > rotation_sigma_max {
        return Err(LandmarkError::Degenerate { rotation_sigma });
    }
    // Residuals larger than stated tell of further noise, which widens the covariance; smaller ones may be chance.
    let freedom = (2 * members - 3) as f64;
    let covariance = covariance * (best.chi2 / freedom).max(1.0);
    let square = |&k: &usize| (matches[k].mine.at - best.pose.apply(&matches[k].theirs.at)).norm_squared();
    let rms = (best.members.iter().map(square).sum::<f64>() / members as f64).sqrt();
    Ok(Agreed { pose: best.pose, covariance, members: best.members.clone(), log10_nfa, rms })
}

/// The poses that two matches suggest and most others agree with, best first.
fn hypotheses(matches: &[Match]) -> Vec<Se2> {
    let mut found: Vec<(f64, Se2)> = Vec::new();
    for (k, a) in matches.iter().enumerate() {
        for b in &matches[..k] {
            let (theirs, mine) = (b.theirs.at - a.theirs.at, b.mine.at - a.mine.at);
            let variance = |m: &Match| m.theirs.covariance.trace() + m.mine.covariance.trace();
            let slack = CHI2_MAX * (variance(a) + variance(b));
            let (long, short) = (mine.norm(), theirs.norm());
            if (long - short) * (long - short) > slack || long * short < 1e-12 {
                continue;
            }
            let angle = libm::atan2(mine.y, mine.x) - libm::atan2(theirs.y, theirs.x);
            let turn = Se2::new(super::super::planar::wrapped(angle), Vector2::zeros());
            let middle = (a.mine.at + b.mine.at) / 2.0;
            let pose = Se2::new(turn.angle, middle - turn.turn(&((a.theirs.at + b.theirs.at) / 2.0)));
            let cost: f64 = matches.iter().map(|m| distance(m, &pose).0.min(CHI2_ROUGH)).sum();
            found.push((cost, pose));
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    // Hypotheses of one pose use up no more than their share.
    let mut kept: Vec<Se2> = Vec::new();
    for (_, pose) in found {
        if kept.len() == FITTED_MAX {
            break;
        }
        let same = |other: &Se2| {
            matches
                .iter()
                .all(|m| (pose.apply(&m.theirs.at) - other.apply(&m.theirs.at)).norm_squared() < 1e-4 * variance_of(m))
        };
        if !kept.iter().any(same) {
            kept.push(pose);
        }
    }
    kept
}

fn variance_of(m: &Match) -> f64 {
    m.theirs.covariance.trace() + m.mine.covariance.trace()
}

/// Squared distance of a match under a pose, and its error and information.
fn distance(m: &Match, pose: &Se2) -> (f64, Vector2<f64>, Matrix2<f64>) {
    let error = pose.apply(&m.theirs.at) - m.mine.at;
    let turn = Matrix2::from_columns(&[pose.turn(&Vector2::x()), pose.turn(&Vector2::y())]);
    let covariance = m.mine.covariance + turn * m.theirs.covariance * turn.transpose();
    let information = covariance.try_inverse().unwrap_or_else(Matrix2::zeros);
    (error.dot(&(information * error)), error, information)
}

/// Least squares over the matches near the pose, which are chosen anew after each step.
fn fit(matches: &[Match], pose: &Se2) -> Option<Fit> {
    let mut pose = *pose;
    let mut gate = CHI2_ROUGH;
    for round in 0..FITS {
        let (mut h, mut g) = (Matrix3::zeros(), Vector3::zeros());
        for m in matches {
            let (chi2, error, information) = distance(m, &pose);
            if chi2 <= gate {
                let j = jacobian(&m.theirs.at, &pose);
                h += j.transpose() * information * j;
                g += j.transpose() * information * error;
            }
        }
        let step: Vector3<f64> = -(h.cholesky()?.solve(&g));
        pose = pose.retract(&step);
        if round >= 1 {
            gate = CHI2_MAX;
        }
    }
    let mut fit = Fit { pose, information: Matrix3::zeros(), members: Vec::new(), chi2: 0.0 };
    for (k, m) in matches.iter().enumerate() {
        let (chi2, _, information) = distance(m, &pose);
        if chi2 <= CHI2_MAX {
            let j = jacobian(&m.theirs.at, &pose);
            fit.information += j.transpose() * information * j;
            fit.members.push(k);
            fit.chi2 += chi2;
        }
    }
    Some(fit)
}

/// Of a point's place about the pose's local perturbation.
fn jacobian(p: &Vector2<f64>, pose: &Se2) -> nalgebra::Matrix2x3<f64> {
    let columns = [Vector2::x(), Vector2::y(), Vector2::new(-p.y, p.x)];
    nalgebra::Matrix2x3::from_columns(&columns.map(|c| pose.turn(&c)))
}

/// How often so many of the matches would agree with one of the hypotheses by accident.
fn log10_nfa(matches: &[Match], fit: &Fit, area: f64) -> f64 {
    let (n, k) = (matches.len() as u64, fit.members.len() as u64);
    let chance = |&member: &usize| {
        let m = &matches[member];
        let (_, _, information) = distance(m, &fit.pose);
        let ellipse = core::f64::consts::PI * CHI2_MAX / information.determinant().sqrt();
        (ellipse / area).min(1.0) * if m.labelled { LABEL_WRONG } else { 1.0 }
    };
    let worst = fit.members.iter().map(chance).fold(0.0, f64::max);
    let choose = |n: u64, k: u64| (1..=k).map(|i| libm::log10((n + 1 - i) as f64 / i as f64)).sum::<f64>();
    choose(n, 2) + choose(n, k) + k.saturating_sub(2) as f64 * libm::log10(worst.max(1e-300))
}

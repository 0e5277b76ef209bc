//! Runs the whole chain (match, σ-consensus, fit, refine) over pairs of places and gathers what it achieved.

use crate::data::{Place, Set};
use merganser_protocol::align::{Problem, SolverConfig, align};
use merganser_protocol::geometry::{Se3, Sim3};
use merganser_protocol::submap::{RefineConfig, Refined, fit, match_keypoints, refine};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// 95 % quantile of χ² with 6 degrees of freedom.
pub const CHI2_6_95: f64 = 12.592;
/// Voxels within which a match counts as right and a point as seen.
const NEAR_VOXELS: f64 = 1.5;
/// Accepted from this fit on.
const FIT_MIN: f64 = 0.2;

/// One direction: how their keypoints were aligned with my features.
pub struct Trial {
    pub matches: usize,
    /// Share of right matches.
    pub inlier_ratio: f64,
    /// The solver's pose, accepted or provisional, with support ≥ 8 and fit ≥ [`FIT_MIN`].
    pub rough: Option<Se3>,
    pub refined: Option<Refined>,
    pub support: f64,
    pub fit: f64,
}

pub fn trial(theirs: &Place, mine: &Place, keypoints: usize, truth: Option<&Se3>) -> Trial {
    let keypoints = theirs.described.keypoints.first(keypoints);
    let features = &mine.described.features;
    let near = NEAR_VOXELS * features.voxel();
    let found = match_keypoints(&keypoints, features);
    let right = |(s, t): &(&[f64; 3], &[f64; 3])| {
        truth.is_some_and(|truth| (*truth * Vector3::from(**s) - Vector3::from(**t)).norm() < near)
    };
    let rights = found.source.iter().zip(&found.target).filter(right).count();
    // What is only provisional for the solver is confirmed here by fit, refinement and the want of contradictions.
    let config = SolverConfig {
        sigma_max: near,
        support_min: 8.0,
        log10_nfa_provisional: Some(0.0),
        seed: 7,
        ..Default::default()
    };
    let problem =
        Problem { source: &found.source, target: &found.target, scores: Some(&found.scores), ..Problem::default() };
    let solved = align(&problem, &config).unwrap();
    let mut trial = Trial {
        matches: found.source.len(),
        inlier_ratio: rights as f64 / found.source.len().max(1) as f64,
        rough: None,
        refined: None,
        support: 0.0,
        fit: 0.0,
    };
    let Ok(alignment) = solved else { return trial };
    let sim: Sim3 = alignment.t_target_source.sim();
    trial.support = alignment.support;
    trial.fit = fit(&keypoints, features, &sim, near);
    if trial.fit >= FIT_MIN {
        trial.rough = Some(sim.to_se3());
        trial.refined = refine(&keypoints, features, &sim.to_se3(), &RefineConfig::of(mine.sensor)).ok();
    }
    trial
}

/// What a set of directions achieved.
#[derive(Default)]
pub struct Score {
    pub directions: usize,
    /// The solver's pose accepted and within the set's rule.
    pub right: usize,
    /// The solver's pose accepted and not.
    pub wrong: usize,
    /// Refined, within the rule.
    pub refined: usize,
    /// Refined, and not within the rule: false alignments that nothing here caught.
    pub false_refined: usize,
    pub matches: f64,
    pub inlier_ratio: f64,
    pub nees: Vec<f64>,
    pub degrees: Vec<f64>,
    pub metres: Vec<f64>,
    pub sigma_degrees: Vec<f64>,
    pub sigma_metres: Vec<f64>,
}

impl Score {
    pub fn of(set: &Set, keypoints: usize) -> Self {
        let mut score = Self::default();
        let directions = overlapping(set);
        score.directions = directions.len();
        for (theirs, mine, truth) in directions {
            score.add(set, &trial(theirs, mine, keypoints, Some(&truth)), &truth);
        }
        score
    }

    fn add(&mut self, set: &Set, trial: &Trial, truth: &Se3) {
        self.inlier_ratio += trial.inlier_ratio / self.directions as f64;
        self.matches += trial.matches as f64 / self.directions as f64;
        let is_right = |pose: &Se3| {
            let (degrees, metres) = difference(pose, truth);
            degrees < set.rotation_deg_max && metres < set.translation_max
        };
        let Some(rough) = trial.rough else { return };
        let count = if is_right(&rough) { &mut self.right } else { &mut self.wrong };
        *count += 1;
        let Some(refined) = &trial.refined else { return };
        let count = if is_right(&refined.pose.pose) { &mut self.refined } else { &mut self.false_refined };
        *count += 1;
        let covariance = refined.pose.covariance;
        let (degrees, metres) = difference(&refined.pose.pose, truth);
        self.nees.push(covariance.mahalanobis_squared(&refined.pose.pose.local(truth)));
        self.degrees.push(degrees);
        self.metres.push(metres);
        let sigmas = covariance.sigmas();
        self.sigma_metres.push(sigmas.fixed_rows::<3>(0).norm());
        self.sigma_degrees.push(sigmas.fixed_rows::<3>(3).norm().to_degrees());
    }

    /// Mean NEES over the refined directions.
    pub fn nees_mean(&self) -> f64 {
        self.nees.iter().sum::<f64>() / self.nees.len() as f64
    }

    /// Share of refined directions whose error lies in the 95 % ellipsoid.
    pub fn covered(&self) -> f64 {
        self.nees.iter().filter(|&&n| n <= CHI2_6_95).count() as f64 / self.nees.len() as f64
    }

    pub fn line(&self, name: &str, keypoints: usize) -> String {
        format!(
            "{name:>8} N={keypoints:<4} matches {:.0}, inlier ratio {:.3}; solver right {} wrong {} of {}; refined right {} \
             wrong {}; NEES mean {:.2} median {:.2}, {:.0} % in the 95 % ellipsoid; median error {:.2}° {:.3} m, stated \
             {:.2}° {:.3} m",
            self.matches,
            self.inlier_ratio,
            self.right,
            self.wrong,
            self.directions,
            self.refined,
            self.false_refined,
            self.nees_mean(),
            median(&self.nees),
            100.0 * self.covered(),
            median(&self.degrees),
            median(&self.metres),
            median(&self.sigma_degrees),
            median(&self.sigma_metres),
        )
    }
}

/// Ordered pairs of places of which a quarter of the first's points is seen by the second, with the true pose.
pub fn overlapping(set: &Set) -> Vec<(&Place, &Place, Se3)> {
    pairs(set).into_iter().filter(|(a, b, truth)| overlap(a, b, truth) >= 0.25).collect()
}

/// All ordered pairs with the true pose of the first in the second.
pub fn pairs(set: &Set) -> Vec<(&Place, &Place, Se3)> {
    let all = set.places.iter().flat_map(|a| set.places.iter().map(move |b| (a, b)));
    let different = all.filter(|(a, b)| !std::ptr::eq(*a, *b));
    different.map(|(a, b)| (a, b, b.t_world_anchor.inverse() * a.t_world_anchor)).collect()
}

/// Share of a's points with a point of b near them.
pub fn overlap(a: &Place, b: &Place, t_b_a: &Se3) -> f64 {
    let radius = NEAR_VOXELS * a.described.features.voxel();
    let cell = |p: &Vector3<f64>| [p.x, p.y, p.z].map(|x| (x / radius).floor() as i64);
    let mut cells = BTreeMap::<[i64; 3], Vec<Vector3<f64>>>::new();
    for s in b.described.features.surfels() {
        cells.entry(cell(&s.position)).or_default().push(s.position);
    }
    let seen = |p: Vector3<f64>| {
        let [x, y, z] = cell(&p);
        let around = (-1..=1).flat_map(|i| (-1..=1).flat_map(move |j| (-1..=1).map(move |k| [x + i, y + j, z + k])));
        around.filter_map(|c| cells.get(&c)).flatten().any(|q| (q - p).norm() < radius)
    };
    let theirs = a.described.features.surfels();
    theirs.iter().filter(|s| seen(*t_b_a * s.position)).count() as f64 / theirs.len().max(1) as f64
}

/// Angle (°) and distance between two poses.
pub fn difference(a: &Se3, b: &Se3) -> (f64, f64) {
    ((a.rotation.inverse() * b.rotation).angle().to_degrees(), (a.translation - b.translation).norm())
}

pub fn median(values: &[f64]) -> f64 {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    sorted.get(sorted.len() / 2).copied().unwrap_or(f64::NAN)
}

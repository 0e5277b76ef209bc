//! From a peer's keypoints to an alignment or a refusal: matches → σ-consensus → poses → judgement → refinement.
//!
//! Where submaps overlap by a third, three to ten of their keypoints have a right match among a thousand wrong ones: no
//! count of matches tells that from chance (MATH §4). But a pose can be *looked at*: of their points, so many would lie
//! on my surface and none where I saw air. So the consensus' pose, if there is one, joins the poses that few matches
//! suggest (`hypotheses`); each is judged by all keypoints.
//!
//! **Score.** A confirmed point weighs ln(q/f): q is its chance under a right pose and f how often it is confirmed under
//! the *other* poses of this very pair, so that ground on ground, which fits anywhere, weighs nothing. A contradicted
//! point costs `CONTRADICTION_COST`, a match that agrees gains `SUPPORT_GAIN`.
//!
//! **Acceptance.** Score, share of keypoints near my surface, share of contradictions; and no other pose with nearly the
//! same score that would itself pass, else the answer is *ambiguous*.

use super::features::{Features, Keypoints, in_voxels};
use super::hypotheses::hypotheses;
use super::matching::{Pairing, pair_up};
use super::refine::{RefineConfig, RefineError, Refined, refine_anchored};
use super::scene::{Cloud, NEAR, Pose, Scene, Verdict};
use super::surface::least_axis;
use crate::align::{AlignError, Problem, SolverConfig, align};
use crate::geometry::{Se3, So3};
use core::ops::Range;
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use thiserror::Error;

/// Keypoints that a pose is first judged by: an even cover...
const GLANCED: usize = 32;
/// ...and, if it is among the first so many...
const GLANCED_AGAIN: usize = 400;
/// ...keypoints that it is judged by once more.
const ROUGH: usize = 96;
/// Poses that are polished.
const POLISHED_MAX: usize = 60;
/// Search radii while polishing on the first [`ROUGH`] keypoints, voxels...
const RADII_ROUGH: [f32; 3] = [3.0, 2.5, 2.0];
/// ...and on all.
const RADII: [f32; 3] = [2.0, 1.5, 1.5];
/// Poses that came this close to each other (voxels, rad) are one.
const SAME: (f64, f64) = (0.5, 0.03);
/// Poses that tell what chance does.
const CHANCE_MAX: usize = 200;
/// Chance of a keypoint's confirmation under a right pose.
const CONFIRMED: f64 = 0.8;
/// What a contradiction takes from the surface's part of the score.
const CONTRADICTION_COST: f64 = 3.0;
/// Points of one wall are not independent: so many count as one.
const POINTS_PER_MEASUREMENT: f64 = 3.0;
/// What a keypoint with a match that agrees with the pose adds: under a wrong pose one in a hundred has one, under a right
/// one at least one in twenty.
const SUPPORT_GAIN: f64 = 3.0;
/// What it takes at first glance, in confirmed points.
const GLANCE_COST: f64 = 2.0;
/// Poses that differ by more than this distance (voxels) or angle (rad) rival each other.
const RIVAL: (f64, f64) = (4.0, 0.15);
/// Cosine of the largest angle between the normals of a match that agrees.
const SUPPORT_COS_MIN: f64 = 0.5;
/// How far a pose is slid, voxels.
const SLIDES: [f64; 4] = [-8.0, -4.0, 4.0, 8.0];
/// Reciprocal of a natural logarithm's base-10 one.
const LOG10: f64 = core::f64::consts::LOG10_E;

/// When an alignment is refused.
#[derive(Clone, Debug, PartialEq)]
pub struct RegisterConfig {
    /// The σ-consensus on mutual matches; its `sigma_max` is in frame units.
    pub solver: SolverConfig,
    /// Least score, nats. Measured: right poses of submaps that overlap by a quarter from 64 on, wrong ones up to 51.
    pub score_min: f64,
    /// Least share of the keypoints with a point of mine near. Submaps that overlap by less than a sixth fall below.
    pub fit_min: f64,
    /// Largest share of contradictions among what I can judge.
    pub contradiction_max: f64,
    /// A rival with this share of the score makes the answer ambiguous.
    pub rival_ratio: f64,
    /// Where the surfaces leave a direction (nearly) free: the pose may keep this share of its surfaces' score if slid
    /// that way, else the answer is ambiguous too.
    pub slid_max: f64,
    /// The refinement.
    pub refine: RefineConfig,
}

impl Default for RegisterConfig {
    fn default() -> Self {
        Self {
            solver: SolverConfig::default(),
            score_min: 60.0,
            fit_min: 0.2,
            contradiction_max: 0.06,
            rival_ratio: 0.8,
            slid_max: 0.6,
            refine: RefineConfig::default(),
        }
    }
}

/// An alignment that passed.
#[derive(Clone, Debug, PartialEq)]
pub struct Registered {
    /// Pose with covariance, and its residuals.
    pub refined: Refined,
    /// Keypoints with a match that agrees with the pose.
    pub support: f64,
    /// log₁₀ of the expected number of equally good poses by chance.
    pub log10_nfa: f64,
    /// Share of the keypoints with a point of mine near.
    pub fit: f64,
    /// Share of contradictions among what I could judge.
    pub contradiction: f64,
    /// Log-likelihood ratio against chance.
    pub score: f64,
}

/// Why there is no alignment.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum RegisterError {
    /// No pose passed.
    #[error("the best of {poses} poses has score {score:.0}, fit {fit:.2} and contradiction {contradiction:.2}")]
    NoConsensus {
        /// Poses looked at.
        poses: usize,
        /// Of the best one.
        score: f64,
        /// Of the best one.
        fit: f64,
        /// Of the best one.
        contradiction: f64,
    },
    /// Two different poses are about equally good.
    #[error("two poses with scores {score:.0} and {rival:.0}: the place looks like another")]
    Ambiguous {
        /// Of the better one.
        score: f64,
        /// Of the other.
        rival: f64,
    },
    /// The pose does not refine.
    #[error(transparent)]
    Refine(#[from] RefineError),
    /// A setting or coordinate is out of range.
    #[error(transparent)]
    Solver(#[from] AlignError),
}

/// A polished pose and what my submap says of it.
struct Judged {
    pose: Pose,
    confirmed: Vec<bool>,
    contradicted: usize,
    /// Matches that agree, one a keypoint.
    support: Vec<Pairing>,
    fit: f64,
    /// What the surfaces say, and all together.
    surface: f64,
    score: f64,
}

impl Judged {
    fn contradiction(&self) -> f64 {
        let confirmed = self.confirmed.iter().filter(|&&c| c).count();
        self.contradicted as f64 / (self.contradicted + confirmed).max(1) as f64
    }
}

/// Aligns their submap with mine.
///
/// # Errors
/// [`RegisterError`]: a refusal with its reason, or a solver setting out of range.
pub fn register(theirs: &Keypoints, mine: &Features, config: &RegisterConfig) -> Result<Registered, RegisterError> {
    let voxel = mine.voxel();
    let their_cloud = cloud(in_voxels(&theirs.0), theirs.voxel() / voxel);
    let my_cloud = cloud(in_voxels(&mine.block), 1.0);
    let my_points: Vec<Vector3<f64>> = my_cloud.points.iter().map(|p| p * voxel).collect();
    let pairings = pair_up(theirs, mine, &my_points);
    let matches = pairings.matches(theirs, &my_points);
    let problem = Problem {
        source: &matches.source,
        target: &matches.target,
        scores: Some(&matches.scores),
        ..Problem::default()
    };
    let consensus = align(&problem, &config.solver)?.ok();

    let mut poses = hypotheses(&their_cloud, &my_cloud, &pairings.all);
    if let Some(found) = &consensus {
        let pose = found.t_target_source.sim().to_se3();
        poses.insert(0, Pose { rotation: pose.rotation.matrix(), translation: pose.translation / voxel });
    }
    let court = Court::new(&their_cloud, &my_cloud, &pairings.all, Scene::new(mine), &poses);
    let judged = court.judge(&poses);
    let count = poses.len();
    let passes = |j: &&Judged| {
        j.score >= config.score_min && j.fit >= config.fit_min && j.contradiction() <= config.contradiction_max
    };
    let Some(best) = judged.iter().find(passes) else {
        let (score, fit, contradiction) =
            judged.first().map_or((0.0, 0.0, 0.0), |best| (best.score, best.fit, best.contradiction()));
        return Err(RegisterError::NoConsensus { poses: count, score, fit, contradiction });
    };
    let rival = judged.iter().filter(passes).find(|j| best.pose.differs(&j.pose, &court.middle, RIVAL.0, RIVAL.1));
    let rival = rival.map_or(0.0, |rival| rival.score);
    let ambiguous = RegisterError::Ambiguous { score: best.score, rival };
    if rival >= config.rival_ratio * best.score {
        return Err(ambiguous);
    }
    let anchors = best
        .support
        .iter()
        .map(|p| (their_cloud.points[p.their as usize] * voxel, my_cloud.points[p.my as usize] * voxel));
    let refined = refine_anchored(theirs, mine, &se3(&best.pose, voxel), &anchors.collect::<Vec<_>>(), &config.refine)?;
    // Along a corridor all poses are nearly as good, and the matches that seem to hold this one were chosen to.
    if refined.share < config.refine.share_min {
        let slid = court.slid(best);
        if slid > config.slid_max * best.surface {
            return Err(RegisterError::Ambiguous { score: best.surface, rival: slid });
        }
    }
    Ok(Registered {
        refined,
        support: best.support.len() as f64,
        log10_nfa: libm::log10(count as f64) - best.score * LOG10,
        fit: best.fit,
        contradiction: best.contradiction(),
        score: best.score,
    })
}

/// All that is needed to judge poses of one pair.
struct Court<'a> {
    theirs: &'a Cloud,
    mine: &'a Cloud,
    matches: &'a [Pairing],
    scene: Scene,
    /// Of their keypoints.
    middle: Vector3<f64>,
    /// Poses that tell what chance does, and what they confirm.
    chance: Vec<(Pose, Vec<bool>)>,
    /// By how many of them each point is confirmed.
    often: Vec<u32>,
}

impl<'a> Court<'a> {
    fn new(theirs: &'a Cloud, mine: &'a Cloud, matches: &'a [Pairing], scene: Scene, poses: &[Pose]) -> Self {
        let middle = theirs.points.iter().sum::<Vector3<f64>>() / theirs.points.len().max(1) as f64;
        let stride = poses.len().div_ceil(CHANCE_MAX).max(1);
        let confirms = |pose: &Pose| -> Vec<bool> {
            let placed = theirs.points.iter().zip(&theirs.normals);
            placed.map(|(p, n)| scene.confirms(&pose.apply(p), &(pose.rotation * n))).collect()
        };
        let chance: Vec<_> = poses.iter().step_by(stride).map(|pose| (*pose, confirms(pose))).collect();
        let often = often(theirs.points.len(), chance.iter().map(|(_, confirms)| confirms));
        Self { theirs, mine, matches, scene, middle, chance, often }
    }

    /// The most promising poses, polished and judged, best first.
    fn judge(&self, poses: &[Pose]) -> Vec<Judged> {
        let mut glanced: Vec<(f64, usize)> =
            (0..poses.len()).map(|k| (self.glance(&poses[k], 0..GLANCED), k)).collect();
        most(&mut glanced, GLANCED_AGAIN);
        glanced.iter_mut().for_each(|(value, k)| *value += self.glance(&poses[*k], GLANCED..ROUGH));
        most(&mut glanced, POLISHED_MAX);
        let mut distinct: Vec<Pose> = Vec::new();
        for (_, k) in glanced {
            let pose = self.polish(poses[k], ROUGH, &RADII_ROUGH);
            if distinct.iter().all(|other| pose.differs(other, &self.middle, SAME.0, SAME.1)) {
                distinct.push(pose);
            }
        }
        let all = self.theirs.points.len();
        let look = |pose| self.close_look(self.polish(pose, all, &RADII));
        let mut judged: Vec<Judged> = distinct.into_iter().map(look).collect();
        judged.sort_by(|a, b| b.score.total_cmp(&a.score));
        judged
    }

    /// Confirmed points of some, less contradicted ones.
    fn glance(&self, pose: &Pose, some: Range<usize>) -> f64 {
        let first = self.theirs.points.iter().zip(&self.theirs.normals).enumerate().take(some.end).skip(some.start);
        let count = self.chance.len() as f64;
        let value = |(k, (p, n)): (usize, (&Vector3<f64>, &Vector3<f64>))| match self
            .scene
            .glance(&pose.apply(p), &(pose.rotation * n))
        {
            Verdict::Confirmed => 1.0 - f64::from(self.often[k]) / count,
            Verdict::Contradicted => -GLANCE_COST,
            Verdict::Unknown => 0.0,
        };
        first.map(value).sum()
    }

    /// Point-to-plane steps on the first keypoints.
    fn polish(&self, mut pose: Pose, first: usize, radii: &[f32]) -> Pose {
        let mut rows = Vec::with_capacity(first);
        for &radius in radii {
            rows.clear();
            for (p, n) in self.theirs.points.iter().zip(&self.theirs.normals).take(first) {
                let at = pose.apply(p);
                if let Some((point, normal)) = self.scene.counterpart(&at, &(pose.rotation * n), radius) {
                    rows.push((at, normal, normal.dot(&(at - point))));
                }
            }
            let Some(step) = plane_step(&rows) else { return pose };
            pose = Pose { rotation: step.rotation * pose.rotation, translation: step.apply(&pose.translation) };
        }
        pose
    }

    fn close_look(&self, pose: Pose) -> Judged {
        let support = self.support(&pose);
        let mut judged =
            Judged { pose, confirmed: Vec::new(), contradicted: 0, support, fit: 0.0, surface: 0.0, score: 0.0 };
        let mut hits = 0;
        for (p, n) in self.theirs.points.iter().zip(&self.theirs.normals) {
            let (verdict, hit) = self.scene.judge(&pose.apply(p), &(pose.rotation * n));
            judged.confirmed.push(verdict == Verdict::Confirmed);
            judged.contradicted += usize::from(verdict == Verdict::Contradicted);
            hits += usize::from(hit);
        }
        judged.fit = f64::from(hits as u32) / self.theirs.points.len().max(1) as f64;
        let differs = |(other, _): &&(Pose, Vec<bool>)| pose.differs(other, &self.middle, RIVAL.0, RIVAL.1);
        let others: Vec<&Vec<bool>> = self.chance.iter().filter(differs).map(|(_, confirms)| confirms).collect();
        let often = often(judged.confirmed.len(), others.iter().copied());
        let weight =
            |k: usize| libm::log(CONFIRMED * (others.len() as f64 + 4.0) / (f64::from(often[k]) + 1.0)).max(0.0);
        let confirmed = judged.confirmed.iter().enumerate().filter(|(_, c)| **c);
        let surface = confirmed.map(|(k, _)| weight(k)).sum::<f64>() - CONTRADICTION_COST * judged.contradicted as f64;
        judged.surface = surface / POINTS_PER_MEASUREMENT;
        judged.score = surface / POINTS_PER_MEASUREMENT + SUPPORT_GAIN * judged.support.len() as f64;
        judged
    }
}

impl Court<'_> {
    /// The best score of the surfaces if the pose is slid along the direction that fewest of them face.
    fn slid(&self, best: &Judged) -> f64 {
        let faces = best.confirmed.iter().zip(&self.theirs.normals).filter(|(confirmed, _)| **confirmed);
        let spread: Matrix3<f64> = faces.map(|(_, n)| best.pose.rotation * n).map(|n| n * n.transpose()).sum();
        let upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].map(|at| spread[at]);
        let Some((axis, _)) = least_axis(&upper) else { return 0.0 };
        let surface = |by: &f64| {
            let translation = best.pose.translation + axis * *by;
            self.close_look(Pose { translation, ..best.pose }).surface
        };
        SLIDES.iter().map(surface).fold(0.0, f64::max)
    }

    /// Matches that agree with the pose, one a keypoint.
    fn support(&self, pose: &Pose) -> Vec<Pairing> {
        let agrees = |p: &&Pairing| {
            let (t, m) = (p.their as usize, p.my as usize);
            (pose.apply(&self.theirs.points[t]) - self.mine.points[m]).norm() <= f64::from(NEAR)
                && (pose.rotation * self.theirs.normals[t]).dot(&self.mine.normals[m]) >= SUPPORT_COS_MIN
        };
        let mut support: Vec<Pairing> = self.matches.iter().filter(agrees).copied().collect();
        support.dedup_by_key(|p| p.their);
        support
    }
}

/// The `count` of the highest value, falling.
fn most(values: &mut Vec<(f64, usize)>, count: usize) {
    values.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    values.truncate(count);
}

/// By how many poses each of `count` points is confirmed.
fn often<'a>(count: usize, poses: impl Iterator<Item = &'a Vec<bool>>) -> Vec<u32> {
    let mut often = vec![0; count];
    for confirms in poses {
        often.iter_mut().zip(confirms).for_each(|(often, &confirmed)| *often += u32::from(confirmed));
    }
    often
}

/// A robust Gauss–Newton step on (point, plane normal, distance) rows; `None` where they are too few.
fn plane_step(rows: &[(Vector3<f64>, Vector3<f64>, f64)]) -> Option<Pose> {
    const ROWS_MIN: usize = 12;
    const SIGMA_MIN: f64 = 0.05;
    const CAUCHY: f64 = 2.385;
    const LEVER: f64 = 10.0;
    if rows.len() < ROWS_MIN {
        return None;
    }
    let mut sizes: Vec<f64> = rows.iter().map(|r| r.2.abs()).collect();
    let middle = sizes.len() / 2;
    let sigma = (1.4826 * *sizes.select_nth_unstable_by(middle, f64::total_cmp).1).max(SIGMA_MIN);
    let centre = rows.iter().map(|r| r.0).sum::<Vector3<f64>>() / rows.len() as f64;
    let (mut h, mut g) = (Matrix6::zeros(), Vector6::zeros());
    for (at, n, e) in rows {
        let turn = (at - centre).cross(n) / LEVER;
        let j = Vector6::new(n.x, n.y, n.z, turn.x, turn.y, turn.z);
        let x = e / (CAUCHY * sigma);
        let w = 1.0 / (1.0 + x * x);
        h += j * j.transpose() * w;
        g += j * (w * e);
    }
    // A trace of damping keeps a free direction still.
    let step = -(h + Matrix6::identity() * (1e-3 * rows.len() as f64)).cholesky()?.solve(&g);
    let rotation = So3::exp(&(Vector3::new(step[3], step[4], step[5]) / LEVER)).matrix();
    Some(Pose { rotation, translation: centre - rotation * centre + Vector3::new(step[0], step[1], step[2]) })
}

fn cloud((points, normals): (Vec<[f32; 3]>, Vec<[f32; 3]>), scale: f64) -> Cloud {
    let double = |v: [f32; 3]| Vector3::from(v.map(f64::from));
    Cloud {
        points: points.into_iter().map(|p| double(p) * scale).collect(),
        normals: normals.into_iter().map(double).collect(),
    }
}

/// The pose in frame units.
fn se3(pose: &Pose, voxel: f64) -> Se3 {
    Se3::new(So3::from_matrix(&pose.rotation), pose.translation * voxel)
}

#[cfg(test)]
#[path = "register_tests.rs"]
mod tests;

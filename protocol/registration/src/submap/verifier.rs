//! The judgement of poses of one pair of submaps: which of many is worth a closer look, what my surfaces and my views
//! say of it, and what they would say of others ([`register`](super::register) holds the definition of the score).
//! Lengths are in voxels.

use super::matching::Pairing;
use super::robust::cauchy_weight;
use super::scene::{Cloud, NEAR, Pose, Scene, Verdict};
use super::surface::least_axis;
use crate::geometry::So3;
use core::ops::Range;
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use std::collections::BTreeSet;

/// Keypoints that a pose is first judged by: an even cover...
const COARSE: usize = 32;
/// ...and, if it is among the first so many...
const GLANCED_AGAIN: usize = 400;
/// ...keypoints that it is judged by once more.
const ROUGH: usize = 96;
/// Poses that are polished.
const POLISHED_MAX: usize = 60;
/// Poses that are judged by all keypoints.
const JUDGED_MAX: usize = 24;
/// Poses at most of the neighbourhood of one that is polished.
const ALIKE_MAX: usize = 8;
/// Search radii while polishing on the first [`ROUGH`] keypoints, voxels...
const RADII_ROUGH: [f32; 3] = [3.0, 2.5, 2.0];
/// ...and on all.
const RADII: [f32; 3] = [2.0, 1.5, 1.5];
/// Poses that came this close to each other (voxels, rad) are one.
const SAME: (f64, f64) = (0.5, 0.03);
/// Poses that tell what chance does.
const CHANCE_MAX: usize = 200;
/// Where few poses are suggested, or all are one, the first one put elsewhere (voxels) tells what chance does, too: on
/// open ground it fits there as well.
const WITNESSES: [[f64; 3]; 12] = [
    [16.0, 0.0, 0.0],
    [-16.0, 0.0, 0.0],
    [0.0, 16.0, 0.0],
    [0.0, -16.0, 0.0],
    [0.0, 0.0, 16.0],
    [0.0, 0.0, -16.0],
    [8.0, 8.0, 0.0],
    [-8.0, 8.0, 0.0],
    [8.0, 0.0, 8.0],
    [-8.0, 0.0, 8.0],
    [0.0, 8.0, 8.0],
    [0.0, -8.0, 8.0],
];
/// Chance of a keypoint's confirmation under a right pose.
const CONFIRMED: f64 = 0.8;
/// What a contradiction takes from the surface's part of the score.
const CONTRADICTION_COST: f64 = 3.0;
/// Points of one wall are not independent: so many count as one.
const POINTS_PER_MEASUREMENT: f64 = 3.0;
/// What a keypoint with a match that agrees with the pose adds: under a wrong pose one in a hundred has one, under a
/// right one at least one in twenty.
const SUPPORT_GAIN: f64 = 3.0;
/// The coarse score that a pose needs, in confirmed points.
const GLANCE_COST: f64 = 2.0;
/// Poses that differ by more than this distance (voxels) or angle (rad) rival each other.
const RIVAL: (f64, f64) = (4.0, 0.15);
/// Cosine of the largest angle between the normals of a match that agrees.
const SUPPORT_COS_MIN: f64 = 0.5;
/// How far a pose is slid, voxels...
const SLIDES: [f64; 4] = [-8.0, -4.0, 4.0, 8.0];
/// ...and turned, rad.
const TURNS: [f64; 4] = [-0.3, -0.15, 0.15, 0.3];

/// A polished pose and what my submap says of it.
pub struct Judged {
    /// The pose.
    pub pose: Pose,
    confirmed: Vec<bool>,
    contradicted: usize,
    /// Matches that agree, one a keypoint and one a feature.
    pub support: Vec<Pairing>,
    /// Share of the keypoints with a point of mine near.
    pub fit: f64,
    /// What the surfaces say...
    pub surface: f64,
    /// ...and all together.
    pub score: f64,
}

impl Judged {
    /// Share of contradictions among what I can judge.
    pub fn contradiction(&self) -> f64 {
        self.contradicted as f64 / (self.contradicted + self.confirmed()).max(1) as f64
    }

    /// Number of points that lie on my surface.
    pub fn confirmed(&self) -> usize {
        self.confirmed.iter().filter(|&&c| c).count()
    }
}

/// All that is needed to judge poses of one pair.
pub struct PoseVerifier<'a> {
    theirs: &'a Cloud,
    mine: &'a Cloud,
    matches: &'a [Pairing],
    scene: &'a Scene,
    /// Of their keypoints.
    middle: Vector3<f64>,
    /// Poses that tell what chance does, and what they confirm.
    chance: Vec<(Pose, Vec<bool>)>,
    /// By how many of them each point is confirmed.
    often: Vec<u32>,
}

impl<'a> PoseVerifier<'a> {
    /// About to judge `poses`, each of which tells what chance does to the others.
    pub fn new(theirs: &'a Cloud, mine: &'a Cloud, matches: &'a [Pairing], scene: &'a Scene, poses: &[Pose]) -> Self {
        let middle = theirs.points.iter().sum::<Vector3<f64>>() / theirs.points.len().max(1) as f64;
        let stride = poses.len().div_ceil(CHANCE_MAX).max(1);
        let confirms = |pose: &Pose| -> Vec<bool> {
            let placed = theirs.points.iter().zip(&theirs.normals);
            placed.map(|(p, n)| scene.confirms(&pose.apply(p), &(pose.rotation * n))).collect()
        };
        let shifted = poses.first().into_iter().flat_map(|pose| WITNESSES.map(|by| shifted(pose, by)));
        let witnesses = poses.iter().step_by(stride).copied().chain(shifted);
        let chance: Vec<_> = witnesses.map(|pose| (pose, confirms(&pose))).collect();
        let often = often(theirs.points.len(), chance.iter().map(|(_, confirms)| confirms));
        Self { theirs, mine, matches, scene, middle, chance, often }
    }

    /// The most promising poses, polished and judged, best first.
    pub fn judge(&self, poses: &[Pose]) -> Vec<Judged> {
        let mut judged = self.judge_with(self.matches, poses, |_| true);
        judged.sort_by(|a, b| b.score.total_cmp(&a.score));
        judged
    }

    /// Of the poses the most promising ones that `may_be`, polished and judged with other matches.
    pub fn judge_with(&self, matches: &[Pairing], poses: &[Pose], may_be: impl Fn(&Pose) -> bool) -> Vec<Judged> {
        let promising = self.promising(poses).into_iter().filter(may_be).take(JUDGED_MAX);
        promising.map(|pose| self.look(&pose, matches)).collect()
    }

    /// The poses of the best coarse scores, polished a little, best first.
    fn promising(&self, poses: &[Pose]) -> Vec<Pose> {
        let mut coarse: Vec<(f64, usize)> =
            (0..poses.len()).map(|k| (self.coarse_score(&poses[k], 0..COARSE), k)).collect();
        most(&mut coarse, GLANCED_AGAIN);
        coarse.iter_mut().for_each(|(value, k)| *value += self.coarse_score(&poses[*k], COARSE..ROUGH));
        most(&mut coarse, GLANCED_AGAIN);
        let mut distinct: Vec<Pose> = Vec::new();
        for k in self.varied(poses, &coarse) {
            let pose = self.polish(poses[k], ROUGH, &RADII_ROUGH);
            if distinct.iter().all(|other| pose.differs(other, &self.middle, SAME.0, SAME.1)) {
                distinct.push(pose);
            }
        }
        let mut distinct: Vec<(f64, Pose)> =
            distinct.into_iter().map(|pose| (self.coarse_score(&pose, 0..ROUGH), pose)).collect();
        distinct.sort_by(|a, b| b.0.total_cmp(&a.0));
        distinct.into_iter().map(|(_, pose)| pose).collect()
    }

    /// The pose polished on all keypoints and looked at closely.
    fn look(&self, pose: &Pose, matches: &[Pairing]) -> Judged {
        self.close_look(self.polish(*pose, self.theirs.points.len(), &RADII), matches)
    }

    /// The first [`POLISHED_MAX`] of those with a coarse score, but of poses near one of them only [`ALIKE_MAX`]: the
    /// rest of a good one's neighbourhood must not crowd out its rivals.
    fn varied(&self, poses: &[Pose], coarse: &[(f64, usize)]) -> Vec<usize> {
        let mut chosen: Vec<usize> = Vec::new();
        for &(_, k) in coarse {
            let alike = chosen.iter().filter(|&&c| !self.rivals(&poses[k], &poses[c])).count();
            if alike < ALIKE_MAX {
                chosen.push(k);
            }
            if chosen.len() == POLISHED_MAX {
                break;
            }
        }
        chosen
    }

    /// Whether two poses differ so much that at most one of them is right.
    pub fn rivals(&self, a: &Pose, b: &Pose) -> bool {
        self.differ(a, b, RIVAL.0, RIVAL.1)
    }

    /// Whether two poses put their middle farther apart than `distance` (voxels) or turn it by more than `angle` (rad).
    pub fn differ(&self, a: &Pose, b: &Pose, distance: f64, angle: f64) -> bool {
        a.differs(b, &self.middle, distance, angle)
    }

    /// Confirmed points of some, less contradicted ones.
    fn coarse_score(&self, pose: &Pose, some: Range<usize>) -> f64 {
        let first = self.theirs.points.iter().zip(&self.theirs.normals).enumerate().take(some.end).skip(some.start);
        let count = self.chance.len() as f64;
        let value = |(k, (p, n)): (usize, (&Vector3<f64>, &Vector3<f64>))| match self
            .scene
            .coarse_score(&pose.apply(p), &(pose.rotation * n))
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

    fn close_look(&self, pose: Pose, matches: &[Pairing]) -> Judged {
        let support = self.support(&pose, matches);
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
        let differs = |(other, _): &&(Pose, Vec<bool>)| self.rivals(&pose, other);
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

impl PoseVerifier<'_> {
    /// The best score of the surfaces if the pose is slid along the direction that fewest of them face, or turned about
    /// their middle: what may be done to it unpunished is not known. All of it where they face one way only.
    pub fn slid(&self, best: &Judged) -> f64 {
        let spread = self.faces(best);
        let upper = [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)].map(|at| spread[at]);
        let Some((axis, _)) = least_axis(&upper) else { return best.surface };
        let placed = best.confirmed.iter().zip(&self.theirs.points).filter(|(confirmed, _)| **confirmed);
        let (sum, count) = placed.fold((Vector3::zeros(), 0.0), |(sum, count), (_, p)| (sum + p, count + 1.0));
        let middle = best.pose.apply(&(sum / f64::max(count, 1.0)));
        let slides = SLIDES.iter().map(|by| shifted(&best.pose, (axis * *by).into()));
        let turns = TURNS.iter().flat_map(|by| {
            [Vector3::x(), Vector3::y(), Vector3::z()].map(|axis| turned(&best.pose, &middle, &(axis * *by)))
        });
        slides.chain(turns).map(|pose| self.close_look(pose, self.matches).surface).fold(0.0, f64::max)
    }

    /// Of the points that confirm a pose, the share that faces the direction which fewest do: a third at best, nothing
    /// on a plane.
    pub fn least_facing(&self, judged: &Judged) -> f64 {
        let spread = self.faces(judged);
        spread.symmetric_eigenvalues().min() / spread.trace().max(1.0)
    }

    /// Which ways the points that confirm a pose face: the sum of n nᵀ, in my frame.
    fn faces(&self, judged: &Judged) -> Matrix3<f64> {
        let confirmed = judged.confirmed.iter().zip(&self.theirs.normals).filter(|(confirmed, _)| **confirmed);
        confirmed.map(|(_, n)| judged.pose.rotation * n).map(|n| n * n.transpose()).sum()
    }

    /// Matches that agree with the pose: one a keypoint, and one a feature of mine.
    fn support(&self, pose: &Pose, matches: &[Pairing]) -> Vec<Pairing> {
        let agrees = |p: &&Pairing| {
            let (t, m) = (p.their as usize, p.my as usize);
            (pose.apply(&self.theirs.points[t]) - self.mine.points[m]).norm() <= f64::from(NEAR)
                && (pose.rotation * self.theirs.normals[t]).dot(&self.mine.normals[m]) >= SUPPORT_COS_MIN
        };
        let mut support: Vec<Pairing> = matches.iter().filter(agrees).copied().collect();
        support.dedup_by_key(|p| p.their);
        let mut named = BTreeSet::new();
        support.retain(|p| named.insert(p.my));
        support
    }
}

fn shifted(pose: &Pose, by: [f64; 3]) -> Pose {
    Pose { translation: pose.translation + Vector3::from(by), ..*pose }
}

/// The pose turned by a rotation vector about a place in my frame.
fn turned(pose: &Pose, about: &Vector3<f64>, by: &Vector3<f64>) -> Pose {
    let turn = So3::exp(by).matrix();
    Pose { rotation: turn * pose.rotation, translation: about + turn * (pose.translation - about) }
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
        let w = cauchy_weight(*e, sigma);
        h += j * j.transpose() * w;
        g += j * (w * e);
    }
    // A trace of damping keeps a free direction still.
    let step = -(h + Matrix6::identity() * (1e-3 * rows.len() as f64)).cholesky()?.solve(&g);
    let rotation = So3::exp(&(Vector3::new(step[3], step[4], step[5]) / LEVER)).matrix();
    Some(Pose { rotation, translation: centre - rotation * centre + Vector3::new(step[0], step[1], step[2]) })
}

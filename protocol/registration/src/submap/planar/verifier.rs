//! What my submap says of poses: how many of their keypoints lie on my walls, how surprising that is, and how many
//! would stand where my beams passed. As in space ([`register`](super::super::register)): a keypoint that every other
//! pose of this pair confirms, too, such as one on the long wall of a corridor, weighs nothing; a door frame weighs
//! much.

use super::super::near::Near;
use super::codec::Codec;
use super::fit::{Walls, counterpart, system};
use super::se2::Se2;
use nalgebra::{Matrix3, Vector2};

/// A keypoint lies on my wall if a point of mine is this near...
const NEAR: f64 = 2.0;
/// ...faces the same way (cosine)...
const FACING: f64 = 0.8;
/// ...and its line passes this near.
const ASIDE: f64 = 1.0;
/// Chance of a keypoint's confirmation under a right pose.
const CONFIRMED: f64 = 0.8;
/// What a contradiction takes from the score, nats.
const CONTRADICTION_COST: f64 = 3.0;
/// Points of one wall are not independent: so many count as one.
const POINTS_PER_MEASUREMENT: f64 = 3.0;
/// Poses that differ by more than this distance or angle (rad) rival each other.
const RIVAL: (f64, f64) = (6.0, 0.15);
/// Poses that came this close to each other are one.
const SAME: (f64, f64) = (1.5, 0.03);
/// Search radii while polishing.
const RADII: [f64; 7] = [6.0, 5.0, 4.0, 3.0, 2.5, 2.0, 2.0];
/// Cosine of the largest angle between the normals of a pair.
pub const ALIKE: f64 = 0.7;
/// Damping of a free direction, in pairs.
const DAMPING: f64 = 1e-3;
/// Pairs without which a pose is not polished.
const PAIRS_MIN: usize = 10;

/// A polished pose and what my submap says of it.
pub struct Judged {
    /// `t_mine_theirs`.
    pub pose: Se2,
    confirmed: Vec<bool>,
    /// Keypoints on my walls...
    pub hits: usize,
    /// ...and in my free space, and points of mine in theirs.
    pub contradicted: usize,
    /// Log-likelihood ratio against chance, nats.
    pub score: f64,
}

impl Judged {
    /// Share of contradictions among what I can judge.
    pub fn contradiction(&self) -> f64 {
        self.contradicted as f64 / (self.contradicted + self.hits).max(1) as f64
    }

    /// Share of the keypoints that lie on my walls.
    pub fn fit(&self) -> f64 {
        self.hits as f64 / self.confirmed.len().max(1) as f64
    }
}

/// All that is needed to judge poses of one pair.
pub struct PoseVerifier<'a> {
    /// Their keypoints...
    pub theirs: &'a Walls,
    /// ...the middle of them...
    pub middle: Vector2<f64>,
    /// ...and what their beams passed through.
    pub their_chart: &'a Codec,
    /// My walls...
    pub near: &'a Near,
    /// ...about as many points of them as they have keypoints...
    pub mine: &'a [Vector2<f64>],
    /// ...and what my beams passed through.
    pub chart: &'a Codec,
}

impl PoseVerifier<'_> {
    /// The poses, polished and judged by one another, best first.
    pub fn judge(&self, poses: &[Se2]) -> Vec<Judged> {
        let mut judged: Vec<Judged> = Vec::new();
        for pose in poses {
            let pose = self.polished(*pose);
            if judged.iter().all(|other| pose.differs(&other.pose, &self.middle, SAME.0, SAME.1)) {
                judged.push(self.look(pose));
            }
        }
        let scores: Vec<f64> = judged.iter().map(|one| self.score(one, &judged)).collect();
        judged.iter_mut().zip(scores).for_each(|(one, score)| one.score = score);
        judged.sort_by(|a, b| b.score.total_cmp(&a.score));
        judged
    }

    /// Whether at most one of two poses is right.
    pub fn rivals(&self, a: &Se2, b: &Se2) -> bool {
        a.differs(b, &self.middle, RIVAL.0, RIVAL.1)
    }

    fn polished(&self, mut pose: Se2) -> Se2 {
        for radius in RADII {
            let system = system(self.theirs, self.near, &pose, radius, ALIKE);
            if system.pairs < PAIRS_MIN {
                break;
            }
            let lever = self.middle.norm() + 1.0;
            let damping = Matrix3::from_diagonal(&[1.0, 1.0, lever * lever].into()) * (DAMPING * system.pairs as f64);
            let Some(solver) = (system.h + damping).cholesky() else { break };
            pose = pose.retract(&-solver.solve(&system.g));
        }
        pose
    }

    fn look(&self, pose: Se2) -> Judged {
        let mut judged = Judged { pose, confirmed: Vec::new(), hits: 0, contradicted: 0, score: 0.0 };
        for (p, n) in self.theirs.points.iter().zip(&self.theirs.normals) {
            let (at, facing) = (pose.apply(p), pose.turn(n));
            let lies = counterpart(self.near, &at, &facing, NEAR, FACING).is_some_and(|mine| {
                let aside = at - Vector2::new(f64::from(mine.point[0]), f64::from(mine.point[1]));
                let normal = Vector2::new(f64::from(mine.normal[0]), f64::from(mine.normal[1]));
                aside.dot(&normal).abs() <= ASIDE
            });
            judged.confirmed.push(lies);
            judged.hits += usize::from(lies);
            judged.contradicted += usize::from(!lies && self.chart.is_free(&at));
        }
        let back = pose.inverse();
        judged.contradicted += self.mine.iter().filter(|p| self.their_chart.is_free(&back.apply(p))).count();
        judged
    }

    fn score(&self, one: &Judged, all: &[Judged]) -> f64 {
        let others: Vec<&Judged> = all.iter().filter(|other| self.rivals(&one.pose, &other.pose)).collect();
        let weight = |k: usize| {
            let often = others.iter().filter(|other| other.confirmed[k]).count() as f64;
            libm::log(CONFIRMED * (others.len() as f64 + 4.0) / (often + 1.0)).max(0.0)
        };
        let surprise: f64 = one.confirmed.iter().enumerate().filter(|(_, c)| **c).map(|(k, _)| weight(k)).sum();
        (surprise - CONTRADICTION_COST * one.contradicted as f64) / POINTS_PER_MEASUREMENT
    }
}

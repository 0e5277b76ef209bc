//! From a peer's keypoints to an alignment or a refusal: matches → σ-consensus → poses → judgement → refinement.
//!
//! Where submaps overlap by a third, three to ten of their keypoints have a right match among a thousand wrong ones: no
//! count of matches tells that from chance (MATH §4). But a pose can be *looked at*: of their points, so many would lie
//! on my surface and none where I saw air. So the consensus' pose, if there is one, joins the poses that few matches
//! suggest (`hypotheses`); the most promising are judged by all keypoints (`verifier`).
//!
//! **Score.** A confirmed point weighs ln(q/f): q is its chance under a right pose and f how often it is confirmed
//! under the *other* poses of this very pair, so that ground on ground, which fits anywhere, weighs nothing. A
//! contradicted point costs `CONTRADICTION_COST`, a match that agrees gains `SUPPORT_GAIN`.
//!
//! **Acceptance.** Score, share of keypoints near my surface, share of contradictions; and no other pose with nearly
//! the same score that would itself pass, nor one elsewhere that nothing contradicts (`lookalike`), else the answer is
//! *ambiguous*.

use super::aliasing;
use super::features::{Features, Keypoints, in_voxels};
use super::gravity::{Upright, Verticals};
use super::hypotheses::{POSES_MAX, hypotheses};
use super::matching::pair_up;
use super::refine::{RefineConfig, RefineError, Refined, refine_anchored};
use super::scene::{Cloud, Pose, Scene};
use super::summary::VOXEL_RATIO_MAX;
use super::verifier::{Judged, PoseVerifier};
use crate::align::{AlignError, Problem, SolverConfig, align};
use crate::geometry::{Se3, So3};
use nalgebra::Vector3;
use std::collections::BTreeSet;
use thiserror::Error;

/// From natural to base-10 logarithms.
const LOG10: f64 = core::f64::consts::LOG10_E;

/// Largest standard deviation of a rotation, rad: a covariance speaks of the neighbourhood in which rotations add up.
const ROTATION_SIGMA_MAX: f64 = 0.25;
/// Share of keypoints that may lie in one half-voxel cell with another: of a thinned cloud's hardly any do.
const CROWDED_MAX: f64 = 0.1;

/// A rival that puts the middle of their keypoints so far from where the best pose does, voxels, sees another place;
/// nearer, the same place turned about, or slid along.
const ELSEWHERE: f64 = 16.0;

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
    /// Which way is up, if both submaps know: poses that tilt one against the other are not looked at.
    pub verticals: Option<Verticals>,
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
            verticals: None,
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
    /// The pose tilts one submap's vertical against the other's.
    #[error("the pose tilts by {tilt:.3} rad what both submaps know to be upright to within {tilt_max:.3}")]
    Tilted {
        /// By how much, rad.
        tilt: f64,
        /// What would have passed.
        tilt_max: f64,
    },
    /// Two different poses are about equally good.
    #[error("two poses with scores {score:.0} and {rival:.0}: the place looks like another")]
    Ambiguous {
        /// Of the better one.
        score: f64,
        /// Of the other.
        rival: f64,
        /// The other one sees another place, not the same one otherwise.
        elsewhere: bool,
    },
    /// Nothing speaks against another pose that is far from the best one.
    #[error(
        "{support} matches support one pose, {rival} another, far from it, that nothing contradicts: the place looks like \
         another"
    )]
    Aliased {
        /// Matches that agree with the best pose.
        support: usize,
        /// Of those with what lies elsewhere, those that agree with the other.
        rival: usize,
        /// The other one sees another place, not the same one otherwise.
        elsewhere: bool,
    },
    /// The two clouds were thinned so differently that they show different things.
    #[error("their cloud is thinned to {ratio:.3} times my voxel; set submap.voxel_m alike on all robots")]
    Thinning {
        /// Their voxel over mine.
        ratio: f64,
    },
    /// Keypoints of a thinned cloud lie apart.
    #[error(
        "{share:.2} of their keypoints lie where another one does: are their points in millimetres where metres are \
         wanted? So far off they are told apart too coarsely. If not, their describer is faulty"
    )]
    Crowded {
        /// Share of those that share a place.
        share: f64,
    },
    /// One submap is planar, the other one is not.
    #[error("a planar submap cannot be compared with one in space; set submap.sensor alike on all robots")]
    NotPlanar,
    /// The pose does not refine.
    #[error(transparent)]
    Refine(#[from] RefineError),
    /// A setting or coordinate is out of range.
    #[error(transparent)]
    Solver(#[from] AlignError),
}

/// Aligns their submap with mine.
///
/// # Errors
/// [`RegisterError`]: a refusal with its reason, or a solver setting out of range.
pub fn register(theirs: &Keypoints, mine: &Features, config: &RegisterConfig) -> Result<Registered, RegisterError> {
    check_comparable(theirs, mine)?;
    let voxel = mine.voxel();
    let their_cloud = cloud(in_voxels(&theirs.block), theirs.voxel() / voxel);
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

    let mut poses = hypotheses(&their_cloud, &my_cloud, &pairings.all, POSES_MAX);
    if let Some(found) = &consensus {
        let pose = found.t_target_source.sim().to_se3();
        poses.insert(0, Pose { rotation: pose.rotation.matrix(), translation: pose.translation / voxel });
    }
    // The others still tell what chance does.
    let upright = Upright(config.verticals);
    let scene = Scene::new(mine);
    let verifier = PoseVerifier::new(&their_cloud, &my_cloud, &pairings.all, &scene, &poses);
    poses.retain(|pose| upright.allows_rough(pose));
    let count = poses.len();
    let mut judged = verifier.judge(&poses);
    judged.retain(|j| upright.allows(&j.pose));
    let passes = |j: &&Judged| {
        j.score >= config.score_min && j.fit >= config.fit_min && j.contradiction() <= config.contradiction_max
    };
    let Some(best) = judged.iter().find(passes) else {
        let (score, fit, contradiction) =
            judged.first().map_or((0.0, 0.0, 0.0), |best| (best.score, best.fit, best.contradiction()));
        return Err(RegisterError::NoConsensus { poses: count, score, fit, contradiction });
    };
    // A rival need not pass itself: it is enough that it is credible.
    let credible = |j: &&Judged| j.fit >= config.fit_min && j.contradiction() <= 2.0 * config.contradiction_max;
    let rival = judged.iter().filter(credible).find(|j| verifier.rivals(&best.pose, &j.pose));
    let is_elsewhere = |rival: &Judged| verifier.differ(&rival.pose, &best.pose, ELSEWHERE, f64::INFINITY);
    if let Some(rival) = rival.filter(|rival| rival.score >= config.rival_ratio * best.score) {
        let elsewhere = is_elsewhere(rival);
        return Err(RegisterError::Ambiguous { score: best.score, rival: rival.score, elsewhere });
    }
    let clouds = (&their_cloud, &my_cloud);
    if let Some(rival) = aliasing::rival(&pairings, (mine, &my_points), clouds, &verifier, best, &upright) {
        let elsewhere = is_elsewhere(&rival);
        return Err(RegisterError::Aliased { support: best.support.len(), rival: rival.support.len(), elsewhere });
    }
    let anchors = best
        .support
        .iter()
        .map(|p| (their_cloud.points[p.their as usize] * voxel, my_cloud.points[p.my as usize] * voxel));
    let refined = refine_anchored(theirs, mine, &se3(&best.pose, voxel), &anchors.collect::<Vec<_>>(), &config.refine)?;
    let turn = refined.pose.covariance.matrix().fixed_view::<3, 3>(3, 3).symmetric_eigenvalues().max();
    if turn > ROTATION_SIGMA_MAX * ROTATION_SIGMA_MAX {
        return Err(RefineError::Degenerate { share: refined.share }.into());
    }
    if let Some(known) = &config.verticals {
        let (tilt, tilt_max) = (known.tilt(&refined.pose.pose.rotation.matrix()), known.tilt_max(turn.sqrt()));
        if tilt > tilt_max {
            return Err(RegisterError::Tilted { tilt, tilt_max });
        }
    }
    // Along a corridor all poses are nearly as good, and the matches that seem to hold this one were chosen to.
    if refined.share < config.refine.share_min {
        let slid = verifier.slid(best);
        if slid > config.slid_max * best.surface {
            return Err(RegisterError::Ambiguous { score: best.surface, rival: slid, elsewhere: false });
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

/// Refuses keypoints of another thinning than mine, and those that are not thinned at all.
pub(super) fn check_comparable(theirs: &Keypoints, mine: &Features) -> Result<(), RegisterError> {
    let ratio = theirs.voxel() / mine.voxel();
    if !(1.0 / VOXEL_RATIO_MAX..=VOXEL_RATIO_MAX).contains(&ratio) {
        return Err(RegisterError::Thinning { ratio });
    }
    let share = crowded(theirs);
    if share > CROWDED_MAX { Err(RegisterError::Crowded { share }) } else { Ok(()) }
}

/// Share of the keypoints in a half-voxel cell with another.
fn crowded(theirs: &Keypoints) -> f64 {
    let cell = 0.5 * theirs.voxel();
    let cells: BTreeSet<[i64; 3]> =
        theirs.surfels().iter().map(|s| [0, 1, 2].map(|k| (s.position[k] / cell).floor() as i64)).collect();
    1.0 - cells.len() as f64 / theirs.len().max(1) as f64
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

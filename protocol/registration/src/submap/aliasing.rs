//! Whether a place looks like another: a pose is right only if its rivals are wrong, and these must be looked for.
//! Among shelves or rooms that are all the same, the matches that agree with the best pose leave none for the next
//! shelf: each keypoint's nearest features are where the robots stood alike. So once a pose would be accepted, each
//! keypoint is matched again with those of its nearest features that lie *elsewhere*, and the poses that these matches
//! suggest, with those that the surfaces do (`shifts`), are polished and looked at like the first ones; what slides
//! back to the best pose takes no other's place. Chance was learned before: a rival need not score.
//!
//! A rival covers less of my submap than the best pose, since robots see best what is near, and so scores less: that
//! says nothing. It stands unless my views contradict it, if enough of their points and matches agree with it, and what
//! they agree with faces all ways: on a floor or along one wall anything can be slid.
//!
//! *Measured* (pairs that were accepted, and how many of them have a rival that stands, when all features were searched
//! and a thousand poses tried). Ray-cast worlds seen for 12 m: shelves without end every 5 m 77 of 77, every 8 m 75 of
//! 79; rooms of 8 m, of which one hardly sees the next, 62 of 76. True pairs: halls 0 of 59, 7-Scenes 0 of 84, KITTI 07
//! 0 of 19.

use super::features::Features;
use super::gravity::Upright;
use super::hypotheses::hypotheses;
use super::matching::Pairings;
use super::scene::{Cloud, Pose};
use super::translation_voting;
use super::verifier::{Judged, PoseVerifier};
use nalgebra::Vector3;

/// Pairs of matches with what lies elsewhere that are tried as poses at most.
const TRIES_MAX: usize = 300;
/// What lies this near to where the best pose puts a keypoint is not elsewhere, voxels.
const ELSEWHERE: f64 = 6.0;
/// A rival puts their middle this far from where the best pose does, voxels...
const APART: f64 = 12.0;
/// ...or is turned by so much, rad: nearer ones are the best pose itself, slid along a wall.
const TURNED: f64 = 0.5;
/// A rival that stands is contradicted by less than this share of what I can judge,...
const CONTRADICTION_MAX: f64 = 0.02;
/// ...has so many matches that agree...
const SUPPORT_MIN: usize = 8;
/// ...this share of the points that confirm the best pose,...
const CONFIRMED_MIN: f64 = 0.25;
/// ...and of these so large a share that faces the direction which fewest do (a third at best),...
const FACING_MIN: f64 = 0.08;
/// ...or this, with so many matches.
const WELL_SUPPORTED: (f64, usize) = (0.05, 16);

/// The most supported rival of `best` that stands.
pub(super) fn rival(
    pairings: &Pairings,
    (mine, my_points): (&Features, &[Vector3<f64>]),
    (their_cloud, my_cloud): (&Cloud, &Cloud),
    verifier: &PoseVerifier<'_>,
    best: &Judged,
    upright: &Upright,
) -> Option<Judged> {
    let placed: Vec<Vector3<f64>> = their_cloud.points.iter().map(|p| best.pose.apply(p)).collect();
    let is_there =
        |their: usize, my: usize| (placed[their] - my_cloud.points[my]).norm_squared() <= ELSEWHERE * ELSEWHERE;
    let elsewhere = pairings.except(mine, my_points, is_there);
    let is_apart = |pose: &Pose| verifier.differ(pose, &best.pose, APART, TURNED);
    let mut poses = hypotheses(their_cloud, my_cloud, &elsewhere, TRIES_MAX);
    poses.extend(translation_voting::shifts((&placed, &best.pose), their_cloud, my_cloud, upright.up(), APART));
    poses.retain(|pose| is_apart(pose) && upright.allows_rough(pose));
    let stands = |rival: &Judged| {
        is_apart(&rival.pose)
            && upright.allows(&rival.pose)
            && rival.contradiction() <= CONTRADICTION_MAX
            && rival.support.len() >= SUPPORT_MIN
            && rival.confirmed() as f64 >= CONFIRMED_MIN * best.confirmed() as f64
            && faces_all_ways(verifier.least_facing(rival), rival.support.len())
    };
    let judged = verifier.judge_with(&elsewhere, &poses, is_apart);
    judged.into_iter().filter(stands).max_by_key(|rival| rival.support.len())
}

fn faces_all_ways(least_facing: f64, support: usize) -> bool {
    least_facing >= FACING_MIN || (least_facing >= WELL_SUPPORTED.0 && support >= WELL_SUPPORTED.1)
}

//! Every ordered pair of submaps with one voxel, tried once: one way keypoints, own features, own answer.

use super::sets::{Place, Set};
use crate::bench::cpu::thread_seconds;
use merganser_protocol::align::SolverConfig;
use merganser_protocol::config::Sensor;
use merganser_protocol::geometry::Se3;
use merganser_protocol::submap::planar::{self, PlanarConfig};
use merganser_protocol::submap::{
    Features, RefineConfig, RegisterConfig, RegisterError, Registered, Verticals, register,
};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// Voxels within which a point counts as seen by the other submap...
const NEAR_VOXELS: f64 = 1.5;
/// ...and where the truth itself is not good to a voxel, m.
const NEAR_PLANAR_M: f64 = 0.2;
/// From this share of seen points on a pair is to be found.
pub(super) const OVERLAP_FOUND: f64 = 0.25;
/// Below this share (of either submap) a pair has no overlap.
pub(super) const OVERLAP_NONE: f64 = 0.02;

/// A submap: position of its set, and within.
pub(super) type At = (usize, usize);

/// One direction.
pub(super) struct Tried {
    /// Whose keypoints were sent.
    pub their: At,
    /// Whose features they were matched with.
    pub mine: At,
    /// Share of their points that I saw; 0 between worlds.
    pub overlap: f64,
    /// The answer.
    pub answer: Result<Registered, RegisterError>,
    /// Rotation (°) and translation (m) off the truth, if there is an answer and a truth.
    pub error: Option<(f64, f64)>,
    /// Whether the answer is right by its set's rule.
    pub is_right: bool,
    /// Squared Mahalanobis distance of the truth.
    pub nees: Option<f64>,
    /// Processor time of the alignment, own descriptors included, s.
    pub seconds: f64,
}

/// Ordered pairs of submaps thinned alike.
pub(super) fn pairs(sets: &[Set]) -> Vec<(At, At)> {
    let all: Vec<At> = (0..sets.len()).flat_map(|s| (0..sets[s].places.len()).map(move |k| (s, k))).collect();
    let voxel = |at: At| place(sets, at).described.features.voxel();
    let alike = |a: At, b: At| voxel(a) == voxel(b) && sets[a.0].sensor == sets[b.0].sensor;
    let ordered = all.iter().flat_map(|&a| all.iter().map(move |&b| (a, b)));
    ordered.filter(|&(a, b)| a != b && alike(a, b)).collect()
}

/// The submap at a position.
pub(super) fn place(sets: &[Set], (set, k): At) -> &Place {
    &sets[set].places[k]
}

/// Tries all pairs; `done` is told of each.
///
/// # Errors
/// Features that do not survive their own encoding.
pub(super) fn all(sets: &[Set], done: impl Fn()) -> anyhow::Result<Vec<Tried>> {
    let tried = |(their, mine): (At, At)| {
        let tried = one(sets, their, mine);
        done();
        tried
    };
    pairs(sets).into_iter().map(tried).collect()
}

fn one(sets: &[Set], their: At, mine: At) -> anyhow::Result<Tried> {
    let (theirs, ours) = (place(sets, their), place(sets, mine));
    let truth = (their.0 == mine.0).then(|| ours.t_world_anchor.inverse() * theirs.t_world_anchor);
    // A copy that has not computed its descriptors yet: their time counts.
    let features = Features::decode(&ours.described.features.encode())?;
    let near = NEAR_VOXELS * features.voxel();
    let sensor = sets[their.0].sensor;
    let radius = if sensor == Sensor::Laser2d { NEAR_PLANAR_M } else { near };
    let solver = SolverConfig { sigma_max: near, support_min: 8.0, seed: 7, ..Default::default() };
    let verticals = Verticals::of(theirs.described.summary.up(), ours.described.summary.up());
    let config = RegisterConfig { solver, refine: RefineConfig::of(sensor), verticals, ..Default::default() };
    let start = thread_seconds();
    let keypoints = &theirs.described.keypoints;
    let answer = if sensor == Sensor::Laser2d {
        planar::register(keypoints, &features, &PlanarConfig::default())
    } else {
        register(keypoints, &features, &config)
    };
    let seconds = thread_seconds() - start;
    let pose = answer.as_ref().ok().map(|found| &found.refined.pose);
    let error = pose.zip(truth).map(|(pose, truth)| difference(&pose.pose, &truth));
    let nees = pose.zip(truth).map(|(pose, truth)| pose.covariance.mahalanobis_squared(&pose.pose.local(&truth)));
    let rule = &sets[their.0];
    let is_right = error.is_some_and(|(deg, m)| deg < rule.rotation_deg && m < rule.translation_m);
    let overlap = truth.map_or(0.0, |truth| overlap(theirs, ours, &truth, radius));
    Ok(Tried { their, mine, overlap, answer, error, is_right, nees, seconds })
}

/// Angle (°) and distance between two poses.
pub(super) fn difference(a: &Se3, b: &Se3) -> (f64, f64) {
    ((a.rotation.inverse() * b.rotation).angle().to_degrees(), (a.translation - b.translation).norm())
}

/// Share of a's points with a point of b near them.
fn overlap(a: &Place, b: &Place, t_b_a: &Se3, radius: f64) -> f64 {
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

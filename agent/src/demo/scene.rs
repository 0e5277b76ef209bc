//! The picture's contents from the outcome.

use super::outputs::{COLOURS, Cloud, Outcome};
use super::views::relation;
use crate::picture::{Robot, Scene};
use merganser_protocol::geometry::{PoseWithCovariance, Se3};
use nalgebra::{Matrix3, Vector3};

/// The scene of a merge, in the frame of the first robot.
pub(super) fn scene(outcome: &Outcome, clouds: &[Cloud]) -> Scene {
    let t_ref_world = outcome.tracks.first().and_then(|track| track.t_world_frame()).map(|t| t.inverse());
    let mut robots = Vec::new();
    for (index, (track, cloud)) in outcome.tracks.iter().zip(clouds).enumerate() {
        let corrected = outcome.evaluation.corrected.get(index).and_then(Option::as_ref);
        let [r, g, b] = COLOURS[index % COLOURS.len()];
        let truth = t_ref_world.zip(track.truth.as_ref());
        robots.push(Robot {
            name: track.name.clone(),
            colour: format!("#{r:02x}{g:02x}{b:02x}"),
            alone: (cloud.own.clone(), track.odometry.iter().map(|pose| pose.translation).collect()),
            merged: (
                cloud.common.clone(),
                corrected.map_or_else(Vec::new, |c| c.poses.iter().map(|pose| pose.translation).collect()),
            ),
            truth: truth.map_or_else(Vec::new, |(t, poses)| poses.iter().map(|pose| (t * *pose).translation).collect()),
            anchors: corrected.map_or_else(Vec::new, |c| c.anchors.iter().map(position).collect()),
        });
    }
    Scene {
        title: title(outcome),
        subtitle: outcome.headline.clone(),
        up: up(outcome),
        robots,
        alignments: alignments(outcome),
    }
}

fn title(outcome: &Outcome) -> String {
    let n = outcome.tracks.len();
    let merged = outcome.evaluation.corrected.iter().flatten().count();
    if merged == n {
        format!("{n} robots, {n} local frames, one map")
    } else {
        format!("{n} robots, {merged} of them in one map")
    }
}

/// The way "up" usually is in the common frame: against y for a camera, along z for anything else.
fn up(outcome: &Outcome) -> Vector3<f64> {
    let camera = outcome.recordings.first().is_some_and(|recording| recording.manifest().sensor == "depth");
    if camera { -Vector3::y() } else { Vector3::z() }
}

/// A position and its covariance in the common frame: for a local perturbation, R Σ_ρρ Rᵀ.
fn position(anchor: &PoseWithCovariance) -> (Vector3<f64>, Matrix3<f64>) {
    let r = anchor.pose.rotation.matrix();
    let rho = anchor.covariance.matrix().fixed_view::<3, 3>(0, 0).into_owned();
    (anchor.pose.translation, r * rho * r.transpose())
}

/// Both anchors of every alignment between robots that the joint estimate of the first robot uses.
fn alignments(outcome: &Outcome) -> Vec<[Vector3<f64>; 2]> {
    let Some(views) = outcome.views.first() else { return Vec::new() };
    let place = |submap: &str| -> Option<Vector3<f64>> {
        let (frame, index) = submap.rsplit_once('#')?;
        let index: u32 = index.parse().ok()?;
        let view = views.map.submaps.iter().find(|view| view.frame == frame && view.index == index)?;
        let anchor: Se3 = relation(view.t_own_anchor.as_ref()?)?.pose;
        Some(anchor.translation)
    };
    let frame = |submap: &str| submap.rsplit_once('#').map(|(frame, _)| frame.to_owned());
    let used = views.graph.edges.iter().filter(|edge| edge.kind == "alignment" && edge.weight > 0.0);
    let between = used.filter(|edge| frame(&edge.i) != frame(&edge.j));
    between.filter_map(|edge| Some([place(&edge.i)?, place(&edge.j)?])).collect()
}

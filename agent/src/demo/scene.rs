//! The picture's contents from the outcome, in metres; where nobody knows how long the first robot's unit is, in units.

use super::outputs::{COLOURS, Cloud, Outcome};
use super::views::relative;
use crate::picture::{Robot, Scene};
use merganser_protocol::geometry::Relative;
use nalgebra::{Matrix3, Vector3};

/// The scene of a merge, in the frame of the first robot.
pub(super) fn scene(outcome: &Outcome, clouds: &[Cloud]) -> Scene {
    let t_ref_world = outcome.tracks.first().and_then(|track| track.t_world_frame()).map(|t| t.inverse());
    let unit_m = outcome.tracks.first().and_then(|track| track.unit_m);
    let unit = unit_m.unwrap_or(1.0);
    let scaled = |places: &[Vector3<f64>], unit: f64| places.iter().map(|p| p * unit).collect::<Vec<_>>();
    let mut robots = Vec::new();
    for (index, (track, cloud)) in outcome.tracks.iter().zip(clouds).enumerate() {
        let corrected = outcome.evaluation.corrected.get(index).and_then(Option::as_ref);
        let [r, g, b] = COLOURS[index % COLOURS.len()];
        let truth = t_ref_world.zip(track.truth.as_ref());
        robots.push(Robot {
            name: track.name.clone(),
            colour: format!("#{r:02x}{g:02x}{b:02x}"),
            alone: {
                let own = track.unit_m.unwrap_or(1.0);
                (scaled(&cloud.own, own), track.odometry.iter().map(|pose| pose.translation * own).collect())
            },
            merged: (
                scaled(&cloud.common, unit),
                corrected.map_or_else(Vec::new, |c| c.poses.iter().map(|pose| pose.translation * unit).collect()),
            ),
            truth: truth
                .map_or_else(Vec::new, |(t, poses)| poses.iter().map(|pose| t * pose.translation * unit).collect()),
            anchors: corrected.map_or_else(Vec::new, |c| c.anchors.iter().map(|t| position(t, unit)).collect()),
        });
    }
    Scene {
        title: title(outcome),
        subtitle: outcome.headline.clone(),
        up: up(outcome),
        robots,
        alignments: alignments(outcome, unit),
        in_metres: unit_m.is_some(),
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

/// A position and its covariance in the common frame: for a local perturbation, s² R Σ_ρρ Rᵀ.
fn position(anchor: &Relative, unit: f64) -> (Vector3<f64>, Matrix3<f64>) {
    let sim = anchor.sim();
    let rho = match anchor {
        Relative::Metric(t) => t.covariance.matrix().fixed_view::<3, 3>(0, 0).into_owned(),
        Relative::Similarity(t) => t.covariance.matrix().fixed_view::<3, 3>(0, 0).into_owned(),
    };
    let r = sim.rotation.matrix() * (sim.scale * unit);
    (sim.translation * unit, r * rho * r.transpose())
}

/// Both anchors of every alignment between robots that the joint estimate of the first robot uses.
fn alignments(outcome: &Outcome, unit: f64) -> Vec<[Vector3<f64>; 2]> {
    let Some(views) = outcome.views.first() else { return Vec::new() };
    let place = |submap: &str| -> Option<Vector3<f64>> {
        let (frame, index) = submap.rsplit_once('#')?;
        let index: u32 = index.parse().ok()?;
        let view = views.map.submaps.iter().find(|view| view.frame == frame && view.index == index)?;
        Some(relative(view.t_own_anchor.as_ref()?)?.sim().translation * unit)
    };
    let frame = |submap: &str| submap.rsplit_once('#').map(|(frame, _)| frame.to_owned());
    let used = views.graph.edges.iter().filter(|edge| edge.kind == "alignment" && edge.weight > 0.0);
    let between = used.filter(|edge| frame(&edge.i) != frame(&edge.j));
    between.filter_map(|edge| Some([place(&edge.i)?, place(&edge.j)?])).collect()
}

//! The files that the demonstration leaves: the merged map, the robots' paths, the alignments and the picture.

use super::evaluate::{CHI2_6_95, CHI2_7_95, Evaluation, Pair, PoseError};
use super::scene;
use super::track::Track;
use super::trajectory::Corrected;
use super::views::Views;
use crate::picture;
use crate::recording::{Recording, ply};
use anyhow::{Context, Result};
use merganser_protocol::geometry::{Relative, Sim3};
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::{SMatrix, Vector3};
use serde_json::{Value, json};
use std::collections::BTreeSet;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

/// Names of the files, beside a `robot_*.tum` each.
const MERGED: &str = "merged.ply";
const ALIGNMENTS: &str = "alignments.json";
const PNG: &str = "merge.png";
const SVG: &str = "merge.svg";
/// What [`ALIGNMENTS`] says of itself where a robot does not know the metre.
const SCALED_CONVENTIONS: &str = "t_a_b maps frame b into frame a, p_a = scale R p_b + t, and is rigid where no scale is \
     stated; quaternions [x, y, z, w]; tangents and covariances in the order (translation, rotation, and log-scale if there \
     is one), of the local perturbation T exp(δ); translations in units of a, their covariances in units of b, angles in \
     rad; an error's scale is the estimate over the truth, its translation_m in m; units_m is what one is in each robot's \
     frame, null if unknown; the merged map and the paths are in units of the reference frame";
/// Numbers of 32 bits are a millimetre apart from here on, m (or units).
const EXACT_MAX: f64 = 8_192.0;
/// An offset is easier to type if it is round, m (or units).
const OFFSET_STEP: f64 = 100.0;
/// The merged map is thinned to one point per robot in cubes of this share of the submaps' voxel.
const THIN: f64 = 0.5;
/// Robots' colours, told apart by colour-blind people too (Okabe and Ito).
pub(super) const COLOURS: [[u8; 3]; 6] =
    [[0, 114, 178], [213, 94, 0], [0, 158, 115], [204, 121, 167], [230, 159, 0], [86, 180, 233]];

/// What everything is drawn and written from.
pub(super) struct Outcome<'a> {
    pub recordings: &'a [Recording],
    pub tracks: &'a [Track],
    pub views: &'a [Views],
    pub evaluation: &'a Evaluation,
    /// One line for the picture.
    pub headline: String,
}

/// A robot's thinned points: in its own frame by odometry, and in the common frame.
#[derive(Clone, Debug, Default)]
pub(super) struct Cloud {
    pub own: Vec<Vector3<f64>>,
    pub common: Vec<Vector3<f64>>,
}

/// Writes all files into `folder` and returns their paths, and what the merged map is written relative to, if it is.
pub(super) fn write(result: &Outcome, folder: &Path) -> Result<(Vec<PathBuf>, Option<Vector3<f64>>)> {
    let mut clouds = Vec::new();
    for (recording, corrected) in result.recordings.iter().zip(&result.evaluation.corrected) {
        clouds.push(cloud(recording, corrected.as_ref())?);
    }
    let mut written = Vec::new();
    let mut put = |name: String, bytes: Vec<u8>| -> Result<()> {
        let path = folder.join(name);
        fs::write(&path, bytes).with_context(|| path.display().to_string())?;
        written.push(path);
        Ok(())
    };
    let offset = offset_of(&clouds);
    put(MERGED.into(), merged_ply(&clouds, offset))?;
    for (track, corrected) in result.tracks.iter().zip(&result.evaluation.corrected) {
        if let Some(corrected) = corrected {
            put(format!("robot_{}.tum", track.name), tum(&track.stamps_secs, &corrected.poses).into())?;
        }
    }
    put(ALIGNMENTS.into(), serde_json::to_vec_pretty(&alignments(result))?)?;
    let svg = picture::draw(&scene::scene(result, &clouds));
    put(PNG.into(), picture::png(&svg, 1.0)?)?;
    put(SVG.into(), svg.into())?;
    Ok((written, offset))
}

/// Removes what an earlier run left, so that nothing of it passes for this one's. A folder without [`MERGED`] is
/// nobody's but the user's, and is left as it is.
pub(super) fn remove_old(folder: &Path) -> Result<()> {
    if !folder.join(MERGED).is_file() {
        return Ok(());
    }
    for entry in fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let ours = [MERGED, ALIGNMENTS, PNG, SVG].contains(&name.as_str())
            || (name.starts_with("robot_") && name.ends_with(".tum"));
        if ours && path.is_file() {
            fs::remove_file(&path).with_context(|| path.display().to_string())?;
        }
    }
    Ok(())
}

/// Reads all clouds of a recording, thinned.
fn cloud(recording: &Recording, corrected: Option<&Corrected>) -> Result<Cloud> {
    let cell = recording.manifest().config.submap.voxel_m * THIN;
    // The voxel is of the robot's own unit; one size for all its submaps, so that their cubes are the same.
    let to_common = corrected.and_then(|corrected| corrected.poses.first()).map_or(1.0, |pose| pose.scale);
    let cell = cell * to_common;
    let mut taken = BTreeSet::new();
    let mut cloud = Cloud::default();
    for (index, line) in recording.keyframes().iter().enumerate() {
        let t_common_body = corrected.and_then(|corrected| corrected.poses.get(index));
        for point in recording.points(index)? {
            let p_body = Vector3::from(point.map(f64::from));
            let p_own = line.pose.pose * p_body;
            let place = t_common_body.map_or(p_own, |t| *t * p_body);
            if taken.insert(<[i64; 3]>::from(place.map(|x| (x / cell).floor() as i64))) {
                cloud.own.push(p_own);
                if t_common_body.is_some() {
                    cloud.common.push(place);
                }
            }
        }
    }
    Ok(cloud)
}

pub(super) fn merged_ply(clouds: &[Cloud], offset: Option<Vector3<f64>>) -> Vec<u8> {
    let mut points = Vec::new();
    let from = offset.unwrap_or_default();
    for (cloud, colour) in clouds.iter().zip(COLOURS.iter().cycle()) {
        points.extend(cloud.common.iter().map(|p| (<[f32; 3]>::from((p - from).map(|x| x as f32)), *colour)));
    }
    let comment = offset.map(|offset| {
        let [x, y, z] = offset.into();
        format!("offset {x} {y} {z}: to be added to each vertex")
    });
    ply::encode_coloured(points.len(), points.iter().map(|(point, colour)| (point, *colour)), comment.as_deref())
}

/// What points are written relative to, in whole steps of [`OFFSET_STEP`], where single precision would blur them.
pub(super) fn offset_of(clouds: &[Cloud]) -> Option<Vector3<f64>> {
    let points = || clouds.iter().flat_map(|cloud| &cloud.common);
    if points().all(|p| p.amax() < EXACT_MAX) {
        return None;
    }
    let low = points().copied().reduce(|a, b| a.inf(&b))?;
    let high = points().copied().reduce(|a, b| a.sup(&b))?;
    Some(((low + high) / (2.0 * OFFSET_STEP)).map(|steps| steps.round() * OFFSET_STEP))
}

/// The TUM format: `stamp x y z qx qy qz qw`, a pose a line.
pub(super) fn tum(stamps_secs: &[f64], poses: &[Sim3]) -> String {
    let mut text = String::new();
    for (stamp, pose) in stamps_secs.iter().zip(poses) {
        let ([x, y, z], [qx, qy, qz, qw]) = (<[f64; 3]>::from(pose.translation), pose.rotation.xyzw());
        let _ = writeln!(text, "{stamp:.9} {x:.6} {y:.6} {z:.6} {qx:.9} {qy:.9} {qz:.9} {qw:.9}");
    }
    text
}

fn alignments(result: &Outcome) -> Value {
    let mut document = json!({
        "conventions": "t_a_b maps frame b into frame a; quaternions [x, y, z, w]; tangents and covariances in the order \
                        (translation, rotation), of the local perturbation T exp(δ); m and rad",
        "reference_frame": result.views.first().map(|views| &views.frames.own),
        "chi2_6_95": CHI2_6_95,
        "pairs": result.evaluation.pairs.iter().map(pair).collect::<Vec<_>>(),
        "single_alignments": {
            "count": result.evaluation.singles.count,
            "nees_mean": result.evaluation.singles.nees_mean,
            "inside_95": result.evaluation.singles.inside_95,
            "translation_rms_m": result.evaluation.singles.translation_rms_m,
            "rotation_rms_deg": result.evaluation.singles.rotation_rms_deg,
        },
        "checks": result.evaluation.checks.iter().map(|check| {
            json!({"what": check.what, "held": check.held, "found": check.found})
        }).collect::<Vec<_>>(),
    });
    // Swarms that know the metre are told nothing of scales.
    if result.tracks.iter().any(|track| track.scale == ScaleKind::Unknown) {
        document["conventions"] = json!(SCALED_CONVENTIONS);
        document["chi2_7_95"] = json!(CHI2_7_95);
        document["units_m"] = result.tracks.iter().map(|track| (track.name.clone(), json!(track.unit_m))).collect();
    }
    document
}

fn pair(pair: &Pair) -> Value {
    let [proposed, agreed, used] = pair.alignments;
    let is_similarity = matches!(pair.t_a_b, Some(Relative::Similarity(_)));
    let has_scale = is_similarity || pair.error.is_some_and(|e| e.degrees_of_freedom == 7);
    let pose = |t: &Sim3| {
        let mut pose = json!({"translation": <[f64; 3]>::from(t.translation), "rotation": t.rotation.xyzw()});
        if has_scale {
            pose["scale"] = json!(t.scale);
        }
        pose
    };
    let estimate = |t: &Relative| {
        let (covariance, sigmas): (Vec<Vec<f64>>, Vec<f64>) = match t {
            Relative::Metric(t) => (rows(t.covariance.matrix()), t.covariance.sigmas().as_slice().to_vec()),
            Relative::Similarity(t) => (rows(t.covariance.matrix()), t.covariance.sigmas().as_slice().to_vec()),
        };
        json!({"pose": pose(&t.sim()), "covariance": covariance, "sigmas": sigmas})
    };
    let error = |e: &PoseError| {
        let mut error = json!({
            "xi": &e.xi.as_slice()[..e.degrees_of_freedom],
            "translation_m": e.translation_m,
            "rotation_deg": e.rotation_deg,
            "nees": e.nees,
            "inside_95": e.inside_95(),
        });
        if has_scale {
            error["scale"] = json!(e.scale);
            error["degrees_of_freedom"] = json!(e.degrees_of_freedom);
        }
        error
    };
    json!({
        "a": pair.robots[0],
        "b": pair.robots[1],
        "status": pair.status,
        "alignments": {"proposed": proposed, "agreed": agreed, "used": used},
        "log10_nfa": pair.log10_nfa,
        "t_a_b": pair.t_a_b.as_ref().map(estimate),
        "truth": pair.truth.as_ref().map(pose),
        "error": pair.error.as_ref().map(error),
    })
}

fn rows<const N: usize>(m: &SMatrix<f64, N, N>) -> Vec<Vec<f64>> {
    (0..N).map(|r| (0..N).map(|c| m[(r, c)]).collect()).collect()
}

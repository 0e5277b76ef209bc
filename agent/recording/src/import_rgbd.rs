//! A 7-Scenes folder (as in tsdf-fusion's `data/`: `frame-XXXXXX.depth.png` in millimetres, `camera-intrinsics.txt`,
//! `poses_all_1000.txt` with camera-to-world matrices) becomes three robots by thirds of its frames. The body is the
//! camera: x right, y down, z forward. Depth from 0.3 to 4 m, every sixth pixel of every sixth row: up to 8,500 points.

use super::Drift;
use super::bounded::{read_bytes, read_text};
use super::cut::{Cut, Scan};
use super::error::{Problem, RecordingError, on};
use super::table::{near, number};
use crate::depth::{Camera, Counts, DepthError, DepthImage};
use merganser_protocol::config::Config;
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::time::Stamp;
use nalgebra::{Matrix3, Matrix4, Vector3};
use std::collections::BTreeMap;
use std::path::Path;

/// How the depth images' names end.
pub(super) const DEPTH_SUFFIX: &str = ".depth.png";
const DEPTH_PREFIX: &str = "frame-";
const INTRINSICS: &str = "camera-intrinsics.txt";
const POSES: &str = "poses_all_1000.txt";
/// What one count is, m.
const UNIT_M: f64 = 1e-3;
/// Depth used, m: nearer is noise, farther is coarse.
const RANGE_M: [f64; 2] = [0.3, 4.0];
/// Every so many pixels of every so many rows.
const STRIDE: usize = 6;
/// The camera's rate.
const FRAME_NANOS: i64 = 1_000_000_000 / 30;
/// A hand-held visual SLAM's: 1 % of the way and a tenth of a degree on each axis per keyframe (a third of a second).
const DRIFT: Drift = Drift { per_metre: 0.01, floor_m: 0.001, step_deg: 0.1 };
/// Largest deviation from orthonormality of a pose's rotation.
const ROTATION_ERROR_MAX: f64 = 1e-3;

/// Writes three recordings into `out`.
pub(super) fn import(data: &Path, out: &Path, seed: u64) -> Result<(), RecordingError> {
    let camera = read_intrinsics(&data.join(INTRINSICS))?;
    let poses = read_poses(&data.join(POSES))?;
    let mut scans = Vec::new();
    for entry in on(data, data.read_dir())? {
        let source = on(data, entry)?.path();
        let name = source.file_name().unwrap_or_default().to_string_lossy();
        let Some(index) = name.strip_suffix(DEPTH_SUFFIX).and_then(|name| name.strip_prefix(DEPTH_PREFIX)) else {
            continue;
        };
        let known = index.parse::<u32>().ok().and_then(|index| Some((index, *poses.get(&index)?)));
        let Some((index, truth)) = known else {
            return Err(Problem::Data(format!("has no pose in {POSES}")).of(&source));
        };
        scans.push(Scan { stamp: Stamp(i64::from(index) * FRAME_NANOS), truth, source });
    }
    scans.sort_by_key(|scan| scan.stamp);
    let mut config = Config::default();
    config.submap.voxel_m = 0.05;
    // A narrow view leans on few surfaces: of ten images they are more than of five. Measured over three drifts (seed 1
    // in brackets): frames 0.018 m and 0.74° off (0.019 m and 0.78° at worst) with ten, 0.022 m and 0.79° (0.029 m and
    // 0.63°) with five, and no better with three times as many keypoints.
    config.submap.keyframes_max = 10;
    let origin = format!("7-Scenes RGB-D, {} depth images cut into three robots by thirds", scans.len());
    let cut = Cut { robots: 3, sensor: "depth", origin, drift: DRIFT, seed, config };
    cut.write(&scans, out, |scan| read_depth(&scan.source, &camera))
}

fn read_intrinsics(path: &Path) -> Result<Camera, RecordingError> {
    let text = read_text(path)?;
    let mut k = Vec::new();
    for (index, line) in text.lines().enumerate() {
        for word in line.split_ascii_whitespace() {
            k.push(number("K", word).map_err(|problem| problem.at(path, index + 1))?);
        }
    }
    match *k.as_slice() {
        [fx, _, cx, _, fy, cy, _, _, _] if fx > 0.0 && fy > 0.0 => Ok(Camera { fx, fy, cx, cy }),
        _ => Err(Problem::Data("is not a 3×3 camera matrix with positive focal lengths".into()).of(path)),
    }
}

/// `index` and sixteen numbers a line: the camera-to-world matrix, row by row.
fn read_poses(path: &Path) -> Result<BTreeMap<u32, Se3>, RecordingError> {
    let text = read_text(path)?;
    let mut poses = BTreeMap::new();
    for (index, line) in text.lines().enumerate() {
        let pose = read_pose(line).map_err(|problem| problem.at(path, index + 1))?;
        poses.insert(pose.0, pose.1);
    }
    Ok(poses)
}

fn read_pose(line: &str) -> Result<(u32, Se3), Problem> {
    let words: Vec<&str> = line.split_ascii_whitespace().collect();
    let [index, words @ ..] = words.as_slice() else {
        return Err(Problem::Fields { found: 0, expected: 17 });
    };
    let frame = index.parse().map_err(|_| Problem::Number { column: "index", text: (*index).into() })?;
    let values = words.iter().map(|word| number("pose", word)).collect::<Result<Vec<_>, _>>()?;
    if values.len() != 16 {
        return Err(Problem::Fields { found: values.len() + 1, expected: 17 });
    }
    Ok((frame, rigid(&Matrix4::from_row_slice(&values))?))
}

/// A pose from a homogeneous matrix, whose rotation must be one.
pub(super) fn rigid(m: &Matrix4<f64>) -> Result<Se3, Problem> {
    let r: Matrix3<f64> = m.fixed_view::<3, 3>(0, 0).into_owned();
    let mut off = (r.transpose() * r - Matrix3::identity()).amax();
    if r.determinant() < 0.0 {
        off = off.max(2.0);
    }
    if off > ROTATION_ERROR_MAX {
        return Err(Problem::Rotation(off));
    }
    near(Se3::new(So3::from_matrix(&r), Vector3::new(m[(0, 3)], m[(1, 3)], m[(2, 3)])))
}

/// The points of a depth image, in the camera's frame.
fn read_depth(path: &Path, camera: &Camera) -> Result<Vec<[f32; 3]>, RecordingError> {
    let bytes = read_bytes(path)?;
    let seen = || DepthImage::from_png(&bytes)?.points(camera, &Counts::new(UNIT_M, Some(RANGE_M))?, STRIDE);
    seen().map_err(|error| match error {
        DepthError::Nothing { .. } => Problem::CloudEmpty.of(path),
        DepthError::Camera { .. } => Problem::Image(format!("{error}; check {INTRINSICS}")).of(path),
        _ => Problem::Image(error.to_string()).of(path),
    })
}

//! One of two things to be aligned: read, cut into a submap, described as a robot describes its own.

use super::AlignArgs;
use crate::commands::BadInput;
use crate::commands::scratch::Scratch;
use crate::observation::{self, Format};
use crate::recording::{Recording, cloud, import};
use anyhow::Result;
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use merganser_protocol::submap::{
    CovarianceOf, Described, Features, Keyframe, Keypoints, Mark, Submap, SubmapBuilder, describe,
};
use merganser_protocol::time::Stamp;
use merganser_recording::manifest::CloudFormat;
use nalgebra::Vector3;
use std::collections::BTreeSet;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Voxels in the range of a cloud: between the 70 of 0.05 m for a depth camera's 3.5 m and the 110 of 0.5 m for a
/// LiDAR's 55 m, which `agent/dist/default.toml` advises.
const VOXELS_IN_RANGE: f64 = 100.0;
/// Voxels that are suggested, m: from those of a thing on a table to those of a street.
const VOXELS_M: [f64; 2] = [0.001, 0.5];
/// Points that a voxel holds at least, on average, of a cloud that it thins.
const POINTS_IN_VOXEL: usize = 2;
/// Clouds that reach farther are taken for a LiDAR's, m.
const CAMERA_RANGE: f64 = 10.0;
/// Side of the cubes in which a range is counted, m; of small clouds a tenth of what their farthest point is off.
const CELL_M: f64 = 0.25;
/// Standard deviation of the one pose of a cloud, which is where it is by definition.
const POSE_SIGMA: f64 = 1e-4;

/// Bytes of a message at most: the largest that an agent can be told to take.
const MESSAGE_BYTES_MAX: u64 = 16 << 20;

/// What was read.
pub(super) struct Source {
    name: String,
    what: What,
    /// What a bag was made into.
    _scratch: Option<Scratch>,
}

enum What {
    Cloud(Vec<[f32; 3]>, Vec<Mark>),
    Recording(Box<Recording>, usize),
}

/// A described submap.
pub(super) struct Side {
    pub name: String,
    /// A cloud, of which nothing tells where it was seen from.
    pub is_cloud: bool,
    /// Points read, and left after thinning.
    pub points: [usize; 2],
    /// 90 % of the surface is nearer to the anchor, m.
    pub range: f64,
    pub cloud: Vec<Vector3<f64>>,
    pub features: Arc<Features>,
    pub keypoints: Arc<Keypoints>,
}

/// Reads a cloud, or opens a recording.
pub(super) fn read(path: &Path, args: &AlignArgs) -> Result<Source> {
    let name = path.display().to_string();
    let (folder, number) = numbered(path);
    if import::is_bag(&folder) {
        return of_bag(name, &folder, number, args);
    }
    if folder.is_dir() {
        let recording = Recording::open(&folder)?;
        return Ok(Source { name, what: What::Recording(Box::new(recording), number), _scratch: None });
    }
    if path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("json")) {
        return of_message(name, path);
    }
    let format = args.format.map_or_else(|| format_of(path), Ok)?;
    let (points, remarks) = cloud::read_remarked(path, format)?;
    for remark in remarks {
        console::Term::stderr().write_line(&format!("merganser: {name}: {remark}"))?;
    }
    let sees_landmarks = args.sensor.is_some_and(Sensor::sees_landmarks);
    let marks = if sees_landmarks { cloud::landmarks(path, format)? } else { Vec::new() };
    Ok(Source { name, what: What::Cloud(points, marks), _scratch: None })
}

/// What a bag holds of its one robot.
fn of_bag(name: String, bag: &Path, number: usize, args: &AlignArgs) -> Result<Source> {
    let scratch = Scratch::new("align")?;
    let mut prepared = import::prepare_bag(bag, scratch.path(), &args.topics.wanted())?;
    for remark in prepared.remarks {
        console::Term::stderr().write_line(&format!("merganser: {name}: {remark}"))?;
    }
    if prepared.recordings.len() > 1 {
        let robots: Vec<&str> = prepared.recordings.iter().map(|one| one.manifest().robot.as_str()).collect();
        return Err(BadInput::told(format!(
            "{name}: holds the robots {}: choose one by its topics, --odometry /NAME/… --cloud /NAME/…",
            robots.join(", ")
        )));
    }
    let recording = prepared.recordings.remove(0);
    Ok(Source { name, what: What::Recording(Box::new(recording), number), _scratch: Some(scratch) })
}

/// The points of a keyframe, as a SLAM sends it in JSON.
fn of_message(name: String, path: &Path) -> Result<Source> {
    let told = |why: String| BadInput::told(format!("{name}: {why}"));
    let mut bytes = Vec::new();
    // Whatever size the file states: that of a pipe is 0.
    let file = std::fs::File::open(path).map_err(|error| told(error.to_string()))?;
    file.take(MESSAGE_BYTES_MAX + 1).read_to_end(&mut bytes).map_err(|error| told(error.to_string()))?;
    if bytes.len() as u64 > MESSAGE_BYTES_MAX {
        return Err(told(format!("has more than {MESSAGE_BYTES_MAX} bytes, which no agent takes in one message")));
    }
    let keyframe = observation::keyframe(Format::Json, &bytes).map_err(|error| told(error.to_string()))?;
    if keyframe.points.is_empty() {
        return Err(told("has no points".into()));
    }
    Ok(Source { name: name.clone(), what: What::Cloud(keyframe.points, keyframe.marks), _scratch: None })
}

/// A folder, and which of its submaps, if it is named so.
fn numbered(path: &Path) -> (PathBuf, usize) {
    let text = path.to_string_lossy();
    let split = text.rsplit_once(':').and_then(|(folder, number)| Some((folder, number.parse().ok()?)));
    match split {
        Some((folder, number)) if !path.exists() => (folder.into(), number),
        _ => (path.into(), 0),
    }
}

fn format_of(path: &Path) -> Result<CloudFormat> {
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_ascii_lowercase();
    match &*ending {
        "ply" => Ok(CloudFormat::Ply),
        "pcd" => Ok(CloudFormat::Pcd),
        "bin" => Ok(CloudFormat::KittiBin),
        _ => Err(BadInput::told(format!(
            "{}: its name does not end in .ply, .pcd, .bin or .json, and it is no folder and no bag; say by --format how \
             it is stored",
            path.display()
        ))),
    }
}

/// What is asked for, else what a recording says, else what the clouds suggest.
pub(super) fn config(sources: &[Source; 2], args: &AlignArgs) -> Result<Config> {
    let recorded = |source: &Source| match &source.what {
        What::Recording(recording, _) => Some(recording.manifest().config.clone()),
        What::Cloud(..) => None,
    };
    let [a, b] = [0, 1].map(|k| recorded(&sources[k]));
    if let (Some(a), Some(b), None) = (&a, &b, args.sensor)
        && a.submap.sensor != b.submap.sensor
    {
        return Err(BadInput::told(format!(
            "{} and {} are of different sensors, which robots do not compare; choose one by --sensor",
            sources[0].name, sources[1].name
        )));
    }
    let mut config = a.or(b).unwrap_or_else(|| suggested(sources));
    let is_cloud = |source: &Source| matches!(source.what, What::Cloud(..));
    if config.submap.sensor.sees_landmarks() && args.sensor.is_none() && sources.iter().any(is_cloud) {
        return Err(BadInput::told("one is of landmarks: state --sensor landmarks, so that the cloud is read so, too"));
    }
    config.submap.sensor = args.sensor.unwrap_or(config.submap.sensor);
    config.submap.scale = args.scale.unwrap_or(config.submap.scale);
    config.submap.voxel_m = args.voxel.unwrap_or(config.submap.voxel_m);
    if let Some(sigma) = args.sigma_max {
        config.align.sigma_max_voxels = sigma / config.submap.voxel_m;
    }
    config.validate().map_err(|error| {
        BadInput::told(match error.key {
            "align.sigma_max_voxels" => format!(
                "--sigma-max of {} voxels does not work; use 0.1 to 10 voxels of {} m",
                error.value, config.submap.voxel_m
            ),
            "submap.voxel_m" => format!("--voxel: {}", error.mend),
            _ => error.to_string(),
        })
    })?;
    Ok(config)
}

fn suggested(sources: &[Source; 2]) -> Config {
    let clouds = sources.iter().filter_map(|source| match &source.what {
        What::Cloud(points, _) => Some(points),
        What::Recording(..) => None,
    });
    let all: Vec<&[f32; 3]> = clouds.flatten().collect();
    let is_flat = all.iter().all(|point| point[2] == all[0][2]);
    let range = range(all.iter().copied());
    let mut config = Config::default();
    config.submap.sensor = match range {
        _ if is_flat => Sensor::Laser2d,
        range if range > CAMERA_RANGE => Sensor::Lidar3d,
        _ => Sensor::Points3d,
    };
    let mut voxel = (range / VOXELS_IN_RANGE).clamp(VOXELS_M[0], VOXELS_M[1]);
    // In a cloud that hardly gets thinner, points are farther apart than this: it shows no surfaces at such a scale.
    while all.len() < POINTS_IN_VOXEL * cells(all.iter().copied(), voxel).len() && voxel < VOXELS_M[1] {
        voxel *= 1.2;
    }
    // Of few decimals, which is easier to repeat.
    let decimals = if voxel < 0.02 { 1000.0 } else { 100.0 };
    config.submap.voxel_m = (decimals * voxel.min(VOXELS_M[1])).round() / decimals;
    config
}

/// The cubes of this side that hold a point.
fn cells<'a>(points: impl Iterator<Item = &'a [f32; 3]>, side: f64) -> BTreeSet<[i64; 3]> {
    points.map(|point| point.map(|c| (f64::from(c) / side).round() as i64)).collect()
}

/// 90 % of the surface is nearer: points are counted once in each cube of [`CELL_M`], since sensors see most of them near.
fn range<'a>(points: impl Iterator<Item = &'a [f32; 3]> + Clone) -> f64 {
    let far = points.clone().flatten().fold(0.0_f64, |most, c| most.max(f64::from(c.abs())));
    let side = CELL_M.min(far / 10.0).max(1e-6);
    let distance = |cell: [i64; 3]| side * Vector3::from(cell.map(|steps| steps as f64)).norm();
    let mut distances: Vec<f64> = cells(points, side).into_iter().map(distance).collect();
    distances.sort_by(f64::total_cmp);
    distances.get(distances.len() * 9 / 10).copied().unwrap_or(0.0)
}

impl Source {
    /// Whether it is no submap of a recording, which knows what its sensor saw from where.
    pub(super) fn is_cloud(&self) -> bool {
        matches!(self.what, What::Cloud(..))
    }

    /// Cuts and describes it.
    pub(super) fn describe(self, config: &Config, fused: bool) -> Result<Side> {
        let is_cloud = self.is_cloud();
        let (mut submap, read) = match self.what {
            What::Cloud(points, marks) => of_cloud(&self.name, points, marks, config)?,
            What::Recording(recording, number) => of_recording(&self.name, &recording, number, config)?,
        };
        if fused && is_cloud {
            // Of no point is known who saw it: nobody looked through anything, and surfaces face the origin.
            submap.seen_from.fill(u16::MAX);
        }
        let Described { features, keypoints, further, .. } = describe(&submap, &config.submap);
        // All that two robots would fetch for a pair that is worth a second look.
        let keypoints = further.and_then(|further| keypoints.with_further(&further)).unwrap_or(keypoints);
        if keypoints.is_empty() && config.submap.sensor != Sensor::Laser2d {
            if config.submap.sensor.sees_landmarks() {
                let why =
                    "no landmarks that could be recognised: state a label or a descriptor of them (label, d0 to d31)";
                return Err(BadInput::told(format!("{}: {why}", self.name)));
            }
            return Err(BadInput::told(format!(
                "{}: no keypoints: {} points are left at {} m, too few that have neighbours; use a smaller --voxel, or \
                 check the unit",
                self.name,
                submap.cloud.len(),
                config.submap.voxel_m
            )));
        }
        let cloud: Vec<Vector3<f64>> = submap.cloud.iter().map(|p| Vector3::from(p.map(f64::from))).collect();
        Ok(Side {
            name: self.name,
            is_cloud,
            points: [read, cloud.len()],
            range: range(submap.cloud.iter()),
            cloud,
            features: Arc::new(features),
            keypoints: Arc::new(keypoints),
        })
    }
}

fn of_cloud(name: &str, points: Vec<[f32; 3]>, marks: Vec<Mark>, config: &Config) -> Result<(Submap, usize)> {
    let read = points.len();
    let covariance = Covariance::from_sigmas([POSE_SIGMA; 6]).map_err(|error| BadInput::told(error.to_string()))?;
    let keyframe = Keyframe {
        stamp: Stamp(0),
        session: None,
        pose: PoseWithCovariance { pose: Se3::identity(), covariance },
        covariance_of: CovarianceOf::Motion,
        points,
        marks,
        place: None,
        up: None,
    };
    let mut builder = SubmapBuilder::new(config.submap.clone());
    let finished = builder.push(keyframe).map_err(|error| BadInput::told(format!("{name}: {error}")))?;
    let submap = finished.or_else(|| builder.flush());
    Ok((submap.ok_or_else(|| BadInput::told(format!("{name}: makes no submap")))?, read))
}

/// The submap of this number, as an agent cuts it.
fn of_recording(name: &str, recording: &Recording, number: usize, config: &Config) -> Result<(Submap, usize)> {
    let mut builder = SubmapBuilder::new(config.submap.clone());
    let (mut found, mut read) = (0, 0);
    for index in 0..=recording.len() {
        let finished = if index < recording.len() {
            let keyframe = recording.keyframe(index)?;
            let points = keyframe.points.len();
            let finished = builder.push(keyframe).map_err(|error| BadInput::told(format!("{name}: {error}")))?;
            read = if finished.is_some() { read } else { read + points };
            finished
        } else {
            builder.flush()
        };
        if let Some(submap) = finished {
            if found == number {
                return Ok((submap, read));
            }
            (found, read) = (found + 1, 0);
        }
    }
    Err(BadInput::told(format!("{name}: there is no submap {number}; the recording has {found}, counted from 0")))
}

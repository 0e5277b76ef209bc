//! LiDAR scans with known poses become robots: gtsam_points dumps (`graph.txt` with lines `vI x y z qx qy qz qw`, and
//! `NNNNNN/points.bin` of f32 x, y, z) and KITTI sequences (`NNNNNN.bin` of f32 x, y, z, intensity, and `poses.txt` in
//! the LiDAR's frame: twelve numbers a line, the line being the scan's number, or `index x y z qx qy qz qw`).

use super::bounded::read_text;
use super::cloud;
use super::cut::{Cut, Scan};
use super::error::{Problem, RecordingError, on};
use super::import_rgbd::rigid;
use super::table::{number, pose_of};
use super::{Drift, Remarks};
use crate::manifest::CloudFormat;
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::geometry::Se3;
use merganser_protocol::time::Stamp;
use nalgebra::Matrix4;
use std::cell::RefCell;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Poses of a gtsam_points dump.
pub(super) const GRAPH: &str = "graph.txt";
/// Poses of a KITTI sequence.
pub(super) const POSES: &str = "poses.txt";
/// How KITTI's scans end.
pub(super) const SCAN_SUFFIX: &str = ".bin";
/// A LiDAR turns ten times a second.
const SCAN_NANOS: i64 = 100_000_000;
/// A LiDAR odometry: 1 % of the way and a tenth of a degree per scan.
const DRIFT: Drift = Drift { per_metre: 0.01, floor_m: 0.01, step_deg: 0.1 };
/// As fast as this a LiDAR is carried, m/s and rad/s: a dump numbers its keyframes, and does not tell their times.
const CARRIED: (f64, f64) = (10.0, 0.5);
/// With fewer scans than this per robot, two robots are made instead of three.
const SCANS_PER_ROBOT_MIN: usize = 4;
/// Submaps a robot should have at least, so that three alignments can be found.
const SUBMAPS_PER_ROBOT: usize = 4;

/// Writes two or three recordings into `out`; says what was odd.
pub(super) fn import(data: &Path, out: &Path, seed: u64) -> Result<Vec<String>, RecordingError> {
    let graph = data.join(GRAPH);
    let (poses, format, source): (_, _, fn(&Path, u32) -> PathBuf) = if graph.is_file() {
        let source = |data: &Path, index| data.join(format!("{index:06}")).join("points.bin");
        (read_poses(&graph)?, CloudFormat::XyzBin, source)
    } else {
        let source = |data: &Path, index| data.join(format!("{index:06}{SCAN_SUFFIX}"));
        if !data.join(POSES).is_file() {
            let why = format!("holds scans but neither {GRAPH} nor {POSES}; state the pose of each scan in {POSES}");
            return Err(Problem::Data(why).of(data));
        }
        (read_poses(&data.join(POSES))?, CloudFormat::KittiBin, source)
    };
    for scan in numbered(data, format)? {
        if !poses.contains_key(&scan) {
            let why = format!("scan {scan:06} has no pose; state it, or take the scan away");
            return Err(Problem::Data(why).of(data));
        }
    }
    let stated = poses.len();
    let stamps: Vec<Stamp> = if graph.is_file() { carried(&poses) } else { poses.keys().map(turned).collect() };
    let scans: Vec<Scan> = poses
        .into_iter()
        .zip(stamps)
        .map(|((index, truth), stamp)| Scan { stamp, truth, source: source(data, index) })
        .filter(|scan| scan.source.is_file())
        .collect();
    if scans.len() < 2 {
        let why = format!("{} scans have a pose; at least two are needed", scans.len());
        return Err(Problem::Data(why).of(data));
    }
    let robots = if scans.len() < 3 * SCANS_PER_ROBOT_MIN { 2 } else { 3 };
    let mut config = Config::default();
    config.submap.sensor = Sensor::Lidar3d;
    config.submap.voxel_m = 0.5;
    config.submap.distance_m = 10.0;
    config.submap.keyframes_max = (scans.len() / (robots * SUBMAPS_PER_ROBOT)).clamp(1, 10) as u32;
    let origin = format!("{} LiDAR scans ({stated} poses) cut into {robots} robots by time", scans.len());
    let cut = Cut { robots, sensor: "lidar3d", origin, drift: DRIFT, seed, config };
    let remarks = RefCell::new(Remarks::default());
    cut.write(&scans, out, |scan| {
        let (points, odd) = cloud::read_remarked(&scan.source, format)?;
        remarks.borrow_mut().note(&scan.source, odd);
        Ok(points)
    })?;
    Ok(remarks.into_inner().told())
}

/// When a LiDAR made the scan of this number.
fn turned(number: &u32) -> Stamp {
    Stamp(i64::from(*number) * SCAN_NANOS)
}

/// When the keyframes of a dump were made, had the LiDAR been carried as fast as it is at most.
fn carried(poses: &BTreeMap<u32, Se3>) -> Vec<Stamp> {
    let (mut now, mut last) = (0_i64, None);
    let mut stamp = |pose: &Se3| {
        if let Some(last) = last.replace(*pose) {
            let t_last_this = last.inverse() * *pose;
            let secs = (t_last_this.translation.norm() / CARRIED.0).max(t_last_this.rotation.angle() / CARRIED.1);
            now = now.saturating_add(SCAN_NANOS.max((secs * 1e9).ceil() as i64));
        }
        Stamp(now)
    };
    poses.values().map(&mut stamp).collect()
}

/// Numbers of the scans in a folder: files `NNNNNN.bin`, or folders `NNNNNN` with points.
fn numbered(data: &Path, format: CloudFormat) -> Result<Vec<u32>, RecordingError> {
    let mut numbers = Vec::new();
    for entry in on(data, data.read_dir())? {
        let path = on(data, entry)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let number = match format {
            CloudFormat::KittiBin => name.strip_suffix(SCAN_SUFFIX),
            _ => path.join("points.bin").is_file().then_some(&*name),
        };
        numbers.extend(number.and_then(|number| number.parse::<u32>().ok()));
    }
    Ok(numbers)
}

/// `t_world_lidar` by the scan's number.
fn read_poses(path: &Path) -> Result<BTreeMap<u32, Se3>, RecordingError> {
    let text = read_text(path)?;
    let mut poses = BTreeMap::new();
    for (index, line) in text.lines().enumerate() {
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        // Edges of a graph and blank lines are not poses.
        if words.first().is_none_or(|word| word.starts_with(['e', '#'])) {
            continue;
        }
        let (scan, pose) = read_pose(&words, index).map_err(|problem| problem.at(path, index + 1))?;
        poses.insert(scan, pose);
    }
    Ok(poses)
}

fn read_pose(words: &[&str], line: usize) -> Result<(u32, Se3), Problem> {
    let numbers = |words: &[&str]| words.iter().map(|word| number("pose", word)).collect::<Result<Vec<_>, _>>();
    match words {
        [name, rest @ ..] if rest.len() == 7 => {
            let index = name.strip_prefix('v').unwrap_or(name).parse();
            let index = index.map_err(|_| Problem::Number { column: "index", text: (*name).into() })?;
            let mut v = [0.0; 7];
            v.copy_from_slice(&numbers(rest)?);
            Ok((index, pose_of(v)?))
        }
        all if all.len() == 12 => {
            let mut values = numbers(all)?;
            values.extend([0.0, 0.0, 0.0, 1.0]);
            let index = u32::try_from(line).map_err(|_| Problem::KeyframesRange(line))?;
            Ok((index, rigid(&Matrix4::from_row_slice(&values))?))
        }
        _ => Err(Problem::Fields { found: words.len(), expected: 12 }),
    }
}

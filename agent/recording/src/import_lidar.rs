//! LiDAR scans with known poses become robots: gtsam_points dumps, GLIM dumps, KITTI sequences, and numbered clouds
//! beside a table of their poses. [`dump`] finds what a folder holds, and names what cannot be read; [`poses`] reads the
//! tables; [`kitti`] tells a camera's poses from a LiDAR's; [`times`] reads when scans were made.

mod dump;
mod glim;
mod kitti;
mod poses;
#[cfg(test)]
mod tests;
mod times;

use super::cloud;
use super::cut::{Cut, Scan};
use super::error::{Problem, RecordingError};
use super::{Drift, Remarks};
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::geometry::Se3;
use merganser_protocol::time::Stamp;
use std::cell::RefCell;
use std::path::Path;

pub(super) use dump::{GRAPH, POSES, SCAN_SUFFIX, is_dump, is_scans};

/// A LiDAR turns ten times a second.
const SCAN_NANOS: i64 = 100_000_000;
/// Largest number of a scan that counts turns of a LiDAR: four months of them. Larger ones are times.
const TURN_MAX: u64 = 100_000_000;
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
    let dump::Dump { format, frames, stated, mut remarks, is_submaps, are_turns } = dump::Dump::read(data)?;
    if frames.len() < 2 {
        let why = format!("{} scans have a pose; at least two are needed", frames.len());
        return Err(Problem::Data(why).of(data));
    }
    let mut config = Config::default();
    config.submap.sensor = Sensor::Lidar3d;
    config.submap.voxel_m = 0.5;
    config.submap.distance_m = 10.0;
    let scans = stamped(frames, are_turns, &config, &mut remarks);
    let robots = if scans.len() < 3 * SCANS_PER_ROBOT_MIN { 2 } else { 3 };
    config.submap.keyframes_max =
        if is_submaps { 1 } else { (scans.len() / (robots * SUBMAPS_PER_ROBOT)).clamp(1, 10) as u32 };
    let origin = format!("{} LiDAR scans ({stated} poses) cut into {robots} robots by time", scans.len());
    let cut = Cut { robots, sensor: "lidar3d", origin, drift: DRIFT, seed, config };
    let odd = RefCell::new(Remarks::default());
    cut.write(&scans, out, |scan| {
        let (points, told) = cloud::read_remarked(&scan.source, format)?;
        odd.borrow_mut().note(&scan.source, told);
        Ok(points)
    })?;
    remarks.extend(odd.into_inner().told());
    Ok(remarks)
}

/// Scans with the times that they state; else by their numbers, where these can count the turns of a LiDAR; else by the
/// time that the way takes.
fn stamped(frames: Vec<dump::Frame>, are_turns: bool, config: &Config, remarks: &mut Vec<String>) -> Vec<Scan> {
    let poses: Vec<Se3> = frames.iter().map(|frame| frame.pose).collect();
    let stated: Option<Vec<Stamp>> = frames.iter().map(|frame| frame.stamp).collect();
    let stamps = stated.unwrap_or_else(|| {
        let turned: Option<Vec<Stamp>> = frames.iter().map(|frame| turned(frame.number)).collect();
        match turned.filter(|_| are_turns) {
            Some(turned) if can_be(&poses, &turned, config) => turned,
            turned => {
                if turned.is_some() {
                    let told = "the scans are farther apart than a LiDAR gets in a tenth of a second: their numbers are \
                                not taken for turns of it, and each has the time that its way takes";
                    remarks.push(told.into());
                }
                carried(&poses)
            }
        }
    });
    let scan = |(frame, stamp): (dump::Frame, Stamp)| Scan { stamp, truth: frame.pose, source: frame.source };
    frames.into_iter().zip(stamps).map(scan).collect()
}

/// When a LiDAR made the scan of this number.
fn turned(number: u64) -> Option<Stamp> {
    (number <= TURN_MAX).then_some(Stamp(number as i64 * SCAN_NANOS))
}

/// Whether an agent would take these poses at these times.
fn can_be(poses: &[Se3], stamps: &[Stamp], config: &Config) -> bool {
    let steps = poses.windows(2).zip(stamps.windows(2));
    steps.map(|(pose, stamp)| (pose[0].inverse() * pose[1], (stamp[1].0 - stamp[0].0) as f64 * 1e-9)).all(
        |(step, secs)| {
            step.translation.norm() <= config.submap.speed_max_m_s * secs
                && step.rotation.angle().to_degrees() <= config.submap.turn_max_deg_s * secs
        },
    )
}

/// When keyframes were made, had the LiDAR been carried as fast as it is at most.
fn carried(poses: &[Se3]) -> Vec<Stamp> {
    let (mut now, mut last) = (0_i64, None);
    let mut stamp = |pose: &Se3| {
        if let Some(last) = last.replace(*pose) {
            let t_last_this = last.inverse() * *pose;
            let secs = (t_last_this.translation.norm() / CARRIED.0).max(t_last_this.rotation.angle() / CARRIED.1);
            now = now.saturating_add(SCAN_NANOS.max((secs * 1e9).ceil() as i64));
        }
        Stamp(now)
    };
    poses.iter().map(&mut stamp).collect()
}

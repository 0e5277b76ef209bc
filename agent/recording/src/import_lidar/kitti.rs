//! KITTI states the poses of its left camera (z forward, x right, y down), beside scans of a LiDAR (x forward, z up).
//! `calib.txt` tells how the two lie to one another. The poses do not say whose they are, but how the body moves does: a
//! vehicle goes along its forward axis and turns about the vertical one.

use super::poses::{Poses, matrix};
use crate::bounded::read_text;
use crate::error::{Problem, RecordingError};
use crate::table::number;
use merganser_protocol::geometry::Se3;
use nalgebra::Vector3;
use std::path::Path;

/// How the LiDAR lies to the camera.
pub(super) const CALIBRATION: &str = "calib.txt";
/// How the line is named in which it does, in the odometry set and in others made like it.
const TRANSFORMS: [&str; 3] = ["Tr:", "Tr_velo_to_cam:", "Tr_velo_cam:"];
/// This share of the way along an axis makes it the forward one. Of KITTI's vehicles it is above 0.95.
const FORWARD: f64 = 0.7;
/// Way that tells, m.
const WAY_MIN: f64 = 3.0;
/// Turns, rad, that tell the vertical axis.
const TURN_MIN: f64 = 0.2;

/// Whose poses these are, by how the body moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Mover {
    /// Forward is z, and turns are about y: a camera's axes.
    Camera,
    /// Anything else.
    Other,
}

/// Tells it by the steps from pose to pose.
pub(super) fn mover<'a>(poses: impl Iterator<Item = &'a Se3>) -> Mover {
    let (mut way, mut turn, mut last) = (Vector3::zeros(), Vector3::zeros(), None::<Se3>);
    for pose in poses {
        if let Some(last) = last.replace(*pose) {
            let step = last.inverse() * *pose;
            way += step.translation.abs();
            turn += step.rotation.log();
        }
    }
    // What turns to and fro, as a car that rolls on a straight road, is no turn.
    let turn = turn.abs();
    let is_forward = way.norm() >= WAY_MIN && way.z >= FORWARD * way.norm();
    let is_upright = turn.norm() < TURN_MIN || turn.y > turn.z;
    if is_forward && is_upright { Mover::Camera } else { Mover::Other }
}

/// Poses of the camera become those of the LiDAR, if `calib.txt` tells how; without it they are refused. Says what was
/// done.
pub(super) fn of_lidar(data: &Path, path: &Path, poses: &mut Poses) -> Result<Vec<String>, RecordingError> {
    let mover = mover(poses.poses());
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    if !poses.are_kitti {
        let told = format!(
            "{name}: the poses go along their z axis, as a camera's do; they are taken for the LiDAR's, whose x axis is \
             forward: if they are a camera's, change them into t_world_lidar"
        );
        return Ok(Vec::from_iter((mover == Mover::Camera).then_some(told)));
    }
    let calibration = data.join(CALIBRATION);
    match (mover, calibration.is_file()) {
        (Mover::Other, false) => Ok(Vec::new()),
        (Mover::Other, true) => Ok(vec![format!(
            "{name}: the poses do not go along their z axis, as a camera's do: they are taken for the LiDAR's, and \
             {CALIBRATION} is not used"
        )]),
        (Mover::Camera, true) => {
            let t_camera_lidar = read_transform(&calibration)?;
            poses.map(|pose| t_camera_lidar.inverse() * *pose * t_camera_lidar);
            Ok(vec![format!(
                "{name}: the poses are a camera's (z forward), and were made the LiDAR's by {CALIBRATION}"
            )])
        }
        (Mover::Camera, false) => {
            let why = format!(
                "the poses go along their z axis: they are KITTI's, of the camera, and the scans are in the LiDAR's frame; \
                 put the sequence's {CALIBRATION} (with its line `Tr:`) beside the scans, or state the LiDAR's poses as \
                 `index x y z qx qy qz qw`"
            );
            Err(Problem::Data(why).of(path))
        }
    }
}

/// `t_camera_lidar`.
fn read_transform(path: &Path) -> Result<Se3, RecordingError> {
    for (index, line) in read_text(path)?.lines().enumerate() {
        let line = line.trim();
        let Some(rest) = TRANSFORMS.iter().find_map(|name| line.strip_prefix(name)) else { continue };
        let numbers = rest.split_ascii_whitespace().map(|word| number("Tr", word)).collect::<Result<Vec<_>, _>>();
        return numbers.and_then(|numbers| matrix(&numbers)).map_err(|problem| problem.at(path, index + 1));
    }
    let why =
        "has no line `Tr:` of twelve numbers, the transform from the LiDAR to the camera; take the sequence's own";
    Err(Problem::Data(why.into()).of(path))
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::geometry::So3;

    /// A car on a straight road rolls to and fro by more than it turns.
    #[test]
    fn a_camera_that_rolls_on_a_straight_road_is_one() {
        let step = |k: i32| {
            let roll = if k % 2 == 0 { 0.02 } else { -0.02 };
            Se3::new(So3::exp(&Vector3::new(0.0, 0.003, roll)), Vector3::new(0.0, 0.0, 0.8))
        };
        let camera: Vec<Se3> =
            (0..60).scan(Se3::identity(), |at, k| Some(std::mem::replace(at, *at * step(k)))).collect();
        assert!(mover(camera.iter()) == Mover::Camera);
        // The same way by a LiDAR: x forward, z up.
        let lidar: Vec<Se3> = camera
            .iter()
            .map(|t| {
                let turn = t.rotation.log();
                let at = t.translation;
                Se3::new(So3::exp(&Vector3::new(turn.z, -turn.x, -turn.y)), Vector3::new(at.z, -at.x, -at.y))
            })
            .collect();
        assert!(mover(lidar.iter()) == Mover::Other);
    }
}

//! Scans become keyframes with the wheels' odometry.

use super::Scan;
use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3};
use merganser_protocol::submap::{CovarianceOf, Keyframe};

/// A keyframe is taken after this way, m...
pub(crate) const STEP_M: f64 = 0.25;
/// ...or this turn, rad.
pub(crate) const STEP_RAD: f64 = 0.15;
/// Standard deviations of wheel odometry: along and across, m, a share of the way and so much besides...
const WAY: (f64, f64) = (0.15, 0.02);
/// ...and the heading, rad, per metre and per rad turned and so much besides.
const HEADING: (f64, f64, f64) = (0.05, 0.15, 0.01);
/// Height (m) and tilt (rad) of a robot that drives on a floor.
const OUT_OF_PLANE: (f64, f64) = (1e-3, 1e-4);

/// The covariance of a motion of wheels.
pub(crate) fn driven(motion: &Se3) -> Result<Covariance<6>, CovarianceError> {
    let (way, turn) = (motion.translation.norm(), motion.rotation.angle());
    let along = WAY.0 * way + WAY.1;
    let heading = HEADING.0 * way + HEADING.1 * turn + HEADING.2;
    let (height, tilt) = OUT_OF_PLANE;
    Covariance::from_sigmas([along, along, height, tilt, tilt, heading])
}

/// The scans that lie far enough apart, as keyframes with their real odometry, in the frame of its origin. Covariances
/// are those of motions, as generous as small robots' wheels need.
pub fn keyframes<'a>(scans: impl Iterator<Item = &'a Scan>) -> Vec<Keyframe> {
    let mut keyframes: Vec<Keyframe> = Vec::new();
    for scan in scans.filter(|scan| !scan.points.is_empty()) {
        let motion = keyframes.last().map_or_else(Se3::identity, |last| last.pose.pose.inverse() * scan.pose);
        let (way, turn) = (motion.translation.norm(), motion.rotation.angle());
        if !keyframes.is_empty() && way < STEP_M && turn < STEP_RAD {
            continue;
        }
        let Ok(covariance) = driven(&motion) else { continue };
        let pose = PoseWithCovariance { pose: scan.pose, covariance };
        let (stamp, covariance_of, points) = (scan.stamp, CovarianceOf::Motion, scan.points.clone());
        keyframes.push(Keyframe {
            stamp,
            session: None,
            pose,
            covariance_of,
            points,
            marks: Vec::new(),
            place: None,
            up: None,
        });
    }
    keyframes
}

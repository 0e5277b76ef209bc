//! A robot's drive: the true poses of its keyframes along its path, and the odometry its SLAM would report: every
//! motion disturbed by noise that grows with distance and turn, with exactly the covariance it was drawn from.

use super::path::Path;
use crate::dice::Dice;
use core::f64::consts::TAU;
use libm::sin;
use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3, So3};
use nalgebra::{Vector3, Vector6};
use serde::{Deserialize, Serialize};

/// Height of the body above the ground, m.
const BODY_HEIGHT_M: f64 = 0.8;
/// Standard deviation stated for the first keyframe, which defines the frame (m, rad): as good as exact.
const FIRST_SIGMA: f64 = 1e-6;

/// How robots drive and how well they know it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DriveOptions {
    /// Mean speed, m/s; it varies by 20 % about it.
    pub speed_m_s: f64,
    /// Distance between keyframes, m.
    pub keyframe_m: f64,
    /// Largest roll and pitch, degrees.
    pub tilt_deg: f64,
    /// Translation noise of each motion: m per √m, each axis.
    pub drift_m_per_sqrt_m: f64,
    /// Rotation noise of each motion: degrees per √m, each axis.
    pub drift_deg_per_sqrt_m: f64,
    /// Rotation noise of each motion: share of √(turn), rad per √rad, each axis.
    pub drift_per_sqrt_turn: f64,
}

impl Default for DriveOptions {
    fn default() -> Self {
        Self {
            speed_m_s: 1.0,
            keyframe_m: 0.8,
            tilt_deg: 1.5,
            drift_m_per_sqrt_m: 0.01,
            drift_deg_per_sqrt_m: 0.1,
            drift_per_sqrt_turn: 0.003,
        }
    }
}

/// One keyframe before its scan.
#[derive(Clone, Debug, PartialEq)]
pub struct Step {
    /// Since the drive began, ns.
    pub nanos: u64,
    /// The truth.
    pub t_world_body: Se3,
    /// Motion since the keyframe before, as measured, and the covariance it was drawn from, in the SLAM's unit.
    pub motion: PoseWithCovariance,
    /// The motions chained: the body in the SLAM's frame and unit, which begins at the first keyframe.
    pub t_frame_body: Se3,
}

impl Step {
    /// The same, measured by a SLAM that takes `unit_m` for one.
    ///
    /// # Errors
    /// [`CovarianceError`] if no covariance can be so small, or so large.
    pub fn in_units(self, unit_m: f64) -> Result<Self, CovarianceError> {
        let scaled = |t: &Se3| Se3::new(t.rotation, t.translation / unit_m);
        let per_unit = Vector6::from_fn(|k, _| if k < 3 { 1.0 / unit_m } else { 1.0 });
        let covariance = self.motion.covariance.matrix().component_mul(&(per_unit * per_unit.transpose()));
        let motion = PoseWithCovariance { pose: scaled(&self.motion.pose), covariance: Covariance::new(covariance)? };
        Ok(Self { motion, t_frame_body: scaled(&self.t_frame_body), ..self })
    }
}

/// The keyframes of one robot's drive along `path`, for `secs` seconds or to its end.
///
/// # Errors
/// [`CovarianceError`] if the drift options give a noise that no covariance can hold.
pub fn drive(options: &DriveOptions, path: &Path, secs: f64, dice: &mut Dice) -> Result<Vec<Step>, CovarianceError> {
    let sway = Sway::new(options.tilt_deg, dice);
    let mut steps: Vec<Step> = Vec::new();
    let (mut distance, mut time) = (0.0, 0.0);
    while time <= secs && path.end().is_none_or(|end| distance <= end) {
        let t_world_body = sway.pose(path, distance);
        let (motion, t_frame_body) = match steps.last() {
            None => {
                let covariance = Covariance::from_sigmas([FIRST_SIGMA; 6])?;
                (PoseWithCovariance { pose: Se3::identity(), covariance }, Se3::identity())
            }
            Some(last) => {
                let motion = measure(options, &(last.t_world_body.inverse() * t_world_body), dice)?;
                (motion, last.t_frame_body * motion.pose)
            }
        };
        steps.push(Step { nanos: (time * 1e9) as u64, t_world_body, motion, t_frame_body });
        let speed = options.speed_m_s * (1.0 + 0.2 * sin(0.37 * distance + sway.phases[0]));
        distance += options.keyframe_m;
        time += options.keyframe_m / speed;
    }
    Ok(steps)
}

/// The motion as odometry reports it.
fn measure(options: &DriveOptions, motion: &Se3, dice: &mut Dice) -> Result<PoseWithCovariance, CovarianceError> {
    let (length, turn) = (motion.translation.norm(), motion.rotation.angle());
    let translation = options.drift_m_per_sqrt_m * length.sqrt();
    let rotation = libm::hypot(
        options.drift_deg_per_sqrt_m.to_radians() * length.sqrt(),
        options.drift_per_sqrt_turn * turn.sqrt(),
    );
    let sigmas = [translation, translation, translation, rotation, rotation, rotation];
    let noise = Vector6::from(sigmas.map(|sigma| sigma * dice.normal()));
    Ok(PoseWithCovariance { pose: motion.retract(&noise), covariance: Covariance::from_sigmas(sigmas)? })
}

/// The slight roll, pitch and heave of a body on wheels.
struct Sway {
    tilt: f64,
    phases: [f64; 3],
    waves: [f64; 3],
}

impl Sway {
    fn new(tilt_deg: f64, dice: &mut Dice) -> Self {
        let phases = [0; 3].map(|_| dice.range(0.0, TAU));
        Self { tilt: tilt_deg.to_radians(), phases, waves: [0; 3].map(|_| dice.range(0.5, 1.5)) }
    }

    fn pose(&self, path: &Path, distance: f64) -> Se3 {
        let ([x, y], heading) = path.at(distance);
        let wave = |k: usize| sin(self.waves[k] * distance + self.phases[k]);
        let yaw = So3::exp(&Vector3::new(0.0, 0.0, heading));
        let tilt = So3::exp(&Vector3::new(self.tilt * wave(0), self.tilt * wave(1), 0.0));
        Se3::new(yaw * tilt, Vector3::new(x, y, BODY_HEIGHT_M + 0.03 * wave(2)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn a_drive(seed: u64, secs: f64) -> Vec<Step> {
        let path = Path::of_robot(0, 5.0, 3.0, &mut Dice::new(1, "path"));
        drive(&DriveOptions::default(), &path, secs, &mut Dice::new(seed, "drive")).unwrap()
    }

    #[test]
    fn the_drive_has_the_stated_speed_and_spacing() {
        let steps = a_drive(1, 40.0);
        assert!((45..=55).contains(&steps.len()), "{}", steps.len());
        assert!(steps.windows(2).all(|w| w[0].nanos < w[1].nanos));
        for pair in steps.windows(2) {
            let moved = (pair[1].t_world_body.translation - pair[0].t_world_body.translation).norm();
            assert!((moved - 0.8).abs() < 0.05, "{moved}");
        }
        assert_eq!(steps[0].t_frame_body, Se3::identity());
    }

    #[test]
    fn odometry_noise_fits_its_covariance() {
        let (mut sum, mut count) = (0.0, 0.0);
        for seed in 0..20 {
            for pair in a_drive(seed, 60.0).windows(2) {
                let truth = pair[0].t_world_body.inverse() * pair[1].t_world_body;
                let error = pair[1].motion.pose.local(&truth);
                sum += pair[1].motion.covariance.mahalanobis_squared(&error);
                count += 1.0;
            }
        }
        // χ²₆ has mean 6 and variance 12.
        let mean: f64 = sum / count;
        assert!((mean - 6.0).abs() < 4.0 * (12.0f64 / count).sqrt(), "{mean} over {count}");
    }

    #[test]
    fn drift_adds_up() {
        let steps = a_drive(5, 40.0);
        let last = steps.last().unwrap();
        let truth = steps[0].t_world_body.inverse() * last.t_world_body;
        let off = (truth.translation - last.t_frame_body.translation).norm();
        assert!((0.02..2.0).contains(&off), "{off} m after 40 m");
    }
}

//! Logs of the CARMEN toolkit, as the Radish data sets come: a message a line, of which `FLASER` (a planar scan with
//! the wheels' odometry) and the parameter `robot_frontlaser_offset` are used. Pure text: the caller reads the file.
//!
//! `FLASER n r₁ … rₙ x y θ odom_x odom_y odom_θ ipc_timestamp host logger_timestamp`: ranges in m from right to left
//! over 180°, poses in m and rad. What lies beyond [`RANGE_M`] is left out, and with it readings that stand for no
//! return.

use crate::line_error::LineError;
use core::f64::consts::PI;
use core::ops::RangeInclusive;
use libm::{cos, sin};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::Stamp;
use nalgebra::Vector3;
use thiserror::Error;

/// Bytes of a line at most.
pub const LINE_MAX: usize = 65_536;
/// Readings in a scan at most.
pub const READINGS_MAX: usize = 4096;
/// Scans in a log at most.
pub const SCANS_MAX: usize = 1_000_000;
/// Readings used, m.
pub const RANGE_M: RangeInclusive<f64> = 0.05..=30.0;
/// Positions are accepted up to here, m; a laser is mounted this far from the middle of its robot at most.
const POSITION_MAX_M: f64 = 1e5;
/// Seconds since 1970 are accepted up to here: beyond it nanoseconds do not fit.
const SECONDS_MAX: f64 = 9e9;
/// A keyframe is taken after this way, m...
const STEP_M: f64 = 0.25;
/// ...or this turn, rad.
const STEP_RAD: f64 = 0.15;
/// Standard deviations of wheel odometry: along and across, m, a share of the way and so much besides...
const WAY: (f64, f64) = (0.15, 0.02);
/// ...and the heading, rad, per metre and per rad turned and so much besides.
const HEADING: (f64, f64, f64) = (0.05, 0.15, 0.01);
/// Height (m) and tilt (rad) of a robot that drives on a floor.
const OUT_OF_PLANE: (f64, f64) = (1e-3, 1e-4);

/// A scan.
#[derive(Clone, Debug, PartialEq)]
pub struct Scan {
    /// When (`ipc_timestamp`).
    pub stamp: Stamp,
    /// `t_odometry_body`: where the wheels say the robot is, in the plane z = 0.
    pub pose: Se3,
    /// What the laser hit, body frame, m; x forward, y left, z = 0.
    pub points: Vec<[f32; 3]>,
}

/// A line that cannot be used, and how to mend it.
pub type CarmenError = LineError<BadLine>;

/// What is wrong with a line.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum BadLine {
    /// Too long for any scan.
    #[error("longer than {LINE_MAX} bytes; is the file damaged, or still packed?")]
    TooLong,
    /// Does not begin with a message's name.
    #[error("begins with {0:?}, which names no CARMEN message; is this a CARMEN log?")]
    NoMessage(String),
    /// Fewer or more fields than it should have.
    #[error("a FLASER message of {readings} readings has {expected} fields, not {found}; leave the cut line out")]
    Fields {
        /// What it says itself.
        readings: usize,
        /// Fields due.
        expected: usize,
        /// Fields there.
        found: usize,
    },
    /// Not a usable number of readings.
    #[error("claims {0:?} readings; 2 to {READINGS_MAX} are read")]
    Readings(String),
    /// A field that is no finite number, or absurdly large.
    #[error("{field} = {text:?} is no usable number; leave the line out")]
    Number {
        /// Which.
        field: &'static str,
        /// What it holds.
        text: String,
    },
    /// Stamps that do not rise.
    #[error("the scan is not later than the one before; sort the log by ipc_timestamp and leave repeated scans out")]
    NotLater,
    /// More scans than accepted.
    #[error("more than {SCANS_MAX} scans; cut the log")]
    TooManyScans,
}

/// Reads a log line by line.
#[derive(Clone, Debug, Default)]
pub struct Parser {
    scans: Vec<Scan>,
    line: usize,
    /// How far in front of the robot's middle the laser is, m.
    offset: f64,
}

impl Parser {
    /// Takes the next line.
    ///
    /// # Errors
    /// [`CarmenError`]; the parser is as it was before the line.
    pub fn line(&mut self, text: &str) -> Result<(), CarmenError> {
        self.line += 1;
        self.take(text).map_err(|what| CarmenError { line: self.line, what })
    }

    /// The scans, in rising order of their stamps.
    pub fn finish(self) -> Vec<Scan> {
        self.scans
    }

    fn take(&mut self, text: &str) -> Result<(), BadLine> {
        if text.len() > LINE_MAX {
            return Err(BadLine::TooLong);
        }
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        match words.as_slice() {
            [] => Ok(()),
            ["FLASER", fields @ ..] => {
                let scan = self.scan(fields)?;
                if self.scans.last().is_some_and(|last| scan.stamp <= last.stamp) {
                    return Err(BadLine::NotLater);
                }
                if self.scans.len() == SCANS_MAX {
                    return Err(BadLine::TooManyScans);
                }
                self.scans.push(scan);
                Ok(())
            }
            ["PARAM", "robot_frontlaser_offset", value, ..] => {
                self.offset = number("robot_frontlaser_offset", value, POSITION_MAX_M)?;
                Ok(())
            }
            [name, ..] if name.starts_with('#') || name.chars().all(is_of_name) => Ok(()),
            [name, ..] => Err(BadLine::NoMessage(short(name))),
        }
    }

    fn scan(&self, fields: &[&str]) -> Result<Scan, BadLine> {
        let claim = fields.first().copied().unwrap_or_default();
        let readings = claim.parse().ok().filter(|n| (2..=READINGS_MAX).contains(n));
        let readings = readings.ok_or_else(|| BadLine::Readings(short(claim)))?;
        // Three poses' numbers twice, and a stamp with host and logger's stamp.
        let (found, expected) = (fields.len() + 1, readings + 11);
        if found != expected {
            return Err(BadLine::Fields { readings, expected, found });
        }
        // An even number of readings leaves the last one of the half turn out.
        let step = PI / if readings % 2 == 0 { readings as f64 } else { (readings - 1) as f64 };
        let mut points = Vec::with_capacity(readings);
        for (k, text) in fields[1..=readings].iter().enumerate() {
            let range = number("range", text, f64::MAX)?;
            if RANGE_M.contains(&range) {
                let angle = k as f64 * step - PI / 2.0;
                points.push([(self.offset + range * cos(angle)) as f32, (range * sin(angle)) as f32, 0.0]);
            }
        }
        let rest = &fields[readings + 1..];
        let [x, y] = [number("odom_x", rest[3], POSITION_MAX_M)?, number("odom_y", rest[4], POSITION_MAX_M)?];
        let heading = number("odom_theta", rest[5], POSITION_MAX_M)?;
        let seconds = number("ipc_timestamp", rest[6], SECONDS_MAX)?;
        // Logs are written to the microsecond.
        let stamp = Stamp((seconds * 1e6).round() as i64 * 1000);
        let rotation = So3::exp(&Vector3::new(0.0, 0.0, heading));
        Ok(Scan { stamp, pose: Se3::new(rotation, Vector3::new(x, y, 0.0)), points })
    }
}

fn is_of_name(c: char) -> bool {
    c.is_ascii_uppercase() || c.is_ascii_digit() || "_-".contains(c)
}

fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

/// A finite number of at most `most` in size.
fn number(field: &'static str, text: &str, most: f64) -> Result<f64, BadLine> {
    let value = text.parse().ok().filter(|v: &f64| v.abs() <= most);
    value.ok_or_else(|| BadLine::Number { field, text: short(text) })
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
        let along = WAY.0 * way + WAY.1;
        let heading = HEADING.0 * way + HEADING.1 * turn + HEADING.2;
        let (height, tilt) = OUT_OF_PLANE;
        let Ok(covariance) = Covariance::from_sigmas([along, along, height, tilt, tilt, heading]) else { continue };
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

#[cfg(test)]
mod tests {
    use super::*;

    const GOOD: &str = "FLASER 3 1.0 50.0 2.0 0 0 0 4.0 5.0 0.5 12.000001 host 3.0";

    fn parsed(lines: &[&str]) -> Result<Vec<Scan>, CarmenError> {
        let mut parser = Parser::default();
        lines.iter().try_for_each(|line| parser.line(line))?;
        Ok(parser.finish())
    }

    #[test]
    fn a_scan_is_read_as_the_robot_saw_it() {
        let scans =
            parsed(&["# comment", "", "PARAM robot_frontlaser_offset 0.25 nohost 0", "ODOM 1 2 3", GOOD]).unwrap();
        assert_eq!(scans.len(), 1);
        assert_eq!(scans[0].stamp, Stamp(12_000_001_000));
        assert!((scans[0].pose.translation - Vector3::new(4.0, 5.0, 0.0)).norm() < 1e-12);
        // To the right and to the left; what is ahead is too far.
        let expected = [[0.25, -1.0, 0.0], [0.25, 2.0, 0.0]];
        assert_eq!(scans[0].points.len(), 2);
        for (p, q) in scans[0].points.iter().zip(expected) {
            assert!((0..3).all(|k| (p[k] - q[k] as f32).abs() < 1e-6), "{p:?}");
        }
    }

    #[test]
    fn every_bad_line_is_told_with_its_number() {
        let told = |line: &str| parsed(&["# comment", line]).unwrap_err();
        for cut in 1..GOOD.split(' ').count() {
            let line = GOOD.split(' ').take(cut).collect::<Vec<_>>().join(" ");
            assert_eq!(told(&line).line, 2, "{line}");
        }
        assert!(matches!(told(&format!("{GOOD} 7")).what, BadLine::Fields { readings: 3, expected: 14, found: 15 }));
        assert!(matches!(told("FLASER 1 1.0 0 0 0 0 0 0 1 h 1").what, BadLine::Readings(_)));
        assert!(matches!(told("FLASER 4097 1.0").what, BadLine::Readings(_)));
        assert!(matches!(told("FLASER 4096 1.0").what, BadLine::Fields { readings: 4096, .. }));
        for bad in ["NaN", "inf", "x", "1e300"] {
            assert!(matches!(told(&GOOD.replace("4.0", bad)).what, BadLine::Number { field: "odom_x", .. }), "{bad}");
        }
        assert!(matches!(told(&GOOD.replace("50.0", "NaN")).what, BadLine::Number { field: "range", .. }));
        assert!(matches!(told(&GOOD.replace("12.000001", "1e10")).what, BadLine::Number { .. }));
        assert!(matches!(told("\u{1f}BZh9 x").what, BadLine::NoMessage(_)));
        assert_eq!(told(&" ".repeat(LINE_MAX + 1)).what, BadLine::TooLong);
        assert!(parsed(&[&" ".repeat(LINE_MAX)]).is_ok());
        let error = parsed(&[GOOD, GOOD]).unwrap_err();
        assert_eq!((error.line, error.what), (2, BadLine::NotLater));
    }

    #[test]
    fn keyframes_are_as_far_apart_as_stated() {
        let scan = |k: i32| Scan {
            stamp: Stamp(i64::from(k)),
            pose: Se3::new(So3::identity(), Vector3::new(0.1 * f64::from(k), 0.0, 0.0)),
            points: vec![[1.0, 0.0, 0.0]],
        };
        let scans: Vec<Scan> = (0..10).map(scan).collect();
        let stamps: Vec<i64> = keyframes(scans.iter()).iter().map(|k| k.stamp.0).collect();
        assert_eq!(stamps, [0, 3, 6, 9]);
        let blind = scans.iter().map(|s| Scan { points: vec![], ..s.clone() }).collect::<Vec<_>>();
        assert!(keyframes(blind.iter()).is_empty());
    }
}

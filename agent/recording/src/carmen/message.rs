//! Messages that hold a scan with the robot's odometry, field by field.

use super::{BadLine, Scan, short};
use core::f64::consts::PI;
use core::ops::RangeInclusive;
use libm::{cos, sin};
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::time::Stamp;
use nalgebra::Vector3;

/// Readings in a scan at most.
pub const READINGS_MAX: usize = 4096;
/// Readings used, m.
pub const RANGE_M: RangeInclusive<f64> = 0.05..=30.0;
/// Positions are accepted up to here, m, and headings up to as many rad.
pub(super) const POSITION_MAX_M: f64 = 1e5;
/// Seconds since 1970 are accepted up to here: beyond it nanoseconds do not fit.
const SECONDS_MAX: f64 = 9e9;
/// Fields of a `FLASER` beside its readings: name, count, laser's and robot's pose, stamp, host, logger's stamp.
const FLASER_FIELDS: usize = 11;
/// Fields of a `ROBOTLASER1` beside its readings and remissions: name, type, four of its beams, accuracy and mode,
/// two counts, laser's and robot's pose, two speeds, two safety distances, turn axis, stamp, host, logger's stamp.
const ROBOTLASER_FIELDS: usize = 24;

/// `FLASER n r₁ … rₙ x y θ odom_x odom_y odom_θ ipc_timestamp host logger_timestamp`, without its name, of a laser
/// `offset` m in front of the robot's middle. The beams go over 180° from right to left.
pub(super) fn flaser(fields: &[&str], offset: f64) -> Result<Scan, BadLine> {
    let readings = count("readings", fields.first(), 2)?;
    expect("FLASER", fields, readings, readings + FLASER_FIELDS)?;
    // An even number of readings leaves the last one of the half turn out.
    let step = PI / if readings % 2 == 0 { readings as f64 } else { (readings - 1) as f64 };
    let beams = Beams { start: -PI / 2.0, step, range_max: f64::INFINITY };
    let t_body_laser = Se3::new(So3::identity(), Vector3::new(offset, 0.0, 0.0));
    let points = beams.points(&fields[1..=readings], &t_body_laser)?;
    let rest = &fields[readings + 1..];
    Ok(Scan { stamp: stamp(rest[6])?, pose: pose(["odom_x", "odom_y", "odom_theta"], &rest[3..6])?, points })
}

/// `ROBOTLASER1 type start_angle field_of_view angular_resolution maximum_range accuracy remission_mode n r₁ … rₙ m
/// i₁ … iₘ laser_x laser_y laser_θ robot_x robot_y robot_θ tv rv forward_safety_dist side_safety_dist turn_axis
/// ipc_timestamp host logger_timestamp`, without its name. The beams begin at `start_angle`, and both poses are of the
/// odometry: how the laser is mounted lies between them.
pub(super) fn robotlaser(fields: &[&str]) -> Result<Scan, BadLine> {
    const NAME: &str = "ROBOTLASER1";
    let readings = count("readings", fields.get(7), 2)?;
    // Where the line is cut before the second count, that is what is wrong.
    let remissions = fields.get(8 + readings).map_or(Ok(0), |text| count("remissions", Some(text), 0))?;
    expect(NAME, fields, readings, readings + remissions + ROBOTLASER_FIELDS)?;
    let beams = Beams {
        start: number("start_angle", fields[1], 2.0 * PI)?,
        step: number("angular_resolution", fields[3], PI).and_then(|step| match step {
            step if step > 0.0 => Ok(step),
            _ => Err(BadLine::Number { field: "angular_resolution", text: short(fields[3]) }),
        })?,
        range_max: number("maximum_range", fields[4], f64::MAX)?,
    };
    let rest = &fields[9 + readings + remissions..];
    let t_odometry_laser = pose(["laser_x", "laser_y", "laser_theta"], &rest[..3])?;
    let t_odometry_body = pose(["robot_x", "robot_y", "robot_theta"], &rest[3..6])?;
    let points = beams.points(&fields[8..8 + readings], &(t_odometry_body.inverse() * t_odometry_laser))?;
    Ok(Scan { stamp: stamp(rest[11])?, pose: t_odometry_body, points })
}

/// How a scan's readings lie.
struct Beams {
    /// Direction of the first, rad from straight ahead to the left.
    start: f64,
    /// From one to the next, rad.
    step: f64,
    /// A reading of so much, m, or more is none.
    range_max: f64,
}

impl Beams {
    /// The points that were hit, in the body frame.
    fn points(&self, ranges: &[&str], t_body_laser: &Se3) -> Result<Vec<[f32; 3]>, BadLine> {
        let mut points = Vec::with_capacity(ranges.len());
        for (k, text) in ranges.iter().enumerate() {
            let range = number("range", text, f64::MAX)?;
            if RANGE_M.contains(&range) && range < self.range_max {
                let angle = self.start + k as f64 * self.step;
                let point = *t_body_laser * Vector3::new(range * cos(angle), range * sin(angle), 0.0);
                points.push(point.map(|x| x as f32).into());
            }
        }
        Ok(points)
    }
}

fn count(of: &'static str, text: Option<&&str>, least: usize) -> Result<usize, BadLine> {
    let claim = text.copied().unwrap_or_default();
    let found = claim.parse().ok().filter(|n| (least..=READINGS_MAX).contains(n));
    found.ok_or_else(|| BadLine::Count { of, text: short(claim), least })
}

/// `fields` are without the message's name, `expected` counts it.
fn expect(message: &'static str, fields: &[&str], readings: usize, expected: usize) -> Result<(), BadLine> {
    match fields.len() + 1 {
        found if found == expected => Ok(()),
        found => Err(BadLine::Fields { message, readings, expected, found }),
    }
}

fn pose(names: [&'static str; 3], texts: &[&str]) -> Result<Se3, BadLine> {
    let [x, y, heading] = [0, 1, 2].map(|k| number(names[k], texts[k], POSITION_MAX_M));
    let (x, y, heading) = (x?, y?, heading?);
    Ok(Se3::new(So3::exp(&Vector3::new(0.0, 0.0, heading)), Vector3::new(x, y, 0.0)))
}

/// Logs are written to the microsecond.
fn stamp(text: &str) -> Result<Stamp, BadLine> {
    let seconds = number("ipc_timestamp", text, SECONDS_MAX)?;
    Ok(Stamp((seconds * 1e6).round() as i64 * 1000))
}

/// A finite number of at most `most` in size.
pub(super) fn number(field: &'static str, text: &str, most: f64) -> Result<f64, BadLine> {
    let value = text.parse().ok().filter(|v: &f64| v.abs() <= most);
    value.ok_or_else(|| BadLine::Number { field, text: short(text) })
}

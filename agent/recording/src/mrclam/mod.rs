//! The logs of the MRCLAM data sets (Leung et al., IJRR 2011): robots that drive in a plane, their commanded speeds,
//! and range and bearing to bar codes, which landmarks and robots carry. Pure text: the caller reads the files.
//!
//! A line holds numbers: `time forward_velocity angular_velocity` (s, m/s, rad/s) in an odometry file, `time barcode
//! range bearing` (s, m, rad) in a measurement file, `subject barcode` in `Barcodes.dat`, where robots are the first
//! subjects. What begins with `#` is a remark.
//!
//! `front` and `smooth` stand in for the robots' own SLAM.

mod front;
mod smooth;

pub use front::{Calibration, keyframes, position};

use crate::line_error::LineError;
use merganser_protocol::time::Stamp;
use std::collections::BTreeMap;
use thiserror::Error;

/// Bytes of a line at most.
pub const LINE_MAX: usize = 1024;
/// Lines of one file at most.
pub const LINES_MAX: usize = 4_000_000;
/// Subjects at most.
pub const SUBJECTS_MAX: usize = 1_000;
/// Ranges used, m.
pub const RANGE_M: core::ops::RangeInclusive<f64> = 0.05..=50.0;
/// Seconds since 1970 are accepted up to here: beyond it nanoseconds do not fit.
const SECONDS_MAX: f64 = 9e9;
/// Speeds (m/s, rad/s) and bearings (rad) are accepted up to here.
const SPEED_MAX: f64 = 100.0;

/// A line that cannot be used, and how to mend it.
pub type MrclamError = LineError<BadLine>;

/// What is wrong with a line.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum BadLine {
    /// Longer than any line of numbers.
    #[error("longer than {LINE_MAX} bytes; is the file damaged, or still packed?")]
    TooLong,
    /// Fewer or more numbers than it should have.
    #[error("{found} numbers instead of {expected} ({columns}); leave the cut line out")]
    Fields {
        /// Numbers there.
        found: usize,
        /// Numbers due.
        expected: usize,
        /// What they are.
        columns: &'static str,
    },
    /// A field that is no number, or out of range.
    #[error("{column} = {text:?} is no usable number; leave the line out")]
    Number {
        /// Which.
        column: String,
        /// What it holds.
        text: String,
    },
    /// Time goes back.
    #[error("the time is before that of the line above; sort the file by time")]
    Earlier,
    /// More lines than accepted.
    #[error("more than {LINES_MAX} lines; cut the file")]
    TooManyLines,
    /// Two subjects with one bar code, or more than accepted.
    #[error("subject or bar code comes twice, or there are more than {SUBJECTS_MAX}; each subject has its own")]
    Subjects,
}

/// A commanded speed, which holds until the next.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Speed {
    /// Since when.
    pub stamp: Stamp,
    /// m/s, forward.
    pub forward: f64,
    /// rad/s, to the left.
    pub angular: f64,
}

/// A sighting of a bar code.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// When.
    pub stamp: Stamp,
    /// Whose bar code.
    pub barcode: u32,
    /// m.
    pub range: f64,
    /// rad, to the left of straight ahead.
    pub bearing: f64,
}

/// Reads an odometry file.
///
/// # Errors
/// [`MrclamError`] for the first bad line.
pub fn speeds(text: &str) -> Result<Vec<Speed>, MrclamError> {
    let mut speeds: Vec<Speed> = Vec::new();
    lines(text, "time, forward velocity, angular velocity", |fields: [&str; 3]| {
        let [time, forward, angular] = fields;
        let speed = Speed {
            stamp: stamp(time)?,
            forward: number("forward velocity", forward, SPEED_MAX)?,
            angular: number("angular velocity", angular, SPEED_MAX)?,
        };
        in_order(speeds.last().map(|last| last.stamp), speed.stamp)?;
        speeds.push(speed);
        Ok(())
    })?;
    Ok(speeds)
}

/// Reads a measurement file. Sightings out of [`RANGE_M`] are left out.
///
/// # Errors
/// [`MrclamError`] for the first bad line.
pub fn sightings(text: &str) -> Result<Vec<Sighting>, MrclamError> {
    let mut sightings: Vec<Sighting> = Vec::new();
    lines(text, "time, barcode, range, bearing", |fields: [&str; 4]| {
        let [time, barcode, range, bearing] = fields;
        let sighting = Sighting {
            stamp: stamp(time)?,
            barcode: whole("barcode", barcode)?,
            range: number("range", range, f64::from(u32::MAX))?,
            bearing: number("bearing", bearing, SPEED_MAX)?,
        };
        in_order(sightings.last().map(|last| last.stamp), sighting.stamp)?;
        sightings.push(sighting);
        Ok(())
    })?;
    sightings.retain(|s| RANGE_M.contains(&s.range));
    Ok(sightings)
}

/// Reads `Barcodes.dat`: the subject of each bar code.
///
/// # Errors
/// [`MrclamError`] for the first bad line.
pub fn subjects(text: &str) -> Result<BTreeMap<u32, u32>, MrclamError> {
    let mut subjects = BTreeMap::new();
    lines(text, "subject, barcode", |[subject, barcode]: [&str; 2]| {
        let (subject, barcode) = (whole("subject", subject)?, whole("barcode", barcode)?);
        let known = subjects.values().any(|s| *s == subject) || subjects.len() == SUBJECTS_MAX;
        if known || subjects.insert(barcode, subject).is_some() {
            return Err(BadLine::Subjects);
        }
        Ok(())
    })?;
    Ok(subjects)
}

/// Calls `take` with the numbers of each line that is neither empty nor a remark.
fn lines<const N: usize>(
    text: &str,
    columns: &'static str,
    mut take: impl FnMut([&str; N]) -> Result<(), BadLine>,
) -> Result<(), MrclamError> {
    for (index, line) in text.lines().enumerate() {
        let mut take_line = || {
            if index >= LINES_MAX {
                return Err(BadLine::TooManyLines);
            }
            if line.len() > LINE_MAX {
                return Err(BadLine::TooLong);
            }
            let fields: Vec<&str> = line.split_ascii_whitespace().collect();
            if fields.first().is_none_or(|first| first.starts_with('#')) {
                return Ok(());
            }
            let found = fields.len();
            take(fields.try_into().map_err(|_| BadLine::Fields { found, expected: N, columns })?)
        };
        take_line().map_err(|what| MrclamError { line: index + 1, what })?;
    }
    Ok(())
}

fn in_order(last: Option<Stamp>, next: Stamp) -> Result<(), BadLine> {
    if last.is_some_and(|last| next < last) { Err(BadLine::Earlier) } else { Ok(()) }
}

/// To the millisecond, as the logs state it.
fn stamp(text: &str) -> Result<Stamp, BadLine> {
    Ok(Stamp((number("time", text, SECONDS_MAX)? * 1e3).round() as i64 * 1_000_000))
}

fn number(column: &str, text: &str, largest: f64) -> Result<f64, BadLine> {
    // Negated, so that NaN is refused too.
    text.parse().ok().filter(|x: &f64| x.abs() <= largest).ok_or_else(|| bad(column, text))
}

fn whole(column: &str, text: &str) -> Result<u32, BadLine> {
    text.parse().map_err(|_| bad(column, text))
}

fn bad(column: &str, text: &str) -> BadLine {
    BadLine::Number { column: column.to_owned(), text: text.chars().take(40).collect() }
}

#[cfg(test)]
mod tests;

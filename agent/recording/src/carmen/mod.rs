//! Logs of the CARMEN toolkit, as the Radish data sets come: a message a line, of which `FLASER` and `ROBOTLASER1` (a
//! planar scan with the wheels' odometry) and the parameter `robot_frontlaser_offset` (of `FLASER`) are used. Pure
//! text: the caller reads the file.
//!
//! Ranges are in m, poses in m and rad. What lies beyond [`RANGE_M`] is left out, and with it readings that stand for
//! no return.

mod keyframes;
mod message;

pub use keyframes::keyframes;
pub(crate) use keyframes::{STEP_M, STEP_RAD, driven};
pub use message::{RANGE_M, READINGS_MAX};

use crate::line_error::LineError;
use merganser_protocol::geometry::Se3;
use merganser_protocol::time::Stamp;
use message::{POSITION_MAX_M, flaser, number, robotlaser};
use thiserror::Error;

/// Bytes of a line at most.
pub const LINE_MAX: usize = 65_536;
/// Scans in a log at most.
pub const SCANS_MAX: usize = 1_000_000;

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

/// The scans of a log.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Log {
    /// In rising order of their stamps, no two of which are equal.
    pub scans: Vec<Scan>,
    /// Scans that stood behind a later one, and were sorted in.
    pub late: usize,
    /// Scans with the stamp of one before them in the log, and left out.
    pub repeated: usize,
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
    #[error("a {message} message of {readings} readings has {expected} fields, not {found}; leave the cut line out")]
    Fields {
        /// Which.
        message: &'static str,
        /// What it says itself.
        readings: usize,
        /// Fields due.
        expected: usize,
        /// Fields there.
        found: usize,
    },
    /// Not a usable number of readings or remissions.
    #[error("claims {text:?} {of}; {least} to {READINGS_MAX} are read")]
    Count {
        /// Of what.
        of: &'static str,
        /// What it holds.
        text: String,
        /// How many there must be.
        least: usize,
    },
    /// A field that is no finite number, or absurdly large.
    #[error("{field} = {text:?} is no usable number; leave the line out")]
    Number {
        /// Which.
        field: &'static str,
        /// What it holds.
        text: String,
    },
    /// More scans than accepted.
    #[error("more than {SCANS_MAX} scans; cut the log")]
    TooManyScans,
}

/// Reads a log line by line.
#[derive(Clone, Debug, Default)]
pub struct Parser {
    scans: Vec<Scan>,
    line: usize,
    /// How far in front of the robot's middle the laser of `FLASER` is, m.
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

    /// What was read. Logs are written as messages arrive, and some arrive late or twice: scans are sorted by their
    /// stamps, and of those with one stamp the first is kept.
    pub fn finish(self) -> Log {
        let mut scans = self.scans;
        let mut latest = None;
        let is_late = |scan: &&Scan| {
            let late = latest.is_some_and(|latest| scan.stamp < latest);
            latest = latest.max(Some(scan.stamp));
            late
        };
        let late = scans.iter().filter(is_late).count();
        let all = scans.len();
        scans.sort_by_key(|scan| scan.stamp);
        scans.dedup_by_key(|scan| scan.stamp);
        Log { late, repeated: all - scans.len(), scans }
    }

    fn take(&mut self, text: &str) -> Result<(), BadLine> {
        if text.len() > LINE_MAX {
            return Err(BadLine::TooLong);
        }
        let words: Vec<&str> = text.split_ascii_whitespace().collect();
        let scan = match words.as_slice() {
            [] => return Ok(()),
            ["FLASER", fields @ ..] => flaser(fields, self.offset)?,
            ["ROBOTLASER1", fields @ ..] => robotlaser(fields)?,
            ["PARAM", "robot_frontlaser_offset", value, ..] => {
                self.offset = number("robot_frontlaser_offset", value, POSITION_MAX_M)?;
                return Ok(());
            }
            [name, ..] if name.starts_with('#') || name.chars().all(is_of_name) => return Ok(()),
            [name, ..] => return Err(BadLine::NoMessage(short(name))),
        };
        if self.scans.len() == SCANS_MAX {
            return Err(BadLine::TooManyScans);
        }
        self.scans.push(scan);
        Ok(())
    }
}

fn is_of_name(c: char) -> bool {
    c.is_ascii_uppercase() || c.is_ascii_digit() || "_-".contains(c)
}

fn short(text: &str) -> String {
    text.chars().take(40).collect()
}

#[cfg(test)]
mod tests;

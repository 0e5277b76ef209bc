//! Kimera-Multi's measurement tables (`measurements.csv`, one a robot): decides which rows make a sound pose graph.
//!
//! Columns, by name: `robot_src, pose_src, robot_dst, pose_dst, qx, qy, qz, qw, tx, ty, tz, kappa, tau`, and optionally
//! `is_known_inlier, weight`. A pose becomes the g2o id with the robot's letter in the top byte, as GTSAM's symbols
//! are.

use super::g2o::LENGTH_MAX;
use super::lines::{Files, without_mark};
use super::{MEASUREMENTS_MAX, Measurement, POSES_MAX, PoseGraph, isotropic_information, printed_matrix};
use crate::geometry::Se3;
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Robots an import may hold: as many as there are letters.
pub const ROBOTS_MAX: u64 = 26;
/// Poses of one robot: what fits below the letter.
const INDEX_MAX: u64 = (1 << 56) - 1;

/// A row that cannot be part of a pose graph.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("line {line}: {what}")]
pub struct KimeraError {
    /// Which line, from 1.
    pub line: usize,
    /// What is wrong with it, and how to mend it.
    pub what: KimeraFault,
}

/// What is wrong with a row.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum KimeraFault {
    /// The first line lacks a column.
    #[error("the first line names no column {0:?}")]
    Column(&'static str),
    /// A row with too few fields.
    #[error("{got} fields, the first line names {want} columns")]
    Fields {
        /// Columns.
        want: usize,
        /// Fields.
        got: usize,
    },
    /// A field that is no number, or not one its column can hold.
    #[error("column {column}: {text:?} is not {want}")]
    Number {
        /// Which column.
        column: &'static str,
        /// What it holds.
        text: String,
        /// What it should.
        want: &'static str,
    },
    /// Both ends are one pose.
    #[error("measures a pose against itself; leave the row out")]
    SelfLoop,
    /// Too many poses.
    #[error("more than {POSES_MAX} poses")]
    Poses,
    /// Too many measurements.
    #[error("more than {MEASUREMENTS_MAX} measurements")]
    Measurements,
}

/// What a row says of its measurement.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Recorded {
    /// Known to be right (odometry).
    pub known: bool,
    /// Weight a robust solver gave it.
    pub weight: f64,
}

/// Reads tables row by row; robots' tables may repeat each other's rows.
#[derive(Clone, Debug, Default)]
pub struct Importer {
    graph: PoseGraph,
    recorded: Vec<Recorded>,
    seen: BTreeSet<(u64, u64)>,
    columns: Vec<String>,
    files: Files,
}

impl Importer {
    /// Begins the next table.
    pub fn begin(&mut self) {
        self.files.begin();
        self.columns = Vec::new();
    }

    /// Takes the next line of the table.
    ///
    /// # Errors
    /// [`KimeraError`] with its number; nothing of the line is taken then.
    pub fn line(&mut self, text: &str) -> Result<(), KimeraError> {
        let line = self.files.advance();
        self.take(without_mark(text, line)).map_err(|what| KimeraError { line, what })
    }

    /// The graph, and what was recorded of each measurement.
    pub fn finish(self) -> (PoseGraph, Vec<Recorded>) {
        (self.graph, self.recorded)
    }

    fn take(&mut self, text: &str) -> Result<(), KimeraFault> {
        if text.trim().is_empty() {
            return Ok(());
        }
        let fields: Vec<&str> = text.split(',').map(str::trim).collect();
        if self.columns.is_empty() {
            const WANTED: [&str; 13] = [
                "robot_src",
                "pose_src",
                "robot_dst",
                "pose_dst",
                "qx",
                "qy",
                "qz",
                "qw",
                "tx",
                "ty",
                "tz",
                "kappa",
                "tau",
            ];
            if let Some(missing) = WANTED.into_iter().find(|name| !fields.contains(name)) {
                return Err(KimeraFault::Column(missing));
            }
            self.columns = fields.into_iter().map(str::to_owned).collect();
            return Ok(());
        }
        if fields.len() != self.columns.len() {
            return Err(KimeraFault::Fields { want: self.columns.len(), got: fields.len() });
        }
        let row: BTreeMap<&str, &str> = self.columns.iter().map(String::as_str).zip(fields).collect();
        let i = pose_id(&row, "robot_src", "pose_src")?;
        let j = pose_id(&row, "robot_dst", "pose_dst")?;
        let number = |column| number(&row, column);
        let xyzw = [number("qx")?, number("qy")?, number("qz")?, number("qw")?];
        let norm = xyzw.iter().map(|x| x * x).sum::<f64>().sqrt();
        let length = |column| length(&row, column);
        let unit = Se3::from_xyzw(xyzw.map(|x| x / norm), [length("tx")?, length("ty")?, length("tz")?]);
        let fault = |want| wrong(&row, "qw", want);
        let t_i_j = unit.filter(|_| (norm - 1.0).abs() < 1e-2).ok_or_else(|| fault("part of a unit quaternion"))?;
        let (kappa, tau) = (positive(&row, "kappa")?, positive(&row, "tau")?);
        let recorded = Recorded {
            known: row.get("is_known_inlier").is_some_and(|&text| text == "1"),
            weight: if row.contains_key("weight") { number("weight")? } else { 1.0 },
        };
        let (printed, information, line) = (printed_matrix(xyzw), isotropic_information(kappa, tau), self.files.last());
        self.add(Measurement { i, j, t_i_j, printed, information, kappa, tau, line }, recorded)
    }

    fn add(&mut self, m: Measurement, recorded: Recorded) -> Result<(), KimeraFault> {
        if m.i == m.j {
            return Err(KimeraFault::SelfLoop);
        }
        if !self.seen.insert((m.i, m.j)) {
            return Ok(());
        }
        if self.graph.measurements.len() == MEASUREMENTS_MAX {
            return Err(KimeraFault::Measurements);
        }
        self.graph.poses.entry(m.i).or_default();
        self.graph.poses.entry(m.j).or_default();
        if self.graph.poses.len() > POSES_MAX {
            return Err(KimeraFault::Poses);
        }
        self.graph.measurements.push(m);
        self.recorded.push(recorded);
        Ok(())
    }
}

/// The id of a robot's pose: its letter in the top byte.
fn pose_id(row: &BTreeMap<&str, &str>, robot: &'static str, pose: &'static str) -> Result<u64, KimeraFault> {
    let whole = |column: &'static str, below: u64, want| {
        let text = row[column];
        let value = text.parse::<u64>().ok().filter(|&x| x < below);
        value.ok_or_else(|| KimeraFault::Number { column, text: text.chars().take(40).collect(), want })
    };
    let letter = u64::from(b'a') + whole(robot, ROBOTS_MAX, "a robot's number, 0 to 25")?;
    Ok(letter << 56 | whole(pose, INDEX_MAX, "a pose's number")?)
}

fn wrong(row: &BTreeMap<&str, &str>, column: &'static str, want: &'static str) -> KimeraFault {
    KimeraFault::Number { column, text: row[column].chars().take(40).collect(), want }
}

fn number(row: &BTreeMap<&str, &str>, column: &'static str) -> Result<f64, KimeraFault> {
    row[column].parse::<f64>().ok().filter(|x| x.is_finite()).ok_or_else(|| wrong(row, column, "a finite number"))
}

fn length(row: &BTreeMap<&str, &str>, column: &'static str) -> Result<f64, KimeraFault> {
    let value = number(row, column)?;
    if value.abs() <= LENGTH_MAX { Ok(value) } else { Err(wrong(row, column, "a length of up to 1e12 m")) }
}

fn positive(row: &BTreeMap<&str, &str>, column: &'static str) -> Result<f64, KimeraFault> {
    let value = number(row, column)?;
    // Twice a weight is an information.
    let is_weight = value > 0.0 && (2.0 * value).is_finite();
    if is_weight { Ok(value) } else { Err(wrong(row, column, "a positive number")) }
}

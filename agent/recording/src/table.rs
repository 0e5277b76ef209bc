//! `keyframes.csv`, `truth.csv` and their like: strict tables of numbers. A line that is not exactly what the header
//! promises refuses the recording; nothing is guessed or skipped.

use super::error::{Problem, RecordingError, on};
use super::unmeasured::marked_unmeasured;
use crate::manifest::{KEYFRAMES_HEADER, KEYFRAMES_MAX, POSITIONS_HEADER, TRUTH_HEADER, UP_HEADER};
use crate::observation::{COORDINATE_MAX, PositionMessage};
use merganser_protocol::agent::io::PositionSighting;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::Up;
use merganser_protocol::time::Stamp;
use nalgebra::{Matrix6, Vector3};
use std::fs::File;
use std::io::{BufRead, BufReader, Read};
use std::path::{Component, Path, PathBuf};

/// Longest line of a table: 29 numbers and a path fit many times over.
const LINE_BYTES_MAX: usize = 8192;
/// Columns of a pose.
const POSE: [&str; 7] = ["x", "y", "z", "qx", "qy", "qz", "qw"];
/// Columns of a covariance: the row-major upper triangle.
const COVARIANCE: [&str; 21] = [
    "c00", "c01", "c02", "c03", "c04", "c05", "c11", "c12", "c13", "c14", "c15", "c22", "c23", "c24", "c25", "c33",
    "c34", "c35", "c44", "c45", "c55",
];

/// One line of `keyframes.csv`.
#[derive(Clone, Debug, PartialEq)]
pub struct KeyframeLine {
    /// When, on the robot's clock.
    pub stamp: Stamp,
    /// `t_frame_body` with the covariance that the manifest's `covariance_of` explains.
    pub pose: PoseWithCovariance,
    /// The cloud's file, relative to the recording's folder.
    pub cloud: PathBuf,
}

/// One line of `truth.csv`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TruthLine {
    /// The keyframe's stamp.
    pub stamp: Stamp,
    /// `t_world_body`.
    pub pose: Se3,
}

/// Reads `keyframes.csv`; stamps are seen to rise.
pub(super) fn read_keyframes(path: &Path) -> Result<Vec<KeyframeLine>, RecordingError> {
    let mut lines: Vec<KeyframeLine> = Vec::new();
    read(path, KEYFRAMES_HEADER, |fields| {
        let line = KeyframeLine {
            stamp: stamp(fields[0])?,
            pose: PoseWithCovariance { pose: pose(&fields[1..8])?, covariance: covariance(&fields[8..29])? },
            cloud: cloud(fields[29])?,
        };
        if let Some(previous) = lines.last().map(|line| line.stamp).filter(|previous| *previous >= line.stamp) {
            return Err(Problem::Unsorted { stamp: line.stamp.0, previous: previous.0 });
        }
        lines.push(line);
        Ok(())
    })?;
    Ok(lines)
}

/// Reads `truth.csv`.
pub(super) fn read_truth(path: &Path) -> Result<Vec<TruthLine>, RecordingError> {
    let mut lines = Vec::new();
    read(path, TRUTH_HEADER, |fields| {
        lines.push(TruthLine { stamp: stamp(fields[0])?, pose: pose(&fields[1..8])? });
        Ok(())
    })?;
    Ok(lines)
}

/// Reads `positions.csv`; stamps are seen not to fall.
pub(super) fn read_positions(path: &Path) -> Result<Vec<PositionSighting>, RecordingError> {
    let mut lines: Vec<PositionSighting> = Vec::new();
    read(path, POSITIONS_HEADER, |fields| {
        let mut values = [0.0; 9];
        for ((value, text), column) in values.iter_mut().zip(&fields[2..]).zip(POSITIONS_HEADER.split(',').skip(2)) {
            *value = number(column, text)?;
        }
        let [x, y, z, covariance @ ..] = values;
        let robot = Name::new(fields[1]).map_err(|error| Problem::Data(error.to_string()))?;
        let message = PositionMessage { stamp_ns: stamp(fields[0])?.0, robot, position: [x, y, z], covariance };
        let line = PositionSighting::try_from(message).map_err(|error| Problem::Data(error.to_string()))?;
        if let Some(previous) = lines.last().map(|line| line.stamp).filter(|previous| *previous > line.stamp) {
            return Err(Problem::Unsorted { stamp: line.stamp.0, previous: previous.0 });
        }
        lines.push(line);
        Ok(())
    })?;
    Ok(lines)
}

/// Reads `up.csv`: of each keyframe of the recording that it names, in their order, what it takes for up.
pub(super) fn read_ups(path: &Path, keyframes: &[KeyframeLine]) -> Result<Vec<Option<Up>>, RecordingError> {
    let mut ups = vec![None; keyframes.len()];
    let mut later = 0;
    read(path, UP_HEADER, |fields| {
        let stamp = stamp(fields[0])?;
        let mut values = [0.0; 4];
        for ((value, text), column) in values.iter_mut().zip(&fields[1..]).zip(UP_HEADER.split(',').skip(1)) {
            *value = number(column, text)?;
        }
        let [x, y, z, sigma_rad] = values;
        let up = Up::new([x, y, z], sigma_rad).map_err(|error| Problem::Data(error.to_string()))?;
        let after = keyframes[later..].iter().position(|line| line.stamp == stamp);
        let Some(after) = after else {
            let said = format!("no keyframe after the one of the line above has the stamp {}", stamp.0);
            return Err(Problem::Data(said));
        };
        ups[later + after] = Some(up);
        later += after + 1;
        Ok(())
    })?;
    Ok(ups)
}

/// Calls `take` with the fields of each line after the header, whose number of columns they have.
fn read(
    path: &Path,
    header: &'static str,
    mut take: impl FnMut(&[&str]) -> Result<(), Problem>,
) -> Result<(), RecordingError> {
    let mut reader = BufReader::new(on(path, File::open(path))?);
    let columns = header.split(',').count();
    let mut line = Vec::new();
    for number in 1.. {
        line.clear();
        let limit = LINE_BYTES_MAX as u64 + 1;
        if on(path, reader.by_ref().take(limit).read_until(b'\n', &mut line))? == 0 {
            if number == 1 {
                return Err(Problem::Header(header).at(path, 1));
            }
            break;
        }
        if line.len() > LINE_BYTES_MAX {
            return Err(Problem::LineLength(LINE_BYTES_MAX).at(path, number));
        }
        if number > KEYFRAMES_MAX + 1 {
            return Err(Problem::KeyframesRange(number - 1).at(path, number));
        }
        let text =
            str::from_utf8(&line).map_err(|_| Problem::Data("is no text; save it as UTF-8".into()).at(path, number))?;
        let text = text.trim_end_matches(['\n', '\r']);
        if number == 1 {
            if text != header {
                return Err(Problem::Header(header).at(path, 1));
            }
            continue;
        }
        let fields: Vec<&str> = text.split(',').collect();
        if fields.len() != columns {
            return Err(Problem::Fields { found: fields.len(), expected: columns }.at(path, number));
        }
        take(&fields).map_err(|problem| problem.at(path, number))?;
    }
    Ok(())
}

fn stamp(text: &str) -> Result<Stamp, Problem> {
    text.parse().map(Stamp).map_err(|_| Problem::Number { column: "stamp_ns", text: text.into() })
}

fn pose(fields: &[&str]) -> Result<Se3, Problem> {
    let mut v = [0.0; 7];
    for ((value, text), column) in v.iter_mut().zip(fields).zip(POSE) {
        *value = number(column, text)?;
    }
    pose_of(v)
}

/// A pose from `x, y, z, qx, qy, qz, qw`.
pub(super) fn pose_of([x, y, z, qx, qy, qz, qw]: [f64; 7]) -> Result<Se3, Problem> {
    let q = [qx, qy, qz, qw];
    let length = q.iter().map(|c| c * c).sum::<f64>().sqrt();
    // A quaternion printed with three decimals is still within this; anything else is another kind of number.
    if (length - 1.0).abs() > 1e-2 {
        return Err(Problem::Quaternion(length));
    }
    let rotation = So3::from_xyzw(q).ok_or(Problem::Quaternion(length))?;
    near(Se3::new(rotation, Vector3::new(x, y, z)))
}

/// Refuses a pose too far from the origin.
pub(super) fn near(pose: Se3) -> Result<Se3, Problem> {
    if pose.translation.iter().all(|x| x.abs() <= COORDINATE_MAX) { Ok(pose) } else { Err(Problem::Far) }
}

fn covariance(fields: &[&str]) -> Result<Covariance<6>, Problem> {
    let mut m = Matrix6::zeros();
    let upper = (0..6).flat_map(|row| (row..6).map(move |column| (row, column)));
    for (((row, column), text), name) in upper.zip(fields).zip(COVARIANCE) {
        let value = number(name, text)?;
        m[(row, column)] = value;
        m[(column, row)] = value;
    }
    Ok(Covariance::new(marked_unmeasured(m))?)
}

/// A cloud's path: relative, and inside the folder.
fn cloud(text: &str) -> Result<PathBuf, Problem> {
    let path = Path::new(text);
    let plain = path.components().all(|part| matches!(part, Component::Normal(_)));
    if text.is_empty() || !plain {
        return Err(Problem::CloudPath(text.into()));
    }
    Ok(path.into())
}

/// A finite number.
pub(super) fn number(column: &'static str, text: &str) -> Result<f64, Problem> {
    let value: f64 = text.parse().map_err(|_| Problem::Number { column, text: text.chars().take(40).collect() })?;
    if value.is_finite() { Ok(value) } else { Err(Problem::NotFinite { column, value }) }
}

//! Tables of poses, one a line: twelve numbers (the upper rows of a matrix, KITTI's) for the scan of the line's number;
//! `index x y z qx qy qz qw` (in a graph `vI x y z …`); or, with a time in seconds before the pose, TUM's.

use super::TURN_MAX;
use super::dump::Frame;
use crate::bounded::read_text;
use crate::error::{Problem, RecordingError};
use crate::import_rgbd::rigid;
use crate::remark::Remark;
use crate::table::{number, pose_of};
use merganser_protocol::geometry::Se3;
use merganser_protocol::geometry::quaternion_order::QuaternionOrder;
use merganser_protocol::time::Stamp;
use nalgebra::Matrix4;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Latest time of a table, s: what nanoseconds of an `i64` hold, with room.
const SECS_MAX: f64 = 9e9;

/// How a table tells whose pose it is.
enum Key {
    /// By the line.
    Line,
    /// By the first number.
    Index(u64),
    /// By a time.
    Time(Stamp),
}

/// Poses of scans, `t_world_lidar`, as a table states them.
pub(super) struct Poses {
    path: PathBuf,
    rows: Vec<(Key, Se3, usize)>,
    /// Whether each line is KITTI's twelve numbers.
    pub are_kitti: bool,
}

impl Poses {
    /// Reads a table.
    pub fn read(path: &Path) -> Result<Self, RecordingError> {
        let mut rows = Vec::new();
        let mut are_kitti = true;
        for (index, line) in read_text(path)?.lines().enumerate() {
            let words: Vec<&str> = line.split_ascii_whitespace().collect();
            // Edges of a graph and blank lines are not poses.
            if words.first().is_none_or(|word| word.starts_with(['e', '#'])) {
                continue;
            }
            let (key, pose) = row(&words).map_err(|problem| problem.at(path, index + 1))?;
            are_kitti &= matches!(key, Key::Line);
            rows.push((key, pose, index + 1));
        }
        are_kitti &= !rows.is_empty();
        Ok(Self { path: path.into(), rows, are_kitti })
    }

    /// How many there are.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// All poses, in the order of the lines.
    pub fn poses(&self) -> impl Iterator<Item = &Se3> {
        self.rows.iter().map(|(_, pose, _)| pose)
    }

    /// What is told if the body moves as if quaternions were written w first.
    pub fn order_told(&self) -> Option<String> {
        let mut order = QuaternionOrder::default();
        let of_quaternions = self.rows.iter().filter(|(key, ..)| !matches!(key, Key::Line));
        of_quaternions.for_each(|(_, pose, _)| order.push(pose));
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        order.is_doubtful().then(|| format!("{name}: {}", Remark::WFirst))
    }

    /// Changes each pose.
    pub fn map(&mut self, change: impl Fn(&Se3) -> Se3) {
        self.rows.iter_mut().for_each(|(_, pose, _)| *pose = change(pose));
    }

    /// The scans with their poses, in the order of their numbers; a scan without one is an error, a pose without a scan
    /// is none.
    pub fn join(self, data: &Path, scans: BTreeMap<u64, PathBuf>) -> Result<Vec<Frame>, RecordingError> {
        let is_timed = self.rows.iter().any(|(key, ..)| matches!(key, Key::Time(_)))
            || (self.counts_seconds() && !self.holds(&scans) && self.rows.len() == scans.len() && self.rises());
        if is_timed { self.by_order(scans) } else { self.by_number(data, scans) }
    }

    /// Whole numbers that are too large to count scans are whole seconds.
    fn counts_seconds(&self) -> bool {
        self.rows.iter().all(|(key, ..)| key.index().is_some_and(|index| index > TURN_MAX))
    }

    fn holds(&self, scans: &BTreeMap<u64, PathBuf>) -> bool {
        let stated: std::collections::BTreeSet<u64> = self.rows.iter().filter_map(|(key, ..)| key.index()).collect();
        scans.keys().all(|scan| stated.contains(scan))
    }

    fn rises(&self) -> bool {
        self.rows.windows(2).all(|pair| pair[0].0.index() < pair[1].0.index())
    }

    fn by_number(self, data: &Path, scans: BTreeMap<u64, PathBuf>) -> Result<Vec<Frame>, RecordingError> {
        let mut stated = BTreeMap::new();
        for (key, pose, line) in self.rows {
            let scan = key.index().unwrap_or(line as u64 - 1);
            if stated.insert(scan, pose).is_some() {
                return Err(Problem::Data(format!("states the pose of scan {scan:06} twice; leave one out"))
                    .at(self.path, line));
            }
        }
        let mut frames = Vec::new();
        for (scan, source) in scans {
            let Some(pose) = stated.get(&scan) else {
                let why = format!(
                    "scan {scan:06} has no pose; state it, or take the scan away ({} states {} poses: in a table of twelve \
                     numbers line 1 is that of scan 000000; of fewer scans state `index x y z qx qy qz qw`)",
                    self.path.file_name().unwrap_or_default().to_string_lossy(),
                    stated.len(),
                );
                return Err(Problem::Data(why).of(data));
            };
            frames.push(Frame { number: scan, stamp: None, pose: *pose, source });
        }
        Ok(frames)
    }

    /// The first time is that of the first scan, and so on.
    fn by_order(self, scans: BTreeMap<u64, PathBuf>) -> Result<Vec<Frame>, RecordingError> {
        if self.rows.len() != scans.len() {
            let why = format!(
                "states {} poses by their times for {} scans; state one for each scan, in their order, or the scan's \
                 number instead of the time",
                self.rows.len(),
                scans.len()
            );
            return Err(Problem::Data(why).of(self.path));
        }
        let mut frames: Vec<Frame> = Vec::new();
        for ((number, source), (key, pose, line)) in scans.into_iter().zip(self.rows) {
            let stamp = key.stamp().map_err(|problem| problem.at(&self.path, line))?;
            if let Some(last) = frames.last().and_then(|last| last.stamp).filter(|last| *last >= stamp) {
                return Err(Problem::Unsorted { stamp: stamp.0, previous: last.0 }.at(self.path, line));
            }
            frames.push(Frame { number, stamp: Some(stamp), pose, source });
        }
        Ok(frames)
    }
}

impl Key {
    fn index(&self) -> Option<u64> {
        if let Self::Index(index) = self { Some(*index) } else { None }
    }

    fn stamp(&self) -> Result<Stamp, Problem> {
        match self {
            Self::Line => Err(Problem::Data("states no time, as other lines do; state it first".into())),
            Self::Index(index) => seconds(&index.to_string()),
            Self::Time(stamp) => Ok(*stamp),
        }
    }
}

/// A time that is written in seconds, to the nanosecond, which an `f64` of today's seconds does not tell apart.
pub(super) fn seconds(text: &str) -> Result<Stamp, Problem> {
    let secs = number("time", text)?;
    if secs.abs() > SECS_MAX {
        return Err(Problem::Data(format!("the time {secs} is none in seconds; write seconds, as TUM's tables do")));
    }
    let (whole, part) = text.split_once('.').unwrap_or((text, ""));
    let digits: String = part.chars().chain(core::iter::repeat('0')).take(9).collect();
    let nanos = match (whole.parse::<i64>(), digits.parse::<i64>()) {
        // Digits before an exponent are no nanoseconds.
        (Ok(whole), Ok(nanos)) if whole >= 0 && !text.starts_with('-') && !text.contains(['e', 'E']) => {
            whole * 1_000_000_000 + nanos
        }
        _ => (secs * 1e9).round() as i64,
    };
    Ok(Stamp(nanos))
}

fn row(words: &[&str]) -> Result<(Key, Se3), Problem> {
    let numbers = |words: &[&str]| words.iter().map(|word| number("pose", word)).collect::<Result<Vec<_>, _>>();
    match words {
        [name, rest @ ..] if rest.len() == 7 => {
            let index = name.strip_prefix('v').unwrap_or(name);
            let key = match index.parse() {
                Ok(index) => Key::Index(index),
                Err(_) => Key::Time(seconds(index)?),
            };
            let mut v = [0.0; 7];
            v.copy_from_slice(&numbers(rest)?);
            Ok((key, pose_of(v)?))
        }
        all if all.len() == 12 => Ok((Key::Line, matrix(&numbers(all)?)?)),
        _ => Err(Problem::Data(format!(
            "{} fields; a pose is twelve numbers (three rows of a matrix), or `index x y z qx qy qz qw`, or the same with \
             a time in seconds first",
            words.len()
        ))),
    }
}

/// A pose from the upper three rows of its matrix.
pub(super) fn matrix(rows: &[f64]) -> Result<Se3, Problem> {
    if rows.len() != 12 {
        return Err(Problem::Fields { found: rows.len(), expected: 12 });
    }
    let mut values = rows.to_vec();
    values.extend([0.0, 0.0, 0.0, 1.0]);
    rigid(&Matrix4::from_row_slice(&values))
}

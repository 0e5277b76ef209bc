//! GLIM's dumps: a folder `NNNNNN` for each of its submaps, with `data.txt` (the submap's pose, and when its scans were
//! made) and `points_compact.bin` (f32 x, y, z in the frame of the submap's middle scan).

use super::poses::seconds;
use crate::bounded::read_text;
use crate::error::{Problem, RecordingError};
use crate::import_rgbd::rigid;
use crate::table::number;
use merganser_protocol::geometry::Se3;
use merganser_protocol::time::Stamp;
use nalgebra::Matrix4;
use std::path::Path;

/// What is known of a submap.
pub(super) const FACTS: &str = "data.txt";
/// Its points.
pub(super) const POINTS: &str = "points_compact.bin";
/// The line before the four rows of its pose, `t_world_submap`.
const POSE: &str = "T_world_origin:";
/// When a scan was made, s.
const STAMP: &str = "stamp:";

/// The pose of a submap, and when its middle scan was made.
pub(super) fn read(path: &Path) -> Result<(Se3, Stamp), RecordingError> {
    let text = read_text(path)?;
    let lines: Vec<&str> = text.lines().map(str::trim).collect();
    let Some(at) = lines.iter().position(|line| line.starts_with(POSE)) else {
        return Err(Problem::Data(format!("has no {POSE}, as GLIM writes it; was it cut off?")).of(path));
    };
    let mut values = Vec::new();
    for row in 1..=4 {
        let line = lines.get(at + row).copied().unwrap_or_default();
        let numbers = line.split_ascii_whitespace().map(|word| number("T_world_origin", word));
        let numbers = numbers.collect::<Result<Vec<_>, _>>().map_err(|problem| problem.at(path, at + row + 1))?;
        if numbers.len() != 4 {
            return Err(Problem::Fields { found: numbers.len(), expected: 4 }.at(path, at + row + 1));
        }
        values.extend(numbers);
    }
    let pose = rigid(&Matrix4::from_row_slice(&values)).map_err(|problem| problem.at(path, at + 2))?;
    let mut stamps = Vec::new();
    for (index, line) in lines.iter().enumerate() {
        if let Some(secs) = line.strip_prefix(STAMP) {
            stamps.push(seconds(secs.trim()).map_err(|problem| problem.at(path, index + 1))?);
        }
    }
    match stamps.get(stamps.len() / 2) {
        Some(stamp) => Ok((pose, *stamp)),
        None => Err(Problem::Data(format!("has no line {STAMP}, as GLIM writes one for each scan")).of(path)),
    }
}

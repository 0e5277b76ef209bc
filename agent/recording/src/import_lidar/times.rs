//! `times.txt`, as KITTI has it beside a sequence's scans: a time in seconds on each line, the first that of scan 000000.

use super::dump::Frame;
use super::poses::seconds;
use crate::bounded::read_text;
use crate::error::{Problem, RecordingError};
use std::path::Path;

/// The name of the table.
pub(super) const TIMES: &str = "times.txt";

/// Gives scans the times of the table, if there is one and the poses state none.
pub(super) fn give(data: &Path, frames: &mut [Frame]) -> Result<(), RecordingError> {
    let path = data.join(TIMES);
    if !path.is_file() || frames.iter().any(|frame| frame.stamp.is_some()) {
        return Ok(());
    }
    let text = read_text(&path)?;
    let lines: Vec<&str> = text.lines().map(str::trim).collect();
    let mut last = None;
    for frame in frames {
        let at = usize::try_from(frame.number).ok().filter(|at| lines.get(*at).is_some_and(|line| !line.is_empty()));
        let Some(at) = at else {
            let why = format!(
                "states no time of scan {:06} (line 1 is that of scan 000000); state it, or take {TIMES} away: then scans \
                 are taken to follow one another as a LiDAR turns",
                frame.number
            );
            return Err(Problem::Data(why).of(path));
        };
        let stamp = seconds(lines[at]).map_err(|problem| problem.at(&path, at + 1))?;
        if let Some(last) = last.replace(stamp).filter(|last| *last >= stamp) {
            return Err(Problem::Unsorted { stamp: stamp.0, previous: last.0 }.at(path, at + 1));
        }
        frame.stamp = Some(stamp);
    }
    Ok(())
}

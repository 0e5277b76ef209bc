//! Files and what they claim are looked at before memory is taken for them.

use super::error::{Problem, RecordingError, on};
use super::limits::{CLOUD_BYTES_MAX, POINTS_MAX, UNPACKING_BYTES_MAX};
use super::remark::Remark;
use std::fs::File;
use std::io::{ErrorKind, Read as _};
use std::path::Path;

/// What a cloud holds, as exactly as it says.
pub(super) struct Read {
    /// x, y, z of each point.
    pub points: Vec<[f64; 3]>,
    /// What was odd.
    pub remarks: Vec<Remark>,
}

/// A problem in a cloud, with the line where its format has lines.
pub(super) struct Fault {
    /// Counted from 1.
    pub line: Option<usize>,
    /// What is wrong.
    pub problem: Problem,
}

impl From<Problem> for Fault {
    fn from(problem: Problem) -> Self {
        Self { line: None, problem }
    }
}

/// The whole file, if it is not larger than [`CLOUD_BYTES_MAX`].
pub(super) fn read_bytes(path: &Path) -> Result<Vec<u8>, RecordingError> {
    let file = on(path, File::open(path))?;
    let length = on(path, file.metadata())?.len();
    if length > CLOUD_BYTES_MAX {
        return Err(Problem::CloudBytes(length).of(path));
    }
    let mut bytes = Vec::new();
    on(path, file.take(CLOUD_BYTES_MAX).read_to_end(&mut bytes))?;
    Ok(bytes)
}

/// The whole file as text, if it is not larger than [`CLOUD_BYTES_MAX`].
pub(super) fn read_text(path: &Path) -> Result<String, RecordingError> {
    String::from_utf8(read_bytes(path)?).map_err(|_| Problem::Data("is no text".into()).of(path))
}

/// What an `.xz` file holds, but no more than so many bytes.
pub(super) fn unpacked_xz(path: &Path, packed: &[u8], bytes_max: u64) -> Result<Vec<u8>, RecordingError> {
    let reader = lzma_rust2::XzReader::new_mem_limit(packed, true, (UNPACKING_BYTES_MAX >> 10) as u32);
    let mut bytes = Vec::new();
    match reader.take(bytes_max).read_to_end(&mut bytes) {
        Ok(_) => Ok(bytes),
        Err(error) if error.kind() == ErrorKind::OutOfMemory => Err(Problem::Dictionary.of(path)),
        Err(error) => Err(Problem::Io(error).of(path)),
    }
}

/// Refuses a claimed number of points that is too large.
pub(super) fn bounded(points: u64) -> Result<usize, Problem> {
    match usize::try_from(points) {
        Ok(count) if count <= POINTS_MAX => Ok(count),
        _ => Err(Problem::CloudPoints(points)),
    }
}

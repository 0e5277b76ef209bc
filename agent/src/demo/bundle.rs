//! The recordings that are compiled into the program, so that the demonstration needs no data.

use anyhow::{Context, Result, ensure};
use std::fs;
use std::path::Path;

/// Relative paths and contents, sorted.
const FILES: &[(&str, &[u8])] = include!(concat!(env!("OUT_DIR"), "/recordings.rs"));

/// Writes the recordings into `out`, a folder per robot.
pub(super) fn unpack(out: &Path) -> Result<()> {
    ensure!(!FILES.is_empty(), "this program was built without recordings; give some with --data");
    for (name, bytes) in FILES {
        let path = out.join(name);
        let folder = path.parent().unwrap_or(out);
        fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
        fs::write(&path, bytes).with_context(|| path.display().to_string())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::recording::import::open_all;

    #[test]
    fn the_compiled_in_recordings_are_good_and_small() {
        if FILES.is_empty() {
            println!("skipped: built without agent/recordings");
            return;
        }
        let size: usize = FILES.iter().map(|(_, bytes)| bytes.len()).sum();
        assert!(size <= 4 << 20, "{size} bytes");
        let out = tempfile::tempdir().unwrap();
        unpack(out.path()).unwrap();
        let recordings = open_all(out.path()).unwrap();
        assert_eq!(recordings.len(), 3);
        for recording in recordings {
            assert!(recording.truth().is_some());
            for index in 0..recording.len() {
                assert!(recording.points(index).unwrap().len() > 100);
            }
        }
    }
}

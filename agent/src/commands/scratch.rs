//! A folder for what is made of somebody's data while a command runs.

use anyhow::{Context, Result};
use std::path::{Path, PathBuf};

/// Such a folder, gone when it is no longer needed.
pub(crate) struct Scratch(PathBuf);

impl Scratch {
    /// A new one: what stands there already is somebody else's, and is not removed.
    pub fn new(command: &str) -> Result<Self> {
        let path = std::env::temp_dir().join(format!("merganser-{command}-{}", std::process::id()));
        std::fs::create_dir(&path).with_context(|| format!("cannot make {}", path.display()))?;
        Ok(Self(path))
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Scratch {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0); // what is left there does no harm
    }
}

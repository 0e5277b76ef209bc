//! A folder for what is made of somebody's data while a command runs.

use anyhow::{Context, Result};
use std::path::Path;
use tempfile::TempDir;

/// Such a folder, gone when it is no longer needed. What a killed command left is in nobody's way.
pub(crate) struct Scratch(TempDir);

impl Scratch {
    /// A new one, for this user alone.
    pub fn new(command: &str) -> Result<Self> {
        let made = tempfile::Builder::new().prefix(&format!("merganser-{command}-")).tempdir();
        let told = || format!("cannot make a folder in {} (TMPDIR names another)", std::env::temp_dir().display());
        made.map(Self).with_context(told)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        self.0.path()
    }
}

//! A store in a file: the database at its path, a spare beside it while one is being rebuilt, and the last damaged one
//! for whoever wants to look at it.

use crate::mend::Medium;
use redb::{Builder, Database, DatabaseError};
use std::ffi::OsString;
use std::fs::{self, File};
use std::io;
use std::path::{Path, PathBuf};

/// See the module.
#[derive(Clone, Debug)]
pub struct FileMedium {
    path: PathBuf,
}

impl FileMedium {
    /// The store at this path.
    pub fn new(path: impl Into<PathBuf>) -> Self {
        Self { path: path.into() }
    }

    fn beside(&self, suffix: &str) -> PathBuf {
        let mut name = OsString::from(self.path.as_os_str());
        name.push(suffix);
        name.into()
    }
}

impl Medium for FileMedium {
    fn path(&self) -> &Path {
        &self.path
    }

    fn create(&self, builder: &Builder) -> Result<Database, DatabaseError> {
        builder.create(&self.path)
    }

    fn create_spare(&self, builder: &Builder) -> Result<Database, DatabaseError> {
        let spare = self.beside(".new");
        match fs::remove_file(&spare) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error.into()),
            _ => builder.create(&spare),
        }
    }

    fn promote_spare(&self, keep: bool) -> io::Result<()> {
        if keep {
            let kept = self.beside(".damaged");
            match fs::remove_file(&kept) {
                Err(error) if error.kind() != io::ErrorKind::NotFound => return Err(error),
                // Where there are no links (FAT), a copy does; half a one only takes room.
                _ => fs::hard_link(&self.path, &kept)
                    .or_else(|_| fs::copy(&self.path, &kept).map(drop).inspect_err(|_| drop(fs::remove_file(&kept))))?,
            }
        }
        // One step: a crash leaves the one or the other at the path, never neither.
        fs::rename(self.beside(".new"), &self.path)?;
        let folder = self.path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
        File::open(folder)?.sync_all()
    }
}

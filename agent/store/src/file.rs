//! A store in a file: the database at its path, a spare beside it while one is being rebuilt, and the last damaged ones
//! (`….damaged-1`, `….damaged-2` and so on) for whoever wants to look at them. None is ever overwritten.

use crate::mend::Medium;
use redb::{Builder, Database, DatabaseError};
use std::ffi::OsString;
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::{OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

/// Damaged files kept beside the store. Of more, the smallest goes, the oldest of several; the newest always stays. Large
/// ones may hold what nobody else has, and a disk that fails again and again leaves many small ones.
pub const DAMAGED_KEPT_MAX: usize = 4;

/// Permission bits of a store.
const OWNER_ONLY: u32 = 0o600;
/// Those that it must not have.
const OTHERS: u32 = 0o077;

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

    /// When this store, or a damaged one that is kept beside it, was last written, as far as files tell; and the highest
    /// number of these, which rises from one to the next.
    pub fn past(&self) -> (Option<SystemTime>, u64) {
        let kept = self.damaged().unwrap_or_default();
        let last = kept.last().map_or(0, |(number, ..)| *number);
        let files = kept.into_iter().map(|(.., path)| path).chain([self.path.clone()]);
        (files.filter_map(|path| fs::metadata(path).ok()?.modified().ok()).max(), last)
    }

    /// The permission bits of a store that others than its owner may read or write; such a one was made by an earlier
    /// version, or changed since.
    pub fn loose_mode(&self) -> Option<u32> {
        let mode = fs::metadata(&self.path).ok()?.permissions().mode() & 0o7777;
        (mode & OTHERS != 0).then_some(mode)
    }

    fn beside(&self, suffix: &str) -> PathBuf {
        let mut name = OsString::from(self.path.as_os_str());
        name.push(suffix);
        name.into()
    }

    fn folder(&self) -> &Path {
        self.path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }

    /// The damaged files that are kept: their numbers, lengths and paths, by number.
    fn damaged(&self) -> io::Result<Vec<(u64, u64, PathBuf)>> {
        let prefix = self.beside(".damaged-");
        let Some(prefix) = prefix.file_name().and_then(|name| name.to_str()) else { return Ok(Vec::new()) };
        let mut found = Vec::new();
        for file in fs::read_dir(self.folder())? {
            let file = file?;
            if let Some(number) = file.file_name().to_str().and_then(|name| name.strip_prefix(prefix)?.parse().ok()) {
                found.push((number, file.metadata()?.len(), file.path()));
            }
        }
        found.sort();
        Ok(found)
    }

    /// Keeps what is at the path under a name that was never used: above the highest, which is never let go.
    fn keep(&self) -> io::Result<PathBuf> {
        let number = self.damaged()?.last().map_or(1, |(last, ..)| last.saturating_add(1));
        let kept = self.beside(&format!(".damaged-{number}"));
        // Where there are no links (FAT), a copy does; half a one only takes room.
        fs::hard_link(&self.path, &kept)
            .or_else(|_| fs::copy(&self.path, &kept).map(drop).inspect_err(|_| drop(fs::remove_file(&kept))))?;
        Ok(kept)
    }

    fn let_go(&self) -> io::Result<()> {
        let mut kept = self.damaged()?;
        while kept.len() > DAMAGED_KEPT_MAX {
            let older = kept[..kept.len() - 1].iter().enumerate();
            let Some((smallest, _)) = older.min_by_key(|(_, (number, len, _))| (*len, *number)) else { break };
            fs::remove_file(kept.remove(smallest).2)?;
        }
        Ok(())
    }
}

/// Has a file that is not there yet be readable by its owner alone: it is made here, empty, for the database to fill.
fn owned(path: &Path) -> io::Result<()> {
    match OpenOptions::new().write(true).create_new(true).mode(OWNER_ONLY).open(path) {
        Err(error) if error.kind() != io::ErrorKind::AlreadyExists => Err(error),
        _ => Ok(()),
    }
}

impl Medium for FileMedium {
    fn path(&self) -> &Path {
        &self.path
    }

    fn create(&self, builder: &Builder) -> Result<Database, DatabaseError> {
        owned(&self.path)?;
        builder.create(&self.path)
    }

    fn create_spare(&self, builder: &Builder) -> Result<Database, DatabaseError> {
        let spare = self.beside(".new");
        match fs::remove_file(&spare) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error.into()),
            _ => {
                owned(&spare)?;
                builder.create(&spare)
            }
        }
    }

    fn promote_spare(&self, keep: bool) -> io::Result<Option<PathBuf>> {
        let kept = keep.then(|| self.keep()).transpose()?;
        // One step: a crash leaves the one or the other at the path, never neither.
        fs::rename(self.beside(".new"), &self.path)?;
        File::open(self.folder())?.sync_all()?;
        let _ = self.let_go(); // one too many only takes room, and goes with the next
        Ok(kept)
    }

    fn is_emptied(&self) -> io::Result<bool> {
        match fs::metadata(&self.path) {
            Ok(file) => Ok(file.is_file() && file.len() == 0),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(error),
        }
    }

    fn bytes(&self) -> io::Result<Box<dyn io::Read + '_>> {
        Ok(Box::new(File::open(&self.path)?))
    }
}

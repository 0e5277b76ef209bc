//! Which files are bags, and of which files a bag consists.

use super::{BagError, BagProblem, FILES_MAX};
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

/// What ROS 2 writes beside the files of a bag.
const METADATA: &str = "metadata.yaml";
/// Bytes read of it at most.
const METADATA_BYTES_MAX: u64 = 16 << 20;

/// How a bag is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// `*.mcap`.
    Mcap,
    /// `*.db3`: SQLite.
    Sqlite,
    /// `*.bag`: ROS 1.
    Ros1,
}

/// What a file is by its name.
pub fn kind_of(path: &Path) -> Option<Kind> {
    match path.extension()?.to_str()? {
        "mcap" => Some(Kind::Mcap),
        "db3" => Some(Kind::Sqlite),
        "bag" => Some(Kind::Ros1),
        // A bag whose recorder never came to its end.
        "active" => kind_of(Path::new(path.file_stem()?)),
        _ => None,
    }
}

/// The bags in a folder, by their names: the folder itself if it has a `metadata.yaml`, else its files and those of its
/// folders that have one. None if it holds something else.
///
/// # Errors
/// [`BagError`] if a folder cannot be read.
pub fn bags_in(folder: &Path) -> Result<Vec<PathBuf>, BagError> {
    if folder.join(METADATA).is_file() {
        return Ok(vec![folder.into()]);
    }
    let mut bags: Vec<PathBuf> = entries(folder)?
        .into_iter()
        .filter(|path| if path.is_dir() { path.join(METADATA).is_file() } else { kind_of(path).is_some() })
        .collect();
    bags.sort();
    Ok(bags)
}

/// What is in a folder, at most [`FILES_MAX`].
fn entries(folder: &Path) -> Result<Vec<PathBuf>, BagError> {
    let told = |error: std::io::Error| BagProblem::Io(error).of(folder);
    let mut paths = Vec::new();
    for entry in folder.read_dir().map_err(told)? {
        if paths.len() == FILES_MAX {
            return Err(BagProblem::Files.of(folder));
        }
        paths.push(entry.map_err(told)?.path());
    }
    Ok(paths)
}

/// The files of a bag, in their order.
pub(super) fn of_bag(path: &Path) -> Result<(Kind, Vec<PathBuf>), BagError> {
    if !path.is_dir() {
        return of_file(path).map(|kind| (kind, vec![path.into()]));
    }
    let mut files: Vec<PathBuf> = entries(path)?;
    if let Some(packed) = files.iter().find(|file| packed(file)) {
        return Err(packed_whole(packed));
    }
    files.retain(|file| matches!(kind_of(file), Some(Kind::Mcap | Kind::Sqlite)));
    // A bag that was split has files …_0, …_1, …_10.
    files.sort_by_key(|file| (number(file), file.clone()));
    let metadata = path.join(METADATA);
    if metadata.is_file() {
        for name in names(&metadata)? {
            // Old versions write the folder before the name.
            let name = name.rsplit('/').next().unwrap_or_default();
            if !path.join(name).is_file() {
                return Err(BagProblem::Missing(name.into()).of(path));
            }
        }
    }
    let Some(first) = files.first() else { return Err(BagProblem::Empty.of(path)) };
    let kind = of_file(first)?;
    for file in &files {
        if of_file(file)? != kind {
            return Err(BagProblem::Unknown.of(file));
        }
    }
    Ok((kind, files))
}

fn packed(file: &Path) -> bool {
    let unpacked = file.file_stem().map(Path::new).and_then(kind_of);
    file.extension().is_some_and(|extension| extension == "zstd" || extension == "zst") && unpacked.is_some()
}

fn packed_whole(file: &Path) -> BagError {
    let name = file.file_name().unwrap_or_default().to_string_lossy().into_owned();
    BagProblem::Packed(name).of(file)
}

/// What a file is, by its first bytes.
fn of_file(path: &Path) -> Result<Kind, BagError> {
    if packed(path) {
        return Err(packed_whole(path));
    }
    let told = |error: std::io::Error| BagProblem::Io(error).of(path);
    let mut head = Vec::new();
    File::open(path).map_err(told)?.take(16).read_to_end(&mut head).map_err(told)?;
    if head.starts_with(mcap::MAGIC) {
        Ok(Kind::Mcap)
    } else if head.starts_with(b"SQLite format 3\0") {
        Ok(Kind::Sqlite)
    } else if head.starts_with(super::ros1::MAGIC) {
        Ok(Kind::Ros1)
    } else if head.starts_with(b"#ROSBAG V") || head.starts_with(b"#ROSRECORD") {
        Err(BagProblem::OldFormat.of(path))
    } else {
        Err(BagProblem::Unknown.of(path))
    }
}

/// The number at the end of a file's name; none comes first.
fn number(file: &Path) -> Option<u64> {
    file.file_stem()?.to_str()?.rsplit('_').next()?.parse().ok()
}

/// The files that `metadata.yaml` names, a line each: `relative_file_paths:` and then `- NAME`. All else that it says
/// stands in the files, too.
fn names(metadata: &Path) -> Result<Vec<String>, BagError> {
    let told = |error: std::io::Error| BagProblem::Io(error).of(metadata);
    let mut text = Vec::new();
    File::open(metadata).map_err(told)?.take(METADATA_BYTES_MAX).read_to_end(&mut text).map_err(told)?;
    let text = String::from_utf8_lossy(&text);
    let after = text.lines().skip_while(|line| line.trim() != "relative_file_paths:").skip(1);
    let names = after.map_while(|line| line.trim().strip_prefix("- "));
    Ok(names.map(|name| name.trim_matches(['"', '\'', ' ']).to_owned()).collect())
}

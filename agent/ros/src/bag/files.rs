//! Which files are bags, and of which files a bag consists.

use super::{BagError, BagProblem, FILES_MAX};
use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
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
        // A bag whose recorder never came to its end, or one that is packed as a whole, which is refused with its cure.
        "active" | "zstd" | "zst" => kind_of(Path::new(path.file_stem()?)),
        _ => None,
    }
}

/// The bags in a folder, by their names: the folder itself if it has a `metadata.yaml`, else its files and those of its
/// folders that hold ROS 2's. Files `NAME_0`, `NAME_1`… without a `metadata.yaml`, as a recorder leaves them that was
/// killed, are one bag that was split, `NAME.mcap` or `NAME.db3`. None if it holds something else.
///
/// # Errors
/// [`BagError`] if the folder cannot be read.
pub fn bags_in(folder: &Path) -> Result<Vec<PathBuf>, BagError> {
    if folder.join(METADATA).is_file() {
        return Ok(vec![folder.into()]);
    }
    let all = entries(folder)?;
    let mut bags: Vec<PathBuf> = loose(&all).into_keys().map(|name| folder.join(name)).collect();
    for within in all.iter().filter(|path| path.is_dir()) {
        if within.join(METADATA).is_file() {
            bags.push(within.clone());
            continue;
        }
        // Folders of other things, which cannot be read or hold very much, are not for us.
        let mut files = entries(within).unwrap_or_default();
        files.retain(|file| is_ros2(file));
        let loose = loose(&files);
        match loose.len() {
            1 => bags.push(within.clone()),
            _ => bags.extend(loose.into_keys().map(|name| within.join(name))),
        }
    }
    bags.sort();
    Ok(bags)
}

fn is_ros2(file: &Path) -> bool {
    matches!(kind_of(file), Some(Kind::Mcap | Kind::Sqlite))
}

/// The bags of files that no `metadata.yaml` names, by their names. Those that were split have the name of their files
/// without the number.
fn loose(paths: &[PathBuf]) -> BTreeMap<OsString, Vec<PathBuf>> {
    let names: BTreeSet<&Path> = paths.iter().map(PathBuf::as_path).collect();
    let is_bag = |file: &&PathBuf| {
        let is_twice = packed(file) && names.contains(file.with_extension("").as_path());
        kind_of(file).is_some() && !is_twice && file.is_file()
    };
    let mut split: BTreeMap<OsString, BTreeMap<u64, &PathBuf>> = BTreeMap::new();
    let mut bags: BTreeMap<OsString, Vec<PathBuf>> = BTreeMap::new();
    for file in paths.iter().filter(is_bag) {
        match part(file).filter(|(whole, _)| !names.contains(file.with_file_name(whole).as_path())) {
            Some((whole, number)) => drop(split.entry(whole).or_default().insert(number, file)),
            None => drop(bags.insert(name(file), vec![file.clone()])),
        }
    }
    for (whole, parts) in split {
        // Recorders count from 0 on.
        if parts.len() > 1 && parts.keys().copied().eq(0..parts.len() as u64) {
            bags.insert(whole, parts.into_values().cloned().collect());
        } else {
            bags.extend(parts.into_values().map(|file| (name(file), vec![file.clone()])));
        }
    }
    bags
}

fn name(file: &Path) -> OsString {
    file.file_name().unwrap_or_default().into()
}

/// The name of the bag of which the file may be a part, and which part.
fn part(file: &Path) -> Option<(OsString, u64)> {
    let (stem, number) = file.file_stem()?.to_str()?.rsplit_once('_')?;
    let is_number = is_ros2(file) && number.bytes().all(|digit| digit.is_ascii_digit());
    let number = number.parse().ok().filter(|_| is_number)?;
    Some((format!("{stem}.{}", file.extension()?.to_str()?).into(), number))
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

/// The files of a bag.
pub(super) struct Files {
    pub(super) kind: Kind,
    /// In their order.
    pub(super) files: Vec<PathBuf>,
    /// What there is to tell of them.
    pub(super) noted: Vec<String>,
}

/// The files of a bag.
pub(super) fn of_bag(path: &Path) -> Result<Files, BagError> {
    let (files, noted) = if path.is_dir() {
        of_folder(path)?
    } else if let Some(parts) = parts(path) {
        let noted = vec![taken_for_one(&parts)];
        (parts, noted)
    } else {
        (vec![path.into()], Vec::new())
    };
    let Some(first) = files.first() else { return Err(BagProblem::Empty.of(path)) };
    let kind = of_file(first)?;
    for file in &files {
        if of_file(file)? != kind {
            return Err(BagProblem::Unknown.of(file));
        }
    }
    Ok(Files { kind, files, noted })
}

/// The parts of a bag that was split, if the path is only their name.
fn parts(path: &Path) -> Option<Vec<PathBuf>> {
    if path.exists() {
        return None;
    }
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let parts = loose(&entries(folder).ok()?).remove(path.file_name()?)?;
    (parts.len() > 1).then_some(parts)
}

fn taken_for_one(files: &[PathBuf]) -> String {
    let told = |file: Option<&PathBuf>| file.map(|file| name(file).to_string_lossy().into_owned()).unwrap_or_default();
    format!(
        "{} to {} ({} files) are taken for one bag that was split, as no metadata.yaml names them; if they are several \
         bags, give each a folder",
        told(files.first()),
        told(files.last()),
        files.len()
    )
}

/// The files of a bag that is a folder, and what there is to tell of them: those that `metadata.yaml` names, else all.
fn of_folder(path: &Path) -> Result<(Vec<PathBuf>, Vec<String>), BagError> {
    let mut beside: Vec<PathBuf> = entries(path)?;
    beside.retain(|file| is_ros2(file));
    // A bag that was split has files …_0, …_1, …_10.
    beside.sort_by_key(|file| (number(file), file.clone()));
    let metadata = path.join(METADATA);
    let named = if metadata.is_file() { names(&metadata)? } else { Vec::new() };
    if named.is_empty() {
        let is_unpacked = |file: &Path| beside.contains(&file.with_extension(""));
        if let Some(packed) = beside.iter().find(|file| packed(file) && !is_unpacked(file)) {
            return Err(packed_whole(packed));
        }
        beside.retain(|file| !packed(file));
        let noted = if beside.len() > 1 { vec![taken_for_one(&beside)] } else { Vec::new() };
        return Ok((beside, noted));
    }
    let mut files: Vec<PathBuf> = Vec::new();
    for name in named {
        // Old versions write the folder before the name.
        let name = name.rsplit('/').next().unwrap_or_default();
        let file = path.join(name);
        if !file.is_file() {
            let packed = beside.iter().find(|other| packed(other) && other.with_extension("") == file);
            return Err(packed.map_or_else(|| BagProblem::Missing(name.into()).of(path), |packed| packed_whole(packed)));
        }
        if files.len() == FILES_MAX {
            return Err(BagProblem::Files.of(path));
        }
        if !files.contains(&file) {
            files.push(file);
        }
    }
    let is_named = |file: &PathBuf| files.contains(file) || packed(file) && files.contains(&file.with_extension(""));
    beside.retain(|file| !is_named(file));
    let mut noted = Vec::new();
    if let Some(first) = beside.first() {
        let (count, first) = (beside.len(), name(first));
        noted.push(format!(
            "metadata.yaml does not name {count} of the files beside it ({}), and so they are not read; run `ros2 bag \
             reindex` if they are of this bag",
            if count > 1 { format!("{} …", first.to_string_lossy()) } else { first.to_string_lossy().into_owned() }
        ));
    }
    Ok((files, noted))
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

//! What lies in a folder and can be played: laser logs with a truth beside them, and whatever else the importer knows.

use merganser_protocol::config::Sensor;
use merganser_recording::import::{Kind, Prepared, detect, is_bag, log_name, prepare, prepare_log};
use merganser_recording::{Recording, TRUTH};
use std::path::{Path, PathBuf};

/// Folders are looked through so deep.
const DEPTH_MAX: usize = 4;
/// Seed of the drift on data that come without odometry.
const SEED: u64 = 1;

/// Something to play.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Set {
    /// For the table.
    pub name: String,
    /// The log, or the folder.
    pub path: PathBuf,
    /// Where the truth is.
    pub truth: TruthFile,
}

/// Where the truth of a set is.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum TruthFile {
    /// `stamp1 stamp2 dx dy dz roll pitch yaw` a line: how the body lay at the second stamp, seen from the first.
    Relations(PathBuf),
    /// `stamp x y z qx qy qz qw` a line: poses of the body.
    Tum(PathBuf),
    /// MRCLAM's folder: poses of the robots, or the survey of the landmarks.
    Mrclam,
    /// In the recordings.
    Recorded,
}

/// Every set below `folder`, in the order of their paths, and what looks like one but cannot be judged.
///
/// # Errors
/// A folder that cannot be read.
pub fn find(folder: &Path) -> anyhow::Result<(Vec<Set>, Vec<String>)> {
    let (mut sets, mut left_out) = (Vec::new(), Vec::new());
    look(folder, 0, &mut sets, &mut left_out)?;
    sets.sort_by(|a, b| a.path.cmp(&b.path));
    Ok((sets, left_out))
}

fn look(folder: &Path, depth: usize, sets: &mut Vec<Set>, left_out: &mut Vec<String>) -> anyhow::Result<()> {
    let mut entries: Vec<PathBuf> = folder
        .read_dir()
        .map_err(|error| anyhow::anyhow!("{}: {error}", folder.display()))?
        .map(|entry| Ok(entry?.path()))
        .collect::<std::io::Result<_>>()?;
    entries.sort();
    for path in entries.iter().filter(|path| path.is_file()) {
        let file = path.file_name().unwrap_or_default().to_string_lossy();
        let Some(name) = log_name(&file) else { continue };
        match truth_beside(folder, name) {
            Some(truth) => sets.push(Set { name: name.into(), path: path.clone(), truth }),
            None => left_out.push(format!("{}: no {name}.relations and no {name}.gt.tum beside it", path.display())),
        }
    }
    let name = || folder.file_name().map_or_else(|| "data".into(), |name| name.to_string_lossy().into_owned());
    match detect(folder) {
        Ok(Kind::Mrclam) => sets.push(Set { name: name(), path: folder.into(), truth: TruthFile::Mrclam }),
        Ok(Kind::Recordings) => {
            let with_truth = entries.iter().any(|path| path.join(TRUTH).is_file());
            if with_truth {
                sets.push(Set { name: name(), path: folder.into(), truth: TruthFile::Recorded });
            } else {
                left_out.push(format!("{}: recordings without {TRUTH}", folder.display()));
            }
            return Ok(());
        }
        Ok(Kind::SevenScenes | Kind::Lidar) => {
            sets.push(Set { name: name(), path: folder.into(), truth: TruthFile::Recorded });
            return Ok(());
        }
        Ok(Kind::Bags) => {
            let bags = entries.iter().filter(|path| path.is_file() && is_bag(path));
            left_out.extend(bags.map(|path| format!("{}: a ROS bag, whose truth is not known", path.display())));
        }
        Ok(Kind::Carmen) | Err(_) => {}
    }
    if depth < DEPTH_MAX {
        for path in entries.iter().filter(|path| path.is_dir()) {
            look(path, depth + 1, sets, left_out)?;
        }
    }
    Ok(())
}

fn truth_beside(folder: &Path, name: &str) -> Option<TruthFile> {
    let there = |endings: [&str; 2]| {
        endings.iter().map(|ending| folder.join(format!("{name}{ending}"))).find(|path| path.is_file())
    };
    there([".gt.tum", ".gt.tum.xz"])
        .map(TruthFile::Tum)
        .or_else(|| there([".relations", ".relations.xz"]).map(TruthFile::Relations))
}

impl Set {
    /// Its robots, made in `out` where they are not recordings already; of a log so many. And what was amiss with it.
    ///
    /// # Errors
    /// Data that cannot be used.
    pub fn recordings(&self, out: &Path, robots: usize) -> anyhow::Result<Prepared> {
        Ok(match &self.truth {
            TruthFile::Relations(_) | TruthFile::Tum(_) => prepare_log(&self.path, out, robots)?,
            TruthFile::Mrclam | TruthFile::Recorded => prepare(&self.path, out, SEED)?,
        })
    }
}

/// Whether robots of this kind move in a plane.
pub fn is_planar(recording: &Recording) -> bool {
    matches!(recording.manifest().config.submap.sensor, Sensor::Laser2d | Sensor::Landmarks2d)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_log_needs_a_truth_beside_it() {
        let folder = tempfile::tempdir().unwrap();
        let deep = folder.path().join("a/b");
        std::fs::create_dir_all(&deep).unwrap();
        for name in ["one.clf", "one.relations", "two.clf.xz", "two.gt.tum.xz", "three.log.bz2", "notes.txt"] {
            std::fs::write(deep.join(name), "").unwrap();
        }
        let (sets, left_out) = find(folder.path()).unwrap();
        let found: Vec<(&str, &TruthFile)> = sets.iter().map(|set| (set.name.as_str(), &set.truth)).collect();
        let (one, two) = (TruthFile::Relations(deep.join("one.relations")), TruthFile::Tum(deep.join("two.gt.tum.xz")));
        assert_eq!(found, [("one", &one), ("two", &two)]);
        assert!(matches!(left_out.as_slice(), [only] if only.contains("three.gt.tum")), "{left_out:?}");
    }

    #[test]
    fn a_folder_that_is_none_is_told() {
        assert!(find(Path::new("/nowhere")).unwrap_err().to_string().starts_with("/nowhere: "));
    }
}

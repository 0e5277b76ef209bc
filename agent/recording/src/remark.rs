//! What was odd in clouds and tables and could be read all the same: told once a kind, by the first file in which it was.

use core::fmt;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Something odd in one file.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Remark {
    /// A PCD states this `VIEWPOINT`.
    Viewpoint(String),
    /// Coordinates are whole numbers.
    Whole,
    /// A `.bin` of nuScenes, with a fifth number.
    Five,
    /// Poses of a table move as if their quaternions were written w first.
    WFirst,
}

impl fmt::Display for Remark {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Viewpoint(stated) => write!(
                f,
                "VIEWPOINT {stated} is not applied; points must be in the body frame: if they are not, move them there \
                 and write VIEWPOINT 0 0 0 1 0 0 0"
            ),
            Self::Whole => f.write_str(
                "x, y, z are whole numbers and taken for metres; if they are millimetres, divide by 1000 and write \
                 them as float",
            ),
            Self::Five => f.write_str(
                "five numbers a point, the fifth the number of a laser: read as nuScenes' x y z intensity ring, not as \
                 KITTI's x y z reflectance",
            ),
            Self::WFirst => f.write_str(
                "the body moves one way in its own axes only if the quaternions are written w first; they are read as x y z \
                 w: put w last",
            ),
        }
    }
}

/// The remarks on many clouds.
#[derive(Clone, Debug, Default)]
pub struct Remarks {
    /// By kind: the first, its file, and in how many files it was.
    kinds: BTreeMap<u8, (Remark, PathBuf, usize)>,
}

impl Remarks {
    /// Notes what was odd in a file; says what was so in none before.
    pub fn note(&mut self, path: &Path, remarks: Vec<Remark>) -> Vec<String> {
        let mut news = Vec::new();
        for remark in remarks {
            let kind = match &remark {
                Remark::Viewpoint(_) => 0,
                Remark::Whole => 1,
                Remark::Five => 2,
                Remark::WFirst => 3,
            };
            if !self.kinds.contains_key(&kind) {
                news.push(format!("{}: {remark}", path.display()));
            }
            self.kinds.entry(kind).or_insert_with(|| (remark, path.into(), 0)).2 += 1;
        }
        news
    }

    /// A sentence for each kind.
    pub fn told(&self) -> Vec<String> {
        let told = |(remark, path, files): &(Remark, PathBuf, usize)| match files {
            1 => format!("{}: {remark}", path.display()),
            2 => format!("{} (and another file): {remark}", path.display()),
            n => format!("{} (and {} more files): {remark}", path.display(), n - 1),
        };
        self.kinds.values().map(told).collect()
    }
}

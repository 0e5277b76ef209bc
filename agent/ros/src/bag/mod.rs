//! Bags: recordings of ROS topics, as MCAP, as ROS 2's sqlite3 files, and of ROS 1 (format 2.0). All give the same:
//! topics with their types, and messages one by one in the order of the file, of which no more than one chunk is in
//! memory.
//!
//! A bag that was cut short, as by a robot that lost power, is read as far as it is whole, and [`Bag::damage`] tells
//! so.

mod files;
mod mcap;
mod ros1;
mod sqlite;

pub use files::{Kind, bags_in, kind_of};

use crate::limits::{
    CHUNK_BYTES_MAX, DAMAGE_TOLD_MAX, FILES_MAX, MESSAGE_BYTES_MAX, RECORD_HEADER_BYTES_MAX, TOPICS_MAX,
};
use crate::wire::{Serialization, plain_type};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Topic {
    /// Such as `/robot1/odom`.
    pub name: String,
    /// Such as `nav_msgs/Odometry`: without the `msg` of ROS 2.
    pub kind: String,
    /// How its messages are written; `None` if it is nothing of ROS (JSON, Protobuf), which is not read.
    pub serialization: Option<Serialization>,
    /// Messages.
    pub count: u64,
}

/// A message of a bag.
#[derive(Clone, Copy, Debug)]
pub struct Record<'a> {
    /// Which of [`Bag::topics`].
    pub topic: usize,
    /// When it was received, ns since 1970.
    pub received_ns: i64,
    /// As it was published.
    pub bytes: &'a [u8],
}

/// Whether to read on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Flow {
    /// The next message.
    On,
    /// That is all.
    Stop,
}

/// Why a bag cannot be read.
#[derive(Debug, Error)]
#[error("{}: {problem}", path.display())]
pub struct BagError {
    /// The file or folder.
    pub path: PathBuf,
    /// What is wrong, and how to mend it.
    pub problem: BagProblem,
}

/// What is wrong with a bag.
#[derive(Debug, Error)]
pub enum BagProblem {
    /// A file cannot be read.
    #[error("{0}")]
    Io(#[from] std::io::Error),
    /// Nothing that is known.
    #[error(
        "is no bag: expected *.mcap, *.db3 (or a folder of them with metadata.yaml), or a ROS 1 *.bag of format 2.0"
    )]
    Unknown,
    /// A ROS 1 bag of another format.
    #[error("is a ROS 1 bag of another format than 2.0; convert it by `rosbag fix`, or by `rosbags-convert`")]
    OldFormat,
    /// A bag with no file.
    #[error("metadata.yaml is there, but no *.mcap or *.db3 beside it; copy the whole folder")]
    Empty,
    /// A file that `metadata.yaml` names is not there.
    #[error("metadata.yaml names {0}, which is missing; copy the whole folder, or run `ros2 bag reindex`")]
    Missing(String),
    /// The file is packed as a whole.
    #[error("is packed as a whole; unpack it by `zstd -d --rm {0}`, and take `.zstd` out of metadata.yaml")]
    Packed(String),
    /// A chunk is packed in an unknown way.
    #[error("a chunk is packed by {0:?}; none, bz2, lz4 and zstd are read: convert the bag by `rosbags-convert`")]
    Compression(String),
    /// It begins as a bag, and then is none.
    #[error("{0}; it cannot be read from its beginning: copy it again, or mend it by `{1}`")]
    Damaged(String, &'static str),
    /// SQLite cannot read it.
    #[error("SQLite: {0}; try `sqlite3 FILE .recover`")]
    Sqlite(String),
    /// The tables are not those of a bag.
    #[error("has no tables `topics` and `messages` as ROS 2 writes them ({0}); is it another SQLite database?")]
    Tables(String),
    /// Too many topics.
    #[error("has more than {TOPICS_MAX} topics (TOPICS_MAX)")]
    Topics,
    /// Too many files.
    #[error("has more than {FILES_MAX} files (FILES_MAX)")]
    Files,
}

impl BagProblem {
    /// The problem, told of a file.
    pub fn of(self, path: impl Into<PathBuf>) -> BagError {
        BagError { path: path.into(), problem: self }
    }
}

/// Messages that were passed over in a file.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Damage {
    /// What could not be read of a file, with its name.
    pub stopped: Vec<String>,
    /// How often that was beyond [`DAMAGE_TOLD_MAX`].
    pub untold: u64,
    /// Messages larger than [`MESSAGE_BYTES_MAX`], which are left out.
    pub long: u64,
    /// Messages of no topic, or that could not be unpacked.
    pub lost: u64,
    /// What there is to tell of its files beside.
    pub noted: Vec<String>,
}

/// A bag, whose topics are known.
#[derive(Clone, Debug)]
pub struct Bag {
    path: PathBuf,
    kind: Kind,
    files: Vec<PathBuf>,
    topics: Vec<Topic>,
    damage: Damage,
}

impl Bag {
    /// Opens the bag at `path`, a file, a folder, or the name of one that was split ([`bags_in`]), and counts its messages, for which it is
    /// read once.
    ///
    /// # Errors
    /// [`BagError`].
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let files::Files { kind, files, noted } = files::of_bag(path)?;
        let mut bag = Self { path: path.into(), kind, files, topics: Vec::new(), damage: Damage::default() };
        let mut topics = Topics::default();
        let mut counts: BTreeMap<usize, u64> = BTreeMap::new();
        bag.damage = bag.scan(&mut topics, true, &mut |record| {
            *counts.entry(record.topic).or_default() += 1;
            Flow::On
        })?;
        bag.damage.noted = noted;
        bag.topics = topics.list;
        for (topic, count) in counts {
            if let Some(topic) = bag.topics.get_mut(topic) {
                topic.count += count;
            }
        }
        Ok(bag)
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Its topics.
    pub fn topics(&self) -> &[Topic] {
        &self.topics
    }

    /// What of it could not be read.
    pub fn damage(&self) -> &Damage {
        &self.damage
    }

    /// Gives each message of the topics for which `wanted` says so (by their index) to `each`, file by file, and
    /// returns what could not be read on the way; [`Damage::beyond`] tells what of it [`Bag::damage`] did not say.
    ///
    /// # Errors
    /// [`BagError`].
    pub fn read(
        &self,
        wanted: impl Fn(usize) -> bool,
        mut each: impl FnMut(Record<'_>) -> Flow,
    ) -> Result<Damage, BagError> {
        let mut topics = Topics { list: self.topics.clone() };
        let passed = |record: Record<'_>| if wanted(record.topic) { each(record) } else { Flow::On };
        self.scan(&mut topics, false, &mut { passed })
    }

    fn scan(
        &self,
        topics: &mut Topics,
        counts: bool,
        each: &mut dyn FnMut(Record<'_>) -> Flow,
    ) -> Result<Damage, BagError> {
        let mut damage = Damage::default();
        for file in &self.files {
            let flow = match self.kind {
                Kind::Mcap => mcap::scan(file, topics, &mut damage, each)?,
                Kind::Sqlite => sqlite::scan(file, topics, &mut damage, counts, each)?,
                Kind::Ros1 => ros1::scan(file, topics, &mut damage, each)?,
            };
            if flow == Flow::Stop {
                break;
            }
        }
        Ok(damage)
    }
}

/// Topics by the order in which they were met.
#[derive(Default)]
struct Topics {
    list: Vec<Topic>,
}

impl Topics {
    /// The index of a topic, which is taken down if it is new.
    fn index(&mut self, name: &str, kind: &str, serialization: Option<Serialization>) -> Result<usize, BagProblem> {
        let kind = plain_type(kind);
        let known = |topic: &Topic| topic.name == name && topic.kind == kind && topic.serialization == serialization;
        if let Some(index) = self.list.iter().position(known) {
            return Ok(index);
        }
        if self.list.len() == TOPICS_MAX {
            return Err(BagProblem::Topics);
        }
        self.list.push(Topic { name: name.into(), kind, serialization, count: 0 });
        Ok(self.list.len() - 1)
    }
}

impl Damage {
    /// Takes down that a file cannot be read on.
    fn stop(&mut self, file: &Path, why: impl std::fmt::Display) {
        if self.stopped.len() == DAMAGE_TOLD_MAX {
            self.untold += 1;
            return;
        }
        let name = file.file_name().unwrap_or_default().to_string_lossy();
        self.stopped.push(format!("{name}: {why}"));
    }

    /// What of this an earlier reading of the same bag did not find.
    pub fn beyond(&self, earlier: &Self) -> Self {
        Self {
            stopped: self.stopped.iter().filter(|why| !earlier.stopped.contains(why)).cloned().collect(),
            untold: self.untold.saturating_sub(earlier.untold),
            long: self.long.saturating_sub(earlier.long),
            lost: self.lost.saturating_sub(earlier.lost),
            noted: self.noted.iter().filter(|note| !earlier.noted.contains(note)).cloned().collect(),
        }
    }

    /// A sentence for each.
    pub fn told(&self) -> Vec<String> {
        let mut told: Vec<String> =
            self.stopped.iter().map(|why| format!("{why}; all that is whole is used")).collect();
        if self.untold > 0 {
            told.push(format!("{} more places are damaged", self.untold));
        }
        if self.long > 0 {
            told.push(format!("{} messages of more than {MESSAGE_BYTES_MAX} bytes are left out", self.long));
        }
        if self.lost > 0 {
            told.push(format!("{} messages of no known topic, or that cannot be unpacked, are left out", self.lost));
        }
        told.extend(self.noted.iter().cloned());
        told
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(crate) mod write;

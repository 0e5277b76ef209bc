//! The disk: one redb database per robot, in which facts are durable before anyone hears of them (DESIGN §4). Batches
//! that arrive while a commit runs, or within a short wait, share the next commit; each commit is atomic and synced, and
//! quick repair makes reopening after a crash a matter of milliseconds.
//!
//! Tables: `entries` (robot, epoch, seq → bytes), `blobs` (hash → bytes), `private` (robot, epoch, index → bytes), `meta`.

use merganser_protocol::agent::Restored;
use merganser_protocol::agent::io::{Input, Record};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId, SubmapId};
use redb::{Database, DatabaseError, Durability, ReadableDatabase, ReadableTable, TableDefinition, WriteTransaction};
use std::path::{Path, PathBuf};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant, SystemTime};
use thiserror::Error;

/// Version of the tables.
const SCHEMA: u32 = 1;
/// Bytes of records after which a commit waits for no more of them.
const COMMIT_BYTES_MAX: usize = 4 << 20;
/// Cache of the database, in bytes.
const CACHE_BYTES: usize = 16 << 20;
/// 2020-01-01 in seconds since 1970: epochs count from there.
const EPOCH_ORIGIN_SECS: u64 = 1_577_836_800;

const ENTRIES: TableDefinition<'_, [u8; 16], &[u8]> = TableDefinition::new("entries");
const BLOBS: TableDefinition<'_, [u8; 32], &[u8]> = TableDefinition::new("blobs");
const PRIVATE: TableDefinition<'_, [u8; 16], &[u8]> = TableDefinition::new("private");
const META: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("meta");

/// Why a store cannot be used.
#[derive(Debug, Error)]
pub enum StoreError {
    /// Another process has it.
    #[error("store {path}: another agent uses it; stop that one, or give this one a store of its own", path = .0.display())]
    InUse(PathBuf),
    /// It belongs to somebody else.
    #[error(
        "store {path} belongs to {owner}, not to {wanted}; give each robot a store of its own",
        path = path.display()
    )]
    Foreign {
        /// The file.
        path: PathBuf,
        /// `swarm/robot` it was made for.
        owner: String,
        /// `swarm/robot` that opens it.
        wanted: String,
    },
    /// It was written by another version of this program.
    #[error(
        "store {path} has schema {found}, this program reads {SCHEMA}; use the program that wrote it, or move the file \
         away: an empty store begins a new epoch and fetches the swarm's facts again",
        path = path.display()
    )]
    Schema {
        /// The file.
        path: PathBuf,
        /// The version found.
        found: String,
    },
    /// The database or the disk failed.
    #[error("store {path}: {reason}", path = path.display())]
    Failed {
        /// The file.
        path: PathBuf,
        /// What the database said.
        reason: String,
    },
}

/// An open database.
#[derive(Debug)]
pub struct Store {
    db: Database,
    path: PathBuf,
}

impl Store {
    /// Opens the store of `swarm/robot`, or makes a new one.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn open(path: &Path, swarm: &Name, robot: &Name) -> Result<Self, StoreError> {
        let db = Database::builder().set_cache_size(CACHE_BYTES).create(path).map_err(|error| match error {
            DatabaseError::DatabaseAlreadyOpen => StoreError::InUse(path.into()),
            DatabaseError::UpgradeRequired(found) => {
                StoreError::Schema { path: path.into(), found: format!("redb file format {found}") }
            }
            other => StoreError::Failed { path: path.into(), reason: other.to_string() },
        })?;
        Self::with_database(db, path, swarm, robot)
    }

    /// A store in a database that is already open (tests give it failing disks).
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn with_database(db: Database, path: &Path, swarm: &Name, robot: &Name) -> Result<Self, StoreError> {
        let store = Self { db, path: path.into() };
        let owner = format!("{swarm}/{robot}");
        let found = store.meta("schema")?;
        match found.as_deref().map(<[u8; 4]>::try_from) {
            None => store.found(&owner)?,
            Some(Ok(version)) if u32::from_le_bytes(version) == SCHEMA => {}
            Some(Ok(version)) => return Err(store.foreign_schema(u32::from_le_bytes(version).to_string())),
            Some(Err(_)) => return Err(store.foreign_schema("of unknown form".into())),
        }
        let found = String::from_utf8_lossy(&store.meta("owner")?.unwrap_or_default()).into_owned();
        if found != owner {
            return Err(StoreError::Foreign { path: store.path, owner: found, wanted: owner });
        }
        Ok(store)
    }

    /// Reads all records.
    ///
    /// # Errors
    /// [`StoreError`].
    pub fn load(&self) -> Result<Restored, StoreError> {
        let fresh_epoch =
            self.meta("fresh_epoch")?.and_then(|bytes| bytes.try_into().ok()).map_or(0, u32::from_le_bytes);
        let records = self.read().map_err(|error| self.failed(&error))?;
        Ok(Restored { records, fresh_epoch })
    }

    /// Makes records durable, in one synced commit. On an error nothing of them is stored.
    ///
    /// # Errors
    /// What the database or the disk said, in words.
    pub fn commit<'a>(&self, records: impl Iterator<Item = &'a Record>) -> Result<(), String> {
        self.write(|transaction| records.into_iter().try_for_each(|record| put(transaction, record)))
    }

    fn found(&self, owner: &str) -> Result<(), StoreError> {
        let write = |transaction: &WriteTransaction| -> Result<(), String> {
            transaction.open_table(ENTRIES).map_err(text)?;
            transaction.open_table(BLOBS).map_err(text)?;
            transaction.open_table(PRIVATE).map_err(text)?;
            let mut meta = transaction.open_table(META).map_err(text)?;
            for (key, value) in [
                ("owner", owner.as_bytes()),
                ("fresh_epoch", fresh_epoch(SystemTime::now()).to_le_bytes().as_slice()),
                ("schema", SCHEMA.to_le_bytes().as_slice()),
            ] {
                meta.insert(key, value).map_err(text)?;
            }
            Ok(())
        };
        self.write(write).map_err(|reason| StoreError::Failed { path: self.path.clone(), reason })
    }

    fn meta(&self, key: &str) -> Result<Option<Vec<u8>>, StoreError> {
        let get = || -> Result<Option<Vec<u8>>, redb::Error> {
            match self.db.begin_read()?.open_table(META) {
                Ok(table) => Ok(table.get(key)?.map(|value| value.value().to_vec())),
                Err(redb::TableError::TableDoesNotExist(_)) => Ok(None),
                Err(error) => Err(error.into()),
            }
        };
        get().map_err(|error| self.failed(&error))
    }

    fn read(&self) -> Result<Vec<Record>, redb::Error> {
        let transaction = self.db.begin_read()?;
        let mut records = Vec::new();
        for row in transaction.open_table(ENTRIES)?.iter()? {
            let (key, value) = row?;
            let (frame, seq) = split_key(key.value());
            records.push(Record::Entry { id: EntryId { frame, seq }, bytes: value.value().to_vec() });
        }
        for row in transaction.open_table(BLOBS)?.iter()? {
            let (key, value) = row?;
            records.push(Record::Blob { hash: Hash(key.value()), bytes: value.value().to_vec() });
        }
        for row in transaction.open_table(PRIVATE)?.iter()? {
            let (key, value) = row?;
            let (frame, index) = split_key(key.value());
            records.push(Record::Private { submap: SubmapId { frame, index }, bytes: value.value().to_vec() });
        }
        Ok(records)
    }

    fn write(&self, work: impl FnOnce(&WriteTransaction) -> Result<(), String>) -> Result<(), String> {
        let mut transaction = self.db.begin_write().map_err(text)?;
        transaction.set_durability(Durability::Immediate).map_err(text)?;
        transaction.set_quick_repair(true);
        work(&transaction)?; // dropping the transaction aborts it
        transaction.commit().map_err(text)
    }

    fn failed(&self, error: &redb::Error) -> StoreError {
        StoreError::Failed { path: self.path.clone(), reason: error.to_string() }
    }

    fn foreign_schema(&self, found: String) -> StoreError {
        StoreError::Schema { path: self.path.clone(), found }
    }
}

fn put(transaction: &WriteTransaction, record: &Record) -> Result<(), String> {
    match record {
        Record::Entry { id, bytes } => {
            let mut table = transaction.open_table(ENTRIES).map_err(text)?;
            let before = table.insert(join_key(id.frame, id.seq), bytes.as_slice()).map_err(text)?;
            match before {
                Some(before) if before.value() != bytes => {
                    Err(format!("entry {id} is already stored with other bytes"))
                }
                _ => Ok(()),
            }
        }
        Record::Blob { hash, bytes } => {
            let mut table = transaction.open_table(BLOBS).map_err(text)?;
            table.insert(hash.0, bytes.as_slice()).map(drop).map_err(text)
        }
        Record::Private { submap, bytes } => {
            let mut table = transaction.open_table(PRIVATE).map_err(text)?;
            table.insert(join_key(submap.frame, submap.index), bytes.as_slice()).map(drop).map_err(text)
        }
    }
}

/// Big-endian, so that the database's order is that of the ids.
fn join_key(frame: FrameId, number: u32) -> [u8; 16] {
    let mut key = [0; 16];
    key[..8].copy_from_slice(&frame.robot.0);
    key[8..12].copy_from_slice(&frame.epoch.to_be_bytes());
    key[12..].copy_from_slice(&number.to_be_bytes());
    key
}

fn split_key(key: [u8; 16]) -> (FrameId, u32) {
    let number = u128::from_be_bytes(key);
    let robot = RobotId(((number >> 64) as u64).to_be_bytes());
    (FrameId { robot, epoch: (number >> 32) as u32 }, number as u32)
}

/// Seconds since 2020; a clock that stands before gives 0 (the core then counts on from what peers know of it).
fn fresh_epoch(now: SystemTime) -> u32 {
    let secs = now.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs());
    u32::try_from(secs.saturating_sub(EPOCH_ORIGIN_SECS)).unwrap_or(u32::MAX)
}

fn text(error: impl std::fmt::Display) -> String {
    error.to_string()
}

/// A batch of records on its way to the disk.
#[derive(Debug)]
struct Batch {
    number: u64,
    records: Vec<Record>,
}

/// The thread that owns the store. Dropping it waits until all that was given is written.
#[derive(Debug)]
pub struct Writer {
    batches: Option<mpsc::Sender<Batch>>,
    thread: Option<JoinHandle<()>>,
}

impl Writer {
    /// Starts the thread. `done` hears [`Input::Persisted`] after each commit, or [`Input::PersistFailed`] once; after a
    /// failure nothing more is written, because a later batch may rest on the lost one.
    ///
    /// # Errors
    /// If the system gives no thread.
    pub fn spawn(store: Store, wait: Duration, done: impl Fn(Input) + Send + 'static) -> std::io::Result<Self> {
        let (sender, batches) = mpsc::channel();
        let thread =
            std::thread::Builder::new().name("store".into()).spawn(move || write_all(&store, wait, &batches, done))?;
        Ok(Self { batches: Some(sender), thread: Some(thread) })
    }

    /// Hands over a batch; its fate is told to `done`. How many are on their way is the core's to bound.
    pub fn persist(&self, number: u64, records: Vec<Record>) {
        if let Some(batches) = &self.batches {
            let _ = batches.send(Batch { number, records }); // the thread ends only when we do
        }
    }
}

impl Drop for Writer {
    fn drop(&mut self) {
        self.batches = None;
        if self.thread.take().is_some_and(|thread| thread.join().is_err()) {
            tracing::error!("the store's thread panicked; this is a bug");
        }
    }
}

fn write_all(store: &Store, wait: Duration, batches: &mpsc::Receiver<Batch>, done: impl Fn(Input)) {
    while let Ok(first) = batches.recv() {
        let group = gather(first, wait, batches);
        let number = |batch: Option<&Batch>| batch.map_or(0, |batch| batch.number);
        match store.commit(group.iter().flat_map(|batch| &batch.records)) {
            Ok(()) => done(Input::Persisted { up_to: number(group.last()) }),
            Err(reason) => {
                done(Input::PersistFailed { batch: number(group.first()), reason });
                while batches.recv().is_ok() {}
                return;
            }
        }
    }
}

/// Batches that share one commit: the first, and what comes within `wait` of it, up to [`COMMIT_BYTES_MAX`].
fn gather(first: Batch, wait: Duration, batches: &mpsc::Receiver<Batch>) -> Vec<Batch> {
    let deadline = Instant::now() + wait;
    let mut bytes = weight(&first);
    let mut group = vec![first];
    while bytes < COMMIT_BYTES_MAX {
        match batches.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
            Ok(batch) => {
                bytes += weight(&batch);
                group.push(batch);
            }
            Err(RecvTimeoutError::Timeout | RecvTimeoutError::Disconnected) => break,
        }
    }
    group
}

fn weight(batch: &Batch) -> usize {
    let bytes = |record: &Record| match record {
        Record::Entry { bytes, .. } | Record::Blob { bytes, .. } | Record::Private { bytes, .. } => bytes.len(),
    };
    batch.records.iter().map(bytes).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn keys_sort_as_ids_and_come_back() {
        let frame = |robot, epoch| FrameId { robot: RobotId([robot; 8]), epoch };
        let mut ids = vec![(frame(0, 1), u32::MAX), (frame(0, 256), 0), (frame(1, 0), 3), (frame(255, u32::MAX), 7)];
        ids.sort();
        let keys: Vec<_> = ids.iter().map(|(frame, number)| join_key(*frame, *number)).collect();
        assert!(keys.is_sorted());
        assert_eq!(keys.into_iter().map(split_key).collect::<Vec<_>>(), ids);
    }

    #[test]
    fn epochs_count_from_2020_and_never_fail() {
        let at = |secs| fresh_epoch(SystemTime::UNIX_EPOCH + Duration::from_secs(secs));
        assert_eq!((at(0), at(EPOCH_ORIGIN_SECS), at(EPOCH_ORIGIN_SECS + 9)), (0, 0, 9));
        assert_eq!(at(1 << 40), u32::MAX);
    }
}

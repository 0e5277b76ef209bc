//! The disk: one redb database per robot, in which facts are durable before anyone hears of them (DESIGN §4). Each
//! commit is atomic and synced, and quick repair makes reopening after a crash a matter of milliseconds. There is no
//! clock and no thread here, and the file may be any [`Medium`]: the agent brings a file, the simulator a disk that
//! fails.
//!
//! What it promises, and how:
//! - *A commit that was confirmed is there after any crash*: two-phase commits, synced.
//! - *Damage is found*: opening checks the database's own checksums and a seal over each record and its key. What is
//!   sound goes into a new file that takes the old one's place; what is not is counted, dropped, and can be fetched
//!   from peers again. If an entry may be missing, this robot's log must not be continued, for others may hold what is
//!   lost: [`Record::EpochClosed`] says so, at every start until a later epoch has begun.
//! - *What cannot be opened at all is told apart*: a store of ours that is damaged ([`StoreError::Damaged`]) can be
//!   renewed, if whoever opens it wants that; what was never one, belongs to somebody else or cannot be read now is left
//!   alone.
//! - *A disk that refuses loses nothing*: a failed commit stores nothing of its batch; the next one opens the database
//!   again. After anything but a full disk the records are first copied into a new file, since a kernel forgets pages
//!   that it could not write.
//!
//! Tables: `entries` (robot, epoch, seq), `blobs` (hash), `private` (robot, epoch, index),
//! `forks` (robot, epoch), `meta`; values are sealed.

mod error;
mod file;
mod inspect;
mod mend;
#[cfg(feature = "simulated")]
pub mod simulated;
mod tables;
mod traces;

pub use error::{CommitError, StoreError};
pub use file::{DAMAGED_KEPT_MAX, FileMedium};
pub use inspect::{Damage, Inspection, Schema, inspect};
pub use mend::{Medium, Opened, Renewed, Report};

use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{Name, RobotId};
use redb::Database;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Version of the tables that this crate writes. Version 1 had no seals, version 2 no refused pairs; both are migrated.
/// Two versions differ in two bits, so that a flipped one makes none of another.
pub const SCHEMA: u32 = 4;
/// The first version that sealed what it wrote, and kept forks.
const SEALED: u32 = 2;
/// The first version that kept refused pairs.
const REFUSING: u32 = 4;
/// Cache of the database, in bytes. Facts are read at a start and then only written, so that a small one serves.
const CACHE_BYTES: usize = 2 << 20;

/// Whose store it is.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Owner {
    /// The swarm.
    pub swarm: Name,
    /// The robot's name.
    pub robot: Name,
    /// The robot's id: its own log is the one that must never be written twice.
    pub id: RobotId,
}

impl Owner {
    fn label(&self) -> String {
        format!("{}/{}", self.swarm, self.robot)
    }
}

/// An open store.
#[derive(Debug)]
pub struct Store {
    /// `None` after a failed commit, until the database has been opened again.
    db: Option<Database>,
    medium: Box<dyn Medium>,
    owner: Owner,
    /// What a closed database needs before it is trusted again.
    distrust: bool,
}

impl Store {
    /// Opens the store, or makes a new one, and reads it; what is damaged is mended. `fresh_epoch` is the epoch that an
    /// empty store would begin: a number that rises from run to run, such as seconds since 2020.
    ///
    /// # Errors
    /// [`StoreError`]; nothing is changed then.
    pub fn open(medium: impl Medium + 'static, owner: Owner, fresh_epoch: u32) -> Result<Opened, StoreError> {
        mend::open(Box::new(medium), owner, fresh_epoch)
    }

    /// After [`StoreError::Damaged`]: puts an empty store in the place of one that cannot be opened, which is kept beside
    /// it. The epoch that it begins is `fresh_epoch`, or above the last one that the damaged file still names as this
    /// robot's own; those before are closed. A store that can be opened after all is opened.
    ///
    /// # Errors
    /// [`StoreError`]; nothing is changed then.
    pub fn renew(medium: impl Medium + 'static, owner: Owner, fresh_epoch: u32) -> Result<Opened, StoreError> {
        mend::renew(Box::new(medium), owner, fresh_epoch)
    }

    /// Makes records durable, in one synced commit. If an earlier commit failed, the database is opened again first.
    ///
    /// # Errors
    /// [`CommitError`]: nothing of the records is stored, and it is safe to try again, now or later.
    pub fn commit<'a>(&mut self, records: impl Iterator<Item = &'a Record>) -> Result<(), CommitError> {
        let db = match self.db.take() {
            Some(db) => db,
            None => mend::reopen(&*self.medium, &self.owner, self.distrust)?,
        };
        // A page that is damaged while we run may trip an assertion of the database's: an error like any other.
        let done = catch_unwind(AssertUnwindSafe(|| tables::write(&db, |writing| tables::put_all(writing, records))));
        match done.unwrap_or_else(|panic| Err(CommitError::Failed(tables::what_panicked(&*panic)))) {
            Ok(()) => {
                self.db = Some(db);
                self.distrust = false;
                Ok(())
            }
            Err(error @ CommitError::Conflict(_)) => {
                self.db = Some(db); // the database is well
                Err(error)
            }
            Err(error) => {
                self.distrust |= !matches!(error, CommitError::Full(_));
                drop(catch_unwind(AssertUnwindSafe(|| drop(db))));
                Err(error)
            }
        }
    }
}

//! Opening: a store that is whole is taken as it is, an older or damaged one is written anew beside it and put in its
//! place, one of somebody else or of a later version is refused. One that cannot be opened is refused, too, until it is
//! asked to be renewed.

use crate::inspect::{self, Damage, Inspection, Schema};
use crate::tables::{self, write};
use crate::traces::Traces;
use crate::{CACHE_BYTES, CommitError, Owner, SCHEMA, Store, StoreError};
use merganser_protocol::agent::Restored;
use merganser_protocol::agent::io::Record;
use redb::{Builder, Database, DatabaseError};
use std::fmt::Debug;
use std::io;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};

/// Where a database lives: a place for the one in use, and one for a spare while it is being made anew.
pub trait Medium: Debug + Send {
    /// Its name, for messages.
    fn path(&self) -> &Path;

    /// Opens the database, or makes an empty one.
    ///
    /// # Errors
    /// Those of [`Builder::create`].
    fn create(&self, builder: &Builder) -> Result<Database, DatabaseError>;

    /// Makes an empty spare database; an earlier spare is dropped.
    ///
    /// # Errors
    /// Those of [`Builder::create`].
    fn create_spare(&self, builder: &Builder) -> Result<Database, DatabaseError>;

    /// Puts the spare in the database's place, in one step and durably; handles to the spare stay good. `keep` asks to
    /// keep the old one for whoever wants to look at it; where, is returned.
    ///
    /// # Errors
    /// Those of the file system.
    fn promote_spare(&self, keep: bool) -> io::Result<Option<PathBuf>>;

    /// Whether there is something that holds nothing: no database leaves that.
    ///
    /// # Errors
    /// Those of the file system.
    fn is_emptied(&self) -> io::Result<bool>;

    /// All bytes, whatever they are.
    ///
    /// # Errors
    /// Those of the file system.
    fn bytes(&self) -> io::Result<Box<dyn io::Read + '_>>;
}

/// A store that was opened, and what it held.
#[derive(Debug)]
pub struct Opened {
    /// The store.
    pub store: Store,
    /// For the core.
    pub restored: Restored,
    /// For people.
    pub report: Report,
}

/// What opening found and did.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Report {
    /// The older schema that it was migrated from.
    pub migrated_from: Option<u32>,
    /// What was not sound, the first thousand, and was dropped.
    pub damaged: Vec<Damage>,
    /// How much was not sound.
    pub damaged_count: usize,
    /// An entry may be missing: this robot begins a new epoch.
    pub entries_lost: bool,
    /// Why the damage is still in the file, if it is: the disk did not let it be mended. Until it does, commits fail.
    pub unmended: Option<String>,
    /// Where the damaged file is kept, if it is.
    pub kept: Option<PathBuf>,
    /// It could not be opened, and an empty store took its place.
    pub renewed: Option<Renewed>,
}

/// A store that took the place of one that could not be opened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Renewed {
    /// What the database said.
    pub reason: String,
    /// Bytes of the damaged one.
    pub len: u64,
    /// The last epoch that it still named as this robot's own.
    pub last_epoch: Option<u32>,
    /// The epoch that begins.
    pub epoch: u32,
}

pub(crate) fn open(medium: Box<dyn Medium>, owner: Owner, fresh_epoch: u32) -> Result<Opened, StoreError> {
    let path = medium.path().to_path_buf();
    let failed = |reason: String| StoreError::Failed { path: path.clone(), reason };
    let mut db = open_database(&*medium, Some(&owner))?;
    let mut seen = inspect::read(&mut db).map_err(failed)?;
    let mut report = Report {
        damaged: std::mem::take(&mut seen.damaged),
        damaged_count: seen.damaged_count,
        entries_lost: seen.entries_lost,
        ..Report::default()
    };
    let founded = match &seen.schema {
        Schema::New => {
            found(&db, &owner, fresh_epoch, None, []).map_err(|error| failed(error.to_string()))?;
            true
        }
        Schema::Version(version) if *version > SCHEMA || *version == 0 => {
            return Err(StoreError::Schema { path, found: version.to_string() });
        }
        Schema::Unknown(found) => return Err(StoreError::Schema { path, found: found.clone() }),
        Schema::Version(version) => {
            report.migrated_from = (*version < SCHEMA).then_some(*version);
            false
        }
    };
    if let Some(found) = seen.owner.as_ref().filter(|found| **found != owner.label()) {
        return Err(StoreError::Foreign { path, owner: found.clone(), wanted: owner.label() });
    }
    let fresh_epoch = seen.fresh_epoch.unwrap_or(0).max(fresh_epoch);
    if report.entries_lost {
        seen.closed_epoch = Some(last_epoch(&seen, &owner));
    }
    let mut usable = Some(db);
    if !founded && (report.migrated_from.is_some() || report.damaged_count > 0) {
        drop(catch_unwind(AssertUnwindSafe(|| drop(usable.take()))));
        let rebuilt = rebuild(&*medium, &owner, fresh_epoch, &seen, report.damaged_count > 0);
        usable = match rebuilt {
            Ok((db, kept)) => {
                report.kept = kept;
                Some(db)
            }
            // Without room for a second file there is no writing, as what is damaged may trip the database. Each commit
            // tries to mend it first.
            Err(error) if report.migrated_from.is_none() => {
                report.unmended = Some(error.to_string());
                None
            }
            Err(error) => return Err(failed(format!("cannot be migrated to schema {SCHEMA}: {error}"))),
        };
    }
    let mut records = seen.records;
    records.extend(seen.closed_epoch.map(|epoch| Record::EpochClosed { epoch }));
    let distrust = usable.is_none();
    let store = Store { db: usable, medium, owner, distrust };
    Ok(Opened { store, restored: Restored { records, fresh_epoch }, report })
}

/// See [`Store::renew`].
pub(crate) fn renew(medium: Box<dyn Medium>, owner: Owner, fresh_epoch: u32) -> Result<Opened, StoreError> {
    let path = medium.path().to_path_buf();
    let failed = |reason: String| StoreError::Failed { path: path.clone(), reason };
    let reason = match open_database(&*medium, Some(&owner)) {
        Err(StoreError::Damaged { reason, .. }) => reason,
        Err(other) => return Err(other),
        Ok(db) => {
            drop(db);
            return open(medium, owner, fresh_epoch);
        }
    };
    let traces = medium.bytes().and_then(|bytes| Traces::of(bytes, Some(&owner)));
    let traces = traces.map_err(|error| failed(error.to_string()))?;
    let epoch = traces.epoch.map_or(fresh_epoch, |last| last.saturating_add(1).max(fresh_epoch));
    // What comes back of our own past is of these, and must not be gone on with.
    let closed_epoch = epoch.checked_sub(1);
    let (db, kept) = replace(&*medium, &owner, epoch, closed_epoch, &[], true).map_err(|e| failed(e.to_string()))?;
    let renewed = Renewed { reason, len: traces.len, last_epoch: traces.epoch, epoch };
    let report = Report { entries_lost: true, kept, renewed: Some(renewed), ..Report::default() };
    let records = closed_epoch.map(|epoch| Record::EpochClosed { epoch }).into_iter().collect();
    let store = Store { db: Some(db), medium, owner, distrust: false };
    Ok(Opened { store, restored: Restored { records, fresh_epoch: epoch }, report })
}

/// Opens the database itself. What cannot be opened is looked at, to tell a damaged store from what never was one.
pub(crate) fn open_database(medium: &dyn Medium, owner: Option<&Owner>) -> Result<Database, StoreError> {
    let path = medium.path().to_path_buf();
    let refuse = |reason: String| match medium.bytes().and_then(|bytes| Traces::of(bytes, owner)) {
        Ok(traces) => traces.refuse(medium.path().into(), owner, reason),
        Err(error) => StoreError::Failed { path: medium.path().into(), reason: error.to_string() },
    };
    match medium.is_emptied() {
        Ok(false) => {}
        // The database would take it for a new one.
        Ok(true) => return Err(StoreError::Damaged { path, reason: "the file is empty".into() }),
        Err(error) => return Err(StoreError::Failed { path, reason: error.to_string() }),
    }
    let opened = catch_unwind(AssertUnwindSafe(|| medium.create(Builder::new().set_cache_size(CACHE_BYTES))));
    let error = match opened {
        Ok(Ok(db)) => return Ok(db),
        Ok(Err(error)) => error,
        Err(panic) => return Err(refuse(tables::what_panicked(&*panic))),
    };
    Err(match error {
        DatabaseError::DatabaseAlreadyOpen => StoreError::InUse(path),
        DatabaseError::UpgradeRequired(_) | DatabaseError::Storage(redb::StorageError::Corrupted(_)) => {
            refuse(error.to_string())
        }
        DatabaseError::Storage(redb::StorageError::Io(error)) if inspect::tells_of_damage(&error) => {
            refuse(error.to_string())
        }
        other => StoreError::Failed { path, reason: other.to_string() },
    })
}

/// After a failed commit: opens the database again. If it is not to be trusted, into a new file.
pub(crate) fn reopen(medium: &dyn Medium, owner: &Owner, distrust: bool) -> Result<Database, CommitError> {
    let opened = catch_unwind(AssertUnwindSafe(|| medium.create(Builder::new().set_cache_size(CACHE_BYTES))));
    let mut db = opened.unwrap_or_else(|panic| {
        Err(DatabaseError::Storage(redb::StorageError::Corrupted(tables::what_panicked(&*panic))))
    })?;
    if !distrust {
        return Ok(db);
    }
    let mut seen = inspect::read(&mut db).map_err(CommitError::Failed)?;
    if seen.entries_lost {
        seen.closed_epoch = Some(last_epoch(&seen, owner));
    }
    let damaged = !seen.is_sound();
    let fresh_epoch = seen.fresh_epoch.unwrap_or(0);
    drop(catch_unwind(AssertUnwindSafe(|| drop(db))));
    rebuild(medium, owner, fresh_epoch, &seen, damaged).map(|(db, _)| db)
}

/// The last epoch of this robot's own that the store ever knew of.
fn last_epoch(seen: &Inspection, owner: &Owner) -> u32 {
    let own = seen.records.iter().filter_map(|record| match record {
        Record::Entry { id, .. } if id.frame.robot == owner.id => Some(id.frame.epoch),
        _ => None,
    });
    own.chain(seen.closed_epoch).chain(seen.fresh_epoch).max().unwrap_or(0)
}

fn rebuild(
    medium: &dyn Medium,
    owner: &Owner,
    fresh_epoch: u32,
    seen: &Inspection,
    keep: bool,
) -> Result<(Database, Option<PathBuf>), CommitError> {
    replace(medium, owner, fresh_epoch, seen.closed_epoch, &seen.records, keep)
}

/// Puts a new store with these records in the place of what is there; nothing is moved before it is whole.
fn replace(
    medium: &dyn Medium,
    owner: &Owner,
    fresh_epoch: u32,
    closed_epoch: Option<u32>,
    records: &[Record],
    keep: bool,
) -> Result<(Database, Option<PathBuf>), CommitError> {
    let db = medium.create_spare(Builder::new().set_cache_size(CACHE_BYTES))?;
    found(&db, owner, fresh_epoch, closed_epoch, records)?;
    let kept = medium.promote_spare(keep).map_err(|error| CommitError::of_io(&error))?;
    Ok((db, kept))
}

/// Writes a whole new store, in one commit.
fn found<'a>(
    db: &Database,
    owner: &Owner,
    fresh_epoch: u32,
    closed_epoch: Option<u32>,
    records: impl IntoIterator<Item = &'a Record>,
) -> Result<(), CommitError> {
    write(db, |transaction| {
        tables::make(transaction)?;
        tables::put_meta(transaction, tables::META_OWNER, owner.label().as_bytes())?;
        tables::put_meta(transaction, tables::META_FRESH_EPOCH, &fresh_epoch.to_le_bytes())?;
        tables::put_meta(transaction, tables::META_SCHEMA, &SCHEMA.to_le_bytes())?;
        tables::put_all(transaction, records.into_iter())?;
        tables::put_all(transaction, closed_epoch.map(|epoch| Record::EpochClosed { epoch }).iter())
    })
}

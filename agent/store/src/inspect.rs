//! Reading a whole store without trusting it: what is sound, what is not, and whether an entry may be missing.

use crate::mend::Medium;
use crate::tables::{self, BLOBS, ENTRIES, FORKS, META, PRIVATE, number, split_key, unseal, unsealed};
use crate::{SCHEMA, StoreError, mend};
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, Hash, SubmapId};
use merganser_protocol::wire::Entry;
use redb::{
    Database, DatabaseError, ReadableDatabase, ReadableTable, ReadableTableMetadata, TableDefinition, TableError,
};
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Damaged records listed one by one; the rest is counted.
const LISTED_MAX: usize = 1000;

/// Which tables a database has.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Schema {
    /// None: it was just made.
    New,
    /// Those of this version.
    Version(u32),
    /// None that we know.
    Unknown(String),
}

/// A record, or a part of a table, that cannot be trusted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Damage {
    /// The table.
    pub table: &'static str,
    /// Which record, as far as it can be told.
    pub what: String,
    /// What is wrong.
    pub why: String,
}

/// What a store holds.
#[derive(Clone, Debug)]
pub struct Inspection {
    /// Which tables.
    pub schema: Schema,
    /// `swarm/robot` it was made for, if that can be read.
    pub owner: Option<String>,
    /// The epoch that its first log was to have.
    pub fresh_epoch: Option<u32>,
    /// Epochs up to this one are not to be continued.
    pub closed_epoch: Option<u32>,
    /// All sound records.
    pub records: Vec<Record>,
    /// What is not sound, the first thousand.
    pub damaged: Vec<Damage>,
    /// How much is not sound.
    pub damaged_count: usize,
    /// An entry may be missing.
    pub entries_lost: bool,
}

/// Reads the whole store and changes nothing but what a crash left unfinished.
///
/// # Errors
/// [`StoreError`] if it cannot be opened at all.
pub fn inspect(medium: &dyn Medium) -> Result<Inspection, StoreError> {
    let mut db = mend::open_database(medium)?;
    read(&mut db).map_err(|reason| StoreError::Failed { path: medium.path().into(), reason })
}

/// See [`inspect`].
///
/// # Errors
/// What the disk said, if it cannot be read now.
pub(crate) fn read(db: &mut Database) -> Result<Inspection, String> {
    let mut seen = Inspection {
        schema: Schema::New,
        owner: None,
        fresh_epoch: None,
        closed_epoch: None,
        records: Vec::new(),
        damaged: Vec::new(),
        damaged_count: 0,
        entries_lost: false,
    };
    if let Some(why) = check_pages(db)? {
        seen.add("pages", "the file".into(), why);
    }
    seen.read_meta(db);
    match seen.schema {
        Schema::New | Schema::Unknown(_) => {}
        Schema::Version(version) => {
            seen.read_entries(db, version);
            seen.read_blobs(db, version);
            seen.read_private(db, version);
            if version >= SCHEMA {
                seen.read_forks(db);
            }
        }
    }
    Ok(seen)
}

/// The database's own checksums, over all pages: what is wrong, if anything.
fn check_pages(db: &mut Database) -> Result<Option<String>, String> {
    match catch_unwind(AssertUnwindSafe(|| db.check_integrity())) {
        Ok(Ok(_)) => Ok(None), // `false`: a crash left something unfinished that is now done
        Ok(Err(DatabaseError::Storage(redb::StorageError::Io(error)))) => Err(error.to_string()),
        Ok(Err(error)) => Ok(Some(error.to_string())),
        Err(panic) => Ok(Some(tables::what_panicked(&*panic))),
    }
}

impl Inspection {
    /// Whether all is well.
    pub fn is_sound(&self) -> bool {
        self.damaged_count == 0
    }

    fn add(&mut self, table: &'static str, what: String, why: String) {
        self.damaged_count += 1;
        self.entries_lost |= table == "entries";
        if self.damaged.len() < LISTED_MAX {
            self.damaged.push(Damage { table, what, why });
        }
    }

    fn read_meta(&mut self, db: &Database) {
        let (schema, trouble) = meta(db, tables::META_SCHEMA);
        let numbered = schema.as_deref().and_then(number);
        self.schema = match (schema, numbered) {
            (_, Some(version)) => Schema::Version(version),
            (Some(_), None) => Schema::Unknown("of unknown form".into()),
            // No number, but tables: what is sealed says by itself which schema it has.
            (None, None) if trouble.is_some() || has_tables(db) => Schema::Version(SCHEMA),
            (None, None) => Schema::New,
        };
        if numbered.is_none() && self.schema == Schema::Version(SCHEMA) {
            self.add("meta", "schema".into(), trouble.unwrap_or_else(|| "is missing".into()));
        }
        let Schema::Version(version) = self.schema else { return };
        self.owner = self.sealed_meta(db, version, tables::META_OWNER).and_then(|bytes| String::from_utf8(bytes).ok());
        self.fresh_epoch = self.sealed_meta(db, version, tables::META_FRESH_EPOCH).as_deref().and_then(number);
        self.closed_epoch = self.sealed_meta(db, version, tables::META_CLOSED_EPOCH).as_deref().and_then(number);
    }

    fn sealed_meta(&mut self, db: &Database, version: u32, key: &'static str) -> Option<Vec<u8>> {
        let optional = key == tables::META_CLOSED_EPOCH;
        match meta(db, key) {
            (Some(value), _) if version < SCHEMA => Some(value),
            (Some(value), _) => {
                let sound = unseal("meta", key.as_bytes(), &value).map(<[u8]>::to_vec);
                if sound.is_none() {
                    self.add("meta", key.into(), "its seal is broken".into());
                    // That an epoch was closed may be what was lost.
                    self.entries_lost |= optional;
                }
                sound
            }
            (None, None) if optional => None,
            (None, trouble) => {
                self.add("meta", key.into(), trouble.unwrap_or_else(|| "is missing".into()));
                self.entries_lost |= optional;
                None
            }
        }
    }

    fn read_entries(&mut self, db: &Database, version: u32) {
        for (key, value) in self.scan(db, ENTRIES, "entries") {
            let (frame, seq) = split_key(key);
            let id = EntryId { frame, seq };
            // Of old, nothing was sealed: an entry at least names its place.
            let sound = if version < SCHEMA {
                Entry::decode(&value).is_ok_and(|entry| entry.id() == id).then_some(value)
            } else {
                unsealed("entries", &key, value)
            };
            match sound {
                Some(bytes) => self.records.push(Record::Entry { id, bytes }),
                None => self.add("entries", id.to_string(), "its bytes have changed".into()),
            }
        }
    }

    fn read_blobs(&mut self, db: &Database, version: u32) {
        for (key, value) in self.scan(db, BLOBS, "blobs") {
            let bytes = if version < SCHEMA { Some(value) } else { unsealed("blobs", &key, value) };
            match bytes.filter(|bytes| Hash::of(bytes).0 == key) {
                Some(bytes) => self.records.push(Record::Blob { hash: Hash(key), bytes }),
                None => self.add("blobs", Hash(key).to_string(), "its bytes are not those that its hash names".into()),
            }
        }
    }

    fn read_private(&mut self, db: &Database, version: u32) {
        for (key, value) in self.scan(db, PRIVATE, "private") {
            let (frame, index) = split_key(key);
            let submap = SubmapId { frame, index };
            match if version < SCHEMA { Some(value) } else { unsealed("private", &key, value) } {
                Some(bytes) => self.records.push(Record::Private { submap, bytes }),
                None => self.add("private", submap.to_string(), "its bytes have changed".into()),
            }
        }
    }

    fn read_forks(&mut self, db: &Database) {
        for (key, value) in self.scan(db, FORKS, "forks") {
            let (frame, _) = split_key(key);
            match unseal("forks", &key, &value).and_then(tables::split_proof) {
                Some(proof) => self.records.push(Record::Fork { frame, proof }),
                None => self.add("forks", frame.to_string(), "its bytes have changed".into()),
            }
        }
    }

    /// All rows that can be read: from the front, and if that ends early, from the back.
    fn scan<const N: usize>(
        &mut self,
        db: &Database,
        table: TableDefinition<'_, [u8; N], &'static [u8]>,
        name: &'static str,
    ) -> Vec<([u8; N], Vec<u8>)> {
        let mut rows = Vec::new();
        let mut trouble = walk(db, table, Direction::Forward, |key, value| {
            rows.push((key, value));
            true
        });
        if trouble.is_some() {
            let last = rows.last().map(|(key, _)| *key);
            let mut tail = Vec::new();
            let _ = walk(db, table, Direction::Backward, |key, value| {
                let new = last.is_none_or(|last| key > last);
                if new {
                    tail.push((key, value));
                }
                new
            }); // the same trouble, met from behind
            rows.extend(tail.into_iter().rev());
        }
        let len = catch_unwind(AssertUnwindSafe(|| table_len(db, table))).ok().flatten();
        if trouble.is_none() && len != Some(rows.len() as u64) {
            trouble = Some(format!("{} rows were found where there should be {len:?}", rows.len()));
        }
        if trouble.is_none() && !rows.is_sorted_by(|(a, _), (b, _)| a < b) {
            trouble = Some("rows are out of order".into());
        }
        if let Some(why) = trouble {
            self.add(name, "a part of the table".into(), why);
        }
        rows
    }
}

#[derive(Clone, Copy)]
enum Direction {
    Forward,
    Backward,
}

/// Shows rows to `each` until it says no or no more can be read; what the trouble was.
fn walk<const N: usize>(
    db: &Database,
    table: TableDefinition<'_, [u8; N], &'static [u8]>,
    direction: Direction,
    mut each: impl FnMut([u8; N], Vec<u8>) -> bool,
) -> Option<String> {
    let mut all = || -> Result<(), redb::Error> {
        let table = db.begin_read()?.open_table(table)?;
        let mut rows = table.iter()?;
        loop {
            let row = match direction {
                Direction::Forward => rows.next(),
                Direction::Backward => rows.next_back(),
            };
            let Some((key, value)) = row.transpose()? else { break };
            if !each(key.value(), value.value().to_vec()) {
                break;
            }
        }
        Ok(())
    };
    match catch_unwind(AssertUnwindSafe(&mut all)) {
        Ok(Ok(())) => None,
        Ok(Err(error)) => Some(error.to_string()),
        Err(panic) => Some(tables::what_panicked(&*panic)),
    }
}

fn table_len<const N: usize>(db: &Database, table: TableDefinition<'_, [u8; N], &'static [u8]>) -> Option<u64> {
    db.begin_read().ok()?.open_table(table).ok()?.len().ok()
}

/// The stored value, and what kept it from being read.
fn meta(db: &Database, key: &str) -> (Option<Vec<u8>>, Option<String>) {
    let get = || -> Result<Option<Vec<u8>>, redb::Error> {
        match db.begin_read()?.open_table(META) {
            Ok(table) => Ok(table.get(key)?.map(|value| value.value().to_vec())),
            Err(TableError::TableDoesNotExist(_)) => Ok(None),
            Err(error) => Err(error.into()),
        }
    };
    match catch_unwind(AssertUnwindSafe(get)) {
        Ok(Ok(value)) => (value, None),
        Ok(Err(error)) => (None, Some(error.to_string())),
        Err(panic) => (None, Some(tables::what_panicked(&*panic))),
    }
}

fn has_tables(db: &Database) -> bool {
    let count = || db.begin_read().ok()?.list_tables().ok().map(Iterator::count);
    catch_unwind(AssertUnwindSafe(count)).ok().flatten() != Some(0)
}

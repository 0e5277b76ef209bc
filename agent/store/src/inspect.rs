//! Reading a whole store without trusting it: what is sound, what is not, and whether an entry may be missing.

use crate::mend::Medium;
use crate::tables::{self, BLOBS, ENTRIES, FORKS, META, PRIVATE, REFUSED, number, split_key, unseal, unsealed};
use crate::{REFUSING, SCHEMA, SEALED, StoreError, mend};
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, Hash, SubmapId};
use merganser_protocol::wire::Entry;
use redb::{
    Database, ReadableDatabase, ReadableTable, ReadableTableMetadata, TableDefinition, TableError, TableHandle,
};
use std::io;
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
    /// What the disk said where it gave nothing.
    unreadable: Option<String>,
}

/// Reads the whole store and changes nothing but what a crash left unfinished.
///
/// # Errors
/// [`StoreError`] if it cannot be opened at all.
pub fn inspect(medium: &dyn Medium) -> Result<Inspection, StoreError> {
    let mut db = mend::open_database(medium, None)?;
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
        unreadable: None,
    };
    if let Err(trouble) = check_pages(db) {
        seen.meet("pages", "the file".into(), trouble);
    }
    seen.read_meta(db);
    match seen.schema {
        Schema::New | Schema::Unknown(_) => {}
        Schema::Version(version) => {
            seen.read_entries(db, version);
            seen.read_blobs(db, version);
            seen.read_private(db, version);
            if version >= SEALED {
                seen.read_forks(db);
            }
            if version >= REFUSING {
                seen.read_refused(db);
            }
        }
    }
    // What the disk did not give now it may give later: it must not be taken for lost, and dropped.
    seen.unreadable.take().map_or(Ok(seen), Err)
}

/// Why something was not read.
enum Trouble {
    /// The disk does not give it.
    Unreadable(String),
    /// It is not what was written.
    Damaged(String),
}

fn attempt<T>(work: impl FnOnce() -> Result<T, redb::Error>) -> Result<T, Trouble> {
    match catch_unwind(AssertUnwindSafe(work)) {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(redb::Error::Io(error))) if !tells_of_damage(&error) => Err(Trouble::Unreadable(error.to_string())),
        Ok(Err(error)) => Err(Trouble::Damaged(error.to_string())),
        Err(panic) => Err(Trouble::Damaged(tables::what_panicked(&*panic))),
    }
}

/// Whether it says that the file is shorter than, or not what, it should be; else the disk may give it later.
pub(crate) fn tells_of_damage(error: &io::Error) -> bool {
    matches!(error.kind(), io::ErrorKind::UnexpectedEof | io::ErrorKind::InvalidData)
}

/// The database's own checksums, over all pages.
fn check_pages(db: &mut Database) -> Result<(), Trouble> {
    // `false`: a crash left something unfinished that is now done.
    attempt(|| Ok(db.check_integrity().map(drop)?))
}

impl Inspection {
    /// Whether all is well.
    pub fn is_sound(&self) -> bool {
        self.damaged_count == 0
    }

    fn meet(&mut self, table: &'static str, what: String, trouble: Trouble) {
        match trouble {
            Trouble::Damaged(why) => self.add(table, what, why),
            Trouble::Unreadable(why) => self.unreadable = self.unreadable.take().or(Some(why)),
        }
    }

    fn add(&mut self, table: &'static str, what: String, why: String) {
        self.damaged_count += 1;
        self.entries_lost |= table == "entries";
        if self.damaged.len() < LISTED_MAX {
            self.damaged.push(Damage { table, what, why });
        }
    }

    fn read_meta(&mut self, db: &Database) {
        let missing = || Trouble::Damaged("is missing".into());
        let (schema, trouble) = match meta(db, tables::META_SCHEMA) {
            Ok(Some(schema)) => match number(&schema) {
                // One bit away from ours there is no other version's.
                Some(turned)
                    if (turned ^ SCHEMA).is_power_of_two()
                        && self.sealed_meta(db, SCHEMA, tables::META_OWNER).is_some() =>
                {
                    (Schema::Version(SCHEMA), Some(Trouble::Damaged(format!("is {turned}, which no version writes"))))
                }
                Some(version) => (Schema::Version(version), None),
                // No version writes anything but a number there. Where the owner is sealed as we seal, it is damage.
                None if self.sealed_meta(db, SCHEMA, tables::META_OWNER).is_some() => {
                    (Schema::Version(SCHEMA), Some(Trouble::Damaged("is no number".into())))
                }
                None => (Schema::Unknown("of unknown form".into()), None),
            },
            Ok(None) if has_foreign_tables(db) => (Schema::Unknown("that is none of ours".into()), None),
            // No number, but tables: what is sealed says by itself which schema it has.
            Ok(None) if has_tables(db) => (Schema::Version(SCHEMA), Some(missing())),
            Ok(None) => (Schema::New, None),
            Err(trouble) => (Schema::Version(SCHEMA), Some(trouble)),
        };
        self.schema = schema;
        if let Some(trouble) = trouble {
            self.meet("meta", "schema".into(), trouble);
        }
        let Schema::Version(version) = self.schema else { return };
        self.owner = self.sealed_meta(db, version, tables::META_OWNER).and_then(|bytes| String::from_utf8(bytes).ok());
        self.fresh_epoch = self.sealed_meta(db, version, tables::META_FRESH_EPOCH).as_deref().and_then(number);
        self.closed_epoch = self.sealed_meta(db, version, tables::META_CLOSED_EPOCH).as_deref().and_then(number);
        self.look_for_lost_keys(db);
        let session = self.sealed_meta(db, version, tables::META_SESSION);
        self.records.extend(session.as_deref().and_then(tables::split_session));
    }

    fn sealed_meta(&mut self, db: &Database, version: u32, key: &'static str) -> Option<Vec<u8>> {
        let optional = [tables::META_CLOSED_EPOCH, tables::META_SESSION].contains(&key);
        match meta(db, key) {
            Ok(Some(value)) if version < SEALED => Some(value),
            Ok(Some(value)) => {
                let sound = unseal("meta", key.as_bytes(), &value).map(<[u8]>::to_vec);
                if sound.is_none() {
                    self.add("meta", key.into(), "its seal is broken".into());
                    // That an epoch was closed may be what was lost, or that the front end began another run.
                    self.entries_lost |= optional;
                }
                sound
            }
            Ok(None) if optional => None,
            missing => {
                let trouble = missing.err().unwrap_or_else(|| Trouble::Damaged("is missing".into()));
                self.meet("meta", key.into(), trouble);
                self.entries_lost |= optional;
                None
            }
        }
    }

    /// A key that nobody wrote was another, and perhaps one that need not be there.
    fn look_for_lost_keys(&mut self, db: &Database) {
        let lost = match meta_keys(db) {
            Ok(keys) => keys.iter().any(|key| !tables::META_KEYS.contains(&key.as_str())),
            Err(Trouble::Damaged(_)) => true,
            Err(trouble) => return self.meet("meta", "keys".into(), trouble),
        };
        if lost {
            self.add("meta", "a key".into(), "it is none that was written".into());
            self.entries_lost = true;
        }
    }

    fn read_entries(&mut self, db: &Database, version: u32) {
        for (key, value) in self.scan(db, ENTRIES, "entries") {
            let (frame, seq) = split_key(key);
            let id = EntryId { frame, seq };
            // Of old, nothing was sealed: an entry at least names its place.
            let sound = if version < SEALED {
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
            let bytes = if version < SEALED { Some(value) } else { unsealed("blobs", &key, value) };
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
            match if version < SEALED { Some(value) } else { unsealed("private", &key, value) } {
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

    fn read_refused(&mut self, db: &Database) {
        for (key, value) in self.scan(db, REFUSED, "refused") {
            let [i, j] = tables::split_pair(key);
            let evidence =
                unseal("refused", &key, &value).and_then(|value| value.try_into().ok()).map(u64::from_le_bytes);
            match evidence {
                Some(_) => self.records.push(Record::Refused { i, j, evidence }),
                None => self.add("refused", format!("{i} {j}"), "its bytes have changed".into()),
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
        })
        .err();
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
        trouble = trouble.or_else(|| check_rows(db, table, &rows).err());
        if let Some(trouble) = trouble {
            self.meet(name, "a part of the table".into(), trouble);
        }
        rows
    }
}

#[derive(Clone, Copy)]
enum Direction {
    Forward,
    Backward,
}

/// Shows rows to `each` until it says no or no more can be read.
fn walk<const N: usize>(
    db: &Database,
    table: TableDefinition<'_, [u8; N], &'static [u8]>,
    direction: Direction,
    mut each: impl FnMut([u8; N], Vec<u8>) -> bool,
) -> Result<(), Trouble> {
    attempt(|| {
        let table = db.begin_read()?.open_table(table)?;
        let mut rows = table.iter()?;
        loop {
            let row = match direction {
                Direction::Forward => rows.next(),
                Direction::Backward => rows.next_back(),
            };
            let Some((key, value)) = row.transpose()? else { return Ok(()) };
            if !each(key.value(), value.value().to_vec()) {
                return Ok(());
            }
        }
    })
}

/// Whether the rows are as many as the table says, and rise.
fn check_rows<const N: usize>(
    db: &Database,
    table: TableDefinition<'_, [u8; N], &'static [u8]>,
    rows: &[([u8; N], Vec<u8>)],
) -> Result<(), Trouble> {
    let len = attempt(|| Ok(db.begin_read()?.open_table(table)?.len()?))?;
    if len != rows.len() as u64 {
        return Err(Trouble::Damaged(format!("{} rows were found where there should be {len}", rows.len())));
    }
    if !rows.is_sorted_by(|(a, _), (b, _)| a < b) {
        return Err(Trouble::Damaged("rows are out of order".into()));
    }
    Ok(())
}

/// The stored value.
fn meta(db: &Database, key: &str) -> Result<Option<Vec<u8>>, Trouble> {
    attempt(|| match db.begin_read()?.open_table(META) {
        Ok(table) => Ok(table.get(key)?.map(|value| value.value().to_vec())),
        Err(TableError::TableDoesNotExist(_)) => Ok(None),
        Err(error) => Err(error.into()),
    })
}

fn meta_keys(db: &Database) -> Result<Vec<String>, Trouble> {
    attempt(|| {
        let meta = db.begin_read()?.open_table(META)?;
        meta.iter()?.map(|row| Ok(row?.0.value().to_owned())).collect()
    })
}

/// Whether there are tables, and each has a name that is none of ours.
fn has_foreign_tables(db: &Database) -> bool {
    let ours = [ENTRIES.name(), BLOBS.name(), PRIVATE.name(), FORKS.name(), REFUSED.name(), META.name()];
    let names =
        attempt(|| Ok(db.begin_read()?.list_tables()?.map(|table| table.name().to_owned()).collect::<Vec<_>>()));
    names.is_ok_and(|names| !names.is_empty() && !names.iter().any(|name| ours.contains(&name.as_str())))
}

/// Whether there are tables, for all that can be read.
fn has_tables(db: &Database) -> bool {
    attempt(|| Ok(db.begin_read()?.list_tables()?.next().is_some())).unwrap_or(true)
}

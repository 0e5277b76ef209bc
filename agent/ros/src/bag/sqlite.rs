//! ROS 2's sqlite3 files, by SQLite itself: tables `topics` and `messages`. Type definitions, which later versions
//! write, are not needed. Messages that were packed one by one (zstd) are unpacked.

use super::{BagError, BagProblem, Damage, Flow, MESSAGE_BYTES_MAX, Record, Topics};
use crate::wire::Serialization;
use rusqlite::limits::Limit;
use rusqlite::types::ValueRef;
use rusqlite::{Connection, OpenFlags};
use std::collections::BTreeMap;
use std::io::Read as _;
use std::path::Path;

/// Bytes of a row beside its message.
const ROW_BYTES: i32 = 1 << 20;
/// How a message begins that is packed; no CDR begins so.
const ZSTD_MAGIC: [u8; 4] = [0x28, 0xb5, 0x2f, 0xfd];

pub(super) fn scan(
    path: &Path,
    topics: &mut Topics,
    damage: &mut Damage,
    counts: bool,
    each: &mut dyn FnMut(Record<'_>) -> Flow,
) -> Result<Flow, BagError> {
    let bag = open(path).map_err(|problem| problem.of(path))?;
    let known = read_topics(&bag, topics).map_err(|problem| problem.of(path))?;
    let result = if counts { count(&bag, &known, damage, each) } else { messages(&bag, &known, damage, each) };
    match result {
        Ok(flow) => Ok(flow),
        // A file that was cut is read as far as its pages go.
        Err(rusqlite::Error::SqliteFailure(error, _)) if error.code == rusqlite::ErrorCode::DatabaseCorrupt => {
            damage.stop(path, "the database is damaged or was cut off");
            Ok(Flow::On)
        }
        Err(error) => Err(BagProblem::Sqlite(error.to_string()).of(path)),
    }
}

/// Opens it so that nothing is written, not even beside it, unless the recorder left a journal to be played.
fn open(path: &Path) -> Result<Connection, BagProblem> {
    let told = |error: rusqlite::Error| BagProblem::Sqlite(error.to_string());
    let name = path.to_str().ok_or_else(|| BagProblem::Sqlite("its name is not UTF-8; rename it".into()))?;
    let escaped = name.replace('%', "%25").replace('?', "%3f").replace('#', "%23");
    let is_final = ["-wal", "-journal"].iter().all(|suffix| !Path::new(&format!("{name}{suffix}")).exists());
    let uri = format!("file:{escaped}?mode=ro{}", if is_final { "&immutable=1" } else { "" });
    let flags = OpenFlags::SQLITE_OPEN_READ_ONLY | OpenFlags::SQLITE_OPEN_URI | OpenFlags::SQLITE_OPEN_NO_MUTEX;
    let bag = Connection::open_with_flags(uri, flags).map_err(told)?;
    bag.set_limit(Limit::SQLITE_LIMIT_LENGTH, MESSAGE_BYTES_MAX as i32 + ROW_BYTES).map_err(told)?;
    bag.set_limit(Limit::SQLITE_LIMIT_ATTACHED, 0).map_err(told)?;
    bag.execute_batch("PRAGMA trusted_schema = OFF; PRAGMA query_only = ON;").map_err(told)?;
    // A view may never end.
    for table in ["topics", "messages"] {
        let real = "SELECT COUNT(*) FROM sqlite_master WHERE type = 'table' AND name = ?1 AND sql LIKE 'CREATE TABLE%'";
        let found: i64 = bag.query_row(real, [table], |row| row.get(0)).map_err(told)?;
        if found != 1 {
            return Err(BagProblem::Tables(format!("there is no table {table}")));
        }
    }
    Ok(bag)
}

/// Our index of each topic by its number in the file.
fn read_topics(bag: &Connection, topics: &mut Topics) -> Result<BTreeMap<i64, usize>, BagProblem> {
    let told = |error: rusqlite::Error| BagProblem::Tables(error.to_string());
    let mut statement = bag.prepare("SELECT id, name, type, serialization_format FROM topics").map_err(told)?;
    let mut rows = statement.query([]).map_err(told)?;
    let mut known = BTreeMap::new();
    while let Some(row) = rows.next().map_err(told)? {
        let id: i64 = row.get(0).map_err(told)?;
        let name: String = row.get(1).map_err(told)?;
        let kind: String = row.get(2).map_err(told)?;
        let format: String = row.get(3).map_err(told)?;
        let serialization = (format == "cdr").then_some(Serialization::Cdr);
        known.insert(id, topics.index(&name, &kind, serialization)?);
    }
    Ok(known)
}

/// Every message without its bytes.
fn count(
    bag: &Connection,
    known: &BTreeMap<i64, usize>,
    damage: &mut Damage,
    each: &mut dyn FnMut(Record<'_>) -> Flow,
) -> rusqlite::Result<Flow> {
    let mut statement = bag.prepare("SELECT topic_id, timestamp FROM messages")?;
    let mut rows = statement.query([])?;
    while let Some(row) = rows.next()? {
        let (id, received_ns): (i64, i64) = (row.get(0)?, row.get(1)?);
        match known.get(&id) {
            Some(topic) => drop(each(Record { topic: *topic, received_ns, bytes: &[] })),
            None => damage.lost += 1,
        }
    }
    Ok(Flow::On)
}

fn messages(
    bag: &Connection,
    known: &BTreeMap<i64, usize>,
    damage: &mut Damage,
    each: &mut dyn FnMut(Record<'_>) -> Flow,
) -> rusqlite::Result<Flow> {
    let mut statement = bag.prepare("SELECT topic_id, timestamp, data FROM messages ORDER BY timestamp, id")?;
    let mut rows = statement.query([])?;
    let mut unpacked = Vec::new();
    while let Some(row) = rows.next()? {
        let (id, received_ns): (i64, i64) = (row.get(0)?, row.get(1)?);
        let (Some(topic), ValueRef::Blob(mut bytes)) = (known.get(&id), row.get_ref(2)?) else {
            damage.lost += 1;
            continue;
        };
        if bytes.starts_with(&ZSTD_MAGIC) {
            unpacked.clear();
            let limit = MESSAGE_BYTES_MAX as u64 + 1;
            let read = zstd::Decoder::new(bytes).and_then(|packed| packed.take(limit).read_to_end(&mut unpacked));
            if read.is_err() {
                damage.lost += 1;
                continue;
            }
            bytes = &unpacked;
        }
        if bytes.len() > MESSAGE_BYTES_MAX {
            damage.long += 1;
            continue;
        }
        if each(Record { topic: *topic, received_ns, bytes }) == Flow::Stop {
            return Ok(Flow::Stop);
        }
    }
    Ok(Flow::On)
}

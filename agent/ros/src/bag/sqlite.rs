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
    result.map_err(|error| BagProblem::Sqlite(error.to_string()).of(path)).map(|end| match end {
        End::Flow(flow) => flow,
        // A file that was cut is read as far as its pages go.
        End::Corrupt => {
            damage.stop(path, "the database is damaged or was cut off");
            Flow::On
        }
        End::Unordered => {
            damage.stop(
                path,
                "the index of stamps is damaged; messages are read in the order in which they were written",
            );
            Flow::On
        }
    })
}

/// How a reading ended.
enum End {
    Flow(Flow),
    /// At a page that cannot be read.
    Corrupt,
    /// The index by which messages are put in order cannot be read; all messages could be.
    Unordered,
}

fn is_corrupt(error: &rusqlite::Error) -> bool {
    error.sqlite_error_code() == Some(rusqlite::ErrorCode::DatabaseCorrupt)
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
    // SQLite refuses a file that is shorter than it states as a whole, unless the schema might be mended; ours is not.
    bag.execute_batch("PRAGMA trusted_schema = OFF; PRAGMA query_only = ON; PRAGMA writable_schema = ON;")
        .map_err(told)?;
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
) -> rusqlite::Result<End> {
    let mut statement = bag.prepare("SELECT topic_id, timestamp FROM messages")?;
    let mut rows = statement.query([])?;
    loop {
        let row = match rows.next() {
            Ok(Some(row)) => row,
            Ok(None) => return Ok(End::Flow(Flow::On)),
            Err(error) if is_corrupt(&error) => return Ok(End::Corrupt),
            Err(error) => return Err(error),
        };
        let (id, received_ns): (i64, i64) = (row.get(0)?, row.get(1)?);
        match known.get(&id) {
            Some(topic) => drop(each(Record { topic: *topic, received_ns, bytes: &[] })),
            None => damage.lost += 1,
        }
    }
}

/// Every message by its stamp; if the index of stamps is damaged, those that are left in the order of their numbers.
fn messages(
    bag: &Connection,
    known: &BTreeMap<i64, usize>,
    damage: &mut Damage,
    each: &mut dyn FnMut(Record<'_>) -> Flow,
) -> rusqlite::Result<End> {
    let mut given = Given::default();
    match ordered(bag, "timestamp, id", known, damage, &mut given, each)? {
        End::Corrupt => match ordered(bag, "id", known, damage, &mut given, each)? {
            End::Flow(Flow::On) => Ok(End::Unordered),
            other => Ok(other),
        },
        other => Ok(other),
    }
}

/// Every message that is not yet given.
fn ordered(
    bag: &Connection,
    by: &str,
    known: &BTreeMap<i64, usize>,
    damage: &mut Damage,
    given: &mut Given,
    each: &mut dyn FnMut(Record<'_>) -> Flow,
) -> rusqlite::Result<End> {
    // SQLite refuses a row that is longer than it may take, and with it all that follow: its length is read alone.
    let select = format!(
        "SELECT id, topic_id, timestamp, length(data), CASE WHEN length(data) <= {MESSAGE_BYTES_MAX} THEN data END \
         FROM messages ORDER BY {by}"
    );
    let mut statement = match bag.prepare(&select) {
        Err(error) if is_corrupt(&error) => return Ok(End::Corrupt),
        statement => statement?,
    };
    let mut rows = statement.query([])?;
    let mut unpacked = Vec::new();
    loop {
        let row = match rows.next() {
            Ok(Some(row)) => row,
            Ok(None) => return Ok(End::Flow(Flow::On)),
            Err(error) if is_corrupt(&error) => return Ok(End::Corrupt),
            Err(error) => return Err(error),
        };
        let (number, id, received_ns): (i64, i64, i64) = (row.get(0)?, row.get(1)?, row.get(2)?);
        if !given.insert(number) {
            continue;
        }
        if row.get::<_, Option<i64>>(3)?.is_some_and(|length| length > MESSAGE_BYTES_MAX as i64) {
            damage.long += 1;
            continue;
        }
        let (Some(topic), ValueRef::Blob(mut bytes)) = (known.get(&id), row.get_ref(4)?) else {
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
            return Ok(End::Flow(Flow::Stop));
        }
    }
}

/// Numbers of messages that were given, as ranges: recorders count up, so that there are few.
#[derive(Default)]
struct Given {
    /// First by last.
    ranges: BTreeMap<i64, i64>,
}

impl Given {
    /// Takes a number; false if it is there.
    fn insert(&mut self, number: i64) -> bool {
        let (mut first, mut last) = (number, number);
        if let Some((&to, &from)) = self.ranges.range(number..).next() {
            if from <= number {
                return false;
            }
            if from.checked_sub(1) == Some(number) {
                self.ranges.remove(&to);
                last = to;
            }
        }
        if let Some(before) = number.checked_sub(1)
            && let Some(from) = self.ranges.remove(&before)
        {
            first = from;
        }
        self.ranges.insert(last, first);
        true
    }
}

#[cfg(test)]
mod tests;

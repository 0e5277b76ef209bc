//! The tables: how keys and sealed values look, and how records are put into them.
//!
//! A seal is the first eight bytes of BLAKE3 over table, key and value. Flipped bits in either are found when the
//! record is read, whatever the database thinks of the page that holds it.

use crate::CommitError;
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{FrameId, Hash, RobotId, SubmapId};
use redb::{Database, Durability, Key, ReadableTable, TableDefinition, WriteTransaction};
use std::any::Any;

pub(crate) const ENTRIES: TableDefinition<'_, [u8; 16], &[u8]> = TableDefinition::new("entries");
pub(crate) const BLOBS: TableDefinition<'_, [u8; 32], &[u8]> = TableDefinition::new("blobs");
pub(crate) const PRIVATE: TableDefinition<'_, [u8; 16], &[u8]> = TableDefinition::new("private");
pub(crate) const FORKS: TableDefinition<'_, [u8; 16], &[u8]> = TableDefinition::new("forks");
pub(crate) const REFUSED: TableDefinition<'_, [u8; 32], &[u8]> = TableDefinition::new("refused");
pub(crate) const META: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("meta");

/// Keys of `meta`. The schema is not sealed: its place and form are the same in all versions.
pub(crate) const META_SCHEMA: &str = "schema";
pub(crate) const META_OWNER: &str = "owner";
pub(crate) const META_FRESH_EPOCH: &str = "fresh_epoch";
pub(crate) const META_CLOSED_EPOCH: &str = "closed_epoch";
pub(crate) const META_SESSION: &str = "session";
pub(crate) const META_KEYS: [&str; 5] = [META_SCHEMA, META_OWNER, META_FRESH_EPOCH, META_CLOSED_EPOCH, META_SESSION];

const SEAL_LEN: usize = 8;

/// A value with its seal in front.
pub(crate) fn seal(table: &str, key: &[u8], value: &[u8]) -> Vec<u8> {
    let mut sealed = seal_of(table, key, value).to_vec();
    sealed.extend_from_slice(value);
    sealed
}

/// The value, if its seal is whole.
pub(crate) fn unseal<'a>(table: &str, key: &[u8], sealed: &'a [u8]) -> Option<&'a [u8]> {
    let (seal, value) = sealed.split_first_chunk::<SEAL_LEN>()?;
    (*seal == seal_of(table, key, value)).then_some(value)
}

/// [`unseal`] without a second copy of the value.
pub(crate) fn unsealed(table: &str, key: &[u8], mut sealed: Vec<u8>) -> Option<Vec<u8>> {
    unseal(table, key, &sealed)?;
    sealed.drain(..SEAL_LEN);
    Some(sealed)
}

fn seal_of(table: &str, key: &[u8], value: &[u8]) -> [u8; SEAL_LEN] {
    // The lengths of table and key are fixed per table (names of `meta` are not, but none begins another).
    let hash = Hash::of(&[table.as_bytes(), key, value].concat());
    core::array::from_fn(|i| hash.0[i])
}

/// Big-endian, so that the database's order is that of the ids.
pub(crate) fn join_key(frame: FrameId, number: u32) -> [u8; 16] {
    let mut key = [0; 16];
    key[..8].copy_from_slice(&frame.robot.0);
    key[8..12].copy_from_slice(&frame.epoch.to_be_bytes());
    key[12..].copy_from_slice(&number.to_be_bytes());
    key
}

/// The ids of a key.
pub(crate) fn split_key(key: [u8; 16]) -> (FrameId, u32) {
    let number = u128::from_be_bytes(key);
    let robot = RobotId(((number >> 64) as u64).to_be_bytes());
    (FrameId { robot, epoch: (number >> 32) as u32 }, number as u32)
}

/// Both submaps of a pair.
pub(crate) fn join_pair(i: SubmapId, j: SubmapId) -> [u8; 32] {
    let mut key = [0; 32];
    key[..16].copy_from_slice(&join_key(i.frame, i.index));
    key[16..].copy_from_slice(&join_key(j.frame, j.index));
    key
}

/// The submaps of a pair's key.
pub(crate) fn split_pair(key: [u8; 32]) -> [SubmapId; 2] {
    [0, 16].map(|at| {
        let (frame, index) = split_key(core::array::from_fn(|k| key[at + k]));
        SubmapId { frame, index }
    })
}

/// The epoch, its run, and those that are over.
fn join_session(epoch: u32, session: u64, over: &[u64]) -> Vec<u8> {
    let sessions = [session].into_iter().chain(over.iter().copied()).flat_map(u64::to_le_bytes);
    epoch.to_le_bytes().into_iter().chain(sessions).collect()
}

/// What [`join_session`] joined.
pub(crate) fn split_session(bytes: &[u8]) -> Option<Record> {
    let (epoch, rest) = bytes.split_first_chunk()?;
    let (session, rest) = rest.split_first_chunk()?;
    let (over, []) = rest.as_chunks() else { return None };
    let over = over.iter().map(|bytes| u64::from_le_bytes(*bytes)).collect();
    Some(Record::Session { epoch: u32::from_le_bytes(*epoch), session: u64::from_le_bytes(*session), over })
}

/// The length of the first, and both.
fn join_proof([a, b]: &[Vec<u8>; 2]) -> Vec<u8> {
    [&u32::try_from(a.len()).unwrap_or(u32::MAX).to_le_bytes()[..], a, b].concat()
}

/// The two entries of a proof.
pub(crate) fn split_proof(bytes: &[u8]) -> Option<[Vec<u8>; 2]> {
    let (len, rest) = bytes.split_first_chunk()?;
    let (a, b) = rest.split_at_checked(u32::from_le_bytes(*len) as usize)?;
    Some([a.to_vec(), b.to_vec()])
}

/// One synced, atomic transaction. On an error nothing of it is stored.
pub(crate) fn write(
    db: &Database,
    work: impl FnOnce(&WriteTransaction) -> Result<(), CommitError>,
) -> Result<(), CommitError> {
    let mut transaction = db.begin_write()?;
    transaction.set_durability(Durability::Immediate).map_err(redb::Error::from)?;
    transaction.set_quick_repair(true);
    work(&transaction)?; // dropping the transaction aborts it
    Ok(transaction.commit()?)
}

/// Makes all tables, so that reading never meets a missing one.
pub(crate) fn make(transaction: &WriteTransaction) -> Result<(), CommitError> {
    transaction.open_table(ENTRIES)?;
    transaction.open_table(BLOBS)?;
    transaction.open_table(PRIVATE)?;
    transaction.open_table(FORKS)?;
    transaction.open_table(REFUSED)?;
    transaction.open_table(META)?;
    Ok(())
}

pub(crate) fn put_all<'a>(
    transaction: &WriteTransaction,
    records: impl Iterator<Item = &'a Record>,
) -> Result<(), CommitError> {
    records.into_iter().try_for_each(|record| put(transaction, record))
}

fn put(transaction: &WriteTransaction, record: &Record) -> Result<(), CommitError> {
    match record {
        Record::Entry { id, bytes } => {
            let key = join_key(id.frame, id.seq);
            match insert(transaction, ENTRIES, "entries", key, &key, bytes)? {
                Some(before) if before != *bytes => Err(CommitError::Conflict(*id)),
                _ => Ok(()),
            }
        }
        Record::Blob { hash, bytes } => {
            insert(transaction, BLOBS, "blobs", hash.0, &hash.0, bytes)?;
            Ok(())
        }
        Record::Private { submap, bytes } => {
            let key = join_key(submap.frame, submap.index);
            insert(transaction, PRIVATE, "private", key, &key, bytes)?;
            Ok(())
        }
        Record::Fork { frame, proof } => {
            let key = join_key(*frame, 0);
            insert(transaction, FORKS, "forks", key, &key, &join_proof(proof))?;
            Ok(())
        }
        Record::EpochClosed { epoch } => {
            let before = get_meta(transaction, META_CLOSED_EPOCH)?.as_deref().and_then(number);
            put_meta(transaction, META_CLOSED_EPOCH, &before.unwrap_or(0).max(*epoch).to_le_bytes())
        }
        Record::Session { epoch, session, over } => {
            let before = get_meta(transaction, META_SESSION)?.as_deref().and_then(split_session);
            let is_later = |before| matches!(before, Record::Session { epoch: of, .. } if of > *epoch);
            match before.is_some_and(is_later) {
                true => Ok(()),
                false => put_meta(transaction, META_SESSION, &join_session(*epoch, *session, over)),
            }
        }
        Record::Refused { i, j, evidence } => {
            let key = join_pair(*i, *j);
            match evidence {
                Some(evidence) => drop(insert(transaction, REFUSED, "refused", key, &key, &evidence.to_le_bytes())?),
                None => drop(transaction.open_table(REFUSED)?.remove(key)?),
            }
            Ok(())
        }
        Record::Replaced { below, submaps, blobs } => {
            let entries = join_key(below.frame, 0)..join_key(below.frame, below.seq);
            transaction.open_table(ENTRIES)?.retain_in(entries, |_, _| false)?;
            remove_own(transaction, submaps, blobs)
        }
        Record::Retired { frame, submaps, blobs } => {
            let entries = join_key(*frame, 0)..=join_key(*frame, u32::MAX);
            transaction.open_table(ENTRIES)?.retain_in(entries, |_, _| false)?;
            transaction.open_table(FORKS)?.remove(join_key(*frame, 0))?;
            remove_own(transaction, submaps, blobs)
        }
    }
}

/// Removes what is private to own submaps, and blobs.
fn remove_own(transaction: &WriteTransaction, submaps: &[SubmapId], blobs: &[Hash]) -> Result<(), CommitError> {
    let mut private = transaction.open_table(PRIVATE)?;
    for submap in submaps {
        private.remove(join_key(submap.frame, submap.index))?;
    }
    let mut stored = transaction.open_table(BLOBS)?;
    for blob in blobs {
        stored.remove(blob.0)?;
    }
    Ok(())
}

/// Inserts a sealed value; gives back what was there, if that was sound.
fn insert<K: Key + 'static>(
    transaction: &WriteTransaction,
    table: TableDefinition<'_, K, &'static [u8]>,
    name: &str,
    key: impl for<'a> std::borrow::Borrow<K::SelfType<'a>>,
    key_bytes: &[u8],
    value: &[u8],
) -> Result<Option<Vec<u8>>, CommitError> {
    let mut table = transaction.open_table(table)?;
    let before = table.insert(key, seal(name, key_bytes, value).as_slice())?;
    Ok(before.and_then(|before| unseal(name, key_bytes, before.value()).map(<[u8]>::to_vec)))
}

/// What is there under this key, if that is sound.
fn get_meta(transaction: &WriteTransaction, key: &str) -> Result<Option<Vec<u8>>, CommitError> {
    let meta = transaction.open_table(META)?;
    let sealed = meta.get(key)?;
    Ok(sealed.and_then(|sealed| unseal("meta", key.as_bytes(), sealed.value()).map(<[u8]>::to_vec)))
}

pub(crate) fn put_meta(transaction: &WriteTransaction, key: &str, value: &[u8]) -> Result<(), CommitError> {
    let mut meta = transaction.open_table(META)?;
    let stored = if key == META_SCHEMA { value.to_vec() } else { seal("meta", key.as_bytes(), value) };
    meta.insert(key, stored.as_slice())?;
    Ok(())
}

pub(crate) fn number(bytes: &[u8]) -> Option<u32> {
    Some(u32::from_le_bytes(bytes.try_into().ok()?))
}

/// The message of a panic.
pub(crate) fn what_panicked(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref::<&str>().copied());
    format!("the database tripped over damage: {}", text.unwrap_or("no message"))
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
    fn a_seal_holds_table_key_and_value() {
        let sealed = seal("entries", b"key", b"value");
        assert_eq!(unseal("entries", b"key", &sealed), Some(&b"value"[..]));
        assert_eq!(unseal("blobs", b"key", &sealed), None);
        assert_eq!(unseal("entries", b"kez", &sealed), None);
        for at in 0..sealed.len() {
            let mut flipped = sealed.clone();
            flipped[at] ^= 16;
            assert_eq!(unseal("entries", b"key", &flipped), None, "{at}");
        }
        assert_eq!(unseal("entries", b"key", &sealed[..7]), None);
    }
}

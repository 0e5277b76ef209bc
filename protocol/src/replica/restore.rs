//! Loading a store. The hash chain is checked entry by entry, the signature only of each log's last entry: it covers
//! its predecessor's hash, hence the whole log. 36,000 entries cost one hash each and one signature a log.

use super::log::{Held, Link, Log, retires};
use super::set::{IngestError, Ingested, Replica, Slot};
use crate::ids::{EntryId, FrameId, Hash};
use crate::wire::Entry;
use std::collections::BTreeMap;
use thiserror::Error;

/// A record, and what its place in the log depends on.
struct Stored {
    seq: u32,
    previous: Hash,
    floor: u32,
    retires: Option<u32>,
    bytes: Vec<u8>,
}

impl Stored {
    fn new(entry: &Entry, bytes: Vec<u8>) -> Self {
        let (previous, floor) = (entry.previous(), entry.floor());
        Self { seq: entry.id().seq, previous, floor, retires: retires(entry), bytes }
    }
}

/// A stored entry that could not be loaded.
#[derive(Clone, Debug, PartialEq)]
pub struct Damage {
    /// Which, as far as it can be read.
    pub id: Option<EntryId>,
    /// What is wrong: `None` if only an entry before it is missing or damaged.
    pub why: Option<IngestError>,
}

/// Parts of the store are damaged. All that is sound is loaded; the rest can be fetched from neighbours, except in a
/// log of this robot's own, which must not be continued: begin a new epoch.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{} stored entries cannot be used, the first {}", .damaged.len(), first(.damaged))]
pub struct RestoreError {
    /// Each of them, in canonical order.
    pub damaged: Vec<Damage>,
}

fn first(damaged: &[Damage]) -> String {
    let Some(Damage { id, why }) = damaged.first() else { return String::new() };
    let id = id.map_or_else(|| "of unreadable place".into(), |id| id.to_string());
    let why = why.as_ref().map_or_else(|| "an entry before it is missing".into(), ToString::to_string);
    format!("{id}: {why}")
}

impl RestoreError {
    /// Whether a log has damage.
    pub fn concerns(&self, frame: FrameId) -> bool {
        self.damaged.iter().any(|damage| damage.id.is_none_or(|id| id.frame == frame))
    }
}

impl Replica {
    /// Loads stored entries, in any order; what loads is durable. A log with two histories in the store is quarantined.
    ///
    /// # Errors
    /// [`RestoreError`] lists what could not be loaded; everything else was.
    pub fn restore(&mut self, records: impl IntoIterator<Item = Vec<u8>>) -> Result<(), RestoreError> {
        let mut damaged = Vec::new();
        let mut logs: BTreeMap<FrameId, Vec<Stored>> = BTreeMap::new();
        for bytes in records {
            match self.admit(&bytes) {
                Ok(entry) => logs.entry(entry.id().frame).or_default().push(Stored::new(&entry, bytes)),
                Err(why) => {
                    let id = Entry::decode(&bytes).ok().map(|entry| entry.id());
                    damaged.push(Damage { id, why: Some(why) });
                }
            }
        }
        for (frame, mut records) in logs {
            records.sort_by(|x, y| (x.seq, &x.bytes).cmp(&(y.seq, &y.bytes)));
            records.dedup_by(|x, y| x.bytes == y.bytes);
            // What a floor replaces goes with the commit that brings the floor; of an old store more may be left.
            if let Some(floor) = records.iter().filter(|record| record.floor == record.seq).map(|r| r.seq).max() {
                records.retain(|record| record.seq >= floor);
            }
            self.restore_log(frame, records, &mut damaged);
        }
        damaged.sort_by_key(|damage| damage.id);
        if damaged.is_empty() { Ok(()) } else { Err(RestoreError { damaged }) }
    }

    fn restore_log(&mut self, frame: FrameId, records: Vec<Stored>, damaged: &mut Vec<Damage>) {
        // What does not chain goes the long way: it may prove a fork, wait for a refetched entry, or be damaged.
        for Stored { seq, bytes, .. } in self.restore_chain(frame, records) {
            let id = Some(EntryId { frame, seq });
            match self.ingest(&bytes) {
                Ok(Ingested::New(ids)) => ids.into_iter().for_each(|id| self.mark_durable(id)),
                Ok(Ingested::Known) | Err(IngestError::Fork(_) | IngestError::Quarantined(_)) => {}
                Ok(Ingested::Early(_)) | Err(IngestError::TooEarly(_)) => damaged.push(Damage { id, why: None }),
                Err(why) => damaged.push(Damage { id, why: Some(why) }),
            }
        }
    }

    /// Loads the longest sound prefix of the log; gives back the other records.
    fn restore_chain(&mut self, frame: FrameId, records: Vec<Stored>) -> Vec<Stored> {
        if self.slots.contains_key(&frame) || self.check_epoch(frame).is_err() {
            return records;
        }
        let first = records.first().filter(|record| record.floor == record.seq).map_or(0, |record| record.seq);
        self.slots.insert(frame, Slot::Log(Log::begin(first)));
        let mut records = records.into_iter().peekable();
        let fits = |replica: &mut Self, record: &Stored| {
            let log = replica.log_mut(frame);
            let next = record.seq == log.next_seq() && matches!(log.link(record.previous, record.floor), Link::Fits);
            next && replica.check_place(EntryId { frame, seq: record.seq }, record.floor).is_ok()
        };
        while let Some(record) = records.next_if(|record| fits(self, record)) {
            self.log_mut(frame).push(Held::new(record.bytes.into(), record.floor, record.retires));
        }
        let mut left = Vec::new();
        while let Some(held) = self.log_mut(frame).pop() {
            let entry = Entry::decode(&held.bytes);
            if entry.as_ref().is_ok_and(|entry| self.verify(entry).is_ok()) {
                self.log_mut(frame).push(held);
                break;
            }
            // What was admitted can be decoded again.
            left.extend(entry.map(|entry| Stored::new(&entry, held.bytes.into())));
        }
        left.reverse();
        let log = self.log_mut(frame);
        log.mark_all_durable();
        let nothing = log.is_empty();
        self.digest.take();
        if nothing {
            self.slots.remove(&frame);
        }
        self.retire(frame);
        left.into_iter().chain(records).collect()
    }
}

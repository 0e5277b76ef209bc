//! Loading a store. The hash chain is checked entry by entry, the signature only of each log's last entry: it covers its
//! predecessor's hash, hence the whole log. 36,000 entries cost one hash each and one signature a log.

use super::log::{Held, Link};
use super::set::{IngestError, Ingested, Replica};
use crate::ids::{EntryId, FrameId};
use crate::wire::Entry;
use std::collections::BTreeMap;
use thiserror::Error;

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
#[error("{} stored entries are damaged or out of reach, first {:?}", .damaged.len(), .damaged.first())]
pub struct RestoreError {
    /// Each of them, in canonical order.
    pub damaged: Vec<Damage>,
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
        let mut logs: BTreeMap<FrameId, Vec<(Entry, Vec<u8>)>> = BTreeMap::new();
        for bytes in records {
            match self.admit(&bytes) {
                Ok(entry) => logs.entry(entry.id().frame).or_default().push((entry, bytes)),
                Err(why) => {
                    let id = Entry::decode(&bytes).ok().map(|entry| entry.id());
                    damaged.push(Damage { id, why: Some(why) });
                }
            }
        }
        for (frame, mut records) in logs {
            records.sort_by(|(a, x), (b, y)| (a.id().seq, x).cmp(&(b.id().seq, y)));
            records.dedup_by(|(_, x), (_, y)| x == y);
            self.restore_log(frame, records, &mut damaged);
        }
        damaged.sort_by_key(|damage| damage.id);
        if damaged.is_empty() { Ok(()) } else { Err(RestoreError { damaged }) }
    }

    fn restore_log(&mut self, frame: FrameId, records: Vec<(Entry, Vec<u8>)>, damaged: &mut Vec<Damage>) {
        let chained = self.restore_chain(frame, &records);
        // What does not chain goes the long way: it may prove a fork, wait for a refetched entry, or be damaged.
        for (entry, bytes) in &records[chained..] {
            let id = Some(entry.id());
            match self.ingest(bytes) {
                Ok(Ingested::New(ids)) => ids.into_iter().for_each(|id| self.mark_durable(id)),
                Ok(Ingested::Known) | Err(IngestError::Fork(_) | IngestError::Quarantined(_)) => {}
                Ok(Ingested::Early(_)) | Err(IngestError::TooEarly(_)) => damaged.push(Damage { id, why: None }),
                Err(why) => damaged.push(Damage { id, why: Some(why) }),
            }
        }
    }

    /// Loads the longest sound prefix of the log; returns how many records it took.
    fn restore_chain(&mut self, frame: FrameId, records: &[(Entry, Vec<u8>)]) -> usize {
        if self.slots.contains_key(&frame) || self.check_epoch(frame).is_err() {
            return 0;
        }
        for (entry, bytes) in records {
            let log = self.log_mut(frame);
            let next = entry.id().seq == log.next_seq() && matches!(log.link(entry), Link::Fits);
            if !next || self.check_seq(entry.id()).is_err() {
                break;
            }
            self.log_mut(frame).entries.push(Held::new(entry, bytes));
        }
        let mut len = self.log_mut(frame).entries.len();
        while len > 0 && self.verify(&records[len - 1].0).is_err() {
            len -= 1;
        }
        let log = self.log_mut(frame);
        log.entries.truncate(len);
        (0..len as u32).for_each(|seq| log.mark_durable(seq));
        self.digest.take();
        if len == 0 {
            self.slots.remove(&frame);
        }
        len
    }
}

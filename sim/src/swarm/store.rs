//! A robot's disk: records become durable a while after they were handed over, batch by batch; a crash loses what was
//! not yet durable.

use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, Hash, SubmapId};
use std::collections::{BTreeMap, VecDeque};

/// One robot's disk.
#[derive(Clone, Debug, Default)]
pub struct Store {
    durable: BTreeMap<Key, Record>,
    waiting: VecDeque<(u64, Vec<Record>)>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum Key {
    Entry(EntryId),
    Blob(Hash),
    Private(SubmapId),
    EpochClosed(u32),
}

impl Store {
    /// Takes a batch that is not durable yet.
    pub fn accept(&mut self, batch: u64, records: Vec<Record>) {
        self.waiting.push_back((batch, records));
    }

    /// Makes everything up to and including `batch` durable.
    pub fn commit(&mut self, batch: u64) {
        while self.waiting.front().is_some_and(|(number, _)| *number <= batch) {
            for record in self.waiting.pop_front().map(|(_, records)| records).unwrap_or_default() {
                self.durable.insert(key(&record), record);
            }
        }
    }

    /// Power is cut: what was waiting is lost. Returns the number of records.
    pub fn crash(&mut self) -> usize {
        self.waiting.drain(..).map(|(_, records)| records.len()).sum()
    }

    /// The disk is replaced by an empty one.
    pub fn wipe(&mut self) {
        *self = Self::default();
    }

    /// All that is durable.
    pub fn records(&self) -> Vec<Record> {
        self.durable.values().cloned().collect()
    }
}

fn key(record: &Record) -> Key {
    match record {
        Record::Entry { id, .. } => Key::Entry(*id),
        Record::Blob { hash, .. } => Key::Blob(*hash),
        Record::Private { submap, .. } => Key::Private(*submap),
        Record::EpochClosed { epoch } => Key::EpochClosed(*epoch),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blob(byte: u8) -> Record {
        Record::Blob { hash: Hash([byte; 32]), bytes: vec![byte] }
    }

    #[test]
    fn only_what_was_committed_survives() {
        let mut store = Store::default();
        store.accept(1, vec![blob(1)]);
        store.accept(2, vec![blob(2), blob(3)]);
        store.commit(1);
        assert_eq!(store.crash(), 2);
        assert_eq!(store.records(), [blob(1)]);
        store.commit(2);
        assert_eq!(store.records(), [blob(1)]);
        store.wipe();
        assert!(store.records().is_empty());
    }
}

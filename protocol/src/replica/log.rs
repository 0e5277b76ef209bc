//! One frame's log: its entries from 0 on, without holes, and which of them are durable.

use crate::ids::Hash;
use crate::wire::Entry;
use std::collections::BTreeMap;

/// An entry held.
pub(super) struct Held {
    /// Canonical bytes.
    pub bytes: Box<[u8]>,
    pub hash: Hash,
    pub floor: u32,
    pub durable: bool,
}

impl Held {
    /// An entry from its canonical bytes and the floor it states.
    pub fn new(bytes: Box<[u8]>, floor: u32) -> Self {
        Self { hash: Hash::of(&bytes), bytes, floor, durable: false }
    }
}

/// How an entry relates to the end of a log.
pub(super) enum Link {
    /// It follows.
    Fits,
    /// It names another predecessor: a fork.
    Contradicts,
    /// Its floor is below its predecessor's.
    FloorFell,
}

/// One frame's log.
#[derive(Default)]
pub(super) struct Log {
    /// Entries `0..`.
    pub entries: Vec<Held>,
    /// Entries `0..durable` are durable.
    pub durable: u32,
    /// Verified entries that wait for their predecessor. Bounded by the set.
    pub early: BTreeMap<u32, Entry>,
    /// Some entry came from another robot in this run.
    pub received: bool,
}

impl Log {
    /// The next free place.
    pub fn next_seq(&self) -> u32 {
        // Lengths are bounded by `entries_per_frame_max`, a u32.
        self.entries.len() as u32
    }

    pub fn held(&self, seq: u32) -> Option<&Held> {
        self.entries.get(seq as usize)
    }

    /// Hash that the next entry must name; zero for the first.
    pub fn head(&self) -> Hash {
        self.entries.last().map(|held| held.hash).unwrap_or_default()
    }

    /// The writer's floor as of the last entry.
    pub fn floor(&self) -> u32 {
        self.entries.last().map_or(0, |held| held.floor)
    }

    /// Whether an entry, whose place is the next free one, may be pushed that names this predecessor and this floor.
    pub fn link(&self, previous: Hash, floor: u32) -> Link {
        if previous != self.head() {
            Link::Contradicts
        } else if floor < self.floor() {
            Link::FloorFell
        } else {
            Link::Fits
        }
    }

    pub fn mark_durable(&mut self, seq: u32) {
        if let Some(held) = self.entries.get_mut(seq as usize) {
            held.durable = true;
        }
        while self.held(self.durable).is_some_and(|held| held.durable) {
            self.durable += 1;
        }
    }

    /// The entries that may be shown to others.
    pub fn durable_entries(&self) -> &[Held] {
        &self.entries[..self.durable as usize]
    }
}

//! One frame's log: its entries from the writer's floor on, without holes, and which of them are durable.
//!
//! A floor is the place of an entry that states that very place as its floor: it replaces everything below it. Once it
//! is durable what it replaces goes. A log whose next entry is not to be had any more (everybody else dropped it) goes
//! on at the floor; until that is durable, what is held is shown as before.

use crate::ids::Hash;
use crate::wire::fact::RetiredFact;
use crate::wire::payload::KIND_RETIRED;
use crate::wire::{Entry, Fact};
use std::collections::BTreeMap;

/// An entry held.
pub(super) struct Held {
    /// Canonical bytes.
    pub bytes: Box<[u8]>,
    pub hash: Hash,
    pub floor: u32,
    /// The first of its writer's epochs that stays, if it says so.
    pub retires: Option<u32>,
    pub durable: bool,
}

/// What an entry takes in memory beyond its bytes, roughly.
pub(super) const HELD_BYTES: usize = 128;

impl Held {
    /// An entry from its canonical bytes, and what it states of its log and of its writer's epochs.
    pub fn new(bytes: Box<[u8]>, floor: u32, retires: Option<u32>) -> Self {
        Self { hash: Hash::of(&bytes), bytes, floor, retires, durable: false }
    }

    /// An entry with its canonical bytes.
    pub fn of(entry: &Entry, bytes: Box<[u8]>) -> Self {
        Self::new(bytes, entry.floor(), retires(entry))
    }

    /// What it is counted for.
    fn cost(&self) -> usize {
        self.bytes.len() + HELD_BYTES
    }
}

/// The first of its writer's epochs that stays, if an entry says so: of epochs that are to come none can go.
pub(super) fn retires(entry: &Entry) -> Option<u32> {
    match (entry.kind() == KIND_RETIRED).then(|| entry.fact()) {
        Some(Ok(Fact::Retired(RetiredFact { below }))) => Some(below.get().min(entry.id().frame.epoch)),
        _ => None,
    }
}

/// How an entry relates to the end of a log.
pub(super) enum Link {
    /// It follows.
    Fits,
    /// It names another predecessor: a fork.
    Contradicts,
    /// Its floor is neither its predecessor's nor its own place.
    FloorMoved,
}

/// One frame's log.
#[derive(Default)]
pub(super) struct Log {
    /// Place of the first entry held.
    first: u32,
    /// Entries `first..`.
    entries: Vec<Held>,
    /// Entries `first..durable` are durable; at least `first`.
    durable: u32,
    /// What `entries` are counted for.
    bytes: usize,
    /// The first of the writer's epochs that stays, by any entry so far, durable or not.
    stays: u32,
    /// What begins at a floor beyond the entries, until it is durable.
    beyond: Option<Box<Log>>,
    /// Verified entries that wait for their predecessor. Bounded by the set.
    pub early: BTreeMap<u32, Entry>,
    /// Some entry came from another robot in this run.
    pub received: bool,
}

impl Log {
    /// The next free place.
    pub fn next_seq(&self) -> u32 {
        // Lengths are bounded by `entries_per_frame_max`, a u32, and no entry has the last place of all.
        let last = self.last();
        last.first + last.entries.len() as u32
    }

    /// Place of the first entry that may be shown to others.
    pub fn first(&self) -> u32 {
        self.first
    }

    /// Place after the last entry that may be shown to others.
    pub fn durable(&self) -> u32 {
        self.durable
    }

    pub fn is_empty(&self) -> bool {
        self.last().entries.is_empty()
    }

    pub fn held(&self, seq: u32) -> Option<&Held> {
        let part = self.beyond.as_deref().filter(|beyond| seq >= beyond.first).unwrap_or(self);
        part.entries.get(seq.checked_sub(part.first)? as usize)
    }

    /// The last entry.
    pub fn head(&self) -> Option<&Held> {
        self.last().entries.last()
    }

    /// Place from which on the writer wants its entries kept, as of the last one.
    pub fn floor(&self) -> u32 {
        self.head().map_or(self.last().first, |held| held.floor)
    }

    /// Whether an entry, whose place is the next free one, may be pushed that names this predecessor and this floor.
    pub fn link(&self, previous: Hash, floor: u32) -> Link {
        // Of what came before a first entry above 0 nothing is known.
        let follows = match self.head() {
            Some(head) => head.hash == previous,
            None => self.next_seq() > 0 || previous == Hash::default(),
        };
        if !follows {
            Link::Contradicts
        } else if floor != self.floor() && floor != self.next_seq() {
            Link::FloorMoved
        } else {
            Link::Fits
        }
    }

    /// Adds the next entry, of which [`Self::link`] says that it fits.
    pub fn push(&mut self, held: Held) {
        let last = self.last_mut();
        last.bytes += held.cost();
        last.stays = last.stays.max(held.retires.unwrap_or_default());
        last.entries.push(held);
    }

    /// Takes the last entry back.
    pub fn pop(&mut self) -> Option<Held> {
        let last = self.last_mut();
        let held = last.entries.pop();
        last.bytes -= held.as_ref().map_or(0, Held::cost);
        held
    }

    /// What its entries are counted for; those below the last one's floor are about to go.
    pub fn bytes(&self) -> usize {
        let last = self.last();
        match self.floor().checked_sub(last.first) {
            Some(below @ 1..) => last.entries.iter().skip(below as usize).map(Held::cost).sum(),
            _ => last.bytes,
        }
    }

    /// The first of the writer's epochs that will stay, once all is durable; 0 if all do.
    pub fn stays(&self) -> u32 {
        self.stays.max(self.last().stays)
    }

    /// The first of the writer's epochs that stays, as far as durable entries say so.
    pub fn retires(&self) -> Option<u32> {
        self.durable_entries().iter().filter_map(|held| held.retires).max()
    }

    /// Begins at `seq`, with nothing.
    pub fn begin(seq: u32) -> Self {
        Self { first: seq, durable: seq, ..Self::default() }
    }

    /// Goes on at the floor `seq`, beyond the next free place, with this entry.
    pub fn jump(&mut self, seq: u32, held: Held) {
        self.beyond = Some(Box::new(Self {
            bytes: held.cost(),
            stays: held.retires.unwrap_or_default(),
            entries: vec![held],
            ..Self::begin(seq)
        }));
        self.early.retain(|place, _| *place > seq);
    }

    pub fn mark_durable(&mut self, seq: u32) {
        self.mark(seq);
        if let Some(beyond) = &mut self.beyond {
            beyond.mark(seq);
        }
        if let Some(beyond) = self.beyond.take_if(|beyond| beyond.durable > beyond.first) {
            let Self { first, entries, durable, bytes, stays, .. } = *beyond;
            (self.first, self.entries, self.durable, self.bytes) = (first, entries, durable, bytes);
            self.stays = self.stays.max(stays);
        }
        self.drop_replaced();
    }

    /// All that is held is durable.
    pub fn mark_all_durable(&mut self) {
        self.entries.iter_mut().for_each(|held| held.durable = true);
        self.entries.shrink_to_fit();
        self.durable = self.next_seq();
        self.drop_replaced();
    }

    /// The entries that may be shown to others, from [`Self::first`] on.
    pub fn durable_entries(&self) -> &[Held] {
        &self.entries[..(self.durable - self.first) as usize]
    }

    fn mark(&mut self, seq: u32) {
        let at = seq.checked_sub(self.first).map(|at| at as usize);
        if let Some(held) = at.and_then(|at| self.entries.get_mut(at)) {
            held.durable = true;
        }
        while self.entries.get((self.durable - self.first) as usize).is_some_and(|held| held.durable) {
            self.durable += 1;
        }
    }

    /// What lies below the last durable entry's floor goes.
    fn drop_replaced(&mut self) {
        let floor = self.durable_entries().last().map_or(self.first, |held| held.floor);
        if floor > self.first {
            let gone = self.entries.drain(..(floor - self.first) as usize);
            self.bytes -= gone.map(|held| held.cost()).sum::<usize>();
            self.first = floor;
        }
    }

    fn last(&self) -> &Self {
        self.beyond.as_deref().unwrap_or(self)
    }

    fn last_mut(&mut self) -> &mut Self {
        if self.beyond.is_some() { self.beyond.get_or_insert_default() } else { self }
    }
}

//! All logs together, and the way in for everything that arrives, [`Replica::ingest`] (this robot's own facts come in
//! by [`Replica::append`]). Checks run from cheap to dear (size, form, swarm, roster, duplicates, limits, signature,
//! chain), so that a flood of foreign entries costs no signature check and no memory.

use super::fork::ForkProof;
use super::log::{Held, Link, Log};
use crate::config::GossipConfig;
use crate::ids::{EntryId, FrameId, Hash, Name, RobotId};
use crate::wire::{Beacon, Entry, EntryError, Fact, Life, SwarmTag};
use core::cell::OnceCell;
use core::ops::Range;
use ed25519_dalek::VerifyingKey;
use std::collections::BTreeMap;
use thiserror::Error;

/// Entries per robot that wait for a predecessor, over all its frames.
pub const EARLY_PER_ROBOT_MAX: usize = 64;

/// Robots in a roster at most: have-vectors count them in two bytes.
pub const MEMBERS_MAX: usize = 1 << 16;

/// The facts that one robot holds. See the [module](super) for its rules.
pub struct Replica {
    pub(super) swarm: SwarmTag,
    pub(super) members: BTreeMap<RobotId, Member>,
    pub(super) slots: BTreeMap<FrameId, Slot>,
    /// First bytes of the hash of all members' ids: equal rosters, equal places in have-vectors.
    pub(super) roster_hash: [u8; 4],
    /// The digest, until the set changes.
    pub(super) digest: OnceCell<Hash>,
    /// First epoch of each robot that may be held: older ones it gave up, or they were too many.
    pub(super) retired: BTreeMap<RobotId, u32>,
    /// Logs that were dropped since the last [`Replica::take_gone`].
    pub(super) gone: Vec<FrameId>,
    pub(super) entries_per_frame_max: u32,
    pub(super) epochs_per_robot_max: usize,
    /// What a member's entries may be counted for.
    pub(super) member_bytes_max: usize,
}

pub(super) struct Member {
    name: Name,
    key: VerifyingKey,
}

/// A frame's log, or the proof that it has two histories.
pub(super) enum Slot {
    Log(Log),
    Forked(ForkProof),
}

/// A roster that cannot be used.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum RosterError {
    /// No ed25519 public key, or a weak one.
    #[error("the key of {0} is not a usable ed25519 public key; take the line that `keys generate` printed")]
    Key(Name),
    /// Two names, one key.
    #[error("{0} and {1} have the same key; every robot needs its own")]
    Twice(Name, Name),
    /// More robots than a have-vector can count.
    #[error("the roster has {0} robots; at most {MEMBERS_MAX} can form a swarm")]
    TooMany(usize),
}

/// What became of an entry that was taken in.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Ingested {
    /// New: this entry, then those that had waited for it, in order. All must be made durable.
    New(Vec<EntryId>),
    /// Held already; nothing changed.
    Known,
    /// Its predecessor is missing: it waits, in bounded memory, neither stored nor advertised.
    Early(EntryId),
}

/// Why an entry was refused. No state changed, except by [`IngestError::Fork`].
#[derive(Clone, Debug, Error, PartialEq)]
pub enum IngestError {
    /// Not an entry, or not signed by its origin.
    #[error(transparent)]
    Entry(#[from] EntryError),
    /// Of another swarm.
    #[error("entry belongs to another swarm ({0:?})")]
    Swarm(SwarmTag),
    /// Of a robot that is not in the roster.
    #[error("robot {0} is not in the roster")]
    UnknownOrigin(RobotId),
    /// It is the last epoch of all, or as many of this robot's as are held already wait for the disk.
    #[error("robot {0} begins epochs faster than they can be kept, or its last one of all")]
    EpochLimit(RobotId),
    /// The robot's entries take as much as is granted to each member.
    #[error("robot {0} has filled its share of gossip.facts_bytes_max; others are not touched")]
    BytesLimit(RobotId),
    /// The log is as long as is held.
    #[error("entry {0} is beyond gossip.entries_per_frame_max")]
    SeqLimit(EntryId),
    /// The floor that it states is neither its predecessor's nor its own place: the log ends here, on every robot
    /// alike.
    #[error("entry {0} states a floor that is neither its predecessor's nor its own place")]
    FloorMoved(EntryId),
    /// Its predecessor is missing, and so many nearer ones wait already that it was not kept.
    #[error("entry {0} is too far ahead of what is held")]
    TooEarly(EntryId),
    /// The log is quarantined.
    #[error("log {0} has two histories and is quarantined")]
    Quarantined(FrameId),
    /// The log has two histories, as this entry proves: **the log is quarantined now** ([`Replica::forks`] has the
    /// proof).
    #[error("log {0} has two histories: the same key is used twice, or a store was restored from an old image")]
    Fork(FrameId),
    /// Two entries that do not contradict each other were given as a fork proof.
    #[error("the two entries do not prove a fork")]
    NotAProof,
}

impl IngestError {
    /// The robot whose signature stands under what was refused. Nobody is blamed for bytes that anyone may have sent.
    pub fn culprit(&self) -> Option<RobotId> {
        match self {
            Self::FloorMoved(id) | Self::TooEarly(id) => Some(id.frame.robot),
            Self::Fork(frame) => Some(frame.robot),
            // Looked at after the signature.
            Self::BytesLimit(robot) => Some(*robot),
            Self::Entry(_)
            | Self::Swarm(_)
            | Self::UnknownOrigin(_)
            | Self::EpochLimit(_)
            | Self::SeqLimit(_)
            | Self::Quarantined(_)
            | Self::NotAProof => None,
        }
    }

    /// A short name for counters.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Entry(error) => error.reason(),
            Self::Swarm(_) => "swarm",
            Self::UnknownOrigin(_) => "unknown_origin",
            Self::EpochLimit(_) => "epoch_limit",
            Self::BytesLimit(_) => "bytes_limit",
            Self::SeqLimit(_) => "seq_limit",
            Self::FloorMoved(_) => "floor_moved",
            Self::TooEarly(_) => "too_early",
            Self::Quarantined(_) => "quarantined",
            Self::Fork(_) => "fork",
            Self::NotAProof => "not_a_proof",
        }
    }
}

impl Replica {
    /// An empty replica for the members of `roster` (name and ed25519 public key).
    ///
    /// # Errors
    /// [`RosterError`] if a key is unusable or used twice, or there are too many.
    pub fn new(
        swarm: &Name,
        roster: impl IntoIterator<Item = (Name, [u8; 32])>,
        limits: &GossipConfig,
    ) -> Result<Self, RosterError> {
        let mut members = BTreeMap::<RobotId, Member>::new();
        for (name, public) in roster {
            let key = VerifyingKey::from_bytes(&public).ok().filter(|key| !key.is_weak());
            let key = key.ok_or_else(|| RosterError::Key(name.clone()))?;
            if let Some(other) = members.insert(RobotId::of_key(&public), Member { name: name.clone(), key }) {
                return Err(RosterError::Twice(other.name, name));
            }
        }
        if members.len() > MEMBERS_MAX {
            return Err(RosterError::TooMany(members.len()));
        }
        let members_count = members.len();
        let mut ids = blake3::Hasher::new();
        for robot in members.keys() {
            ids.update(&robot.0);
        }
        let [a, b, c, d, ..] = *ids.finalize().as_bytes();
        Ok(Self {
            swarm: SwarmTag::of(swarm),
            members,
            roster_hash: [a, b, c, d],
            digest: OnceCell::new(),
            slots: BTreeMap::new(),
            retired: BTreeMap::new(),
            gone: Vec::new(),
            entries_per_frame_max: limits.entries_per_frame_max,
            epochs_per_robot_max: limits.epochs_per_robot_max,
            member_bytes_max: limits.member_bytes_max(members_count),
        })
    }

    /// Takes in an entry from anywhere.
    ///
    /// # Errors
    /// [`IngestError`]; only [`IngestError::Fork`] changes state.
    pub fn ingest(&mut self, bytes: &[u8]) -> Result<Ingested, IngestError> {
        let entry = self.admit(bytes)?;
        let id = entry.id();
        let frame = id.frame;
        match self.slots.get(&frame) {
            Some(Slot::Forked(_)) => return Err(IngestError::Quarantined(frame)),
            Some(Slot::Log(log)) if log.held(id.seq).is_some_and(|held| *held.bytes == *bytes) => {
                return Ok(Ingested::Known);
            }
            // The writer has replaced it, or given it up.
            Some(Slot::Log(log)) if id.seq < log.first() => return Ok(Ingested::Known),
            None if self.is_retired(frame) => return Ok(Ingested::Known),
            Some(Slot::Log(log)) if log.early.get(&id.seq) == Some(&entry) => return Ok(Ingested::Early(id)),
            _ => {}
        }
        self.check_epoch(frame)?;
        self.check_place(id, entry.floor())?;
        self.verify(&entry)?;
        self.check_bytes(&entry, bytes.len())?;

        let next = self.next_seq(frame);
        if id.seq > next && entry.floor() == id.seq {
            return self.jump(&entry, bytes);
        }
        if id.seq > next {
            return self.hold_early(entry, bytes);
        }
        if let Some(held) = self.log(frame).and_then(|log| log.held(id.seq)) {
            let other = held.bytes.to_vec();
            return Err(self.fork(frame, &other, bytes));
        }
        // A gap that a floor has jumped: what lay in it is gone.
        if self.log(frame).is_some_and(|log| log.held(id.seq).is_none() && id.seq < next) {
            return Ok(Ingested::Known);
        }
        self.push(&entry, bytes)?;
        self.with_early(id)
    }

    /// This new entry, and those that had waited for it.
    fn with_early(&mut self, id: EntryId) -> Result<Ingested, IngestError> {
        let mut new = vec![id];
        while let Some(entry) = self.take_early(id.frame) {
            let id = entry.id();
            match self.push(&entry, &entry.encode()) {
                Ok(()) => new.push(id),
                Err(IngestError::Fork(frame)) => return Err(IngestError::Fork(frame)),
                Err(_) => break,
            }
        }
        Ok(Ingested::New(new))
    }

    /// The entry `id` is on disk: from now on it may be shown, once all before it are, too. Unknown ids are ignored.
    pub fn mark_durable(&mut self, id: EntryId) {
        if let Some(Slot::Log(log)) = self.slots.get_mut(&id.frame) {
            log.mark_durable(id.seq);
            self.digest.take();
            self.retire(id.frame);
        }
    }

    /// The next free place in a log, counting entries that are not durable yet; 0 for logs not held.
    pub fn next_seq(&self, frame: FrameId) -> u32 {
        self.log(frame).map_or(0, Log::next_seq)
    }

    /// Epochs known of a robot, rising.
    pub fn epochs_of(&self, robot: RobotId) -> impl DoubleEndedIterator<Item = u32> {
        let all = FrameId { robot, epoch: 0 }..=FrameId { robot, epoch: u32::MAX };
        self.slots.range(all).map(|(frame, _)| frame.epoch)
    }

    /// Durable entries in canonical order (frame, then place), as canonical bytes, logs in quarantine left out.
    pub fn entries(&self) -> impl Iterator<Item = (EntryId, &[u8])> {
        self.logs().flat_map(|(frame, log)| {
            let id = move |seq| EntryId { frame, seq };
            (log.first()..).zip(log.durable_entries()).map(move |(seq, held)| (id(seq), &*held.bytes))
        })
    }

    /// The facts in [`Replica::entries`]. Payloads that are no fact (of newer kinds, or malformed though signed) are
    /// passed over, on every robot alike.
    pub fn facts(&self) -> impl Iterator<Item = (EntryId, Fact)> {
        self.entries().filter_map(|(id, bytes)| Some((id, Entry::decode(bytes).ok()?.fact().ok()?)))
    }

    /// The places that are held of a log, if all of them are durable.
    pub fn settled(&self, frame: FrameId) -> Option<Range<u32>> {
        let log = self.log(frame)?;
        (log.durable() == log.next_seq()).then(|| log.first()..log.durable())
    }

    /// Whether this entry is held and replaces all below it.
    pub fn is_floor(&self, id: EntryId) -> bool {
        id.seq > 0 && self.log(id.frame).and_then(|log| log.held(id.seq)).is_some_and(|held| held.floor == id.seq)
    }

    /// One entry, durable or not.
    pub fn entry(&self, id: EntryId) -> Option<Entry> {
        Entry::decode(self.entry_bytes(id)?).ok()
    }

    /// One entry's canonical bytes, durable or not.
    pub fn entry_bytes(&self, id: EntryId) -> Option<&[u8]> {
        self.log(id.frame)?.held(id.seq).map(|held| &*held.bytes)
    }

    /// This swarm's tag.
    pub fn swarm(&self) -> SwarmTag {
        self.swarm
    }

    /// A member's name.
    pub fn name_of(&self, robot: RobotId) -> Option<&Name> {
        self.members.get(&robot).map(|member| &member.name)
    }

    /// The members, in the order of their ids.
    pub fn members(&self) -> impl Iterator<Item = (RobotId, &Name)> {
        self.members.iter().map(|(robot, member)| (*robot, &member.name))
    }

    /// Whether a beacon comes from the member it names.
    #[must_use]
    pub fn verify_beacon(&self, beacon: &Beacon) -> bool {
        self.members.get(&beacon.robot()).is_some_and(|member| beacon.verify(&member.key, self.swarm))
    }

    /// Whether a proof of life comes from the member it names.
    #[must_use]
    pub fn verify_life(&self, life: &Life) -> bool {
        self.members.get(&life.content().robot).is_some_and(|member| life.verify(&member.key, self.swarm))
    }

    /// The cheap checks: size, form, swarm, roster.
    pub(super) fn admit(&self, bytes: &[u8]) -> Result<Entry, IngestError> {
        let entry = Entry::decode(bytes)?;
        if entry.swarm() != self.swarm {
            return Err(IngestError::Swarm(entry.swarm()));
        }
        let robot = entry.id().frame.robot;
        if !self.members.contains_key(&robot) {
            return Err(IngestError::UnknownOrigin(robot));
        }
        Ok(entry)
    }

    /// Whether an entry that states this floor may be held: entries from a floor on are counted, and the last place of
    /// all stays free.
    pub(super) fn check_place(&self, id: EntryId, floor: u32) -> Result<(), IngestError> {
        let fits = id.seq.saturating_sub(floor) < self.entries_per_frame_max && id.seq < u32::MAX;
        if fits { Ok(()) } else { Err(IngestError::SeqLimit(id)) }
    }

    pub(super) fn verify(&self, entry: &Entry) -> Result<(), IngestError> {
        let robot = entry.id().frame.robot;
        let member = self.members.get(&robot).ok_or(IngestError::UnknownOrigin(robot))?;
        Ok(entry.verify(&member.key)?)
    }

    pub(super) fn log(&self, frame: FrameId) -> Option<&Log> {
        match self.slots.get(&frame) {
            Some(Slot::Log(log)) => Some(log),
            _ => None,
        }
    }

    pub(super) fn logs(&self) -> impl Iterator<Item = (FrameId, &Log)> {
        self.slots.iter().filter_map(|(frame, slot)| match slot {
            Slot::Log(log) => Some((*frame, log)),
            Slot::Forked(_) => None,
        })
    }

    pub(super) fn log_mut(&mut self, frame: FrameId) -> &mut Log {
        let slot = self.slots.entry(frame).or_insert_with(|| Slot::Log(Log::default()));
        match slot {
            Slot::Log(log) => log,
            Slot::Forked(_) => unreachable!("callers refuse quarantined logs first"),
        }
    }

    /// Pushes a verified entry whose place is the next free one.
    fn push(&mut self, entry: &Entry, bytes: &[u8]) -> Result<(), IngestError> {
        let id = entry.id();
        let link = self.log(id.frame).map_or(Link::Fits, |log| log.link(entry.previous(), entry.floor()));
        match link {
            Link::Fits => {
                let log = self.log_mut(id.frame);
                log.received = true;
                log.push(Held::of(entry, bytes.into()));
                Ok(())
            }
            Link::FloorMoved => Err(IngestError::FloorMoved(id)),
            Link::Contradicts => {
                let last = self.log(id.frame).and_then(Log::head);
                let other = last.map(|held| held.bytes.to_vec()).unwrap_or_default();
                Err(self.fork(id.frame, &other, bytes))
            }
        }
    }

    /// Goes on at a verified entry that is a floor, beyond the next free place.
    fn jump(&mut self, entry: &Entry, bytes: &[u8]) -> Result<Ingested, IngestError> {
        let id = entry.id();
        let log = self.log_mut(id.frame);
        if let Some(other) = log.early.get(&id.seq).map(Entry::encode) {
            return Err(self.fork(id.frame, &other, bytes)); // the same one was answered before
        }
        log.received = true;
        log.jump(id.seq, Held::of(entry, bytes.into()));
        self.with_early(id)
    }

    fn fork(&mut self, frame: FrameId, a: &[u8], b: &[u8]) -> IngestError {
        self.quarantine(frame, a, b);
        IngestError::Fork(frame)
    }

    /// Keeps a verified entry until its predecessor comes; of too many, those nearest to what is held.
    fn hold_early(&mut self, entry: Entry, bytes: &[u8]) -> Result<Ingested, IngestError> {
        let id = entry.id();
        if let Some(other) = self.log(id.frame).and_then(|log| log.early.get(&id.seq)) {
            let other = other.encode();
            return Err(self.fork(id.frame, &other, bytes));
        }
        let robot = id.frame.robot;
        let all = FrameId { robot, epoch: 0 }..=FrameId { robot, epoch: u32::MAX };
        let waiting = self.slots.range(all).filter_map(|(frame, slot)| match slot {
            Slot::Log(log) => Some((*frame, log)),
            Slot::Forked(_) => None,
        });
        let (mut count, mut farthest) = (0, None);
        for (frame, log) in waiting {
            count += log.early.len();
            let last = log.early.keys().next_back().map(|seq| (seq - log.next_seq(), EntryId { frame, seq: *seq }));
            farthest = farthest.max(last);
        }
        if count >= EARLY_PER_ROBOT_MAX {
            match farthest {
                Some((distance, far)) if id.seq - self.next_seq(id.frame) < distance => {
                    self.log_mut(far.frame).early.remove(&far.seq);
                }
                _ => return Err(IngestError::TooEarly(id)),
            }
        }
        let log = self.log_mut(id.frame);
        log.received = true;
        log.early.insert(id.seq, entry);
        Ok(Ingested::Early(id))
    }

    fn take_early(&mut self, frame: FrameId) -> Option<Entry> {
        let Some(Slot::Log(log)) = self.slots.get_mut(&frame) else { return None };
        log.early.remove(&log.next_seq())
    }
}

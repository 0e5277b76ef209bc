//! What a member may take of every robot's memory: so many epochs, and so many bytes of entries. Both bounds are the
//! same on robots with the same roster and configuration.
//!
//! *Epochs*: the newest are held. Once an entry of a newer one is durable, the oldest log is gone, and is not taken in
//! again. Whoever heard of all epochs of a robot thus holds the same ones, in whatever order they came, and also when the
//! robot that wrote them is gone or has lost its own past.
//!
//! *Bytes*: the member itself makes room. The first entry of a new epoch gives up old ones ([`RetiredFact`]); once that
//! is durable, their logs are gone. Whoever makes no room is heard no further; others are not touched.
//!
//! [`RetiredFact`]: crate::wire::fact::RetiredFact

use super::log::{HELD_BYTES, Log, retires};
use super::set::{IngestError, Replica, Slot};
use crate::ids::{FrameId, RobotId};
use crate::wire::Entry;
use crate::wire::limits::ENTRY_LEN_MAX;

impl Replica {
    /// Whether the writer of this log gave it up, or as many newer ones as may be are held.
    pub(super) fn is_retired(&self, frame: FrameId) -> bool {
        self.retired.get(&frame.robot).is_some_and(|first| frame.epoch < *first)
    }

    /// The first epoch of a robot that may be held, if there is a bound.
    pub fn first_epoch(&self, robot: RobotId) -> Option<u32> {
        self.retired.get(&robot).copied()
    }

    /// The first epoch of a robot that it wants kept, if its logs say so.
    pub fn stated_first_epoch(&self, robot: RobotId) -> Option<u32> {
        self.slots_of(robot).filter_map(|(frame, _)| self.log(*frame)?.retires()).max()
    }

    /// Logs that were dropped because they were given up or too many since the last call.
    pub fn take_gone(&mut self) -> Vec<FrameId> {
        core::mem::take(&mut self.gone)
    }

    /// The first epoch that can stay if a log of this frame is begun; `None` if all can. Older ones must go beyond three
    /// quarters of the bytes that are granted to a member, so that there is room to write.
    pub fn to_retire(&self, frame: FrameId) -> Option<u32> {
        if self.slots.contains_key(&frame) {
            return None;
        }
        let (mut bytes, mut first) = (0, frame.epoch);
        for (older, slot) in self.slots_of(frame.robot).rev().filter(|(older, _)| **older < frame) {
            bytes += bytes_of(slot);
            if bytes > self.member_bytes_max / 4 * 3 {
                return Some(first);
            }
            first = older.epoch;
        }
        None
    }

    /// What a robot's entries are counted for.
    pub fn bytes_of(&self, robot: RobotId) -> usize {
        self.slots_of(robot).map(|(_, slot)| bytes_of(slot)).sum()
    }

    /// What a robot's entries may be counted for.
    pub fn member_bytes_max(&self) -> usize {
        self.member_bytes_max
    }

    /// Whether an entry of any length might find no room.
    pub(super) fn is_full(&self, robot: RobotId) -> bool {
        self.bytes_of(robot) + ENTRY_LEN_MAX + HELD_BYTES > self.member_bytes_max
    }

    /// Whether a log of this frame is or may be held. Nobody has the last epoch of all: none could follow it. What is to
    /// go stays until what comes is durable; there is an end to that, too. Logs of which only later entries are here are
    /// not counted: [those](super::set::EARLY_PER_ROBOT_MAX) have a bound of their own.
    pub(super) fn check_epoch(&self, frame: FrameId) -> Result<(), IngestError> {
        if frame.epoch == u32::MAX {
            return Err(IngestError::EpochLimit(frame.robot));
        }
        let begun = || self.slots_of(frame.robot).filter(|(_, slot)| slot.is_begun()).count();
        if self.slots.get(&frame).is_some_and(Slot::is_begun) || begun() < 2 * self.epochs_per_robot_max {
            return Ok(());
        }
        Err(IngestError::EpochLimit(frame.robot))
    }

    /// Whether there is room for an entry of so many bytes, counted without what it replaces, and without what is given
    /// up, though that stays until it is durable.
    pub(super) fn check_bytes(&self, entry: &Entry, len: usize) -> Result<(), IngestError> {
        let id = entry.id();
        let stays = self.slots_of(id.frame.robot).filter_map(|(frame, _)| self.log(*frame)).map(Log::stays);
        let first = stays.chain(retires(entry)).max().unwrap_or_default();
        let replaces = |frame: &FrameId| frame.epoch < first || (*frame == id.frame && entry.floor() == id.seq);
        let kept = self.slots_of(id.frame.robot).filter(|(frame, _)| !replaces(frame));
        let held: usize = kept.map(|(_, slot)| bytes_of(slot)).sum();
        if held + len + HELD_BYTES > self.member_bytes_max {
            return Err(IngestError::BytesLimit(id.frame.robot));
        }
        Ok(())
    }

    /// Drops the logs that the durable entries of this one give up, and those that are too many with it.
    pub(super) fn retire(&mut self, frame: FrameId) {
        let known = self.first_epoch(frame.robot).unwrap_or_default();
        // Most logs give up nothing: those need not be looked through each time.
        let log = self.log(frame).filter(|log| log.stays() > known);
        let first = log.and_then(Log::retires).max(self.first_of_newest(frame.robot));
        let Some(first) = first.filter(|first| *first > known) else { return };
        self.retired.insert(frame.robot, first);
        let gone: Vec<FrameId> = self.slots_of(frame.robot).map(|(frame, _)| *frame).collect();
        for frame in gone.into_iter().filter(|frame| frame.epoch < first) {
            // The disk has or will have something of those that are more than a later entry waiting.
            if self.slots.remove(&frame).is_some_and(|slot| slot.is_begun()) {
                self.gone.push(frame);
            }
        }
        self.digest.take();
    }

    /// The oldest of as many epochs of a robot as may be held, if so many are: it can only rise.
    fn first_of_newest(&self, robot: RobotId) -> Option<u32> {
        let shown = self.slots_of(robot).rev().filter(|(_, slot)| slot.is_shown());
        shown.map(|(frame, _)| frame.epoch).nth(self.epochs_per_robot_max - 1)
    }

    fn slots_of(&self, robot: RobotId) -> impl DoubleEndedIterator<Item = (&FrameId, &Slot)> {
        self.slots.range(FrameId { robot, epoch: 0 }..=FrameId { robot, epoch: u32::MAX })
    }
}

impl Slot {
    /// Whether it has more than later entries that wait.
    fn is_begun(&self) -> bool {
        !matches!(self, Self::Log(log) if log.is_empty())
    }

    /// Whether others are shown something of it.
    fn is_shown(&self) -> bool {
        match self {
            Self::Log(log) => !log.durable_entries().is_empty(),
            Self::Forked(_) => true,
        }
    }
}

fn bytes_of(slot: &Slot) -> usize {
    match slot {
        Slot::Log(log) => log.bytes(),
        Slot::Forked(proof) => proof.a.len() + proof.b.len(),
    }
}

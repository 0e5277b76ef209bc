//! What a member may take of every robot's memory: so many epochs, and so many bytes of entries. Both bounds are the
//! same on robots with the same roster and configuration.
//!
//! The member itself makes room: the first entry of a new epoch gives up old ones ([`RetiredFact`]), so many that the
//! others take it. Once that is durable, the logs given up are gone. Whoever makes no room is heard no further; others
//! are not touched.
//!
//! [`RetiredFact`]: crate::wire::fact::RetiredFact

use super::log::{HELD_BYTES, Log, retires};
use super::set::{IngestError, Replica, Slot};
use crate::ids::{FrameId, RobotId};
use crate::wire::Entry;
use crate::wire::limits::ENTRY_LEN_MAX;

impl Replica {
    /// Whether the writer of this log gave it up.
    pub(super) fn is_retired(&self, frame: FrameId) -> bool {
        self.retired.get(&frame.robot).is_some_and(|first| frame.epoch < *first)
    }

    /// The first epoch that a robot has not given up, if it gave up any.
    pub fn first_epoch(&self, robot: RobotId) -> Option<u32> {
        self.retired.get(&robot).copied()
    }

    /// Logs that were given up and dropped since the last call.
    pub fn take_gone(&mut self) -> Vec<FrameId> {
        core::mem::take(&mut self.gone)
    }

    /// The first epoch that can stay if a log of this frame is begun; `None` if all can. Older ones go that the others
    /// would have no room for, and those beyond three quarters of the bytes that are granted to a member, so that there
    /// is room to write.
    pub fn to_retire(&self, frame: FrameId) -> Option<u32> {
        if self.slots.contains_key(&frame) {
            return None;
        }
        let (mut count, mut bytes, mut first) = (0, 0, frame.epoch);
        for (older, slot) in self.slots_of(frame.robot).rev().filter(|(older, _)| **older < frame) {
            (count, bytes) = (count + 1, bytes + bytes_of(slot));
            if count >= self.epochs_per_robot_max || bytes > self.member_bytes_max / 4 * 3 {
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

    /// Whether the log of this entry is or may be held. Nobody has the last epoch of all: none could follow it.
    pub(super) fn check_epoch(&self, entry: &Entry) -> Result<(), IngestError> {
        let id = entry.id();
        self.check_room(id.frame, retires(entry).filter(|_| id.seq == 0))
    }

    /// Whether a log of this frame is or may be held that begins by giving up the epochs below `first`.
    pub(super) fn check_room(&self, frame: FrameId, first: Option<u32>) -> Result<(), IngestError> {
        if frame.epoch == u32::MAX {
            return Err(IngestError::EpochLimit(frame.robot));
        }
        let epochs = || self.epochs_of(frame.robot);
        // What is given up stays until that is durable; there is an end to that, too.
        let fits = || epochs().filter(|epoch| first.is_none_or(|first| *epoch >= first)).count();
        if self.slots.contains_key(&frame)
            || (fits() < self.epochs_per_robot_max && epochs().count() < 2 * self.epochs_per_robot_max)
        {
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

    /// Drops the logs that the durable entries of this one give up.
    pub(super) fn retire(&mut self, frame: FrameId) {
        let known = self.first_epoch(frame.robot).unwrap_or_default();
        // Most logs give up nothing: those need not be looked through each time.
        let log = self.log(frame).filter(|log| log.stays() > known);
        let Some(first) = log.and_then(Log::retires).filter(|first| *first > known) else { return };
        self.retired.insert(frame.robot, first);
        let gone: Vec<FrameId> = self.slots_of(frame.robot).map(|(frame, _)| *frame).collect();
        for frame in gone.into_iter().filter(|frame| frame.epoch < first) {
            self.slots.remove(&frame);
            self.gone.push(frame);
        }
        self.digest.take();
    }

    fn slots_of(&self, robot: RobotId) -> impl DoubleEndedIterator<Item = (&FrameId, &Slot)> {
        self.slots.range(FrameId { robot, epoch: 0 }..=FrameId { robot, epoch: u32::MAX })
    }
}

fn bytes_of(slot: &Slot) -> usize {
    match slot {
        Slot::Log(log) => log.bytes(),
        Slot::Forked(proof) => proof.a.len() + proof.b.len(),
    }
}

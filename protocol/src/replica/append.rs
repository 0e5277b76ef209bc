//! Writing this robot's own facts (DESIGN §3): [`Replica::append`] for the next one of a log, [`Replica::append_floor`]
//! for those that replace all before them. A log is written on only as long as nobody else can know more of it.

use super::log::Held;
use super::set::{Replica, Slot};
use crate::ids::{EntryId, FrameId, Hash, RobotId};
use crate::wire::fact::CondensedFact;
use crate::wire::{Entry, EntryContent, EntryError, Fact, FactError};
use ed25519_dalek::SigningKey;
use thiserror::Error;

/// Why a fact of our own cannot be written. No state changed.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum AppendError {
    /// The fact is not writable.
    #[error(transparent)]
    Fact(#[from] FactError),
    /// The entry would be over a limit.
    #[error(transparent)]
    Entry(#[from] EntryError),
    /// The key is no member's.
    #[error("robot {0} is not in the roster")]
    NotInRoster(RobotId),
    /// A later epoch was begun.
    #[error("epoch {epoch} is closed: epoch {latest} was begun")]
    Closed {
        /// The epoch asked for.
        epoch: u32,
        /// The latest one.
        latest: u32,
    },
    /// No epoch can follow this robot's last one; or it begins them faster than its disk keeps them.
    #[error("{0} has no epoch left that others would take; give the robot a new key")]
    EpochLimit(RobotId),
    /// The log is full or quarantined, or others hold entries of it that this robot did not write in this run or load
    /// from its store. Writing on would tell a second story.
    #[error("log {0} cannot be continued ({1}); begin a new epoch")]
    NewEpochNeeded(FrameId, &'static str),
}

impl Replica {
    /// Appends a fact as the next entry of this robot's log of `frame_epoch`. It is held at once, but shown to
    /// nobody until [`Replica::mark_durable`].
    ///
    /// # Errors
    /// [`AppendError`]; no state changes.
    pub fn append(&mut self, key: &SigningKey, frame_epoch: u32, fact: &Fact) -> Result<Entry, AppendError> {
        let robot = RobotId::of_key(key.verifying_key().as_bytes());
        let entry = self.next_entry(key, robot, frame_epoch, fact, false)?;
        self.log_mut(entry.id().frame).push(Held::of(&entry, entry.encode().into()));
        Ok(entry)
    }

    /// Appends these facts as the next entries of this robot's log of `frame_epoch`; the first states its own
    /// place as the floor, and once it is durable everything below it is gone, here and on every robot that hears of
    /// it.
    ///
    /// # Errors
    /// [`AppendError`]; no state changes.
    pub fn append_floor(
        &mut self,
        key: &SigningKey,
        frame_epoch: u32,
        parts: &[CondensedFact],
    ) -> Result<Vec<Entry>, AppendError> {
        let robot = RobotId::of_key(key.verifying_key().as_bytes());
        let frame = FrameId { robot, epoch: frame_epoch };
        let mut entries = Vec::with_capacity(parts.len());
        for part in parts {
            let fact = Fact::Condensed(part.clone());
            match self.next_entry(key, robot, frame_epoch, &fact, entries.is_empty()) {
                Ok(entry) => {
                    self.log_mut(frame).push(Held::of(&entry, entry.encode().into()));
                    entries.push(entry);
                }
                Err(error) => {
                    entries.iter().for_each(|_| drop(self.log_mut(frame).pop()));
                    return Err(error);
                }
            }
        }
        Ok(entries)
    }

    fn next_entry(
        &self,
        key: &SigningKey,
        robot: RobotId,
        frame_epoch: u32,
        fact: &Fact,
        raises: bool,
    ) -> Result<Entry, AppendError> {
        let frame = FrameId { robot, epoch: frame_epoch };
        if !self.members.contains_key(&robot) {
            return Err(AppendError::NotInRoster(robot));
        }
        if let Some(latest) = self.epochs_of(robot).last().filter(|latest| *latest > frame_epoch) {
            return Err(AppendError::Closed { epoch: frame_epoch, latest });
        }
        let needed = |why| Err(AppendError::NewEpochNeeded(frame, why));
        let (seq, floor, previous) = match self.slots.get(&frame) {
            Some(Slot::Forked(_)) => return needed("it has two histories"),
            Some(Slot::Log(log)) if log.received || !log.early.is_empty() => {
                return needed("others hold entries of it that this store lost");
            }
            Some(Slot::Log(log)) => {
                let (next, floor) = (log.next_seq(), log.floor());
                (next, if raises { next } else { floor }, log.head().map(|head| head.hash).unwrap_or_default())
            }
            None => (0, 0, Hash::default()),
        };
        let id = EntryId { frame, seq };
        if self.check_place(id, floor).is_err() {
            return needed("it is full");
        }
        let (kind, payload) = (fact.kind(), fact.to_payload()?);
        let entry = Entry::sign(key, EntryContent { swarm: self.swarm, id, kind, floor, previous, payload })?;
        if self.check_epoch(frame).is_err() {
            return Err(AppendError::EpochLimit(robot));
        }
        if self.check_bytes(&entry, entry.encode().len()).is_err() {
            return needed("this robot has filled its share of gossip.facts_bytes_max");
        }
        Ok(entry)
    }
}

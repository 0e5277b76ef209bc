//! Proof that a robot told two stories: two entries of one log, both signed by their origin, that cannot both belong to
//! one history. The same key on two robots, or a store restored from an old image, makes such a pair.

use super::set::{IngestError, Replica, Slot};
use crate::ids::FrameId;
use crate::wire::Entry;

/// Two signed entries of one log that contradict each other: different ones for the same place, or a successor that
/// names another predecessor.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ForkProof {
    /// Canonical bytes of the entry with the lower (or equal) place.
    pub a: Vec<u8>,
    /// Canonical bytes of the other.
    pub b: Vec<u8>,
}

impl Replica {
    /// Takes in a fork proof. Returns the log and whether it was not known as forked before; it is quarantined at once.
    ///
    /// # Errors
    /// [`IngestError`] if the two do not prove a fork of a member's log. No state changes then.
    pub fn ingest_fork(&mut self, a: &[u8], b: &[u8]) -> Result<(FrameId, bool), IngestError> {
        let (first, second) = (self.admit(a)?, self.admit(b)?);
        let frame = first.id().frame;
        if second.id().frame != frame || !contradict(&first, &second) {
            return Err(IngestError::NotAProof);
        }
        if self.is_quarantined(frame) {
            return Ok((frame, false));
        }
        if self.is_retired(frame) {
            return Ok((frame, false));
        }
        self.check_epoch(frame)?;
        self.verify(&first)?;
        self.verify(&second)?;
        self.quarantine(frame, a, b);
        Ok((frame, true))
    }

    /// Logs known to have two histories, with their proofs, in the order of their frames.
    pub fn forks(&self) -> impl Iterator<Item = (FrameId, &ForkProof)> {
        self.slots.iter().filter_map(|(frame, slot)| match slot {
            Slot::Forked(proof) => Some((*frame, proof)),
            Slot::Log(_) => None,
        })
    }

    /// Whether this log is known to have two histories.
    pub fn is_quarantined(&self, frame: FrameId) -> bool {
        matches!(self.slots.get(&frame), Some(Slot::Forked(_)))
    }

    /// Drops a log for its proof. Both entries are verified by the caller.
    pub(super) fn quarantine(&mut self, frame: FrameId, a: &[u8], b: &[u8]) {
        let proof = ForkProof { a: a.to_vec(), b: b.to_vec() };
        self.slots.insert(frame, Slot::Forked(proof));
        self.digest.take();
        self.retire(frame);
    }
}

/// Whether two entries of one log, in rising order, cannot belong to one history.
fn contradict(a: &Entry, b: &Entry) -> bool {
    let (m, n) = (a.id().seq, b.id().seq);
    (m == n && a != b) || (m.checked_add(1) == Some(n) && b.previous() != a.hash())
}

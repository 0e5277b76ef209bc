//! What a neighbour lacks, within a byte budget. Logs take turns, one entry each, from a start that depends on the
//! asker's vector, so that under any budget every log advances; the answer lists entries in canonical order and can be
//! resumed by asking again with the vector that includes it.

use super::have::Have;
use super::set::{Replica, Slot};
use crate::ids::FrameId;
use crate::wire::limits::{ENTRIES_PER_DELTA_MAX, FORKS_PER_DELTA_MAX};
use crate::wire::messages::carried_len;
use crate::wire::{Delta, EntryBytes, Head};
use core::ops::Range;

impl Replica {
    /// Entries and fork proofs that the holder of `have` lacks, at most `byte_budget` bytes of them. Progress is
    /// certain from a budget of 4,096 bytes on.
    pub fn delta_for(&self, have: &Have, byte_budget: usize) -> Delta {
        let mut delta = Delta::default();
        let mut left = byte_budget;
        self.add_forks(have, &mut delta, &mut left);

        let mut lacking = self.lacking(have);
        let taken = self.take_turns(&lacking, first_turn(have, lacking.len()), left);
        for ((frame, range), taken) in lacking.iter_mut().zip(taken) {
            delta.more |= taken < range.end;
            let held = (range.start..taken).filter_map(|seq| self.log(*frame)?.held(seq));
            delta.entries.extend(held.map(|held| EntryBytes(held.bytes.to_vec())));
        }
        delta
    }

    fn add_forks(&self, have: &Have, delta: &mut Delta, left: &mut usize) {
        let half = *left / 2;
        for (frame, proof) in self.forks() {
            if !have.covers(frame) || have.head(frame) == Some(Head::Forked) {
                continue;
            }
            let len = carried_len(proof.a.len()) + carried_len(proof.b.len());
            // The first may take all of the budget, the others leave half of it to entries.
            let fits = len <= *left && (delta.forks.is_empty() || *left - len >= half);
            if !fits || delta.forks.len() == FORKS_PER_DELTA_MAX {
                delta.more = true;
                return;
            }
            *left -= len;
            delta.forks.push([EntryBytes(proof.a.clone()), EntryBytes(proof.b.clone())]);
        }
    }

    /// Places that the asker lacks, by log.
    fn lacking(&self, have: &Have) -> Vec<(FrameId, Range<u32>)> {
        let range = |(frame, slot): (&FrameId, &Slot)| {
            let Slot::Log(log) = slot else { return None };
            let range = match have.head(*frame) {
                None => log.first()..log.durable(),
                Some(Head::Forked) => return None,
                // Below the floor there is nothing to send, or to compare.
                Some(Head::Log { len, .. }) if len <= log.first() => log.first()..log.durable(),
                Some(Head::Log { len, tag }) => match (log.held(len - 1).filter(|_| len <= log.durable()), tag) {
                    (None, _) => return None,
                    // Another history: our entry in that place is the asker's proof.
                    (Some(held), Some(tag)) if Head::tag_of(&held.hash) != tag => len - 1..len,
                    (Some(_), _) => len..log.durable(),
                },
            };
            (have.covers(*frame) && !range.is_empty()).then_some((*frame, range))
        };
        self.slots.iter().filter_map(range).collect()
    }

    /// How far each log of `lacking` gets when they take turns until the budget or the count is used up.
    fn take_turns(&self, lacking: &[(FrameId, Range<u32>)], first: usize, budget: usize) -> Vec<u32> {
        let mut at: Vec<u32> = lacking.iter().map(|(_, range)| range.start).collect();
        let (mut left, mut count, mut waiting) = (budget, 0, lacking.len());
        while waiting > 0 {
            waiting = 0;
            for turn in 0..lacking.len() {
                let k = (first + turn) % lacking.len();
                let (frame, range) = &lacking[k];
                if at[k] == range.end {
                    continue;
                }
                let Some(held) = self.log(*frame).and_then(|log| log.held(at[k])) else { continue };
                let len = carried_len(held.bytes.len());
                if len > left || count == ENTRIES_PER_DELTA_MAX {
                    return at;
                }
                left -= len;
                count += 1;
                at[k] += 1;
                waiting += 1;
            }
        }
        at
    }
}

/// Whose turn it is first: changes with the vector, so that no log is always last.
fn first_turn(have: &Have, lacking: usize) -> usize {
    let mut hasher = blake3::Hasher::new();
    for (frame, head) in have.heads() {
        hasher.update(&frame.robot.0);
        if let Head::Log { len, .. } = head {
            hasher.update(&len.to_le_bytes());
        }
    }
    let mut bytes = [0; 8];
    bytes.copy_from_slice(&hasher.finalize().as_bytes()[..8]);
    (u64::from_le_bytes(bytes) % (lacking.max(1) as u64)) as usize
}

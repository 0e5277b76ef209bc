//! What a replica says it holds: digest, root, have-vector. Because each entry names its predecessor's hash, a log's
//! length and last hash stand for all of it, and hashing the heads hashes the set.

use super::set::{Replica, Slot};
use crate::ids::{FrameId, Hash};
use crate::wire::limits::HEADS_MAX;
use crate::wire::{HaveRoot, HaveVector, Head};

/// Keeps a digest from standing for anything else.
const DIGEST_CONTEXT: &[u8] = b"merganser set 1\n";

impl Replica {
    /// BLAKE3 of the set of durable entries (and of which logs are quarantined): equal sets, equal digests.
    pub fn digest(&self) -> Hash {
        let mut hasher = blake3::Hasher::new();
        hasher.update(DIGEST_CONTEXT);
        for (frame, head) in self.heads() {
            hasher.update(&frame.robot.0);
            hasher.update(&frame.epoch.to_le_bytes());
            let (len, hash) = head.unwrap_or_default();
            hasher.update(&len.to_le_bytes());
            hasher.update(&hash.0);
        }
        Hash(*hasher.finalize().as_bytes())
    }

    /// The first eight bytes of the digest.
    pub fn root(&self) -> [u8; 8] {
        let digest = self.digest().0;
        core::array::from_fn(|i| digest[i])
    }

    /// Durable entries held, logs in quarantine left out.
    pub fn count(&self) -> u64 {
        self.logs().map(|(_, log)| u64::from(log.durable)).sum()
    }

    /// Whether a neighbour that announces this holds something else than we do.
    pub fn differs(&self, have: &HaveRoot) -> bool {
        have.root != self.root()
    }

    /// The first [`HEADS_MAX`] heads, which is all of them in most swarms.
    pub fn have(&self) -> HaveVector {
        self.have_after(None)
    }

    /// Up to [`HEADS_MAX`] heads of the logs after `after`. Its `until` is set where more follow.
    pub fn have_after(&self, after: Option<FrameId>) -> HaveVector {
        let mut have = HaveVector { after, ..HaveVector::default() };
        for (frame, head) in self.heads().filter(|(frame, _)| after.is_none_or(|after| *frame > after)) {
            if have.heads.len() == HEADS_MAX {
                have.until = have.heads.last().map(|(frame, _)| *frame);
                break;
            }
            let head = head.map_or(Head::Forked, |(len, hash)| Head::Log { len, tag: Head::tag_of(&hash) });
            have.heads.push((frame, head));
        }
        have
    }

    /// Length and last hash of every log that has durable entries; `None` for those in quarantine.
    fn heads(&self) -> impl Iterator<Item = (FrameId, Option<(u32, Hash)>)> {
        self.slots.iter().filter_map(|(frame, slot)| match slot {
            Slot::Forked(_) => Some((*frame, None)),
            Slot::Log(log) => {
                let last = log.durable_entries().last()?;
                Some((*frame, Some((log.durable, last.hash))))
            }
        })
    }
}

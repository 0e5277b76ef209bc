//! What a replica says it holds: digest, root, have-vector; and what a neighbour's vector says about our own logs.
//! Because each entry names its predecessor's hash, a log's length and last hash stand for all of it, and hashing the
//! heads hashes the set.

use super::set::{Replica, Slot};
use crate::ids::{FrameId, Hash, RobotId};
use crate::wire::limits::HEADS_MAX;
use crate::wire::{HaveRoot, HaveVector, Head, Members};
use std::collections::BTreeMap;

/// Keeps a digest from standing for anything else.
const DIGEST_CONTEXT: &[u8] = b"merganser set 1\n";

/// Which vector to make.
#[derive(Clone, Copy, Debug, Default)]
pub struct VectorForm {
    /// With four bytes of each log's last hash.
    pub tagged: bool,
    /// With the robots' ids, for a neighbour that has another roster.
    pub listed: bool,
    /// Only logs after this one.
    pub after: Option<FrameId>,
}

/// What a neighbour's vector says, in frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Have {
    /// Who says so.
    pub asker: RobotId,
    named: bool,
    after: Option<FrameId>,
    until: Option<FrameId>,
    heads: BTreeMap<FrameId, Head>,
}

impl Have {
    /// Whether the vector asks about this log.
    pub fn covers(&self, frame: FrameId) -> bool {
        match self.named {
            true => self.heads.contains_key(&frame),
            false => self.after.is_none_or(|after| frame > after) && self.until.is_none_or(|until| frame <= until),
        }
    }

    /// The head of one log, if named.
    pub fn head(&self, frame: FrameId) -> Option<Head> {
        self.heads.get(&frame).copied()
    }

    pub(super) fn heads(&self) -> impl Iterator<Item = (FrameId, Head)> {
        self.heads.iter().map(|(frame, head)| (*frame, *head))
    }
}

impl Replica {
    /// BLAKE3 of the set of durable entries (and of which logs are quarantined): equal sets, equal digests.
    pub fn digest(&self) -> Hash {
        *self.digest.get_or_init(|| {
            let mut hasher = blake3::Hasher::new();
            hasher.update(DIGEST_CONTEXT);
            for (frame, head) in self.durable_heads() {
                hasher.update(&frame.robot.0);
                hasher.update(&frame.epoch.to_le_bytes());
                let (len, hash) = head.unwrap_or_default();
                hasher.update(&len.to_le_bytes());
                hasher.update(&hash.0);
            }
            Hash(*hasher.finalize().as_bytes())
        })
    }

    /// The first eight bytes of the digest.
    pub fn root(&self) -> [u8; 8] {
        let digest = self.digest().0;
        core::array::from_fn(|i| digest[i])
    }

    /// Durable entries held, logs in quarantine left out.
    pub fn held(&self) -> u64 {
        self.logs().map(|(_, log)| log.durable_entries().len() as u64).sum()
    }

    /// Places of logs that are settled: durable entries, and those below floors. Logs in quarantine are left out.
    pub fn count(&self) -> u64 {
        self.logs().map(|(_, log)| u64::from(log.durable())).sum()
    }

    /// Root and count, to be announced.
    pub fn have_root(&self) -> HaveRoot {
        HaveRoot { root: self.root(), count: self.count() }
    }

    /// The heads of the first [`HEADS_MAX`] logs after `form.after`. Its `until` is set where more follow.
    pub fn have(&self, asker: RobotId, form: VectorForm) -> HaveVector {
        let mut until = None;
        let mut heads = Vec::new();
        for (frame, head) in self.durable_heads().filter(|(frame, _)| form.after.is_none_or(|after| *frame > after)) {
            if heads.len() == HEADS_MAX {
                until = heads.last().map(|(frame, _)| *frame);
                break;
            }
            heads.push((frame, head_of(head, form.tagged)));
        }
        HaveVector { after: form.after, until, ..self.vector(asker, form.listed, &heads) }
    }

    /// A vector that asks about these logs only, at most [`HEADS_MAX`] of them.
    pub fn have_named(&self, asker: RobotId, listed: bool, logs: impl IntoIterator<Item = FrameId>) -> HaveVector {
        let head = |frame| match self.slots.get(&frame) {
            Some(Slot::Forked(_)) => Head::Forked,
            Some(Slot::Log(log)) => Head::Log { len: log.durable(), tag: None },
            None => Head::Log { len: 0, tag: None },
        };
        let heads: BTreeMap<FrameId, Head> =
            logs.into_iter().take(HEADS_MAX).map(|frame| (frame, head(frame))).collect();
        let heads: Vec<(FrameId, Head)> = heads.into_iter().collect();
        HaveVector { named: true, ..self.vector(asker, listed, &heads) }
    }

    /// What a vector says; `None` if it counts by another roster than ours.
    pub fn read_have(&self, have: &HaveVector) -> Option<Have> {
        let robots: Vec<RobotId> = match &have.members {
            Members::Roster(hash) if *hash == self.roster_hash => self.members().map(|(robot, _)| robot).collect(),
            Members::Roster(_) => return None,
            Members::Listed(robots) => robots.clone(),
        };
        let robot = |place: u16| robots.get(usize::from(place)).copied();
        let mut heads = BTreeMap::new();
        for (place, epoch, head) in &have.heads {
            heads.insert(FrameId { robot: robot(*place)?, epoch: *epoch }, *head);
        }
        let (asker, named) = (robot(have.asker)?, have.named);
        Some(Have { asker, named, after: have.after, until: have.until, heads })
    }

    /// Logs of which the holder of `have` has more than we do, and up to where; `None` for those it knows are forked
    /// while we do not.
    pub fn ahead_of_us(&self, have: &Have) -> BTreeMap<FrameId, Option<u32>> {
        let ahead = |(frame, head): (FrameId, Head)| {
            // What we would not take is not asked for.
            if self.is_retired(frame) || self.is_full(frame.robot) {
                return None;
            }
            let ours = match self.slots.get(&frame) {
                Some(Slot::Forked(_)) => return None,
                Some(Slot::Log(log)) => log.durable(),
                None => 0,
            };
            let theirs = match head {
                Head::Forked => None,
                Head::Log { len, .. } if len > ours => Some(len),
                Head::Log { .. } => return None,
            };
            self.name_of(frame.robot).map(|_| (frame, theirs))
        };
        have.heads().filter_map(ahead).collect()
    }

    /// Durable entries of every log that has any; `None` for those in quarantine.
    pub fn lengths(&self) -> impl Iterator<Item = (FrameId, Option<u32>)> {
        self.durable_heads().map(|(frame, head)| (frame, head.map(|(len, _)| len)))
    }

    fn vector(&self, asker: RobotId, listed: bool, heads: &[(FrameId, Head)]) -> HaveVector {
        let robots: Vec<RobotId> = if listed {
            let mut robots: Vec<RobotId> = heads.iter().map(|(frame, _)| frame.robot).chain([asker]).collect();
            robots.sort_unstable();
            robots.dedup();
            robots
        } else {
            self.members().map(|(robot, _)| robot).collect()
        };
        // Everything held is of members, of whom there are at most 65,536.
        let place = |robot: RobotId| robots.binary_search(&robot).unwrap_or_default() as u16;
        HaveVector {
            asker: place(asker),
            named: false,
            after: None,
            until: None,
            heads: heads.iter().map(|(frame, head)| (place(frame.robot), frame.epoch, *head)).collect(),
            members: if listed { Members::Listed(robots) } else { Members::Roster(self.roster_hash) },
        }
    }

    /// Length and last hash of every log that has durable entries; `None` for those in quarantine.
    fn durable_heads(&self) -> impl Iterator<Item = (FrameId, Option<(u32, Hash)>)> {
        self.slots.iter().filter_map(|(frame, slot)| match slot {
            Slot::Forked(_) => Some((*frame, None)),
            Slot::Log(log) => {
                let last = log.durable_entries().last()?;
                Some((*frame, Some((log.durable(), last.hash))))
            }
        })
    }
}

fn head_of(head: Option<(u32, Hash)>, tagged: bool) -> Head {
    match head {
        None => Head::Forked,
        Some((len, hash)) => Head::Log { len, tag: tagged.then(|| Head::tag_of(&hash)) },
    }
}

//! What a robot says it holds: a root hash (sent often), and a have-vector (sent when roots differ) with one head per
//! log. A head is the number of entries held, without holes, and four bytes of the last one's hash: two histories of
//! one log show at first contact. A log known to be forked is named as such, so that the proof is not sent again.

use super::limits::{self, HEADS_MAX};
use crate::ids::{FrameId, Hash, RobotId};
use serde::{Deserialize, Serialize};

/// "This is the hash of all that I hold."
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HaveRoot {
    /// Who says so: a hint, not signed. A lie costs one useless question.
    #[serde(serialize_with = "super::json::id")]
    pub robot: RobotId,
    /// First bytes of the digest.
    #[serde(serialize_with = "super::json::tag")]
    pub root: [u8; 8],
    /// Durable entries held.
    pub count: u64,
    /// Rises with every announcement of one run.
    pub tick: u64,
}

/// Four bytes that stand for a log's last entry.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Head {
    /// The log's entries `0..len` are held.
    Log {
        /// At least 1.
        len: u32,
        /// First bytes of the hash of entry `len − 1`.
        tag: [u8; 4],
    },
    /// The log has two histories: quarantined, nothing of it is wanted.
    Forked,
}

impl Head {
    /// The tag of the last entry's hash.
    pub fn tag_of(hash: &Hash) -> [u8; 4] {
        [hash.0[0], hash.0[1], hash.0[2], hash.0[3]]
    }
}

/// "This is what I hold", for the logs after `after` up to and including `until` (all, where absent). Logs of that
/// range that are not named are not held at all.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct HaveVector {
    /// Exclusive start of the range.
    pub after: Option<FrameId>,
    /// Inclusive end of the range.
    pub until: Option<FrameId>,
    /// Heads in rising order of their frames, at most [`HEADS_MAX`].
    pub heads: Vec<(FrameId, Head)>,
}

impl HaveVector {
    /// Whether the vector speaks about this log.
    pub fn covers(&self, frame: FrameId) -> bool {
        self.after.is_none_or(|after| frame > after) && self.until.is_none_or(|until| frame <= until)
    }

    /// The head of one log, if named.
    pub fn head(&self, frame: FrameId) -> Option<Head> {
        let at = self.heads.binary_search_by_key(&frame, |(frame, _)| *frame).ok()?;
        Some(self.heads[at].1)
    }
}

/// A have-vector on the wire.
#[derive(Serialize, Deserialize)]
pub(super) struct RawHaveVector {
    after: Option<FrameId>,
    until: Option<FrameId>,
    #[serde(deserialize_with = "limits::list::<_, _, HEADS_MAX>")]
    heads: Vec<RawHead>,
}

/// `len` 0 says "forked", with a zero tag.
#[derive(Serialize, Deserialize)]
struct RawHead {
    frame: FrameId,
    len: u32,
    tag: [u8; 4],
}

impl RawHaveVector {
    pub fn of(have: &HaveVector) -> Self {
        let raw = |&(frame, head): &(FrameId, Head)| match head {
            Head::Log { len, tag } => RawHead { frame, len, tag },
            Head::Forked => RawHead { frame, len: 0, tag: [0; 4] },
        };
        Self { after: have.after, until: have.until, heads: have.heads.iter().map(raw).collect() }
    }

    /// `None` if frames are not rising, outside the range, or a forked head has a tag.
    pub fn parse(self) -> Option<HaveVector> {
        let mut have = HaveVector { after: self.after, until: self.until, heads: Vec::new() };
        for RawHead { frame, len, tag } in self.heads {
            let rising = have.heads.last().is_none_or(|(last, _)| *last < frame);
            if !rising || !have.covers(frame) || (len == 0 && tag != [0; 4]) {
                return None;
            }
            have.heads.push((frame, if len == 0 { Head::Forked } else { Head::Log { len, tag } }));
        }
        Some(have)
    }
}

//! What a robot says it holds (DESIGN §4): a root hash, sent often, and a have-vector with one head per log, sent when
//! roots differ.
//!
//! A head is the number of entries held, without holes. Because entries are chained by hash, an entry that does not
//! follow from the asker's last one shows a fork by itself; only where nothing follows is a hash needed to see it. So
//! the first vector between two neighbours, and any after an exchange that explained nothing, carries four bytes of
//! each last entry's hash; the others leave them out. A log known to be forked is named as such, so that the proof is
//! not sent again.
//!
//! On the wire robots are numbers: places in the roster, named by its hash, where both sides share it, else in a list
//! that comes along. Places and epochs are steps from the head before. A head then takes 3 to 5 bytes instead of 19.

use super::limits::{self, HEADS_MAX, MEMBERS_MAX};
use crate::ids::{FrameId, Hash, RobotId};
use serde::{Deserialize, Serialize};

/// "This is the hash of all that I hold."
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct HaveRoot {
    /// First bytes of the digest.
    #[serde(serialize_with = "super::json::tag")]
    pub root: [u8; 8],
    /// Places of logs that are settled (durable, or below a floor): a hint at who has more.
    pub count: u64,
}

/// What stands for a log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Head {
    /// The log's entries `0..len` are held; 0 only in a vector of named logs.
    Log {
        /// How many.
        len: u32,
        /// First bytes of the hash of entry `len − 1`, in tagged vectors.
        tag: Option<[u8; 4]>,
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

/// Whose places the numbers of a have-vector are.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Members {
    /// All members of the roster with this hash, in the order of their ids.
    Roster([u8; 4]),
    /// These, in the order of their ids.
    Listed(#[serde(deserialize_with = "limits::list::<_, _, MEMBERS_MAX>")] Vec<RobotId>),
}

/// A have-vector as it travels. The replica turns it into what it says about frames.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HaveVector {
    /// Whose places the numbers are.
    pub members: Members,
    /// Who asks: a hint, not signed. A lie costs one useless question.
    pub asker: u16,
    /// Only the logs named here are asked about. Else those of the whole range, and what is not named is not held.
    pub named: bool,
    /// Exclusive start of the range.
    pub after: Option<FrameId>,
    /// Inclusive end of the range.
    pub until: Option<FrameId>,
    /// Place of the robot, epoch, head: rising, at most [`HEADS_MAX`]; all tagged, or none.
    pub heads: Vec<(u16, u32, Head)>,
}

impl HaveVector {
    /// Whether the heads carry hashes.
    pub fn is_tagged(&self) -> bool {
        self.heads.iter().any(|(_, _, head)| matches!(head, Head::Log { tag: Some(_), .. }))
    }
}

/// A have-vector on the wire.
#[derive(Serialize, Deserialize)]
pub(super) struct RawHaveVector {
    members: Members,
    asker: u16,
    named: bool,
    after: Option<FrameId>,
    until: Option<FrameId>,
    #[serde(deserialize_with = "limits::list::<_, _, HEADS_MAX>")]
    heads: Vec<RawHead>,
    /// Empty, or one for each log that is not forked.
    #[serde(deserialize_with = "limits::list::<_, _, HEADS_MAX>")]
    tags: Vec<[u8; 4]>,
}

/// Steps of the robot's place and (signed) of the epoch; `code` 0 says "forked", `len + 1` otherwise.
#[derive(Serialize, Deserialize)]
struct RawHead {
    step: u16,
    epoch: i64,
    code: u64,
}

impl RawHaveVector {
    pub fn of(have: &HaveVector) -> Self {
        let mut last = (0, 0);
        let (mut heads, mut tags) = (Vec::with_capacity(have.heads.len()), Vec::new());
        for &(place, epoch, head) in &have.heads {
            let code = match head {
                Head::Forked => 0,
                Head::Log { len, tag } => {
                    tags.extend(tag);
                    u64::from(len) + 1
                }
            };
            let step = place.wrapping_sub(last.0); // Places that fall are refused by every receiver.
            heads.push(RawHead { step, epoch: i64::from(epoch) - i64::from(last.1), code });
            last = (place, epoch);
        }
        let HaveVector { members, asker, named, after, until, .. } = have.clone();
        Self { members, asker, named, after, until, heads, tags }
    }

    /// `None` if robots or heads are not rising, a place has no robot, or tags and logs do not pair.
    pub fn parse(self) -> Option<HaveVector> {
        let Self { members, asker, named, after, until, heads, tags } = self;
        let places = match &members {
            Members::Roster(_) => usize::from(u16::MAX) + 1,
            Members::Listed(robots) if robots.is_sorted_by(|a, b| a < b) => robots.len(),
            Members::Listed(_) => return None,
        };
        let logs = heads.iter().filter(|head| head.code > 0).count();
        if usize::from(asker) >= places || !(tags.is_empty() || tags.len() == logs) {
            return None;
        }
        let mut tags = tags.into_iter();
        let mut have = HaveVector { members, asker, named, after, until, heads: Vec::with_capacity(heads.len()) };
        let mut last = (0u16, 0u32);
        for RawHead { step, epoch, code } in heads {
            let place = last.0.checked_add(step)?;
            let epoch = u32::try_from(i64::from(last.1).checked_add(epoch)?).ok()?;
            let rising = have.heads.is_empty() || (place, epoch) > last;
            let head = match code.checked_sub(1) {
                None => Head::Forked,
                Some(len) => Head::Log { len: u32::try_from(len).ok()?, tag: tags.next() },
            };
            let nothing = matches!(head, Head::Log { len: 0, .. });
            if !rising || usize::from(place) >= places || (nothing && !named) {
                return None;
            }
            have.heads.push((place, epoch, head));
            last = (place, epoch);
        }
        Some(have)
    }
}

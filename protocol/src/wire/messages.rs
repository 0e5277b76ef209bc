//! Every message one robot can send another. [`Message::decode`] is the only way in: it applies the frame's checks, the
//! limits of each list, and the canonical-form check. Entries inside are carried as bytes and judged by the replica.
//! `serde::Serialize` is for people: JSON with ids in hexadecimal and facts spelled out.

use super::beacon::{Beacon, RawBeacon};
use super::entry::EntryBytes;
use super::frame::{self, FrameKind, WireError};
use super::have::{HaveRoot, HaveVector, RawHaveVector};
use super::life::{Life, Nonce};
use super::limits::{
    self, BLOB_LEN_MAX, ENTRIES_PER_DELTA_MAX, ENTRY_LEN_MAX, FORKS_PER_DELTA_MAX, MESSAGE_LEN_MAX, PROOF_MAX,
};
use crate::ids::{Hash, SubmapId};
use serde::{Deserialize, Serialize};

/// A message.
#[expect(clippy::large_enum_variant, reason = "messages are short-lived and never kept in numbers")]
#[derive(Clone, Debug, PartialEq, Serialize)]
#[serde(tag = "message", content = "body", rename_all = "snake_case")]
pub enum Message {
    /// Where a robot is now.
    Pose(#[serde(serialize_with = "super::json::beacon")] Beacon),
    /// New entries, at most [`ENTRIES_PER_DELTA_MAX`] and [`MESSAGE_LEN_MAX`] bytes.
    Facts(Vec<EntryBytes>),
    /// The hash of all that a robot holds.
    Have(HaveRoot),
    /// "Here is what I hold; what am I missing?"
    SyncRequest(#[serde(serialize_with = "super::json::have")] HaveVector),
    /// Some of what was missing.
    SyncReply(Delta),
    /// "Give me this piece of this blob."
    BlobRequest {
        /// Its address.
        #[serde(serialize_with = "super::json::id")]
        hash: Hash,
        /// First byte wanted.
        offset: u32,
        /// Bytes wanted at most; at least 1.
        len: u32,
    },
    /// A piece of a blob.
    BlobReply {
        /// Its address.
        #[serde(serialize_with = "super::json::id")]
        hash: Hash,
        /// Place of the first byte of `bytes`.
        offset: u32,
        /// Length of the whole blob; 0 if the sender does not have it.
        total: u32,
        /// The piece.
        #[serde(serialize_with = "super::json::length")]
        bytes: Vec<u8>,
        /// What [proves](super::slice) that the piece belongs there; nothing if it is the whole, or empty. With a proof the
        /// frame is of another kind.
        #[serde(serialize_with = "super::json::count", skip_serializing_if = "Vec::is_empty")]
        proof: Vec<[u8; 32]>,
    },
    /// "I think these two submaps overlap; please look."
    AlignRequest {
        /// The submap whose anchor frame is the target.
        #[serde(serialize_with = "super::json::id")]
        i: SubmapId,
        /// The submap that is mapped into `i`.
        #[serde(serialize_with = "super::json::id")]
        j: SubmapId,
    },
    /// What became of that request.
    AlignReply {
        /// The answer.
        status: AlignStatus,
    },
    /// "Are you there now?"
    LifeRequest {
        /// To be signed.
        #[serde(serialize_with = "super::json::nonce")]
        nonce: Nonce,
    },
    /// A signed yes.
    LifeReply(#[serde(serialize_with = "super::json::life")] Life),
}

/// Entries that a have-vector lacks.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Delta {
    /// Missing entries in canonical order: by frame, then place.
    #[serde(deserialize_with = "limits::list::<_, _, ENTRIES_PER_DELTA_MAX>")]
    pub entries: Vec<EntryBytes>,
    /// For logs with two histories that the asker does not know as such: two entries that prove it.
    #[serde(deserialize_with = "limits::list::<_, _, FORKS_PER_DELTA_MAX>")]
    pub forks: Vec<[EntryBytes; 2]>,
    /// The answer was cut to its budget: ask again.
    pub more: bool,
}

/// What became of a request to align. Append-only.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum AlignStatus {
    /// It will be looked at.
    Accepted,
    /// Too much to do: ask again later.
    Busy,
    /// One of the submaps is not known here (yet).
    Unknown,
    /// An alignment or verdict for the pair exists; it will come as a fact.
    Done,
    /// Neither submap is the receiver's.
    NotMine,
}

#[derive(Serialize, Deserialize)]
struct RawFacts(#[serde(deserialize_with = "limits::list::<_, _, ENTRIES_PER_DELTA_MAX>")] Vec<EntryBytes>);

#[derive(Serialize, Deserialize)]
struct RawBlobRequest {
    hash: Hash,
    offset: u32,
    len: u32,
}

#[derive(Serialize, Deserialize)]
struct RawBlobReply {
    hash: Hash,
    offset: u32,
    total: u32,
    #[serde(serialize_with = "limits::as_bytes", deserialize_with = "limits::bytes::<_, BLOB_LEN_MAX>")]
    bytes: Vec<u8>,
}

#[derive(Serialize, Deserialize)]
struct RawBlobSlice {
    piece: RawBlobReply,
    #[serde(deserialize_with = "limits::list::<_, _, PROOF_MAX>")]
    proof: Vec<[u8; 32]>,
}

impl Message {
    /// The framed bytes. A message over its limits encodes too, and is refused by every receiver;
    /// [`Message::facts`] and the replica's deltas stay within them.
    pub fn encode(&self) -> Vec<u8> {
        let kind = self.frame_kind();
        match self {
            Self::Pose(beacon) => frame::seal(kind, beacon.raw()),
            Self::Facts(entries) => frame::seal(kind, entries),
            Self::Have(root) => frame::seal(kind, root),
            Self::SyncRequest(have) => frame::seal(kind, &RawHaveVector::of(have)),
            Self::SyncReply(delta) => frame::seal(kind, delta),
            Self::BlobRequest { hash, offset, len } => {
                frame::seal(kind, &RawBlobRequest { hash: *hash, offset: *offset, len: *len })
            }
            Self::BlobReply { hash, offset, total, bytes, proof } => {
                let piece = RawBlobReply { hash: *hash, offset: *offset, total: *total, bytes: bytes.clone() };
                match kind {
                    FrameKind::BlobReply => frame::seal(kind, &piece),
                    _ => frame::seal(kind, &RawBlobSlice { piece, proof: proof.clone() }),
                }
            }
            Self::AlignRequest { i, j } => frame::seal(kind, &(i, j)),
            Self::AlignReply { status } => frame::seal(kind, status),
            Self::LifeRequest { nonce } => frame::seal(kind, nonce),
            Self::LifeReply(life) => frame::seal(kind, life),
        }
    }

    /// Decodes a frame.
    ///
    /// # Errors
    /// [`WireError`], naming the first check that failed.
    pub fn decode(bytes: &[u8]) -> Result<Self, WireError> {
        let (kind, body) = frame::open(bytes)?;
        let message = Self::parse(kind, body)?;
        if message.encode() == bytes { Ok(message) } else { Err(WireError::NonCanonical { kind }) }
    }

    fn parse(kind: FrameKind, body: &[u8]) -> Result<Self, WireError> {
        let require = |good: bool, field, mend| if good { Ok(()) } else { Err(WireError::Value { kind, field, mend }) };
        Ok(match kind {
            FrameKind::Pose => {
                let raw: RawBeacon = frame::parse_body(kind, body)?;
                Self::Pose(raw.parse()?.ok_or(WireError::NonCanonical { kind })?)
            }
            FrameKind::Facts => Self::Facts(frame::parse_body::<RawFacts>(kind, body)?.0),
            FrameKind::Have => Self::Have(frame::parse_body(kind, body)?),
            FrameKind::SyncRequest => {
                let have = frame::parse_body::<RawHaveVector>(kind, body)?.parse();
                let wrong = WireError::Value { kind, field: "heads", mend: "must rise and lie in the stated range" };
                Self::SyncRequest(have.ok_or(wrong)?)
            }
            FrameKind::SyncReply => Self::SyncReply(frame::parse_body(kind, body)?),
            FrameKind::BlobRequest => {
                let RawBlobRequest { hash, offset, len } = frame::parse_body(kind, body)?;
                require(len > 0, "len", "must be at least 1")?;
                Self::BlobRequest { hash, offset, len }
            }
            FrameKind::BlobReply | FrameKind::BlobSlice => {
                let RawBlobSlice { piece, proof } = match kind {
                    FrameKind::BlobReply => RawBlobSlice { piece: frame::parse_body(kind, body)?, proof: Vec::new() },
                    _ => frame::parse_body(kind, body)?,
                };
                let RawBlobReply { hash, offset, total, bytes } = piece;
                require(total as usize <= BLOB_LEN_MAX, "total", "must be at most 65536")?;
                let end = u64::from(offset) + bytes.len() as u64;
                require(end <= u64::from(total), "bytes", "must lie inside the blob")?;
                Self::BlobReply { hash, offset, total, bytes, proof }
            }
            FrameKind::AlignRequest => {
                let (i, j) = frame::parse_body(kind, body)?;
                require(i != j, "j", "must be another submap than i")?;
                Self::AlignRequest { i, j }
            }
            FrameKind::AlignReply => Self::AlignReply { status: frame::parse_body(kind, body)? },
            FrameKind::LifeRequest => Self::LifeRequest { nonce: frame::parse_body(kind, body)? },
            FrameKind::LifeReply => Self::LifeReply(frame::parse_body(kind, body)?),
        })
    }

    /// Cuts entries into as few `Facts` messages as their limits allow, in order. Entries longer than
    /// [`ENTRY_LEN_MAX`] are left out: nobody would take them.
    pub fn facts(entries: impl IntoIterator<Item = Vec<u8>>) -> Vec<Self> {
        let mut messages = Vec::new();
        let (mut batch, mut len) = (Vec::new(), 0);
        for entry in entries.into_iter().filter(|entry| entry.len() <= ENTRY_LEN_MAX) {
            let next = carried_len(entry.len());
            if len + next > MESSAGE_LEN_MAX || batch.len() == ENTRIES_PER_DELTA_MAX {
                messages.push(Self::Facts(core::mem::take(&mut batch)));
                len = 0;
            }
            len += next;
            batch.push(EntryBytes(entry));
        }
        if !batch.is_empty() {
            messages.push(Self::Facts(batch));
        }
        messages
    }

    /// A short name for byte counters: pose, facts, have, sync, blob, align or life.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Pose(_) => "pose",
            Self::Facts(_) => "facts",
            Self::Have(_) => "have",
            Self::SyncRequest(_) | Self::SyncReply(_) => "sync",
            Self::BlobRequest { .. } | Self::BlobReply { .. } => "blob",
            Self::AlignRequest { .. } | Self::AlignReply { .. } => "align",
            Self::LifeRequest { .. } | Self::LifeReply(_) => "life",
        }
    }

    fn frame_kind(&self) -> FrameKind {
        match self {
            Self::Pose(_) => FrameKind::Pose,
            Self::Facts(_) => FrameKind::Facts,
            Self::Have(_) => FrameKind::Have,
            Self::SyncRequest(_) => FrameKind::SyncRequest,
            Self::SyncReply(_) => FrameKind::SyncReply,
            Self::BlobRequest { .. } => FrameKind::BlobRequest,
            Self::BlobReply { proof, .. } if proof.is_empty() => FrameKind::BlobReply,
            Self::BlobReply { .. } => FrameKind::BlobSlice,
            Self::AlignRequest { .. } => FrameKind::AlignRequest,
            Self::AlignReply { .. } => FrameKind::AlignReply,
            Self::LifeRequest { .. } => FrameKind::LifeRequest,
            Self::LifeReply(_) => FrameKind::LifeReply,
        }
    }
}

/// Bytes that an entry of `len` bytes takes in a message: itself and its length.
pub(crate) fn carried_len(len: usize) -> usize {
    len + if len < 128 { 1 } else { 2 }
}

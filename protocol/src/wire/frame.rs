//! The frame around every message: magic (2 bytes), version, kind, postcard body. Decoding is strict: the length is
//! checked against the kind's limit first, the body must fill the frame exactly, and what was decoded must encode to
//! the very bytes received, so that each message has one form.

use super::limits::{BEACON_LEN_MAX, HAVE_LEN_MAX, HEADER_LEN, MESSAGE_LEN_MAX, MESSAGE_OVERHEAD_MAX, SMALL_LEN_MAX};
use super::pose::PoseError;
use crate::geometry::CovarianceError;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// First two bytes of every frame.
pub const MAGIC: [u8; 2] = *b"mg";
/// The version this code speaks.
pub const VERSION: u8 = 1;

/// What a frame holds. Numbers are append-only.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum FrameKind {
    /// A live pose beacon.
    Pose = 1,
    /// New entries.
    Facts = 2,
    /// A root announcement.
    Have = 3,
    /// A have-vector: "what am I missing?"
    SyncRequest = 4,
    /// Missing entries.
    SyncReply = 5,
    /// "Give me this piece of this blob."
    BlobRequest = 6,
    /// A piece of a blob.
    BlobReply = 7,
    /// "Please look at this pair of submaps."
    AlignRequest = 8,
    /// What became of it.
    AlignReply = 9,
    /// A piece of a blob that proves itself.
    BlobSlice = 10,
    /// "Are you there now?"
    LifeRequest = 11,
    /// A signed yes.
    LifeReply = 12,
}

impl FrameKind {
    /// Every kind, in order of its number.
    pub const ALL: [Self; 12] = [
        Self::Pose,
        Self::Facts,
        Self::Have,
        Self::SyncRequest,
        Self::SyncReply,
        Self::BlobRequest,
        Self::BlobReply,
        Self::AlignRequest,
        Self::AlignReply,
        Self::BlobSlice,
        Self::LifeRequest,
        Self::LifeReply,
    ];

    fn of(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| *kind as u8 == number)
    }

    /// Longest frame of this kind, in bytes.
    pub fn len_max(self) -> usize {
        match self {
            Self::Pose | Self::LifeReply => BEACON_LEN_MAX,
            Self::Have => HAVE_LEN_MAX,
            Self::BlobRequest | Self::AlignRequest | Self::AlignReply | Self::LifeRequest => SMALL_LEN_MAX,
            Self::Facts | Self::SyncRequest | Self::SyncReply | Self::BlobReply | Self::BlobSlice => {
                MESSAGE_LEN_MAX + MESSAGE_OVERHEAD_MAX
            }
        }
    }
}

/// Why bytes are no message. Decoding changes no state.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum WireError {
    /// Shorter than a frame's header.
    #[error("{len} bytes are too short for a frame; it begins with {HEADER_LEN} bytes of header")]
    TooShort {
        /// Length received.
        len: usize,
    },
    /// Not one of our frames.
    #[error("frame begins with {got:02x?} instead of {MAGIC:02x?}; something else publishes on this key")]
    Magic {
        /// The first two bytes.
        got: [u8; 2],
    },
    /// A frame of another version.
    #[error("frame has version {got}, this agent speaks {VERSION}; update the older of the two robots")]
    Version {
        /// The version byte.
        got: u8,
    },
    /// A kind this version does not know.
    #[error("frame has unknown kind {got}")]
    Kind {
        /// The kind byte.
        got: u8,
    },
    /// Longer than its kind allows.
    #[error("{kind:?} frame of {len} bytes is longer than {max}")]
    TooLong {
        /// Its kind.
        kind: FrameKind,
        /// Length received.
        len: usize,
        /// The limit.
        max: usize,
    },
    /// The body is truncated, over an inner limit, or no value of its type.
    #[error("{kind:?} frame has a malformed body: {why}")]
    Body {
        /// Its kind.
        kind: FrameKind,
        /// What the decoder said.
        why: postcard::Error,
    },
    /// Bytes after the body.
    #[error("{kind:?} frame has {rest} bytes after its body")]
    Trailing {
        /// Its kind.
        kind: FrameKind,
        /// How many.
        rest: usize,
    },
    /// The same content has another, canonical encoding.
    #[error("{kind:?} frame is not canonically encoded")]
    NonCanonical {
        /// Its kind.
        kind: FrameKind,
    },
    /// A value that its type cannot hold.
    #[error("{kind:?} frame: {field} {mend}")]
    Value {
        /// Its kind.
        kind: FrameKind,
        /// Which field.
        field: &'static str,
        /// What it should be.
        mend: &'static str,
    },
    /// A beacon's pose is no pose.
    #[error("pose beacon: {0}")]
    Pose(#[from] PoseError),
    /// A beacon's covariance is no covariance.
    #[error("pose beacon: {0}")]
    Covariance(#[from] CovarianceError),
}

impl WireError {
    /// A short name for counters.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::TooShort { .. } => "too_short",
            Self::Magic { .. } => "magic",
            Self::Version { .. } => "version",
            Self::Kind { .. } => "kind",
            Self::TooLong { .. } => "too_long",
            Self::Body { .. } => "malformed",
            Self::Trailing { .. } => "trailing",
            Self::NonCanonical { .. } => "non_canonical",
            Self::Value { .. } => "value",
            Self::Pose(_) => "pose",
            Self::Covariance(_) => "covariance",
        }
    }
}

/// A frame of `kind` around `body`.
pub(super) fn seal(kind: FrameKind, body: &impl Serialize) -> Vec<u8> {
    let mut bytes = vec![MAGIC[0], MAGIC[1], VERSION, kind as u8];
    bytes.extend_from_slice(&to_bytes(body));
    bytes
}

/// Checks the header and the length; gives the kind and the body's bytes.
pub(super) fn open(bytes: &[u8]) -> Result<(FrameKind, &[u8]), WireError> {
    let Some((&[m0, m1, version, kind], body)) = bytes.split_first_chunk::<HEADER_LEN>() else {
        return Err(WireError::TooShort { len: bytes.len() });
    };
    if [m0, m1] != MAGIC {
        return Err(WireError::Magic { got: [m0, m1] });
    }
    if version != VERSION {
        return Err(WireError::Version { got: version });
    }
    let kind = FrameKind::of(kind).ok_or(WireError::Kind { got: kind })?;
    if bytes.len() > kind.len_max() {
        return Err(WireError::TooLong { kind, len: bytes.len(), max: kind.len_max() });
    }
    Ok((kind, body))
}

/// Decodes a body that must fill `bytes`.
pub(super) fn parse_body<'a, T: Deserialize<'a>>(kind: FrameKind, bytes: &'a [u8]) -> Result<T, WireError> {
    let (body, rest) = postcard::take_from_bytes(bytes).map_err(|why| WireError::Body { kind, why })?;
    if rest.is_empty() { Ok(body) } else { Err(WireError::Trailing { kind, rest: rest.len() }) }
}

/// Room for most facts and frames, so that writing one allocates once.
const USUAL_LEN: usize = 256;

/// The postcard encoding of plain wire data.
pub(super) fn to_bytes(value: &impl Serialize) -> Vec<u8> {
    #[expect(
        clippy::expect_used,
        reason = "postcard fails only for sequences of unknown length, which no wire type has"
    )]
    postcard::to_extend(value, Vec::with_capacity(USUAL_LEN)).expect("wire types have known lengths")
}

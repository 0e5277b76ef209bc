//! A log entry: one signed fact in its place. An entry names its predecessor by BLAKE3 hash (all 32 bytes: the hash of
//! a log's last entry then stands for the whole log, and so does that entry's signature), so a writer cannot tell two
//! stories without leaving a proof. The payload of an unknown kind is carried as it is.
//!
//! Canonical bytes = postcard body, then the 64-byte ed25519 signature over `SIGNING_CONTEXT ‖ body`. The hash of an
//! entry is that of all its canonical bytes.

use super::fact::Fact;
use super::frame::to_bytes;
use super::limits::{self, ENTRY_LEN_MAX, PAYLOAD_LEN_MAX};
use super::payload::FactError;
use crate::ids::{EntryId, FrameId, Hash, Name, RobotId};
use core::fmt;
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use thiserror::Error;

/// Version of the entry format.
pub const ENTRY_VERSION: u8 = 1;
/// Length of an entry's signature.
const SIGNATURE_LEN: usize = 64;
/// Keeps a signature over an entry from standing for anything else.
const SIGNING_CONTEXT: &[u8] = b"merganser entry 1\n";

/// The first eight bytes of the BLAKE3 hash of a swarm's name.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SwarmTag(pub [u8; 8]);

impl SwarmTag {
    /// The tag of the swarm with this name.
    pub fn of(swarm: &Name) -> Self {
        let hash = Hash::of(swarm.as_str().as_bytes()).0;
        Self(core::array::from_fn(|i| hash[i]))
    }
}

impl fmt::Debug for SwarmTag {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// A decoded entry. Decoding checks form and limits; who signed it is checked by [`Entry::verify`].
#[derive(Clone, PartialEq, Eq)]
pub struct Entry {
    body: Body,
    signature: [u8; SIGNATURE_LEN],
}

#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct Body {
    version: u8,
    swarm: SwarmTag,
    robot: RobotId,
    epoch: u32,
    seq: u32,
    kind: u8,
    floor: u32,
    previous: Hash,
    #[serde(serialize_with = "limits::as_bytes", deserialize_with = "limits::bytes::<_, PAYLOAD_LEN_MAX>")]
    payload: Vec<u8>,
}

/// Why bytes are no entry. No state changes.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum EntryError {
    /// Longer than [`ENTRY_LEN_MAX`].
    #[error("entry of {0} bytes is longer than {ENTRY_LEN_MAX}")]
    TooLong(usize),
    /// Too short to hold a signature.
    #[error("entry of {0} bytes is too short")]
    TooShort(usize),
    /// Of another version of the format.
    #[error("entry has version {0}, this agent reads {ENTRY_VERSION}; update the older of the two robots")]
    Version(u8),
    /// Truncated, over an inner limit, or no value of its type.
    #[error("entry is malformed: {0}")]
    Malformed(postcard::Error),
    /// Bytes between the body and the signature.
    #[error("entry has {0} bytes too many")]
    Trailing(usize),
    /// The same content has another, canonical encoding.
    #[error("entry is not canonically encoded")]
    NonCanonical,
    /// The floor lies above the entry itself.
    #[error("entry {seq} states a floor of {floor}, above itself")]
    Floor {
        /// The entry's place.
        seq: u32,
        /// The floor it states.
        floor: u32,
    },
    /// The first entry of a log names a predecessor.
    #[error("the first entry of a log names a predecessor")]
    First,
    /// Not signed by the key of its origin.
    #[error("entry is not signed by its origin")]
    Signature,
}

impl EntryError {
    /// A short name for counters.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::TooLong(_) => "entry_too_long",
            Self::TooShort(_) => "entry_too_short",
            Self::Version(_) => "entry_version",
            Self::Malformed(_) => "entry_malformed",
            Self::Trailing(_) => "entry_trailing",
            Self::NonCanonical => "entry_non_canonical",
            Self::Floor { .. } => "entry_floor",
            Self::First => "entry_first",
            Self::Signature => "entry_signature",
        }
    }
}

/// What an entry states besides its signature.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct EntryContent {
    /// Which swarm.
    pub swarm: SwarmTag,
    /// Its place.
    pub id: EntryId,
    /// What the payload is ([`Fact::kind`]).
    pub kind: u8,
    /// Entries of this log below this place may be forgotten; never falls along a log.
    pub floor: u32,
    /// Hash of the entry before it; zero for the first.
    pub previous: Hash,
    /// The fact, at most [`PAYLOAD_LEN_MAX`] bytes.
    pub payload: Vec<u8>,
}

impl Entry {
    /// Signs an entry.
    ///
    /// # Errors
    /// [`EntryError`] if the content is over a limit or contradicts itself.
    pub fn sign(key: &SigningKey, content: EntryContent) -> Result<Self, EntryError> {
        let EntryContent { swarm, id, kind, floor, previous, payload } = content;
        if payload.len() > PAYLOAD_LEN_MAX {
            return Err(EntryError::TooLong(payload.len()));
        }
        let FrameId { robot, epoch } = id.frame;
        let body = Body { version: ENTRY_VERSION, swarm, robot, epoch, seq: id.seq, kind, floor, previous, payload };
        body.check()?;
        let signature = key.sign(&body.signed_bytes()).to_bytes();
        Ok(Self { body, signature })
    }

    /// Decodes canonical bytes.
    ///
    /// # Errors
    /// [`EntryError`] for anything but the canonical bytes of an entry; the signature is not looked at.
    pub fn decode(bytes: &[u8]) -> Result<Self, EntryError> {
        if bytes.len() > ENTRY_LEN_MAX {
            return Err(EntryError::TooLong(bytes.len()));
        }
        let (body_bytes, signature) =
            bytes.split_last_chunk::<SIGNATURE_LEN>().ok_or(EntryError::TooShort(bytes.len()))?;
        match body_bytes.first() {
            None => return Err(EntryError::TooShort(bytes.len())),
            Some(&version) if version != ENTRY_VERSION => return Err(EntryError::Version(version)),
            Some(_) => {}
        }
        let (body, rest): (Body, _) = postcard::take_from_bytes(body_bytes).map_err(EntryError::Malformed)?;
        if !rest.is_empty() {
            return Err(EntryError::Trailing(rest.len()));
        }
        if to_bytes(&body) != body_bytes {
            return Err(EntryError::NonCanonical);
        }
        body.check()?;
        Ok(Self { body, signature: *signature })
    }

    /// The canonical bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = to_bytes(&self.body);
        bytes.extend_from_slice(&self.signature);
        bytes
    }

    /// Checks that `key`, the key of [`Entry::id`]'s robot, signed this entry.
    ///
    /// # Errors
    /// [`EntryError::Signature`].
    pub fn verify(&self, key: &VerifyingKey) -> Result<(), EntryError> {
        key.verify_strict(&self.body.signed_bytes(), &Signature::from_bytes(&self.signature))
            .map_err(|_| EntryError::Signature)
    }

    /// BLAKE3 of the canonical bytes.
    pub fn hash(&self) -> Hash {
        Hash::of(&self.encode())
    }

    /// Its place.
    pub fn id(&self) -> EntryId {
        EntryId { frame: FrameId { robot: self.body.robot, epoch: self.body.epoch }, seq: self.body.seq }
    }

    /// Its swarm.
    pub fn swarm(&self) -> SwarmTag {
        self.body.swarm
    }

    /// What the payload is.
    pub fn kind(&self) -> u8 {
        self.body.kind
    }

    /// The writer's floor at this entry.
    pub fn floor(&self) -> u32 {
        self.body.floor
    }

    /// Hash of the entry before it.
    pub fn previous(&self) -> Hash {
        self.body.previous
    }

    /// The payload as it came.
    pub fn payload(&self) -> &[u8] {
        &self.body.payload
    }

    /// The fact in the payload.
    ///
    /// # Errors
    /// [`FactError`]; of unknown kinds, [`FactError::UnknownKind`].
    pub fn fact(&self) -> Result<Fact, FactError> {
        Fact::from_payload(self.body.kind, &self.body.payload)
    }
}

impl Body {
    fn check(&self) -> Result<(), EntryError> {
        if self.floor > self.seq {
            return Err(EntryError::Floor { seq: self.seq, floor: self.floor });
        }
        if self.seq == 0 && self.previous != Hash::default() {
            return Err(EntryError::First);
        }
        Ok(())
    }

    fn signed_bytes(&self) -> Vec<u8> {
        let mut bytes = SIGNING_CONTEXT.to_vec();
        bytes.extend_from_slice(&to_bytes(self));
        bytes
    }
}

impl fmt::Debug for Entry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let hash = self.hash();
        f.debug_struct("Entry")
            .field("id", &self.id())
            .field("kind", &Fact::kind_name(self.kind()))
            .field("floor", &self.floor())
            .field("previous", &self.previous())
            .field("hash", &hash)
            .field("fact", &self.fact())
            .finish()
    }
}

/// An entry's canonical bytes inside a message: bounded, not yet looked at.
#[derive(Clone, PartialEq, Eq)]
pub struct EntryBytes(pub Vec<u8>);

impl fmt::Debug for EntryBytes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match Entry::decode(&self.0) {
            Ok(entry) => entry.fmt(f),
            Err(error) => write!(f, "EntryBytes({} bytes: {error})", self.0.len()),
        }
    }
}

impl Serialize for EntryBytes {
    fn serialize<S: Serializer>(&self, s: S) -> Result<S::Ok, S::Error> {
        if s.is_human_readable() { super::json::entry(&self.0).serialize(s) } else { s.serialize_bytes(&self.0) }
    }
}

impl<'de> Deserialize<'de> for EntryBytes {
    fn deserialize<D: Deserializer<'de>>(d: D) -> Result<Self, D::Error> {
        limits::bytes::<D, ENTRY_LEN_MAX>(d).map(Self)
    }
}

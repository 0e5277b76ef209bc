//! Who and what: names, robots, frames, submaps, entries and blobs. All are small, ordered values, so that every map
//! keyed by them iterates in one canonical order on every robot.

use core::fmt;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Longest [`Name`], in bytes.
pub const NAME_LEN_MAX: usize = 32;

/// A swarm's or a robot's name: 1 to 32 characters of `[a-z0-9_-]`, so that it can stand in a Zenoh key.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub struct Name(String);

/// A string that cannot be a [`Name`].
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{0:?} is not a name: use 1 to {NAME_LEN_MAX} characters of a-z, 0-9, '_' and '-'")]
pub struct NameError(pub String);

impl Name {
    /// Parses a name.
    ///
    /// # Errors
    /// [`NameError`] if the text is empty, longer than [`NAME_LEN_MAX`], or has another character.
    pub fn new(text: impl Into<String>) -> Result<Self, NameError> {
        let text = text.into();
        let good = |b: u8| b.is_ascii_lowercase() || b.is_ascii_digit() || b == b'_' || b == b'-';
        if text.is_empty() || text.len() > NAME_LEN_MAX || !text.bytes().all(good) {
            return Err(NameError(text.chars().take(2 * NAME_LEN_MAX).collect()));
        }
        Ok(Self(text))
    }

    /// The name as text.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl TryFrom<String> for Name {
    type Error = NameError;
    fn try_from(text: String) -> Result<Self, NameError> {
        Self::new(text)
    }
}

impl From<Name> for String {
    fn from(name: Name) -> Self {
        name.0
    }
}

impl fmt::Display for Name {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}

/// A robot: the first eight bytes of the BLAKE3 hash of its ed25519 public key.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct RobotId(pub [u8; 8]);

impl RobotId {
    /// The robot that owns this ed25519 public key.
    pub fn of_key(public_key: &[u8; 32]) -> Self {
        let hash = blake3::hash(public_key);
        let mut id = [0; 8];
        id.copy_from_slice(&hash.as_bytes()[..8]);
        Self(id)
    }
}

impl fmt::Display for RobotId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for RobotId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "r:{self}")
    }
}

/// A local map frame: one robot between two restarts of its SLAM (or losses of its store).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct FrameId {
    /// The robot whose SLAM defines the frame.
    pub robot: RobotId,
    /// Which of that robot's frames; rises, never falls.
    pub epoch: u32,
}

impl fmt::Display for FrameId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}/{}", self.robot, self.epoch)
    }
}

impl fmt::Debug for FrameId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A submap: the `index`-th stretch of keyframes of one frame. Its anchor is a node of the joint estimate.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct SubmapId {
    /// The frame it belongs to.
    pub frame: FrameId,
    /// Position along that frame's trajectory, from 0.
    pub index: u32,
}

impl fmt::Display for SubmapId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}#{}", self.frame, self.index)
    }
}

impl fmt::Debug for SubmapId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A log entry: the `seq`-th that one robot wrote in one epoch.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct EntryId {
    /// Whose log, and which epoch of it.
    pub frame: FrameId,
    /// Position in the log, from 0, without holes.
    pub seq: u32,
}

impl fmt::Display for EntryId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.frame, self.seq)
    }
}

impl fmt::Debug for EntryId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

/// A BLAKE3 hash: of a blob (its address), an entry, or a set.
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct Hash(pub [u8; 32]);

impl Hash {
    /// The hash of `bytes`.
    pub fn of(bytes: &[u8]) -> Self {
        Self(*blake3::hash(bytes).as_bytes())
    }
}

impl fmt::Display for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl fmt::Debug for Hash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0[..4].iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_checked_on_both_sides_of_each_limit() {
        assert!(Name::new("a").is_ok());
        assert!(Name::new("a".repeat(NAME_LEN_MAX)).is_ok());
        assert!(Name::new("a".repeat(NAME_LEN_MAX + 1)).is_err());
        for bad in ["", "A", "a/b", "a*", "é", "a b"] {
            assert!(Name::new(bad).is_err(), "{bad:?}");
        }
    }
}

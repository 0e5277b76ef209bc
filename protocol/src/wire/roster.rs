//! The roster as a statement of the swarm's own key: who is a member, who may look on, and whose word counts no more.
//! The key is used on a computer of the operator's, off the robots; its public half is all that they know of it.
//!
//! A [`Roster`] is parsed once: what decodes is signed by the key that it names, in its one form, and contradicts itself
//! nowhere. Each statement is whole, so of two the later replaces the other ([`Roster::supersedes`]): the one with the
//! higher version, and of two with one version the one with the greater hash. That order is total, so robots that heard
//! of the same statements hold the same one, in whatever order they came. Two statements of one version are told as a
//! fork of the swarm's key ([`Roster::is_fork_of`]): two operators signed, or the key is stolen.
//!
//! Canonical bytes = postcard body, then the 64-byte ed25519 signature over `SIGNING_CONTEXT ‖ body`.

use super::frame::to_bytes;
use super::limits::{
    self, KEPT_EPOCHS_MAX, ROSTER_LEN_MAX, ROSTER_MEMBERS_MAX, ROSTER_OBSERVERS_MAX, ROSTER_REVOKED_MAX,
};
use crate::ids::{Hash, Name, RobotId};
use core::num::NonZero;
use ed25519_dalek::{Signature, Signer, SigningKey, VerifyingKey};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use thiserror::Error;

/// Version of the statement's form.
const FORMAT: u8 = 1;
/// Length of the signature.
const SIGNATURE_LEN: usize = 64;
/// Keeps a signature over a roster from standing for anything else.
const SIGNING_CONTEXT: &[u8] = b"merganser roster 1\n";

/// An ed25519 public key.
pub type Key = [u8; 32];

/// Entries of a log that stay, by epoch: those below this place.
pub type Kept = BTreeMap<u32, NonZero<u32>>;

/// A member's keys.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Member {
    /// The key that it has from now on.
    pub key: Key,
    /// The one that it had before, whose word counts until a later statement leaves it out.
    pub old: Option<Key>,
}

/// A key whose word counts no more.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Revoked {
    /// Whose it was.
    pub name: Name,
    /// What stays of what it wrote, frozen; nothing if this is empty.
    pub kept: Kept,
}

/// What a roster says.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RosterContent {
    /// The swarm.
    pub swarm: Name,
    /// Rises with each statement.
    pub version: NonZero<u64>,
    /// Robots, by name.
    pub members: BTreeMap<Name, Member>,
    /// Who may look on, by name.
    pub observers: BTreeMap<Name, Key>,
    /// Keys that count no more.
    pub revoked: BTreeMap<Key, Revoked>,
}

/// A signed [`RosterContent`], sound in itself. See the [module](self).
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Roster {
    content: RosterContent,
    swarm_key: Key,
    signature: [u8; SIGNATURE_LEN],
    hash: Hash,
}

/// Which statement it is. The greater one counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
pub struct RosterHead {
    /// Its version.
    pub version: u64,
    /// BLAKE3 of its canonical bytes.
    #[serde(serialize_with = "super::json::id")]
    pub hash: Hash,
}

/// A robot whose facts count.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Listed {
    /// Its id.
    pub robot: RobotId,
    /// Its name.
    pub name: Name,
    /// Its key.
    pub key: Key,
    /// If its key was revoked: what stays of what it wrote.
    pub frozen: Option<Kept>,
}

/// Why something is no roster.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum StatementError {
    /// Longer than [`ROSTER_LEN_MAX`].
    #[error(
        "the roster has {0} bytes; at most {ROSTER_LEN_MAX} travel: leave out old keys and what is kept of revoked ones"
    )]
    TooLong(usize),
    /// Too short to hold a signature.
    #[error("{0} bytes are too short for a roster; take a whole copy of the file")]
    TooShort(usize),
    /// Of another version of the form.
    #[error("the roster has form {0}, this program reads {FORMAT}; update the older of the two")]
    Format(u8),
    /// Truncated, over an inner limit, or no value of its type.
    #[error("the roster is malformed ({0}); take a whole copy of the file")]
    Malformed(postcard::Error),
    /// Bytes between the body and the signature.
    #[error("the roster has {0} bytes too many")]
    Trailing(usize),
    /// The same content has another, canonical encoding.
    #[error("the roster is not canonically encoded")]
    NonCanonical,
    /// Not signed by the key that it names.
    #[error("the roster is not signed by the swarm key that it names")]
    Signature,
    /// More of something than fits.
    #[error("the roster has {count} {what}; at most {max} fit")]
    TooMany {
        /// Of what.
        what: &'static str,
        /// How many.
        count: usize,
        /// The limit.
        max: usize,
    },
    /// The swarm's own key, which signs rosters and stays off the robots.
    #[error("the key of {0} is the swarm's own, which no robot or observer may hold; make another by `merganser keys`")]
    OwnKey(Name),
    /// Not an ed25519 public key, or a weak one.
    #[error("the key of {0} is not a usable ed25519 public key; take the line that `merganser keys generate` printed")]
    Key(Name),
    /// One key under two names, or twice under one.
    #[error(
        "{0} and {1} have the same key; every robot and observer needs its own, and a revoked one is not used again"
    )]
    KeyTwice(Name, Name),
    /// One name for a robot and an observer.
    #[error("{0} is the name of a robot and of an observer; choose another for one of them")]
    NameTwice(Name),
    /// Of another swarm, by name.
    #[error("the roster is of the swarm {is}, not of {wanted}")]
    Swarm {
        /// The roster's.
        is: Name,
        /// The one that is wanted.
        wanted: Name,
    },
    /// Of another swarm that has the same name.
    #[error("the roster is of another swarm with the name {swarm}: its key is {is}, not {wanted}", is = Hash(*.is), wanted = Hash(*.wanted))]
    SwarmKey {
        /// The swarm.
        swarm: Name,
        /// The roster's key.
        is: Key,
        /// The one that is wanted.
        wanted: Key,
    },
}

impl StatementError {
    /// A short name for counters.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::TooLong(_) => "roster_too_long",
            Self::TooShort(_) => "roster_too_short",
            Self::Format(_) => "roster_format",
            Self::Malformed(_) => "roster_malformed",
            Self::Trailing(_) => "roster_trailing",
            Self::NonCanonical => "roster_non_canonical",
            Self::Signature => "roster_signature",
            Self::TooMany { .. } => "roster_too_many",
            Self::OwnKey(_) => "roster_own_key",
            Self::Key(_) => "roster_key",
            Self::KeyTwice(..) => "roster_key_twice",
            Self::NameTwice(_) => "roster_name_twice",
            Self::Swarm { .. } => "roster_swarm",
            Self::SwarmKey { .. } => "roster_swarm_key",
        }
    }
}

#[derive(Serialize, Deserialize)]
struct RawBody {
    format: u8,
    swarm: Name,
    swarm_key: Key,
    version: NonZero<u64>,
    #[serde(deserialize_with = "limits::list::<_, _, ROSTER_MEMBERS_MAX>")]
    members: Vec<(Name, Key, Option<Key>)>,
    #[serde(deserialize_with = "limits::list::<_, _, ROSTER_OBSERVERS_MAX>")]
    observers: Vec<(Name, Key)>,
    #[serde(deserialize_with = "limits::list::<_, _, ROSTER_REVOKED_MAX>")]
    revoked: Vec<RawRevoked>,
}

#[derive(Serialize, Deserialize)]
struct RawRevoked {
    key: Key,
    name: Name,
    #[serde(deserialize_with = "limits::list::<_, _, KEPT_EPOCHS_MAX>")]
    kept: Vec<(u32, NonZero<u32>)>,
}

impl Roster {
    /// Signs a roster.
    ///
    /// # Errors
    /// [`StatementError`] if the content contradicts itself or is over a limit.
    pub fn sign(key: &SigningKey, content: RosterContent) -> Result<Self, StatementError> {
        let swarm_key = key.verifying_key().to_bytes();
        content.check(&swarm_key)?;
        let mut bytes = to_bytes(&RawBody::of(&content, swarm_key));
        let signature = key.sign(&signed_bytes(&bytes)).to_bytes();
        bytes.extend_from_slice(&signature);
        if bytes.len() > ROSTER_LEN_MAX {
            return Err(StatementError::TooLong(bytes.len()));
        }
        Ok(Self { content, swarm_key, signature, hash: Hash::of(&bytes) })
    }

    /// Decodes canonical bytes, and checks the signature of the key that they name. Whose key that is, is for
    /// [`Roster::check_swarm`].
    ///
    /// # Errors
    /// [`StatementError`], naming the first check that failed.
    pub fn decode(bytes: &[u8]) -> Result<Self, StatementError> {
        Self::decode_of(bytes, None)
    }

    /// The same of a swarm that is known: others cost no look at a signature.
    ///
    /// # Errors
    /// [`StatementError`], naming the first check that failed.
    pub fn decode_for(bytes: &[u8], swarm: &Name, swarm_key: &Key) -> Result<Self, StatementError> {
        Self::decode_of(bytes, Some((swarm, swarm_key)))
    }

    fn decode_of(bytes: &[u8], wanted: Option<(&Name, &Key)>) -> Result<Self, StatementError> {
        if bytes.len() > ROSTER_LEN_MAX {
            return Err(StatementError::TooLong(bytes.len()));
        }
        let short = StatementError::TooShort(bytes.len());
        let Some((body, signature)) = bytes.split_last_chunk::<SIGNATURE_LEN>() else { return Err(short) };
        match body.first() {
            None => return Err(short),
            Some(&format) if format != FORMAT => return Err(StatementError::Format(format)),
            Some(_) => {}
        }
        let (raw, rest): (RawBody, _) = postcard::take_from_bytes(body).map_err(StatementError::Malformed)?;
        if !rest.is_empty() {
            return Err(StatementError::Trailing(rest.len()));
        }
        let swarm_key = raw.swarm_key;
        if let Some((swarm, key)) = wanted {
            check_swarm(&raw.swarm, &swarm_key, swarm, key)?;
        }
        let content = raw.parse();
        if to_bytes(&RawBody::of(&content, swarm_key)) != body {
            return Err(StatementError::NonCanonical);
        }
        let key = usable(&swarm_key).ok_or(StatementError::Signature)?;
        key.verify_strict(&signed_bytes(body), &Signature::from_bytes(signature))
            .map_err(|_| StatementError::Signature)?;
        content.check(&swarm_key)?;
        Ok(Self { content, swarm_key, signature: *signature, hash: Hash::of(bytes) })
    }

    /// The canonical bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = to_bytes(&RawBody::of(&self.content, self.swarm_key));
        bytes.extend_from_slice(&self.signature);
        bytes
    }

    /// Whether it is of this swarm.
    ///
    /// # Errors
    /// [`StatementError::Swarm`] or [`StatementError::SwarmKey`].
    pub fn check_swarm(&self, swarm: &Name, swarm_key: &Key) -> Result<(), StatementError> {
        check_swarm(&self.content.swarm, &self.swarm_key, swarm, swarm_key)
    }

    /// What it says.
    pub fn content(&self) -> &RosterContent {
        &self.content
    }

    /// The public half of the swarm's key.
    pub fn swarm_key(&self) -> &Key {
        &self.swarm_key
    }

    /// Which statement it is.
    pub fn head(&self) -> RosterHead {
        RosterHead { version: self.content.version.get(), hash: self.hash }
    }

    /// Whether it counts, and not the other.
    pub fn supersedes(&self, other: &Self) -> bool {
        self.head() > other.head()
    }

    /// Whether both have one version, and are not the same: the swarm's key signed twice.
    pub fn is_fork_of(&self, other: &Self) -> bool {
        self.content.version == other.content.version && self.hash != other.hash
    }

    /// All robots whose facts count: members by their new and old keys, and revoked ones of whom something stays.
    pub fn listed(&self) -> impl Iterator<Item = Listed> {
        let members = self.content.members.iter().flat_map(|(name, member)| {
            let listed = |key| Listed { robot: RobotId::of_key(&key), name: name.clone(), key, frozen: None };
            [Some(member.key), member.old].into_iter().flatten().map(listed)
        });
        let kept = self.content.revoked.iter().filter(|(_, revoked)| !revoked.kept.is_empty());
        members.chain(kept.map(|(key, Revoked { name, kept })| Listed {
            robot: RobotId::of_key(key),
            name: name.clone(),
            key: *key,
            frozen: Some(kept.clone()),
        }))
    }
}

impl RosterContent {
    /// The first statement of a new swarm: nobody is in it yet.
    pub fn first(swarm: Name) -> Self {
        let (members, observers, revoked) = Default::default();
        Self { swarm, version: NonZero::<u64>::MIN, members, observers, revoked }
    }

    /// Every key in it, with the name that it belongs to.
    fn keys(&self) -> impl Iterator<Item = (&Key, &Name)> {
        let members = self.members.iter();
        let members = members.flat_map(|(name, member)| {
            [(&member.key, name)].into_iter().chain(member.old.as_ref().map(|old| (old, name)))
        });
        let observers = self.observers.iter().map(|(name, key)| (key, name));
        members.chain(observers).chain(self.revoked.iter().map(|(key, revoked)| (key, &revoked.name)))
    }

    fn check(&self, swarm_key: &Key) -> Result<(), StatementError> {
        let most = |what, count, max| match count > max {
            true => Err(StatementError::TooMany { what, count, max }),
            false => Ok(()),
        };
        most("robots", self.members.len(), ROSTER_MEMBERS_MAX)?;
        most("observers", self.observers.len(), ROSTER_OBSERVERS_MAX)?;
        most("revoked keys", self.revoked.len(), ROSTER_REVOKED_MAX)?;
        for revoked in self.revoked.values() {
            most("epochs kept of one key", revoked.kept.len(), KEPT_EPOCHS_MAX)?;
        }
        if let Some(name) = self.members.keys().find(|name| self.observers.contains_key(*name)) {
            return Err(StatementError::NameTwice(name.clone()));
        }
        let mut seen = BTreeMap::new();
        for (key, name) in self.keys() {
            if key == swarm_key {
                return Err(StatementError::OwnKey(name.clone()));
            }
            if usable(key).is_none() {
                return Err(StatementError::Key(name.clone()));
            }
            // By id, which is what logs are told apart by.
            if let Some(other) = seen.insert(RobotId::of_key(key), name) {
                return Err(StatementError::KeyTwice(other.clone(), name.clone()));
            }
        }
        Ok(())
    }
}

impl RawBody {
    fn of(content: &RosterContent, swarm_key: Key) -> Self {
        let RosterContent { swarm, version, members, observers, revoked } = content;
        let kept = |kept: &Kept| kept.iter().map(|(epoch, len)| (*epoch, *len)).collect();
        Self {
            format: FORMAT,
            swarm: swarm.clone(),
            swarm_key,
            version: *version,
            members: members.iter().map(|(name, Member { key, old })| (name.clone(), *key, *old)).collect(),
            observers: observers.iter().map(|(name, key)| (name.clone(), *key)).collect(),
            revoked: revoked
                .iter()
                .map(|(key, revoked)| RawRevoked { key: *key, name: revoked.name.clone(), kept: kept(&revoked.kept) })
                .collect(),
        }
    }

    /// The content. What does not rise, or stands twice, shows when it is encoded again.
    fn parse(self) -> RosterContent {
        let revoked = |RawRevoked { key, name, kept }| (key, Revoked { name, kept: kept.into_iter().collect() });
        RosterContent {
            swarm: self.swarm,
            version: self.version,
            members: self.members.into_iter().map(|(name, key, old)| (name, Member { key, old })).collect(),
            observers: self.observers.into_iter().collect(),
            revoked: self.revoked.into_iter().map(revoked).collect(),
        }
    }
}

fn check_swarm(name: &Name, key: &Key, wanted_name: &Name, wanted_key: &Key) -> Result<(), StatementError> {
    if name != wanted_name {
        return Err(StatementError::Swarm { is: name.clone(), wanted: wanted_name.clone() });
    }
    if key != wanted_key {
        return Err(StatementError::SwarmKey { swarm: name.clone(), is: *key, wanted: *wanted_key });
    }
    Ok(())
}

/// A key for which not everybody can sign.
fn usable(key: &Key) -> Option<VerifyingKey> {
    VerifyingKey::from_bytes(key).ok().filter(|key| !key.is_weak())
}

fn signed_bytes(body: &[u8]) -> Vec<u8> {
    [SIGNING_CONTEXT, body].concat()
}

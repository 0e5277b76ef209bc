//! The state machine of one robot: facts, gossip, negotiation and the joint estimate behind one `Input`/`Output` door.

pub mod io;
pub mod job;

use crate::config::{Config, ConfigError};
use crate::ids::{FrameId, Hash, Name, RobotId};
use crate::time::Instant;
use io::{Input, Output, Record};
use std::collections::BTreeMap;
use thiserror::Error;

/// Who this agent is and whom it trusts.
#[derive(Clone)]
pub struct Identity {
    /// The swarm's name.
    pub swarm: Name,
    /// This robot's name; must be in the roster with the key's public half.
    pub name: Name,
    /// The ed25519 secret key.
    pub secret_key: [u8; 32],
    /// Every member of the swarm and its ed25519 public key, this robot included.
    pub roster: BTreeMap<Name, [u8; 32]>,
}

/// Why an agent could not start.
#[derive(Debug, Error)]
pub enum StartError {
    /// A knob is out of range.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The roster does not hold this robot under this key.
    #[error(
        "robot {0} is not in the roster with the public half of its key; add the line that `keys generate` printed"
    )]
    NotInRoster(Name),
    /// The store holds something that this agent did not write.
    #[error("the store is damaged: {0}; restore a copy or start with an empty store, which begins a new epoch")]
    Store(String),
}

/// What the shell kept from earlier runs.
#[derive(Clone, Debug, Default)]
pub struct Restored {
    /// All durable records, in any order.
    pub records: Vec<Record>,
    /// The epoch to begin if the store is empty: larger than any this robot used before (seconds since 2020 serve).
    pub fresh_epoch: u32,
}

/// One robot's agent. Call [`Agent::handle`] once, drain [`Agent::poll_output`] until it is empty, then wait until
/// [`Agent::poll_timeout`] or the next input.
pub struct Agent {}

impl Agent {
    /// A new agent.
    ///
    /// # Errors
    /// [`StartError`] for a bad configuration, roster or store.
    pub fn new(
        _config: Config,
        _identity: Identity,
        _seed: u64,
        _restored: Restored,
        _now: Instant,
    ) -> Result<Self, StartError> {
        Ok(Self {})
    }

    /// Takes one input.
    pub fn handle(&mut self, _now: Instant, _input: Input) {}

    /// The next output, if any. Only [`Agent::handle`] makes new ones.
    pub fn poll_output(&mut self) -> Option<Output> {
        None
    }

    /// When [`Input::Timeout`] is wanted. Only [`Agent::handle`] changes it.
    pub fn poll_timeout(&self) -> Option<Instant> {
        None
    }

    /// This robot.
    pub fn robot(&self) -> RobotId {
        RobotId([0; 8])
    }

    /// The frame that this robot writes now.
    pub fn frame(&self) -> FrameId {
        FrameId { robot: self.robot(), epoch: 0 }
    }

    /// BLAKE3 digest of the set of entries held: equal sets, equal digests.
    pub fn digest(&self) -> Hash {
        Hash::default()
    }
}

//! The state machine of one robot: facts, gossip, negotiation and the joint estimate behind one `Input`/`Output` door.
//!
//! The contract (tested in `tests/agents/contract.rs`): call [`Agent::handle`] once, drain [`Agent::poll_output`] until
//! it is empty, then wait until [`Agent::poll_timeout`] or the next input. Only `handle` changes anything.
//!
//! Nothing is advertised before it is durable: a new entry goes out as [`Output::Persist`] and takes effect (is
//! published, counted in the have-vector, used in the estimate) when [`Input::Persisted`] confirms it.

mod alignment;
mod context;
mod core;
mod estimation;
pub mod io;
pub mod job;
#[cfg(test)]
mod job_tests;
mod mapping;
mod motion;
mod recent;
mod replication;
mod restore;
mod router;
mod stats;
mod two_sided;
mod view;

use crate::config::{Config, ConfigError};
use crate::ids::{FrameId, Hash, Name, RobotId};
use crate::replica::{Replica, RosterError};
use crate::time::Instant;
use alignment::Alignment;
use context::{Context, Me};
use ed25519_dalek::SigningKey;
use estimation::Estimation;
use io::{Command, EpochReason, Input, Output, Record};
use mapping::Mapping;
use replication::Replication;
use std::collections::BTreeMap;
use thiserror::Error;
use zeroize::Zeroize;

pub use self::core::Core;
pub use alignment::{
    ALIGNMENTS_PER_FRAME_PAIR, ALIGNMENTS_PER_SUBMAP, FEATURES_MAX, KEYPOINTS_MAX, LOOKALIKES_MAX, POSTPONED_MAX,
    REFUSED_MAX, REFUSED_WAITING_MAX, SECOND_LOOKS_MAX, TRIES_PER_SUBMAP,
};
pub use estimation::{ROBOTS_ALL_PAIRS_MAX, estimate_version};
pub use mapping::{CLOCK_BACK_KEYFRAMES, PATH_KEYFRAMES_MAX, SIGHTING_AGE_SECS_MAX, TURN_SIGMA_MAX, stated};
pub use replication::knowledge::Agreement;
pub use replication::{BLOBS_MAX, GONE_IN_A_ROW_MAX, PROOFS_PER_SEC, UNSENT_MAX};

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
    /// The roster holds a key that is no ed25519 public key, or one key twice.
    #[error(transparent)]
    Roster(#[from] RosterError),
}

/// What the shell kept from earlier runs.
#[derive(Clone, Debug, Default)]
pub struct Restored {
    /// All durable records, in any order.
    pub records: Vec<Record>,
    /// The epoch to begin if the store is empty or must not be continued: larger than any this robot used before
    /// (seconds since 2020 serve).
    pub fresh_epoch: u32,
}

/// One robot's agent: four parts, each of which alone touches what it holds, and a router between them.
pub struct Agent {
    context: Context,
    replication: Replication,
    mapping: Mapping,
    alignment: Alignment,
    estimation: Estimation,
}

impl Agent {
    /// A new agent, resuming from what the shell kept.
    ///
    /// # Errors
    /// [`StartError`] for a bad configuration, roster or store.
    pub fn new(
        config: Config,
        mut identity: Identity,
        seed: u64,
        restored: Restored,
        now: Instant,
    ) -> Result<Self, StartError> {
        config.validate()?;
        let key = SigningKey::from_bytes(&identity.secret_key);
        identity.secret_key.zeroize(); // the one copy left is wiped with the agent
        let public = key.verifying_key().to_bytes();
        if identity.roster.get(&identity.name) != Some(&public) {
            return Err(StartError::NotInRoster(identity.name));
        }
        let robot = RobotId::of_key(&public);
        let replica = Replica::new(&identity.swarm, identity.roster, &config.gossip)?;
        let frame = FrameId { robot, epoch: restored.fresh_epoch };
        let names = replica.members().map(|(robot, name)| (robot, name.clone())).collect();
        let me = Me { frame, key, name: identity.name, swarm: identity.swarm, names };
        let context = Context::new(config, me, seed, now);
        let mut agent = Self {
            replication: Replication::new(&context, replica),
            mapping: Mapping::new(&context.config().submap),
            alignment: Alignment::new(&context),
            estimation: Estimation::default(),
            context,
        };
        agent.restore(restored);
        Ok(agent)
    }

    /// Takes one input.
    pub fn handle(&mut self, now: Instant, input: Input) {
        self.context.reach(now);
        match input {
            Input::Keyframe(keyframe) => self.on_keyframe(keyframe),
            Input::KeyframesLost { why, count } => self.mapping.lose(why, count),
            Input::Sighting(sighting) => self.on_sighting(&sighting),
            Input::Position(sighting) => self.on_position(&sighting),
            Input::Received { from, channel, bytes } => self.on_received(from, channel, &bytes),
            Input::Asked { token, kind, bytes } => self.on_asked(token, kind, &bytes),
            Input::Answered { query, bytes } => self.on_answered(query, bytes.as_deref()),
            Input::Neighbour { robot, up } => self.on_neighbour(robot, up),
            Input::Persisted { up_to } => self.on_persisted(up_to),
            Input::PersistFailed { batch: _, reason } => {
                self.replication.on_persist_failed(&mut self.context, &reason);
            }
            Input::JobDone { job, result } => self.on_job_done(job, result),
            Input::Timeout => {}
            Input::Command(Command::Flush) => {
                self.mapping.close_submap(&mut self.context);
                self.save_refusals();
            }
            Input::Command(Command::NewEpoch) => self.begin_next_epoch(EpochReason::Told),
        }
        self.run_timers();
        if !self.replication.store_fails() {
            self.mapping.start_describing(&mut self.context);
        }
        self.start_aligning();
        self.start_solving();
        self.condense();
        self.close_batch();
    }

    /// The next output, if any. Only [`Agent::handle`] makes new ones.
    pub fn poll_output(&mut self) -> Option<Output> {
        self.context.next_output()
    }

    /// When [`Input::Timeout`] is wanted. Only [`Agent::handle`] changes it.
    pub fn poll_timeout(&self) -> Option<Instant> {
        let now = self.context.now();
        let told = self.mapping.body().map(|(_, _, stamp)| stamp);
        let gossip = self.replication.timeout(&self.context, told);
        [gossip, self.alignment.timeout(now), self.estimation.timeout()].into_iter().flatten().min()
    }

    /// This robot.
    pub fn robot(&self) -> RobotId {
        self.context.robot()
    }

    /// The frame that this robot writes now.
    pub fn frame(&self) -> FrameId {
        self.context.frame()
    }

    /// What it holds: the lengths of its logs, `None` for those that have two histories.
    pub fn heads(&self) -> impl Iterator<Item = (FrameId, Option<u32>)> {
        self.replication.lengths()
    }

    /// BLAKE3 digest of the set of durable entries held: equal sets, equal digests.
    pub fn digest(&self) -> Hash {
        self.replication.digest()
    }
}

//! The state machine of one robot: facts, gossip, negotiation and the joint estimate behind one `Input`/`Output` door.
//!
//! The contract (tested in `tests/agents/contract.rs`): call [`Agent::handle`] once, drain [`Agent::poll_output`] until
//! it is empty, then wait until [`Agent::poll_timeout`] or the next input. Only `handle` changes anything.
//!
//! Nothing is advertised before it is durable: a new entry goes out as [`Output::Persist`] and takes effect (is
//! published, counted in the have-vector, used in the estimate) when [`Input::Persisted`] confirms it.

mod aligning;
mod allowance;
mod beacons;
mod condensing;
#[cfg(test)]
mod condensing_tests;
mod context;
mod core;
pub mod estimate_version;
mod gossip;
pub mod io;
pub mod job;
#[cfg(test)]
mod job_tests;
mod knowledge;
mod ledger;
mod live;
mod mapping;
mod negotiation;
mod overlap_model;
mod ranking;
mod recent;
mod refusals;
mod second_look;
mod shortlist;
mod sighting;
mod solving;
mod stated;
mod stats;
mod steps;
mod traffic;
mod two_sided;
mod view;

use crate::config::{Config, ConfigError};
use crate::ids::{EntryId, FrameId, Hash, Name, RobotId};
use crate::replica::{Replica, RosterError};
use crate::submap::Keypoints;
use crate::submap::runs::Runs;
use crate::time::Instant;
use crate::wire::fact::Fact;
use allowance::Allowance;
use condensing::Condensing;
use context::{Context, Me};
use ed25519_dalek::SigningKey;
use gossip::Gossip;
use io::{Command, EpochReason, Input, JobId, Output, Record};
use job::JobResult;
use knowledge::Knowledge;
use ledger::Ledger;
use mapping::Mapper;
use negotiation::Negotiation;
use refusals::Refusals;
use sighting::Positions;
use solving::MapState;
use std::collections::{BTreeMap, BTreeSet};
use steps::Steps;
use thiserror::Error;

pub use self::core::Core;
pub use condensing::GONE_IN_A_ROW_MAX;
pub use gossip::BLOBS_MAX;
pub use knowledge::Agreement;
pub use live::ROBOTS_ALL_PAIRS_MAX;
pub use mapping::CLOCK_BACK_KEYFRAMES;
pub use negotiation::{
    ALIGNMENTS_PER_FRAME_PAIR, ALIGNMENTS_PER_SUBMAP, FEATURES_MAX, KEYPOINTS_MAX, LOOKALIKES_MAX, TRIES_PER_SUBMAP,
};
pub use refusals::{REFUSED_MAX, REFUSED_WAITING_MAX};
pub use second_look::SECOND_LOOKS_MAX;
pub use sighting::{SIGHTING_AGE_SECS_MAX, TURN_SIGMA_MAX};
pub use traffic::{POSTPONED_MAX, UNSENT_MAX};

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

/// One robot's agent.
pub struct Agent {
    context: Context,
    ledger: Ledger,
    replica: Replica,
    knowledge: Knowledge,
    mapper: Mapper,
    negotiation: Negotiation,
    refusals: Refusals,
    allowance: Allowance,
    gossip: Gossip,
    map: MapState,
    condensing: Condensing,
    positions: Positions,
}

impl Agent {
    /// A new agent, resuming from what the shell kept.
    ///
    /// # Errors
    /// [`StartError`] for a bad configuration, roster or store.
    pub fn new(
        config: Config,
        identity: Identity,
        seed: u64,
        restored: Restored,
        now: Instant,
    ) -> Result<Self, StartError> {
        config.validate()?;
        let key = SigningKey::from_bytes(&identity.secret_key);
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
        let (config, now) = (context.config(), context.now());
        let mut agent = Self {
            mapper: Mapper::new(&config.submap),
            negotiation: Negotiation::new(config.submap.sensor),
            refusals: Refusals::new(config),
            allowance: Allowance::new(config.align.further_bytes_per_sec, now),
            gossip: Gossip::new(robot, &config.gossip, now),
            replica,
            ledger: Ledger::default(),
            knowledge: Knowledge::default(),
            map: MapState::default(),
            condensing: Condensing::default(),
            positions: Positions::default(),
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
            Input::Sighting(sighting) => self.on_sighting(&sighting),
            Input::Position(sighting) => self.on_position(&sighting),
            Input::Received { from, channel, bytes } => self.on_received(from, channel, &bytes),
            Input::Asked { token, kind, bytes } => self.on_asked(token, kind, &bytes),
            Input::Answered { query, bytes } => self.on_answered(query, bytes.as_deref()),
            Input::Neighbour { robot, up } => self.on_neighbour(robot, up),
            Input::Persisted { up_to } => self.on_persisted(up_to),
            Input::PersistFailed { batch: _, reason } => self.on_persist_failed(reason),
            Input::JobDone { job, result } => self.on_job_done(job, result),
            Input::Timeout => {}
            Input::Command(Command::Flush) => {
                self.close_submap();
                self.save_refusals();
            }
            Input::Command(Command::NewEpoch) => {
                self.begin_epoch(self.context.frame().epoch.saturating_add(1), EpochReason::Told);
            }
        }
        self.run_timers();
        self.start_describing();
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
        let further = self.allowance.timeout(self.context.now());
        [self.gossip_timeout(), self.fetch_timeout(), self.solve_timeout(), further].into_iter().flatten().min()
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
        self.replica.lengths()
    }

    /// BLAKE3 digest of the set of durable entries held: equal sets, equal digests.
    pub fn digest(&self) -> Hash {
        self.replica.digest()
    }

    /// Loads what is sound. A damaged log of our own must not be continued, since others may hold what is missing here:
    /// a new epoch begins. Damage elsewhere is fetched again from neighbours.
    fn restore(&mut self, restored: Restored) {
        let mut entries = Vec::new();
        let (mut private, mut blobs) = (Vec::new(), Vec::new());
        let (mut forks, mut refused) = (Vec::new(), Vec::new());
        let (mut closed, mut session) = (None, None);
        let fresh_epoch = restored.fresh_epoch;
        for record in restored.records {
            match record {
                Record::Entry { bytes, .. } => entries.push(bytes),
                Record::Blob { bytes, .. } => blobs.push(bytes),
                Record::Private { submap, bytes } => private.push((submap, bytes)),
                Record::Fork { proof, .. } => forks.push(proof),
                Record::EpochClosed { epoch } => closed = closed.max(Some(epoch)),
                Record::Session { epoch, session: now, over } => session = session.max(Some((epoch, now, over))),
                Record::Refused { i, j, evidence: Some(evidence) } => refused.push(((i, j), evidence)),
                // A store gives back what is there.
                Record::Replaced { .. } | Record::Refused { evidence: None, .. } => {}
            }
        }
        let loaded = self.replica.restore(entries);
        for [a, b] in forks {
            if let Err(error) = self.replica.ingest_fork(&a, &b) {
                self.context.reject(None, "store: fork", &error.to_string());
            }
        }
        if let Some(epoch) = self.replica.epochs_of(self.context.robot()).next_back() {
            self.context.set_epoch(epoch);
        }
        if self.replica.is_quarantined(self.context.frame()) {
            closed = closed.max(Some(self.context.frame().epoch));
        }
        if let Err(damage) = loaded {
            self.context.reject(None, "store", &damage.to_string());
            closed = closed.max(damage.concerns(self.context.frame()).then_some(self.context.frame().epoch));
        }
        if let Some(closed) = closed.filter(|closed| *closed >= self.context.frame().epoch) {
            self.begin_epoch(closed.saturating_add(1).max(fresh_epoch), EpochReason::Log);
        }
        self.refusals.restore(refused);
        self.relearn();
        // Only now it is known which are ours; of others as many are taken as there is room for.
        let named = self.knowledge.blobs_of(self.context.robot());
        let is_named = |bytes: &&Vec<u8>| named.contains(&Hash::of(bytes));
        let further: Vec<Hash> =
            blobs.iter().filter(is_named).filter_map(|bytes| Keypoints::address_in(bytes)).collect();
        let ours: BTreeSet<Hash> = named.iter().copied().chain(further).collect();
        let (own, foreign): (Vec<_>, Vec<_>) = blobs.into_iter().partition(|bytes| ours.contains(&Hash::of(bytes)));
        own.into_iter().chain(foreign).take(BLOBS_MAX).for_each(|bytes| self.keep_blob(bytes));
        for (submap, bytes) in private {
            self.restore_features(submap, &bytes);
        }
        self.resume_mapping(self.runs_of(session));
    }

    /// What is known of the front end's runs, by what was last kept of them: the epoch, its run, and those that are
    /// over.
    fn runs_of(&self, kept: Option<(u32, u64, Vec<u64>)>) -> Runs {
        let Some((epoch, session, over)) = kept else { return Runs::default() };
        // An epoch that began since may be of any run that is not over.
        Runs::remembered((epoch == self.context.frame().epoch).then_some(session), over)
    }

    /// A durable entry takes effect.
    fn learn(&mut self, id: EntryId) {
        let Some(entry) = self.replica.entry(id).filter(|entry| !self.replica.is_quarantined(entry.id().frame)) else {
            return;
        };
        if self.replica.is_floor(id) {
            self.knowledge.forget_below(id.frame, id.seq);
            self.negotiation.drop_unknown(&self.knowledge);
        }
        match entry.fact() {
            Ok(fact) => {
                self.knowledge.absorb(id, fact.clone());
                self.map.dirty = true;
                self.on_fact(id, &fact);
            }
            Err(error) => self.context.reject(Some(id.frame.robot), error.reason(), &format!("{id}: {error}")),
        }
    }

    /// Forgets and learns everything again: at start, and when a quarantine takes facts away.
    fn relearn(&mut self) {
        self.knowledge = Knowledge::default();
        self.map.steps = Steps::default();
        self.negotiation.clear_candidates();
        // What calls for something is heard once all is known; of submaps ours call for all pairs, verdicts for nothing
        // but news, and these are old.
        let mut calling = Vec::new();
        for (id, fact) in self.replica.facts() {
            if matches!(fact, Fact::Alignment(_) | Fact::Condensed(_)) {
                calling.push((id, fact.clone()));
            }
            self.knowledge.absorb(id, fact);
        }
        self.negotiation.drop_unknown(&self.knowledge);
        calling.iter().for_each(|(id, fact)| self.on_fact(*id, fact));
        self.weigh_refusals();
        self.note_all_candidates();
        self.map.dirty = true;
    }

    fn on_job_done(&mut self, id: JobId, result: JobResult) {
        match result {
            JobResult::Described(described) => self.on_described(id, *described),
            JobResult::Aligned(outcome) => self.on_aligned(id, outcome),
            JobResult::Solved(solved) => self.on_solved(id, *solved),
        }
    }
}

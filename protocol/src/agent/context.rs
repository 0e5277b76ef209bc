//! What all parts of an agent share: who it is, its options, the present moment, its numbers and counters, and the one
//! way out, by which each part says what is to be sent, run, kept and told.

use super::io::{Event, JobId, Output, QueryId, Record};
use super::job::Job;
use super::stats::Stats;
use crate::config::Config;
use crate::ids::{FrameId, Name, RobotId, SubmapId};
use crate::time::Instant;
use ed25519_dalek::SigningKey;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::{BTreeMap, VecDeque};

/// A clock that shows more (after 292 years, or because it is broken) stands still for the agent: pauses must end after
/// they begin, or whatever is repeated after a pause would be repeated without one.
const LATEST: Instant = Instant::from_nanos(u64::MAX / 2);

/// This robot and its swarm.
pub(super) struct Me {
    pub(super) frame: FrameId,
    pub(super) key: SigningKey,
    pub(super) name: Name,
    pub(super) swarm: Name,
    /// Every member of the swarm, this robot included.
    pub(super) names: BTreeMap<RobotId, Name>,
}

/// See the module.
pub(super) struct Context {
    config: Config,
    me: Me,
    seed: u64,
    rng: ChaCha8Rng,
    now: Instant,
    outputs: VecDeque<Output>,
    /// Records of this call; they leave together at its end.
    records: Vec<Record>,
    stats: Stats,
    next_job: u64,
    next_query: u64,
}

impl Context {
    pub(super) fn new(config: Config, me: Me, seed: u64, now: Instant) -> Self {
        Self {
            config,
            me,
            seed,
            rng: ChaCha8Rng::seed_from_u64(seed),
            now: now.min(LATEST),
            outputs: VecDeque::new(),
            records: Vec::new(),
            stats: Stats::default(),
            next_job: 1,
            next_query: 1,
        }
    }

    pub(super) fn config(&self) -> &Config {
        &self.config
    }

    /// This robot.
    pub(super) fn robot(&self) -> RobotId {
        self.me.frame.robot
    }

    /// The frame that this robot writes now.
    pub(super) fn frame(&self) -> FrameId {
        self.me.frame
    }

    /// From now on this robot writes another frame.
    pub(super) fn set_epoch(&mut self, epoch: u32) {
        self.me.frame.epoch = epoch;
    }

    pub(super) fn me(&self) -> &Me {
        &self.me
    }

    pub(super) fn seed(&self) -> u64 {
        self.seed
    }

    pub(super) fn rng(&mut self) -> &mut ChaCha8Rng {
        &mut self.rng
    }

    /// Random numbers of their own, that change nothing of the others.
    pub(super) fn rng_beside(&self, stream: u64) -> ChaCha8Rng {
        let mut rng = self.rng.clone();
        rng.set_stream(stream);
        rng
    }

    pub(super) fn now(&self) -> Instant {
        self.now
    }

    /// It is so late; time never goes back.
    pub(super) fn reach(&mut self, now: Instant) {
        self.now = self.now.max(now.min(LATEST));
    }

    pub(super) fn stats(&self) -> &Stats {
        &self.stats
    }

    /// The counters, to count something.
    pub(super) fn count(&mut self) -> &mut Stats {
        &mut self.stats
    }

    /// Puts an output behind all others.
    pub(super) fn put(&mut self, output: Output) {
        self.outputs.push_back(output);
    }

    pub(super) fn next_output(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    pub(super) fn event(&mut self, event: Event) {
        self.put(Output::Event(event));
    }

    /// Counts a refusal and reports it, at most once per peer, reason and interval. `peer` is whoever signed what is
    /// refused, if anybody did.
    pub(super) fn reject(&mut self, peer: Option<RobotId>, reason: &'static str, detail: &str) {
        if let Some(suppressed) = self.stats.rejected(self.now, peer, reason) {
            let name = peer.map_or_else(|| "unknown".to_owned(), |peer| self.robot_name(peer));
            self.event(Event::Rejected { peer, name, reason: format!("{reason}: {detail}"), suppressed });
        }
    }

    /// Refuses what is not signed: whoever sent it, `named` is the robot that it was sent in the name of, or that was
    /// asked, and is not blamed.
    pub(super) fn reject_unsigned(&mut self, named: RobotId, reason: &'static str, detail: &str) {
        let name = self.robot_name(named);
        self.reject(None, reason, &format!("{detail} (unsigned, in the name of {name})"));
    }

    pub(super) fn run_job(&mut self, job: Job) -> JobId {
        let id = JobId(self.next_job);
        self.next_job += 1;
        self.stats.worked(job.kind());
        self.put(Output::Run { id, job });
        id
    }

    pub(super) fn new_query(&mut self) -> QueryId {
        let id = QueryId(self.next_query);
        self.next_query += 1;
        id
    }

    /// Has a record made durable, together with all others of this call.
    pub(super) fn keep(&mut self, record: Record) {
        self.records.push(record);
    }

    /// Records that were not handed out yet.
    pub(super) fn kept(&self) -> usize {
        self.records.len()
    }

    pub(super) fn take_records(&mut self) -> Vec<Record> {
        core::mem::take(&mut self.records)
    }

    /// A robot of the roster's name.
    pub(super) fn name_of(&self, robot: RobotId) -> Option<&Name> {
        self.me.names.get(&robot)
    }

    /// The robot of the roster that has this name.
    pub(super) fn robot_named(&self, name: &Name) -> Option<RobotId> {
        self.me.names.iter().find(|(_, of)| *of == name).map(|(robot, _)| *robot)
    }

    /// A robot's name, or its id if the roster does not hold it.
    pub(super) fn robot_name(&self, robot: RobotId) -> String {
        self.name_of(robot).map_or_else(|| robot.to_string(), ToString::to_string)
    }

    pub(super) fn frame_name(&self, frame: FrameId) -> String {
        format!("{}/{}", self.robot_name(frame.robot), frame.epoch)
    }

    pub(super) fn submap_name(&self, id: SubmapId) -> String {
        format!("{}#{}", self.frame_name(id.frame), id.index)
    }
}

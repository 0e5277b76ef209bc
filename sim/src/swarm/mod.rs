//! The swarm: every robot's core, disk, SLAM and links in one queue of virtual time. Whatever a real shell does
//! (deliver, persist, run jobs, time out, tell who is near) is an event here; jobs run inline and are charged virtual
//! time. Robots' process clocks begin when their processes do, so an instant kept across a restart shows as a fault.

mod act;
mod alignment_oracle;
#[cfg(test)]
pub(crate) mod fake;
mod fate;
mod hostile;
mod look;
mod robot;
mod stopwatch;
mod store;
mod trace;

pub use robot::Usage;
pub use stopwatch::Stopwatch;

use crate::check::{Checks, Phase, RobotSample, Sample, Violation};
use crate::core::Restartable;
use crate::dice::Dice;
use crate::faults::FaultCounts;
use crate::field::Field;
use crate::network::{Network, millis};
use crate::queue::Queue;
use crate::scenario::Scenario;
use crate::stage::{Stage, StageError};
use alignment_oracle::AlignmentOracle;
use merganser_protocol::agent::StartError;
use merganser_protocol::agent::io::{Channel, Event as Told, JobId, QueryId, QueryKind};
use merganser_protocol::agent::job::Job;
use merganser_protocol::geometry::Sim3;
use merganser_protocol::ids::{NameError, RobotId};
use merganser_protocol::time::Instant;
use robot::{Robot, Slam, identities};
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;
use trace::Trace;

/// Outputs of one input at most, and events of one virtual second per robot at most: beyond, the core is in a loop.
const OUTPUTS_MAX: usize = 100_000;
const EVENTS_PER_SEC_AND_ROBOT_MAX: u64 = 50_000;
/// Notable events kept for the report.
const TOLD_MAX: usize = 10_000;
/// Samples in a row that must find all done before the run ends early.
const DONE_SAMPLES: u32 = 2;

/// Why a swarm could not start.
#[derive(Debug, Error)]
pub enum SwarmError {
    /// The world or the drives.
    #[error(transparent)]
    Stage(#[from] StageError),
    /// A robot's name.
    #[error(transparent)]
    Name(#[from] NameError),
    /// An agent.
    #[error("robot {0} cannot start: {1}")]
    Start(String, StartError),
}

/// A run in progress.
pub struct Swarm<C> {
    scenario: Scenario,
    stage: Stage,
    seed: u64,
    queue: Queue<Event>,
    network: Network,
    field: Field,
    robots: Vec<Robot<C>>,
    ids: BTreeMap<RobotId, usize>,
    checks: Checks,
    oracle: Option<AlignmentOracle>,
    trace: Trace,
    counts: FaultCounts,
    truth: BTreeMap<String, Sim3>,
    adversaries: BTreeSet<String>,
    told: Vec<(f64, usize, Told)>,
    stopwatch: Stopwatch,
    violation: Option<Violation>,
    healed: bool,
    done_samples: u32,
    agreed_since: Option<Instant>,
    events: u64,
    /// The virtual second that events are being counted in, and how many it has had.
    second: (u64, u64),
}

/// How a run ended.
pub struct Outcome<C> {
    /// What was run.
    pub scenario: Scenario,
    /// The world and the drives.
    pub stage: Stage,
    /// With which seed.
    pub seed: u64,
    /// The first broken invariant.
    pub violation: Option<Violation>,
    /// BLAKE3 over every input and output.
    pub trace: merganser_protocol::ids::Hash,
    /// Number of inputs and outputs.
    pub trace_lines: u64,
    /// Virtual time at the end.
    pub ended: Instant,
    /// Since when all hold the same facts, as sampled after the healing.
    pub agreed_since: Option<Instant>,
    /// Whether all held the same facts and had nothing left to do when it ended.
    pub idle: bool,
    /// Events handled.
    pub events: u64,
    /// Faults that fired.
    pub counts: FaultCounts,
    /// The robots at the end.
    pub robots: Vec<RobotSample>,
    /// Messages by kind, for each robot of the scenario.
    pub usage: Vec<BTreeMap<&'static str, Usage>>,
    /// `t_world_frame` of every frame; the scale is its unit, m.
    pub truth: BTreeMap<String, Sim3>,
    /// What the agents told people: seconds, robot, event.
    pub told: Vec<(f64, usize, Told)>,
    /// Where the wall time went.
    pub stopwatch: Stopwatch,
    _core: core::marker::PhantomData<C>,
}

/// All that can happen.
enum Event {
    Boot { robot: usize },
    Keyframe { robot: usize, index: usize },
    DriveEnds { robot: usize },
    Broadcast { from: usize, to: usize, channel: Channel, bytes: Vec<u8> },
    Ask { from: usize, from_incarnation: u32, to: usize, query: QueryId, kind: QueryKind, bytes: Vec<u8> },
    Answer { to: usize, incarnation: u32, query: QueryId, bytes: Option<Vec<u8>> },
    Commit { robot: usize, incarnation: u32 },
    CutNow { robot: usize, incarnation: u32 },
    JobDone { robot: usize, incarnation: u32, id: JobId, job: Box<Job> },
    Wake { robot: usize, incarnation: u32, at: Instant },
    Hear { observer: usize, subject: usize, version: u64 },
    FaultBegins(usize),
    FaultEnds(usize),
    Flood(usize),
    Heal,
    Move,
    Sample,
}

impl<C: Restartable> Swarm<C> {
    /// A swarm at time zero.
    ///
    /// # Errors
    /// [`SwarmError`] if the scenario cannot be staged.
    pub fn new(scenario: Scenario, seed: u64) -> Result<Self, SwarmError> {
        let stage = Stage::new(&scenario, seed)?;
        let mut dice = Dice::new(seed, "machines");
        let mut queue = Queue::new();
        let mut robots = Vec::new();
        for (index, (identity, id)) in identities(&stage, seed)?.into_iter().enumerate() {
            let offset = scenario.machine.clock_offset_secs;
            let slam = Slam::new(dice.range(-offset, offset), scenario.adversary(identity.name.as_str()));
            let starts = millis(1e3 * dice.range(0.0, scenario.machine.start_within_secs));
            robots.push(Robot::new(identity, id, slam, &scenario));
            queue.push(Instant::ZERO.after(starts), Event::Boot { robot: index });
            let steps = stage.steps(index);
            for (k, step) in steps.iter().enumerate() {
                let at = Instant::from_nanos(step.nanos).after(starts);
                queue.push(at, Event::Keyframe { robot: index, index: k });
                if k + 1 == steps.len() {
                    queue.push(at, Event::DriveEnds { robot: index });
                }
            }
        }
        let members = robots.len();
        Self::with_twins(&mut robots, &scenario);
        for (index, fault) in scenario.faults.iter().enumerate() {
            queue.push(secs(fault.begins()), Event::FaultBegins(index));
            if let Some(ends) = fault.ends() {
                queue.push(secs(ends), Event::FaultEnds(index));
            }
        }
        queue.push(secs(scenario.duration_secs + scenario.machine.start_within_secs), Event::Heal);
        queue.push(secs(1.0), Event::Sample);
        let field = Field::new(scenario.radio, members, seed);
        if field.moves() {
            queue.push(Instant::ZERO, Event::Move);
        }
        let mut swarm = Self {
            field,
            network: Network::new(scenario.network.clone(), robots.len(), seed),
            ids: robots.iter().take(members).enumerate().map(|(index, robot)| (robot.id, index)).collect(),
            adversaries: scenario.adversaries(),
            oracle: scenario.summary.clone().map(|options| AlignmentOracle::new(options, seed)),
            checks: Checks::all(scenario.config.gossip.epochs_per_robot_max),
            scenario,
            stage,
            seed,
            queue,
            robots,
            trace: Trace::default(),
            counts: FaultCounts::default(),
            truth: BTreeMap::new(),
            told: Vec::new(),
            stopwatch: Stopwatch::default(),
            violation: None,
            healed: false,
            done_samples: 0,
            agreed_since: None,
            events: 0,
            second: (0, 0),
        };
        swarm.reach();
        Ok(swarm)
    }

    /// Runs to the end: until an invariant breaks, all is calm and done, or the time to settle is over. `progress` is
    /// told the virtual time now and then.
    ///
    /// # Errors
    /// [`SwarmError::Start`] if an agent refuses to start.
    pub fn run(mut self, mut progress: impl FnMut(Instant)) -> Result<Outcome<C>, SwarmError> {
        let storm = self.scenario.duration_secs + self.scenario.machine.start_within_secs;
        let end = secs(storm + self.scenario.settle_secs);
        let mut ended = end;
        while let Some((now, event)) = self.queue.pop() {
            if now > end {
                break;
            }
            self.guard(now);
            let sampled = matches!(event, Event::Sample);
            self.step(now, event)?;
            if sampled {
                progress(now);
            }
            if self.violation.is_some() || self.done_samples >= DONE_SAMPLES {
                ended = now;
                break;
            }
        }
        Ok(self.finish(ended))
    }

    /// The longest this run can take, virtual.
    pub fn end(&self) -> Instant {
        secs(self.scenario.duration_secs + self.scenario.machine.start_within_secs + self.scenario.settle_secs)
    }

    fn finish(mut self, ended: Instant) -> Outcome<C> {
        let robots = self.robot_samples(ended);
        self.pin_frames(&robots);
        let snapshots = robots.iter().filter_map(|robot| robot.snapshot.as_ref());
        for robot in &self.robots {
            robot.store.disk().with_faults(|faults| {
                self.counts.writes_without_room += faults.refused_full;
                self.counts.writes_failed += faults.refused_error;
                self.counts.reads_failed += faults.refused_reads;
            });
        }
        self.counts.held_back = snapshots.flat_map(|snapshot| snapshot.stats.held_back.values()).sum();
        if self.violation.is_none() {
            let sample = Sample {
                at: ended,
                phase: Phase::End,
                robots: robots.clone(),
                down: self.down(),
                truth: &self.truth,
                expect: &self.scenario.expect,
                adversaries: &self.adversaries,
            };
            self.violation = self.checks.sample(ended, &sample);
        }
        Outcome {
            violation: self.violation,
            trace: self.trace.hash(),
            trace_lines: self.trace.lines(),
            ended,
            agreed_since: self.agreed_since,
            idle: all_done(&robots),
            events: self.events,
            counts: self.counts,
            robots,
            usage: self.robots.into_iter().map(|robot| robot.usage).collect(),
            truth: self.truth,
            told: self.told,
            stopwatch: self.stopwatch,
            scenario: self.scenario,
            stage: self.stage,
            seed: self.seed,
            _core: core::marker::PhantomData,
        }
    }

    /// A core that never rests would keep virtual time from moving on.
    fn guard(&mut self, now: Instant) {
        self.events += 1;
        let second = now.as_nanos() / 1_000_000_000;
        self.second = if second == self.second.0 { (second, self.second.1 + 1) } else { (second, 1) };
        if self.second.1 > EVENTS_PER_SEC_AND_ROBOT_MAX * self.scenario.robots as u64 {
            self.object("no endless loop", format!("{} events within one virtual second", self.second.1));
        }
    }

    fn object(&mut self, invariant: &str, what: String) {
        let at_secs = self.queue.now().as_secs_f64();
        self.violation.get_or_insert(Violation { invariant: invariant.to_owned(), at_secs, what });
    }

    fn step(&mut self, now: Instant, event: Event) -> Result<(), SwarmError> {
        // What is meant for a paused process waits, in order.
        if let Some(robot) = event.process()
            && now < self.robots[robot].paused_until
        {
            self.counts.delayed_by_pause += 1;
            self.queue.push(self.robots[robot].paused_until, event);
            return Ok(());
        }
        match event {
            Event::Boot { robot } => self.boot(now, robot)?,
            Event::FaultBegins(index) => self.fault_begins(now, index),
            Event::FaultEnds(index) => self.fault_ends(now, index)?,
            Event::Heal => self.heal(now)?,
            Event::Move => self.move_on(now),
            Event::Sample => self.sample(now),
            Event::Flood(index) => self.flood(now, index),
            other => self.deliver(now, other),
        }
        Ok(())
    }

    fn find(&self, name: &str) -> Option<usize> {
        self.robots.iter().position(|robot| robot.name.as_str() == name)
    }
}

impl Event {
    /// The process that must run for this to happen; `None` for what concerns the outside.
    fn process(&self) -> Option<usize> {
        match *self {
            Self::Keyframe { robot, .. }
            | Self::DriveEnds { robot }
            | Self::Commit { robot, .. }
            | Self::JobDone { robot, .. }
            | Self::Wake { robot, .. } => Some(robot),
            Self::Broadcast { to, .. } | Self::Ask { to, .. } | Self::Answer { to, .. } => Some(to),
            Self::Hear { observer, .. } => Some(observer),
            Self::Boot { .. }
            | Self::CutNow { .. }
            | Self::FaultBegins(_)
            | Self::FaultEnds(_)
            | Self::Flood(_)
            | Self::Heal
            | Self::Move
            | Self::Sample => None,
        }
    }
}

fn all_agree(robots: &[RobotSample]) -> bool {
    robots.windows(2).all(|pair| pair[0].digest == pair[1].digest)
}

fn all_done(robots: &[RobotSample]) -> bool {
    all_agree(robots) && robots.iter().all(|robot| robot.snapshot.as_ref().is_none_or(|s| s.status.idle))
}

fn secs(secs: f64) -> Instant {
    Instant::ZERO.after(millis(1e3 * secs))
}

#[cfg(test)]
mod tests;

//! A shell with perfect wires for real cores and recordings: everything arrives at once, every record is durable at
//! once, jobs run where they are asked for. What a robot sees is then a function of the recordings alone. Wires may also
//! lose messages, by a seed.

use crate::dice::Dice;
use ed25519_dalek::SigningKey;
use merganser_protocol::agent::io::{AskToken, Channel, Command, Event, Input, Output};
use merganser_protocol::agent::job::JobResult;
use merganser_protocol::agent::{Agent, Identity, Restored};
use merganser_protocol::ids::{Name, RobotId};
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::snapshot::PairView;
use merganser_protocol::time::Instant;
use merganser_recording::Recording;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

/// Virtual time after the last keyframe.
const SETTLE: Duration = Duration::from_secs(30);

/// A member of every roster here that runs no core: its key is the test's to lie with.
pub const LIAR: &str = "mallory";
/// Its secret key.
pub const LIAR_SECRET: [u8; 32] = [99; 32];

/// Cores on perfect wires.
pub struct Wires {
    /// The cores.
    pub agents: Vec<Agent>,
    /// Virtual time.
    pub now: Instant,
    /// Everything published, with its sender's index.
    pub published: Vec<(usize, Channel, Vec<u8>)>,
    /// Every event, with the index of the core that told it.
    pub events: Vec<(usize, Event)>,
    /// What each core said of merged pairs, whenever that changed.
    pub statements: Vec<Statement>,
    inbox: VecDeque<(usize, Input)>,
    loss: Option<(f64, Dice)>,
}

/// The pairs that a core calls merged, from a moment on until its next statement.
#[derive(Clone, Debug, PartialEq)]
pub struct Statement {
    /// Since when.
    pub at: Instant,
    /// Index of the core.
    pub robot: usize,
    /// Merged pairs only.
    pub pairs: Vec<PairView>,
}

/// Plays recordings into a core each, in the order of their stamps, until `SETTLE` after the last.
///
/// # Errors
/// Text: a recording that cannot be read, or a configuration that a core refuses.
pub fn play(recordings: &[Recording], seed: u64) -> Result<Wires, String> {
    play_with(recordings, seed, |_, _| {})
}

/// As [`play`], over wires that lose this share of the messages to each robot, and of the questions.
///
/// # Errors
/// As [`play`].
pub fn play_lossy(recordings: &[Recording], seed: u64, loss: f64) -> Result<Wires, String> {
    let mut wires = Wires::new(recordings, seed)?;
    wires.loss = Some((loss, Dice::new(seed, "wires")));
    wires.play(recordings, |_, _| {})
}

/// As [`play`], and calls `meddle` with the number of keyframes handed out before each of them.
///
/// # Errors
/// As [`play`].
pub fn play_with(recordings: &[Recording], seed: u64, meddle: impl FnMut(&mut Wires, usize)) -> Result<Wires, String> {
    Wires::new(recordings, seed)?.play(recordings, meddle)
}

/// Every keyframe and position, as (ns since its recording began, robot, whether it is a position, index), in order.
fn order(recordings: &[Recording]) -> Vec<(i64, usize, bool, usize)> {
    let mut order: Vec<(i64, usize, bool, usize)> = Vec::new();
    for (robot, recording) in recordings.iter().enumerate() {
        let begins = recording.begins().0;
        let keyframes = recording.keyframes().iter().map(|line| line.stamp.0).enumerate();
        order.extend(keyframes.map(|(index, stamp)| (stamp - begins, robot, false, index)));
        let positions = recording.positions().iter().map(|seen| seen.stamp.0).enumerate();
        order.extend(positions.map(|(index, stamp)| ((stamp - begins).max(0), robot, true, index)));
    }
    order.sort_unstable();
    order
}

impl Wires {
    fn play(mut self, recordings: &[Recording], mut meddle: impl FnMut(&mut Self, usize)) -> Result<Self, String> {
        let mut count = 0;
        for (nanos, robot, is_position, index) in order(recordings) {
            let at = Instant::ZERO.after(Duration::from_nanos(nanos.unsigned_abs()));
            if is_position {
                self.run_to(at);
                self.input(robot, Input::Position(recordings[robot].positions()[index].clone()));
                continue;
            }
            meddle(&mut self, count);
            count += 1;
            self.run_to(at);
            let keyframe = recordings[robot].keyframe(index).map_err(|error| error.to_string())?;
            self.input(robot, Input::Keyframe(keyframe));
        }
        for robot in 0..recordings.len() {
            self.input(robot, Input::Command(Command::Flush));
        }
        self.run_to(self.now.after(SETTLE));
        Ok(self)
    }

    fn new(recordings: &[Recording], seed: u64) -> Result<Self, String> {
        let secret = |k: usize| [k as u8 + 1; 32];
        let public = |k: usize| SigningKey::from_bytes(&secret(k)).verifying_key();
        let mut roster: BTreeMap<Name, [u8; 32]> =
            recordings.iter().enumerate().map(|(k, r)| (r.manifest().robot.clone(), public(k).to_bytes())).collect();
        let liar = Name::new(LIAR).map_err(|error| error.to_string())?;
        roster.insert(liar, SigningKey::from_bytes(&LIAR_SECRET).verifying_key().to_bytes());
        let swarm = Name::new("wires").map_err(|error| error.to_string())?;
        let mut agents = Vec::new();
        for (k, recording) in recordings.iter().enumerate() {
            let manifest = recording.manifest();
            let (name, secret_key) = (manifest.robot.clone(), secret(k));
            let identity = Identity { swarm: swarm.clone(), name, secret_key, roster: roster.clone() };
            let seed = seed.wrapping_add(k as u64);
            let agent = Agent::new(manifest.config.clone(), identity, seed, Restored::default(), Instant::ZERO);
            agents.push(agent.map_err(|error| error.to_string())?);
        }
        let mut wires = Self {
            agents,
            now: Instant::ZERO,
            published: Vec::new(),
            events: Vec::new(),
            statements: Vec::new(),
            inbox: VecDeque::new(),
            loss: None,
        };
        for a in 0..wires.agents.len() {
            for b in (0..wires.agents.len()).filter(|b| *b != a) {
                let robot = wires.agents[b].robot();
                wires.inbox.push_back((a, Input::Neighbour { robot, up: true }));
            }
        }
        wires.settle();
        Ok(wires)
    }

    /// Publishes bytes to every core in the name of `from`, which runs none.
    pub fn publish_as(&mut self, from: RobotId, channel: Channel, bytes: &[u8]) {
        for robot in 0..self.agents.len() {
            self.input(robot, Input::Received { from, channel, bytes: bytes.to_vec() });
        }
    }

    /// Gives one core an input and carries all that follows.
    pub fn input(&mut self, robot: usize, input: Input) {
        self.inbox.push_back((robot, input));
        self.settle();
    }

    /// Lets virtual time pass, in steps to every wake-up that a core asked for.
    pub fn run_to(&mut self, end: Instant) {
        loop {
            let next = self.agents.iter().filter_map(Agent::poll_timeout).min().unwrap_or(end).max(self.now);
            if next > end {
                break;
            }
            self.now = next.after(Duration::from_millis(1));
            for robot in 0..self.agents.len() {
                self.inbox.push_back((robot, Input::Timeout));
            }
            self.settle();
        }
        self.now = self.now.max(end);
    }

    fn settle(&mut self) {
        while let Some((robot, input)) = self.inbox.pop_front() {
            let solved = matches!(&input, Input::JobDone { result: JobResult::Solved(_), .. });
            self.agents[robot].handle(self.now, input);
            while let Some(output) = self.agents[robot].poll_output() {
                self.carry(robot, output);
            }
            if solved {
                self.look(robot);
            }
        }
    }

    /// Notes what a core says of pairs that are merged.
    fn look(&mut self, robot: usize) {
        let mut pairs = self.agents[robot].frames().pairs;
        pairs.retain(|pair| pair.status == PairStatus::Merged);
        let last = self.statements.iter().rev().find(|statement| statement.robot == robot);
        if last.map_or(!pairs.is_empty(), |last| last.pairs != pairs) {
            self.statements.push(Statement { at: self.now, robot, pairs });
        }
    }

    fn is_lost(&mut self) -> bool {
        self.loss.as_mut().is_some_and(|(loss, dice)| dice.chance(*loss))
    }

    fn carry(&mut self, robot: usize, output: Output) {
        match output {
            Output::Persist { batch, .. } => self.inbox.push_back((robot, Input::Persisted { up_to: batch })),
            Output::Publish { channel, bytes } => {
                let from = self.agents[robot].robot();
                for other in (0..self.agents.len()).filter(|other| *other != robot) {
                    if self.is_lost() {
                        continue;
                    }
                    self.inbox.push_back((other, Input::Received { from, channel, bytes: bytes.clone() }));
                }
                self.published.push((robot, channel, bytes));
            }
            Output::Ask { query, peer, kind, bytes } => {
                let token = AskToken(query.0);
                let lost = self.is_lost();
                let other = self.agents.iter().position(|agent| agent.robot() == peer && !lost);
                let bytes = other.and_then(|other| self.ask(other, Input::Asked { token, kind, bytes }, token));
                for bytes in bytes.into_iter().map(Some).chain([None]) {
                    self.inbox.push_back((robot, Input::Answered { query, bytes }));
                }
            }
            Output::Answer { .. } => {}
            Output::Event(event) => self.events.push((robot, event)),
            Output::Run { id, job } => self.inbox.push_back((robot, Input::JobDone { job: id, result: job.run() })),
        }
    }

    fn ask(&mut self, robot: usize, question: Input, token: AskToken) -> Option<Vec<u8>> {
        self.agents[robot].handle(self.now, question);
        let mut answer = None;
        while let Some(output) = self.agents[robot].poll_output() {
            match output {
                Output::Answer { token: of, bytes } if of == token => answer = Some(bytes),
                output => self.carry(robot, output),
            }
        }
        answer
    }
}

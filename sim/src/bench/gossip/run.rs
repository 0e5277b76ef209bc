//! One swarm from the start until all sets are equal.

use super::case::World;
use super::policy::{Gossip, Policy};
use super::radio::Radio;
use crate::dice::Dice;
use crate::field::{Field, Layout, TICK};
use crate::queue::Queue;
use anyhow::Context;
use core::num::NonZero;
use core::time::Duration;
use ed25519_dalek::SigningKey;
use merganser_protocol::config::GossipConfig;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use merganser_protocol::gossip::{Answer, Step};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId};
use merganser_protocol::replica::{Ingested, Replica};
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::fact::{ScaleKind, SubmapFact};
use merganser_protocol::wire::messages::Message;
use merganser_protocol::wire::{Delta, Entry, EntryContent, Fact, HaveRoot, HaveVector};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::rc::Rc;

/// How long an unanswered question is waited for.
const ANSWER_SECS: f64 = 2.0;
/// Time that a steady swarm is given after it became equal, before it is measured.
const SETTLE_SECS: f64 = 60.0;
/// Between two entries that a robot shares, s: a tenth of what its radio can send.
const SHARE_SECS: f64 = 0.08;
/// The log's epoch.
const EPOCH: u32 = 200_000_000;

/// What one run cost.
#[derive(Clone, Debug)]
pub struct Outcome {
    name: &'static str,
    gossip: &'static str,
    seed: u64,
    robots: usize,
    loss: f64,
    /// Seconds from the heal (else from the start) until all sets were equal.
    pub equal_after: Option<f64>,
    /// Bytes per robot that are not entries.
    pub control: Option<f64>,
    /// Bytes of entries sent, over bytes that had to arrive.
    pub data_ratio: Option<f64>,
    /// Bytes per robot and second after all was settled.
    pub steady: Option<f64>,
}

impl Outcome {
    /// The columns of its line.
    pub const HEADER: &'static str =
        "case           robots  loss  gossip  seed   equal after s   control kB/robot   data/needed   steady B/s";

    /// When sets could have been equal at best.
    pub fn of_bound(world: &World, seed: u64, equal_after: Option<f64>) -> Self {
        let (name, robots, loss) = (world.name, world.robots, world.loss);
        Self { name, gossip: "bound", seed, robots, loss, equal_after, control: None, data_ratio: None, steady: None }
    }

    /// Whether all sets became equal.
    pub fn converged(&self) -> bool {
        self.equal_after.is_some()
    }
}

impl fmt::Display for Outcome {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let digits = |value: Option<f64>, n| value.map_or_else(|| "-".into(), |value| format!("{value:.n$}"));
        write!(
            f,
            "{:<14} {:>6} {:>4.0}%  {:<6} {:>5} {:>15} {:>18} {:>13} {:>12}",
            self.name,
            self.robots,
            100.0 * self.loss,
            self.gossip,
            self.seed,
            digits(self.equal_after, 1),
            digits(self.control.map(|bytes| bytes / 1e3), 1),
            digits(self.data_ratio, 3),
            digits(self.steady, 1),
        )
    }
}

/// Runs one swarm.
///
/// # Errors
/// None in practice: keys, names and facts are made here.
pub fn measure(world: &World, policy: Policy, seed: u64) -> anyhow::Result<Outcome> {
    let mut swarm = Swarm::new(world, policy, seed)?;
    swarm.run()?;
    Ok(swarm.outcome(world, policy, seed))
}

/// What it cost that all robots hold what each had.
pub struct Shared {
    /// Bytes of entries sent.
    pub data: usize,
    /// All other bytes sent.
    pub control: usize,
    /// When all sets were equal, s.
    pub equal_after: Option<f64>,
    /// What each robot holds.
    pub replicas: Vec<Replica>,
}

/// Robots in reach of one another, each with payloads of a kind of their own, tell one another.
///
/// # Errors
/// A payload that no entry can hold.
pub fn share(payloads: Vec<Vec<Vec<u8>>>, kind: u8, loss: f64, seed: u64) -> anyhow::Result<Shared> {
    let world = World {
        name: "share",
        robots: payloads.len(),
        loss,
        layout: Layout::Mesh,
        facts: 0,
        fact_every_secs: 0.0,
        heal_at: 0.0,
        until: 600.0,
    };
    let mut swarm = Swarm::new(&world, Policy::Ours, seed)?;
    for (k, payloads) in payloads.into_iter().enumerate() {
        for (n, payload) in payloads.into_iter().enumerate() {
            let at = Instant::ZERO.after(Duration::from_secs_f64(TICK + SHARE_SECS * n as f64));
            swarm.queue.push(at, Event::Share(k, kind, payload));
            swarm.unwritten += 1;
        }
    }
    swarm.run()?;
    let Swarm { data, control, equal_at, nodes, .. } = swarm;
    let replicas = nodes.into_iter().map(|node| node.replica).collect();
    Ok(Shared { data, control, equal_after: equal_at.map(Instant::as_secs_f64), replicas })
}

enum Event {
    Tick,
    Write(usize),
    Share(usize, u8, Vec<u8>),
    Wake(usize),
    Have { to: usize, from: usize, have: HaveRoot },
    Facts { to: usize, entry: Rc<Vec<u8>> },
    Asked { to: usize, from: usize, question: u64, have: Box<HaveVector> },
    Answered { to: usize, from: usize, question: u64, delta: Option<Box<Delta>> },
}

struct Node {
    robot: RobotId,
    key: SigningKey,
    replica: Replica,
    gossip: Gossip,
    links: BTreeSet<usize>,
    /// Questions not answered yet, and when they were asked.
    asking: BTreeMap<u64, Instant>,
    wake: Instant,
    facts: u32,
}

struct Swarm<'a> {
    world: &'a World,
    nodes: Vec<Node>,
    field: Field,
    radio: Radio,
    queue: Queue<Event>,
    rng: ChaCha8Rng,
    dice: Dice,
    questions: u64,
    control: usize,
    data: usize,
    needed: usize,
    equal_at: Option<Instant>,
    settled: Option<(Instant, usize)>,
    /// Payloads still to be shared.
    unwritten: usize,
}

impl<'a> Swarm<'a> {
    fn new(world: &'a World, policy: Policy, seed: u64) -> anyhow::Result<Self> {
        let mut dice = Dice::new(seed, "facts");
        let keys: Vec<SigningKey> =
            (0..world.robots).map(|_| SigningKey::from_bytes(&core::array::from_fn(|_| dice.bits() as u8))).collect();
        let names: Vec<Name> = (0..world.robots).map(|k| Name::new(format!("r{k}"))).collect::<Result<_, _>>()?;
        let roster: Vec<(Name, [u8; 32])> =
            names.into_iter().zip(&keys).map(|(name, key)| (name, key.verifying_key().to_bytes())).collect();
        let swarm = Name::new("bench")?;
        let node = |key: &SigningKey| -> anyhow::Result<Node> {
            let robot = RobotId::of_key(key.verifying_key().as_bytes());
            Ok(Node {
                robot,
                key: key.clone(),
                replica: Replica::new(&swarm, roster.clone(), &GossipConfig::default())?,
                gossip: Gossip::new(policy, robot, Instant::ZERO),
                links: BTreeSet::new(),
                asking: BTreeMap::new(),
                wake: Instant::MAX,
                facts: 0,
            })
        };
        Ok(Self {
            world,
            nodes: keys.iter().map(node).collect::<Result<_, _>>()?,
            field: Field::new(world.layout, world.robots, seed),
            radio: Radio::new(world.robots, world.loss, seed),
            queue: Queue::new(),
            rng: ChaCha8Rng::seed_from_u64(seed),
            dice,
            questions: 0,
            control: 0,
            data: 0,
            needed: 0,
            equal_at: None,
            settled: None,
            unwritten: 0,
        })
    }

    fn run(&mut self) -> anyhow::Result<()> {
        for k in 0..self.nodes.len() {
            for _ in 0..self.world.facts {
                self.write(k)?;
            }
            if self.world.fact_every_secs > 0.0 {
                let at = self.dice.exponential(self.world.fact_every_secs);
                self.queue.push(Instant::ZERO.after(Duration::from_secs_f64(at)), Event::Write(k));
            }
        }
        self.queue.push(Instant::ZERO, Event::Tick);
        while let Some((now, event)) = self.queue.pop() {
            if now.as_secs_f64() > self.world.until || self.is_over() {
                break;
            }
            self.happen(now, event)?;
        }
        Ok(())
    }

    fn is_over(&self) -> bool {
        let steady = self.world.name == "steady";
        self.equal_at.is_some() && !steady
    }

    fn happen(&mut self, now: Instant, event: Event) -> anyhow::Result<()> {
        match event {
            Event::Tick => self.tick(now),
            Event::Write(k) => {
                if now.as_secs_f64() < self.world.heal_at {
                    self.write(k)?;
                    let next = self.dice.exponential(self.world.fact_every_secs);
                    self.queue.push(now.after(Duration::from_secs_f64(next)), Event::Write(k));
                }
            }
            Event::Share(k, kind, payload) => {
                self.unwritten -= 1;
                self.write_payload(now, k, kind, payload)?;
            }
            Event::Wake(k) => {
                if self.nodes[k].wake == now {
                    self.nodes[k].wake = Instant::MAX;
                    self.act(now, k);
                }
            }
            Event::Have { to, from, have } => {
                let from = self.nodes[from].robot;
                let node = &mut self.nodes[to];
                node.gossip.on_have(now, &node.replica, from, have);
                self.act(now, to);
            }
            Event::Facts { to, entry } => {
                self.take(now, to, [entry.as_slice()]);
                self.act(now, to);
            }
            Event::Asked { to, from, question, have } => self.answer(now, to, from, question, &have),
            Event::Answered { to, from, question, delta } => self.answered(now, to, from, question, delta),
        }
        Ok(())
    }

    /// Robots drive, contacts come and go, and sets are compared.
    fn tick(&mut self, now: Instant) {
        let secs = now.as_secs_f64();
        if self.field.moves() || secs == 0.0 || (secs - self.world.heal_at).abs() < 0.5 * TICK {
            self.field.drive(secs, TICK);
            self.connect(now);
        }
        if self.settled.is_none() && self.equal_at.is_some_and(|at| now.since(at).as_secs_f64() > SETTLE_SECS) {
            self.settled = Some((now, self.control));
        }
        self.queue.push(now.after(Duration::from_secs_f64(TICK)), Event::Tick);
    }

    fn connect(&mut self, now: Instant) {
        let cut = now.as_secs_f64() + 1e-6 < self.world.heal_at;
        for a in 0..self.nodes.len() {
            for b in a + 1..self.nodes.len() {
                let (is, was) = (self.field.linked(a, b, cut), self.nodes[a].links.contains(&b));
                if is == was {
                    continue;
                }
                for (x, y) in [(a, b), (b, a)] {
                    let robot = self.nodes[y].robot;
                    let node = &mut self.nodes[x];
                    if is {
                        node.links.insert(y)
                    } else {
                        node.links.remove(&y)
                    };
                    node.gossip.on_neighbour(now, robot, is, &mut self.rng);
                    self.schedule(now, x);
                }
            }
        }
    }

    /// One more fact of robot `k`, published to its neighbours.
    fn write(&mut self, k: usize) -> anyhow::Result<()> {
        let now = self.queue.now();
        let node = &mut self.nodes[k];
        let fact = fact(node.facts)?;
        node.facts += 1;
        let entry = node.replica.append(&node.key, EPOCH, &fact).context("own fact")?;
        self.publish(now, k, &entry);
        Ok(())
    }

    /// One more entry of robot `k`, of a kind that only it knows.
    fn write_payload(&mut self, now: Instant, k: usize, kind: u8, payload: Vec<u8>) -> anyhow::Result<()> {
        let node = &mut self.nodes[k];
        let frame = FrameId { robot: node.robot, epoch: EPOCH };
        let seq = node.replica.next_seq(frame);
        let last = seq.checked_sub(1).and_then(|last| node.replica.entry(EntryId { frame, seq: last }));
        let previous = last.map_or_else(Hash::default, |last| last.hash());
        let id = EntryId { frame, seq };
        let content = EntryContent { swarm: node.replica.swarm(), id, kind, floor: 0, previous, payload };
        let entry = Entry::sign(&node.key, content)?;
        node.replica.ingest(&entry.encode())?;
        self.publish(now, k, &entry);
        Ok(())
    }

    fn publish(&mut self, now: Instant, k: usize, entry: &Entry) {
        let node = &mut self.nodes[k];
        node.replica.mark_durable(entry.id());
        node.gossip.on_news(now, 1);
        let bytes = Rc::new(entry.encode());
        self.needed += bytes.len() * (self.world.robots - 1);
        for to in node.links.clone() {
            self.data += bytes.len();
            if let Some(at) = self.radio.send(now, k, bytes.len()) {
                self.queue.push(at, Event::Facts { to, entry: bytes.clone() });
            }
        }
        self.equal_at = None;
        self.schedule(now, k);
    }

    fn act(&mut self, now: Instant, k: usize) {
        loop {
            let node = &mut self.nodes[k];
            let Some(step) = node.gossip.step(now, &node.replica, &mut self.rng) else { break };
            match step {
                Step::Announce(have) => {
                    let bytes = Message::Have(have).encode().len();
                    for to in self.nodes[k].links.clone() {
                        self.control += bytes;
                        if let Some(at) = self.radio.send(now, k, bytes) {
                            self.queue.push(at, Event::Have { to, from: k, have });
                        }
                    }
                }
                Step::Ask { peer, have } => self.ask(now, k, peer, have),
            }
        }
        self.schedule(now, k);
    }

    fn ask(&mut self, now: Instant, k: usize, peer: RobotId, have: HaveVector) {
        let bytes = Message::SyncRequest(have.clone()).encode().len();
        self.control += bytes;
        self.questions += 1;
        let question = self.questions;
        self.nodes[k].asking.insert(question, now);
        let Some(to) = self.nodes[k].links.iter().copied().find(|to| self.nodes[*to].robot == peer) else { return };
        let late = now.after(Duration::from_secs_f64(ANSWER_SECS));
        self.queue.push(late, Event::Answered { to: k, from: to, question, delta: None });
        if let Some(at) = self.radio.send(now, k, bytes) {
            self.queue.push(at, Event::Asked { to, from: k, question, have: Box::new(have) });
        }
    }

    fn answer(&mut self, now: Instant, k: usize, to: usize, question: u64, have: &HaveVector) {
        let node = &mut self.nodes[k];
        if !node.links.contains(&to) {
            return;
        }
        let Some(have) = node.replica.read_have(have) else { return };
        node.gossip.on_asked(now, &node.replica, &have);
        let delta = node.replica.delta_for(&have, GossipConfig::default().delta_bytes_max);
        let data: usize = delta.entries.iter().map(|entry| entry.0.len()).sum();
        let bytes = Message::SyncReply(delta.clone()).encode().len();
        self.data += data;
        self.control += bytes - data;
        if let Some(at) = self.radio.send(now, k, bytes) {
            self.queue.push(at, Event::Answered { to, from: k, question, delta: Some(Box::new(delta)) });
        }
        self.act(now, k);
    }

    fn answered(&mut self, now: Instant, k: usize, from: usize, question: u64, delta: Option<Box<Delta>>) {
        let Some(asked) = self.nodes[k].asking.remove(&question) else { return };
        let answer = match delta {
            None => Answer::Failed,
            Some(delta) => {
                let new = self.take(now, k, delta.entries.iter().map(|entry| entry.0.as_slice()));
                Answer::Got { new, more: delta.more }
            }
        };
        let peer = self.nodes[from].robot;
        let node = &mut self.nodes[k];
        node.gossip.on_answer(now, &node.replica, peer, asked, answer);
        self.act(now, k);
    }

    fn take<'b>(&mut self, now: Instant, k: usize, entries: impl IntoIterator<Item = &'b [u8]>) -> usize {
        let node = &mut self.nodes[k];
        let mut new = 0;
        for bytes in entries {
            if let Ok(Ingested::New(ids)) = node.replica.ingest(bytes) {
                new += ids.len();
                ids.into_iter().for_each(|id| node.replica.mark_durable(id));
            }
        }
        if new > 0 {
            node.gossip.on_news(now, new);
            self.compare(now);
        }
        new
    }

    /// Notes when all sets have become equal.
    fn compare(&mut self, now: Instant) {
        let digest = self.nodes[0].replica.count();
        let writing = now.as_secs_f64() < self.world.heal_at || self.unwritten > 0;
        if !writing
            && self.equal_at.is_none()
            && self.nodes.iter().all(|node| node.replica.count() == digest)
            && self.nodes.iter().all(|node| node.replica.digest() == self.nodes[0].replica.digest())
        {
            self.equal_at = Some(now);
        }
    }

    fn schedule(&mut self, now: Instant, k: usize) {
        let node = &mut self.nodes[k];
        let wake = node.gossip.timeout().max(now);
        if wake < node.wake {
            node.wake = wake;
            self.queue.push(wake, Event::Wake(k));
        }
    }

    fn outcome(&self, world: &World, policy: Policy, seed: u64) -> Outcome {
        let robots = world.robots as f64;
        Outcome {
            name: world.name,
            gossip: if policy == Policy::Ours { "ours" } else { "plain" },
            seed,
            robots: world.robots,
            loss: world.loss,
            equal_after: self.equal_at.map(|at| at.as_secs_f64() - world.heal_at),
            control: Some(self.control as f64 / robots),
            data_ratio: Some(self.data as f64 / self.needed.max(1) as f64),
            steady: self
                .settled
                .map(|(at, before)| (self.control - before) as f64 / robots / self.queue.now().since(at).as_secs_f64()),
        }
    }
}

/// A submap as a robot would state it: about 550 bytes with its signature.
fn fact(index: u32) -> anyhow::Result<Fact> {
    let covariance = Covariance::from_sigmas([0.01; 6])?;
    Ok(Fact::Submap(SubmapFact {
        index,
        stamps: [Stamp(i64::from(index) * 2_000_000_000), Stamp(i64::from(index + 1) * 2_000_000_000)],
        odometry: PoseWithCovariance { pose: Se3::identity(), covariance },
        extent: [4.0, 3.0, 1.5],
        summary: vec![7; 300],
        keypoint_count: 384,
        blob: Hash::of(&index.to_le_bytes()),
        scale: ScaleKind::Metric,
        keyframes: NonZero::new(4),
    }))
}

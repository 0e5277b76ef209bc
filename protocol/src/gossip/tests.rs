//! Properties of the gossip over a small swarm in virtual time: sets become equal over any graph and loss, nothing is
//! fetched twice without loss, a quiet swarm is nearly silent, forks and different rosters are coped with, and a
//! difference that cannot be mended does not cost a storm.

use super::*;
use crate::config::GossipConfig;
use crate::ids::{EntryId, Name};
use crate::replica::testing::{chain, feed};
use crate::wire::messages::Message;
use crate::wire::samples::{self, key};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

const LATENCY: Duration = Duration::from_millis(20);
const TIMEOUT: f64 = 2.0;

enum Event {
    Have { to: usize, from: RobotId, have: HaveRoot },
    Asked { to: usize, from: usize, asked: Instant, have: HaveVector },
    Answered { to: usize, peer: RobotId, asked: Instant, delta: Option<Option<crate::wire::Delta>> },
}

struct Node {
    robot: RobotId,
    replica: Replica,
    spread: AntiEntropy,
}

struct Swarm {
    nodes: Vec<Node>,
    links: Vec<Vec<usize>>,
    queue: BTreeMap<(Instant, u64), Event>,
    now: Instant,
    count: u64,
    rng: ChaCha8Rng,
    loss: f64,
    /// This one's answers are all lost.
    mute: Option<usize>,
    /// Bytes of announcements, and of questions.
    control: [usize; 2],
    fetched: usize,
    messages: usize,
}

impl Swarm {
    fn new(n: u8, links: impl Fn(usize, usize) -> bool, loss: f64) -> Self {
        Self::with_rosters(n, links, loss, |_| n)
    }

    fn with_rosters(n: u8, links: impl Fn(usize, usize) -> bool, loss: f64, members: impl Fn(u8) -> u8) -> Self {
        let name = |k: u8| Name::new(format!("r{k}")).unwrap();
        let node = |k: u8| {
            let roster = (0..members(k)).map(|m| (name(m), key(m).verifying_key().to_bytes()));
            let replica = Replica::new(&samples::swarm(), roster, &GossipConfig::default()).unwrap();
            let robot = samples::robot(k);
            Node { robot, replica, spread: AntiEntropy::new(robot, 16.0, TIMEOUT, Instant::ZERO) }
        };
        let all = 0..usize::from(n);
        let linked = |a: usize| all.clone().filter(|b| a != *b && links(a.min(*b), a.max(*b))).collect();
        let mut swarm = Self {
            nodes: (0..n).map(node).collect(),
            links: all.clone().map(linked).collect(),
            queue: BTreeMap::new(),
            now: Instant::ZERO,
            count: 0,
            rng: ChaCha8Rng::seed_from_u64(7),
            loss,
            mute: None,
            control: [0; 2],
            fetched: 0,
            messages: 0,
        };
        for (a, peers) in swarm.links.clone().into_iter().enumerate() {
            for b in peers {
                let robot = swarm.nodes[b].robot;
                swarm.nodes[a].spread.on_neighbour(Instant::ZERO, robot, true, &mut swarm.rng);
            }
        }
        swarm
    }

    fn give(&mut self, to: usize, entries: &[Vec<u8>]) {
        let before = self.nodes[to].replica.count();
        feed(&mut self.nodes[to].replica, entries);
        let new = self.nodes[to].replica.count().saturating_sub(before) as usize; // A fork takes a log away.
        self.nodes[to].spread.on_news(self.now, new);
    }

    fn send(&mut self, event: Event) {
        self.messages += 1;
        if self.rng.random_range(0.0..1.0) >= self.loss {
            self.at(self.now.after(LATENCY), event);
        }
    }

    fn at(&mut self, at: Instant, event: Event) {
        self.count += 1;
        self.queue.insert((at, self.count), event);
    }

    fn act(&mut self, k: usize) {
        loop {
            let node = &mut self.nodes[k];
            let Some(step) = node.spread.step(self.now, &node.replica, false, &mut self.rng) else { break };
            let robot = node.robot;
            match step {
                Step::Announce(have) => {
                    for to in self.links[k].clone() {
                        self.control[0] += Message::Have(have).encode().len();
                        self.send(Event::Have { to, from: robot, have });
                    }
                }
                Step::Ask { peer, have } => {
                    let to = self.links[k].iter().copied().find(|to| self.nodes[*to].robot == peer);
                    self.control[1] += Message::SyncRequest(have.clone()).encode().len();
                    let late = self.now.after(Duration::from_secs_f64(TIMEOUT));
                    self.at(late, Event::Answered { to: k, peer, asked: self.now, delta: None });
                    if let Some(to) = to {
                        self.send(Event::Asked { to, from: k, asked: self.now, have });
                    }
                }
            }
        }
    }

    fn happen(&mut self, event: Event) -> usize {
        match event {
            Event::Have { to, from, have } => {
                let node = &mut self.nodes[to];
                node.spread.on_have(self.now, &node.replica, from, have);
                to
            }
            Event::Asked { to, from, asked, have } => {
                let node = &mut self.nodes[to];
                let delta = node.replica.read_have(&have).map(|have| {
                    node.spread.on_asked(self.now, &node.replica, &have);
                    node.replica.delta_for(&have, 8192)
                });
                let peer = node.robot;
                if self.mute != Some(to) {
                    self.send(Event::Answered { to: from, peer, asked, delta: Some(delta) });
                }
                to
            }
            Event::Answered { to, peer, asked, delta } => {
                let answer = match delta {
                    None => Answer::Failed,
                    Some(None) => Answer::Refused,
                    Some(Some(delta)) => {
                        let before = self.nodes[to].replica.count();
                        self.fetched += delta.entries.len();
                        let entries: Vec<_> = delta.entries.into_iter().map(|entry| entry.0).collect();
                        let proofs = delta.forks.iter();
                        let proofs = proofs
                            .filter(|[a, b]| matches!(self.nodes[to].replica.ingest_fork(&a.0, &b.0), Ok((_, true))))
                            .count();
                        let forks = self.nodes[to].replica.forks().count();
                        self.give(to, &entries);
                        let forks = self.nodes[to].replica.forks().count() - forks;
                        let new = self.nodes[to].replica.count().saturating_sub(before) as usize + proofs + forks;
                        self.nodes[to].spread.on_news(self.now, proofs + forks);
                        Answer::Got { new, more: delta.more }
                    }
                };
                let node = &mut self.nodes[to];
                node.spread.on_answer(self.now, &node.replica, peer, asked, answer);
                to
            }
        }
    }

    /// Runs until `secs`, or until all are equal. Returns whether they are.
    fn run(&mut self, secs: f64, stop_when_equal: bool) -> bool {
        let end = Instant::ZERO.after(Duration::from_secs_f64(secs));
        loop {
            (0..self.nodes.len()).for_each(|k| self.act(k));
            if stop_when_equal && self.equal() {
                return true;
            }
            let timers = self.nodes.iter().map(|node| node.spread.timeout()).min();
            let message = self.queue.first_key_value().map(|(at, _)| at.0);
            let next = timers.into_iter().chain(message).min().unwrap_or(Instant::MAX);
            assert!(next > self.now || message == Some(next), "a timer that does not move on");
            if next > end {
                self.now = end;
                return self.equal();
            }
            self.now = next;
            while let Some(entry) = self.queue.first_entry().filter(|entry| entry.key().0 <= next) {
                let event = entry.remove();
                let node = self.happen(event);
                self.act(node);
            }
        }
    }

    fn equal(&self) -> bool {
        self.nodes.iter().all(|node| node.replica.digest() == self.nodes[0].replica.digest())
    }

    fn secs(&self) -> f64 {
        self.now.as_secs_f64()
    }
}

fn ring(n: usize) -> impl Fn(usize, usize) -> bool {
    move |a, b| b - a == 1 || b - a == n - 1
}

#[test]
fn sets_become_equal_over_a_ring_and_nothing_is_fetched_twice() {
    let mut swarm = Swarm::new(8, ring(8), 0.0);
    (0..8).for_each(|k| swarm.give(k, &chain(k as u8, 0, 20, 0)));
    assert!(swarm.run(30.0, true));
    assert!(swarm.secs() < 8.0, "{} s", swarm.secs());
    let needed = 8 * 7 * 20;
    assert_eq!(swarm.fetched, needed);
}

#[test]
fn losses_are_repaired() {
    for loss in [0.1, 0.3, 0.6] {
        let mut swarm = Swarm::new(8, ring(8), loss);
        (0..8).for_each(|k| swarm.give(k, &chain(k as u8, 0, 20, 0)));
        assert!(swarm.run(300.0, true), "loss {loss}");
    }
}

#[test]
fn a_neighbour_that_never_answers_keeps_nobody_back() {
    // Robot 0 hears two that have all it lacks; one of them never answers.
    let mut swarm = Swarm::new(3, |a, b| a == 0 || b - a == 1, 0.0);
    (1..3).for_each(|k| swarm.give(k, &chain(1, 0, 100, 0)));
    swarm.mute = Some(1);
    assert!(swarm.run(30.0, true));
    assert!(swarm.secs() < 3.0, "{} s", swarm.secs());
}

#[test]
fn a_quiet_swarm_is_nearly_silent() {
    let mut swarm = Swarm::new(8, |_, _| true, 0.0);
    (0..8).for_each(|k| swarm.give(k, &chain(k as u8, 0, 5, 0)));
    assert!(swarm.run(60.0, false));
    (swarm.control, swarm.fetched) = ([0; 2], 0);
    assert!(swarm.run(1060.0, false));
    assert_eq!(swarm.fetched, 0);
    let per_robot_and_second = swarm.control.map(|bytes| bytes as f64 / 8.0 / 1000.0);
    // Seven neighbours, every 16 s, 14 bytes, of which the suppressed ones are missing.
    assert!((0.1..7.0).contains(&per_robot_and_second[0]), "{per_robot_and_second:?} B/s");
    // Each neighbour is asked after 1, 2, 4 and 8 minutes, though it says that it holds the same.
    assert!((0.1..5.0).contains(&per_robot_and_second[1]), "{per_robot_and_second:?} B/s");
    // One new fact still reaches everyone fast.
    swarm.give(0, &chain(0, 0, 6, 0));
    let from = swarm.secs();
    assert!(swarm.run(from + 10.0, true) && swarm.secs() < from + 3.5, "{}", swarm.secs() - from);
}

#[test]
fn a_fork_of_equal_lengths_is_found_and_spread() {
    let mut swarm = Swarm::new(6, ring(6), 0.0);
    (0..6).for_each(|k| swarm.give(k, &chain(k as u8, 0, 5, 0)));
    assert!(swarm.run(30.0, true));
    // Robot 1 tells two robots different sixth facts, long after all vectors carried no hashes any more.
    swarm.give(3, &chain(1, 0, 6, 0));
    let mut other = chain(1, 0, 5, 0);
    let last = crate::wire::Entry::decode(other.last().unwrap()).unwrap();
    let content = crate::wire::EntryContent {
        swarm: last.swarm(),
        id: EntryId { seq: 5, ..last.id() },
        kind: 99,
        floor: 0,
        previous: last.hash(),
        payload: b"another story".to_vec(),
    };
    other.push(crate::wire::Entry::sign(&key(1), content).unwrap().encode());
    swarm.give(4, &other);
    let from = swarm.secs();
    assert!(swarm.run(from + 60.0, true));
    let frame = last.id().frame;
    assert!(swarm.nodes.iter().all(|node| node.replica.is_quarantined(frame)));
}

#[test]
fn robots_with_different_rosters_share_what_both_know() {
    // The first four know eight members, the others only six; nobody has facts of the two.
    let mut swarm = Swarm::with_rosters(6, ring(6), 0.0, |k| if k < 4 { 8 } else { 6 });
    (0..6).for_each(|k| swarm.give(k, &chain(k as u8, 0, 9, 0)));
    assert!(swarm.run(60.0, true));
}

#[test]
fn what_cannot_be_mended_costs_no_storm() {
    let mut swarm = Swarm::with_rosters(2, |_, _| true, 0.0, |k| if k == 0 { 8 } else { 7 });
    swarm.give(0, &chain(7, 0, 30, 0)); // The other does not know this member.
    assert!(!swarm.run(600.0, false));
    assert_eq!(swarm.nodes[1].replica.count(), 0);
    assert!(swarm.messages < 200, "{} messages", swarm.messages);
}

/// Robot 0 and robot 1, which after 20 s has what 0 lacks, and an outsider who announces `forged` in the name of `named`
/// ten times a second, and answers nothing. Robot 1 `announces` or is drowned out. How long until robot 0 has all.
fn under(named: &[usize], announces: bool, forged: impl Fn(&Swarm, u64) -> HaveRoot) -> Option<f64> {
    let mut swarm = Swarm::new(5, |a, _| a == 0, 0.0);
    swarm.links[0] = vec![1]; // Nobody answers in the others' names.
    swarm.links[1].retain(|_| announces);
    for k in 0..1_000_u64 {
        if k == 200 {
            swarm.give(1, &chain(1, 0, 30, 0));
        }
        for name in named {
            let (from, have) = (swarm.nodes[*name].robot, forged(&swarm, k));
            let node = &mut swarm.nodes[0];
            node.spread.on_have(swarm.now, &node.replica, from, have);
        }
        swarm.run(0.1 * (k + 1) as f64, false);
        if k > 200 && swarm.nodes[0].replica.digest() == swarm.nodes[1].replica.digest() {
            return Some(swarm.secs() - 20.0);
        }
    }
    None
}

/// Another root each time, of more facts than anybody has.
fn anything(_: &Swarm, k: u64) -> HaveRoot {
    HaveRoot { root: k.to_le_bytes(), count: 1 << 62 }
}

/// That it holds just what robot 0 does.
fn the_same(swarm: &Swarm, _: u64) -> HaveRoot {
    swarm.nodes[0].replica.have_root()
}

#[test]
fn claims_in_the_name_of_robots_that_are_away_starve_nobody() {
    let took = under(&[2, 3, 4], true, anything);
    assert!(took.is_some_and(|secs| secs < 1.0), "{took:?}");
    // Nothing is heard of who has it: it is asked all the same.
    let took = under(&[2, 3, 4], false, anything);
    assert!(took.is_some_and(|secs| secs < 61.0), "{took:?}");
}

#[test]
fn claims_in_the_name_of_who_has_what_is_missing_only_delay() {
    let took = under(&[1], false, anything);
    assert!(took.is_some_and(|secs| secs < 3.0), "{took:?}");
    let took = under(&[1], false, the_same);
    assert!(took.is_some_and(|secs| secs < 61.0), "{took:?}");
}

#[test]
fn checks_cost_no_more_in_a_large_swarm() {
    // Bytes of questions a second and robot, once all hold the same: each robot asks one neighbour a minute at most.
    let quiet = |n: u8| {
        let mut swarm = Swarm::new(n, |_, _| true, 0.0);
        swarm.give(0, &chain(0, 0, 5, 0));
        assert!(swarm.run(1_000.0, false));
        swarm.control = [0; 2];
        assert!(swarm.run(2_000.0, false));
        swarm.control[1] as f64 / f64::from(n) / 1_000.0
    };
    let [few, many] = [quiet(4), quiet(32)];
    assert!(few > 0.1 && many < 1.5 * 8.0 / 3.0 * few, "{few} and {many} B/s");
}

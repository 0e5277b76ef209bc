//! The gossip under test, behind one door.

use super::plain::Plain;
use merganser_protocol::gossip::{Answer, AntiEntropy, Step};
use merganser_protocol::ids::RobotId;
use merganser_protocol::replica::{Have, Replica};
use merganser_protocol::time::Instant;
use merganser_protocol::wire::HaveRoot;
use rand_chacha::ChaCha8Rng;

/// Which gossip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Policy {
    /// The core's.
    Ours,
    /// Fixed interval, whole vector.
    Plain,
}

/// One robot's gossip.
pub enum Gossip {
    Ours(AntiEntropy),
    Plain(Plain),
}

impl Gossip {
    pub fn new(policy: Policy, me: RobotId, now: Instant) -> Self {
        let config = merganser_protocol::config::GossipConfig::default();
        match policy {
            Policy::Ours => Self::Ours(AntiEntropy::new(me, config.have_secs, config.answer_secs, now)),
            Policy::Plain => Self::Plain(Plain::new(me)),
        }
    }

    pub fn on_neighbour(&mut self, now: Instant, robot: RobotId, up: bool, rng: &mut ChaCha8Rng) {
        match self {
            Self::Ours(spread) => {
                spread.on_neighbour(now, robot, up, rng);
            }
            Self::Plain(plain) => plain.on_neighbour(robot, up),
        }
    }

    pub fn on_have(&mut self, now: Instant, replica: &Replica, from: RobotId, have: HaveRoot) {
        match self {
            Self::Ours(spread) => spread.on_have(now, replica, from, have),
            Self::Plain(plain) => plain.on_have(replica, from, have),
        }
    }

    pub fn on_asked(&mut self, now: Instant, replica: &Replica, have: &Have) {
        if let Self::Ours(spread) = self {
            spread.on_asked(now, replica, have);
        }
    }

    pub fn on_answer(&mut self, now: Instant, replica: &Replica, peer: RobotId, asked: Instant, answer: Answer) {
        match self {
            Self::Ours(spread) => spread.on_answer(now, replica, peer, asked, answer),
            Self::Plain(plain) => plain.on_answer(peer),
        }
    }

    pub fn on_news(&mut self, now: Instant, new: usize) {
        if let Self::Ours(spread) = self {
            spread.on_news(now, new);
        }
    }

    pub fn step(&mut self, now: Instant, replica: &Replica, rng: &mut ChaCha8Rng) -> Option<Step> {
        match self {
            Self::Ours(spread) => spread.step(now, replica, false, rng),
            Self::Plain(plain) => plain.step(now, replica, rng),
        }
    }

    pub fn timeout(&self) -> Instant {
        match self {
            Self::Ours(spread) => spread.timeout(),
            Self::Plain(plain) => plain.timeout(),
        }
    }
}

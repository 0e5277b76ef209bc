//! The gossip one would write first: the root every two seconds, the whole vector with hashes to whoever differs, one
//! question at a time. It is the peer that ours is measured against.

use core::time::Duration;
use merganser_protocol::gossip::Step;
use merganser_protocol::ids::RobotId;
use merganser_protocol::replica::{Replica, VectorForm};
use merganser_protocol::time::Instant;
use merganser_protocol::wire::HaveRoot;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::Rng;
use std::collections::BTreeSet;

/// Time between two announcements.
const EVERY: f64 = 2.0;

pub struct Plain {
    me: RobotId,
    neighbours: BTreeSet<RobotId>,
    next: Instant,
    asked: Option<RobotId>,
    differs: Option<RobotId>,
}

impl Plain {
    pub fn new(me: RobotId) -> Self {
        Self { me, neighbours: BTreeSet::new(), next: Instant::ZERO, asked: None, differs: None }
    }

    pub fn on_neighbour(&mut self, robot: RobotId, up: bool) {
        if up {
            self.neighbours.insert(robot);
        } else {
            self.neighbours.remove(&robot);
        }
    }

    pub fn on_have(&mut self, replica: &Replica, from: RobotId, have: HaveRoot) {
        if have.root != replica.root() && self.asked.is_none() {
            self.differs = Some(from);
        }
    }

    pub fn on_answer(&mut self, peer: RobotId) {
        self.asked = self.asked.filter(|asked| *asked != peer);
    }

    pub fn step(&mut self, now: Instant, replica: &Replica, rng: &mut ChaCha8Rng) -> Option<Step> {
        if let Some(peer) = self.differs.take() {
            self.asked = Some(peer);
            let form = VectorForm { tagged: true, ..VectorForm::default() };
            return Some(Step::Ask { peer, have: replica.have(self.me, form) });
        }
        if now < self.next {
            return None;
        }
        let jitter = f64::from(rng.next_u32()) / f64::from(u32::MAX);
        self.next = now.after(Duration::from_secs_f64(EVERY * (0.9 + 0.2 * jitter)));
        (!self.neighbours.is_empty()).then(|| Step::Announce(replica.have_root()))
    }

    pub fn timeout(&self) -> Instant {
        if self.differs.is_some() { Instant::ZERO } else { self.next }
    }
}

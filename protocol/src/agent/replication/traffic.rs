//! What goes on the link, and what waits (DESIGN §4): everything sent is paid from one [`Budget`]; new entries of ours
//! wait in order for their turn, answers are cut to what is left or put off, and what is put off is asked for again.

use super::Replication;
use crate::agent::context::Context;
use crate::agent::io::{Channel, Output};
use crate::gossip::{Budget, Class, PIECE_BYTES_MIN, REPAIR_BYTES_MIN};
use crate::ids::{EntryId, Hash};
use crate::replica::Have;
use crate::time::Instant;
use crate::wire::Delta;
use crate::wire::messages::{Message, carried_len};
use crate::wire::slice::{self, PIECE_STEP};
use std::collections::VecDeque;

/// New entries of ours that wait for the link; of more the oldest are left to repair.
pub const UNSENT_MAX: usize = 256;

/// The agent's side of the budget.
pub(super) struct Traffic {
    budget: Budget,
    /// New entries of ours that wait.
    unsent: VecDeque<EntryId>,
    /// A turn to announce or ask is held back until then, and was counted.
    held_until: Instant,
}

impl Traffic {
    pub(super) fn new(bytes_per_sec: f64, now: Instant) -> Self {
        let budget = Budget::new(bytes_per_sec, now);
        Self { budget, unsent: VecDeque::new(), held_until: now }
    }

    /// Whether a message of this class may go.
    pub(super) fn may(&self, now: Instant, class: Class) -> bool {
        self.budget.may(now, class)
    }

    /// When a message of this class may go, from `now` on.
    pub(super) fn due(&self, now: Instant, class: Class) -> Instant {
        self.budget.due(now, class)
    }

    /// When the next of our waiting entries may go.
    pub(super) fn timeout(&self, now: Instant) -> Option<Instant> {
        (!self.unsent.is_empty()).then(|| self.due(now, Class::Facts))
    }
}

impl Replication {
    /// Broadcasts.
    pub(super) fn publish(&mut self, context: &mut Context, channel: Channel, message: &Message) {
        let bytes = self.pay_for(context, message);
        context.put(Output::Publish { channel, bytes });
    }

    /// The bytes of a message that goes out, counted and paid.
    pub(super) fn pay_for(&mut self, context: &mut Context, message: &Message) -> Vec<u8> {
        let bytes = count(context, message);
        self.gossip.traffic.budget.pay(context.now(), bytes.len());
        bytes
    }

    /// The same for an answer, which takes nothing from the classes above its own.
    pub(super) fn pay_for_answer(&mut self, context: &mut Context, class: Class, message: &Message) -> Vec<u8> {
        let bytes = count(context, message);
        self.gossip.traffic.budget.pay_answer(context.now(), class, bytes.len());
        bytes
    }

    /// Whether to announce, ask or negotiate now. If not, a turn is held back: one each time that the link is full.
    pub(super) fn may_speak(&mut self, context: &mut Context) -> bool {
        let Traffic { budget, held_until, .. } = &mut self.gossip.traffic;
        let may = budget.may(context.now(), Class::Have);
        if !may && *held_until <= context.now() {
            *held_until = budget.due(context.now(), Class::Have);
            context.count().held_back(Class::Have, 1);
        }
        may
    }

    /// Publishes entries of ours that just became durable, or has them wait.
    pub(super) fn publish_entries(&mut self, context: &mut Context, ids: &[EntryId]) {
        self.gossip.traffic.unsent.extend(ids);
        self.publish_unsent(context);
        let unsent = &mut self.gossip.traffic.unsent;
        let held = unsent.len().min(ids.len());
        // Repair brings the others; the latest are the most wanted.
        unsent.drain(..unsent.len().saturating_sub(UNSENT_MAX));
        if held > 0 {
            context.count().held_back(Class::Facts, held);
        }
    }

    /// Publishes what waits, as far as there is room.
    pub(super) fn publish_unsent(&mut self, context: &mut Context) {
        if self.is_alone() {
            return self.gossip.traffic.unsent.clear(); // Nobody listens; whoever comes will sync.
        }
        while !self.gossip.traffic.unsent.is_empty() && self.gossip.traffic.may(context.now(), Class::Facts) {
            let entries = self.next_unsent(context);
            for message in Message::facts(entries) {
                self.publish(context, Channel::Facts, &message);
            }
        }
    }

    /// The entries that go next: one at least, and as many as there is room for.
    fn next_unsent(&mut self, context: &Context) -> Vec<Vec<u8>> {
        let Traffic { budget, unsent, .. } = &mut self.gossip.traffic;
        let mut left = budget.left(context.now(), Class::Facts);
        let mut entries = Vec::new();
        while let Some(id) = unsent.front() {
            // One that a floor has replaced meanwhile is gone.
            let bytes = self.replica.entry_bytes(*id).map(<[u8]>::to_vec);
            let len = bytes.as_ref().map_or(0, |bytes| carried_len(bytes.len()));
            if len > left && !entries.is_empty() {
                break;
            }
            left = left.saturating_sub(len);
            entries.extend(bytes);
            unsent.pop_front();
        }
        entries
    }

    /// What the holder of `have` lacks, as much of it as there is room for. If there is no room for what is there, the
    /// answer says that there is more, and holds nothing: it is asked for again.
    pub(super) fn repair(&mut self, context: &mut Context, have: &Have) -> Delta {
        let left = self.gossip.traffic.budget.left(context.now(), Class::Repair);
        let delta =
            self.replica.delta_for(have, left.max(REPAIR_BYTES_MIN).min(context.config().gossip.delta_bytes_max));
        if left >= REPAIR_BYTES_MIN || carried_by(&delta) <= left {
            return delta;
        }
        context.count().held_back(Class::Repair, 1);
        Delta { more: true, ..Delta::default() }
    }

    /// The part of a blob that was asked for, as much of it as there is room for, in steps that can be proved; an empty
    /// one says "not now".
    pub(super) fn piece(&self, context: &mut Context, hash: Hash, offset: usize, len: usize) -> Option<Message> {
        let blob = self.blobs.get(hash).filter(|blob| offset < blob.len())?;
        let asked = offset..offset.saturating_add(len).min(blob.len());
        let left = self.gossip.traffic.budget.left(context.now(), Class::Blob);
        let fits = left >= PIECE_BYTES_MIN || asked.len() <= left;
        let end = [asked.end, offset.saturating_add(left)].into_iter().min().unwrap_or(offset);
        let end = if end == blob.len() { end } else { end - end % PIECE_STEP };
        let piece = offset..if fits { end } else { offset };
        if !fits {
            context.count().held_back(Class::Blob, 1);
        } else if !slice::is_aligned(blob.len(), &piece) {
            return None; // What begins or ends between two steps cannot be proved.
        }
        let (bytes, proof) = (blob[piece.clone()].to_vec(), slice::proof(blob, piece));
        Some(Message::BlobReply { hash, offset: offset as u32, total: blob.len() as u32, bytes, proof })
    }
}

/// The bytes of a message that goes out, counted.
fn count(context: &mut Context, message: &Message) -> Vec<u8> {
    let bytes = message.encode();
    context.count().sent(message.kind(), bytes.len());
    bytes
}

fn carried_by(delta: &Delta) -> usize {
    delta.entries.iter().chain(delta.forks.iter().flatten()).map(|entry| carried_len(entry.0.len())).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::agent::io::{Input, Record};
    use crate::agent::{Agent, Identity, Restored};
    use crate::config::Config;
    use crate::ids::Name;
    use crate::replica::testing::{MEMBERS, chain};
    use crate::wire::samples::{self, key};

    /// Robot 0 with a log of so many entries, and robot 1 in reach; its link is in debt.
    fn starved(entries: u32) -> (Agent, Vec<EntryId>) {
        let name = |n: u8| Name::new(format!("r{n}")).unwrap();
        let roster = (0..MEMBERS).map(|n| (name(n), key(n).verifying_key().to_bytes())).collect();
        let identity = Identity { swarm: samples::swarm(), name: name(0), secret_key: key(0).to_bytes(), roster };
        let id = |seq| EntryId { frame: samples::frame(0, 1), seq };
        let records = (0..).map(id).zip(chain(0, 1, entries, 0));
        let records = records.map(|(id, bytes)| Record::Entry { id, bytes }).collect();
        let mut config = Config::default();
        config.gossip.link_bytes_per_sec = 20_000.0;
        let restored = Restored { records, fresh_epoch: 1 };
        let mut agent = Agent::new(config, identity, 1, restored, Instant::ZERO).unwrap();
        agent.handle(Instant::ZERO, Input::Neighbour { robot: samples::robot(1), up: true });
        agent.replication.gossip.traffic.budget.pay(Instant::ZERO, usize::MAX);
        while agent.poll_output().is_some() {}
        (agent, (0..entries).map(id).collect())
    }

    fn published(agent: &mut Agent) -> Vec<Vec<u8>> {
        let mut entries = Vec::new();
        while let Some(output) = agent.poll_output() {
            if let Output::Publish { channel: Channel::Facts, bytes } = output {
                let Ok(Message::Facts(facts)) = Message::decode(&bytes) else { panic!() };
                entries.extend(facts.into_iter().map(|entry| entry.0));
            }
        }
        entries
    }

    #[test]
    fn new_entries_wait_for_the_link_in_order_and_of_too_many_the_oldest_are_left_to_repair() {
        for excess in [0, 1] {
            let (mut agent, ids) = starved((UNSENT_MAX + excess) as u32);
            agent.replication.publish_entries(&mut agent.context, &ids);
            assert!(published(&mut agent).is_empty());
            assert_eq!(agent.context.stats().held_back["facts"], ids.len() as u64);
            let mut came = Vec::new();
            let mut messages = 0;
            while came.len() < UNSENT_MAX {
                let due = agent.poll_timeout().unwrap();
                agent.handle(due, Input::Timeout);
                let new = published(&mut agent);
                messages += usize::from(!new.is_empty());
                came.extend(new);
            }
            let wanted: Vec<Vec<u8>> =
                ids[excess..].iter().map(|id| agent.replication.replica.entry_bytes(*id).unwrap().to_vec()).collect();
            assert_eq!(came, wanted);
            assert!(messages > 4, "as the link has room: {messages}");
            assert!(agent.replication.gossip.traffic.unsent.is_empty());
        }
    }

    #[test]
    fn entries_that_wait_are_forgotten_when_nobody_listens() {
        let (mut agent, ids) = starved(3);
        agent.replication.publish_entries(&mut agent.context, &ids);
        agent.handle(Instant::ZERO, Input::Neighbour { robot: samples::robot(1), up: false });
        assert!(agent.replication.gossip.traffic.unsent.is_empty());
    }
}

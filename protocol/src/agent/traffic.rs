//! What goes on the link, and what waits (DESIGN §4): everything sent is paid from one [`Budget`]; new entries of ours
//! wait in order for their turn, answers are cut to what is left or put off, and what is put off is asked for again.

use super::Agent;
use super::gossip::Gossip;
use super::io::{Channel, Output, QueryId};
use crate::gossip::{Budget, Class, PIECE_BYTES_MIN, REPAIR_BYTES_MIN};
use crate::ids::{EntryId, Hash};
use crate::replica::Have;
use crate::time::Instant;
use crate::wire::Delta;
use crate::wire::limits::BLOB_PIECE_LEN;
use crate::wire::messages::{Message, carried_len};
use core::time::Duration;
use std::collections::{BTreeMap, VecDeque};

/// New entries of ours that wait for the link; of more the oldest are left to repair.
pub const UNSENT_MAX: usize = 256;
/// Times in a row that a piece of a blob may be put off; then its holder counts as one that does not have it.
pub const POSTPONED_MAX: u32 = 8;
/// Pause after a piece of a blob was put off; it doubles...
const POSTPONED_PAUSE: Duration = Duration::from_millis(500);
/// ...so many times at most.
const POSTPONED_DOUBLINGS: u32 = 4;

/// The agent's side of the budget.
pub(super) struct Traffic {
    budget: Budget,
    /// New entries of ours that wait.
    unsent: VecDeque<EntryId>,
    /// A turn to announce or ask is held back until then, and was counted.
    held_until: Instant,
    /// Times in a row that the next piece of a blob was put off.
    postponed: BTreeMap<Hash, u32>,
}

impl Traffic {
    pub(super) fn new(bytes_per_sec: f64, now: Instant) -> Self {
        let budget = Budget::new(bytes_per_sec, now);
        Self { budget, unsent: VecDeque::new(), held_until: now, postponed: BTreeMap::new() }
    }

    /// Whether a message of this class may go.
    pub(super) fn may(&self, now: Instant, class: Class) -> bool {
        self.budget.may(now, class)
    }

    /// When a message of this class may go, from `now` on.
    pub(super) fn due(&self, now: Instant, class: Class) -> Instant {
        self.budget.due(now, class)
    }

    /// A piece of this blob came.
    pub(super) fn not_postponed(&mut self, hash: Hash) {
        self.postponed.remove(&hash);
    }

    /// When the next of our waiting entries may go.
    pub(super) fn timeout(&self, now: Instant) -> Option<Instant> {
        (!self.unsent.is_empty()).then(|| self.due(now, Class::Facts))
    }
}

impl Agent {
    /// Broadcasts.
    pub(super) fn publish(&mut self, channel: Channel, message: &Message) {
        let bytes = self.pay_for(message);
        self.context.put(Output::Publish { channel, bytes });
    }

    /// The bytes of a message that goes out, counted and paid.
    pub(super) fn pay_for(&mut self, message: &Message) -> Vec<u8> {
        let bytes = self.count(message);
        self.gossip.traffic.budget.pay(self.context.now(), bytes.len());
        bytes
    }

    /// The same for an answer, which takes nothing from the classes above its own.
    pub(super) fn pay_for_answer(&mut self, class: Class, message: &Message) -> Vec<u8> {
        let bytes = self.count(message);
        self.gossip.traffic.budget.pay_answer(self.context.now(), class, bytes.len());
        bytes
    }

    fn count(&mut self, message: &Message) -> Vec<u8> {
        let bytes = message.encode();
        self.context.count().sent(message.kind(), bytes.len());
        bytes
    }

    /// Whether to announce, ask or negotiate now. If not, a turn is held back: one each time that the link is full.
    pub(super) fn may_speak(&mut self) -> bool {
        let Traffic { budget, held_until, .. } = &mut self.gossip.traffic;
        let may = budget.may(self.context.now(), Class::Have);
        if !may && *held_until <= self.context.now() {
            *held_until = budget.due(self.context.now(), Class::Have);
            self.context.count().held_back(Class::Have, 1);
        }
        may
    }

    /// Publishes entries of ours that just became durable, or has them wait.
    pub(super) fn publish_entries(&mut self, ids: &[EntryId]) {
        self.gossip.traffic.unsent.extend(ids);
        self.publish_unsent();
        let unsent = &mut self.gossip.traffic.unsent;
        let held = unsent.len().min(ids.len());
        // Repair brings the others; the latest are the most wanted.
        unsent.drain(..unsent.len().saturating_sub(UNSENT_MAX));
        if held > 0 {
            self.context.count().held_back(Class::Facts, held);
        }
    }

    /// Publishes what waits, as far as there is room.
    pub(super) fn publish_unsent(&mut self) {
        if self.is_alone() {
            return self.gossip.traffic.unsent.clear(); // Nobody listens; whoever comes will sync.
        }
        while !self.gossip.traffic.unsent.is_empty() && self.gossip.traffic.may(self.context.now(), Class::Facts) {
            let entries = self.next_unsent();
            for message in Message::facts(entries) {
                self.publish(Channel::Facts, &message);
            }
        }
    }

    /// The entries that go next: one at least, and as many as there is room for.
    fn next_unsent(&mut self) -> Vec<Vec<u8>> {
        let Traffic { budget, unsent, .. } = &mut self.gossip.traffic;
        let mut left = budget.left(self.context.now(), Class::Facts);
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
    pub(super) fn repair(&mut self, have: &Have) -> Delta {
        let left = self.gossip.traffic.budget.left(self.context.now(), Class::Repair);
        let delta =
            self.replica.delta_for(have, left.max(REPAIR_BYTES_MIN).min(self.context.config().gossip.delta_bytes_max));
        if left >= REPAIR_BYTES_MIN || carried_by(&delta) <= left {
            return delta;
        }
        self.context.count().held_back(Class::Repair, 1);
        Delta { more: true, ..Delta::default() }
    }

    /// The part of a blob that was asked for, as much of it as there is room for; an empty one says "not now".
    pub(super) fn piece(&mut self, hash: Hash, offset: usize, len: usize) -> Option<Message> {
        let blob = self.gossip.blob(hash)?;
        let asked = blob.get(offset..offset.saturating_add(len).min(blob.len()))?; // Beyond its end there is nothing.
        let left = self.gossip.traffic.budget.left(self.context.now(), Class::Blob);
        let fits = left >= PIECE_BYTES_MIN || asked.len() <= left;
        let bytes = if fits { asked[..asked.len().min(left)].to_vec() } else { Vec::new() };
        let total = blob.len() as u32;
        if !fits {
            self.context.count().held_back(Class::Blob, 1);
        }
        Some(Message::BlobReply { hash, offset: offset as u32, total, bytes })
    }

    /// The holder of a blob has no room on its link: it is asked again after a pause, and after many counts as one that
    /// does not have it.
    pub(super) fn fetch_postponed(&mut self, query: QueryId, hash: Hash) {
        let Gossip { traffic, .. } = &mut self.gossip;
        traffic.postponed.retain(|hash, _| self.negotiation.fetches.contains_key(hash));
        let times = traffic.postponed.entry(hash).or_default();
        *times += 1;
        if *times > POSTPONED_MAX {
            traffic.postponed.remove(&hash);
            return self.negotiation.fetch_failed(query, self.context.now());
        }
        let pause = POSTPONED_PAUSE * 2u32.pow((*times - 1).min(POSTPONED_DOUBLINGS));
        if let Some(fetch) = self.negotiation.fetches.get_mut(&hash) {
            fetch.query = None;
            fetch.not_before = self.context.now().after(pause);
        }
    }
}

/// Whether a piece has a length that an honest holder would send, of a blob of which so much is lacking.
pub(super) fn is_piece(len: usize, lacking: usize) -> bool {
    (lacking.min(PIECE_BYTES_MIN)..=lacking.min(BLOB_PIECE_LEN)).contains(&len)
}

fn carried_by(delta: &Delta) -> usize {
    delta.entries.iter().chain(delta.forks.iter().flatten()).map(|entry| carried_len(entry.0.len())).sum()
}

#[cfg(test)]
mod tests {
    use super::super::negotiation::Fetch;
    use super::super::{Identity, Restored};
    use super::*;
    use crate::agent::io::{Input, Record};
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
        agent.gossip.traffic.budget.pay(Instant::ZERO, usize::MAX);
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
            agent.publish_entries(&ids);
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
                ids[excess..].iter().map(|id| agent.replica.entry_bytes(*id).unwrap().to_vec()).collect();
            assert_eq!(came, wanted);
            assert!(messages > 4, "as the link has room: {messages}");
            assert!(agent.gossip.traffic.unsent.is_empty());
        }
    }

    #[test]
    fn entries_that_wait_are_forgotten_when_nobody_listens() {
        let (mut agent, ids) = starved(3);
        agent.publish_entries(&ids);
        agent.handle(Instant::ZERO, Input::Neighbour { robot: samples::robot(1), up: false });
        assert!(agent.gossip.traffic.unsent.is_empty());
    }

    #[test]
    fn a_blob_that_is_put_off_is_asked_for_again_until_its_holder_counts_as_one_without_it() {
        let (mut agent, _) = starved(1);
        let (hash, query) = (Hash::of(b"x"), QueryId(7));
        let mut fetch = Fetch::new(samples::robot(1), Instant::ZERO);
        fetch.query = Some(query);
        agent.negotiation.fetches.insert(hash, fetch);
        let mut pauses = Vec::new();
        for _ in 0..POSTPONED_MAX {
            agent.negotiation.fetches.get_mut(&hash).unwrap().query = Some(query);
            agent.fetch_postponed(query, hash);
            let fetch = &agent.negotiation.fetches[&hash];
            assert!(fetch.failures == 0 && fetch.query.is_none());
            pauses.push(fetch.not_before.since(Instant::ZERO).as_millis());
        }
        assert_eq!(pauses[..6], [500, 1_000, 2_000, 4_000, 8_000, 8_000]);
        agent.negotiation.fetches.get_mut(&hash).unwrap().query = Some(query);
        agent.fetch_postponed(query, hash);
        assert_eq!(agent.negotiation.fetches[&hash].failures, 1);
        agent.gossip.traffic.not_postponed(hash);
        agent.fetch_postponed(query, hash);
        assert_eq!(agent.negotiation.fetches[&hash].not_before.since(Instant::ZERO).as_millis(), 500);
    }

    #[test]
    fn a_piece_is_neither_too_short_nor_too_long() {
        let lengths = |lacking| {
            [PIECE_BYTES_MIN - 1, PIECE_BYTES_MIN, 5_000, BLOB_PIECE_LEN, BLOB_PIECE_LEN + 1]
                .map(|len| is_piece(len, lacking))
        };
        assert_eq!(lengths(40_000), [false, true, true, true, false]);
        assert_eq!(lengths(5_000), [false, true, true, false, false]);
        assert_eq!(lengths(PIECE_BYTES_MIN - 1), [true, false, false, false, false], "the last may be short");
    }
}

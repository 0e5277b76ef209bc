//! How the agent talks (DESIGN §4): new entries of ours are published once; [`crate::gossip`] decides what else is said
//! about facts, and [`super::traffic`] whether there is room for it; blobs are fetched on demand from whoever may have
//! them. Pose beacons are hints: best effort, latest wins, never facts.

use super::Agent;
use super::beacons::SeenBeacon;
use super::io::{AskToken, Channel, Output, QueryId, QueryKind};
use super::knowledge::{Pair, pair_of};
use super::ledger::BATCHES_WAITING_MAX;
use super::recent::Recent;
use super::traffic::{Traffic, is_piece};
use crate::config::GossipConfig;
use crate::gossip::{Answer, AntiEntropy, Class, Step};
use crate::ids::{Hash, RobotId, SubmapId};
use crate::time::{Instant, Stamp};
use crate::wire::limits::BLOB_PIECE_LEN;
use crate::wire::messages::{AlignStatus, Message};
use crate::wire::{Beacon, BeaconContent};
use core::time::Duration;
use std::collections::{BTreeMap, BTreeSet};

/// Raw blobs kept in memory to serve others: of each own submap two.
pub const BLOBS_MAX: usize = 4_096;
/// A beacon that tells nothing new waits so many times `gossip.pose_secs`.
const REPEAT_PAUSES: f64 = 2.5;
/// Shortest time between two wishes ([`Message::AlignRequest`]).
const WISH_EVERY: Duration = Duration::from_secs(2);

/// What the gossip remembers.
pub(super) struct Gossip {
    pub(super) spread: AntiEntropy,
    pub(super) traffic: Traffic,
    beacons: BTreeMap<RobotId, SeenBeacon>,
    blobs: Recent<Vec<u8>>,
    questions: BTreeMap<QueryId, Question>,
    /// When the last beacon of ours went out, and the keyframe that it told of.
    posed: (Instant, Option<Stamp>),
    next_piece: Instant,
    next_wish: Instant,
    beacon_counter: u64,
}

/// A question of ours under way.
#[derive(Clone, Copy, Debug)]
struct Question {
    peer: RobotId,
    about: About,
    asked: Instant,
    expires: Instant,
}

#[derive(Clone, Copy, Debug)]
enum About {
    Sync,
    Blob(Hash),
    Align,
}

impl Gossip {
    pub(super) fn new(me: RobotId, config: &GossipConfig, now: Instant) -> Self {
        Self {
            spread: AntiEntropy::new(me, config.have_secs, config.answer_secs, now),
            traffic: Traffic::new(config.link_bytes_per_sec, now),
            beacons: BTreeMap::new(),
            blobs: Recent::default(),
            questions: BTreeMap::new(),
            posed: (now, None),
            next_piece: now,
            next_wish: now,
            beacon_counter: 0,
        }
    }

    pub(super) fn beacon(&self, robot: RobotId) -> Option<&SeenBeacon> {
        self.beacons.get(&robot)
    }

    pub(super) fn beacons(&self) -> impl Iterator<Item = (RobotId, &SeenBeacon)> {
        self.beacons.iter().map(|(robot, seen)| (*robot, seen))
    }

    /// Whether the next piece of a blob may be asked for.
    pub(super) fn may_fetch(&self, now: Instant) -> bool {
        now >= self.next_piece()
    }

    /// When the next piece of a blob may be asked for.
    pub(super) fn next_piece(&self) -> Instant {
        self.traffic.due(self.next_piece, Class::Blob)
    }

    pub(super) fn blob(&self, hash: Hash) -> Option<&[u8]> {
        self.blobs.get(hash).map(Vec::as_slice)
    }

    /// Whether a blob more makes another one go.
    pub(super) fn is_full(&self) -> bool {
        self.blobs.len() >= BLOBS_MAX
    }

    /// Keeps a blob. Beyond [`BLOBS_MAX`] one goes that is not among `ours`, which are told only then: what others
    /// made they can serve themselves. If all are ours, what others made is not kept.
    pub(super) fn add_blob(&mut self, hash: Hash, bytes: Vec<u8>, ours: Option<BTreeSet<Hash>>) {
        if let Some(ours) = ours.filter(|_| self.is_full() && self.blobs.get(hash).is_none()) {
            let has_gone = self.blobs.drop_oldest(|hash| !ours.contains(hash))
                || (ours.contains(&hash) && self.blobs.drop_oldest(|_| true));
            if !has_gone {
                return;
            }
        }
        self.blobs.insert(hash, bytes);
    }
}

impl Agent {
    pub(super) fn gossip_timeout(&self) -> Option<Instant> {
        let Gossip { spread, traffic, .. } = &self.gossip;
        let speak = spread.timeout().max(traffic.due(self.context.now(), Class::Have));
        [Some(speak), Some(self.pose_due()), traffic.timeout(self.context.now())].into_iter().flatten().min()
    }

    pub(super) fn run_timers(&mut self) {
        self.expire_questions();
        self.publish_unsent();
        self.spread();
        if self.context.now() >= self.pose_due() {
            self.gossip.posed = (self.context.now(), self.stamp());
            self.publish_pose();
        }
        if self.context.now() >= self.gossip.next_wish {
            self.gossip.next_wish = self.context.now().after(WISH_EVERY);
            self.send_wish();
        }
    }

    /// Does what the gossip about facts wants done now, as long as there is room for it.
    fn spread(&mut self) {
        // While received entries wait for the disk our vector is stale: asking now would fetch them twice.
        let busy = !self.ledger.waiting.is_empty() || self.context.kept() > 0;
        while self.gossip.traffic.may(self.context.now(), Class::Have) {
            let Some(step) = self.gossip.spread.step(self.context.now(), &self.replica, busy, self.context.rng())
            else {
                return;
            };
            match step {
                Step::Announce(root) => self.publish(Channel::Have, &Message::Have(root)),
                Step::Ask { peer, have } => {
                    self.ask(peer, QueryKind::Sync, &Message::SyncRequest(have), About::Sync);
                }
            }
        }
        if self.gossip.spread.timeout() <= self.context.now() {
            self.may_speak();
        }
    }

    /// A keyframe is told of at once, if the last beacon went out `pose_secs` ago: late news would be taken for a place
    /// where we no longer are. Without a new one the beacon is repeated, less often, for who missed it.
    fn pose_due(&self) -> Instant {
        let (at, told) = self.gossip.posed;
        let pauses = if self.stamp() == told { REPEAT_PAUSES } else { 1.0 };
        at.after(Duration::from_secs_f64(pauses * self.context.config().gossip.pose_secs))
    }

    /// Of our last keyframe, once there is a beacon to send of it.
    fn stamp(&self) -> Option<Stamp> {
        self.mapper.body().map(|(_, _, stamp)| stamp)
    }

    fn publish_pose(&mut self) {
        if self.is_alone() {
            return;
        }
        let Some((index, t_anchor_body, stamp)) = self.mapper.body() else { return };
        self.gossip.beacon_counter += 1;
        let anchor = SubmapId { frame: self.context.frame(), index };
        let counter = self.gossip.beacon_counter;
        let content = BeaconContent { anchor, stamp, counter, t_anchor_body };
        match Beacon::sign(&self.context.me().key, self.replica.swarm(), &content) {
            Ok(beacon) => self.publish(Channel::Pose, &Message::Pose(beacon)),
            Err(error) => self.context.reject(Some(self.context.robot()), "own pose", &error.to_string()),
        }
    }

    pub(super) fn is_alone(&self) -> bool {
        self.gossip.spread.neighbours().next().is_none()
    }

    fn ask(&mut self, peer: RobotId, kind: QueryKind, message: &Message, about: About) -> QueryId {
        let query = self.context.new_query();
        let bytes = self.pay_for(message);
        let expires = self.context.now().after(Duration::from_secs_f64(3.0 * self.context.config().gossip.answer_secs));
        self.gossip.questions.insert(query, Question { peer, about, asked: self.context.now(), expires });
        self.context.put(Output::Ask { query, peer, kind, bytes });
        query
    }

    pub(super) fn on_neighbour(&mut self, robot: RobotId, up: bool) {
        if robot == self.context.robot() || self.replica.name_of(robot).is_none() {
            return;
        }
        if self.gossip.spread.on_neighbour(self.context.now(), robot, up, self.context.rng()) && up {
            self.negotiation.out_of_reach.clear();
            self.negotiation.mark_dirty();
        }
    }

    pub(super) fn on_received(&mut self, from: RobotId, channel: Channel, bytes: &[u8]) {
        let message = match Message::decode(bytes) {
            Ok(message) => message,
            Err(error) => return self.context.reject(Some(from), error.reason(), &error.to_string()),
        };
        self.context.count().received(message.kind(), bytes.len());
        match (channel, message) {
            (Channel::Pose, Message::Pose(beacon)) => self.on_beacon(from, &beacon),
            (Channel::Facts, Message::Facts(_)) if self.is_overloaded() => {
                // Nothing is lost: it comes again when the sets are compared.
                let detail = format!("{BATCHES_WAITING_MAX} batches wait for the disk");
                self.context.reject(Some(from), "facts: overload", &detail);
            }
            (Channel::Facts, Message::Facts(entries)) => {
                for entry in &entries {
                    self.ingest(Some(from), &entry.0);
                }
            }
            (Channel::Have, Message::Have(_)) if self.replica.name_of(from).is_none() => {
                self.context.reject(
                    Some(from),
                    "have: unknown robot",
                    "the key names a robot that is not in the roster",
                );
            }
            (Channel::Have, Message::Have(have)) => {
                self.gossip.spread.on_have(self.context.now(), &self.replica, from, have);
            }
            (_, other) => self.context.reject(Some(from), "wrong channel", other.kind()),
        }
    }

    fn on_beacon(&mut self, from: RobotId, beacon: &Beacon) {
        if !self.replica.verify_beacon(beacon) {
            return self.context.reject(Some(from), "pose: signature", "beacon not signed by the robot it names");
        }
        let robot = beacon.robot();
        let newer = self.gossip.beacons.get(&robot).is_none_or(|seen| {
            // The counter begins anew with the process, the stamps of one epoch do not.
            let age = |content: &BeaconContent| (content.anchor.frame.epoch, content.stamp, content.counter);
            age(beacon) > age(&seen.content)
        });
        if newer && robot != self.context.robot() {
            let seen = SeenBeacon::after(self.gossip.beacons.get(&robot), **beacon, self.context.now());
            self.gossip.beacons.insert(robot, seen);
        }
    }

    /// Asks for the next piece of a blob. Pieces are paced: on a slow link a whole blob would delay poses by half a
    /// second, whatever their priority, because the queue is the kernel's.
    pub(super) fn fetch_blob(&mut self, hash: Hash, offset: usize, peer: RobotId) -> QueryId {
        let pause = BLOB_PIECE_LEN as f64 / self.context.config().gossip.blob_bytes_per_sec;
        self.gossip.next_piece = self.context.now().after(Duration::from_secs_f64(pause));
        let request = Message::BlobRequest { hash, offset: offset as u32, len: BLOB_PIECE_LEN as u32 };
        self.ask(peer, QueryKind::Blob, &request, About::Blob(hash))
    }

    fn send_wish(&mut self) {
        let Some(pair) = self.best_wish() else { return };
        if !self.may_speak() {
            return;
        }
        let peer = if pair.0.frame.robot == self.context.robot() { pair.1.frame.robot } else { pair.0.frame.robot };
        let request = Message::AlignRequest { i: pair.0, j: pair.1 };
        self.ask(peer, QueryKind::Align, &request, About::Align);
    }

    pub(super) fn on_answered(&mut self, query: QueryId, bytes: Option<&[u8]>) {
        let Some(question) = self.gossip.questions.remove(&query) else { return };
        let refused = bytes.is_some_and(<[u8]>::is_empty);
        let answer = match bytes.filter(|bytes| !bytes.is_empty()).map(Message::decode) {
            None => None,
            Some(Ok(message)) => Some(message),
            Some(Err(error)) => {
                self.context.reject(Some(question.peer), error.reason(), &error.to_string());
                None
            }
        };
        if let (Some(message), Some(bytes)) = (&answer, bytes) {
            self.context.count().received(message.kind(), bytes.len());
        }
        match (question.about, answer) {
            (About::Sync, Some(Message::SyncReply(delta))) => {
                let mut new = 0;
                for entry in &delta.entries {
                    new += usize::from(self.ingest(Some(question.peer), &entry.0));
                }
                for proof in &delta.forks {
                    new += usize::from(self.ingest_fork(question.peer, proof));
                }
                let nothing = delta.entries.is_empty() && delta.forks.is_empty();
                let postponed = delta.more && nothing;
                let answer = if postponed { Answer::Postponed } else { Answer::Got { new, more: delta.more } };
                self.synced(&question, answer);
            }
            (About::Sync, _) => self.synced(&question, if refused { Answer::Refused } else { Answer::Failed }),
            (About::Blob(hash), Some(Message::BlobReply { hash: named, offset, total, bytes })) if named == hash => {
                self.on_piece(query, question.peer, hash, (offset, total), &bytes);
            }
            (About::Blob(_), _) => self.negotiation.fetch_failed(query, self.context.now()),
            (About::Align, _) => {}
        }
    }

    fn synced(&mut self, question: &Question, answer: Answer) {
        self.gossip.spread.on_answer(self.context.now(), &self.replica, question.peer, question.asked, answer);
    }

    /// A piece of a blob came. Pieces may come from different robots; the hash of the whole decides.
    fn on_piece(&mut self, query: QueryId, peer: RobotId, hash: Hash, (offset, total): (u32, u32), piece: &[u8]) {
        let Some(fetch) = self.negotiation.fetches.get_mut(&hash) else { return };
        let left = (total as usize).saturating_sub(fetch.got.len());
        let goes_on = offset as usize == fetch.got.len() && left > 0;
        if goes_on && piece.is_empty() {
            return self.fetch_postponed(query, hash);
        }
        if !goes_on || !is_piece(piece.len(), left) {
            return self.negotiation.fetch_failed(query, self.context.now());
        }
        fetch.got.extend_from_slice(piece);
        self.gossip.traffic.not_postponed(hash);
        if fetch.got.len() < total as usize {
            fetch.query = None;
            fetch.not_before = self.gossip.next_piece;
            return;
        }
        let bytes = core::mem::take(&mut fetch.got);
        if Hash::of(&bytes) == hash {
            self.keep_blob(bytes);
        } else {
            self.context.reject(Some(peer), "blob: wrong hash", "the bytes are not those the hash names");
        }
        if self.negotiation.keypoints(hash).is_some() {
            self.negotiation.fetches.remove(&hash);
        } else {
            self.negotiation.fetch_failed(query, self.context.now());
        }
    }

    /// Every question is answered exactly once; an empty answer says "I cannot".
    pub(super) fn on_asked(&mut self, token: AskToken, kind: QueryKind, bytes: &[u8]) {
        let answer = match Message::decode(bytes) {
            Ok(message) => {
                self.context.count().received(message.kind(), bytes.len());
                self.answer(kind, message)
            }
            Err(error) => {
                self.context.reject(None, error.reason(), &error.to_string());
                None
            }
        };
        let class = match kind {
            QueryKind::Sync => Class::Repair,
            QueryKind::Blob => Class::Blob,
            QueryKind::Align => Class::Have,
        };
        let bytes = answer.map_or_else(Vec::new, |message| self.pay_for_answer(class, &message));
        self.context.put(Output::Answer { token, bytes });
    }

    fn answer(&mut self, kind: QueryKind, question: Message) -> Option<Message> {
        match (kind, question) {
            (QueryKind::Sync, Message::SyncRequest(have)) => {
                let have = self.replica.read_have(&have)?;
                self.gossip.spread.on_asked(self.context.now(), &self.replica, &have);
                Some(Message::SyncReply(self.repair(&have)))
            }
            (QueryKind::Blob, Message::BlobRequest { hash, offset, len }) => {
                self.piece(hash, offset as usize, len as usize)
            }
            // What others wish takes what is left, so that nobody's wishes keep us from repairing.
            (QueryKind::Align, Message::AlignRequest { i, j })
                if self.gossip.traffic.may(self.context.now(), Class::Blob) =>
            {
                let pair = pair_of(i, j);
                Some(Message::AlignReply { status: self.wished(pair) })
            }
            (QueryKind::Align, Message::AlignRequest { .. }) => None,
            (_, other) => {
                self.context.reject(None, "wrong question", other.kind());
                None
            }
        }
    }

    fn wished(&mut self, pair: Pair) -> AlignStatus {
        if self.knowledge.is_stated(pair) {
            AlignStatus::Done
        } else if self.negotiation.wish(pair) {
            AlignStatus::Accepted
        } else if self.negotiation.is_tried(pair) {
            AlignStatus::Done
        } else {
            AlignStatus::Unknown
        }
    }

    /// Shells answer every question; should one fail to, it must not block us for ever.
    fn expire_questions(&mut self) {
        let expired: Vec<QueryId> = self
            .gossip
            .questions
            .iter()
            .filter(|(_, q)| self.context.now() >= q.expires)
            .map(|(query, _)| *query)
            .collect();
        for query in expired {
            self.on_answered(query, None);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn blob(number: usize) -> (Hash, Vec<u8>) {
        let bytes = number.to_le_bytes().to_vec();
        (Hash::of(&bytes), bytes)
    }

    #[test]
    fn what_others_made_goes_first_and_never_for_what_others_made_alone() {
        let mut gossip = Gossip::new(RobotId([1; 8]), &GossipConfig::default(), Instant::ZERO);
        let ours: BTreeSet<Hash> = (0..=BLOBS_MAX).map(|number| blob(number).0).collect();
        let add = |gossip: &mut Gossip, number| {
            let (hash, bytes) = blob(number);
            gossip.add_blob(hash, bytes, Some(ours.clone()));
        };
        let held = |gossip: &Gossip, numbers: core::ops::Range<usize>| {
            numbers.filter(|number| gossip.blob(blob(*number).0).is_some()).count()
        };
        let foreign = BLOBS_MAX + 1..2 * BLOBS_MAX + 1;
        (1..BLOBS_MAX).for_each(|number| add(&mut gossip, number));
        foreign.clone().for_each(|number| add(&mut gossip, number));
        assert_eq!((held(&gossip, 0..BLOBS_MAX), held(&gossip, foreign.clone())), (BLOBS_MAX - 1, 1));
        add(&mut gossip, 0);
        assert_eq!((held(&gossip, 0..BLOBS_MAX), held(&gossip, foreign.clone())), (BLOBS_MAX, 0));
        add(&mut gossip, foreign.start);
        assert_eq!((held(&gossip, 0..BLOBS_MAX), held(&gossip, foreign)), (BLOBS_MAX, 0));
        add(&mut gossip, BLOBS_MAX);
        assert_eq!(held(&gossip, 0..BLOBS_MAX + 1), BLOBS_MAX);
        assert!(gossip.blob(blob(BLOBS_MAX).0).is_some(), "the latest of ours is served");
    }
}

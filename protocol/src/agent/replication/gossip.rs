//! How the agent talks (DESIGN §4): new entries of ours are published once; [`crate::gossip`] decides what else is said
//! about facts, and [`super::traffic`] whether there is room for it; blobs are fetched on demand from whoever may have
//! them. Pose beacons are hints: best effort, latest wins, never facts.

use super::Replication;
use super::ledger::BATCHES_WAITING_MAX;
use super::traffic::Traffic;
use crate::agent::context::Context;
use crate::agent::io::{Channel, Output, QueryId, QueryKind};
use crate::config::GossipConfig;
use crate::geometry::PoseWithCovariance;
use crate::gossip::{Answer, AntiEntropy, Class, Step};
use crate::ids::{Hash, RobotId, SubmapId};
use crate::time::{Instant, Stamp};
use crate::wire::limits::BLOB_PIECE_LEN;
use crate::wire::messages::Message;
use crate::wire::slice;
use crate::wire::{Beacon, BeaconContent, Delta, EntryBytes, Nonce};
use core::time::Duration;
use std::collections::BTreeMap;

/// A beacon that tells nothing new waits so many times `gossip.pose_secs`.
const REPEAT_PAUSES: f64 = 2.5;
/// Shortest time between two wishes ([`Message::AlignRequest`]).
const WISH_EVERY: Duration = Duration::from_secs(2);
/// When a blob is looked for again that nobody can serve now.
const FETCH_AGAIN: Duration = Duration::from_millis(500);

/// The anchor that our body is known by, its pose there, and the stamp of the keyframe that tells so.
pub(in crate::agent) type Body = (u32, PoseWithCovariance, Stamp);

/// What the gossip remembers.
pub(super) struct Gossip {
    pub(super) spread: AntiEntropy,
    pub(super) traffic: Traffic,
    questions: BTreeMap<QueryId, Question>,
    /// When the last beacon of ours went out, and the keyframe that it told of.
    posed: (Instant, Option<Stamp>),
    next_piece: Instant,
    next_wish: Instant,
    beacon_counter: u64,
}

/// A question of ours under way.
///
/// Nobody signs answers, and anyone may give one in another's name. So each is judged by what it proves: entries by
/// their signatures, pieces of a blob by its address. One that proves nothing settles nothing, for another may follow;
/// what it claims counts only when it is known that none will.
#[derive(Clone, Copy, Debug)]
pub(in crate::agent) struct Question {
    pub(in crate::agent) peer: RobotId,
    about: About,
    asked: Instant,
    expires: Instant,
    /// The best of the answers that proved nothing.
    unproved: Answer,
    /// What came of it was reported: further answers are taken in, and change nothing about that.
    is_settled: bool,
}

#[derive(Clone, Copy, Debug)]
pub(super) enum About {
    Sync,
    /// The piece of this blob that begins there.
    Blob(Hash, usize),
    Align,
    /// With the number to be signed.
    Life(Nonce),
}

/// What came of a question of ours, as far as it concerns others.
pub(in crate::agent) enum Reply {
    Nothing,
    /// Entries and proofs that are to be taken in; this robot was asked.
    Delta(RobotId, Delta),
    /// A piece of a blob, as it should be.
    Piece {
        hash: Hash,
        offset: u32,
        total: u32,
        bytes: Vec<u8>,
    },
    /// The next piece of this blob is put off.
    PutOff(Hash),
    /// No piece of a blob.
    NoPiece,
}

/// The next piece of a blob that is wanted.
#[derive(Clone, Copy, Debug)]
pub(in crate::agent) struct Lacking {
    pub(in crate::agent) hash: Hash,
    pub(in crate::agent) offset: usize,
    /// The robot that made it.
    pub(in crate::agent) owner: RobotId,
    /// Questions for it that failed.
    pub(in crate::agent) failures: u32,
}

impl Gossip {
    pub(super) fn new(me: RobotId, config: &GossipConfig, now: Instant) -> Self {
        Self {
            spread: AntiEntropy::new(me, config.have_secs, config.answer_secs, now),
            traffic: Traffic::new(config.link_bytes_per_sec, now),
            questions: BTreeMap::new(),
            posed: (now, None),
            next_piece: now,
            next_wish: now,
            beacon_counter: 0,
        }
    }

    pub(super) fn neighbours(&self) -> impl Iterator<Item = RobotId> {
        self.spread.neighbours()
    }

    pub(super) fn is_neighbour(&self, robot: RobotId) -> bool {
        self.spread.is_neighbour(robot)
    }

    /// So many entries are new here.
    pub(super) fn on_news(&mut self, now: Instant, count: usize) {
        self.spread.on_news(now, count);
    }

    /// When the next piece of a blob may be asked for.
    fn next_piece(&self) -> Instant {
        self.traffic.due(self.next_piece, Class::Blob)
    }

    /// Whom to ask for a blob: its owner, or after failures any neighbour in turn (whoever fetched it has it).
    fn holder(&self, piece: &Lacking) -> Option<RobotId> {
        let turn = piece.failures as usize;
        if turn.is_multiple_of(2) && self.spread.is_neighbour(piece.owner) {
            return Some(piece.owner);
        }
        self.spread.neighbours().nth((turn / 2) % self.spread.neighbours().count().max(1))
    }
}

impl Replication {
    /// When something is to be said; `told` is the stamp of our last keyframe.
    pub(in crate::agent) fn timeout(&self, context: &Context, told: Option<Stamp>) -> Option<Instant> {
        let Gossip { spread, traffic, .. } = &self.gossip;
        let now = context.now();
        let speak = spread.timeout().max(traffic.due(now, Class::Have));
        [Some(speak), Some(self.pose_due(context, told)), traffic.timeout(now)].into_iter().flatten().min()
    }

    /// Says what is due.
    pub(in crate::agent) fn run_timers(&mut self, context: &mut Context, body: Option<Body>) {
        self.publish_unsent(context);
        self.spread(context);
        let told = body.map(|(_, _, stamp)| stamp);
        if context.now() >= self.pose_due(context, told) {
            self.gossip.posed = (context.now(), told);
            self.publish_pose(context, body);
        }
    }

    /// Does what the gossip about facts wants done now, as long as there is room for it.
    fn spread(&mut self, context: &mut Context) {
        // While received entries wait for the disk our vector is stale: asking now would fetch them twice.
        let busy = self.waiting() > 0 || context.kept() > 0;
        while self.gossip.traffic.may(context.now(), Class::Have) {
            let Some(step) = self.gossip.spread.step(context.now(), &self.replica, busy, context.rng()) else { return };
            match step {
                Step::Announce(root) => self.publish(context, Channel::Have, &Message::Have(root)),
                Step::Ask { peer, have } => {
                    self.ask(context, peer, QueryKind::Sync, &Message::SyncRequest(have), About::Sync);
                }
            }
        }
        if self.gossip.spread.timeout() <= context.now() {
            self.may_speak(context);
        }
    }

    /// A keyframe is told of at once, if the last beacon went out `pose_secs` ago: late news would be taken for a place
    /// where we no longer are. Without a new one the beacon is repeated, less often, for who missed it.
    fn pose_due(&self, context: &Context, stamp: Option<Stamp>) -> Instant {
        let (at, told) = self.gossip.posed;
        let pauses = if stamp == told { REPEAT_PAUSES } else { 1.0 };
        at.after(Duration::from_secs_f64(pauses * context.config().gossip.pose_secs))
    }

    fn publish_pose(&mut self, context: &mut Context, body: Option<Body>) {
        if self.is_alone() {
            return;
        }
        let Some((index, t_anchor_body, stamp)) = body else { return };
        self.gossip.beacon_counter += 1;
        let anchor = SubmapId { frame: context.frame(), index };
        let counter = self.gossip.beacon_counter;
        let content = BeaconContent { anchor, stamp, counter, t_anchor_body };
        match Beacon::sign(&context.me().key, self.replica.swarm(), &content) {
            Ok(beacon) => {
                self.lives.latest = Some(beacon.age());
                self.publish(context, Channel::Pose, &Message::Pose(beacon));
            }
            Err(error) => context.reject(Some(context.robot()), "own pose", &error.to_string()),
        }
    }

    pub(super) fn is_alone(&self) -> bool {
        self.gossip.neighbours().next().is_none()
    }

    pub(super) fn ask(
        &mut self,
        context: &mut Context,
        peer: RobotId,
        kind: QueryKind,
        message: &Message,
        about: About,
    ) -> QueryId {
        let query = context.new_query();
        let bytes = self.pay_for(context, message);
        let asked = context.now();
        let expires = asked.after(Duration::from_secs_f64(3.0 * context.config().gossip.answer_secs));
        let question = Question { peer, about, asked, expires, unproved: Answer::Failed, is_settled: false };
        self.gossip.questions.insert(query, question);
        context.put(Output::Ask { query, peer, kind, bytes });
        query
    }

    /// A robot came into reach, or left. Whether it is news that it came.
    pub(in crate::agent) fn on_neighbour(&mut self, context: &mut Context, robot: RobotId, up: bool) -> bool {
        if robot == context.robot() || context.name_of(robot).is_none() {
            return false;
        }
        self.gossip.spread.on_neighbour(context.now(), robot, up, context.rng()) && up
    }

    /// A broadcast came. Entries that are to be taken in.
    pub(in crate::agent) fn on_received(
        &mut self,
        context: &mut Context,
        from: RobotId,
        channel: Channel,
        bytes: &[u8],
    ) -> Vec<EntryBytes> {
        let message = match Message::decode(bytes) {
            Ok(message) => message,
            Err(error) => {
                context.reject_unsigned(from, error.reason(), &error.to_string());
                return Vec::new();
            }
        };
        context.count().received(message.kind(), bytes.len());
        match (channel, message) {
            (Channel::Pose, Message::Pose(beacon)) => self.on_beacon(context, from, &beacon),
            (Channel::Facts, Message::Facts(_)) if self.is_overloaded() => {
                // Nothing is lost: it comes again when the sets are compared.
                let detail = format!("{BATCHES_WAITING_MAX} batches wait for the disk");
                context.reject_unsigned(from, "facts: overload", &detail);
            }
            (Channel::Facts, Message::Facts(entries)) => return entries,
            (Channel::Have, Message::Have(_)) if context.name_of(from).is_none() => {
                let detail = "the key names a robot that is not in the roster";
                context.reject_unsigned(from, "have: unknown robot", detail);
            }
            (Channel::Have, Message::Have(have)) => {
                self.gossip.spread.on_have(context.now(), &self.replica, from, have);
            }
            (_, other) => context.reject_unsigned(from, "wrong channel", other.kind()),
        }
        Vec::new()
    }

    fn on_beacon(&mut self, context: &mut Context, from: RobotId, beacon: &Beacon) {
        if !self.replica.verify_beacon(beacon) {
            return context.reject_unsigned(from, "pose: signature", "the beacon's own signature does not hold");
        }
        if beacon.robot() != context.robot() && self.beacons.hear(**beacon, context.now()) {
            self.ask_life(context, beacon.robot());
        }
    }

    /// Asks for a piece of a blob, if there `is_room` for a question more. Otherwise, when to look again.
    ///
    /// Pieces are paced: on a slow link a whole blob would delay poses by half a second, whatever their priority,
    /// because the queue is the kernel's.
    pub(in crate::agent) fn ask_for_piece(
        &mut self,
        context: &mut Context,
        piece: &Lacking,
        is_room: bool,
    ) -> Result<QueryId, Instant> {
        // Nobody to ask, enough under way, or too soon.
        let Some(peer) = self.gossip.holder(piece).filter(|_| is_room) else {
            return Err(context.now().after(FETCH_AGAIN));
        };
        if context.now() < self.gossip.next_piece() {
            return Err(self.gossip.next_piece());
        }
        let pause = BLOB_PIECE_LEN as f64 / context.config().gossip.blob_bytes_per_sec;
        self.gossip.next_piece = context.now().after(Duration::from_secs_f64(pause));
        let Lacking { hash, offset, .. } = *piece;
        let request = Message::BlobRequest { hash, offset: offset as u32, len: BLOB_PIECE_LEN as u32 };
        Ok(self.ask(context, peer, QueryKind::Blob, &request, About::Blob(hash, offset)))
    }

    /// The earliest time for another piece of the same blob.
    pub(in crate::agent) fn next_piece(&self) -> Instant {
        self.gossip.next_piece
    }

    /// Whether one more wish of ours may be told; true once in a while.
    pub(in crate::agent) fn take_wish_due(&mut self, now: Instant) -> bool {
        let is_due = now >= self.gossip.next_wish;
        if is_due {
            self.gossip.next_wish = now.after(WISH_EVERY);
        }
        is_due
    }

    /// Tells the other endpoint of a pair that we wish it tried, if there is room to speak.
    pub(in crate::agent) fn send_wish(&mut self, context: &mut Context, (i, j): (SubmapId, SubmapId)) {
        if self.may_speak(context) {
            let peer = if i.frame.robot == context.robot() { j.frame.robot } else { i.frame.robot };
            self.ask(context, peer, QueryKind::Align, &Message::AlignRequest { i, j }, About::Align);
        }
    }

    /// A question of ours has an answer, or, if there are no `bytes`, will have no more.
    pub(in crate::agent) fn on_answered(
        &mut self,
        context: &mut Context,
        query: QueryId,
        bytes: Option<&[u8]>,
    ) -> Reply {
        let Some(&question) = self.gossip.questions.get(&query) else { return Reply::Nothing };
        let Some(bytes) = bytes else { return self.on_last_answer(context, query) };
        if bytes.is_empty() {
            self.note(query, Answer::Refused);
            return Reply::Nothing;
        }
        let answer = match Message::decode(bytes) {
            Ok(answer) => answer,
            Err(error) => {
                context.reject_unsigned(question.peer, error.reason(), &error.to_string());
                return Reply::Nothing;
            }
        };
        context.count().received(answer.kind(), bytes.len());
        match (question.about, answer) {
            (About::Sync, Message::SyncReply(delta)) => Reply::Delta(question.peer, delta),
            (About::Blob(hash, offset), Message::BlobReply { hash: named, offset: at, total, bytes, proof })
                if named == hash && at as usize == offset =>
            {
                self.on_piece(context, query, (hash, at, total), bytes, &proof)
            }
            (About::Align, Message::AlignReply { .. }) => Reply::Nothing,
            (About::Life(nonce), Message::LifeReply(life)) => {
                if self.on_life(context, (question.peer, nonce), &life) {
                    self.gossip.questions.remove(&query);
                }
                Reply::Nothing
            }
            (_, other) => {
                context.reject_unsigned(question.peer, "wrong answer", other.kind());
                Reply::Nothing
            }
        }
    }

    fn on_piece(
        &mut self,
        context: &mut Context,
        query: QueryId,
        (hash, offset, total): (Hash, u32, u32),
        bytes: Vec<u8>,
        proof: &[[u8; 32]],
    ) -> Reply {
        if bytes.is_empty() {
            self.note(query, if total == 0 { Answer::Refused } else { Answer::Postponed });
            return Reply::Nothing;
        }
        if !slice::proves(hash, total as usize, offset as usize, &bytes, proof) {
            if let Some(question) = self.gossip.questions.get(&query) {
                let detail = "the bytes are not those that the address names";
                context.reject_unsigned(question.peer, "blob: wrong bytes", detail);
            }
            return Reply::Nothing;
        }
        self.gossip.questions.remove(&query);
        Reply::Piece { hash, offset, total, bytes }
    }

    /// There will be no more answers: what those said that proved nothing is all there is.
    fn on_last_answer(&mut self, context: &Context, query: QueryId) -> Reply {
        let Some(question) = self.gossip.questions.remove(&query) else { return Reply::Nothing };
        match (question.about, question.unproved) {
            (About::Sync, answer) => {
                self.synced(context, &question, answer);
                Reply::Nothing
            }
            (About::Blob(hash, _), Answer::Postponed) => Reply::PutOff(hash),
            (About::Blob(..), _) => Reply::NoPiece,
            (About::Align | About::Life(_), _) => Reply::Nothing,
        }
    }

    /// Notes an answer that proved nothing. All may be false: "nothing" counts before "not now", because after it the next
    /// window is asked about, while whoever says "not now" again and again would keep us at this one.
    fn note(&mut self, query: QueryId, answer: Answer) {
        let rank = |answer: &Answer| match answer {
            Answer::Failed => 0,
            Answer::Refused => 1,
            Answer::Postponed => 2,
            Answer::Got { .. } => 3,
        };
        let question = self.gossip.questions.get_mut(&query);
        if let Some(question) = question.filter(|question| rank(&answer) > rank(&question.unproved)) {
            question.unproved = answer;
        }
    }

    /// What was said to be missing here was taken in: of it so much was new.
    pub(in crate::agent) fn on_delta(&mut self, context: &Context, query: QueryId, delta: &Delta, new: usize) {
        if new == 0 {
            let is_empty = delta.entries.is_empty() && delta.forks.is_empty();
            let postponed = delta.more && is_empty;
            return self.note(query, if postponed { Answer::Postponed } else { Answer::Got { new, more: delta.more } });
        }
        let Some(asked) = self.gossip.questions.get_mut(&query) else { return };
        let question = *asked;
        asked.is_settled = true;
        self.synced(context, &question, Answer::Got { new, more: delta.more });
    }

    fn synced(&mut self, context: &Context, question: &Question, answer: Answer) {
        if !question.is_settled {
            self.gossip.spread.on_answer(context.now(), &self.replica, question.peer, question.asked, answer);
        }
    }

    /// Shells answer every question; should one fail to, it must not block us for ever.
    pub(in crate::agent) fn expired(&self, now: Instant) -> Vec<QueryId> {
        self.gossip.questions.iter().filter(|(_, q)| now >= q.expires).map(|(query, _)| *query).collect()
    }
}

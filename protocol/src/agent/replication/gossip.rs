//! How the agent talks (DESIGN §4): new entries of ours are published once; [`crate::gossip`] decides what else is said
//! about facts, and [`super::traffic`] whether there is room for it; blobs are fetched on demand from whoever may have
//! them. Pose beacons are hints: best effort, latest wins, never facts.

use super::Replication;
use super::ledger::BATCHES_WAITING_MAX;
use super::traffic::Traffic;
use crate::agent::context::Context;
use crate::agent::io::{AskToken, Channel, Output, QueryId, QueryKind};
use crate::config::GossipConfig;
use crate::geometry::PoseWithCovariance;
use crate::gossip::{Answer, AntiEntropy, Class, Step};
use crate::ids::{Hash, RobotId, SubmapId};
use crate::time::{Instant, Stamp};
use crate::wire::limits::BLOB_PIECE_LEN;
use crate::wire::messages::Message;
use crate::wire::{Beacon, BeaconContent, Delta, EntryBytes};
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
    spread: AntiEntropy,
    pub(super) traffic: Traffic,
    questions: BTreeMap<QueryId, Question>,
    /// When the last beacon of ours went out, and the keyframe that it told of.
    posed: (Instant, Option<Stamp>),
    next_piece: Instant,
    next_wish: Instant,
    beacon_counter: u64,
}

/// A question of ours under way.
#[derive(Clone, Copy, Debug)]
pub(in crate::agent) struct Question {
    pub(in crate::agent) peer: RobotId,
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

/// What came of a question of ours, as far as it concerns others.
pub(in crate::agent) enum Reply {
    Nothing,
    /// Entries and proofs that are to be taken in.
    Delta(Question, Delta),
    /// A piece of a blob.
    Piece {
        peer: RobotId,
        hash: Hash,
        offset: u32,
        total: u32,
        bytes: Vec<u8>,
    },
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
            Ok(beacon) => self.publish(context, Channel::Pose, &Message::Pose(beacon)),
            Err(error) => context.reject(Some(context.robot()), "own pose", &error.to_string()),
        }
    }

    pub(super) fn is_alone(&self) -> bool {
        self.gossip.neighbours().next().is_none()
    }

    fn ask(
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
        self.gossip.questions.insert(query, Question { peer, about, asked, expires });
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
                context.reject(Some(from), error.reason(), &error.to_string());
                return Vec::new();
            }
        };
        context.count().received(message.kind(), bytes.len());
        match (channel, message) {
            (Channel::Pose, Message::Pose(beacon)) => self.on_beacon(context, from, &beacon),
            (Channel::Facts, Message::Facts(_)) if self.is_overloaded() => {
                // Nothing is lost: it comes again when the sets are compared.
                let detail = format!("{BATCHES_WAITING_MAX} batches wait for the disk");
                context.reject(Some(from), "facts: overload", &detail);
            }
            (Channel::Facts, Message::Facts(entries)) => return entries,
            (Channel::Have, Message::Have(_)) if context.name_of(from).is_none() => {
                let detail = "the key names a robot that is not in the roster";
                context.reject(Some(from), "have: unknown robot", detail);
            }
            (Channel::Have, Message::Have(have)) => {
                self.gossip.spread.on_have(context.now(), &self.replica, from, have);
            }
            (_, other) => context.reject(Some(from), "wrong channel", other.kind()),
        }
        Vec::new()
    }

    fn on_beacon(&mut self, context: &mut Context, from: RobotId, beacon: &Beacon) {
        if !self.replica.verify_beacon(beacon) {
            return context.reject(Some(from), "pose: signature", "beacon not signed by the robot it names");
        }
        if beacon.robot() != context.robot() {
            self.beacons.hear(**beacon, context.now());
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
        Ok(self.ask(context, peer, QueryKind::Blob, &request, About::Blob(hash)))
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

    /// A question of ours was answered, or never will be.
    pub(in crate::agent) fn on_answered(
        &mut self,
        context: &mut Context,
        query: QueryId,
        bytes: Option<&[u8]>,
    ) -> Reply {
        let Some(question) = self.gossip.questions.remove(&query) else { return Reply::Nothing };
        let peer = question.peer;
        let refused = bytes.is_some_and(<[u8]>::is_empty);
        let answer = match bytes.filter(|bytes| !bytes.is_empty()).map(Message::decode) {
            None => None,
            Some(Ok(message)) => Some(message),
            Some(Err(error)) => {
                context.reject(Some(peer), error.reason(), &error.to_string());
                None
            }
        };
        if let (Some(message), Some(bytes)) = (&answer, bytes) {
            context.count().received(message.kind(), bytes.len());
        }
        match (question.about, answer) {
            (About::Sync, Some(Message::SyncReply(delta))) => Reply::Delta(question, delta),
            (About::Sync, _) => {
                self.synced(context, &question, if refused { Answer::Refused } else { Answer::Failed });
                Reply::Nothing
            }
            (About::Blob(hash), Some(Message::BlobReply { hash: named, offset, total, bytes })) if named == hash => {
                Reply::Piece { peer, hash, offset, total, bytes }
            }
            (About::Blob(_), _) => Reply::NoPiece,
            (About::Align, _) => Reply::Nothing,
        }
    }

    /// What a neighbour knew better was taken in: of it so much was new.
    pub(in crate::agent) fn on_delta(&mut self, context: &Context, question: &Question, delta: &Delta, new: usize) {
        let nothing = delta.entries.is_empty() && delta.forks.is_empty();
        let postponed = delta.more && nothing;
        let answer = if postponed { Answer::Postponed } else { Answer::Got { new, more: delta.more } };
        self.synced(context, question, answer);
    }

    fn synced(&mut self, context: &Context, question: &Question, answer: Answer) {
        self.gossip.spread.on_answer(context.now(), &self.replica, question.peer, question.asked, answer);
    }

    /// A question of another, if it can be read and is of the kind that it claims to be.
    pub(in crate::agent) fn on_asked(&self, context: &mut Context, kind: QueryKind, bytes: &[u8]) -> Option<Message> {
        let question = match Message::decode(bytes) {
            Ok(question) => question,
            Err(error) => {
                context.reject(None, error.reason(), &error.to_string());
                return None;
            }
        };
        context.count().received(question.kind(), bytes.len());
        let is_of_kind = matches!(
            (kind, &question),
            (QueryKind::Sync, Message::SyncRequest(_))
                | (QueryKind::Blob, Message::BlobRequest { .. })
                | (QueryKind::Align, Message::AlignRequest { .. })
        );
        if !is_of_kind {
            context.reject(None, "wrong question", question.kind());
        }
        is_of_kind.then_some(question)
    }

    /// The answer to a question about what is held here.
    pub(in crate::agent) fn answer_to(&mut self, context: &mut Context, question: Message) -> Option<Message> {
        match question {
            Message::SyncRequest(have) => {
                let have = self.replica.read_have(&have)?;
                self.gossip.spread.on_asked(context.now(), &self.replica, &have);
                Some(Message::SyncReply(self.repair(context, &have)))
            }
            Message::BlobRequest { hash, offset, len } => self.piece(context, hash, offset as usize, len as usize),
            _ => None,
        }
    }

    /// Whether what others wish may be answered: it takes what is left, so that nobody's wishes keep us from repairing.
    pub(in crate::agent) fn may_answer_wish(&self, now: Instant) -> bool {
        self.gossip.traffic.may(now, Class::Blob)
    }

    /// Every question is answered exactly once; an empty answer says "I cannot".
    pub(in crate::agent) fn answer(
        &mut self,
        context: &mut Context,
        token: AskToken,
        kind: QueryKind,
        answer: Option<&Message>,
    ) {
        let class = match kind {
            QueryKind::Sync => Class::Repair,
            QueryKind::Blob => Class::Blob,
            QueryKind::Align => Class::Have,
        };
        let bytes = answer.map_or_else(Vec::new, |message| self.pay_for_answer(context, class, message));
        context.put(Output::Answer { token, bytes });
    }

    /// Shells answer every question; should one fail to, it must not block us for ever.
    pub(in crate::agent) fn expired(&self, now: Instant) -> Vec<QueryId> {
        self.gossip.questions.iter().filter(|(_, q)| now >= q.expires).map(|(query, _)| *query).collect()
    }
}

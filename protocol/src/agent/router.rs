//! The router: what happens to one part of an agent is brought to the others here, and nowhere else.

use super::Agent;
use super::alignment::Sources;
use super::estimation::live_robots;
use super::io::{AskToken, Channel, EpochReason, Event, JobId, PositionSighting, QueryId, QueryKind, Record, Sighting};
use super::job::JobResult;
use super::mapping::Finished;
use super::replication::knowledge::pair_of;
use super::replication::{BATCHES_WAITING_MAX, Heard, Reply, Written};
use crate::ids::{EntryId, FrameId, Hash, RobotId};
use crate::submap::{Described, Keyframe, Submap};
use crate::wire::EntryBytes;
use crate::wire::fact::Fact;
use crate::wire::messages::Message;

impl Agent {
    /// A keyframe is of the present frame, begins another one, or is refused.
    pub(super) fn on_keyframe(&mut self, keyframe: Keyframe) {
        if self.is_at_epoch_limit() || !self.mapping.has_room(&mut self.context, &keyframe) {
            return;
        }
        if let Some(reason) = self.mapping.another_frame(&keyframe) {
            self.begin_next_epoch(reason);
            if self.is_at_epoch_limit() {
                return;
            }
        }
        if let Some(reason) = self.mapping.on_keyframe(&mut self.context, keyframe) {
            self.begin_next_epoch(reason);
        }
    }

    /// Whether others would refuse facts of our epoch; if so, a keyframe is refused.
    fn is_at_epoch_limit(&mut self) -> bool {
        let limit = self.replication.epoch_limit(&self.context);
        if let Some(error) = &limit {
            self.context.reject(Some(self.context.robot()), "keyframe: receive-only", &error.to_string());
        }
        limit.is_some()
    }

    /// A direct measurement of another robot becomes a fact, or is refused.
    pub(super) fn on_sighting(&mut self, sighting: &Sighting) {
        if !self.is_hindered("sighting: receive-only", "sighting: overload") {
            let beacons = self.replication.beacons();
            let fact = self.mapping.on_sighting(&mut self.context, beacons, sighting);
            self.state_sighting(fact);
        }
    }

    /// A direct measurement of where another robot is becomes a fact, or is refused.
    pub(super) fn on_position(&mut self, sighting: &PositionSighting) {
        if !self.is_hindered("position: receive-only", "position: overload") {
            let beacons = self.replication.beacons();
            let fact = self.mapping.on_position(&mut self.context, beacons, sighting);
            self.state_sighting(fact);
        }
    }

    fn state_sighting(&mut self, fact: Option<Fact>) {
        if let Some(fact) = fact.filter(|fact| self.state(fact)) {
            self.mapping.on_stated(&fact);
        }
    }

    /// Whether nothing can be stated now; if so it is refused under one of these names.
    fn is_hindered(&mut self, receive_only: &'static str, overload: &'static str) -> bool {
        if self.replication.is_receive_only(&self.context) {
            self.context.reject(Some(self.context.robot()), receive_only, "it cannot be kept now");
            return true;
        }
        if self.replication.is_overloaded() {
            let detail = format!("{BATCHES_WAITING_MAX} batches wait for the disk; the store is too slow");
            self.context.reject(Some(self.context.robot()), overload, &detail);
            return true;
        }
        false
    }

    /// States a fact: in the present epoch, but while submaps of an earlier one wait to be described, in that one. The
    /// first fact of an epoch closes those before it, and their last submaps would be lost. False if it cannot be
    /// written.
    fn state(&mut self, fact: &Fact) -> bool {
        let present = self.context.frame().epoch;
        let earlier = self.mapping.first_undescribed().map(|id| id.frame.epoch).filter(|epoch| *epoch < present);
        earlier.is_some_and(|epoch| self.write(epoch, fact)) || self.write(present, fact)
    }

    /// Writes a fact of our own. False if it cannot be written.
    fn write(&mut self, epoch: u32, fact: &Fact) -> bool {
        let written = self.replication.write(&mut self.context, epoch, fact);
        if written == Written::InNewEpochOnly {
            self.begin_next_epoch(EpochReason::Log);
        }
        written == Written::Yes
    }

    pub(super) fn begin_next_epoch(&mut self, reason: EpochReason) {
        self.begin_epoch(self.context.frame().epoch.saturating_add(1), reason);
    }

    /// A new local frame begins: the trajectory so far is closed, for later runs as well, even if this one ends before
    /// the new epoch has an entry.
    pub(super) fn begin_epoch(&mut self, epoch: u32, reason: EpochReason) {
        self.mapping.close_submap(&mut self.context);
        self.context.set_epoch(epoch);
        self.context.keep(Record::EpochClosed { epoch: epoch.saturating_sub(1) });
        self.mapping.restart(reason == EpochReason::Session);
        self.context.event(Event::EpochBegan { frame: self.context.frame(), reason });
        self.replication.tell_of_limit(&mut self.context);
    }

    pub(super) fn on_job_done(&mut self, id: JobId, result: JobResult) {
        match result {
            JobResult::Described(described) => self.on_described(id, *described),
            JobResult::Aligned(outcome) => {
                let sources = Sources::of(&self.replication, &self.estimation);
                if let Some(fact) = self.alignment.on_aligned(&mut self.context, sources, id, outcome) {
                    self.state(&fact);
                }
            }
            JobResult::Solved(solved) => {
                if self.estimation.on_solved(&mut self.context, id, *solved) {
                    self.alignment.mark_dirty();
                }
            }
        }
    }

    /// A submap was described: it is stated, and what belongs to it kept.
    fn on_described(&mut self, job: JobId, described: (Submap, Described)) {
        let Some(finished) = self.mapping.on_described(&mut self.context, job, described) else { return };
        let Finished { id, fact, blob: (hash, bytes), described } = finished;
        if !self.write(id.frame.epoch, &fact) {
            return;
        }
        let keypoints = described.keypoints.len();
        self.context.keep(Record::Private { submap: id, bytes: described.features.encode() });
        self.alignment.keep_keypoints(&mut self.context, hash, &bytes);
        self.context.keep(Record::Blob { hash, bytes });
        if let Some(bytes) = described.further.map(|further| further.encode()) {
            self.context.keep(Record::Blob { hash: Hash::of(&bytes), bytes });
        }
        self.context.event(Event::SubmapFinished { submap: id, keypoints });
        self.alignment.add_features(id, described.features);
    }

    /// Starts as many alignments as allowed: answers owed first, then the most promising candidates.
    pub(super) fn start_aligning(&mut self) {
        if self.alignment.take_due(self.context.now()) && !self.replication.is_receive_only(&self.context) {
            let sources = Sources::of(&self.replication, &self.estimation);
            for id in self.alignment.answers_owed(&self.context, sources) {
                let sources = Sources::of(&self.replication, &self.estimation);
                if let Some(refusal) = self.alignment.start_answer(&mut self.context, sources, id) {
                    self.state(&refusal);
                }
            }
            let sources = Sources::of(&self.replication, &self.estimation);
            self.alignment.start(&mut self.context, sources);
        }
        self.start_fetching();
    }

    /// Asks for the keypoints that alignments wait for, as far as there is room.
    fn start_fetching(&mut self) {
        let (due, mut free) = self.alignment.due_pieces(self.context.now());
        for piece in due {
            let asked = self.replication.ask_for_piece(&mut self.context, &piece, free > 0);
            free -= usize::from(asked.is_ok());
            self.alignment.on_piece_asked(piece.hash, asked);
        }
    }

    pub(super) fn start_solving(&mut self) {
        let now = self.context.now();
        if self.estimation.is_due(now) {
            let robots = live_robots(&self.context, self.mapping.body(), self.replication.beacons(), now);
            self.estimation.start(&mut self.context, &self.replication, &robots);
        }
    }

    /// Shortens our log, if that is due; submaps that go are forgotten.
    pub(super) fn condense(&mut self) {
        let gone = self.replication.condense(&mut self.context);
        self.alignment.forget(&gone);
    }

    /// All records of this call go to the disk together, and with them refusals that wait for others, or are many.
    pub(super) fn close_batch(&mut self) {
        if self.context.kept() > 0 || self.alignment.are_refusals_many() {
            self.save_refusals();
            self.replication.close_batch(&mut self.context);
        }
    }

    pub(super) fn save_refusals(&mut self) {
        self.alignment.save_refusals(|record| self.context.keep(record));
    }

    /// Says what is due.
    pub(super) fn run_timers(&mut self) {
        for query in self.replication.expired(self.context.now()) {
            self.on_answered(query, None);
        }
        self.replication.run_timers(&mut self.context, self.mapping.body());
        if self.replication.take_wish_due(self.context.now()) {
            let sources = Sources::of(&self.replication, &self.estimation);
            let wish = self.alignment.take_best_wish(sources, |robot| self.replication.is_neighbour(robot));
            wish.into_iter().for_each(|pair| self.replication.send_wish(&mut self.context, pair));
        }
    }

    pub(super) fn on_received(&mut self, from: RobotId, channel: Channel, bytes: &[u8]) {
        let entries = self.replication.on_received(&mut self.context, from, channel, bytes);
        for entry in &entries {
            self.ingest(from, &entry.0);
        }
    }

    pub(super) fn on_neighbour(&mut self, robot: RobotId, up: bool) {
        if self.replication.on_neighbour(&mut self.context, robot, up) {
            self.alignment.on_neighbour();
        }
    }

    pub(super) fn on_answered(&mut self, query: QueryId, bytes: Option<&[u8]>) {
        match self.replication.on_answered(&mut self.context, query, bytes) {
            Reply::Nothing => {}
            Reply::Delta(peer, delta) => {
                let mut new = 0;
                for entry in &delta.entries {
                    new += usize::from(self.ingest(peer, &entry.0));
                }
                for proof in &delta.forks {
                    new += usize::from(self.ingest_fork(peer, proof));
                }
                self.replication.on_delta(&self.context, query, &delta, new);
            }
            Reply::Piece { hash, offset, total, bytes } => {
                let moments = [self.context.now(), self.replication.next_piece()];
                if let Some(bytes) = self.alignment.on_piece(query, hash, (offset, total), &bytes, moments) {
                    self.keep_blob(bytes);
                    self.alignment.on_blob(query, hash, self.context.now());
                }
            }
            Reply::PutOff(hash) => self.alignment.on_put_off(query, hash, self.context.now()),
            Reply::NoPiece => self.alignment.on_no_piece(query, self.context.now()),
        }
    }

    /// Keeps a keypoint blob, for whoever asks, and its decoded form.
    pub(super) fn keep_blob(&mut self, bytes: Vec<u8>) {
        let hash = Hash::of(&bytes);
        if self.alignment.keep_keypoints(&mut self.context, hash, &bytes) {
            self.replication.add_blob(&self.context, hash, bytes);
        }
    }

    pub(super) fn on_asked(&mut self, token: AskToken, kind: QueryKind, bytes: &[u8]) {
        let answer = match self.replication.on_asked(&mut self.context, kind, bytes) {
            Some(Message::AlignRequest { i, j }) => self.replication.may_answer_wish(self.context.now()).then(|| {
                Message::AlignReply { status: self.alignment.on_wish(self.replication.knowledge(), pair_of(i, j)) }
            }),
            Some(question) => self.replication.answer_to(&mut self.context, question),
            None => None,
        };
        self.replication.answer(&mut self.context, token, kind, answer.as_ref());
    }

    /// Takes an entry from a peer; it takes effect once it is durable. Whether it changed anything.
    fn ingest(&mut self, from: RobotId, bytes: &[u8]) -> bool {
        match self.replication.ingest(&mut self.context, from, bytes) {
            Heard::New(ids) => {
                for id in ids {
                    if self.replication.keep(&mut self.context, id) {
                        self.meet_own_past(id.frame);
                    }
                }
                return true;
            }
            Heard::Early(frame) => self.meet_own_end(frame),
            Heard::Forked(frame) => {
                self.on_fork(frame);
                return true;
            }
            Heard::Nothing => {}
        }
        false
    }

    /// Takes the proof that a log has two histories. Whether it was news.
    fn ingest_fork(&mut self, from: RobotId, proof: &[EntryBytes; 2]) -> bool {
        let heard = self.replication.ingest_fork(&mut self.context, from, proof);
        if let Heard::Forked(frame) = heard {
            self.on_fork(frame);
        }
        heard != Heard::Nothing
    }

    /// A log is in quarantine from now on: what it said counts no more.
    fn on_fork(&mut self, frame: FrameId) {
        self.meet_own_end(frame);
        self.relearn();
    }

    /// A peer holds entries that we signed but no longer have: our store was lost. What we write must not collide, and
    /// no later run may take this log for one to go on with: what we hold of it may be less than others do.
    fn meet_own_past(&mut self, FrameId { robot, epoch }: FrameId) {
        if robot != self.context.robot() {
            return;
        }
        if epoch >= self.context.frame().epoch {
            self.begin_epoch(epoch.saturating_add(1), EpochReason::Log);
        } else {
            self.context.keep(Record::EpochClosed { epoch });
            self.replication.tell_of_limit(&mut self.context);
        }
    }

    /// The same of a past that we cannot hold, because it has two histories or its beginning is yet to come: what we
    /// write before the end of it would be refused.
    fn meet_own_end(&mut self, frame: FrameId) {
        if frame.epoch >= self.context.frame().epoch {
            self.meet_own_past(frame);
        }
    }

    pub(super) fn on_persisted(&mut self, up_to: u64) {
        if self.replication.store_fails() {
            self.alignment.mark_dirty();
        }
        let durable = self.replication.on_persisted(&mut self.context, up_to);
        for id in &durable.entries {
            self.replication.mark_durable(*id);
            self.learn(*id);
        }
        if let Some(gone) = self.replication.drop_retired(&mut self.context, &[]) {
            self.relearn();
            self.alignment.forget(&gone);
        }
        self.replication.publish_durable(&mut self.context, durable);
    }

    /// A durable entry takes effect.
    fn learn(&mut self, id: EntryId) {
        if self.replication.forget_below(id) {
            self.alignment.drop_unknown(self.replication.knowledge());
        }
        if let Some(fact) = self.replication.learn(&mut self.context, id) {
            self.estimation.mark_dirty();
            let sources = Sources::of(&self.replication, &self.estimation);
            self.alignment.on_fact(&mut self.context, sources, id, &fact);
        }
    }

    /// Forgets and learns everything again: at start, and when a quarantine takes facts away.
    pub(super) fn relearn(&mut self) {
        let calling = self.replication.relearn(self.context.robot());
        self.estimation.on_relearned();
        let sources = Sources::of(&self.replication, &self.estimation);
        self.alignment.on_relearned(&mut self.context, sources, &calling);
    }
}

//! Which pairs of submaps are aligned, and what comes of it: candidates are noted as submaps become known, keypoints
//! fetched, alignments computed, stated and verified (DESIGN §6). Its timers are those of what it waits for: keypoints,
//! and leave to spend more on what is known already.

mod aligning;
mod allowance;
mod fetches;
mod negotiation;
mod overlap_model;
mod pairing;
mod prospects;
mod ranking;
mod refusals;
mod second_look;
mod shortlist;
mod stated;
mod tries;

pub use fetches::POSTPONED_MAX;
pub use negotiation::{
    ALIGNMENTS_PER_FRAME_PAIR, ALIGNMENTS_PER_SUBMAP, FEATURES_MAX, KEYPOINTS_MAX, LOOKALIKES_MAX, TRIES_PER_SUBMAP,
};
pub use refusals::{REFUSED_MAX, REFUSED_WAITING_MAX};
pub use second_look::SECOND_LOOKS_MAX;

use super::context::Context;
use super::estimation::Estimation;
use super::io::{Event, QueryId, Record};
use super::replication::blobs::Blobs;
use super::replication::knowledge::{Agreement, Knowledge, Pair};
use super::replication::{Lacking, Replication};
use crate::ids::{EntryId, Hash, RobotId, SubmapId};
use crate::submap::{Features, Keypoints};
use crate::time::Instant;
use crate::wire::fact::{AlignmentFact, Fact};
use crate::wire::messages::AlignStatus;
use allowance::Allowance;
use fetches::{Fetches, Piece};
use negotiation::{Negotiation, VERIFICATIONS_MAX};
use prospects::Prospects;
use refusals::Refusals;
use std::collections::BTreeSet;
use std::sync::Arc;
use tries::Tries;

/// See the module.
pub(super) struct Alignment {
    negotiation: Negotiation,
    refusals: Refusals,
    allowance: Allowance,
    fetches: Fetches,
    tries: Tries,
}

/// What the alignment reads of the other parts.
#[derive(Clone, Copy)]
pub(super) struct Sources<'a> {
    knowledge: &'a Knowledge,
    blobs: &'a Blobs,
    estimation: &'a Estimation,
}

impl<'a> Sources<'a> {
    pub(super) fn of(replication: &'a Replication, estimation: &'a Estimation) -> Self {
        Self { knowledge: replication.knowledge(), blobs: replication.blobs(), estimation }
    }
}

impl Alignment {
    pub(super) fn new(context: &Context) -> Self {
        let config = context.config();
        Self {
            negotiation: Negotiation::new(config.submap.sensor),
            refusals: Refusals::new(config),
            allowance: Allowance::new(config.align.further_bytes_per_sec, context.now()),
            fetches: Fetches::default(),
            tries: Tries::default(),
        }
    }

    /// What pairs promise, by all that is known now.
    fn prospects<'a>(&'a self, context: &'a Context, sources: Sources<'a>) -> Prospects<'a> {
        let Self { negotiation, allowance, fetches, refusals: _, tries: _ } = self;
        let Sources { knowledge, blobs, estimation } = sources;
        Prospects { context, negotiation, allowance, fetches, knowledge, blobs, estimation }
    }

    /// What became of pairs that were tried with others.
    pub(super) fn tries(&self) -> &Tries {
        &self.tries
    }

    /// When something is to be done that was put off.
    pub(super) fn timeout(&self, now: Instant) -> Option<Instant> {
        [self.fetches.timeout(), self.allowance.timeout(now)].into_iter().flatten().min()
    }

    /// Something changed that may make work startable.
    pub(super) fn mark_dirty(&mut self) {
        self.negotiation.mark_dirty();
    }

    /// A fact has taken effect: what does it call for?
    pub(super) fn on_fact(&mut self, context: &mut Context, sources: Sources<'_>, id: EntryId, fact: &Fact) {
        self.negotiation.mark_dirty();
        match fact {
            Fact::Submap(fact) => {
                let new = SubmapId { frame: id.frame, index: fact.index };
                if let Some(of) = sources.knowledge.copied_from(new) {
                    let detail = format!(
                        "{} shows what {} stated before as its own; nothing is aligned with it. Do both play one \
                         recording?",
                        context.submap_name(new),
                        context.robot_name(of)
                    );
                    context.reject(Some(new.frame.robot), "copied_submap", &detail);
                }
                self.note_candidates(context, sources.knowledge, new);
            }
            Fact::Alignment(fact) => self.note_verification(context, sources, id, fact),
            Fact::Verdict(fact) => report_agreement(context, sources.knowledge, fact.alignment),
            // What is carried on called for something when it was new; to whom it is new, it calls now.
            Fact::Condensed(condensed) => {
                for one in condensed.carried.iter().filter(|one| !matches!(one.fact, Fact::Verdict(_))) {
                    self.on_fact(context, sources, EntryId { seq: one.seq, ..id }, &one.fact);
                }
            }
            Fact::Sighting(_) | Fact::Position(_) | Fact::Lookalike(_) | Fact::Retired(_) => {}
        }
    }

    /// All facts were learned anew; some of them call for something.
    pub(super) fn on_relearned(&mut self, context: &mut Context, sources: Sources<'_>, calling: &[(EntryId, Fact)]) {
        self.negotiation.clear_candidates();
        self.drop_unknown(sources.knowledge);
        calling.iter().for_each(|(id, fact)| self.on_fact(context, sources, *id, fact));
        self.weigh_refusals(context, sources.knowledge);
        self.note_all_candidates(context, sources.knowledge);
    }

    /// Facts are forgotten, and with them candidates and wishes that name a submap which is gone.
    pub(super) fn drop_unknown(&mut self, knowledge: &Knowledge) {
        self.negotiation.drop_unknown(knowledge);
    }

    /// Somebody aligned one of our submaps: we owe an answer, once.
    fn note_verification(&mut self, context: &Context, sources: Sources<'_>, id: EntryId, fact: &AlignmentFact) {
        // What a third party says of two others is no try of theirs, or a liar could keep all pairs from being tried.
        if sources.knowledge.alignment(id).is_none() {
            return;
        }
        self.negotiation.mark_tried((fact.i, fact.j));
        self.negotiation.peer_requests.remove((fact.i, fact.j));
        let me = context.robot();
        let ours = fact.i.frame.robot == me || fact.j.frame.robot == me;
        if ours && id.frame.robot != me && !sources.knowledge.has_verdict(id, me) {
            self.owe_answer(context, sources, id);
        }
    }

    /// Of more than may wait for an answer, some go that cannot have one now.
    fn owe_answer(&mut self, context: &Context, sources: Sources<'_>, id: EntryId) {
        let is_full = self.negotiation.verify.len() >= VERIFICATIONS_MAX;
        let now = if is_full { self.answers_owed(context, sources).into_iter().collect() } else { BTreeSet::new() };
        self.negotiation.add_verification(id, |id| !now.contains(id));
    }

    /// Alignments that wait for our answer and can be worked on now.
    pub(super) fn answers_owed(&self, context: &Context, sources: Sources<'_>) -> Vec<EntryId> {
        self.prospects(context, sources).answers_owed()
    }

    /// Candidates worth their cost that are not put off until more may be spent.
    pub(super) fn proposals(&self, context: &Context, sources: Sources<'_>) -> usize {
        self.prospects(context, sources).proposals()
    }

    /// Alignments being computed.
    pub(super) fn running(&self) -> usize {
        self.negotiation.running.len()
    }

    /// How many submaps of ours can be aligned.
    pub(super) fn own_submaps(&self) -> usize {
        self.negotiation.own().count()
    }

    /// The most similar pair that the other endpoint should try and that would join frames not yet merged.
    pub(super) fn take_best_wish(
        &mut self,
        sources: Sources<'_>,
        is_neighbour: impl Fn(RobotId) -> bool,
    ) -> Option<Pair> {
        let reachable = |pair: &Pair| [pair.0, pair.1].iter().any(|id| is_neighbour(id.frame.robot));
        let best = self
            .negotiation
            .peer_requests
            .iter()
            .filter(|(pair, _)| reachable(pair) && !sources.estimation.are_connected(pair.0, pair.1))
            .max_by(|a, b| a.1.similarity.value.total_cmp(&b.1.similarity.value).then(b.0.cmp(&a.0)))
            .map(|(pair, _)| pair)?;
        self.negotiation.peer_requests.remove(best);
        Some(best)
    }

    /// The other endpoint wishes a pair tried.
    pub(super) fn on_wish(&mut self, knowledge: &Knowledge, pair: Pair) -> AlignStatus {
        if knowledge.is_stated(pair) {
            AlignStatus::Done
        } else if self.negotiation.wish(pair) {
            AlignStatus::Accepted
        } else if self.negotiation.is_tried(pair) {
            AlignStatus::Done
        } else {
            AlignStatus::Unknown
        }
    }

    /// A submap of ours was described.
    pub(super) fn add_features(&mut self, submap: SubmapId, features: Features) {
        self.negotiation.add_features(submap, Arc::new(features));
    }

    /// After a restart: the features of a submap of ours.
    pub(super) fn restore_features(&mut self, context: &mut Context, submap: SubmapId, bytes: &[u8]) {
        match Features::decode(bytes) {
            Ok(features) => self.add_features(submap, features),
            Err(error) => context.reject(Some(context.robot()), "store: features", &format!("{submap}: {error}")),
        }
    }

    /// Keeps what a keypoint blob says. False if it says nothing.
    pub(super) fn keep_keypoints(&mut self, context: &mut Context, hash: Hash, blob: &[u8]) -> bool {
        match Keypoints::decode(blob) {
            Ok(keypoints) => {
                self.fetches.is_read(hash);
                self.negotiation.add_keypoints(hash, Arc::new(keypoints));
                true
            }
            Err(error) => {
                context.reject(None, "blob", &error.to_string());
                false
            }
        }
    }

    /// Submaps of ours are gone, and with them what was refused of them.
    pub(super) fn forget(&mut self, gone: &BTreeSet<SubmapId>) {
        gone.iter().for_each(|submap| self.negotiation.forget(*submap));
        let pairs = self.refusals.which(|(i, j), _| gone.contains(&i) || gone.contains(&j));
        self.refusals.forget(&pairs);
    }

    /// A robot came into reach: it may have what nobody had.
    pub(super) fn on_neighbour(&mut self) {
        self.fetches.on_neighbour();
        self.negotiation.mark_dirty();
    }

    /// Pieces of keypoints to ask for now, and how many questions more may be under way.
    pub(super) fn due_pieces(&self, now: Instant) -> (Vec<Lacking>, usize) {
        self.fetches.due(now)
    }

    /// A piece was asked for, or is to be asked for later.
    pub(super) fn on_piece_asked(&mut self, hash: Hash, asked: Result<QueryId, Instant>) {
        self.fetches.asked(hash, asked);
    }

    /// A piece of keypoints came; the next is not asked for before `next_piece`. All bytes, if it was the last.
    pub(super) fn on_piece(
        &mut self,
        query: QueryId,
        hash: Hash,
        place: (u32, u32),
        piece: &[u8],
        moments: [Instant; 2],
    ) -> Option<Vec<u8>> {
        let came = self.fetches.on_piece(query, hash, place, piece, moments);
        self.after_piece(came)
    }

    /// The holder of a piece has no room on its link.
    pub(super) fn on_put_off(&mut self, query: QueryId, hash: Hash, now: Instant) {
        let came = self.fetches.put_off_by_holder(query, hash, now);
        self.after_piece(came);
    }

    /// A question for a piece was in vain.
    pub(super) fn on_no_piece(&mut self, query: QueryId, now: Instant) {
        let came = self.fetches.failed(query, now);
        self.after_piece(came);
    }

    /// All pieces of a blob came, and it was kept if it is what it should be.
    pub(super) fn on_blob(&mut self, query: QueryId, hash: Hash, now: Instant) {
        match self.negotiation.keypoints(hash).is_some() {
            true => self.fetches.has_come(hash),
            false => self.on_no_piece(query, now),
        }
    }

    fn after_piece(&mut self, came: Piece) -> Option<Vec<u8>> {
        match came {
            Piece::Taken => None,
            Piece::Last(bytes) => Some(bytes),
            Piece::GivenUp => {
                self.negotiation.mark_dirty();
                None
            }
        }
    }

    /// After a restart: what the disk held of refused pairs.
    pub(super) fn restore_refusals(&mut self, refused: Vec<(Pair, u64)>) {
        self.refusals.restore(refused);
    }

    /// Whether so many refusals wait that they go to the disk by themselves.
    pub(super) fn are_refusals_many(&self) -> bool {
        self.refusals.are_many()
    }

    /// Refusals go to the disk with whatever else does now.
    pub(super) fn save_refusals(&mut self, mut keep: impl FnMut(Record)) {
        self.refusals.save(&mut keep);
    }

    /// A pair that we tried was refused. One of a submap that went meanwhile cannot be tried again, whatever is known.
    fn note_refusal(&mut self, context: &Context, knowledge: &Knowledge, pair: Pair) {
        let is_gone = |id: SubmapId| id.frame.robot == context.robot() && self.negotiation.features(id).is_none();
        if is_gone(pair.0) || is_gone(pair.1) {
            return;
        }
        if let Some(evidence) = evidence(&self.refusals, context, knowledge, pair) {
            self.refusals.add(pair, evidence);
        }
    }

    /// All facts were learned anew: refusals that rest on what is still so count as tried, others no more.
    fn weigh_refusals(&mut self, context: &Context, knowledge: &Knowledge) {
        let now = |pair| evidence(&self.refusals, context, knowledge, pair);
        let gone = self.refusals.which(|pair, evidence| now(pair) != Some(evidence));
        self.refusals.forget(&gone);
        gone.into_iter().for_each(|pair| self.negotiation.retry(pair));
        for (i, j) in self.refusals.pairs() {
            // Of a loop, ours is the one that was made later: it was paired up with those before it.
            let (mine, theirs) = if j.frame.robot == context.robot() { (j, i) } else { (i, j) };
            self.negotiation.restore_tried(mine, theirs);
        }
    }
}

/// A digest of what a try of this pair rests on; `None` if it is no pair that we could try.
fn evidence(refusals: &Refusals, context: &Context, knowledge: &Knowledge, pair: Pair) -> Option<u64> {
    let is_ours = [pair.0, pair.1].iter().any(|id| id.frame.robot == context.robot());
    if is_ours { refusals.evidence(knowledge, pair) } else { None }
}

/// Two robots have measured a pair of which one submap is ours.
fn report_agreement(context: &mut Context, knowledge: &Knowledge, alignment: EntryId) {
    let Some(fact) = knowledge.alignment(alignment) else { return };
    let (i, j) = (fact.i, fact.j);
    if i.frame.robot != context.robot() && j.frame.robot != context.robot() {
        return;
    }
    match knowledge.agreement(alignment) {
        Agreement::Agreed => {
            context.count().worked("agreed");
            context.event(Event::AlignmentAgreed { i, j });
        }
        Agreement::Disputed => {
            context.count().worked("disputed");
            context.event(Event::AlignmentDisputed { i, j });
        }
        Agreement::Waiting => {}
    }
}

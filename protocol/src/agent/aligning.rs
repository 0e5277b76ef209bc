//! The negotiation at work: candidates are noted as submaps become known, blobs fetched, alignments computed, stated
//! and verified.

use super::Agent;
use super::io::{Event, JobId};
use super::job::{AlignJob, Job, Look, Measured, NotAligned};
use super::knowledge::{Agreement, Knowledge, Known, Pair, pair_of};
use super::negotiation::{FETCHES_MAX, Fetch, LOOKALIKES_MAX, LOOP_GAP, Negotiation, Purpose, VERIFICATIONS_MAX, Work};
use super::overlap_model::Prediction;
use super::ranking::Proposal;
use super::shortlist::Candidate;
use crate::config::AlignConfig;
use crate::geometry::Relative;
use crate::ids::{EntryId, Hash, RobotId, SubmapId};
use crate::submap::{Keypoints, Summary, Verticals};
use crate::time::Instant;
use crate::wire::fact::{AlignmentFact, Fact, LookalikeFact, RefusalReason, ScaleKind, VerdictFact, VerdictOutcome};
use core::time::Duration;
use std::collections::BTreeSet;
use std::sync::Arc;

/// When a fetch is looked at again that nobody can serve now.
const FETCH_AGAIN: Duration = Duration::from_millis(500);

impl Agent {
    /// A fact has taken effect: what does it call for?
    pub(super) fn on_fact(&mut self, id: EntryId, fact: &Fact) {
        self.negotiation.mark_dirty();
        match fact {
            Fact::Submap(fact) => self.note_candidates(SubmapId { frame: id.frame, index: fact.index }),
            Fact::Alignment(fact) => self.note_verification(id, fact),
            Fact::Verdict(fact) => self.report_agreement(fact.alignment),
            // What is carried on called for something when it was new; to whom it is new, it calls now.
            Fact::Condensed(condensed) => {
                for one in condensed.carried.iter().filter(|one| !matches!(one.fact, Fact::Verdict(_))) {
                    self.on_fact(EntryId { seq: one.seq, ..id }, &one.fact);
                }
            }
            Fact::Sighting(_) | Fact::Position(_) | Fact::Lookalike(_) => {}
        }
    }

    /// Pairs a submap that became known with all that it may overlap: one of ours with all, one of another's with ours.
    fn note_candidates(&mut self, new: SubmapId) {
        let Some(known) = self.knowledge.submap(new) else { return };
        let looks =
            Looks { me: self.context.robot(), knowledge: &self.knowledge, config: &self.context.config().align };
        if new.frame.robot != self.context.robot() {
            looks.pair_up(&mut self.negotiation, &looks.ours(), [(new, known)].into_iter());
        } else if let Some(summary) = &known.summary {
            looks.pair_up(&mut self.negotiation, &[(new, summary)], self.knowledge.submaps());
        }
    }

    /// Pairs all of our submaps with all that they may overlap.
    pub(super) fn note_all_candidates(&mut self) {
        let looks =
            Looks { me: self.context.robot(), knowledge: &self.knowledge, config: &self.context.config().align };
        looks.pair_up(&mut self.negotiation, &looks.ours(), self.knowledge.submaps());
        self.negotiation.mark_dirty();
    }

    /// Somebody aligned one of our submaps: we owe an answer, once.
    fn note_verification(&mut self, id: EntryId, fact: &AlignmentFact) {
        // What a third party says of two others is no try of theirs, or a liar could keep all pairs from being tried.
        if self.knowledge.alignment(id).is_none() {
            return;
        }
        self.negotiation.mark_tried((fact.i, fact.j));
        self.negotiation.peer_requests.remove((fact.i, fact.j));
        let ours = fact.i.frame.robot == self.context.robot() || fact.j.frame.robot == self.context.robot();
        let owed =
            ours && id.frame.robot != self.context.robot() && !self.knowledge.has_verdict(id, self.context.robot());
        if owed {
            self.owe_answer(id);
        }
    }

    /// Of more than may wait for an answer, some go that cannot have one now.
    fn owe_answer(&mut self, id: EntryId) {
        let is_full = self.negotiation.verify.len() >= VERIFICATIONS_MAX;
        let now = if is_full { self.answers_owed().into_iter().collect() } else { BTreeSet::new() };
        self.negotiation.add_verification(id, |id| !now.contains(id));
    }

    fn report_agreement(&mut self, alignment: EntryId) {
        let Some(fact) = self.knowledge.alignment(alignment) else { return };
        let (i, j) = (fact.i, fact.j);
        if i.frame.robot != self.context.robot() && j.frame.robot != self.context.robot() {
            return;
        }
        match self.knowledge.agreement(alignment) {
            Agreement::Agreed => {
                self.context.count().worked("agreed");
                self.context.event(Event::AlignmentAgreed { i, j });
            }
            Agreement::Disputed => {
                self.context.count().worked("disputed");
                self.context.event(Event::AlignmentDisputed { i, j });
            }
            Agreement::Waiting => {}
        }
    }

    pub(super) fn fetch_timeout(&self) -> Option<Instant> {
        self.negotiation.fetches.values().filter(|f| f.query.is_none()).map(|f| f.not_before).min()
    }

    /// Starts as many alignments as allowed: answers owed first, then the most promising candidates.
    pub(super) fn start_aligning(&mut self) {
        let further = self.allowance.take_due(self.context.now());
        if (self.negotiation.take_stirred() || further) && !self.is_receive_only() {
            self.start_verifying();
            if self.has_room() || !self.negotiation.fetches.is_empty() {
                let active = self.active_candidates();
                self.start_proposing(&active);
                self.drop_idle_fetches(&active);
            }
        }
        self.start_fetching();
    }

    fn has_room(&self) -> bool {
        self.negotiation.running.len() < self.context.config().align.jobs_max
    }

    fn start_verifying(&mut self) {
        for id in self.answers_owed() {
            let Some(fact) = self.knowledge.alignment(id).cloned() else {
                self.negotiation.verify.remove(&id);
                continue;
            };
            let (mine, theirs) = self.ours_first(&fact);
            let further = self.is_second_look(&fact);
            let Some(further) = further.filter(|_| self.negotiation.features(mine).is_some()) else {
                self.negotiation.verify.remove(&id);
                self.write_verdict(id, VerdictOutcome::Refused(RefusalReason::BadInput));
                continue;
            };
            if self.has_room() && self.start_alignment(mine, theirs, Purpose::Verify(id), further) {
                self.negotiation.verify.remove(&id);
            }
        }
    }

    fn start_proposing(&mut self, active: &[Proposal]) {
        self.negotiation.begun.retain(|begun| active.iter().any(|p| pair_of(p.mine, p.theirs) == *begun));
        for &Proposal { mine, theirs, may_wait, bytes, prediction, further } in active {
            if !self.has_room() || self.negotiation.is_fetching_enough(self.context.now()) {
                break;
            }
            let pair = pair_of(mine, theirs);
            if !self.negotiation.begun.contains(&pair) {
                match may_wait {
                    true if !self.allowance.may_spend(self.context.now()) => continue,
                    true => self.allowance.spend(self.context.now(), bytes),
                    // A loop of our own is stated once, and moves no keypoints.
                    false if self.is_loop(mine, theirs) => {}
                    false => self.allowance.owe(self.context.now(), bytes),
                }
                self.negotiation.begun.insert(pair);
            }
            // Without features (evicted, or never described) the pair cannot be tried: off the list as well.
            let mut ours = [mine, theirs].into_iter().filter(|id| id.frame.robot == self.context.robot());
            let lacks = ours.any(|id| self.negotiation.features(id).is_none());
            if lacks || self.start_alignment(mine, theirs, Purpose::Propose(prediction), further) {
                self.negotiation.mark_tried(pair);
            }
        }
    }

    /// Nobody in reach has the submap's keypoints.
    pub(super) fn is_out_of_reach(&self, id: SubmapId) -> bool {
        !self.negotiation.out_of_reach.is_empty()
            && self.knowledge.submap(id).is_some_and(|fact| self.negotiation.out_of_reach.contains(&fact.blob))
    }

    /// Alignments that wait for our answer and can be worked on now.
    pub(super) fn answers_owed(&self) -> Vec<EntryId> {
        let reachable = |id: &&EntryId| {
            let fact = self.knowledge.alignment(**id);
            fact.is_none_or(|fact| {
                !self.is_out_of_reach(fact.i) && !self.is_out_of_reach(fact.j) && self.may_be_judged(fact)
            })
        };
        self.negotiation.verify.iter().filter(reachable).copied().collect()
    }

    /// Starts aligning a pair, if the keypoints it takes are here; otherwise has them fetched.
    fn start_alignment(&mut self, mine: SubmapId, theirs: SubmapId, purpose: Purpose, further: bool) -> bool {
        let Some((keypoints, used)) = self.keypoints_of(theirs, further) else { return false };
        if further && used.is_none() && matches!(purpose, Purpose::Propose(_)) {
            // There is nothing to be seen that was not at first.
            return true;
        }
        let Some(features) = self.negotiation.features(mine).cloned() else { return false };
        let back = self.is_loop(mine, theirs).then(|| self.looking_back(mine, theirs, further));
        if back.as_ref().is_some_and(Option::is_none) {
            return false;
        }
        let scale = self.knowledge.submap(theirs).map_or(ScaleKind::Unknown, |fact| fact.scale);
        // Whatever the unit is, within one frame it is the same.
        let metric = mine.frame == theirs.frame
            || (self.context.config().submap.scale, scale) == (ScaleKind::Metric, ScaleKind::Metric);
        let job = AlignJob {
            theirs: keypoints,
            mine: features,
            back: back.flatten(),
            config: self.context.config().align.clone(),
            voxel_m: self.context.config().submap.voxel_m,
            sensor: self.context.config().submap.sensor,
            verticals: self.verticals(mine, theirs),
            scale: if metric { ScaleKind::Metric } else { ScaleKind::Unknown },
            seed: self.pair_seed(pair_of(mine, theirs)),
        };
        let id = self.context.run_job(Job::Align(Box::new(job)));
        self.negotiation.running.insert(id, Work { mine, theirs, purpose, further: used });
        true
    }

    /// Which way is up, as both submaps' summaries have it: what everyone who aligns the pair reckons with.
    fn verticals(&self, mine: SubmapId, theirs: SubmapId) -> Option<Verticals> {
        let up = |id| self.knowledge.submap(id)?.summary.as_ref()?.up();
        Verticals::of(up(theirs), up(mine))
    }

    /// Both submaps are ours: nobody else will look at the pair.
    pub(super) fn is_loop(&self, mine: SubmapId, theirs: SubmapId) -> bool {
        mine.frame.robot == theirs.frame.robot
    }

    /// What it takes to look at a loop from its other end as well.
    fn looking_back(&mut self, mine: SubmapId, theirs: SubmapId, further: bool) -> Option<Look> {
        let features = self.negotiation.features(theirs).cloned()?;
        Some((self.keypoints_of(mine, further)?.0, features))
    }

    /// What a blob of this submap says, if it is here; otherwise it is fetched.
    pub(super) fn keypoints_at(&mut self, blob: Hash, submap: SubmapId) -> Option<Arc<Keypoints>> {
        if let Some(keypoints) = self.negotiation.keypoints(blob) {
            return Some(keypoints.clone());
        }
        if let Some(Ok(keypoints)) = self.gossip.blob(blob).map(Keypoints::decode) {
            return Some(Arc::new(keypoints));
        }
        let fetch = || Fetch::new(submap.frame.robot, self.context.now());
        self.negotiation.fetches.entry(blob).or_insert_with(fetch);
        None
    }

    /// A seed of our own for this pair: independent of the other endpoint's, the same in a replay.
    fn pair_seed(&self, pair: Pair) -> u64 {
        let mut bytes = Vec::with_capacity(80);
        bytes.extend_from_slice(&self.context.robot().0);
        for id in [pair.0, pair.1] {
            bytes.extend_from_slice(&id.frame.robot.0);
            bytes.extend_from_slice(&id.frame.epoch.to_le_bytes());
            bytes.extend_from_slice(&id.index.to_le_bytes());
        }
        let Hash(hash) = Hash::of(&bytes);
        let [a, b, c, d, e, f, g, h, ..] = hash;
        u64::from_le_bytes([a, b, c, d, e, f, g, h]) ^ self.context.seed()
    }

    /// Stops fetching what no pair needs any more: of those that were active, the ones that have not begun.
    fn drop_idle_fetches(&mut self, active: &[Proposal]) {
        let waits = |c: &&Proposal| c.further || !self.negotiation.is_tried(pair_of(c.mine, c.theirs));
        let mut wanted: BTreeSet<SubmapId> = active.iter().filter(waits).flat_map(|c| [c.mine, c.theirs]).collect();
        for id in self.answers_owed() {
            wanted.extend(self.knowledge.alignment(id).into_iter().flat_map(|fact| [fact.i, fact.j]));
        }
        let first = |id| self.knowledge.submap(id).map(|fact| fact.blob);
        let blobs: BTreeSet<Hash> =
            wanted.into_iter().flat_map(|id| [first(id), self.address_of(id)]).flatten().collect();
        self.negotiation.fetches.retain(|hash, fetch| fetch.query.is_some() || blobs.contains(hash));
    }

    fn start_fetching(&mut self) {
        let idle = |fetch: &Fetch| fetch.query.is_none() && fetch.not_before <= self.context.now();
        let due: Vec<(Hash, Option<RobotId>, usize)> = self
            .negotiation
            .fetches
            .iter()
            .filter(|(_, fetch)| idle(fetch))
            .map(|(hash, fetch)| (*hash, self.holder(fetch), fetch.got.len()))
            .collect();
        let mut free =
            FETCHES_MAX.saturating_sub(self.negotiation.fetches.values().filter(|f| f.query.is_some()).count());
        for (hash, peer, offset) in due {
            let query = match peer {
                Some(peer) if free > 0 && self.gossip.may_fetch(self.context.now()) => {
                    self.fetch_blob(hash, offset, peer)
                }
                // Nobody to ask, enough under way, or too soon: look again later.
                _ => {
                    let idle = peer.is_none() || free == 0;
                    let later = if idle { self.context.now().after(FETCH_AGAIN) } else { self.gossip.next_piece() };
                    self.negotiation.fetches.entry(hash).and_modify(|fetch| fetch.not_before = later);
                    continue;
                }
            };
            free -= 1;
            self.negotiation.fetches.entry(hash).and_modify(|fetch| fetch.query = Some(query));
        }
    }

    /// Whom to ask for a blob: its owner, or after failures any neighbour in turn (whoever fetched it has it).
    fn holder(&self, fetch: &Fetch) -> Option<RobotId> {
        let spread = &self.gossip.spread;
        let turn = fetch.failures as usize;
        if turn.is_multiple_of(2) && spread.is_neighbour(fetch.owner) {
            return Some(fetch.owner);
        }
        spread.neighbours().nth((turn / 2) % spread.neighbours().count().max(1))
    }

    pub(super) fn on_aligned(&mut self, job: JobId, outcome: Result<Box<Measured>, NotAligned>) {
        let Some(work) = self.negotiation.running.remove(&job) else { return };
        self.negotiation.mark_dirty();
        let agrees = outcome.as_ref().map_or(Some(true), |found| self.agrees_with_map(&work, &found.t_mine_theirs));
        let outcome = match agrees {
            Some(true) => outcome,
            Some(false) => Err(RefusalReason::NoConsensus.into()),
            None => return self.put_off(&work),
        };
        self.context.count().worked(if outcome.is_ok() { "aligned" } else { "refused" });
        match work.purpose {
            Purpose::Propose(prediction) => {
                self.tell_try(&work, prediction, outcome.is_ok());
                match outcome {
                    Ok(measured) => self.propose(&work, &measured),
                    Err(why) => {
                        self.note_refusal(pair_of(work.mine, work.theirs));
                        self.note_second_look(&work, prediction, why.reason);
                        self.note_lookalike(&work, why);
                    }
                }
            }
            Purpose::Verify(id) => {
                let verdict = match outcome {
                    Ok(measured) => VerdictOutcome::Measured {
                        t_i_j: t_i_j(&work, &measured.t_mine_theirs),
                        sigma: measured.sigma as f32,
                        support: to_support(measured.support),
                    },
                    Err(why) => VerdictOutcome::Refused(why.reason),
                };
                self.write_verdict(id, verdict);
            }
        }
    }

    /// Of two of our own submaps, one fits at another place as well: all are told so, once of either, so that no single
    /// bare submap speaks for a whole frame. Of submaps of another epoch nothing is told.
    fn note_lookalike(&mut self, work: &Work, why: NotAligned) {
        let ((i, j), frame) = (pair_of(work.mine, work.theirs), self.context.frame());
        // Second looks speak for no merge, and against none.
        let is_of_ours = i.frame == frame && j.frame == frame && work.further.is_none();
        if !why.elsewhere || !is_of_ours {
            return;
        }
        let told = self.knowledge.lookalikes_of(frame);
        let is_new = |index: u32| told.iter().all(|(i, j)| *i != index && *j != index);
        if told.len() < LOOKALIKES_MAX && is_new(i.index) && is_new(j.index) {
            self.write(frame.epoch, &Fact::Lookalike(LookalikeFact { i: i.index, j: j.index }));
        }
    }

    fn tell_try(&mut self, work: &Work, prediction: Prediction, found: bool) {
        let (i, j) = pair_of(work.mine, work.theirs);
        if work.further.is_some() {
            self.context.count().worked(if found { "second_look_aligned" } else { "second_look_refused" });
            return self.context.event(Event::LookedAgain { i, j, found });
        }
        self.negotiation.overlap_model.learn(&prediction.features, found);
        self.context.event(Event::AlignmentTried { i, j, expected: prediction.probability, found });
    }

    /// A second look of which our map cannot say any more whether it agrees: an answer that is owed waits until it can.
    fn put_off(&mut self, work: &Work) {
        if let Purpose::Verify(id) = work.purpose {
            self.owe_answer(id);
        }
    }

    fn propose(&mut self, work: &Work, measured: &Measured) {
        let (i, j) = pair_of(work.mine, work.theirs);
        let Some(blobs) = self.blobs_used(work) else { return };
        self.context.event(Event::AlignmentProposed { i, j, support: measured.support });
        let fact = Fact::Alignment(AlignmentFact {
            i,
            j,
            t_i_j: t_i_j(work, &measured.t_mine_theirs),
            sigma: measured.sigma as f32,
            support: to_support(measured.support),
            log10_nfa: measured.log10_nfa as f32,
            blobs,
        });
        self.write(self.context.frame().epoch, &fact);
    }

    fn write_verdict(&mut self, alignment: EntryId, outcome: VerdictOutcome) {
        self.write(self.context.frame().epoch, &Fact::Verdict(VerdictFact { alignment, outcome }));
    }

    /// The most similar pair that the other endpoint should try and that would join frames not yet merged.
    pub(super) fn best_wish(&mut self) -> Option<Pair> {
        let reachable = |pair: &Pair| [pair.0, pair.1].iter().any(|id| self.gossip.spread.is_neighbour(id.frame.robot));
        let best = self
            .negotiation
            .peer_requests
            .iter()
            .filter(|(pair, _)| reachable(pair) && !self.are_connected(pair.0, pair.1))
            .max_by(|a, b| a.1.similarity.value.total_cmp(&b.1.similarity.value).then(b.0.cmp(&a.0)))
            .map(|(pair, _)| pair)?;
        self.negotiation.peer_requests.remove(best);
        Some(best)
    }
}

/// What the summaries of submaps say of which may overlap.
struct Looks<'a> {
    me: RobotId,
    knowledge: &'a Knowledge,
    config: &'a AlignConfig,
}

impl Looks<'_> {
    fn ours(&self) -> Vec<(SubmapId, &Summary)> {
        let ours = self.knowledge.submaps_of(self.me);
        ours.filter_map(|(id, known)| Some((id, known.summary.as_ref()?))).collect()
    }

    /// Notes each of `ours` with each of `all` that may overlap it: as a candidate if we are to begin, else as a wish.
    /// Millions of pairs at a start: each of `all` is looked at once, and few are alike enough for more than a glance.
    fn pair_up<'k>(
        &self,
        negotiation: &mut Negotiation,
        ours: &[(SubmapId, &Summary)],
        all: impl Iterator<Item = (SubmapId, &'k Known)>,
    ) {
        let limit = self.config.candidates_max;
        let wanted = |negotiation: &Negotiation| self.config.similarity_min.max(negotiation.least_similarity(limit));
        let mut least = wanted(negotiation);
        for (theirs, known) in all {
            let Some(looks) = &known.summary else { continue };
            for &(mine, summary) in ours {
                let Some(similarity) = summary.similarity_from(looks, least) else { continue };
                let pair = pair_of(mine, theirs);
                if !self.may_pair(mine, theirs) || negotiation.is_tried(pair) {
                    continue;
                }
                let candidate = Candidate { mine, theirs, similarity, wished: false, further: false };
                if Negotiation::responsible(pair) == self.me || mine.frame.robot == theirs.frame.robot {
                    negotiation.add_candidate(candidate, limit);
                } else {
                    negotiation.peer_requests.offer(candidate, limit);
                }
                least = wanted(negotiation);
            }
        }
    }

    fn may_pair(&self, mine: SubmapId, theirs: SubmapId) -> bool {
        let far = mine.frame != theirs.frame || mine.index.abs_diff(theirs.index) >= LOOP_GAP;
        far && !self.knowledge.is_stated(pair_of(mine, theirs))
    }
}

/// The measurement in the canonical direction: target the smaller submap.
fn t_i_j(work: &Work, t_mine_theirs: &Relative) -> Relative {
    if work.mine < work.theirs { *t_mine_theirs } else { t_mine_theirs.inverse() }
}

fn to_support(support: f64) -> u16 {
    support.clamp(0.0, f64::from(u16::MAX)) as u16
}

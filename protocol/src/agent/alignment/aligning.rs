//! The negotiation at work: answers owed and promising pairs are aligned as far as there is room, and what was found is
//! stated, or refused.

use super::negotiation::{LOOKALIKES_MAX, Purpose, Work};
use super::overlap_model::Prediction;
use super::prospects::is_loop;
use super::ranking::Proposal;
use super::{Alignment, Sources};
use crate::agent::context::Context;
use crate::agent::io::{Event, JobId};
use crate::agent::job::{AlignJob, Job, Look, Measured, NotAligned};
use crate::agent::replication::knowledge::{Knowledge, Pair, pair_of};
use crate::geometry::Relative;
use crate::ids::{EntryId, Hash, SubmapId};
use crate::submap::Keypoints;
use crate::time::Instant;
use crate::wire::fact::{AlignmentFact, Fact, LookalikeFact, RefusalReason, ScaleKind, VerdictFact, VerdictOutcome};
use std::sync::Arc;

impl Alignment {
    /// Whether alignments may be startable that were not before; true once.
    pub(in crate::agent) fn take_due(&mut self, now: Instant) -> bool {
        let further = self.allowance.take_due(now);
        self.negotiation.take_stirred() || further
    }

    /// Starts as many of the most promising candidates as allowed, once answers owed have begun.
    pub(in crate::agent) fn start(&mut self, context: &mut Context, sources: Sources<'_>) {
        if self.has_room(context) || !self.fetches.is_empty() {
            let active = self.prospects(context, sources).active_candidates();
            self.start_proposing(context, sources, &active);
            // What no pair needs any more is not fetched.
            let needed = self.prospects(context, sources).blobs_needed(&active);
            self.fetches.drop_idle(|hash| needed.contains(hash));
        }
    }

    fn has_room(&self, context: &Context) -> bool {
        self.negotiation.running.len() < context.config().align.jobs_max
    }

    /// Works on an alignment that waits for our answer. The answer, if there is nothing to compute.
    pub(in crate::agent) fn start_answer(
        &mut self,
        context: &mut Context,
        sources: Sources<'_>,
        id: EntryId,
    ) -> Option<Fact> {
        let Some(fact) = sources.knowledge.alignment(id) else {
            self.negotiation.verify.remove(&id);
            return None;
        };
        let prospects = self.prospects(context, sources);
        let (mine, theirs) = prospects.ours_first(fact);
        let further = prospects.is_second_look(fact);
        let is_copy = sources.knowledge.copied_from(theirs).is_some();
        let Some(further) = further.filter(|_| !is_copy && self.negotiation.features(mine).is_some()) else {
            self.negotiation.verify.remove(&id);
            return Some(verdict(id, VerdictOutcome::Refused(RefusalReason::BadInput)));
        };
        if self.has_room(context)
            && self.start_alignment(context, sources, [mine, theirs], Purpose::Verify(id), further)
        {
            self.negotiation.verify.remove(&id);
        }
        None
    }

    fn start_proposing(&mut self, context: &mut Context, sources: Sources<'_>, active: &[Proposal]) {
        self.negotiation.begun.retain(|begun| active.iter().any(|p| pair_of(p.mine, p.theirs) == *begun));
        let now = context.now();
        for &Proposal { mine, theirs, may_wait, bytes, prediction, further } in active {
            if !self.has_room(context) || self.fetches.are_enough(now) {
                break;
            }
            let pair = pair_of(mine, theirs);
            if !self.negotiation.begun.contains(&pair) {
                match may_wait {
                    true if !self.allowance.may_spend(now) => continue,
                    true => self.allowance.spend(now, bytes),
                    // A loop of our own is stated once, and moves no keypoints.
                    false if is_loop(mine, theirs) => {}
                    false => self.allowance.owe(now, bytes),
                }
                self.negotiation.begun.insert(pair);
            }
            // Without features (evicted, or never described) the pair cannot be tried: off the list as well.
            let mut ours = [mine, theirs].into_iter().filter(|id| id.frame.robot == context.robot());
            let lacks = ours.any(|id| self.negotiation.features(id).is_none());
            let purpose = Purpose::Propose(prediction);
            if lacks || self.start_alignment(context, sources, [mine, theirs], purpose, further) {
                self.negotiation.mark_tried(pair);
            }
        }
    }

    /// Starts aligning a pair, if the keypoints it takes are here; otherwise has them fetched.
    fn start_alignment(
        &mut self,
        context: &mut Context,
        sources: Sources<'_>,
        [mine, theirs]: [SubmapId; 2],
        purpose: Purpose,
        further: bool,
    ) -> bool {
        let now = context.now();
        let Some((keypoints, used)) = self.keypoints_of(sources, theirs, further, now) else { return false };
        if further && used.is_none() && matches!(purpose, Purpose::Propose(_)) {
            // There is nothing to be seen that was not at first.
            return true;
        }
        let Some(features) = self.negotiation.features(mine).cloned() else { return false };
        let back = is_loop(mine, theirs).then(|| self.looking_back(sources, [mine, theirs], further, now));
        if back.as_ref().is_some_and(Option::is_none) {
            return false;
        }
        let scale = sources.knowledge.submap(theirs).map_or(ScaleKind::Unknown, |fact| fact.scale);
        let config = context.config();
        // Whatever the unit is, within one frame it is the same.
        let metric =
            mine.frame == theirs.frame || (config.submap.scale, scale) == (ScaleKind::Metric, ScaleKind::Metric);
        let job = AlignJob {
            theirs: keypoints,
            mine: features,
            back: back.flatten(),
            config: config.align.clone(),
            voxel_m: config.submap.voxel_m,
            sensor: config.submap.sensor,
            verticals: self.prospects(context, sources).verticals(mine, theirs),
            scale: if metric { ScaleKind::Metric } else { ScaleKind::Unknown },
            seed: pair_seed(context, pair_of(mine, theirs)),
        };
        let id = context.run_job(Job::Align(Box::new(job)));
        self.negotiation.running.insert(id, Work { mine, theirs, purpose, further: used });
        true
    }

    /// What it takes to look at a loop from its other end as well.
    fn looking_back(
        &mut self,
        sources: Sources<'_>,
        [mine, theirs]: [SubmapId; 2],
        further: bool,
        now: Instant,
    ) -> Option<Look> {
        let features = self.negotiation.features(theirs).cloned()?;
        Some((self.keypoints_of(sources, mine, further, now)?.0, features))
    }

    /// The keypoints of a submap, with the further ones if these are wanted and there are any, and then their address.
    /// `None` until they are here.
    fn keypoints_of(
        &mut self,
        sources: Sources<'_>,
        submap: SubmapId,
        further: bool,
        now: Instant,
    ) -> Option<(Arc<Keypoints>, Option<Hash>)> {
        let blob = sources.knowledge.submap(submap)?.blob;
        let first = self.keypoints_at(sources, blob, submap, now)?;
        let Some(address) = first.further().filter(|_| further) else { return Some((first, None)) };
        let more = self.keypoints_at(sources, address, submap, now)?;
        // Further keypoints that do not fit the first ones are left out.
        Some(first.with_further(&more).map_or((first, None), |both| (Arc::new(both), Some(address))))
    }

    /// What a blob of this submap says, if it is here; otherwise it is fetched.
    fn keypoints_at(
        &mut self,
        sources: Sources<'_>,
        blob: Hash,
        submap: SubmapId,
        now: Instant,
    ) -> Option<Arc<Keypoints>> {
        if let Some(keypoints) = self.negotiation.keypoints(blob) {
            return Some(keypoints.clone());
        }
        if let Some(Ok(keypoints)) = sources.blobs.get(blob).map(Keypoints::decode) {
            return Some(Arc::new(keypoints));
        }
        self.fetches.want(blob, submap.frame.robot, now);
        None
    }

    /// An alignment was computed, or could not be. What is to be stated of it.
    pub(in crate::agent) fn on_aligned(
        &mut self,
        context: &mut Context,
        sources: Sources<'_>,
        job: JobId,
        outcome: Result<Box<Measured>, NotAligned>,
    ) -> Option<Fact> {
        let work = self.negotiation.running.remove(&job)?;
        self.negotiation.mark_dirty();
        let prospects = self.prospects(context, sources);
        let agrees =
            outcome.as_ref().map_or(Some(true), |found| prospects.agrees_with_map(&work, &found.t_mine_theirs));
        let outcome = match agrees {
            Some(true) => outcome,
            Some(false) => Err(RefusalReason::NoConsensus.into()),
            None => {
                self.put_off(context, sources, &work);
                return None;
            }
        };
        context.count().worked(if outcome.is_ok() { "aligned" } else { "refused" });
        match work.purpose {
            Purpose::Propose(prediction) => {
                self.tell_try(context, &work, prediction, outcome.is_ok());
                if work.further.is_none() {
                    self.tries.note(work.mine.frame, work.theirs.frame, outcome.as_ref().err().map(|why| why.reason));
                }
                match outcome {
                    Ok(measured) => self.propose(context, sources, &work, &measured),
                    Err(why) => {
                        self.note_refusal(context, sources.knowledge, pair_of(work.mine, work.theirs));
                        let again = self.prospects(context, sources).second_look(&work, prediction, why.reason);
                        again.into_iter().for_each(|candidate| self.negotiation.add_second_look(candidate));
                        lookalike(context, sources.knowledge, &work, why)
                    }
                }
            }
            Purpose::Verify(id) => Some(verdict(
                id,
                match outcome {
                    Ok(measured) => VerdictOutcome::Measured {
                        t_i_j: t_i_j(&work, &measured.t_mine_theirs),
                        sigma: measured.sigma as f32,
                        support: to_support(measured.support),
                    },
                    Err(why) => VerdictOutcome::Refused(why.reason),
                },
            )),
        }
    }

    fn tell_try(&mut self, context: &mut Context, work: &Work, prediction: Prediction, found: bool) {
        let (i, j) = pair_of(work.mine, work.theirs);
        if work.further.is_some() {
            context.count().worked(if found { "second_look_aligned" } else { "second_look_refused" });
            return context.event(Event::LookedAgain { i, j, found });
        }
        self.negotiation.overlap_model.learn(&prediction.features, found);
        context.event(Event::AlignmentTried { i, j, expected: prediction.probability, found });
    }

    /// A second look of which our map cannot say any more whether it agrees: an answer that is owed waits until it can.
    fn put_off(&mut self, context: &Context, sources: Sources<'_>, work: &Work) {
        if let Purpose::Verify(id) = work.purpose {
            self.owe_answer(context, sources, id);
        }
    }

    fn propose(&self, context: &mut Context, sources: Sources<'_>, work: &Work, measured: &Measured) -> Option<Fact> {
        let (i, j) = pair_of(work.mine, work.theirs);
        let blobs = self.prospects(context, sources).blobs_used(work)?;
        context.event(Event::AlignmentProposed { i, j, support: measured.support });
        Some(Fact::Alignment(AlignmentFact {
            i,
            j,
            t_i_j: t_i_j(work, &measured.t_mine_theirs),
            sigma: measured.sigma as f32,
            support: to_support(measured.support),
            log10_nfa: measured.log10_nfa as f32,
            blobs,
        }))
    }
}

fn verdict(alignment: EntryId, outcome: VerdictOutcome) -> Fact {
    Fact::Verdict(VerdictFact { alignment, outcome })
}

/// Of two of our own submaps, one fits at another place as well: all are told so, once of either, so that no single
/// bare submap speaks for a whole frame. Of submaps of another epoch nothing is told.
fn lookalike(context: &Context, knowledge: &Knowledge, work: &Work, why: NotAligned) -> Option<Fact> {
    let ((i, j), frame) = (pair_of(work.mine, work.theirs), context.frame());
    // Second looks speak for no merge, and against none.
    let is_of_ours = i.frame == frame && j.frame == frame && work.further.is_none();
    if !why.elsewhere || !is_of_ours {
        return None;
    }
    let told = knowledge.lookalikes_of(frame);
    let is_new = |index: u32| told.iter().all(|(i, j)| *i != index && *j != index);
    let is_worth = told.len() < LOOKALIKES_MAX && is_new(i.index) && is_new(j.index);
    is_worth.then_some(Fact::Lookalike(LookalikeFact { i: i.index, j: j.index }))
}

/// A seed of our own for this pair: independent of the other endpoint's, the same in a replay.
fn pair_seed(context: &Context, pair: Pair) -> u64 {
    let mut bytes = Vec::with_capacity(80);
    bytes.extend_from_slice(&context.robot().0);
    for id in [pair.0, pair.1] {
        bytes.extend_from_slice(&id.frame.robot.0);
        bytes.extend_from_slice(&id.frame.epoch.to_le_bytes());
        bytes.extend_from_slice(&id.index.to_le_bytes());
    }
    let Hash(hash) = Hash::of(&bytes);
    let [a, b, c, d, e, f, g, h, ..] = hash;
    u64::from_le_bytes([a, b, c, d, e, f, g, h]) ^ context.seed()
}

/// The measurement in the canonical direction: target the smaller submap.
fn t_i_j(work: &Work, t_mine_theirs: &Relative) -> Relative {
    if work.mine < work.theirs { *t_mine_theirs } else { t_mine_theirs.inverse() }
}

fn to_support(support: f64) -> u16 {
    support.clamp(0.0, f64::from(u16::MAX)) as u16
}

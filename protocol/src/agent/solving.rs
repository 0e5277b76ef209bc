//! When the joint estimate is solved again, and what changed when it was.

use super::Agent;
use super::io::{Event, JobId};
use super::job::{Job, SolveJob, Solved};
use super::knowledge::{EstimationInput, Gaps, Known};
use super::steps::Steps;
use crate::geometry::{PoseWithCovariance, Relative};
use crate::ids::{EntryId, FrameId, Hash, SubmapId};
use crate::time::Instant;
use crate::wire::fact::{Fact, SubmapFact};
use core::time::Duration;
use std::collections::{BTreeMap, BTreeSet};

/// A solve is followed by a rest of so many times what it took, the wait for other jobs included: however large the map
/// and small the computer, at least so much of a core is left to the rest of the robot.
const REST: u32 = 4;
/// Longest such rest: what has become known meanwhile is to be seen at last.
const REST_MAX: Duration = Duration::from_secs(30);

/// The joint estimate and the state of its solver.
#[derive(Default)]
pub(super) struct MapState {
    pub(super) solved: Solved,
    /// Our frame when the estimate was posed, in which its views are given. A new epoch has another.
    seen_from: Option<FrameId>,
    /// Frames that the estimate passed over because nothing ties them to anything, and how many anchors each has.
    pub(super) alone: BTreeMap<FrameId, usize>,
    /// Facts came in since the last problem was posed.
    pub(super) dirty: bool,
    pub(super) solving: Option<JobId>,
    posed_at: Instant,
    posed_digest: Hash,
    posed_from: Option<FrameId>,
    posed_alone: BTreeMap<FrameId, usize>,
    posed_gaps: Gaps,
    /// Digest of the set of facts that the estimate is a function of.
    pub(super) digest: Hash,
    next_solve: Instant,
    merged: BTreeSet<FrameId>,
    /// The odometry of the last problem posed.
    pub(super) steps: Steps,
}

impl Agent {
    pub(super) fn solve_timeout(&self) -> Option<Instant> {
        (self.map.dirty && self.map.solving.is_none()).then_some(self.map.next_solve)
    }

    pub(super) fn start_solving(&mut self) {
        if self.map.dirty && self.map.solving.is_none() && self.context.now() >= self.map.next_solve {
            let config = self.context.config().estimate.clone();
            let own = self.context.frame();
            let mut steps = core::mem::take(&mut self.map.steps).renewed();
            let odometry = |known: &Known| steps.of(known, || self.submap_fact(known).map(|fact| fact.odometry));
            let EstimationInput { problem, alone, gaps } = self.knowledge.question(own, odometry);
            self.map.steps = steps;
            let live = self.live_pairs(&problem, &gaps);
            let job = SolveJob { problem, config, own, live };
            (self.map.posed_from, self.map.posed_alone, self.map.posed_gaps) = (Some(own), alone, gaps);
            self.map.dirty = false;
            self.map.posed_at = self.context.now();
            self.map.posed_digest = self.replica.digest();
            self.map.next_solve =
                self.context.now().after(Duration::from_secs_f64(self.context.config().estimate.interval_secs));
            self.map.solving = Some(self.context.run_job(Job::Solve(Box::new(job))));
        }
    }

    pub(super) fn on_solved(&mut self, job: JobId, solved: Solved) {
        if self.map.solving.take_if(|running| *running == job).is_none() {
            return;
        }
        let rest = self.context.now().since(self.map.posed_at).saturating_mul(REST).min(REST_MAX);
        self.map.next_solve = self.map.next_solve.max(self.context.now().after(rest));
        self.map.digest = self.map.posed_digest;
        self.map.seen_from = self.map.posed_from;
        self.map.alone = core::mem::take(&mut self.map.posed_alone);
        self.map.solved = solved.with_indices(&core::mem::take(&mut self.map.posed_gaps));
        let merged = self.frames_merged_with_ours();
        self.negotiation.mark_dirty();
        let before = core::mem::replace(&mut self.map.merged, merged.clone());
        for frame in merged.difference(&before) {
            self.context.event(Event::Merged { frame: *frame });
        }
        for frame in before.difference(&merged) {
            self.context.event(Event::Unmerged { frame: *frame });
        }
    }

    /// Frames in the component of our present frame, without it.
    pub(super) fn frames_merged_with_ours(&self) -> BTreeSet<FrameId> {
        let own = self.context.frame();
        let Some(ours) = self.map.solved.frames.get(&own).map(|placed| placed.with) else { return BTreeSet::new() };
        let together = self.map.solved.frames.iter().filter(|(frame, placed)| **frame != own && placed.with == ours);
        together.map(|(frame, _)| *frame).collect()
    }

    /// `t_own_frame`, if the estimate says so of our present frame.
    pub(super) fn t_own_frame(&self, frame: FrameId) -> Option<Relative> {
        self.solved_for_own()?.frames.get(&frame)?.t_own_frame
    }

    /// `t_own_anchor`, likewise.
    pub(super) fn t_own_anchor(&self, submap: SubmapId) -> Option<&Relative> {
        self.solved_for_own()?.anchors.get(&submap)
    }

    /// `t_own_body` of a body that is known by the anchor of a submap: estimate ∘ beacon, and what their errors have to
    /// do with one another.
    pub(super) fn t_own_body(&self, anchor: SubmapId, t_anchor_body: &PoseWithCovariance) -> Option<Relative> {
        let solved = self.solved_for_own()?;
        let t_own_anchor = solved.anchors.get(&anchor)?;
        Some(match (t_own_anchor, solved.ends.get(&anchor)) {
            (Relative::Metric(t_own_anchor), Some(end)) => Relative::Metric(end.onward(t_own_anchor, t_anchor_body)),
            _ => t_own_anchor.compose(&Relative::Metric(*t_anchor_body)),
        })
    }

    fn solved_for_own(&self) -> Option<&Solved> {
        (self.map.seen_from == Some(self.context.frame())).then_some(&self.map.solved)
    }

    /// A submap's fact, from the entry that holds it now.
    pub(super) fn submap_fact(&self, known: &Known) -> Option<SubmapFact> {
        let held_at = EntryId { seq: known.held_at, ..known.entry };
        match self.replica.entry(held_at)?.fact().ok()? {
            Fact::Submap(fact) => Some(fact),
            Fact::Condensed(condensed) => {
                let carried = condensed.carried.into_iter().find(|one| one.seq == known.entry.seq)?;
                if let Fact::Submap(fact) = carried.fact { Some(fact) } else { None }
            }
            _ => None,
        }
    }
}

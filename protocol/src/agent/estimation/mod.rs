//! The joint estimate: when it is solved again, what changed when it was, and what it says. Its timer is that of the
//! next solution.

mod claims;
pub mod estimate_version;
mod live;
mod steps;

pub use live::ROBOTS_ALL_PAIRS_MAX;
pub(super) use live::{Live, live_robots, pair_views, robot_view};

use super::context::Context;
use super::io::{Event, JobId};
use super::job::{Job, SolveJob, Solved};
use super::replication::Replication;
use super::replication::knowledge::{EstimationInput, Gaps, Known};
use crate::estimate::verdicts::Verdicts;
use crate::geometry::{PoseWithCovariance, Relative};
use crate::ids::{FrameId, Hash, SubmapId};
use crate::time::Instant;
use claims::Claims;
use core::time::Duration;
use std::collections::{BTreeMap, BTreeSet};
use steps::Steps;

/// A solve is followed by a rest of so many times what it took, the wait for other jobs included: however large the map
/// and small the computer, at least so much of a core is left to the rest of the robot.
const REST: u32 = 4;
/// Longest such rest: what has become known meanwhile is to be seen at last.
const REST_MAX: Duration = Duration::from_secs(30);

/// The joint estimate and the state of its solver.
#[derive(Default)]
pub(super) struct Estimation {
    solved: Solved,
    /// Our frame when the estimate was posed, in which its views are given. A new epoch has another.
    seen_from: Option<FrameId>,
    /// Frames that the estimate passed over because nothing ties them to anything, and how many anchors each has.
    alone: BTreeMap<FrameId, usize>,
    /// Facts came in since the last problem was posed.
    dirty: bool,
    solving: Option<JobId>,
    posed_at: Instant,
    posed_digest: Hash,
    posed_from: Option<FrameId>,
    posed_alone: BTreeMap<FrameId, usize>,
    posed_gaps: Gaps,
    /// Digest of the set of facts that the estimate is a function of.
    digest: Hash,
    next_solve: Instant,
    merged: BTreeSet<FrameId>,
    /// What was said of pairs of frames.
    claims: Claims,
    /// The odometry of the last problem posed.
    steps: Steps,
    /// What pairs of frames came to; with the job while one runs.
    verdicts: Verdicts,
}

impl Estimation {
    /// When the estimate is to be solved again.
    pub(super) fn timeout(&self) -> Option<Instant> {
        (self.dirty && self.solving.is_none()).then_some(self.next_solve)
    }

    /// Facts came in.
    pub(super) fn mark_dirty(&mut self) {
        self.dirty = true;
    }

    /// All facts were learned anew.
    pub(super) fn on_relearned(&mut self) {
        self.steps = Steps::default();
        self.dirty = true;
    }

    /// Whether the estimate is to be solved now.
    pub(super) fn is_due(&self, now: Instant) -> bool {
        self.timeout().is_some_and(|due| due <= now)
    }

    /// Poses the problem that follows from the facts, and the relations of these robots.
    pub(super) fn start(&mut self, context: &mut Context, replication: &Replication, robots: &[Live]) {
        let config = context.config().estimate.clone();
        let own = context.frame();
        let mut steps = core::mem::take(&mut self.steps).renewed();
        let odometry = |known: &Known| steps.of(known, || replication.submap_fact(known).map(|fact| fact.odometry));
        let EstimationInput { problem, alone, gaps } = replication.knowledge().question(own, odometry);
        self.steps = steps;
        let live = live::live_pairs(context.robot(), robots, &problem, &gaps);
        let interval = Duration::from_secs_f64(config.interval_secs);
        let verdicts = core::mem::take(&mut self.verdicts);
        let job = SolveJob { problem, config, own, live, verdicts };
        (self.posed_from, self.posed_alone, self.posed_gaps) = (Some(own), alone, gaps);
        self.dirty = false;
        self.posed_at = context.now();
        self.posed_digest = replication.digest();
        self.next_solve = context.now().after(interval);
        self.solving = Some(context.run_job(Job::Solve(Box::new(job))));
    }

    /// The estimate was solved. False if it is not the one that was asked for.
    pub(super) fn on_solved(&mut self, context: &mut Context, job: JobId, mut solved: Solved) -> bool {
        if self.solving.take_if(|running| *running == job).is_none() {
            return false;
        }
        self.verdicts = core::mem::take(&mut solved.verdicts);
        let rest = context.now().since(self.posed_at).saturating_mul(REST).min(REST_MAX);
        self.next_solve = self.next_solve.max(context.now().after(rest));
        self.digest = self.posed_digest;
        self.seen_from = self.posed_from;
        self.alone = core::mem::take(&mut self.posed_alone);
        self.solved = solved.with_indices(&core::mem::take(&mut self.posed_gaps));
        let merged = self.frames_merged_with(context.frame());
        let before = core::mem::replace(&mut self.merged, merged.clone());
        for frame in merged.difference(&before) {
            context.event(Event::Merged { frame: *frame });
        }
        for frame in before.difference(&merged) {
            context.event(Event::Unmerged { frame: *frame });
        }
        for change in self.claims.renew(&self.solved.pairs) {
            let event = change.event(context);
            context.event(event);
        }
        true
    }

    /// The last estimate.
    pub(super) fn solved(&self) -> &Solved {
        &self.solved
    }

    /// Frames that the estimate passed over because nothing ties them to anything, and how many anchors each has.
    pub(super) fn alone(&self) -> &BTreeMap<FrameId, usize> {
        &self.alone
    }

    /// Whether the estimate is a function of this set of facts.
    pub(super) fn is_of(&self, digest: Hash) -> bool {
        self.digest == digest
    }

    /// Whether nothing is known that the estimate does not know, and none is being solved.
    pub(super) fn is_settled(&self, digest: Hash) -> bool {
        !self.dirty && self.solving.is_none() && self.is_of(digest)
    }

    /// Frames in the component of a frame, without it.
    pub(super) fn frames_merged_with(&self, own: FrameId) -> BTreeSet<FrameId> {
        let Some(ours) = self.solved.frames.get(&own).map(|placed| placed.with) else { return BTreeSet::new() };
        let together = self.solved.frames.iter().filter(|(frame, placed)| **frame != own && placed.with == ours);
        together.map(|(frame, _)| *frame).collect()
    }

    /// `t_own_anchor`, in whatever frame was ours when the estimate was posed.
    pub(super) fn anchor(&self, submap: SubmapId) -> Option<&Relative> {
        self.solved.anchors.get(&submap)
    }

    /// Whether the estimate knows how two submaps lie.
    pub(super) fn are_connected(&self, a: SubmapId, b: SubmapId) -> bool {
        self.anchor(a).is_some() && self.anchor(b).is_some()
    }

    /// `t_own_frame`, if the estimate says so of our present frame, `own`.
    pub(super) fn t_own_frame(&self, own: FrameId, frame: FrameId) -> Option<Relative> {
        self.solved_for(own)?.frames.get(&frame)?.t_own_frame
    }

    /// `t_own_anchor`, likewise.
    pub(super) fn t_own_anchor(&self, own: FrameId, submap: SubmapId) -> Option<&Relative> {
        self.solved_for(own)?.anchors.get(&submap)
    }

    /// `t_own_body` of a body that is known by the anchor of a submap: estimate ∘ beacon, and what their errors have to
    /// do with one another.
    fn t_own_body(&self, own: FrameId, anchor: SubmapId, t_anchor_body: &PoseWithCovariance) -> Option<Relative> {
        let solved = self.solved_for(own)?;
        let t_own_anchor = solved.anchors.get(&anchor)?;
        Some(match (t_own_anchor, solved.ends.get(&anchor)) {
            (Relative::Metric(t_own_anchor), Some(end)) => Relative::Metric(end.onward(t_own_anchor, t_anchor_body)),
            _ => t_own_anchor.compose(&Relative::Metric(*t_anchor_body)),
        })
    }

    fn t_anchor_anchor(&self, a: SubmapId, b: SubmapId) -> Option<Relative> {
        let live = &self.solved.live;
        live.get(&(a, b)).copied().or_else(|| Some(live.get(&(b, a))?.inverse()))
    }

    fn solved_for(&self, own: FrameId) -> Option<&Solved> {
        (self.seen_from == Some(own)).then_some(&self.solved)
    }
}

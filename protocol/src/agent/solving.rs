//! When the joint estimate is solved again, and what changed when it was.

use super::Agent;
use super::io::{Event, JobId};
use super::job::{Job, SolveJob, Solved};
use crate::estimate::joint::JointEstimate;
use crate::geometry::Relative;
use crate::ids::{FrameId, Hash, SubmapId};
use crate::time::Instant;
use core::time::Duration;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

/// The joint estimate and the state of its solver.
#[derive(Default)]
pub(super) struct MapState {
    pub(super) estimate: Option<Arc<JointEstimate>>,
    /// `t_own_anchor` of every submap connected to our frame.
    pub(super) anchors: BTreeMap<SubmapId, Relative>,
    /// Facts came in since the last problem was posed.
    pub(super) dirty: bool,
    pub(super) solving: Option<JobId>,
    posed_digest: Hash,
    /// Digest of the set of facts that the estimate is a function of.
    pub(super) digest: Hash,
    next_solve: Instant,
    merged: BTreeSet<FrameId>,
}

impl Agent {
    pub(super) fn solve_timeout(&self) -> Option<Instant> {
        (self.map.dirty && self.map.solving.is_none()).then_some(self.map.next_solve)
    }

    pub(super) fn start_solving(&mut self) {
        if self.map.dirty && self.map.solving.is_none() && self.now >= self.map.next_solve {
            let config = self.config.estimate.clone();
            let job = SolveJob { problem: self.knowledge.problem(), config, own: self.me.frame };
            self.map.dirty = false;
            self.map.posed_digest = self.replica.digest();
            self.map.next_solve = self.now.after(Duration::from_secs_f64(self.config.estimate.interval_secs));
            self.map.solving = Some(self.run_job(Job::Solve(Box::new(job))));
        }
    }

    pub(super) fn on_solved(&mut self, job: JobId, solved: Solved) {
        if self.map.solving.take_if(|running| *running == job).is_none() {
            return;
        }
        let Solved { estimate, anchors } = solved;
        self.map.digest = self.map.posed_digest;
        let merged = self.frames_merged_with_ours(&estimate);
        self.map.estimate = Some(estimate);
        self.map.anchors = anchors;
        self.negotiation.stir();
        let before = core::mem::replace(&mut self.map.merged, merged.clone());
        for frame in merged.difference(&before) {
            self.event(Event::Merged { frame: *frame });
        }
        for frame in before.difference(&merged) {
            self.event(Event::Unmerged { frame: *frame });
        }
    }

    /// Frames in the component of our present frame, without it.
    pub(super) fn frames_merged_with_ours(&self, estimate: &JointEstimate) -> BTreeSet<FrameId> {
        let own = self.me.frame;
        let Some(component) = estimate.component_of(own) else { return BTreeSet::new() };
        let frames: BTreeSet<FrameId> = self.knowledge.submaps().map(|(id, _)| id.frame).collect();
        frames.into_iter().filter(|f| *f != own && estimate.component_of(*f) == Some(component)).collect()
    }
}

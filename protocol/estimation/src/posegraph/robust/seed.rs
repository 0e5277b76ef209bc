//! Which frames merge to begin with: the consensus of a swarm's pairs of frames ([`pairs`]), for robots whose poses
//! follow one another.

use super::Closure;
use super::backbone::Backbone;
use crate::admission::Admission;
use crate::config::EstimateConfig;
use crate::geometry::{PoseWithCovariance, Relative, Sim3};
use crate::ids::{EntryId, SubmapId};
use crate::kinds::ScaleKind;
use crate::marginals::certain;
use crate::verdicts::Verdicts;
use crate::{AgreedAlignment, FrameChain, MapProblem, pairs};
use std::collections::{BTreeMap, BTreeSet};

/// What the consensus says.
pub(super) struct Seed {
    /// Measurements that count.
    pub(super) used: BTreeSet<usize>,
    /// `t_world_anchor` of the chains' anchors by odometry, laid out along the strongest pairs.
    pub(super) start: BTreeMap<SubmapId, Sim3>,
}

impl Seed {
    /// `step` gives each trusted measurement as `t_prev_this`.
    pub(super) fn new(
        backbone: &Backbone,
        step: impl Fn(usize) -> PoseWithCovariance,
        closures: &[Closure],
        config: &EstimateConfig,
    ) -> Self {
        let chain = |steps: &Vec<usize>| {
            let odometry = core::iter::once(certain()).chain(steps.iter().map(|&k| step(k))).collect();
            FrameChain { scale: ScaleKind::Metric, odometry }
        };
        let frames: BTreeMap<_, _> = backbone.chains.iter().map(|(&frame, steps)| (frame, chain(steps))).collect();
        let agreed = |c: &Closure| {
            let entry = EntryId { frame: c.i.frame.max(c.j.frame), seq: c.k as u32 };
            AgreedAlignment { entry, i: c.i, j: c.j, t_i_j: Relative::Metric(c.t_i_j) }
        };
        let tied = closures.iter().filter(|c| [c.i, c.j].iter().all(|id| frames.contains_key(&id.frame)));
        let alignments = tied.map(agreed).collect();
        let mut admission = Admission::new(&MapProblem { frames, alignments, ..MapProblem::default() });
        let pairs = pairs::consensus(&mut admission, config, &mut Verdicts::default());
        let start = pairs::start(&admission, &pairs);
        let used = admission.edges.iter().filter(|e| e.is_used()).map(|e| e.measurement.entry.seq as usize).collect();
        Self { used, start }
    }
}

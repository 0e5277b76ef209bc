//! Where anchors and origins lie in a frame's own coordinates. A frame's origin hangs on its first anchor alone, and
//! bodies on their last; what their errors have to do with the map's is told by [`ends`](super::extrapolation).

use super::drift_model::DriftModel;
use super::extrapolation::End;
use super::joint::JointEstimate;
use super::marginals::certain;
use super::node::Node;
use super::solve::Solution;
use crate::geometry::{PoseWithCovariance, Relative};
use crate::ids::{FrameId, SubmapId};
use nalgebra::Matrix6;
use std::collections::BTreeMap;

impl JointEstimate {
    /// `t_reference_anchor`: the anchor in the reference frame's coordinates.
    pub fn anchor(&self, reference: FrameId, submap: SubmapId) -> Option<Relative> {
        let origin = self.origins.get(&reference)?;
        let first = first_of(reference);
        if submap == first {
            return Some(Relative::Metric(*origin));
        }
        let off_together = |solution: &Solution<Node>| solution.covariance_with_cloud(submap, first);
        Some(from_origin(origin, self.start(reference, off_together), &self.relative(first, submap)?))
    }

    /// [`JointEstimate::anchor`] of every anchor in the reference's component, at the cost of a few of them.
    pub fn anchors(&self, reference: FrameId) -> Vec<(SubmapId, Relative)> {
        let first = first_of(reference);
        let (Some(origin), Some(solution)) = (self.origins.get(&reference), self.solution_of(reference, reference))
        else {
            return Vec::new();
        };
        let with_cloud = solution.with_cloud(first);
        let place = |(node, t): (Node, Relative)| {
            let id = node.anchor()?;
            let start = || self.start(reference, |_| with_cloud.as_ref()?.seen_from(id));
            Some((id, if id == first { Relative::Metric(*origin) } else { from_origin(origin, start(), &t) }))
        };
        solution.relatives_to(first, &self.unknown_scale).into_iter().filter_map(place).collect()
    }

    /// `t_a_b` between the frames' origins.
    pub fn frame(&self, a: FrameId, b: FrameId) -> Option<Relative> {
        if a == b {
            return self.component_of(a).map(|_| Relative::Metric(certain()));
        }
        let t_b_anchor0 = self.origins.get(&b)?;
        let seen_from_a = |solution: &Solution<Node>| solution.covariance_with_cloud(first_of(a), first_of(b));
        Some(match (self.anchor(a, first_of(b))?, self.start(b, seen_from_a)) {
            (Relative::Metric(t_a_anchor0), Some(end)) => {
                Relative::Metric(end.onward(&t_a_anchor0, &t_b_anchor0.inverse()))
            }
            (t_a_anchor0, _) => t_a_anchor0.compose(&Relative::Metric(*t_b_anchor0).inverse()),
        })
    }

    /// How robots go on from the last submaps of the metric frames in the reference's component, those that alignments
    /// tell of: with it [`JointEstimate::anchor`] becomes the pose of a body.
    pub fn ends(&self, reference: FrameId) -> BTreeMap<SubmapId, End> {
        let solution = self.solution_of(reference, reference).filter(|_| !self.unknown_scale.contains(&reference));
        let Some(solution) = solution else { return BTreeMap::new() };
        let together = self.ends.iter().filter(|(frame, _)| self.component_of(**frame) == self.component_of(reference));
        let end = |(_, [_, (last, walk)]): (_, &[(SubmapId, DriftModel); 2])| {
            let seen_from = |solution: &Solution<Node>| solution.covariance_with_cloud(first_of(reference), *last);
            Some((*last, End::of(solution, *last, walk.after_anchor()?, seen_from)?))
        };
        together.filter_map(end).collect()
    }

    /// How a frame's origin lies by its first anchor, as seen from where `off_together` says: by the covariance of how
    /// that anchor lies from there with what its cloud is off by.
    fn start(&self, frame: FrameId, off_together: impl FnOnce(&Solution<Node>) -> Option<Matrix6<f64>>) -> Option<End> {
        let [(first, walk), _] = self.ends.get(&frame)?;
        End::of(self.solution_of(frame, frame)?, *first, walk.before_anchor()?, off_together)
    }
}

fn first_of(frame: FrameId) -> SubmapId {
    SubmapId { frame, index: 0 }
}

/// `t_origin_x` from `t_anchor0_x`.
fn from_origin(t_origin_anchor0: &PoseWithCovariance, start: Option<End>, t_anchor0_x: &Relative) -> Relative {
    match (t_anchor0_x, start) {
        (Relative::Metric(t_anchor0_x), Some(start)) => {
            Relative::Metric(start.onward_from_origin(t_origin_anchor0, t_anchor0_x))
        }
        _ => Relative::Metric(*t_origin_anchor0).compose(t_anchor0_x),
    }
}

//! How robots go on from their last submaps: what the motion of a body since the last anchor has to do with where the map
//! says that anchor is.
//!
//! The two are not independent. A submap's anchor is its middle keyframe, and what alignments tell of is its cloud, of
//! which the keyframes after the anchor made a half ([`distortion`](super::distortion)). Where odometry lost its way among
//! them, the cloud lies off its anchor to that side, the map takes the anchor to lie off to the other, and of the two errors
//! the body has the difference. To sum their variances would make live poses look worse than they are.
//!
//! With `d` where the cloud lies by its anchor, of prior covariance Σ_d, and ν what the motion from the anchor is off by, both
//! by local perturbations at the anchor, `X = Cov(d, ν)`. Of ν, `Xᵀ Σ_d⁻¹ d` is told by d and the rest by nothing in the map,
//! so that the error δ of the anchor goes with ν by `Cov(δ, ν) = P Σ_d⁻¹ X`, with P the map's `Cov(δ, d)`. For a random walk
//! of variance W per submap half of W comes after the anchor, and the cloud follows a step there by the share of the
//! keyframes beyond it: a half at first and none at last, a quarter in the mean. Hence `X = W/8`, or a quarter of the whole
//! motion where that is less: a submap may be cut short. The joint graph itself takes d for independent of the odometry.

use super::graph::Label;
use super::solve::Solution;
use crate::geometry::{Covariance, PoseWithCovariance, Relative};
use crate::ids::SubmapId;
use nalgebra::Matrix6;
use std::collections::BTreeMap;

/// Share of a submap's walk that comes after its anchor, the middle keyframe.
const AFTER_ANCHOR: f64 = 0.5;
/// How far a cloud follows what the odometry lost after the anchor, in the mean.
const FOLLOWS: f64 = 0.25;

/// How a robot goes on from its last submap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct End {
    /// `P Σ_d⁻¹`.
    gain: Matrix6<f64>,
    /// The walk of the odometry after the anchor while the submap was made.
    walk: Covariance<6>,
}

impl End {
    /// `t_x_body`, from the map's `t_x_anchor` and the motion since.
    pub fn onward(&self, t_x_anchor: &PoseWithCovariance, t_anchor_body: &PoseWithCovariance) -> PoseWithCovariance {
        let independent = t_x_anchor.compose(t_anchor_body);
        let at_anchor = t_anchor_body.covariance.transported(&t_anchor_body.pose.adjoint());
        let Some(within) = at_anchor.ok().and_then(|moved| moved.meet(&self.walk)) else { return independent };
        let t_body_anchor = t_anchor_body.pose.inverse().adjoint();
        let cross = t_body_anchor * self.gain * within * t_body_anchor.transpose() * FOLLOWS;
        let covariance = Covariance::new(independent.covariance.matrix() + cross + cross.transpose());
        covariance.map_or(independent, |covariance| PoseWithCovariance { covariance, ..independent })
    }
}

/// Of those of the last submaps that have a cloud in `solution`; `walks` are those of the odometry while each was made.
pub(super) fn ends<'a>(
    solution: &Solution,
    reference: SubmapId,
    walks: impl Iterator<Item = (SubmapId, &'a Covariance<6>)>,
) -> BTreeMap<SubmapId, End> {
    let clouds = solution.graph().factors().filter(|factor| factor.label == Label::Cloud);
    let clouds: BTreeMap<SubmapId, (SubmapId, Relative)> = clouds.map(|f| (f.i, (f.j, f.t_i_j))).collect();
    let of = |(anchor, walk): (SubmapId, &Covariance<6>)| {
        let (cloud, t_anchor_cloud) = clouds.get(&anchor)?;
        let off_together = solution.covariance_onward(reference, anchor, *cloud)?;
        let gain = off_together * t_anchor_cloud.metric()?.covariance.information();
        Some((anchor, End { gain, walk: walk.scaled(AFTER_ANCHOR) }))
    };
    walks.filter_map(of).collect()
}

#[cfg(test)]
#[path = "ends_tests.rs"]
mod tests;

//! How frames begin and robots go on from their last submaps: what the motion of a body since the last anchor has to do
//! with where the map says that anchor is, and the same of the origin and the first anchor.
//!
//! The two are not independent. A submap's anchor is its middle keyframe, and what alignments tell of is its cloud, of
//! which the keyframes after the anchor made a half ([`distortion`](super::distortion)). Where odometry lost its way
//! among them, the cloud lies off its anchor to that side, the map takes the anchor to lie off to the other, and of the
//! two errors the body has the difference. To sum their variances would make live poses look worse than they are.
//!
//! With `d` what the cloud's factor is off by (where the cloud lies by its anchor, but for what the steps of odometry
//! to and from that tell of it: `odometry_correlation`), of covariance Σ_d, and ν what the motion from the anchor is
//! off by, both by local perturbations at the anchor, `X = Cov(d, ν)`. Of ν, `Xᵀ Σ_d⁻¹ d` is told by d and the rest by
//! nothing in the map, so that the error δ of the anchor goes with ν by `Cov(δ, ν) = P Σ_d⁻¹ X`, with P the map's
//! `Cov(δ, d)`. A random walk loses about half of its variance after the anchor, and the cloud follows what is lost
//! there by about a quarter (`walk` knows it from how many keyframes there are). `X` is that share of what is lost
//! there, or of the whole motion where that is less: a submap may be cut short.
//!
//! A frame begins as it ends: its origin is the first keyframe, which is one of those that made the first submap, and
//! what the odometry lost from there to the first anchor bent the first cloud likewise. *Measured* in swarms of LiDARs
//! whose alignments are surer than their odometry (σ of 8 mm): without it the relations of frames have a NEES of 0.80
//! by degrees of freedom.

use super::drift_model::Stretch;
use super::node::Node;
use super::solve::Solution;
use crate::geometry::{Covariance, PoseWithCovariance};
use crate::ids::SubmapId;
use nalgebra::Matrix6;

/// How a keyframe lies by an anchor, if the map tells of the anchor's cloud: the motion from the last anchor to the
/// body, or from the first one back to the origin of the frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct End {
    /// `P Σ_d⁻¹`.
    gain: Matrix6<f64>,
    /// What the odometry lost on that side of the anchor while the submap was made.
    stretch: Stretch,
}

impl End {
    /// Of an anchor that has a cloud in `solution`; `off_together` gives P.
    pub(super) fn of(
        solution: &Solution<Node>,
        anchor: SubmapId,
        stretch: Stretch,
        off_together: impl FnOnce(&Solution<Node>) -> Option<Matrix6<f64>>,
    ) -> Option<Self> {
        let (_, cloud) = solution.graph().cloud_of(solution.graph().position(Node::Anchor(anchor))?)?;
        let gain = off_together(solution)? * cloud.t_i_j().metric()?.covariance.information();
        Some(Self { gain, stretch })
    }

    /// `t_x_body`, from the map's `t_x_anchor` and the motion since.
    pub fn onward(&self, t_x_anchor: &PoseWithCovariance, t_anchor_body: &PoseWithCovariance) -> PoseWithCovariance {
        let independent = t_x_anchor.compose(t_anchor_body);
        let at_anchor = t_anchor_body.covariance.transported(&t_anchor_body.pose.adjoint());
        let Some(within) = at_anchor.ok().and_then(|moved| moved.meet(&self.stretch.lost)) else { return independent };
        let t_body_anchor = t_anchor_body.pose.inverse().adjoint();
        let cross = t_body_anchor * self.gain * within * t_body_anchor.transpose() * self.stretch.follows;
        let covariance = Covariance::new(independent.covariance.matrix() + cross + cross.transpose());
        covariance.map_or(independent, |covariance| PoseWithCovariance { covariance, ..independent })
    }

    /// `t_origin_x`, from the map's `t_anchor_x` and where the anchor lies by the origin: the same from the other end.
    pub(super) fn onward_from_origin(
        &self,
        t_origin_anchor: &PoseWithCovariance,
        t_anchor_x: &PoseWithCovariance,
    ) -> PoseWithCovariance {
        self.onward(&t_anchor_x.inverse(), &t_origin_anchor.inverse()).inverse()
    }
}

#[cfg(test)]
#[path = "extrapolation_tests.rs"]
mod tests;

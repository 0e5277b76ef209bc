//! What an alignment of two clouds cannot know: part of its error is common to all alignments of a submap, because a
//! depth camera bends every view of a place alike and all of them see the same noisy points, so that it neither
//! averages out over alignments nor shows in their residuals.
//!
//! Where submap k's cloud lies by its anchor is unknown by that much: `X_k' = X_k Exp(d_k)`, `d_k ~ N(0, C_k)`. In the
//! joint graph a submap with several alignments gets a node `X_k'` (a *cloud*), a factor with covariance `C_k` to its
//! anchor, and its alignments tie the clouds instead of the anchors, with what is left of their covariances. So errors
//! are correlated as they are, and no alignment is worth less for there being others. Each alignment of covariance Σ
//! suggests `C = c Σ`, c = [`MapProblem::common`](super::joint::MapProblem::common); the harmonic mean of them all is
//! taken, and of Σ each end takes away what lies in both `c Σ` and `C_k`, so that none ever claims more than Σ.
//!
//! Where alignments are taken as independent, in the consensus of two frames, an alignment is widened by what it has in
//! common with the others between the two, `1 + c (n_i − 1) + c (n_j − 1)` for n alignments of its submaps: the
//! variance of the mean of as many. The same is done for similarities everywhere, as a cloud has no scale of its own.
//!
//! *Measured* on 7-Scenes with almost no odometry drift, where nothing else is left: with alignments charged a quarter
//! of what they have in common if that is all of their error, the merged frames have a NEES of 18 for 6 degrees of
//! freedom, charged in full 7.6. Over 2,670 pairs of alignments of one ray-cast LiDAR submap: their errors correlate by
//! 0.14 and 0.21 (translation, rotation).
//!
//! Odometry that drifts bends the cloud, too: its middle lies off its anchor, the middle keyframe, by about a twelfth
//! of the variance of the walk while it was made (`walk`). So much is added to `C_k`. *Measured* in swarms of stand-in
//! clouds that drift so (`merganser-sim bench calibration`): without it the submaps' NEES is 1.18 by degrees of
//! freedom. What goes with the odometry on either side is told to the graph by `odometry_correlation`, and to who goes
//! on from the map by [`ends`](super::extrapolation).

use super::admission::Kind;
use super::graph::Factor;
use super::joint::EdgeEstimate;
use super::node::{Label, Node};
use super::odometry_correlation::{self, Around, Gains};
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3};
use crate::ids::{FrameId, SubmapId};
use nalgebra::Matrix6;
use std::collections::BTreeMap;

/// Largest share that alignments of a submap may have in common: a tenth is always left to the alignment itself.
pub const COMMON_MAX: f64 = 0.45;

/// That of submaps of which not both were seen by a LiDAR: nearly all there is.
pub const COMMON_BENT: f64 = COMMON_MAX;
/// That of submaps that a LiDAR saw, which bends nothing: the noise of their own points.
pub const COMMON_LIDAR: f64 = 0.2;

/// By how much an alignment's variance is to grow where alignments are taken as independent.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Charges {
    /// Among those between its two frames.
    pub(super) between: f64,
    /// Among all.
    pub(super) in_all: f64,
}

impl Default for Charges {
    fn default() -> Self {
        Self { between: 1.0, in_all: 1.0 }
    }
}

/// A share that alignments may have in common; one that is no number is none.
pub(super) fn bounded(common: f64) -> f64 {
    if common.is_nan() { 0.0 } else { common.clamp(0.0, COMMON_MAX) }
}

/// Sets every alignment's charges, from all that may count.
pub(super) fn charge(edges: &mut [EdgeEstimate]) {
    let mut uses: BTreeMap<SubmapId, usize> = BTreeMap::new();
    let mut uses_between: BTreeMap<(SubmapId, FrameId), usize> = BTreeMap::new();
    let counts = |edge: &EdgeEstimate| edge.kind == Kind::Alignment && edge.is_used();
    for edge in edges.iter().filter(|edge| counts(edge)) {
        let (i, j) = (edge.measurement.i, edge.measurement.j);
        for (id, other) in [(i, j), (j, i)] {
            *uses.entry(id).or_default() += 1;
            // The consensus of frames weighs no second looks.
            *uses_between.entry((id, other.frame)).or_default() += usize::from(!edge.second_look);
        }
    }
    for edge in edges.iter_mut().filter(|edge| counts(edge)) {
        let (i, j) = (edge.measurement.i, edge.measurement.j);
        let charged = |uses: [usize; 2]| 1.0 + edge.common * (uses[0] + uses[1]).saturating_sub(2) as f64;
        let between = charged([uses_between[&(i, j.frame)], uses_between[&(j, i.frame)]]);
        edge.charges = Charges { between, in_all: charged([uses[&i], uses[&j]]) };
    }
}

/// The factors of measurements that count, and of the clouds that they tie, and what these owe to the odometry around
/// them.
pub(super) fn factors<'a>(
    edges: &[&EdgeEstimate],
    odometry: impl Fn(SubmapId) -> Option<Around<'a>>,
) -> (Vec<Factor<Node>>, BTreeMap<SubmapId, Gains>) {
    let shared: Vec<Option<Shared>> = edges.iter().map(|edge| Shared::of(edge)).collect();
    let clouds = clouds(edges, &shared);
    let mut gains = BTreeMap::new();
    let cloud = |(id, common): (&SubmapId, &Covariance<6>)| {
        let (covariance, of_steps) = odometry(*id).map_or((*common, [None; 2]), |around| {
            odometry_correlation::conditional_covariance(common, &around.walk, around.steps)
        });
        gains.insert(*id, of_steps);
        cloud_factor(*id, &covariance)
    };
    let mut factors: Vec<Factor<Node>> = clouds.iter().map(cloud).collect();
    let one = |(edge, shared): (&&EdgeEstimate, &Option<Shared>)| match shared {
        None => edge.factor(),
        Some(shared) => shared.factor(edge.factor(), &clouds),
    };
    factors.extend(edges.iter().zip(&shared).map(one));
    (factors, gains)
}

/// How a cloud lies by its anchor.
fn cloud_factor(id: SubmapId, covariance: &Covariance<6>) -> Factor<Node> {
    let t_i_j = Relative::Metric(PoseWithCovariance { pose: Se3::identity(), covariance: *covariance });
    Factor { label: Label::Cloud, i: Node::Anchor(id), j: Node::Cloud(id), t_i_j, weight: 1.0 }
}

/// Of every submap with more than one alignment that may share something: the covariance of its cloud.
fn clouds(edges: &[&EdgeEstimate], shared: &[Option<Shared>]) -> BTreeMap<SubmapId, Covariance<6>> {
    let mut information: BTreeMap<SubmapId, (f64, Matrix6<f64>)> = BTreeMap::new();
    for (edge, shared) in edges.iter().zip(shared) {
        let Some(Shared { at_i, at_j, .. }) = shared else { continue };
        for (id, covariance) in [(edge.measurement.i, at_i), (edge.measurement.j, at_j)] {
            let (count, sum) = information.entry(id).or_insert((0.0, Matrix6::zeros()));
            (*count, *sum) = (*count + 1.0, *sum + covariance.information());
        }
    }
    let several = information.into_iter().filter(|(_, (count, _))| *count > 1.0);
    several
        .filter_map(|(id, (count, sum))| Some((id, Covariance::new(sum.cholesky()?.inverse() * count).ok()?)))
        .collect()
}

/// What an alignment has in common with the others of its submaps, by local perturbations of either anchor.
struct Shared {
    /// Σ of `t_i_j`, as it counts.
    covariance: Matrix6<f64>,
    /// What moves j by the perturbation of i.
    t_j_i: Matrix6<f64>,
    at_i: Covariance<6>,
    at_j: Covariance<6>,
}

impl Shared {
    /// `None` for a measurement that shares nothing, or that a cloud cannot take.
    fn of(edge: &EdgeEstimate) -> Option<Self> {
        let PoseWithCovariance { pose, covariance } = edge.measurement.t_i_j.metric()?;
        if edge.kind != Kind::Alignment || edge.common <= 0.0 {
            return None;
        }
        let at_j = covariance.scaled(edge.common / edge.weight);
        let at_i = at_j.transported(&pose.adjoint()).ok()?;
        let t_j_i = pose.inverse().adjoint();
        Some(Self { covariance: *covariance.matrix() / edge.weight, t_j_i, at_i, at_j })
    }

    /// The alignment's factor, between clouds where there are any.
    fn factor(&self, factor: Factor<Node>, clouds: &BTreeMap<SubmapId, Covariance<6>>) -> Factor<Node> {
        let (mut tied, mut left) = (factor, self.covariance);
        if let Some(taken) = clouds.get(&factor.i.submap()).and_then(|cloud| self.at_i.meet(cloud)) {
            left -= self.t_j_i * taken * self.t_j_i.transpose();
            tied.i = Node::Cloud(factor.i.submap());
        }
        if let Some(taken) = clouds.get(&factor.j.submap()).and_then(|cloud| self.at_j.meet(cloud)) {
            left -= taken;
            tied.j = Node::Cloud(factor.j.submap());
        }
        let (Relative::Metric(PoseWithCovariance { pose, .. }), Ok(covariance)) = (factor.t_i_j, Covariance::new(left))
        else {
            return factor;
        };
        Factor { t_i_j: Relative::Metric(PoseWithCovariance { pose, covariance }), weight: 1.0, ..tied }
    }
}

#[cfg(test)]
#[path = "distortion_tests.rs"]
mod tests;

//! The factor graph: which submap anchors are tied by which relative measurements, in one canonical order.
//!
//! Nodes are anchors `t_world_anchor`; each is a similarity whose scale is shared by all anchors of its frame and is 1
//! for metric frames. A factor's residual is `r = log(t_i_j⁻¹ X_i⁻¹ X_j)`, whose covariance is the measurement's own
//! (MATH §1: local perturbations), with the exact Jacobians of MATH §2: `∂r/∂δ_j = J_r⁻¹(r)`,
//! `∂r/∂δ_i = −J_l⁻¹(r) Ad(t_i_j⁻¹)`. Gauge: the smallest [`SubmapId`] of a component is held fixed.

use crate::geometry::sim3::{self, Matrix7, Vector7};
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance, se3};
use crate::ids::{EntryId, FrameId, SubmapId};
use nalgebra::{Matrix6, SMatrix, Vector6};
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Added to every variance (m², rad²): nobody is surer than a micrometre, and no factor's information dwarfs the others
/// so far that the factorisation fails.
const VARIANCE_MIN: f64 = 1e-12;

/// Room is made for one factor more to so many that a graph has: what it grows by at first needs no copy of them all.
const FACTORS_SPARE: usize = 16;

/// Where a factor comes from; part of the canonical order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Label {
    /// The owner's own motion estimate.
    Odometry,
    /// Where a submap's cloud lies by its anchor, as all alignments see it.
    Cloud,
    /// An agreed alignment.
    Alignment(EntryId),
    /// A direct measurement of another robot.
    Sighting(EntryId),
    /// Where another robot was seen, completed to a pose ([`super::position`]).
    Position(EntryId),
}

impl Label {
    /// Whether the rest of the map may find it wrong.
    pub(super) fn is_doubted(self) -> bool {
        matches!(self, Self::Alignment(_) | Self::Sighting(_) | Self::Position(_))
    }
}

/// A relative measurement between two anchors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Factor {
    /// Its origin.
    pub label: Label,
    /// Target anchor.
    pub i: SubmapId,
    /// Source anchor.
    pub j: SubmapId,
    /// `t_i_j`, lengths in units of `i`'s frame.
    pub t_i_j: Relative,
    /// Multiplies the information; positive.
    pub weight: f64,
}

/// Why a set of factors is no graph.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum GraphError {
    /// A mean or weight is NaN, infinite, or a scale or weight is not positive.
    #[error("factor {i:?} -> {j:?} holds a NaN, infinite or non-positive number; leave it out")]
    NotFinite {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
    },
    /// A factor names an anchor that is not among the nodes.
    #[error("factor {i:?} -> {j:?} names an unknown anchor; add its node first")]
    UnknownNode {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
    },
    /// A factor ties an anchor to itself.
    #[error("factor ties {i:?} to itself; leave it out")]
    SelfLoop {
        /// The anchor.
        i: SubmapId,
    },
    /// A rigid measurement between frames of different units, or a similarity where units are equal.
    #[error("factor {i:?} -> {j:?}: SE(3) needs equal units at both ends, SIM(3) different ones")]
    Units {
        /// Target.
        i: SubmapId,
        /// Source.
        j: SubmapId,
    },
}

/// A cloud's factor that follows steps of odometry.
#[derive(Clone, Debug)]
pub(super) struct OdometryCorrelation {
    /// The edges of the steps, and by how much of their residuals.
    pub(super) steps: Vec<(usize, Matrix6<f64>)>,
}

/// One connected component, ready to be solved.
#[derive(Clone, Debug)]
pub struct Graph {
    nodes: Vec<SubmapId>,
    /// Per node, its scale variable among [`Graph::scale_count`]; `None` where the unit is fixed.
    scales: Vec<Option<usize>>,
    scale_count: usize,
    factors: Vec<Edge>,
    /// Of factors that follow others, by their place.
    pub(super) correlations: BTreeMap<usize, OdometryCorrelation>,
}

/// A factor with its nodes resolved. A map has three of them to an anchor, so that no number is held twice.
#[derive(Clone, Debug)]
pub(super) struct Edge {
    pub(super) label: Label,
    pub(super) weight: f64,
    pub(super) i: usize,
    pub(super) j: usize,
    measured: Measured,
}

/// A measurement, and the information of the residual with the weight in it.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "nearly all are rigid, and a box of each would cost time and memory")]
enum Measured {
    Rigid {
        pose: Se3,
        covariance: [f64; 21],
        information: Matrix6<f64>,
    },
    /// Few are, and they are twice as large.
    Similar(Box<(SimWithCovariance, Matrix7)>),
}

/// A factor's residual and its Jacobians by local perturbations (ρ, φ, λ) of both ends.
#[derive(Clone, Copy, Debug)]
pub(super) struct Linearised {
    pub(super) residual: Vector7,
    pub(super) by_i: Matrix7,
    pub(super) by_j: Matrix7,
}

impl Graph {
    /// Splits nodes and factors into connected components, ordered by their smallest anchor. Any input order of
    /// `factors` gives the same components, to the bit.
    ///
    /// Frames in `unknown_scale` get a scale variable, except the first frame of a component without a metric one: its
    /// unit is the component's.
    ///
    /// # Errors
    /// [`GraphError`] for the first factor, in canonical order, that cannot be used.
    pub fn components(
        nodes: &BTreeSet<SubmapId>,
        unknown_scale: &BTreeSet<FrameId>,
        factors: Vec<Factor>,
    ) -> Result<Vec<Self>, GraphError> {
        // Their numbers are sorted, because they themselves are large.
        let mut order: Vec<usize> = (0..factors.len()).collect();
        order.sort_by(|&a, &b| canonical(&factors[a], &factors[b]));
        let index: BTreeMap<SubmapId, usize> = nodes.iter().enumerate().map(|(k, &id)| (id, k)).collect();
        let mut sets = Disjoint::new(nodes.len());
        let mut edges = Vec::with_capacity(factors.len() + factors.len() / FACTORS_SPARE);
        for factor in order.into_iter().map(|k| factors[k]) {
            let edge = Edge::new(factor, |id| index.get(&id).copied(), unknown_scale)?;
            sets.join(edge.i, edge.j);
            edges.push(edge);
        }
        drop(factors);
        let mut members: BTreeMap<usize, Vec<SubmapId>> = BTreeMap::new();
        let mut local = Vec::with_capacity(nodes.len());
        for (k, &id) in nodes.iter().enumerate() {
            let list = members.entry(sets.root(k)).or_default();
            local.push(list.len());
            list.push(id);
        }
        let mut edges_of: BTreeMap<usize, Vec<Edge>> = BTreeMap::new();
        if let Some(&root) = members.keys().next().filter(|_| members.len() == 1) {
            edges_of.insert(root, core::mem::take(&mut edges));
        }
        for mut edge in edges {
            let root = sets.root(edge.i);
            (edge.i, edge.j) = (local[edge.i], local[edge.j]);
            edges_of.entry(root).or_default().push(edge);
        }
        let component = |(root, nodes): (usize, Vec<SubmapId>)| {
            let (scales, scale_count) = scale_variables(&nodes, unknown_scale);
            let factors = edges_of.remove(&root).unwrap_or_default();
            Self { nodes, scales, scale_count, factors, correlations: BTreeMap::new() }
        };
        Ok(members.into_iter().map(component).collect())
    }

    /// The anchors, ascending. The first is held fixed.
    pub fn nodes(&self) -> &[SubmapId] {
        &self.nodes
    }

    /// The factors in canonical order.
    pub fn factors(&self) -> impl ExactSizeIterator<Item = Factor> + '_ {
        let factor = |e: &Edge| {
            let (i, j) = (self.nodes[e.i], self.nodes[e.j]);
            Factor { label: e.label, i, j, t_i_j: e.t_i_j(), weight: e.weight }
        };
        self.factors.iter().map(factor)
    }

    /// Number of scale variables.
    pub fn scale_count(&self) -> usize {
        self.scale_count
    }

    /// The place of an anchor in [`Graph::nodes`].
    pub fn position(&self, id: SubmapId) -> Option<usize> {
        self.nodes.binary_search(&id).ok()
    }

    /// The scale variable of a node.
    pub(super) fn scale_of(&self, node: usize) -> Option<usize> {
        self.scales[node]
    }

    pub(super) fn edges(&self) -> &[Edge] {
        &self.factors
    }

    /// Without what bends them.
    pub(super) fn into_edges(self) -> Vec<Edge> {
        self.factors
    }
}

impl Edge {
    /// A factor between nodes whose numbers `index` knows.
    pub(super) fn new(
        factor: Factor,
        index: impl Fn(SubmapId) -> Option<usize>,
        unknown_scale: &BTreeSet<FrameId>,
    ) -> Result<Self, GraphError> {
        let (i, j) = (factor.i, factor.j);
        if !(is_usable(&factor.t_i_j) && factor.weight.is_finite() && factor.weight > 0.0) {
            return Err(GraphError::NotFinite { i, j });
        }
        if i == j {
            return Err(GraphError::SelfLoop { i });
        }
        let (Some(a), Some(b)) = (index(i), index(j)) else {
            return Err(GraphError::UnknownNode { i, j });
        };
        let same_unit = i.frame == j.frame || !(unknown_scale.contains(&i.frame) || unknown_scale.contains(&j.frame));
        if same_unit != matches!(factor.t_i_j, Relative::Metric(_)) {
            return Err(GraphError::Units { i, j });
        }
        let Factor { label, weight, .. } = factor;
        let measured = match factor.t_i_j {
            Relative::Metric(p) => {
                let (covariance, information) = (p.covariance.packed(), information_of(&p.covariance) * weight);
                Measured::Rigid { pose: p.pose, covariance, information }
            }
            Relative::Similarity(s) => Measured::Similar(Box::new((s, information_of(&s.covariance) * weight))),
        };
        Ok(Self { label, weight, i: a, j: b, measured })
    }

    /// As it was measured.
    pub(super) fn t_i_j(&self) -> Relative {
        match &self.measured {
            Measured::Rigid { pose, covariance, .. } => {
                Relative::Metric(PoseWithCovariance { pose: *pose, covariance: Covariance::unpacked(covariance) })
            }
            Measured::Similar(similar) => Relative::Similarity(similar.0),
        }
    }

    /// Its mean.
    pub(super) fn mean(&self) -> Sim3 {
        match &self.measured {
            Measured::Rigid { pose, .. } => Sim3::from_se3(pose),
            Measured::Similar(similar) => similar.0.sim,
        }
    }

    /// Whether it says nothing of scales.
    pub(super) fn is_rigid(&self) -> bool {
        matches!(self.measured, Measured::Rigid { .. })
    }

    /// Information of the residual, weight included; the scale row is zero for rigid measurements.
    pub(super) fn information(&self) -> Matrix7 {
        match &self.measured {
            Measured::Rigid { information, .. } => {
                let mut out = Matrix7::zeros();
                out.fixed_view_mut::<6, 6>(0, 0).copy_from(information);
                out
            }
            Measured::Similar(similar) => similar.1,
        }
    }

    /// Its trace.
    pub(super) fn information_trace(&self) -> f64 {
        match &self.measured {
            Measured::Rigid { information, .. } => information.trace(),
            Measured::Similar(similar) => similar.1.trace(),
        }
    }

    /// The information of the pose alone.
    pub(super) fn information_rigid(&self) -> Matrix6<f64> {
        match &self.measured {
            Measured::Rigid { information, .. } => *information,
            Measured::Similar(similar) => similar.1.fixed_view::<6, 6>(0, 0).into_owned(),
        }
    }

    /// Dimension of the measurement.
    pub(super) fn dimension(&self) -> usize {
        match self.measured {
            Measured::Rigid { .. } if matches!(self.label, Label::Position(_)) => super::position::DIMENSION,
            Measured::Rigid { .. } => 6,
            Measured::Similar(_) => 7,
        }
    }

    /// `log(t_i_j⁻¹ X_i⁻¹ X_j)`; the scale component is 0 for rigid measurements.
    pub(super) fn residual(&self, values: &[Sim3]) -> Vector7 {
        let t_i_j = values[self.i].inverse() * values[self.j];
        match &self.measured {
            Measured::Rigid { pose, .. } => lift(&pose.local(&t_i_j.to_se3())),
            Measured::Similar(similar) => similar.0.sim.local(&t_i_j),
        }
    }

    /// The weighted square of the residual.
    pub(super) fn chi2(&self, values: &[Sim3]) -> f64 {
        let r = self.residual(values);
        match &self.measured {
            Measured::Rigid { information, .. } => {
                let r = r.fixed_rows::<6>(0);
                r.dot(&(information * r))
            }
            Measured::Similar(similar) => r.dot(&(similar.1 * r)),
        }
    }

    pub(super) fn linearise(&self, values: &[Sim3]) -> Linearised {
        let t_i_j = values[self.i].inverse() * values[self.j];
        match &self.measured {
            Measured::Rigid { pose, .. } => linearise_rigid(pose, &t_i_j.to_se3()),
            Measured::Similar(similar) => {
                let s = &similar.0;
                let residual = s.sim.local(&t_i_j);
                let by_i = -sim3::left_jacobian_inv(&residual) * s.sim.inverse().adjoint();
                Linearised { residual, by_i, by_j: sim3::right_jacobian_inv(&residual) }
            }
        }
    }
}

impl Edge {
    /// Of a factor between anchors of fixed unit: the residual, `∂r/∂δ_j = J_r⁻¹(r)`, and `A = Ad((X_i⁻¹ X_j)⁻¹)`, with
    /// which `∂r/∂δ_i = −J_l⁻¹(r) Ad(t_i_j⁻¹) = −J_r⁻¹(r) A`.
    pub(super) fn linearise_rigid(&self, values: &[Sim3]) -> (Vector6<f64>, Matrix6<f64>, Matrix6<f64>) {
        let t_i_j = (values[self.i].inverse() * values[self.j]).to_se3();
        let residual = self.mean().to_se3().local(&t_i_j);
        (residual, se3::right_jacobian_inv(&residual), t_i_j.inverse().adjoint())
    }
}

/// Both anchors lie in one unit, so that the predicted `X_i⁻¹ X_j` has scale 1 and lengths in that unit. Only the
/// common scale matters: growing it by λ shrinks the prediction's translation by e^−λ.
fn linearise_rigid(measured: &Se3, predicted: &Se3) -> Linearised {
    let residual = measured.local(predicted);
    let j_r_inv = se3::right_jacobian_inv(&residual);
    let mut by_i = Matrix7::zeros();
    let mut by_j = Matrix7::zeros();
    let rigid = -se3::left_jacobian_inv(&residual) * measured.inverse().adjoint();
    by_i.fixed_view_mut::<6, 6>(0, 0).copy_from(&rigid);
    by_j.fixed_view_mut::<6, 6>(0, 0).copy_from(&j_r_inv);
    let shrink = se3::join(&-(predicted.rotation.inverse() * predicted.translation), &nalgebra::Vector3::zeros());
    by_j.fixed_view_mut::<6, 1>(0, 6).copy_from(&(j_r_inv * shrink));
    Linearised { residual: lift(&residual), by_i, by_j }
}

/// The information of a measurement, its certainty bounded by [`VARIANCE_MIN`].
fn information_of<const N: usize>(covariance: &Covariance<N>) -> SMatrix<f64, N, N> {
    let bounded = covariance.matrix() + SMatrix::identity() * VARIANCE_MIN;
    // A covariance remains one; only rounding can say otherwise.
    bounded.cholesky().map_or_else(|| Covariance::new_or_wider(bounded).information(), |c| c.inverse())
}

/// A rigid tangent vector as one of SIM(3).
pub(super) fn lift(xi: &Vector6<f64>) -> Vector7 {
    let mut out = Vector7::zeros();
    out.fixed_rows_mut::<6>(0).copy_from(xi);
    out
}

/// Finite, of unit rotation and positive scale.
pub(super) fn is_usable(t: &Relative) -> bool {
    let s = t.sim();
    let norm = s.rotation.xyzw().iter().map(|x| x * x).sum::<f64>();
    s.translation.iter().all(|x| x.is_finite()) && (norm - 1.0).abs() < 1e-6 && s.scale.is_finite() && s.scale > 0.0
}

/// Total order of factors that depends on nothing but their content.
pub(super) fn canonical(a: &Factor, b: &Factor) -> core::cmp::Ordering {
    (a.i, a.j, a.label).cmp(&(b.i, b.j, b.label)).then_with(|| content_order(&a.t_i_j, &b.t_i_j))
}

/// Total order of measurements by their numbers.
pub(super) fn content_order(a: &Relative, b: &Relative) -> core::cmp::Ordering {
    let numbers = |t: &Relative| {
        let s = t.sim();
        let mut out: Vec<f64> = s.translation.iter().copied().chain(s.rotation.xyzw()).collect();
        out.push(s.scale);
        match t {
            Relative::Metric(p) => out.extend(p.covariance.matrix().iter()),
            Relative::Similarity(q) => out.extend(q.covariance.matrix().iter()),
        }
        out
    };
    let (a, b) = (numbers(a), numbers(b));
    let by_number = a.iter().zip(&b).map(|(x, y)| x.total_cmp(y)).find(|o| o.is_ne());
    by_number.unwrap_or_else(|| a.len().cmp(&b.len()))
}

/// The scale variable of each node and their number.
fn scale_variables(nodes: &[SubmapId], unknown: &BTreeSet<FrameId>) -> (Vec<Option<usize>>, usize) {
    let frames: BTreeSet<FrameId> = nodes.iter().map(|n| n.frame).collect();
    let any_metric = frames.iter().any(|f| !unknown.contains(f));
    let free = frames.iter().filter(|f| unknown.contains(f)).skip(usize::from(!any_metric));
    let variable: BTreeMap<FrameId, usize> = free.enumerate().map(|(k, &f)| (f, k)).collect();
    (nodes.iter().map(|n| variable.get(&n.frame).copied()).collect(), variable.len())
}

/// Union-find whose roots are the smallest members.
pub(super) struct Disjoint(Vec<usize>);

impl Disjoint {
    pub(super) fn new(n: usize) -> Self {
        Self((0..n).collect())
    }

    pub(super) fn root(&mut self, mut k: usize) -> usize {
        while self.0[k] != k {
            self.0[k] = self.0[self.0[k]];
            k = self.0[k];
        }
        k
    }

    /// Whether the two were apart.
    pub(super) fn join(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b)] = a.min(b);
        a != b
    }
}

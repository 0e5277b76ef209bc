//! A factor between nodes of a graph: its residual `r = log(t_i_j⁻¹ X_i⁻¹ X_j)`, its exact Jacobians, and the
//! information with which it counts.

use super::{Factor, GraphError, Key, is_rigid, is_usable};
use crate::geometry::sim3::{self, Matrix7, Vector7};
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance, se3};
use nalgebra::{Matrix6, SMatrix, Vector6};
use std::collections::BTreeSet;

/// Added to every variance (m², rad²): nobody is surer than a micrometre, and no factor's information dwarfs the others
/// so far that the factorisation fails.
const VARIANCE_MIN: f64 = 1e-12;

/// A factor with its nodes resolved. A map has three of them to an anchor, so that no number is held twice.
#[derive(Clone, Debug)]
pub(crate) struct Edge<K: Key> {
    pub(crate) label: K::Label,
    pub(crate) weight: f64,
    pub(crate) i: usize,
    pub(crate) j: usize,
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
pub(crate) struct Linearised {
    pub(crate) residual: Vector7,
    pub(crate) by_i: Matrix7,
    pub(crate) by_j: Matrix7,
}

impl<K: Key> Edge<K> {
    /// A factor between nodes whose numbers `index` knows.
    pub(crate) fn new(
        factor: Factor<K>,
        index: impl Fn(K) -> Option<usize>,
        unknown_scale: &BTreeSet<K::Unit>,
    ) -> Result<Self, GraphError<K>> {
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
        if is_rigid(i.unit(), j.unit(), unknown_scale) != matches!(factor.t_i_j, Relative::Metric(_)) {
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
    pub(crate) fn t_i_j(&self) -> Relative {
        match &self.measured {
            Measured::Rigid { pose, covariance, .. } => {
                Relative::Metric(PoseWithCovariance { pose: *pose, covariance: Covariance::unpacked(covariance) })
            }
            Measured::Similar(similar) => Relative::Similarity(similar.0),
        }
    }

    /// Its mean.
    pub(crate) fn mean(&self) -> Sim3 {
        match &self.measured {
            Measured::Rigid { pose, .. } => Sim3::from_se3(pose),
            Measured::Similar(similar) => similar.0.sim,
        }
    }

    /// Whether it says nothing of scales.
    pub(crate) fn is_rigid(&self) -> bool {
        matches!(self.measured, Measured::Rigid { .. })
    }

    /// Information of the residual, weight included; the scale row is zero for rigid measurements.
    pub(crate) fn information(&self) -> Matrix7 {
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
    pub(crate) fn information_trace(&self) -> f64 {
        match &self.measured {
            Measured::Rigid { information, .. } => information.trace(),
            Measured::Similar(similar) => similar.1.trace(),
        }
    }

    /// The information of the pose alone.
    pub(crate) fn information_rigid(&self) -> Matrix6<f64> {
        match &self.measured {
            Measured::Rigid { information, .. } => *information,
            Measured::Similar(similar) => similar.1.fixed_view::<6, 6>(0, 0).into_owned(),
        }
    }

    /// Dimension of the measurement.
    pub(crate) fn dimension(&self) -> usize {
        match self.measured {
            Measured::Rigid { .. } => K::rigid_dimension(self.label),
            Measured::Similar(_) => 7,
        }
    }

    /// `log(t_i_j⁻¹ X_i⁻¹ X_j)`; the scale component is 0 for rigid measurements.
    pub(crate) fn residual(&self, values: &[Sim3]) -> Vector7 {
        let t_i_j = values[self.i].inverse() * values[self.j];
        match &self.measured {
            Measured::Rigid { pose, .. } => lift(&pose.local(&t_i_j.to_se3())),
            Measured::Similar(similar) => similar.0.sim.local(&t_i_j),
        }
    }

    /// The weighted square of the residual.
    pub(crate) fn chi2(&self, values: &[Sim3]) -> f64 {
        let r = self.residual(values);
        match &self.measured {
            Measured::Rigid { information, .. } => {
                let r = r.fixed_rows::<6>(0);
                r.dot(&(information * r))
            }
            Measured::Similar(similar) => r.dot(&(similar.1 * r)),
        }
    }

    pub(crate) fn linearise(&self, values: &[Sim3]) -> Linearised {
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

impl<K: Key> Edge<K> {
    /// Of a factor between anchors of fixed unit: the residual, `∂r/∂δ_j = J_r⁻¹(r)`, and `A = Ad((X_i⁻¹ X_j)⁻¹)`, with
    /// which `∂r/∂δ_i = −J_l⁻¹(r) Ad(t_i_j⁻¹) = −J_r⁻¹(r) A`.
    pub(crate) fn linearise_rigid(&self, values: &[Sim3]) -> (Vector6<f64>, Matrix6<f64>, Matrix6<f64>) {
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
pub(crate) fn lift(xi: &Vector6<f64>) -> Vector7 {
    let mut out = Vector7::zeros();
    out.fixed_rows_mut::<6>(0).copy_from(xi);
    out
}

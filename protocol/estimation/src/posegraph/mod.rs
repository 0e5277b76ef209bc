//! Pose graphs as researchers exchange them: poses named by numbers, relative measurements with information matrices.
//!
//! [`g2o`] and [`kimera`] read and write files' lines, [`solve`] solves the connected parts of a graph with the
//! estimate's own solver. Files are read line by line by the caller; nothing here touches a disk.

pub mod fault;
pub mod g2o;
mod gauge;
mod identity;
pub mod kimera;
pub mod lines;
pub mod marginals;
pub mod quaternions;
pub mod robust;
pub mod solve;

#[cfg(test)]
mod tests;

use super::chordal::{ChordalEdge, ChordalGraph};
use super::graph::Disjoint;
use crate::geometry::{Covariance, Se3};
use nalgebra::{Matrix3, Matrix6};
use std::collections::{BTreeMap, BTreeSet};

/// Poses a graph may have.
pub const POSES_MAX: usize = 200_000;
/// Measurements a graph may have.
pub const MEASUREMENTS_MAX: usize = 500_000;

/// A relative measurement `t_i_j` between poses `i` and `j`.
#[derive(Clone, Debug, PartialEq)]
pub struct Measurement {
    /// Target pose.
    pub i: u64,
    /// Source pose.
    pub j: u64,
    /// `t_i_j`.
    pub t_i_j: Se3,
    /// Its rotation as printed, which rounding may have made only nearly one (see [`ChordalEdge::r_i_j`]).
    pub printed: Matrix3<f64>,
    /// Information of its local perturbation (ρ, φ): symmetric, its translation and rotation blocks invertible. That
    /// all of it is positive definite is asked only by those who minimise χ².
    pub information: Matrix6<f64>,
    /// SE-Sync's weight of the rotation.
    pub kappa: f64,
    /// SE-Sync's weight of the translation.
    pub tau: f64,
    /// Its line, so that it can be found again: from 1, the lines of several files counted through
    /// ([`lines::Files::place`]).
    pub line: usize,
}

/// A pose graph; any number of connected parts.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PoseGraph {
    /// The poses and their initial values, where given.
    pub poses: BTreeMap<u64, Option<Se3>>,
    /// Measurements in the order of the file.
    pub measurements: Vec<Measurement>,
    /// All poses lie in the plane z = 0 and turn about z only.
    pub planar: bool,
    /// Poses that the file fixes. Of each connected part one says where it lies ([`PoseGraph::place`]); the others are
    /// estimated as all are.
    pub fixed: BTreeSet<u64>,
}

impl PoseGraph {
    /// The connected parts, ordered by their smallest pose; in each, poses ascend.
    pub fn parts(&self) -> Vec<Self> {
        let place: BTreeMap<u64, usize> = self.poses.keys().enumerate().map(|(k, &id)| (id, k)).collect();
        let mut sets = Disjoint::new(place.len());
        for m in &self.measurements {
            sets.join(place[&m.i], place[&m.j]);
        }
        let mut parts: BTreeMap<usize, Self> = BTreeMap::new();
        let empty = || Self { planar: self.planar, ..Self::default() };
        for (&id, &value) in &self.poses {
            let part = parts.entry(sets.root(place[&id])).or_insert_with(empty);
            part.poses.insert(id, value);
            if self.fixed.contains(&id) {
                part.fixed.insert(id);
            }
        }
        for m in &self.measurements {
            parts.entry(sets.root(place[&m.i])).or_insert_with(empty).measurements.push(m.clone());
        }
        parts.into_values().collect()
    }

    /// The graph with SE-Sync's weights, nodes in the order of [`PoseGraph::poses`].
    pub fn chordal(&self) -> ChordalGraph {
        let place: BTreeMap<u64, usize> = self.poses.keys().enumerate().map(|(k, &id)| (id, k)).collect();
        let edge = |m: &Measurement| ChordalEdge {
            i: place[&m.i],
            j: place[&m.j],
            r_i_j: m.printed,
            p_i_j: m.t_i_j.translation,
            kappa: m.kappa,
            tau: m.tau,
        };
        ChordalGraph { nodes: self.poses.len(), edges: self.measurements.iter().map(edge).collect() }
    }

    /// The graph with the isotropic weights in place of the information.
    pub fn isotropic(mut self) -> Self {
        self.measurements.iter_mut().for_each(|m| m.information = isotropic_information(m.kappa, m.tau));
        self
    }

    /// Whether every measurement's information is positive definite.
    pub fn has_covariances(&self) -> bool {
        self.measurements.iter().all(|m| covariance_of(&m.information).is_some())
    }

    /// Whether every measurement's information is that of its isotropic weights, so that the certificate of the
    /// chordal cost speaks of the graph itself.
    pub fn is_isotropic(&self) -> bool {
        let is_isotropic = |m: &Measurement| {
            let want = isotropic_information(m.kappa, m.tau);
            (m.information - want).amax() <= 1e-6 * want.amax()
        };
        !self.planar && self.measurements.iter().all(is_isotropic)
    }
}

/// The weights SE-Sync takes for a measurement in space: `τ = 3/tr(Σ_t)`, `κ = 3/(2 tr(Σ_R))`, the covariances those
/// of the information's blocks. `None` if a block is singular.
pub fn isotropic_weights(information: &Matrix6<f64>) -> Option<(f64, f64)> {
    let of_translation = information.fixed_view::<3, 3>(0, 0).into_owned().try_inverse()?.trace();
    let of_rotation = information.fixed_view::<3, 3>(3, 3).into_owned().try_inverse()?.trace();
    let (kappa, tau) = (1.5 / of_rotation, 3.0 / of_translation);
    (kappa.is_finite() && tau.is_finite() && kappa > 0.0 && tau > 0.0).then_some((kappa, tau))
}

/// The information of isotropic weights.
fn isotropic_information(kappa: f64, tau: f64) -> Matrix6<f64> {
    let mut out = Matrix6::zeros();
    out.view_mut((0, 0), (3, 3)).fill_diagonal(tau);
    out.view_mut((3, 3), (3, 3)).fill_diagonal(2.0 * kappa);
    out
}

/// The matrix of a quaternion (x, y, z, w) by the formula for unit ones, whatever its norm.
fn printed_matrix([x, y, z, w]: [f64; 4]) -> Matrix3<f64> {
    Matrix3::new(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - z * w),
        2.0 * (x * z + y * w),
        2.0 * (x * y + z * w),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - x * w),
        2.0 * (x * z - y * w),
        2.0 * (y * z + x * w),
        1.0 - 2.0 * (x * x + y * y),
    )
}

/// The covariance of an information matrix; `None` if that is not symmetric positive definite and finite.
fn covariance_of(information: &Matrix6<f64>) -> Option<Covariance<6>> {
    let inverse = information.cholesky()?.inverse();
    Covariance::new((inverse + inverse.transpose()) * 0.5).ok()
}

//! Robust re-weighting of the joint estimate: decides which alignments the rest of the map contradicts.
//!
//! With residual `r`, measurement covariance Σ and posterior covariance P of the predicted measurement, the
//! leave-one-out statistic is `rᵀ (Σ − P)⁻¹ r`: it equals the innovation's Mahalanobis distance against the map solved
//! without that measurement (deletion residuals of least squares), and needs no second solve. Directions in which the
//! measurement is the map's only source have no redundancy and are not tested.

use super::graph::{Edge, Key};
use super::node::{Label, Node};
use super::solve::Solution;
use super::sparse::SelectedInverse;
use crate::geometry::chi2;
use crate::geometry::sim3::{self, Matrix7, Vector7};
use crate::geometry::{Relative, se3};
use libm::log;
use nalgebra::SMatrix;

/// Share of a measurement's variance that the rest of the map must be able to predict before it is tested.
const REDUNDANCY_MIN: f64 = 1e-4;

/// After so many rounds of one drop per component, all that fail are dropped at once, so that hostile input cannot
/// demand a solve for each of its measurements.
const SINGLE_DROPS_MAX: usize = 32;

/// A measurement to be left out.
pub(super) struct Drop {
    pub(super) label: Label,
    /// Its leave-one-out χ².
    pub(super) chi2: f64,
}

/// The measurements to leave out before solving again: the worst one (first in canonical order among equals), or all
/// that fail once `round` has reached the limit.
pub(super) fn contradictions(solution: &Solution<Node>, round: usize) -> Vec<Drop> {
    let inverse = solution.selected_inverse();
    let tested = solution.graph().edges().iter().filter(|e| e.label.is_doubted());
    let failing = tested.filter_map(|edge| {
        let LeftOut { chi2, dof, .. } = leave_one_out(solution, &inverse, edge)?;
        // A position says nothing of how what it saw is turned.
        let limit = chi2::P999.get(dof.min(edge.dimension()).checked_sub(1)?)?;
        (chi2 > *limit).then_some((chi2 / limit, Drop { label: edge.label, chi2 }))
    });
    let mut failing: Vec<(f64, Drop)> = failing.collect();
    failing.sort_by(|a, b| b.0.total_cmp(&a.0));
    if round < SINGLE_DROPS_MAX {
        failing.truncate(1);
    }
    failing.into_iter().map(|(_, drop)| drop).collect()
}

/// A measurement against the map without it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct LeftOut {
    /// The leave-one-out χ².
    pub(super) chi2: f64,
    /// Number of redundant directions.
    pub(super) dof: usize,
    /// ln √det of the innovation's covariance in these directions.
    pub(super) log_sqrt_det: f64,
}

/// The leave-one-out χ² of a measurement.
pub(super) fn leave_one_out<K: Key>(
    solution: &Solution<K>,
    inverse: &SelectedInverse<'_>,
    edge: &Edge<K>,
) -> Option<LeftOut> {
    let residual = edge.residual(solution.values());
    let predicted = solution.covariance_along(inverse, edge.i, edge.j)?;
    match &edge.t_i_j() {
        Relative::Metric(p) => {
            let r = residual.fixed_rows::<6>(0).into_owned();
            let j = se3::right_jacobian_inv(&r);
            let predicted = j * predicted.fixed_view::<6, 6>(0, 0) * j.transpose();
            deletion(&r, &(p.covariance.matrix() / edge.weight), &predicted)
        }
        Relative::Similarity(s) => {
            let j: Matrix7 = sim3::right_jacobian_inv(&residual);
            let r: Vector7 = residual;
            deletion(&r, &(s.covariance.matrix() / edge.weight), &(j * predicted * j.transpose()))
        }
    }
}

fn deletion<const N: usize>(
    r: &SMatrix<f64, N, 1>,
    measurement: &SMatrix<f64, N, N>,
    predicted: &SMatrix<f64, N, N>,
) -> Option<LeftOut> {
    let l = measurement.cholesky()?.l();
    let mut log_sqrt_det: f64 = l.diagonal().iter().map(|&x| log(x)).sum();
    let r = l.solve_lower_triangular(r)?;
    let half = l.solve_lower_triangular(predicted)?;
    let predicted = l.solve_lower_triangular(&half.transpose())?;
    let redundancy = SMatrix::<f64, N, N>::identity() - (predicted + predicted.transpose()) * 0.5;
    // In a basis of the redundancy's own directions. Dynamic, because the eigen-solver wants a statically smaller type.
    let eigen = nalgebra::DMatrix::from_iterator(N, N, redundancy.iter().copied()).symmetric_eigen();
    let (mut chi2, mut dof) = (0.0, 0);
    for (k, &share) in eigen.eigenvalues.iter().enumerate() {
        if share > REDUNDANCY_MIN {
            let along: f64 = eigen.eigenvectors.column(k).iter().zip(r.iter()).map(|(v, x)| v * x).sum();
            chi2 += along * along / share;
            dof += 1;
            log_sqrt_det -= 0.5 * log(share);
        }
    }
    Some(LeftOut { chi2, dof, log_sqrt_det })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_source_without_redundancy_is_not_tested() {
        let sigma = SMatrix::<f64, 6, 6>::identity();
        let r = SMatrix::<f64, 6, 1>::repeat(1e-9);
        assert_eq!(deletion(&r, &sigma, &sigma), Some(LeftOut { chi2: 0.0, dof: 0, log_sqrt_det: 0.0 }));
        let out = deletion(&SMatrix::<f64, 6, 1>::repeat(1.0), &sigma, &(sigma * 0.5)).unwrap();
        assert!(out.dof == 6 && (out.chi2 - 12.0).abs() < 1e-12);
        // The innovation's covariance is twice the measurement's.
        assert!((out.log_sqrt_det - 3.0 * log(2.0)).abs() < 1e-12);
    }
}

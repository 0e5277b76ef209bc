//! Covariances of a solved component: of any anchor relative to any other, cross-correlations kept.
//!
//! With `T = X_i⁻¹ X_j` and local perturbations, `δ_T = δ_j − Ad(T⁻¹) δ_i`, so that `Σ_T = A H⁻¹ Aᵀ` for the sparse row
//! block A of that expression: the inner products of `L⁻¹ Aᵀ`, in which only the way to the root takes part. All
//! anchors relative to one take seven solves and one selected inversion (MATH §3: joint covariances, never sums of
//! marginals).

use super::graph::{Key, is_rigid};
use super::solve::{Solution, Variables};
use super::sparse::SelectedInverse;
use crate::geometry::sim3::{Matrix7, Vector7};
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance};
use nalgebra::Matrix6;
use std::collections::BTreeSet;
use std::ops::Range;

/// Standard deviation stated for relations that are certain by definition (an anchor in itself).
const SIGMA_CERTAIN: f64 = 1e-9;

impl<K: Key> Solution<K> {
    /// `t_i_j` between two nodes of the component with the covariance of its local perturbation: rigid, in their own
    /// unit, within one unit or between metric ones (those not in `unknown_scale`); a similarity otherwise. `None` for
    /// nodes of other components.
    pub fn relative(&self, i: impl Into<K>, j: impl Into<K>, unknown_scale: &BTreeSet<K::Unit>) -> Option<Relative> {
        let (i, j): (K, K) = (i.into(), j.into());
        let (a, b) = (self.graph.position(i)?, self.graph.position(j)?);
        let t_i_j = self.values[a].inverse() * self.values[b];
        let rigid = is_rigid(i.unit(), j.unit(), unknown_scale);
        if a == b {
            return Some(Relative::Metric(certain()));
        }
        relation(t_i_j, self.covariance_between(a, b)?, rigid)
    }

    /// [`Solution::relative`] of every node to `reference`, in the order of the component's nodes.
    pub fn relatives_to(&self, reference: impl Into<K>, unknown_scale: &BTreeSet<K::Unit>) -> Vec<(K, Relative)> {
        let reference: K = reference.into();
        let Some(r) = self.graph.position(reference) else { return Vec::new() };
        let Some(columns) = self.columns_of(&self.row_block(r, &Matrix7::identity())) else { return Vec::new() };
        let with_scale = |k: usize| Some((self.variables(k)[0]?.0, self.variables(k)[6]?.0));
        let inverse = self.pattern.selected_inverse(&self.factor, (0..self.values.len()).filter_map(with_scale));
        let at_reference = self.rows(&columns, r);
        let anchors = self.graph.nodes().iter().enumerate();
        let one = |(k, &id): (usize, &K)| {
            if k == r {
                return Some((id, Relative::Metric(certain())));
            }
            let t_r_k = self.values[r].inverse() * self.values[k];
            let variables = self.variables(k);
            let mut own = Matrix7::zeros();
            for (p, x) in variables.iter().enumerate() {
                for (q, y) in variables.iter().enumerate() {
                    if let (Some(x), Some(y)) = (x, y) {
                        own[(p, q)] = inverse.get(*x, *y)?;
                    }
                }
            }
            let a = t_r_k.inverse().adjoint();
            let cross = self.rows(&columns, k) * a.transpose();
            let joint = own - cross - cross.transpose() + a * at_reference * a.transpose();
            let rigid = is_rigid(reference.unit(), id.unit(), unknown_scale);
            let direct = || self.relative(reference, id, unknown_scale);
            Some((id, relation(t_r_k, joint, rigid).or_else(direct)?))
        };
        anchors.filter_map(one).collect()
    }

    /// Covariance of δ in `X_a⁻¹ X_b ⊕ δ`; its scale row is zero where both ends share one scale.
    pub(super) fn covariance_between(&self, a: usize, b: usize) -> Option<Matrix7> {
        let half = self.half_solved(a, b);
        let lower = Matrix7::from_fn(|r, c| if r >= c { half.dot(r, &half, c) } else { 0.0 });
        Some(Matrix7::from_fn(|r, c| lower[(r.max(c), r.min(c))]))
    }

    /// `L⁻¹ Aᵀ` for the row block A of `X_a⁻¹ X_b`.
    pub(super) fn half_solved(&self, a: usize, b: usize) -> HalfSolved {
        let t_b_a = self.values[b].inverse() * self.values[a];
        self.half_solve(&self.difference(a, b, &t_b_a.adjoint()))
    }

    pub(super) fn half_solve(&self, rows: &[(usize, Vector7)]) -> HalfSolved {
        let mut columns = spread(rows, self.pattern.scalars());
        let touched = self.pattern.solve_upwards(&self.factor, rows.iter().map(|(scalar, _)| *scalar), &mut columns);
        HalfSolved { columns, touched, n: self.pattern.scalars() }
    }

    /// [`Solution::covariance_between`] for two anchors that a factor ties, from the selected inverse instead of
    /// solves.
    pub(super) fn covariance_along(&self, inverse: &SelectedInverse<'_>, a: usize, b: usize) -> Option<Matrix7> {
        let adjoint = (self.values[b].inverse() * self.values[a]).adjoint();
        let block = |x: usize, y: usize| {
            let (rows, columns) = (self.variables(x), self.variables(y));
            let mut out = Matrix7::zeros();
            for (r, row) in rows.iter().enumerate() {
                for (c, column) in columns.iter().enumerate() {
                    if let (Some(row), Some(column)) = (row, column) {
                        out[(r, c)] = inverse.get(*row, *column)?;
                    }
                }
            }
            Some(out)
        };
        let cross = block(b, a)? * adjoint.transpose();
        let joint = block(b, b)? - cross - cross.transpose() + adjoint * block(a, a)? * adjoint.transpose();
        Some((joint + joint.transpose()) * 0.5)
    }

    /// The blocks of `H⁻¹` where `H` has any: of each variable, and of those that a factor ties.
    pub(super) fn selected_inverse(&self) -> SelectedInverse<'_> {
        let pairs = (0..self.graph.edges().len()).flat_map(|edge| Variables::of(&self.graph, edge).pairs());
        let pairs = pairs.filter(|(a, b)| a != b);
        self.pattern.selected_inverse(&self.factor, pairs)
    }

    /// The row block A of `δ_b − Ad δ_a` as (scalar, column of A).
    pub(super) fn difference(&self, a: usize, b: usize, adjoint: &Matrix7) -> Vec<(usize, Vector7)> {
        let mut rows = self.row_block(b, &Matrix7::identity());
        merge(&mut rows, self.row_block(a, &-adjoint));
        rows
    }

    /// `m` applied to the perturbation of one anchor, as (scalar, column).
    pub(super) fn row_block(&self, node: usize, m: &Matrix7) -> Vec<(usize, Vector7)> {
        let scalar = |(k, v): (usize, Option<(usize, usize)>)| {
            v.map(|(variable, offset)| (self.pattern.start(variable) + offset, m.column(k).into_owned()))
        };
        self.variables(node).into_iter().enumerate().filter_map(scalar).collect()
    }

    /// `H⁻¹ Aᵀ`, seven columns.
    pub(super) fn columns_of(&self, rows: &[(usize, Vector7)]) -> Option<Vec<f64>> {
        let mut columns = spread(rows, self.pattern.scalars());
        self.pattern.solve(&self.factor, &mut columns);
        Some(columns)
    }

    /// Rows of `columns` that belong to one anchor.
    pub(super) fn rows(&self, columns: &[f64], node: usize) -> Matrix7 {
        let mut out = Matrix7::zeros();
        for (r, variable) in self.variables(node).iter().enumerate() {
            if let Some((variable, offset)) = variable {
                let scalar = self.pattern.start(*variable) + offset;
                for c in 0..7 {
                    out[(r, c)] = columns[c * self.pattern.scalars() + scalar];
                }
            }
        }
        out
    }

    /// The (variable, scalar within it) of each tangent direction of an anchor; `None` where it is fixed.
    fn variables(&self, node: usize) -> [Option<(usize, usize)>; 7] {
        let mut out = [None; 7];
        if node > 0 {
            for (k, slot) in out.iter_mut().take(6).enumerate() {
                *slot = Some((node - 1, k));
            }
        }
        out[6] = self.graph.scale_of(node).map(|s| (self.graph.nodes().len() - 1 + s, 0));
        out
    }
}

/// `L⁻¹ Aᵀ`: seven columns of `n` scalars, of which all but some ranges are zero.
pub(super) struct HalfSolved {
    columns: Vec<f64>,
    touched: Vec<Range<usize>>,
    n: usize,
}

impl HalfSolved {
    /// The inner product of one column and another's.
    pub(super) fn dot(&self, column: usize, other: &Self, of_other: usize) -> f64 {
        let of = |half: &'_ Self, k: usize| k * half.n..(k + 1) * half.n;
        let (x, y) = (&self.columns[of(self, column)], &other.columns[of(other, of_other)]);
        let over =
            |range: &Range<usize>| x[range.clone()].iter().zip(&y[range.clone()]).map(|(x, y)| x * y).sum::<f64>();
        self.touched.iter().map(over).sum::<f64>()
    }
}

/// Adds rows of A to those that are there.
pub(super) fn merge(rows: &mut Vec<(usize, Vector7)>, more: impl IntoIterator<Item = (usize, Vector7)>) {
    for (scalar, column) in more {
        match rows.iter_mut().find(|(known, _)| *known == scalar) {
            Some((_, sum)) => *sum += column,
            None => rows.push((scalar, column)),
        }
    }
}

/// `Aᵀ` of `n` rows from its rows that are not zero, column by column.
pub(super) fn spread(rows: &[(usize, Vector7)], n: usize) -> Vec<f64> {
    let mut columns = vec![0.0; 7 * n];
    for (scalar, row) in rows {
        for c in 0..7 {
            columns[c * n + scalar] = row[c];
        }
    }
    columns
}

/// The identity, with the smallest covariance that can be stated.
pub(super) fn certain() -> PoseWithCovariance {
    let covariance = Covariance::new_or_wider(Matrix6::identity() * (SIGMA_CERTAIN * SIGMA_CERTAIN));
    PoseWithCovariance { pose: Se3::identity(), covariance }
}

pub(super) fn relation(sim: Sim3, covariance: Matrix7, rigid: bool) -> Option<Relative> {
    if rigid {
        let m: Matrix6<f64> = covariance.fixed_view::<6, 6>(0, 0).into_owned();
        let covariance = Covariance::new(floored(m)).ok()?;
        Some(Relative::Metric(PoseWithCovariance { pose: sim.to_se3(), covariance }))
    } else {
        let covariance = Covariance::new(floored(covariance)).ok()?;
        Some(Relative::Similarity(SimWithCovariance { sim, covariance }))
    }
}

/// Symmetric, and no variance below what can be stated.
fn floored<const N: usize>(m: nalgebra::SMatrix<f64, N, N>) -> nalgebra::SMatrix<f64, N, N> {
    let mut out = (m + m.transpose()) * 0.5;
    for k in 0..N {
        out[(k, k)] = out[(k, k)].max(SIGMA_CERTAIN * SIGMA_CERTAIN);
    }
    out
}

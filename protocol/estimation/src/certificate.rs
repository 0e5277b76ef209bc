//! Whether a minimum of the chordal cost is the global one: the dual certificate of SE-Sync (Rosen et al. 2019, §4.2).
//!
//! With the cost `tr(M XᵀX)` in `X = [R t]` and the multipliers `Λ_i = sym(R_iᵀ (X M)_i)` of the rotations'
//! constraints, a stationary point is a global minimum if `S = M − Λ` is positive semidefinite once translations are
//! eliminated. If its smallest eigenvalue is `λ < 0` instead, the cost exceeds the global minimum by at most `3n|λ|`,
//! because the squared norm of the rotations is 3n. Here `S + ηI` is factorised, η as small as the wanted gap allows:
//! that it can be proves `λ ≥ −η`. Lanczos on its inverse (faer's) then gives λ itself.

use super::chordal::{ChordalEdge, ChordalGraph, Pose};
use super::solve::SolveError;
use super::sparse::{BlockPattern, Factor, Workspace};
use crate::geometry::Se3;
use faer::dyn_stack::{MemBuffer, MemStack, StackReq};
use faer::matrix_free::LinOp;
use faer::matrix_free::eigen::{PartialEigenParams, partial_self_adjoint_eigen, partial_self_adjoint_eigen_scratch};
use faer::{Mat, MatMut, MatRef, Par};
use nalgebra::{DMatrix, Matrix3, Vector3};

/// A minimum counts as certified if it exceeds the global one by at most this share of (its cost + 1e-3).
pub const GAP_MAX: f64 = 1e-6;
/// Cost below which a gap is measured absolutely.
const COST_MIN: f64 = 1e-3;
/// Shifts tried, each this many times the one before.
const SHIFT_STEP: f64 = 10.0;
/// Shifts tried at most.
const SHIFTS_MAX: usize = 8;
/// Relative accuracy wanted of the eigenvalue.
const EIGENVALUE_TOLERANCE: f64 = 1e-6;

/// Up to so many rows all eigenvalues are computed: Lanczos needs some room.
const DENSE_MAX: usize = 192;

/// What is known about a minimum.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Certificate {
    /// Smallest eigenvalue of the certificate matrix without translations; at an exact global minimum 0. `None` if it
    /// lies below every shift tried.
    pub eigenvalue: Option<f64>,
    /// By how much the cost can exceed the global minimum; `None` if unknown.
    pub gap: Option<f64>,
    /// Whether the gap is at most [`GAP_MAX`] of the cost.
    pub certified: bool,
}

impl ChordalGraph {
    /// Tests whether `values`, a stationary point, is the global minimum.
    ///
    /// # Errors
    /// [`SolveError`] if the graph is not connected or memory runs out.
    pub fn certify(&self, values: &[Se3]) -> Result<Certificate, SolveError> {
        if values.len() != self.nodes {
            return Err(SolveError::Start { want: self.nodes, got: values.len() });
        }
        let allowed = GAP_MAX * (self.cost(values) + COST_MIN);
        let of_rotations = 3.0 * self.nodes as f64;
        let poses: Vec<Pose> = values.iter().map(Pose::from).collect();
        let matrix = Shifted::new(self, &poses)?;
        let mut shift = 0.5 * allowed / of_rotations;
        for _ in 0..SHIFTS_MAX {
            match matrix.factorise(shift) {
                Ok(factor) => {
                    let eigenvalue = matrix.eigenvalue(&factor, shift).unwrap_or(-shift);
                    let gap = of_rotations * (-eigenvalue).clamp(0.0, shift);
                    return Ok(Certificate { eigenvalue: Some(eigenvalue), gap: Some(gap), certified: gap <= allowed });
                }
                Err(SolveError::Underconstrained { .. }) => shift *= SHIFT_STEP,
                Err(error) => return Err(error),
            }
        }
        Ok(Certificate { eigenvalue: None, gap: None, certified: false })
    }
}

/// `S`, by node the rows of its rotation and its translation; the first node without the latter (its translation is
/// the origin).
struct Shifted {
    pattern: BlockPattern,
    h: Vec<f64>,
    nodes: usize,
}

impl Shifted {
    fn new(graph: &ChordalGraph, values: &[Pose]) -> Result<Self, SolveError> {
        let mut sizes = vec![4; graph.nodes];
        if let Some(first) = sizes.first_mut() {
            *first = 3;
        }
        let pattern = BlockPattern::new(&sizes, graph.edges.iter().map(|e| (e.i, e.j)))?;
        let mut h = vec![0.0; pattern.value_count()];
        for edge in &graph.edges {
            let terms = CostTerms::new(edge);
            let mut add = |a: usize, b: usize, m: &DMatrix<f64>| {
                let cut = m.view((0, 0), (sizes[a], sizes[b]));
                BlockPattern::add(&mut h, pattern.slot(a, b), &cut);
            };
            add(edge.i, edge.i, &terms.ii);
            add(edge.j, edge.j, &terms.jj);
            add(edge.i, edge.j, &terms.ij);
        }
        for (node, multiplier) in multipliers(graph, values).iter().enumerate() {
            BlockPattern::add(&mut h, pattern.slot(node, node), &-multiplier);
        }
        Ok(Self { pattern, h, nodes: graph.nodes })
    }

    fn factorise(&self, shift: f64) -> Result<Factor, SolveError> {
        let mut h = self.h.clone();
        for node in 0..self.nodes {
            BlockPattern::add(&mut h, self.pattern.slot(node, node), &(Matrix3::identity() * shift));
        }
        self.pattern.factorise(h, &mut Workspace::default())
    }

    /// The smallest eigenvalue, from the largest of `(S + ηI)⁻¹`; `None` if Lanczos did not converge.
    fn eigenvalue(&self, factor: &Factor, shift: f64) -> Option<f64> {
        let operator = Inverse { matrix: self, factor };
        let n = 3 * self.nodes;
        if n <= DENSE_MAX {
            let inverse = operator.dense();
            let largest = inverse.symmetric_eigenvalues().max();
            return Some(1.0 / largest - shift);
        }
        let start = Mat::from_fn(n, 1, |r, _| libm::sin(1.0 + 1.7 * r as f64));
        let start = &start * faer::Scale(1.0 / start.norm_l2());
        let mut vectors = Mat::zeros(n, 1);
        let mut values = [0.0];
        let params = PartialEigenParams::default();
        let scratch = partial_self_adjoint_eigen_scratch::<f64>(&operator, 1, Par::Seq, params);
        let mut memory = MemBuffer::try_new(scratch).ok()?;
        let found = partial_self_adjoint_eigen(
            vectors.as_mut(),
            &mut values,
            &operator,
            start.col(0),
            EIGENVALUE_TOLERANCE,
            Par::Seq,
            MemStack::new(&mut memory),
            params,
        );
        (found.n_converged_eigen == 1).then(|| 1.0 / values[0] - shift)
    }
}

/// An edge's blocks of `M`, rows (R, t).
struct CostTerms {
    ii: DMatrix<f64>,
    ij: DMatrix<f64>,
    jj: DMatrix<f64>,
}

impl CostTerms {
    fn new(edge: &ChordalEdge) -> Self {
        let (kappa, tau) = (edge.kappa, edge.tau);
        let (r, t) = (edge.r_i_j, edge.p_i_j);
        let block = |rotation: Matrix3<f64>, right: Vector3<f64>, bottom: Vector3<f64>, corner: f64| {
            let mut m = DMatrix::zeros(4, 4);
            m.view_mut((0, 0), (3, 3)).copy_from(&rotation);
            m.view_mut((0, 3), (3, 1)).copy_from(&right);
            m.view_mut((3, 0), (1, 3)).copy_from(&bottom.transpose());
            m[(3, 3)] = corner;
            m
        };
        let zero = Vector3::zeros();
        Self {
            ii: block(Matrix3::identity() * kappa + t * t.transpose() * tau, t * tau, t * tau, tau),
            ij: block(r * -kappa, t * -tau, zero, -tau),
            jj: block(Matrix3::identity() * kappa, zero, zero, tau),
        }
    }
}

/// `Λ_i = sym(R_iᵀ (X M)_i)`, where `X M` is half the gradient of the cost by the entries of the rotations.
fn multipliers(graph: &ChordalGraph, values: &[Pose]) -> Vec<Matrix3<f64>> {
    let mut out = vec![Matrix3::zeros(); graph.nodes];
    for edge in &graph.edges {
        let (i, j) = (&values[edge.i], &values[edge.j]);
        let (r_i_j, t_i_j) = (edge.r_i_j, edge.p_i_j);
        let translation = (j.t - i.t - i.r * t_i_j) * edge.tau;
        let of_i = (i.r - j.r * r_i_j.transpose()) * edge.kappa - translation * t_i_j.transpose();
        out[edge.i] += i.r.transpose() * of_i;
        out[edge.j] += j.r.transpose() * (j.r - i.r * r_i_j) * edge.kappa;
    }
    out.iter().map(|m| (m + m.transpose()) * 0.5).collect()
}

/// `(S + ηI)⁻¹` on the rotations' rows: translations are eliminated.
struct Inverse<'a> {
    matrix: &'a Shifted,
    factor: &'a Factor,
}

impl Inverse<'_> {
    fn dense(&self) -> DMatrix<f64> {
        let n = 3 * self.matrix.nodes;
        let mut out = Mat::zeros(n, n);
        let identity = Mat::<f64>::identity(n, n);
        self.apply(out.as_mut(), identity.as_ref(), Par::Seq, MemStack::new(&mut MemBuffer::new(StackReq::EMPTY)));
        DMatrix::from_fn(n, n, |r, c| 0.5 * (out[(r, c)] + out[(c, r)]))
    }
}

impl core::fmt::Debug for Inverse<'_> {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.debug_struct("Inverse").field("nodes", &self.matrix.nodes).finish()
    }
}

impl LinOp<f64> for Inverse<'_> {
    fn apply_scratch(&self, _: usize, _: Par) -> StackReq {
        StackReq::EMPTY
    }

    fn nrows(&self) -> usize {
        3 * self.matrix.nodes
    }

    fn ncols(&self) -> usize {
        3 * self.matrix.nodes
    }

    fn apply(&self, mut out: MatMut<'_, f64>, rhs: MatRef<'_, f64>, _: Par, _: &mut MemStack) {
        let pattern = &self.matrix.pattern;
        let mut x = vec![0.0; pattern.scalars() * rhs.ncols()];
        let place = |row: usize, column: usize| column * pattern.scalars() + pattern.start(row / 3) + row % 3;
        for column in 0..rhs.ncols() {
            (0..rhs.nrows()).for_each(|row| x[place(row, column)] = rhs[(row, column)]);
        }
        pattern.solve(self.factor, &mut x);
        for column in 0..rhs.ncols() {
            (0..rhs.nrows()).for_each(|row| out[(row, column)] = x[place(row, column)]);
        }
    }

    fn conj_apply(&self, out: MatMut<'_, f64>, rhs: MatRef<'_, f64>, par: Par, stack: &mut MemStack) {
        self.apply(out, rhs, par, stack);
    }
}

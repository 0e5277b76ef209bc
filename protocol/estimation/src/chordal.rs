//! The chordal cost of pose graphs, `F = Σ κ‖R_j − R_i R_ij‖²_F + τ‖t_j − t_i − R_i t_ij‖²` (Rosen et al. 2019,
//! "SE-Sync", eq. 3), with `κ (6 − 2 tr(R_jᵀ R_i R_ij))` for the first term where R_ij is only nearly a rotation:
//! decides where a minimisation starts that odometry would lead astray, and finds the minimum that
//! [`super::certificate`] can prove to be global.
//!
//! Start: without the constraint that rotations be rotations, two linear least-squares problems (Carlone et al. 2015,
//! "Initialization techniques for 3D SLAM", §III.B). Then Gauss–Newton, then Newton with the exact Hessian, which is
//! what converges quadratically where residuals are large. Perturbations are `R exp(φ^)`, `t + R ρ`; after each step
//! the translations become those that suit the rotations best (variable projection, Golub and Pereyra 1973): a long
//! chain that turns a little sweeps its far end along an arc, of which `ρ` is only the tangent.

use super::minimise::{Normal, Objective, minimise};
use super::solve::SolveError;
use super::sparse::{BlockPattern, Factor, Slot, Workspace};
use crate::geometry::so3::{So3, hat};
use crate::geometry::{Se3, se3};
use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

/// Gauss–Newton steps before the exact Hessian is used.
const GAUSS_NEWTON_STEPS: usize = 3;

/// A measurement with isotropic weights.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ChordalEdge {
    /// Target node.
    pub i: usize,
    /// Source node.
    pub j: usize,
    /// Rotation of `t_i_j`: one as near as its source prints it, because a known optimum is that of what is printed.
    pub r_i_j: Matrix3<f64>,
    /// Translation of `t_i_j`.
    pub p_i_j: Vector3<f64>,
    /// Weight κ of the rotation; positive.
    pub kappa: f64,
    /// Weight τ of the translation; positive.
    pub tau: f64,
}

/// A connected pose graph with isotropic weights. Node 0 is held fixed.
#[derive(Clone, Debug, PartialEq)]
pub struct ChordalGraph {
    /// Number of nodes.
    pub nodes: usize,
    /// Measurements; ends below `nodes` and distinct.
    pub edges: Vec<ChordalEdge>,
}

/// A stationary point of the chordal cost.
#[derive(Clone, Debug, PartialEq)]
pub struct ChordalSolution {
    /// `t_world_node`; node 0 as in the start.
    pub values: Vec<Se3>,
    /// F.
    pub cost: f64,
    /// Iterations used.
    pub iterations: usize,
    /// Whether the last step was negligible, or the next would be.
    pub converged: bool,
}

impl ChordalGraph {
    /// The cost of a set of poses.
    pub fn cost(&self, values: &[Se3]) -> f64 {
        Chordal::cost_of(self, &values.iter().map(Pose::from).collect::<Vec<_>>())
    }

    /// The start by chordal relaxation, node 0 at the identity.
    ///
    /// # Errors
    /// [`SolveError::Underconstrained`] if the graph is not connected.
    pub fn relaxed(&self) -> Result<Vec<Se3>, SolveError> {
        let [of_rotations] = self.patterns([3])?;
        let rotations = self.relaxed_rotations(&of_rotations)?;
        let translations = Translations::new(self)?.of(self, |node| &rotations[node]);
        Ok(rotations.into_iter().zip(translations).map(|(r, t)| Se3::new(So3::from_matrix(&r), t)).collect())
    }

    /// A minimum near `start`.
    ///
    /// # Errors
    /// [`SolveError`]; running out of iterations is no error but `converged = false`.
    pub fn minimise(&self, start: &[Se3], iterations_max: usize) -> Result<ChordalSolution, SolveError> {
        if start.len() != self.nodes {
            return Err(SolveError::Start { want: self.nodes, got: start.len() });
        }
        let values: Vec<Pose> = start.iter().map(Pose::from).collect();
        let mut objective = Chordal::new(self)?;
        let first = minimise(&objective, values, iterations_max.min(GAUSS_NEWTON_STEPS))?;
        objective.exact = true;
        let mut last = minimise(&objective, first.values, iterations_max.saturating_sub(first.iterations))?;
        last.iterations += first.iterations;
        let values = last.values.iter().map(|p| Se3::new(So3::from_matrix(&p.r), p.t)).collect();
        Ok(ChordalSolution { values, cost: last.cost, iterations: last.iterations, converged: last.converged })
    }

    /// Minimises `Σ κ‖R_j − R_i R_ij‖²` over all matrices, then projects on the rotations. Each row `y` of the matrices
    /// is a problem of its own, `Σ κ‖y_j − R_ijᵀ y_i‖²`, with the same normal matrix.
    fn relaxed_rotations(&self, pattern: &BlockPattern) -> Result<Vec<Matrix3<f64>>, SolveError> {
        let mut h = vec![0.0; pattern.value_count()];
        let mut b = vec![0.0; 3 * pattern.scalars()];
        for edge in &self.edges {
            let r_i_j = edge.r_i_j;
            for node in [edge.i, edge.j].into_iter().filter(|&node| node > 0) {
                let slot = pattern.slot(node - 1, node - 1);
                BlockPattern::add(&mut h, slot, &(Matrix3::identity() * edge.kappa));
            }
            if edge.i > 0 && edge.j > 0 {
                let slot = pattern.slot(edge.i - 1, edge.j - 1);
                BlockPattern::add(&mut h, slot, &(r_i_j * -edge.kappa));
            } else {
                // The fixed end is the identity, whose row k is the k-th unit vector.
                let (free, known) = if edge.i > 0 { (edge.i, r_i_j) } else { (edge.j, r_i_j.transpose()) };
                let start = pattern.start(free - 1);
                for (k, x) in b.chunks_exact_mut(pattern.scalars()).enumerate() {
                    (0..3).for_each(|r| x[start + r] += edge.kappa * known[(r, k)]);
                }
            }
        }
        let factor = pattern.factorise(h, &mut Workspace::default())?;
        pattern.solve(&factor, &mut b);
        let row = |k: usize, node: usize| {
            let at = k * pattern.scalars() + pattern.start(node - 1);
            Vector3::from_column_slice(&b[at..at + 3]).transpose()
        };
        let rotation = |node: usize| match node {
            0 => Some(Matrix3::identity()),
            _ => nearest_rotation(&Matrix3::from_rows(&[row(0, node), row(1, node), row(2, node)])),
        };
        (0..self.nodes).map(|node| rotation(node).ok_or(SolveError::NotFinite)).collect()
    }

    /// The patterns of so many scalars a node without the first.
    fn patterns<const N: usize>(&self, scalars: [usize; N]) -> Result<[BlockPattern; N], SolveError> {
        let free = self.edges.iter().filter(|e| e.i > 0 && e.j > 0);
        let sizes = scalars.map(|size| vec![size; self.nodes.saturating_sub(1)]);
        BlockPattern::of_sizes(sizes.each_ref().map(Vec::as_slice), free.map(|e| (e.i - 1, e.j - 1)))
    }
}

/// Which translations suit given rotations best, node 0 at the origin: the minimum of `Σ τ‖t_j − t_i − R_i t_ij‖²`, whose
/// normal matrix is the same for any rotations.
struct Translations {
    pattern: BlockPattern,
    factor: Factor,
}

impl Translations {
    /// Factorises the normal matrix.
    ///
    /// # Errors
    /// [`SolveError::Underconstrained`] if the graph is not connected.
    fn new(graph: &ChordalGraph) -> Result<Self, SolveError> {
        let [pattern] = graph.patterns([1])?;
        let mut h = vec![0.0; pattern.value_count()];
        for edge in &graph.edges {
            let weight = nalgebra::Matrix1::new(edge.tau);
            for node in [edge.i, edge.j].into_iter().filter(|node| *node > 0) {
                BlockPattern::add(&mut h, pattern.slot(node - 1, node - 1), &weight);
            }
            if edge.i > 0 && edge.j > 0 {
                BlockPattern::add(&mut h, pattern.slot(edge.i - 1, edge.j - 1), &-weight);
            }
        }
        let factor = pattern.factorise(h, &mut Workspace::default())?;
        Ok(Self { pattern, factor })
    }

    fn of<'a>(&self, graph: &ChordalGraph, rotation: impl Fn(usize) -> &'a Matrix3<f64>) -> Vec<Vector3<f64>> {
        let pattern = &self.pattern;
        let mut b = vec![0.0; 3 * pattern.scalars()];
        for edge in &graph.edges {
            let step = rotation(edge.i) * edge.p_i_j * edge.tau;
            for (node, sign) in [(edge.i, -1.0), (edge.j, 1.0)].into_iter().filter(|(node, _)| *node > 0) {
                let start = pattern.start(node - 1);
                for (k, x) in b.chunks_exact_mut(pattern.scalars()).enumerate() {
                    x[start] += sign * step[k];
                }
            }
        }
        pattern.solve(&self.factor, &mut b);
        let n = pattern.scalars();
        let place = |node: usize| pattern.start(node - 1);
        let of = |node: usize| Vector3::new(b[place(node)], b[n + place(node)], b[2 * n + place(node)]);
        (0..graph.nodes).map(|node| if node == 0 { Vector3::zeros() } else { of(node) }).collect()
    }
}

/// The rotation nearest to a matrix in the Frobenius norm; `None` if the matrix holds no finite numbers.
pub(super) fn nearest_rotation(m: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    if !m.iter().all(|x| x.is_finite()) {
        return None;
    }
    let svd = m.svd(true, true);
    let (u, v_t) = svd.u.zip(svd.v_t)?;
    let smallest = svd.singular_values.imin();
    let mut sign = Matrix3::identity();
    sign[(smallest, smallest)] = (u * v_t).determinant().signum();
    Some(u * sign * v_t)
}

/// A pose as a matrix.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pose {
    pub(super) r: Matrix3<f64>,
    pub(super) t: Vector3<f64>,
}

impl From<&Se3> for Pose {
    fn from(t: &Se3) -> Self {
        Self { r: t.rotation.matrix(), t: t.translation }
    }
}

/// The chordal cost as an [`Objective`].
struct Chordal<'a> {
    graph: &'a ChordalGraph,
    pattern: BlockPattern,
    translations: Translations,
    /// Per edge, its slots (i, i), (i, j), (j, j).
    slots: Vec<[Option<Slot>; 3]>,
    /// Whether `H` is the exact Hessian.
    exact: bool,
}

impl<'a> Chordal<'a> {
    fn new(graph: &'a ChordalGraph) -> Result<Self, SolveError> {
        let [pattern] = graph.patterns([6])?;
        let slot = |a: usize, b: usize| (a > 0 && b > 0).then(|| pattern.slot(a - 1, b - 1));
        let slots = graph.edges.iter().map(|e| [slot(e.i, e.i), slot(e.i, e.j), slot(e.j, e.j)]).collect();
        Ok(Self { graph, slots, pattern, translations: Translations::new(graph)?, exact: false })
    }

    fn cost_of(graph: &ChordalGraph, values: &[Pose]) -> f64 {
        let one = |edge: &ChordalEdge| {
            let (i, j) = (&values[edge.i], &values[edge.j]);
            let rotation = (j.r - i.r * edge.r_i_j).norm_squared();
            let translation = (j.t - i.t - i.r * edge.p_i_j).norm_squared();
            edge.kappa * (rotation + 3.0 - edge.r_i_j.norm_squared()) + edge.tau * translation
        };
        graph.edges.iter().map(one).sum()
    }
}

impl Objective for Chordal<'_> {
    type Values = Vec<Pose>;

    fn pattern(&self) -> &BlockPattern {
        &self.pattern
    }

    fn cost(&self, values: &Vec<Pose>) -> f64 {
        Self::cost_of(self.graph, values)
    }

    fn linearise(&self, values: &Vec<Pose>, normal: &mut Normal) {
        for (edge, [ii, ij, jj]) in self.graph.edges.iter().zip(&self.slots) {
            let at = EdgeTerms::new(edge, &values[edge.i], &values[edge.j], self.exact);
            for (node, slot, block, gradient) in [(edge.i, ii, &at.ii, &at.i), (edge.j, jj, &at.jj, &at.j)] {
                if let Some(slot) = slot {
                    BlockPattern::add(&mut normal.h, *slot, block);
                    let start = self.pattern.start(node - 1);
                    normal.g[start..start + 6].iter_mut().zip(gradient).for_each(|(g, x)| *g += x);
                }
            }
            if let Some(slot) = ij {
                BlockPattern::add(&mut normal.h, *slot, &at.ij);
            }
        }
    }

    fn retract(&self, values: &Vec<Pose>, delta: &[f64]) -> Vec<Pose> {
        let turned = |(node, pose): (usize, &Pose)| {
            if node == 0 {
                return pose.r;
            }
            let phi = Vector3::from_column_slice(&delta[self.pattern.start(node - 1) + 3..][..3]);
            pose.r * So3::exp(&phi).matrix()
        };
        let rotations: Vec<Matrix3<f64>> = values.iter().enumerate().map(turned).collect();
        let origin = values.first().map_or_else(Vector3::zeros, |first| first.t);
        let translations = self.translations.of(self.graph, |node| &rotations[node]);
        rotations.into_iter().zip(translations).map(|(r, t)| Pose { r, t: origin + t }).collect()
    }
}

/// One edge's part of half the Hessian and half the gradient, tangent order (ρ, φ).
struct EdgeTerms {
    ii: Matrix6<f64>,
    ij: Matrix6<f64>,
    jj: Matrix6<f64>,
    i: Vector6<f64>,
    j: Vector6<f64>,
}

impl EdgeTerms {
    /// With `D = R_iᵀ R_j`, `A = Dᵀ R_ij`, `B = R_ij Dᵀ` and `q = R_iᵀ (t_j − t_i) − t_ij`: half the cost's gradient is
    /// `−κ (A − Aᵀ)^∨` by φ_j, `κ (B − Bᵀ)^∨` by φ_i, and for the translation that of `q` with `∂q/∂ρ_i = −I`,
    /// `∂q/∂φ_i = t_ij^`, `∂q/∂ρ_j = D`. The Gauss–Newton Hessian takes `A = B = I` and drops `q`.
    fn new(edge: &ChordalEdge, i: &Pose, j: &Pose, exact: bool) -> Self {
        let (r_i_j, t_i_j) = (edge.r_i_j, edge.p_i_j);
        let d = i.r.transpose() * j.r;
        let (a, b) = (d.transpose() * r_i_j, r_i_j * d.transpose());
        let q = i.r.transpose() * (j.t - i.t) - t_i_j;
        let (kappa, tau, identity) = (edge.kappa, edge.tau, Matrix3::identity());
        let (blank, none) = (Matrix6::zeros(), Vector6::zeros());
        let mut out = Self { ii: blank, ij: blank, jj: blank, i: none, j: none };
        let by_phi_i = hat(&t_i_j);
        let (mut rotation_ii, mut rotation_jj, mut rotation_ij) = (identity * 2.0, identity * 2.0, d * -2.0);
        let mut lever = by_phi_i.transpose() * by_phi_i;
        if exact {
            let symmetric = |m: &Matrix3<f64>| (m + m.transpose()) * 0.5;
            rotation_ii = identity * b.trace() - symmetric(&b);
            rotation_jj = identity * a.trace() - symmetric(&a);
            rotation_ij = (b.transpose() - identity * b.trace()) * d;
            lever += identity * q.dot(&t_i_j) - symmetric(&(q * t_i_j.transpose()));
        }
        let set = |m: &mut Matrix6<f64>, at: (usize, usize), x: &Matrix3<f64>| {
            m.fixed_view_mut::<3, 3>(at.0, at.1).copy_from(x);
        };
        set(&mut out.ii, (0, 0), &(identity * tau));
        set(&mut out.ii, (0, 3), &(by_phi_i * -tau));
        set(&mut out.ii, (3, 0), &(by_phi_i.transpose() * -tau));
        set(&mut out.ii, (3, 3), &(rotation_ii * kappa + lever * tau));
        set(&mut out.jj, (0, 0), &(identity * tau));
        set(&mut out.jj, (3, 3), &(rotation_jj * kappa));
        set(&mut out.ij, (0, 0), &(d * -tau));
        set(&mut out.ij, (3, 0), &(by_phi_i.transpose() * d * tau));
        set(&mut out.ij, (3, 3), &(rotation_ij * kappa));
        let vee = |m: &Matrix3<f64>| Vector3::new(m[(2, 1)] - m[(1, 2)], m[(0, 2)] - m[(2, 0)], m[(1, 0)] - m[(0, 1)]);
        out.i = se3::join(&(q * -tau), &(by_phi_i.transpose() * q * tau + vee(&b) * kappa));
        out.j = se3::join(&(d.transpose() * q * tau), &(vee(&a) * -kappa));
        out
    }
}

//! Levenberg–Marquardt on one component: decides the most probable anchors given its factors.
//!
//! The result depends on the graph and the start alone; the start is made from the same set of facts, never from an
//! earlier estimate.

use super::graph::{CorrelatedResidual, Edge, Graph, Key};
use super::minimise::{Minimum, Normal, Objective, minimise};
use super::sparse::{BlockPattern, Factor, Slot};
use crate::geometry::{Se3, Sim3, se3};
use nalgebra::{Matrix3, Matrix6, SMatrix, Vector6};
use std::sync::Arc;

pub use super::solve_error::{ComponentError, SolveError};
pub use super::sparse::FACTOR_BYTES_MAX;

/// A solved component: estimates, and the factorisation from which covariances are drawn.
#[derive(Clone, Debug)]
pub struct Solution<K: Key> {
    pub(super) graph: Graph<K>,
    pub(super) values: Vec<Sim3>,
    /// Weighted sum of squared residuals at the end.
    pub chi2: f64,
    /// Residual dimensions minus variables.
    pub dof: usize,
    /// Iterations used.
    pub iterations: usize,
    /// Whether the last step was negligible, or the next would be (otherwise the iterations ran out).
    pub converged: bool,
    pub(super) pattern: Arc<BlockPattern>,
    pub(super) factor: Factor,
}

impl<K: Key> Solution<K> {
    /// The component.
    pub fn graph(&self) -> &Graph<K> {
        &self.graph
    }

    /// `t_world_anchor` in the order of [`Graph::nodes`]; world is the component's own, arbitrary frame.
    pub fn values(&self) -> &[Sim3] {
        &self.values
    }
}

/// A minimum of χ² without a factorisation.
#[derive(Clone, Debug)]
pub struct ChiSquaredMinimum {
    /// `t_world_anchor` in the order of [`Graph::nodes`].
    pub values: Vec<Sim3>,
    /// Weighted sum of squared residuals.
    pub chi2: f64,
    /// Iterations used.
    pub iterations: usize,
    /// Whether the last step was negligible, or the next would be.
    pub converged: bool,
}

/// As [`solve`], for those who want no covariances: nothing is factorised at the minimum.
///
/// # Errors
/// As [`solve`], but a direction that no measurement determines may pass unseen.
pub fn minimum<K: Key>(
    graph: &Graph<K>,
    start: Vec<Sim3>,
    iterations_max: usize,
) -> Result<ChiSquaredMinimum, ComponentError<K>> {
    expect_start(graph, &start)?;
    let system = System::new(graph, FACTOR_BYTES_MAX)?;
    let found = minimise(&system, start, iterations_max).map_err(|error| ComponentError::of(error, graph))?;
    let (chi2, iterations, converged) = (found.cost, found.iterations, found.converged);
    Ok(ChiSquaredMinimum { values: found.values, chi2, iterations, converged })
}

fn expect_start<K: Key>(graph: &Graph<K>, start: &[Sim3]) -> Result<(), SolveError> {
    let (want, got) = (graph.nodes().len(), start.len());
    if want == got { Ok(()) } else { Err(SolveError::Start { want, got }) }
}

/// Minimises the component's χ² from `start` (one `t_world_anchor` per node, in order; anchors of one frame must have
/// the same scale).
///
/// # Errors
/// [`ComponentError`]; running out of iterations is no error but `converged = false`.
pub fn solve<K: Key>(
    graph: Graph<K>,
    start: Vec<Sim3>,
    iterations_max: usize,
) -> Result<Solution<K>, ComponentError<K>> {
    solve_within(graph, start, iterations_max, FACTOR_BYTES_MAX)
}

/// [`solve`] with a limit of one's own in place of [`FACTOR_BYTES_MAX`].
///
/// # Errors
/// As [`solve`].
pub fn solve_within<K: Key>(
    graph: Graph<K>,
    start: Vec<Sim3>,
    iterations_max: usize,
    bytes_max: u64,
) -> Result<Solution<K>, ComponentError<K>> {
    expect_start(&graph, &start)?;
    let system = System::new(&graph, bytes_max)?;
    let found = minimise(&system, start, iterations_max).map_err(|error| ComponentError::of(error, &graph))?;
    let Minimum { values, cost: chi2, iterations, converged, mut normal } = found;
    normal.at(&system, &values)?;
    let factor = normal.factorised(&system.pattern).map_err(|error| ComponentError::of(error, &graph))?;
    let residuals: usize = graph.edges().iter().map(Edge::dimension).sum();
    let dof = residuals.saturating_sub(system.pattern.scalars());
    let pattern = Arc::new(system.pattern);
    Ok(Solution { graph, values, chi2, dof, iterations, converged, pattern, factor })
}

/// Which columns of a factor's Jacobians belong to a variable.
#[derive(Clone, Copy)]
pub(super) enum Part {
    AnchorI,
    AnchorJ,
    ScaleI,
    ScaleJ,
    ScaleBoth,
}

/// A graph's χ² with its index bookkeeping: variables of the nodes, and the blocks each factor adds to.
struct System<'a, K: Key> {
    graph: &'a Graph<K>,
    pattern: BlockPattern,
    terms: Vec<Terms>,
}

enum Terms {
    /// Between anchors of fixed unit.
    Rigid(Rigid),
    /// A cloud's that follows its odometry: first scalar of each node, none of the one held fixed, and the slots of the
    /// pairs (p, q), p ≤ q, of those that have one, row by row.
    CorrelatedResidual { starts: Vec<Option<usize>>, slots: Vec<Slot> },
    /// All others: first scalar and part of each variable, and the slots of the pairs (p, q), p ≤ q, row by row.
    General { parts: Vec<(usize, Part)>, slots: Vec<Slot> },
}

/// First scalar and slot of (i, i) and of (j, j), and the slot of (j, i); `None` at the anchor held fixed.
#[derive(Clone, Copy)]
struct Rigid {
    i: Option<(usize, Slot)>,
    j: Option<(usize, Slot)>,
    cross: Option<Slot>,
}

impl<'a, K: Key> System<'a, K> {
    fn new(graph: &'a Graph<K>, bytes_max: u64) -> Result<Self, SolveError> {
        let variables: Vec<Variables> = (0..graph.edges().len()).map(|k| Variables::of(graph, k)).collect();
        let mut sizes = vec![6; graph.nodes().len().saturating_sub(1)];
        sizes.resize(sizes.len() + graph.scale_count(), 1);
        let [pattern] = BlockPattern::within([&sizes], variables.iter().flat_map(Variables::pairs), bytes_max)?;
        let terms = variables.into_iter().map(|variables| Terms::new(variables, &pattern)).collect();
        Ok(Self { graph, pattern, terms })
    }
}

impl Terms {
    fn new(variables: Variables, pattern: &BlockPattern) -> Self {
        let slots = |variables: &Variables| variables.pairs().iter().map(|&(a, b)| pattern.slot(a, b)).collect();
        let parts = match &variables {
            Variables::CorrelatedResidual(nodes) => {
                let start = |node: &usize| node.checked_sub(1).map(|variable| pattern.start(variable));
                return Self::CorrelatedResidual {
                    starts: nodes.iter().map(start).collect(),
                    slots: slots(&variables),
                };
            }
            Variables::Of(parts) => parts,
        };
        if parts.iter().all(|(_, part)| part.size() == 6) {
            let find = |wanted: fn(&Part) -> bool| parts.iter().find(|(_, p)| wanted(p)).map(|(v, _)| *v);
            let own = |v: usize| (pattern.start(v), pattern.slot(v, v));
            let i = find(|p| matches!(p, Part::AnchorI));
            let j = find(|p| matches!(p, Part::AnchorJ));
            return Self::Rigid(Rigid {
                i: i.map(own),
                j: j.map(own),
                cross: j.zip(i).map(|(a, b)| pattern.slot(a, b)),
            });
        }
        Self::General {
            slots: slots(&variables),
            parts: parts.iter().map(|(v, part)| (pattern.start(*v), *part)).collect(),
        }
    }
}

impl<K: Key> Objective for System<'_, K> {
    type Values = Vec<Sim3>;

    fn pattern(&self) -> &BlockPattern {
        &self.pattern
    }

    fn cost(&self, values: &Vec<Sim3>) -> f64 {
        self.graph.chi2(values)
    }

    fn linearise(&self, values: &Vec<Sim3>, normal: &mut Normal) {
        for (k, (edge, terms)) in self.graph.edges().iter().zip(&self.terms).enumerate() {
            match terms {
                Terms::Rigid(rigid) => add_rigid(edge, values, *rigid, normal),
                Terms::CorrelatedResidual { starts, slots } => {
                    if let Some(correlation) = self.graph.correlations.get(&k) {
                        add_bent(&correlation.linearise(self.graph, edge, values), edge, starts, slots, normal);
                    }
                }
                Terms::General { parts, slots } => add_general(edge, values, parts, slots, normal),
            }
        }
    }

    fn retract(&self, values: &Vec<Sim3>, delta: &[f64]) -> Vec<Sim3> {
        let moved = |(k, value): (usize, &Sim3)| {
            // The anchor held fixed keeps its pose to the bit; its scale may be free.
            let rigid = k.checked_sub(1).map_or(*value, |variable| {
                let xi = &delta[self.pattern.start(variable)..][..6];
                *value * Sim3::from_se3(&Se3::exp(&Vector6::from_column_slice(xi)))
            });
            let Some(s) = self.graph.scale_of(k) else { return rigid };
            let grow = libm::exp(delta[self.pattern.start(self.graph.nodes().len() - 1 + s)]);
            Sim3::new(rigid.rotation, rigid.translation, rigid.scale * grow)
        };
        values.iter().enumerate().map(moved).collect()
    }
}

/// A factor's part of `H` and `g`, between anchors of fixed unit.
pub(super) struct RigidTerm {
    pub(super) ii: Matrix6<f64>,
    pub(super) ji: Matrix6<f64>,
    pub(super) jj: Matrix6<f64>,
    pub(super) gradient_i: Vector6<f64>,
    pub(super) gradient_j: Vector6<f64>,
}

impl RigidTerm {
    /// With `J_i = −J_j A`, `A = Ad((X_i⁻¹ X_j)⁻¹)`: `H_jj = J_jᵀ W J_j`, `H_ji = −H_jj A`, `H_ii = −Aᵀ H_ji`. `J_j`
    /// and `A` are both `[d u; 0 d]` in blocks of translation and rotation, which spares a third of the products.
    pub(super) fn new<K: Key>(edge: &Edge<K>, values: &[Sim3]) -> Self {
        let (residual, by_j, adjoint) = edge.linearise_rigid(values);
        let (d, u) = (block(&by_j, 0, 0), block(&by_j, 0, 3));
        let w = edge.information_rigid();
        let (w_tt, w_tr, w_rr) = (block(&w, 0, 0), block(&w, 0, 3), block(&w, 3, 3));
        let (d_t, u_t) = (d.transpose(), u.transpose());
        let left = [[d_t * w_tt, d_t * w_tr], [u_t * w_tt + d_t * w_tr.transpose(), u_t * w_tr + d_t * w_rr]];
        let (r_t, r_r) = se3::split(&residual);
        let gradient = [left[0][0] * r_t + left[0][1] * r_r, left[1][0] * r_t + left[1][1] * r_r];
        let (tt, rt, rr) = (left[0][0] * d, left[1][0] * d, left[1][0] * u + left[1][1] * d);
        let tr = rt.transpose();
        let (a, s) = (block(&adjoint, 0, 0), block(&adjoint, 0, 3));
        let ji = [[tt * a, tt * s + tr * a], [rt * a, rt * s + rr * a]];
        let (a_t, s_t) = (a.transpose(), s.transpose());
        let (ii_tt, ii_rt) = (a_t * ji[0][0], s_t * ji[0][0] + a_t * ji[1][0]);
        let ii_rr = s_t * ji[0][1] + a_t * ji[1][1];
        Self {
            ii: joined(&ii_tt, &ii_rt.transpose(), &ii_rt, &ii_rr),
            ji: -joined(&ji[0][0], &ji[0][1], &ji[1][0], &ji[1][1]),
            jj: joined(&tt, &tr, &rt, &rr),
            gradient_i: -se3::join(&(a_t * gradient[0]), &(s_t * gradient[0] + a_t * gradient[1])),
            gradient_j: se3::join(&gradient[0], &gradient[1]),
        }
    }
}

/// The 3×3 block whose first entry lies at (`r`, `c`).
fn block(m: &Matrix6<f64>, r: usize, c: usize) -> Matrix3<f64> {
    m.fixed_view::<3, 3>(r, c).into_owned()
}

/// `[tt tr; rt rr]`.
fn joined(tt: &Matrix3<f64>, tr: &Matrix3<f64>, rt: &Matrix3<f64>, rr: &Matrix3<f64>) -> Matrix6<f64> {
    let mut out = Matrix6::zeros();
    for (r, c, m) in [(0, 0, tt), (0, 3, tr), (3, 0, rt), (3, 3, rr)] {
        out.fixed_view_mut::<3, 3>(r, c).copy_from(m);
    }
    out
}

fn add_rigid<K: Key>(edge: &Edge<K>, values: &[Sim3], Rigid { i, j, cross }: Rigid, normal: &mut Normal) {
    let term = RigidTerm::new(edge, values);
    if let Some((start, slot)) = j {
        BlockPattern::add(&mut normal.h, slot, &term.jj);
        normal.g[start..start + 6].iter_mut().zip(&term.gradient_j).for_each(|(g, x)| *g += x);
    }
    if let Some((start, slot)) = i {
        BlockPattern::add(&mut normal.h, slot, &term.ii);
        normal.g[start..start + 6].iter_mut().zip(&term.gradient_i).for_each(|(g, x)| *g += x);
    }
    if let Some(slot) = cross {
        BlockPattern::add(&mut normal.h, slot, &term.ji);
    }
}

fn add_bent<K: Key>(
    bent: &CorrelatedResidual,
    edge: &Edge<K>,
    starts: &[Option<usize>],
    slots: &[Slot],
    normal: &mut Normal,
) {
    let information = edge.information_rigid();
    let weighted = information * bent.residual;
    let free: Vec<_> = bent.by.iter().zip(starts).filter_map(|((_, by), start)| Some((by, (*start)?))).collect();
    let mut slots = slots.iter();
    for (p, (by, start)) in free.iter().enumerate() {
        let gradient = by.transpose() * weighted;
        normal.g[*start..*start + 6].iter_mut().zip(&gradient).for_each(|(g, x)| *g += x);
        let left = by.transpose() * information;
        for ((other, _), slot) in free[p..].iter().zip(&mut slots) {
            BlockPattern::add(&mut normal.h, *slot, &(left * *other));
        }
    }
}

fn add_general<K: Key>(edge: &Edge<K>, values: &[Sim3], parts: &[(usize, Part)], slots: &[Slot], normal: &mut Normal) {
    let at = edge.linearise(values);
    let information = edge.information();
    let weighted = information * at.residual;
    let jacobians: Vec<SMatrix<f64, 7, 6>> = parts.iter().map(|(_, part)| columns(*part, &at.by_i, &at.by_j)).collect();
    let mut slots = slots.iter();
    for (p, (start, part)) in parts.iter().enumerate() {
        let gradient = jacobians[p].transpose() * weighted;
        for k in 0..part.size() {
            normal.g[start + k] += gradient[k];
        }
        let left = jacobians[p].transpose() * information;
        for (q, (_, other)) in parts.iter().enumerate().skip(p) {
            let block = left * jacobians[q];
            if let Some(&slot) = slots.next() {
                BlockPattern::add(&mut normal.h, slot, &block.view((0, 0), (part.size(), other.size())));
            }
        }
    }
}

impl Part {
    pub(super) fn size(self) -> usize {
        match self {
            Self::AnchorI | Self::AnchorJ => 6,
            Self::ScaleI | Self::ScaleJ | Self::ScaleBoth => 1,
        }
    }
}

/// What a factor adds to.
pub(super) enum Variables {
    /// A factor of its two anchors and their scales.
    Of(Vec<(usize, Part)>),
    /// One that follows others: its nodes, ascending.
    CorrelatedResidual(Vec<usize>),
}

impl Variables {
    pub(super) fn of<K: Key>(graph: &Graph<K>, edge: usize) -> Self {
        let factor = &graph.edges()[edge];
        match graph.correlations.get(&edge) {
            None => Self::Of(variables_of(graph, factor)),
            Some(correlation) => Self::CorrelatedResidual(graph.nodes_of(correlation, factor)),
        }
    }

    /// Of its variables, the pairs (p, q), p ≤ q, row by row.
    pub(super) fn pairs(&self) -> Vec<(usize, usize)> {
        let list: Vec<usize> = match self {
            Self::Of(parts) => parts.iter().map(|(variable, _)| *variable).collect(),
            Self::CorrelatedResidual(nodes) => nodes.iter().filter_map(|node| node.checked_sub(1)).collect(),
        };
        list.iter().enumerate().flat_map(|(k, &a)| list[k..].iter().map(move |&b| (a, b))).collect()
    }
}

/// The variables of a factor: anchors without the first, then scales.
fn variables_of<K: Key>(graph: &Graph<K>, edge: &Edge<K>) -> Vec<(usize, Part)> {
    let anchors = graph.nodes().len().saturating_sub(1);
    let end = |node: usize| (node.checked_sub(1), graph.scale_of(node).map(|s| anchors + s));
    parts_of(end(edge.i), end(edge.j)).into_iter().flatten().collect()
}

/// The variables of a factor between two anchors, each given as its own and its scale's variable, where they are free.
pub(super) fn parts_of(
    i: (Option<usize>, Option<usize>),
    j: (Option<usize>, Option<usize>),
) -> [Option<(usize, Part)>; 4] {
    let scales = match (i.1, j.1) {
        (Some(a), Some(b)) if a == b => [Some((a, Part::ScaleBoth)), None],
        (a, b) => [a.map(|v| (v, Part::ScaleI)), b.map(|v| (v, Part::ScaleJ))],
    };
    [i.0.map(|v| (v, Part::AnchorI)), j.0.map(|v| (v, Part::AnchorJ)), scales[0], scales[1]]
}

/// The columns of a factor's Jacobians that belong to a variable; the first [`Part::size`] count.
pub(super) fn columns(part: Part, by_i: &SMatrix<f64, 7, 7>, by_j: &SMatrix<f64, 7, 7>) -> SMatrix<f64, 7, 6> {
    let scale = |column: SMatrix<f64, 7, 1>| {
        let mut out = SMatrix::<f64, 7, 6>::zeros();
        out.set_column(0, &column);
        out
    };
    match part {
        Part::AnchorI => by_i.fixed_columns::<6>(0).into_owned(),
        Part::AnchorJ => by_j.fixed_columns::<6>(0).into_owned(),
        Part::ScaleI => scale(by_i.column(6).into_owned()),
        Part::ScaleJ => scale(by_j.column(6).into_owned()),
        Part::ScaleBoth => scale(by_i.column(6) + by_j.column(6)),
    }
}

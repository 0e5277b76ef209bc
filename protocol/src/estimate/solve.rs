//! Levenberg–Marquardt on one component: decides the most probable anchors given its factors.
//!
//! Each iteration tries the undamped Gauss–Newton step first; where that fails, damping `H + μ diag(H)` follows
//! Nielsen's rule (Madsen, Nielsen and Tingleff 2004, §3.2). The elimination order and symbolic factorisation are made
//! once. The result depends on the graph and the start alone; the start is made from the same set of facts, never from
//! an earlier estimate.

use super::graph::{Edge, Graph};
use super::sparse::{BlockPattern, Slot};
use crate::geometry::Sim3;
use crate::geometry::sim3::Vector7;
use nalgebra::SMatrix;
use std::sync::Arc;
use thiserror::Error;

/// Stop when a step promises to lower χ² by less than this share of (1 + χ²): a millionth of a standard deviation.
const DECREASE_MIN: f64 = 1e-12;
/// First damping after Gauss–Newton failed.
const DAMPING_FIRST: f64 = 1e-4;
/// Damping below this is dropped.
const DAMPING_MIN: f64 = 1e-8;
/// Damping above this means that no step helps.
const DAMPING_MAX: f64 = 1e16;

/// Why a component could not be solved.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum SolveError {
    /// The measurements leave a variable free, or are too ill-conditioned to tell.
    #[error("variable {variable} of the component is not determined by its measurements")]
    Underconstrained {
        /// Variable in canonical order (anchors without the first, then scales).
        variable: usize,
    },
    /// An intermediate number overflowed.
    #[error("numbers overflowed; check the measurements' magnitudes")]
    NotFinite,
    /// The start has another number of poses than the component has anchors.
    #[error("the start has {got} poses, the component {want} anchors")]
    Start {
        /// Anchors.
        want: usize,
        /// Poses given.
        got: usize,
    },
    /// Memory for the factorisation could not be had.
    #[error("not enough memory for the factorisation")]
    OutOfMemory,
}

/// A solved component: estimates, and the factorisation from which covariances are drawn.
#[derive(Clone, Debug)]
pub struct Solution {
    pub(super) graph: Graph,
    pub(super) values: Vec<Sim3>,
    /// Weighted sum of squared residuals at the end.
    pub chi2: f64,
    /// Residual dimensions minus variables.
    pub dof: usize,
    /// Iterations used.
    pub iterations: usize,
    /// Whether the last step was negligible (otherwise the iterations ran out).
    pub converged: bool,
    pub(super) pattern: Arc<BlockPattern>,
    pub(super) factor: Vec<f64>,
}

impl Solution {
    /// The component.
    pub fn graph(&self) -> &Graph {
        &self.graph
    }

    /// `t_world_anchor` in the order of [`Graph::nodes`]; world is the component's own, arbitrary frame.
    pub fn values(&self) -> &[Sim3] {
        &self.values
    }
}

/// Minimises the component's χ² from `start` (one `t_world_anchor` per node, in order; anchors of one frame must have
/// the same scale).
///
/// # Errors
/// [`SolveError`]; running out of iterations is no error but `converged = false`.
pub fn solve(graph: Graph, start: Vec<Sim3>, iterations_max: usize) -> Result<Solution, SolveError> {
    if start.len() != graph.nodes().len() {
        return Err(SolveError::Start { want: graph.nodes().len(), got: start.len() });
    }
    let system = System::new(&graph)?;
    let mut state = State::at(&graph, start)?;
    let mut normal = Normal::default();
    let (mut damping, mut growth) = (0.0, 2.0);
    let (mut iterations, mut converged) = (0, system.pattern.scalars() == 0);
    while !converged && iterations < iterations_max {
        iterations += 1;
        system.linearise(&graph, &state.values, &mut normal);
        loop {
            let step = system.step(&normal, damping);
            let trial =
                step.and_then(|s| Ok((s.decrease, State::at(&graph, system.retract(&graph, &state, &s.delta))?)));
            let threshold = DECREASE_MIN * (1.0 + state.chi2);
            if let Ok((promised, next)) = &trial {
                let gain = (state.chi2 - next.chi2) / promised;
                if *promised <= threshold {
                    converged = true;
                }
                if gain > 0.0 || (converged && next.chi2 <= state.chi2 + threshold) {
                    let lean = 2.0 * gain - 1.0;
                    damping *= (1.0 - lean * lean * lean).max(1.0 / 3.0);
                    growth = 2.0;
                    if damping < DAMPING_MIN {
                        damping = if gain < 0.25 { DAMPING_FIRST } else { 0.0 };
                    }
                    state = next.clone();
                    break;
                }
                if converged {
                    break;
                }
            }
            if damping > DAMPING_MAX {
                // No step lowers χ²: a stationary point, unless the system itself cannot be factorised.
                trial?;
                converged = true;
                break;
            }
            damping = if damping == 0.0 { DAMPING_FIRST } else { damping * growth };
            growth *= 2.0;
        }
    }
    system.linearise(&graph, &state.values, &mut normal);
    let mut factor = Vec::new();
    system.pattern.factorise(&normal.h, &mut factor)?;
    let residuals: usize = graph.edges().iter().map(Edge::dimension).sum();
    let dof = residuals.saturating_sub(system.pattern.scalars());
    Ok(Solution {
        graph,
        values: state.values,
        chi2: state.chi2,
        dof,
        iterations,
        converged,
        pattern: Arc::new(system.pattern),
        factor,
    })
}

/// A point and its χ².
#[derive(Clone)]
struct State {
    values: Vec<Sim3>,
    chi2: f64,
}

impl State {
    fn at(graph: &Graph, values: Vec<Sim3>) -> Result<Self, SolveError> {
        let chi2: f64 = graph.edges().iter().map(|e| e.chi2(&values)).sum();
        if chi2.is_finite() { Ok(Self { values, chi2 }) } else { Err(SolveError::NotFinite) }
    }
}

/// `H = Σ JᵀWJ` and `g = Σ JᵀWr`.
#[derive(Default)]
struct Normal {
    h: Vec<f64>,
    g: Vec<f64>,
}

struct Step {
    delta: Vec<f64>,
    /// By how much the quadratic model says that χ² falls.
    decrease: f64,
}

/// Which columns of a factor's Jacobians belong to a variable.
#[derive(Clone, Copy)]
enum Part {
    AnchorI,
    AnchorJ,
    ScaleI,
    ScaleJ,
    ScaleBoth,
}

/// Index bookkeeping: variables of the nodes, and the blocks each factor adds to.
struct System {
    pattern: BlockPattern,
    terms: Vec<Terms>,
}

struct Terms {
    parts: Vec<(usize, Part)>,
    /// Slots of the parts' pairs (p, q), p ≤ q, row by row.
    slots: Vec<Slot>,
}

impl System {
    fn new(graph: &Graph) -> Result<Self, SolveError> {
        let parts: Vec<_> = graph.edges().iter().map(|e| parts_of(graph, e)).collect();
        let mut sizes = vec![6; graph.nodes().len().saturating_sub(1)];
        sizes.resize(sizes.len() + graph.scale_count(), 1);
        let pairs = parts
            .iter()
            .flat_map(|list| list.iter().enumerate().flat_map(move |(k, a)| list[k..].iter().map(move |b| (a.0, b.0))));
        let pattern = BlockPattern::new(sizes, pairs)?;
        let terms = parts.into_iter().map(|parts| {
            let pairs = parts.iter().enumerate().flat_map(|(k, a)| parts[k..].iter().map(move |b| (a.0, b.0)));
            let slots = pairs.filter_map(|(a, b)| pattern.slot(a, b)).collect();
            Terms { slots, parts }
        });
        let terms = terms.collect();
        Ok(Self { pattern, terms })
    }

    fn linearise(&self, graph: &Graph, values: &[Sim3], normal: &mut Normal) {
        normal.h.clear();
        normal.h.resize(self.pattern.value_count(), 0.0);
        normal.g.clear();
        normal.g.resize(self.pattern.scalars(), 0.0);
        for (edge, terms) in graph.edges().iter().zip(&self.terms) {
            let at = edge.linearise(values);
            let weighted = edge.information * at.residual;
            let jacobians: Vec<SMatrix<f64, 7, 6>> =
                terms.parts.iter().map(|(_, part)| columns(*part, &at.by_i, &at.by_j)).collect();
            let mut slots = terms.slots.iter();
            for (p, (variable, part)) in terms.parts.iter().enumerate() {
                let gradient = jacobians[p].transpose() * weighted;
                let start = self.pattern.start(*variable);
                for k in 0..part.size() {
                    normal.g[start + k] += gradient[k];
                }
                let left = jacobians[p].transpose() * edge.information;
                for (q, (_, other)) in terms.parts.iter().enumerate().skip(p) {
                    let block = left * jacobians[q];
                    if let Some(&slot) = slots.next() {
                        self.pattern.add(&mut normal.h, slot, (part.size(), other.size()), |r, c| block[(r, c)]);
                    }
                }
            }
        }
    }

    /// Solves `(H + μ diag H) δ = −g`.
    fn step(&self, normal: &Normal, damping: f64) -> Result<Step, SolveError> {
        let mut h = normal.h.clone();
        let diagonal: Vec<f64> = self.pattern.diagonal().map(|at| normal.h[at]).collect();
        for (at, d) in self.pattern.diagonal().zip(&diagonal) {
            h[at] += damping * d;
        }
        let mut factor = Vec::new();
        self.pattern.factorise(&h, &mut factor)?;
        let mut delta: Vec<f64> = normal.g.iter().map(|g| -g).collect();
        self.pattern.solve(&factor, &mut delta, 1)?;
        let along_gradient: f64 = delta.iter().zip(&normal.g).map(|(x, g)| -x * g).sum();
        let damped: f64 = delta.iter().zip(&diagonal).map(|(x, d)| damping * d * x * x).sum();
        Ok(Step { delta, decrease: along_gradient + damped })
    }

    fn retract(&self, graph: &Graph, state: &State, delta: &[f64]) -> Vec<Sim3> {
        let moved = |(k, value): (usize, &Sim3)| {
            let mut xi = Vector7::zeros();
            if k > 0 {
                let start = self.pattern.start(k - 1);
                xi.as_mut_slice()[..6].copy_from_slice(&delta[start..start + 6]);
            }
            let rigid = value.retract(&xi);
            let Some(s) = graph.scale_of(k) else { return rigid };
            let grow = libm::exp(delta[self.pattern.start(graph.nodes().len() - 1 + s)]);
            Sim3::new(rigid.rotation, rigid.translation, rigid.scale * grow)
        };
        state.values.iter().enumerate().map(moved).collect()
    }
}

impl Part {
    fn size(self) -> usize {
        match self {
            Self::AnchorI | Self::AnchorJ => 6,
            Self::ScaleI | Self::ScaleJ | Self::ScaleBoth => 1,
        }
    }
}

fn parts_of(graph: &Graph, edge: &Edge) -> Vec<(usize, Part)> {
    let anchors = graph.nodes().len().saturating_sub(1);
    let mut parts = Vec::with_capacity(4);
    if edge.i > 0 {
        parts.push((edge.i - 1, Part::AnchorI));
    }
    if edge.j > 0 {
        parts.push((edge.j - 1, Part::AnchorJ));
    }
    match (graph.scale_of(edge.i), graph.scale_of(edge.j)) {
        (Some(a), Some(b)) if a == b => parts.push((anchors + a, Part::ScaleBoth)),
        (a, b) => {
            parts.extend(a.map(|s| (anchors + s, Part::ScaleI)));
            parts.extend(b.map(|s| (anchors + s, Part::ScaleJ)));
        }
    }
    parts
}

fn columns(part: Part, by_i: &SMatrix<f64, 7, 7>, by_j: &SMatrix<f64, 7, 7>) -> SMatrix<f64, 7, 6> {
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

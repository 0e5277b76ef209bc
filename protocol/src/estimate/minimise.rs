//! Levenberg–Marquardt for any sum of squares over sparse blocks: decides which steps are taken and when to stop.
//!
//! Each iteration tries the undamped step first; where that fails, damping `H + μ diag(H)` follows Nielsen's rule
//! (Madsen, Nielsen and Tingleff 2004, §3.2). The elimination order and symbolic factorisation are made once.

use super::solve::SolveError;
use super::sparse::{BlockPattern, Factor, Workspace};

/// Stop when a step promises to lower the cost by less than this share of (1 + cost): of a χ², a millionth of a
/// standard deviation.
const DECREASE_MIN: f64 = 1e-12;
/// First damping after the undamped step failed.
const DAMPING_FIRST: f64 = 1e-4;
/// Damping below this is dropped.
const DAMPING_MIN: f64 = 1e-8;
/// Damping above this means that no step helps.
const DAMPING_MAX: f64 = 1e16;

/// A sum of squares.
pub(super) trait Objective {
    /// A point.
    type Values: Clone;

    /// The blocks of `H`.
    fn pattern(&self) -> &BlockPattern;
    /// The cost at a point.
    fn cost(&self, values: &Self::Values) -> f64;
    /// `H` and `g` at a point, added to zeros.
    fn linearise(&self, values: &Self::Values, normal: &mut Normal);
    /// The point moved by `delta`.
    fn retract(&self, values: &Self::Values, delta: &[f64]) -> Self::Values;
    /// The cost below which differences are noise, as a share of one.
    fn unit(&self) -> f64 {
        1.0
    }
}

/// Half the Hessian, `H = Σ JᵀWJ`, and half the gradient, `g = Σ JᵀWr`.
#[derive(Default)]
pub(super) struct Normal {
    pub(super) h: Vec<f64>,
    pub(super) g: Vec<f64>,
    /// Memory of the damped `H` and its factor.
    damped: Vec<f64>,
    space: Workspace,
}

/// Where the minimisation ended.
pub(super) struct Minimum<V> {
    pub(super) values: V,
    pub(super) cost: f64,
    pub(super) iterations: usize,
    /// Whether the last step was negligible (otherwise the iterations ran out).
    pub(super) converged: bool,
    /// Memory of the last normal equations, to be used again.
    pub(super) normal: Normal,
}

/// Minimises from `start`.
///
/// # Errors
/// [`SolveError`]; running out of iterations is no error but `converged = false`.
pub(super) fn minimise<O: Objective>(
    objective: &O,
    start: O::Values,
    iterations_max: usize,
) -> Result<Minimum<O::Values>, SolveError> {
    let mut state = State::at(objective, start)?;
    let mut normal = Normal::default();
    let (mut damping, mut growth) = (0.0, 2.0);
    let (mut iterations, mut converged) = (0, objective.pattern().scalars() == 0);
    while !converged && iterations < iterations_max {
        iterations += 1;
        normal.at(objective, &state.values);
        loop {
            let step = normal.step(objective.pattern(), damping);
            let trial =
                step.and_then(|s| Ok((s.decrease, State::at(objective, objective.retract(&state.values, &s.delta))?)));
            let threshold = DECREASE_MIN * (objective.unit() + state.cost);
            if let Ok((promised, next)) = &trial {
                let gain = (state.cost - next.cost) / promised;
                if *promised <= threshold {
                    converged = true;
                }
                if gain > 0.0 || (converged && next.cost <= state.cost + threshold) {
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
                // No step lowers the cost: a stationary point, unless the system itself cannot be factorised.
                trial?;
                converged = true;
                break;
            }
            damping = if damping == 0.0 { DAMPING_FIRST } else { damping * growth };
            growth *= 2.0;
        }
    }
    Ok(Minimum { values: state.values, cost: state.cost, iterations, converged, normal })
}

impl Normal {
    /// The factor of `H`.
    pub(super) fn factorised(mut self, pattern: &BlockPattern) -> Result<Factor, SolveError> {
        pattern.factorise(self.h, &mut self.space)
    }

    /// `H` and `g` at a point.
    pub(super) fn at<O: Objective>(&mut self, objective: &O, values: &O::Values) {
        self.h.clear();
        self.h.resize(objective.pattern().value_count(), 0.0);
        self.g.clear();
        self.g.resize(objective.pattern().scalars(), 0.0);
        objective.linearise(values, self);
    }

    /// Solves `(H + μ diag H) δ = −g`.
    fn step(&mut self, pattern: &BlockPattern, damping: f64) -> Result<Step, SolveError> {
        let mut h = core::mem::take(&mut self.damped);
        h.clear();
        h.extend_from_slice(&self.h);
        let mut damped = Vec::new();
        if damping > 0.0 {
            damped.extend(pattern.diagonal().map(|at| damping * self.h[at]));
            pattern.diagonal().zip(&damped).for_each(|(at, d)| h[at] += d);
        }
        let factor = pattern.factorise(h, &mut self.space)?;
        let mut delta: Vec<f64> = self.g.iter().map(|g| -g).collect();
        pattern.solve(&factor, &mut delta);
        self.damped = factor.into_values();
        let along_gradient: f64 = delta.iter().zip(&self.g).map(|(x, g)| -x * g).sum();
        let damped: f64 = delta.iter().zip(&damped).map(|(x, d)| d * x * x).sum();
        Ok(Step { delta, decrease: along_gradient + damped })
    }
}

/// A point and its cost.
#[derive(Clone)]
struct State<V> {
    values: V,
    cost: f64,
}

impl<V: Clone> State<V> {
    fn at<O: Objective<Values = V>>(objective: &O, values: V) -> Result<Self, SolveError> {
        let cost = objective.cost(&values);
        if cost.is_finite() { Ok(Self { values, cost }) } else { Err(SolveError::NotFinite) }
    }
}

struct Step {
    delta: Vec<f64>,
    /// By how much the quadratic model says that the cost falls.
    decrease: f64,
}

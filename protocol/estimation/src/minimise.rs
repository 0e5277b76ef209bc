//! Levenberg–Marquardt for any sum of squares over sparse blocks: decides which steps are taken and when to stop.
//!
//! Each iteration tries the undamped step first; where that fails, damping `H + μ diag(H)` follows Nielsen's rule
//! (Madsen, Nielsen and Tingleff 2004, §3.2) until a step keeps its promise. The elimination order and symbolic
//! factorisation are made once.

use super::solve_error::SolveError;
use super::sparse::{BlockPattern, Factor, Workspace, zeroed};

/// Stop when a step promises to lower the cost by less than this share of (1 + cost), or when the next one would: of a
/// χ², a millionth of a standard deviation.
const DECREASE_MIN: f64 = 1e-12;
/// First damping after the undamped step failed.
const DAMPING_FIRST: f64 = 1e-4;
/// Damping below this is dropped.
const DAMPING_MIN: f64 = 1e-8;
/// A step that keeps less than this share of what it promises was too long.
const GAIN_POOR: f64 = 0.25;
/// One that keeps this share shows that the model holds: the next step is tried undamped. Damping that fades by
/// Nielsen's third at a time leaves a graph's weakest directions, the slow bends of long chains, to a dozen steps.
const GAIN_GOOD: f64 = 0.9;
/// The next step may promise so many times what the worse of the last two shares says of it.
const TAIL_MARGIN: f64 = 10.0;
/// Damping above this means that no step helps.
const DAMPING_MAX: f64 = 1e16;

/// A sum of squares.
pub(super) trait Objective {
    /// A point.
    type Values;

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
    /// Becomes its own factor in a step, so that no copy is made of what is the largest array there is.
    pub(super) h: Vec<f64>,
    pub(super) g: Vec<f64>,
    space: Workspace,
}

/// Where the minimisation ended.
pub(super) struct Minimum<V> {
    pub(super) values: V,
    pub(super) cost: f64,
    pub(super) iterations: usize,
    /// Whether the last step was negligible, or the next would be (otherwise the iterations ran out).
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
    let (mut trust, mut tail) = (Trust::default(), Tail::default());
    let (mut iterations, mut converged) = (0, objective.pattern().scalars() == 0);
    while !converged && iterations < iterations_max {
        iterations += 1;
        loop {
            let step = normal.step(objective, &state.values, damping);
            let trial =
                step.and_then(|s| Ok((s.decrease, State::at(objective, objective.retract(&state.values, &s.delta))?)));
            let threshold = DECREASE_MIN * (objective.unit() + state.cost);
            let failure = match trial {
                Ok((promised, next)) => {
                    let gain = (state.cost - next.cost) / promised;
                    converged = promised <= threshold;
                    if gain > 0.0 || (converged && next.cost <= state.cost + threshold) {
                        // A damped step may promise little only because it is short.
                        let left = tail.left_after(promised, gain);
                        converged |= damping == 0.0 && left <= threshold;
                        damping = trust.relaxed(damping, gain);
                        growth = 2.0;
                        state = next;
                        break;
                    }
                    if converged {
                        break;
                    }
                    None
                }
                Err(failure) => Some(failure),
            };
            if damping > DAMPING_MAX {
                // No step lowers the cost: a stationary point, unless the system itself cannot be factorised.
                failure.map_or(Ok(()), Err)?;
                converged = true;
                break;
            }
            trust.rejected();
            damping = if damping == 0.0 { DAMPING_FIRST } else { damping * growth };
            growth *= 2.0;
        }
    }
    Ok(Minimum { values: state.values, cost: state.cost, iterations, converged, normal })
}

/// What the last steps tell of the next one, which need not be taken if it will not matter: near a minimum each step
/// promises a share of what the one before did, the square of the rate at which Gauss–Newton's errors shrink.
#[derive(Default)]
struct Tail {
    promised: Option<f64>,
    share: Option<f64>,
}

impl Tail {
    /// By how much the next step may lower the cost, after one that was taken; infinite where that cannot be told.
    fn left_after(&mut self, promised: f64, gain: f64) -> f64 {
        let share = self.promised.map(|before| promised / before);
        let worst = share.zip(self.share).map(|(now, before)| now.max(before));
        (self.promised, self.share) = (Some(promised), share);
        match worst {
            Some(worst) if gain > GAIN_GOOD => TAIL_MARGIN * worst * promised,
            _ => f64::INFINITY,
        }
    }
}

/// How far undamped steps are trusted. A damped step that keeps its promise earns one, but where that one then fails,
/// damping and undamped steps could take turns for ever: from there on damping only fades.
#[derive(Default)]
struct Trust {
    /// Damping was dropped before the step under way.
    is_tested: bool,
    is_lost: bool,
}

impl Trust {
    /// The damping after a step that was taken and kept the share `gain` of its promise.
    fn relaxed(&mut self, damping: f64, gain: f64) -> f64 {
        self.is_lost |= core::mem::take(&mut self.is_tested) && gain < GAIN_POOR;
        if gain >= GAIN_GOOD && damping > 0.0 && !self.is_lost {
            self.is_tested = true;
            return 0.0;
        }
        let lean = 2.0 * gain - 1.0;
        let damping = damping * (1.0 - lean * lean * lean).max(1.0 / 3.0);
        match damping {
            _ if damping >= DAMPING_MIN => damping,
            _ if gain < GAIN_POOR => DAMPING_FIRST,
            _ => 0.0,
        }
    }

    /// To be called where a step was not taken.
    fn rejected(&mut self) {
        self.is_lost |= core::mem::take(&mut self.is_tested);
    }
}

impl Normal {
    /// The factor of `H`.
    pub(super) fn factorised(mut self, pattern: &BlockPattern) -> Result<Factor, SolveError> {
        pattern.factorise(self.h, &mut self.space)
    }

    /// `H` and `g` at a point.
    ///
    /// # Errors
    /// [`SolveError::OutOfMemory`].
    pub(super) fn at<O: Objective>(&mut self, objective: &O, values: &O::Values) -> Result<(), SolveError> {
        zeroed(&mut self.h, objective.pattern().value_count())?;
        zeroed(&mut self.g, objective.pattern().scalars())?;
        objective.linearise(values, self);
        Ok(())
    }

    /// Solves `(H + μ diag H) δ = −g` at a point.
    fn step<O: Objective>(&mut self, objective: &O, values: &O::Values, damping: f64) -> Result<Step, SolveError> {
        self.at(objective, values)?;
        let pattern = objective.pattern();
        let mut h = core::mem::take(&mut self.h);
        let mut damped = Vec::new();
        if damping > 0.0 {
            damped.extend(pattern.diagonal().map(|at| damping * h[at]));
            pattern.diagonal().zip(&damped).for_each(|(at, d)| h[at] += d);
        }
        let factor = pattern.factorise(h, &mut self.space)?;
        let mut delta: Vec<f64> = self.g.iter().map(|g| -g).collect();
        pattern.solve(&factor, &mut delta);
        self.h = factor.into_values();
        let along_gradient: f64 = delta.iter().zip(&self.g).map(|(x, g)| -x * g).sum();
        let damped: f64 = delta.iter().zip(&damped).map(|(x, d)| d * x * x).sum();
        Ok(Step { delta, decrease: along_gradient + damped })
    }
}

/// A point and its cost.
struct State<V> {
    values: V,
    cost: f64,
}

impl<V> State<V> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damping_lasts_until_a_step_keeps_its_promise() {
        let mut trust = Trust::default();
        assert_eq!(trust.relaxed(0.0, 0.2), DAMPING_FIRST);
        assert_eq!(trust.relaxed(0.0, 0.3), 0.0);
        assert_eq!(trust.relaxed(1.0, 0.5), 1.0);
        assert_eq!(trust.relaxed(1.0, 0.89), 1.0 - 0.78_f64.powi(3));
        assert_eq!(trust.relaxed(1.0, 0.9), 0.0);
        assert_eq!(trust.relaxed(0.0, 0.9), 0.0);
        assert!(!trust.is_lost);
    }

    #[test]
    fn where_an_undamped_step_fails_damping_fades_from_then_on() {
        for taken in [false, true] {
            let mut trust = Trust::default();
            assert_eq!(trust.relaxed(1.0, 1.0), 0.0);
            if taken {
                assert_eq!(trust.relaxed(0.0, 0.1), DAMPING_FIRST);
            } else {
                trust.rejected();
            }
            assert_eq!(trust.relaxed(0.3, 1.0), 0.3 / 3.0);
        }
    }

    #[test]
    fn what_is_left_is_told_by_the_worse_of_two_shares() {
        let mut tail = Tail::default();
        assert_eq!(tail.left_after(1.0, 1.0), f64::INFINITY);
        assert_eq!(tail.left_after(1e-2, 1.0), f64::INFINITY);
        assert_eq!(tail.left_after(1e-6, 1.0), TAIL_MARGIN * 1e-2 * 1e-6);
        assert_eq!(tail.left_after(1e-7, 1.0), TAIL_MARGIN * (1e-7 / 1e-6) * 1e-7);
        assert_eq!(tail.left_after(1e-9, 0.5), f64::INFINITY);
    }
}

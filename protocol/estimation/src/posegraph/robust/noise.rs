//! How much noise a graph really has: decides by which factors the standard deviations that it states are to be taken.
//!
//! Files state what a front end assumed: three times too little, or a metre and a radian where nobody knew. Gates on χ²
//! need the truth. So the scale of each of the six whitened directions is estimated from all residuals that count, each
//! against its redundancy (the share of its variance that the rest of the graph predicts; Helmert's variance
//! components), and shrunk towards what is stated where there is little to go by. Only decisions use it: the map is
//! solved with the information that the graph states.

use crate::geometry::{Covariance, Relative, se3};
use crate::graph::{Edge, Key};
use crate::solve::Solution;
use nalgebra::{Matrix6, Vector6};

/// Factors on standard deviations, at least and at most.
const FACTOR_MIN: f64 = 0.01;
const FACTOR_MAX: f64 = 10.0;
/// By how many residuals an estimate is drawn, on a log scale, towards what is known of more: the mean of all
/// directions towards what is stated, that of translations or rotations towards the mean of all, that of one direction
/// towards that.
const DRAWN_BY: f64 = 6.0;

/// Factors on the standard deviations of whitened residuals, by direction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Noise(pub(super) Vector6<f64>);

impl Noise {
    /// As stated.
    pub(super) fn stated() -> Self {
        Self(Vector6::repeat(1.0))
    }

    /// `L D² Lᵀ` for a stated covariance `L Lᵀ`.
    pub(super) fn of(&self, stated: &Covariance<6>) -> Covariance<6> {
        let Some(l) = stated.matrix().cholesky() else { return *stated };
        let scaled = l.l() * Matrix6::from_diagonal(&self.0);
        Covariance::new_or_wider(scaled * scaled.transpose())
    }

    /// All factors times another.
    pub(super) fn scaled(&self, by: f64) -> Self {
        Self((self.0 * by).map(|s| s.clamp(FACTOR_MIN, FACTOR_MAX)))
    }

    /// Whether no factor differs by more than a share.
    pub(super) fn is_near(&self, other: &Self, share: f64) -> bool {
        self.0.iter().zip(&other.0).all(|(a, b)| (a / b - 1.0).abs() <= share)
    }

    /// As one number: the root of the mean variance.
    pub(super) fn mean(&self) -> f64 {
        (self.0.norm_squared() / 6.0).sqrt()
    }
}

/// Squared whitened residuals and redundancies by direction, summed.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Tally {
    squares: Vector6<f64>,
    redundancies: Vector6<f64>,
}

impl Tally {
    /// Adds all measurements of a solved component.
    pub(super) fn add<K: Key>(&mut self, solution: &Solution<K>) {
        let inverse = solution.selected_inverse();
        for edge in solution.graph().edges() {
            let predicted = solution.covariance_along(&inverse, edge.i, edge.j);
            let predicted = predicted.map(|p| p.fixed_view::<6, 6>(0, 0).into_owned());
            if let Some((square, redundancy)) = predicted.and_then(|p| whitened(solution, edge, &p)) {
                self.squares += square;
                self.redundancies += redundancy;
            }
        }
    }

    /// The noise, given the factors under which the residuals were whitened.
    pub(super) fn noise(&self, whitened_by: &Noise) -> Noise {
        let squares = self.squares.component_mul(&whitened_by.0).component_mul(&whitened_by.0);
        let log_variance = |of: core::ops::Range<usize>, towards: f64| {
            let (square, count) = of.fold((0.0, 0.0), |(s, n), k| (s + squares[k], n + self.redundancies[k]));
            let own = libm::log((square / count.max(f64::MIN_POSITIVE)).clamp(FACTOR_MIN.powi(2), FACTOR_MAX.powi(2)));
            (count * own + DRAWN_BY * towards) / (count + DRAWN_BY)
        };
        let all = log_variance(0..6, 0.0);
        let halves = [log_variance(0..3, all), log_variance(3..6, all)];
        Noise(Vector6::from_fn(|k, _| libm::exp(0.5 * log_variance(k..k + 1, halves[k / 3]))))
    }
}

/// Squares of the whitened residual, and the share of each direction's variance that the rest predicts.
fn whitened<K: Key>(
    solution: &Solution<K>,
    edge: &Edge<K>,
    predicted: &Matrix6<f64>,
) -> Option<(Vector6<f64>, Vector6<f64>)> {
    let Relative::Metric(p) = edge.t_i_j() else { return None };
    let residual = edge.residual(solution.values()).fixed_rows::<6>(0).into_owned();
    let l = p.covariance.matrix().cholesky()?.l();
    let j = l.solve_lower_triangular(&se3::right_jacobian_inv(&residual))?;
    let share = (j * predicted * j.transpose()).diagonal();
    let residual = l.solve_lower_triangular(&residual)?;
    Some((residual.component_mul(&residual), share.map(|s| (1.0 - s).clamp(0.0, 1.0))))
}

//! How probable it is that two submaps can be aligned: what ranks candidates for the bytes and the work they cost.
//!
//! What a similarity of summaries is worth depends on the place and the sensor: of pairs of scans alike by 0.92 a tenth
//! overlapped along two streets, two fifths in a hall, all in one room. So every robot learns it from its own tries: a
//! logistic regression on the [`OverlapFeatures`] of a pair, Bayesian, one Newton step from the mean for each outcome
//! (the extended Kalman filter of a Bernoulli variable; Spiegelhalter & Lauritzen 1990), with the predictive
//! probability of MacKay 1992, `σ(μ / √(1 + π s² / 8))`. It begins from what is usual of a sensor, loosely held.

use crate::config::Sensor;
use crate::submap::{Looks, Similarity};
use nalgebra::{SMatrix, SVector};

/// Numbers that the features of a pair amount to: one, similarity, whether the place is known, distance.
const DIMENSIONS: usize = 4;
/// Standard deviations of their weights before anything was tried, but for that of the similarity, which [`Usual`] has.
const SIGMA: [f64; DIMENSIONS - 1] = [1.5, 1.5, 6.0];
/// Weights of the last two: what overlaps by the joint estimate mostly does, and less with the distance.
const NEAR: (f64, f64) = (3.5, -10.0);
/// Variance that each outcome adds, by that at the start: robots drive on into other places.
const FORGET: f64 = 1e-3;

type Vector = SVector<f64, DIMENSIONS>;
type Matrix = SMatrix<f64, DIMENSIONS, DIMENSIONS>;

/// What is known of a pair of submaps before it is tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct OverlapFeatures {
    /// Of the summaries.
    pub similarity: Similarity,
    /// By the joint estimate: distance of the anchors by that at which the submaps just touch, 0 to 1; `None` where
    /// nothing connects them.
    pub apart: Option<f64>,
}

/// What follows from it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Prediction {
    /// From this.
    pub features: OverlapFeatures,
    /// That the two can be aligned.
    pub probability: f64,
}

/// What was learned of what came of tries: what summaries of ours are worth, and what the user's own descriptors are.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct OverlapModel {
    by_summary: Regression,
    by_place: Regression,
}

/// What was learned of one kind of similarity.
#[derive(Clone, Debug, PartialEq)]
struct Regression {
    usual: Usual,
    mean: Vector,
    covariance: Matrix,
}

/// What a sensor's submaps are like, as was measured on single logs and in a hall.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Usual {
    /// Similarity of two that differ as most do.
    similarity: f64,
    /// By how much it varies.
    spread: f64,
    /// Log-odds of a try of such two.
    odds: f64,
    /// By how much these grow where two are more alike by the spread...
    slope: f64,
    /// ...and the standard deviation of that.
    sigma: f64,
}

impl Usual {
    fn of(sensor: Sensor) -> Self {
        match sensor {
            Sensor::Points3d | Sensor::Lidar3d => {
                Self { similarity: 0.88, spread: 0.05, odds: -0.2, slope: 0.7, sigma: 0.5 }
            }
            Sensor::Laser2d => Self { similarity: 0.62, spread: 0.12, odds: -2.5, slope: 1.2, sigma: 0.5 },
            Sensor::Landmarks | Sensor::Landmarks2d => {
                Self { similarity: 0.45, spread: 0.17, odds: -0.5, slope: 1.5, sigma: 0.5 }
            }
        }
    }

    /// Of vectors of an unknown model: wide, about the middle.
    fn of_places() -> Self {
        Self { similarity: 0.6, spread: 0.2, odds: -0.5, slope: 1.0, sigma: 3.0 }
    }

    fn prior(&self) -> Matrix {
        let [one, near, apart] = SIGMA;
        Matrix::from_diagonal(&Vector::from([one, self.sigma, near, apart]).map(|sigma| sigma * sigma))
    }
}

impl OverlapModel {
    /// Nothing was tried yet of what this sensor sees.
    pub fn new(sensor: Sensor) -> Self {
        Self { by_summary: Regression::new(Usual::of(sensor)), by_place: Regression::new(Usual::of_places()) }
    }

    /// How probable it is that a pair can be aligned.
    pub fn predict(&self, features: OverlapFeatures) -> Prediction {
        let regression = match features.similarity.by {
            Looks::Summary => &self.by_summary,
            Looks::Place => &self.by_place,
        };
        Prediction { features, probability: regression.probability(&features) }
    }

    /// Takes what came of a try.
    pub fn learn(&mut self, features: &OverlapFeatures, aligned: bool) {
        match features.similarity.by {
            Looks::Summary => self.by_summary.learn(features, aligned),
            Looks::Place => self.by_place.learn(features, aligned),
        }
    }
}

impl Regression {
    fn new(usual: Usual) -> Self {
        Self { usual, mean: [usual.odds, usual.slope, NEAR.0, NEAR.1].into(), covariance: usual.prior() }
    }

    fn probability(&self, features: &OverlapFeatures) -> f64 {
        let x = self.numbers(features);
        let variance = x.dot(&(self.covariance * x));
        logistic(self.mean.dot(&x) / (1.0 + core::f64::consts::PI * variance / 8.0).sqrt())
    }

    fn numbers(&self, features: &OverlapFeatures) -> Vector {
        let similarity = (features.similarity.value - self.usual.similarity) / self.usual.spread;
        Vector::from([1.0, similarity, features.apart.map_or(0.0, |_| 1.0), features.apart.unwrap_or(0.0)])
    }

    fn learn(&mut self, features: &OverlapFeatures, aligned: bool) {
        let x = self.numbers(features);
        self.covariance += self.usual.prior() * FORGET;
        let expected = logistic(self.mean.dot(&x));
        let certain = expected * (1.0 - expected);
        let along = self.covariance * x;
        let gain = along / (1.0 + certain * x.dot(&along));
        self.covariance -= gain * along.transpose() * certain;
        self.covariance = (self.covariance + self.covariance.transpose()) * 0.5;
        self.mean += gain * (f64::from(u8::from(aligned)) - expected);
    }
}

fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + libm::exp(-x))
}

#[cfg(test)]
#[path = "overlap_model_tests.rs"]
mod tests;

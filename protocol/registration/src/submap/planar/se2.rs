//! Poses in the plane, and how they are carried in space.

use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use libm::{atan2, cos, sin};
use nalgebra::{Matrix3, Matrix6, Vector2, Vector3};

/// Places of x, y and yaw in a tangent vector (ρ, φ) of SE(3).
const IN_PLANE: [usize; 3] = [0, 1, 5];

/// A motion of the plane: turns by an angle, then shifts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Se2 {
    /// rad.
    pub angle: f64,
    /// Where the origin goes.
    pub at: Vector2<f64>,
    cos: f64,
    sin: f64,
}

impl Se2 {
    /// Turns by `angle` (rad) and goes to `at`.
    pub fn new(angle: f64, at: Vector2<f64>) -> Self {
        Self { angle, at, cos: cos(angle), sin: sin(angle) }
    }

    /// What is left of a pose in space, lengths divided by `unit`.
    pub fn of(pose: &Se3, unit: f64) -> Self {
        let m = pose.rotation.matrix();
        Self::new(atan2(m[(1, 0)], m[(0, 0)]), Vector2::new(pose.translation.x, pose.translation.y) / unit)
    }

    /// The pose in space, lengths multiplied by `unit`.
    pub fn se3(&self, unit: f64) -> Se3 {
        let rotation = So3::exp(&Vector3::new(0.0, 0.0, self.angle));
        Se3::new(rotation, Vector3::new(self.at.x * unit, self.at.y * unit, 0.0))
    }

    /// A direction.
    pub fn turn(&self, v: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new(self.cos * v.x - self.sin * v.y, self.sin * v.x + self.cos * v.y)
    }

    /// A direction, back.
    pub fn turn_back(&self, v: &Vector2<f64>) -> Vector2<f64> {
        Vector2::new(self.cos * v.x + self.sin * v.y, self.cos * v.y - self.sin * v.x)
    }

    /// A place.
    pub fn apply(&self, p: &Vector2<f64>) -> Vector2<f64> {
        self.turn(p) + self.at
    }

    /// First `other`, then this.
    pub fn after(&self, other: &Self) -> Self {
        Self::new(wrapped(self.angle + other.angle), self.apply(&other.at))
    }

    /// The motion back.
    pub fn inverse(&self) -> Self {
        Self::new(wrapped(-self.angle), -self.turn_back(&self.at))
    }

    /// The pose changed by (x, y, angle) in its own axes.
    pub fn retract(&self, step: &Vector3<f64>) -> Self {
        Self::new(wrapped(self.angle + step.z), self.apply(&step.xy()))
    }

    /// (x, y, angle) of `other` in this pose's axes: what [`Se2::retract`] takes, to first order.
    pub fn local(&self, other: &Self) -> Vector3<f64> {
        let moved = self.turn_back(&(other.at - self.at));
        Vector3::new(moved.x, moved.y, wrapped(other.angle - self.angle))
    }

    /// Whether two poses place `middle` more than `distance` apart or differ by more than `angle`.
    pub fn differs(&self, other: &Self, middle: &Vector2<f64>, distance: f64, angle: f64) -> bool {
        (self.apply(middle) - other.apply(middle)).norm() > distance || wrapped(self.angle - other.angle).abs() > angle
    }
}

/// The angle in (−π, π].
pub fn wrapped(angle: f64) -> f64 {
    atan2(sin(angle), cos(angle))
}

/// The pose in space with a covariance in the plane (x, y, angle of the local perturbation) and, of the rest, the
/// standard deviations (height, tilt), both in the units of `unit` and rad.
pub fn in_space(pose: &Se2, unit: f64, covariance: &Matrix3<f64>, (height, tilt): (f64, f64)) -> PoseWithCovariance {
    let mut m = Matrix6::zeros();
    let scale = |k: usize| if k < 2 { unit } else { 1.0 };
    for (r, &row) in IN_PLANE.iter().enumerate() {
        for (c, &column) in IN_PLANE.iter().enumerate() {
            m[(row, column)] = covariance[(r, c)] * scale(r) * scale(c);
        }
    }
    (m[(2, 2)], m[(3, 3)], m[(4, 4)]) = (height * height, tilt * tilt, tilt * tilt);
    PoseWithCovariance { pose: pose.se3(unit), covariance: Covariance::new_or_wider(m) }
}

/// The part of a covariance that lies in the plane, lengths divided by `unit`.
pub fn in_plane(covariance: &Covariance<6>, unit: f64) -> Matrix3<f64> {
    let scale = |k: usize| if k < 2 { unit } else { 1.0 };
    Matrix3::from_fn(|r, c| covariance.matrix()[(IN_PLANE[r], IN_PLANE[c])] / (scale(r) * scale(c)))
}

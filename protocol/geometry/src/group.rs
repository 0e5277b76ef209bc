//! What SE(2), SE(3) and SIM(3) share, so that residuals, factors and consensus are written once for all. Tangent order and
//! perturbations as everywhere (MATH §1).

use super::{Se2, Se3, Sim3, se2, se3, sim3};
use core::fmt::Debug;
use nalgebra::{Matrix6, SMatrix, SVector};

/// A matrix Lie group of dimension `N`: the rigid motions of space, the similarities that contain them, or the motions
/// of the plane that they contain.
pub trait Group<const N: usize>: Copy + Debug + PartialEq + core::ops::Mul<Output = Self> {
    /// The identity.
    fn identity() -> Self;
    /// The inverse.
    #[must_use]
    fn inverse(&self) -> Self;
    /// exp(ξ^).
    fn exp(xi: &SVector<f64, N>) -> Self;
    /// log, |φ| ≤ π.
    fn log(&self) -> SVector<f64, N>;
    /// Ad(T).
    fn adjoint(&self) -> SMatrix<f64, N, N>;
    /// Exact J_l(ξ).
    fn left_jacobian(xi: &SVector<f64, N>) -> SMatrix<f64, N, N>;
    /// Exact J_l⁻¹(ξ).
    fn left_jacobian_inv(xi: &SVector<f64, N>) -> SMatrix<f64, N, N>;
    /// ad(ξ).
    fn ad(xi: &SVector<f64, N>) -> SMatrix<f64, N, N>;
    /// A rigid motion as an element of the group; in SE(2), what it does in the plane.
    fn embed(t: &Se3) -> Self;
    /// A covariance of a rigid motion's perturbation as one in the group: no log-scale variance, hence only
    /// semidefinite in SIM(3); the marginal in SE(2).
    fn embed_covariance(sigma: &Matrix6<f64>) -> SMatrix<f64, N, N>;

    /// Exact J_r(ξ) = J_l(−ξ).
    fn right_jacobian(xi: &SVector<f64, N>) -> SMatrix<f64, N, N> {
        Self::left_jacobian(&-xi)
    }

    /// Exact J_r⁻¹(ξ).
    fn right_jacobian_inv(xi: &SVector<f64, N>) -> SMatrix<f64, N, N> {
        Self::left_jacobian_inv(&-xi)
    }

    /// `T ⊕ δ = T exp(δ^)`.
    #[must_use]
    fn retract(&self, delta: &SVector<f64, N>) -> Self {
        *self * Self::exp(delta)
    }

    /// The δ with `self ⊕ δ = other`.
    fn local(&self, other: &Self) -> SVector<f64, N> {
        (self.inverse() * *other).log()
    }
}

macro_rules! group {
    ($group:ty, $module:ident, $dimension:literal, $embed:expr, $embed_covariance:expr) => {
        impl Group<$dimension> for $group {
            fn identity() -> Self {
                Self::identity()
            }
            fn inverse(&self) -> Self {
                self.inverse()
            }
            fn exp(xi: &SVector<f64, $dimension>) -> Self {
                Self::exp(xi)
            }
            fn log(&self) -> SVector<f64, $dimension> {
                self.log()
            }
            fn adjoint(&self) -> SMatrix<f64, $dimension, $dimension> {
                self.adjoint()
            }
            fn left_jacobian(xi: &SVector<f64, $dimension>) -> SMatrix<f64, $dimension, $dimension> {
                $module::left_jacobian(xi)
            }
            fn left_jacobian_inv(xi: &SVector<f64, $dimension>) -> SMatrix<f64, $dimension, $dimension> {
                $module::left_jacobian_inv(xi)
            }
            fn ad(xi: &SVector<f64, $dimension>) -> SMatrix<f64, $dimension, $dimension> {
                $module::ad(xi)
            }
            fn embed(t: &Se3) -> Self {
                $embed(t)
            }
            fn embed_covariance(sigma: &Matrix6<f64>) -> SMatrix<f64, $dimension, $dimension> {
                $embed_covariance(sigma)
            }
        }
    };
}

group!(Se2, se2, 3, Se2::of, se2::in_plane);
group!(Se3, se3, 6, |t: &Se3| *t, |sigma: &Matrix6<f64>| *sigma);
group!(Sim3, sim3, 7, Sim3::from_se3, |sigma: &Matrix6<f64>| {
    let mut m = sim3::Matrix7::zeros();
    m.fixed_view_mut::<6, 6>(0, 0).copy_from(sigma);
    m
});

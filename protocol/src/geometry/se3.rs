//! SE(3): rigid motions, tangent (ρ, φ), with the exact closed-form Jacobians (Barfoot's Q block).

use super::so3::{self, So3, hat};
use libm::{cos, sin};
use nalgebra::{Matrix3, Matrix4, Matrix6, Vector3, Vector6};

/// Below this angle (rad) the Q block uses its series.
const SMALL_ANGLE: f64 = 5e-2;

/// A rigid motion: `t_a_b * p_b = p_a`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Se3 {
    /// Rotation.
    pub rotation: So3,
    /// Translation, m.
    pub translation: Vector3<f64>,
}

impl Se3 {
    /// The identity.
    pub fn identity() -> Self {
        Self { rotation: So3::identity(), translation: Vector3::zeros() }
    }

    /// From its parts.
    pub fn new(rotation: So3, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// From a 4×4 homogeneous matrix (the upper-left block assumed orthonormal).
    pub fn from_matrix(m: &Matrix4<f64>) -> Self {
        Self::new(So3::from_matrix(&m.fixed_view::<3, 3>(0, 0).into_owned()), m.fixed_view::<3, 1>(0, 3).into_owned())
    }

    /// exp(ξ^), ξ = (ρ, φ).
    pub fn exp(xi: &Vector6<f64>) -> Self {
        let (rho, phi) = split(xi);
        Self::new(So3::exp(&phi), so3::left_jacobian(&phi) * rho)
    }

    /// log: ξ = (ρ, φ) with |φ| ≤ π.
    pub fn log(&self) -> Vector6<f64> {
        let phi = self.rotation.log();
        join(&(so3::left_jacobian_inv(&phi) * self.translation), &phi)
    }

    /// The inverse.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let r = self.rotation.inverse();
        Self::new(r, -(r * self.translation))
    }

    /// `T ⊕ δ = T exp(δ^)`.
    #[must_use]
    pub fn retract(&self, delta: &Vector6<f64>) -> Self {
        *self * Self::exp(delta)
    }

    /// The δ with `self ⊕ δ = other`.
    pub fn local(&self, other: &Self) -> Vector6<f64> {
        (self.inverse() * *other).log()
    }

    /// Ad(T): `T exp(ξ^) T⁻¹ = exp((Ad ξ)^)`.
    pub fn adjoint(&self) -> Matrix6<f64> {
        let r = self.rotation.matrix();
        blocks(&r, &(hat(&self.translation) * r), &r)
    }

    /// The pose a fraction `s` of the way (along the geodesic) to `other`.
    #[must_use]
    pub fn interpolate(&self, other: &Self, s: f64) -> Self {
        self.retract(&(self.local(other) * s))
    }
}

impl core::ops::Mul for Se3 {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        Self::new(self.rotation * other.rotation, self.rotation * other.translation + self.translation)
    }
}

impl core::ops::Mul<Vector3<f64>> for Se3 {
    type Output = Vector3<f64>;
    fn mul(self, p: Vector3<f64>) -> Vector3<f64> {
        self.rotation * p + self.translation
    }
}

/// Exact left Jacobian J_l(ξ).
pub fn left_jacobian(xi: &Vector6<f64>) -> Matrix6<f64> {
    let (rho, phi) = split(xi);
    let j = so3::left_jacobian(&phi);
    blocks(&j, &q_block(&rho, &phi), &j)
}

/// Exact inverse left Jacobian J_l⁻¹(ξ).
pub fn left_jacobian_inv(xi: &Vector6<f64>) -> Matrix6<f64> {
    let (rho, phi) = split(xi);
    let j = so3::left_jacobian_inv(&phi);
    blocks(&j, &(-j * q_block(&rho, &phi) * j), &j)
}

/// Exact right Jacobian J_r(ξ) = J_l(−ξ).
pub fn right_jacobian(xi: &Vector6<f64>) -> Matrix6<f64> {
    left_jacobian(&-xi)
}

/// Exact inverse right Jacobian.
pub fn right_jacobian_inv(xi: &Vector6<f64>) -> Matrix6<f64> {
    left_jacobian_inv(&-xi)
}

/// (ρ, φ) of a tangent vector.
pub fn split(xi: &Vector6<f64>) -> (Vector3<f64>, Vector3<f64>) {
    (xi.fixed_rows::<3>(0).into_owned(), xi.fixed_rows::<3>(3).into_owned())
}

/// The tangent vector (ρ, φ).
pub fn join(rho: &Vector3<f64>, phi: &Vector3<f64>) -> Vector6<f64> {
    Vector6::new(rho.x, rho.y, rho.z, phi.x, phi.y, phi.z)
}

fn blocks(a: &Matrix3<f64>, b: &Matrix3<f64>, d: &Matrix3<f64>) -> Matrix6<f64> {
    let mut m = Matrix6::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(a);
    m.fixed_view_mut::<3, 3>(0, 3).copy_from(b);
    m.fixed_view_mut::<3, 3>(3, 3).copy_from(d);
    m
}

/// The off-diagonal block of J_l (Barfoot, State Estimation for Robotics, eq. 7.86b).
fn q_block(rho: &Vector3<f64>, phi: &Vector3<f64>) -> Matrix3<f64> {
    let (p, r) = (hat(phi), hat(rho));
    let t = phi.norm();
    let t2 = t * t;
    // a = (θ − sin θ)/θ³, b = (1 − θ²/2 − cos θ)/θ⁴, c = (θ − sin θ − θ³/6)/θ⁵
    let (a, b, c) = if t < SMALL_ANGLE {
        (
            1.0 / 6.0 - t2 / 120.0 + t2 * t2 / 5040.0,
            -1.0 / 24.0 + t2 / 720.0 - t2 * t2 / 40320.0,
            -1.0 / 120.0 + t2 / 5040.0 - t2 * t2 / 362_880.0,
        )
    } else {
        let (s, co) = (sin(t), cos(t));
        ((t - s) / (t2 * t), (1.0 - 0.5 * t2 - co) / (t2 * t2), (t - s - t2 * t / 6.0) / (t2 * t2 * t))
    };
    let pr = p * r;
    let rp = r * p;
    let prp = pr * p;
    r * 0.5 + (pr + rp + prp) * a - (p * pr + rp * p - prp * 3.0) * b - (prp * p + p * prp) * (0.5 * (b - 3.0 * c))
}

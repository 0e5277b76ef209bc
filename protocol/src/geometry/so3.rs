//! SO(3): rotations as unit quaternions, exp, log, left and right Jacobians and their inverses.

use libm::{atan2, cos, sin};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

/// Below this angle (rad) the series are used instead of the closed forms.
const SMALL_ANGLE: f64 = 1e-3;

/// A rotation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct So3(UnitQuaternion<f64>);

impl So3 {
    /// The identity.
    pub fn identity() -> Self {
        Self(UnitQuaternion::identity())
    }

    /// From quaternion coefficients `[x, y, z, w]` of any length; `None` if not finite or of (nearly) zero length.
    pub fn from_xyzw([x, y, z, w]: [f64; 4]) -> Option<Self> {
        let q = Quaternion::new(w, x, y, z);
        let norm = q.norm();
        (norm.is_finite() && norm > 1e-9).then(|| Self(UnitQuaternion::new_unchecked(q / norm)))
    }

    /// Quaternion coefficients `[x, y, z, w]` with `w ≥ 0`.
    pub fn xyzw(&self) -> [f64; 4] {
        let q = self.0.quaternion();
        let sign = if q.w < 0.0 { -1.0 } else { 1.0 };
        [q.i * sign, q.j * sign, q.k * sign, q.w * sign]
    }

    /// From a rotation matrix (assumed orthonormal with determinant 1).
    pub fn from_matrix(r: &Matrix3<f64>) -> Self {
        // Shepperd's method: the largest of the four pivots keeps it exact near every half turn.
        let trace = r.trace();
        let q = if trace > r.diagonal().max() {
            [r[(2, 1)] - r[(1, 2)], r[(0, 2)] - r[(2, 0)], r[(1, 0)] - r[(0, 1)], 1.0 + trace]
        } else {
            let i = r.diagonal().imax();
            let (j, k) = ((i + 1) % 3, (i + 2) % 3);
            let mut q = [0.0; 4];
            q[i] = 1.0 + r[(i, i)] - r[(j, j)] - r[(k, k)];
            q[j] = r[(j, i)] + r[(i, j)];
            q[k] = r[(k, i)] + r[(i, k)];
            q[3] = r[(k, j)] - r[(j, k)];
            q
        };
        Self::from_xyzw(q).unwrap_or_else(Self::identity)
    }

    /// The rotation matrix.
    pub fn matrix(&self) -> Matrix3<f64> {
        self.0.to_rotation_matrix().into_inner()
    }

    /// exp(φ^), φ in rad.
    pub fn exp(phi: &Vector3<f64>) -> Self {
        let angle = phi.norm();
        let half = 0.5 * angle;
        // sin(θ/2)/θ
        let k = if angle < SMALL_ANGLE { 0.5 - angle * angle / 48.0 } else { sin(half) / angle };
        let q = Quaternion::new(cos(half), k * phi.x, k * phi.y, k * phi.z);
        Self(UnitQuaternion::new_normalize(q))
    }

    /// log: φ with |φ| ≤ π.
    pub fn log(&self) -> Vector3<f64> {
        let [x, y, z, w] = self.xyzw();
        let v = Vector3::new(x, y, z);
        let s = v.norm();
        // θ/sin(θ/2), θ = 2 atan2(s, w): exact up to and at π, since w ≥ 0.
        let k = if s < SMALL_ANGLE { 2.0 / w * (1.0 - s * s / (3.0 * w * w)) } else { 2.0 * atan2(s, w) / s };
        v * k
    }

    /// The inverse.
    #[must_use]
    pub fn inverse(&self) -> Self {
        Self(self.0.inverse())
    }

    /// Rotation angle in rad, 0 to π.
    pub fn angle(&self) -> f64 {
        self.log().norm()
    }
}

impl core::ops::Mul for So3 {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        Self(UnitQuaternion::new_normalize((self.0 * other.0).into_inner()))
    }
}

impl core::ops::Mul<Vector3<f64>> for So3 {
    type Output = Vector3<f64>;
    fn mul(self, v: Vector3<f64>) -> Vector3<f64> {
        self.0 * v
    }
}

/// The skew-symmetric matrix v^ with `v^ u = v × u`.
pub fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// Exact left Jacobian J_l(φ).
pub fn left_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    let w = hat(phi);
    let t = phi.norm();
    let (a, b) = if t < SMALL_ANGLE {
        let t2 = t * t;
        (0.5 - t2 / 24.0, 1.0 / 6.0 - t2 / 120.0)
    } else {
        let half = sin(0.5 * t);
        (2.0 * half * half / (t * t), (t - sin(t)) / (t * t * t))
    };
    Matrix3::identity() + w * a + w * w * b
}

/// Exact inverse left Jacobian J_l⁻¹(φ), |φ| < 2π.
pub fn left_jacobian_inv(phi: &Vector3<f64>) -> Matrix3<f64> {
    let w = hat(phi);
    let t = phi.norm();
    let c = if t < SMALL_ANGLE {
        1.0 / 12.0 + t * t / 720.0
    } else {
        // 1/θ² − cot(θ/2)/(2θ): finite at π, unlike the form with sin θ in the denominator.
        1.0 / (t * t) - cos(0.5 * t) / (2.0 * t * sin(0.5 * t))
    };
    Matrix3::identity() - w * 0.5 + w * w * c
}

/// Exact right Jacobian J_r(φ) = J_l(−φ).
pub fn right_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian(&-phi)
}

/// Exact inverse right Jacobian.
pub fn right_jacobian_inv(phi: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian_inv(&-phi)
}

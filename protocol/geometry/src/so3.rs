//! SO(3): rotations as unit quaternions, exp, log, left and right Jacobians and their inverses, in closed form
//! (MATH §1). Quotients such as sin(θ/2)/θ are exact for every θ but 0, so only differences that cancel get a series.

use libm::{atan2, cos, sin};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

/// Below this angle (rad) coefficients whose closed forms cancel use their series.
const SMALL_ANGLE: f64 = 0.3;

/// A rotation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct So3(UnitQuaternion<f64>);

impl So3 {
    /// The identity.
    #[inline]
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
    #[inline]
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
    #[inline]
    pub fn matrix(&self) -> Matrix3<f64> {
        self.0.to_rotation_matrix().into_inner()
    }

    /// exp(φ^), φ in rad.
    #[inline]
    pub fn exp(phi: &Vector3<f64>) -> Self {
        let angle = phi.norm();
        let half = 0.5 * angle;
        // sin(θ/2)/θ
        let k = if angle == 0.0 { 0.5 } else { sin(half) / angle };
        let q = Quaternion::new(cos(half), k * phi.x, k * phi.y, k * phi.z);
        Self(UnitQuaternion::new_normalize(q))
    }

    /// log: φ with |φ| ≤ π.
    #[inline]
    pub fn log(&self) -> Vector3<f64> {
        let [x, y, z, w] = self.xyzw();
        let v = Vector3::new(x, y, z);
        let s = v.norm();
        // θ/sin(θ/2), θ = 2 atan2(s, w): exact up to and at π, since w ≥ 0.
        let k = if s == 0.0 { 2.0 } else { 2.0 * atan2(s, w) / s };
        v * k
    }

    /// The inverse.
    #[must_use]
    #[inline]
    pub fn inverse(&self) -> Self {
        Self(self.0.inverse())
    }

    /// `R ⊕ δ = R exp(δ^)`.
    #[must_use]
    #[inline]
    pub fn retract(&self, delta: &Vector3<f64>) -> Self {
        *self * Self::exp(delta)
    }

    /// The δ with `self ⊕ δ = other`.
    #[inline]
    pub fn local(&self, other: &Self) -> Vector3<f64> {
        (self.inverse() * *other).log()
    }

    /// Ad(R) = R.
    #[inline]
    pub fn adjoint(&self) -> Matrix3<f64> {
        self.matrix()
    }

    /// The rotation a fraction `s` of the way (along the geodesic) to `other`.
    #[must_use]
    pub fn interpolate(&self, other: &Self, s: f64) -> Self {
        self.retract(&(self.local(other) * s))
    }

    /// Rotation angle in rad, 0 to π.
    #[inline]
    pub fn angle(&self) -> f64 {
        self.log().norm()
    }
}

impl core::ops::Mul for So3 {
    type Output = Self;
    #[inline]
    fn mul(self, other: Self) -> Self {
        Self(UnitQuaternion::new_normalize((self.0 * other.0).into_inner()))
    }
}

impl core::ops::Mul<Vector3<f64>> for So3 {
    type Output = Vector3<f64>;
    #[inline]
    fn mul(self, v: Vector3<f64>) -> Vector3<f64> {
        self.0 * v
    }
}

/// The skew-symmetric matrix v^ with `v^ u = v × u`.
#[inline]
pub fn hat(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// Exact left Jacobian J_l(φ).
pub fn left_jacobian(phi: &Vector3<f64>) -> Matrix3<f64> {
    let w = hat(phi);
    let t = phi.norm();
    // a = (1 − cos θ)/θ², b = (θ − sin θ)/θ³
    let (a, b) = if t < SMALL_ANGLE {
        (factorial_series(2, t * t), factorial_series(3, t * t))
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
    let t2 = t * t;
    let c = if t < SMALL_ANGLE {
        1.0 / 12.0 + t2 * (1.0 / 720.0 + t2 * (1.0 / 30_240.0 + t2 * (1.0 / 1_209_600.0 + t2 / 47_900_160.0)))
    } else {
        // 1/θ² − cot(θ/2)/(2θ): finite at π, unlike the form with sin θ in the denominator.
        1.0 / t2 - cos(0.5 * t) / (2.0 * t * sin(0.5 * t))
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

/// Σ_k (−t²)^k / (n + 2k)!, the remainder of sine or cosine from its n-th term on, over tⁿ. Exact for t² ≤ ¼.
pub(super) fn factorial_series(n: u32, t2: f64) -> f64 {
    let first: f64 = (2..=n).map(f64::from).product();
    // Horner, from the term where t² ≤ ¼ is below rounding.
    let tail = (1..=6).rev().fold(1.0, |tail, k| 1.0 - t2 / f64::from((n + 2 * k - 1) * (n + 2 * k)) * tail);
    tail / first
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::f64::consts::PI;

    #[test]
    fn logs_at_and_next_to_a_half_turn_are_exact() {
        for axis in [Vector3::x(), Vector3::y(), Vector3::z(), Vector3::new(2.0, -3.0, 6.0) / 7.0] {
            for gap in [0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3] {
                let phi = axis * (PI - gap);
                let log = So3::exp(&phi).log();
                // At the half turn itself both signs are right.
                let error = (log - phi).norm().min(if gap < 1e-14 { (log + phi).norm() } else { f64::INFINITY });
                assert!(error < 1e-14 * PI, "gap {gap}: {error:e}");
                let from_matrix = So3::from_matrix(&So3::exp(&phi).matrix());
                assert!((from_matrix.matrix() - So3::exp(&phi).matrix()).amax() < 1e-14);
            }
        }
    }

    #[test]
    fn tiny_rotations_keep_every_digit() {
        for size in [0.0, 1e-300, 1e-100, 1e-12, 1e-8, 1e-5, 1e-3, 0.1] {
            let phi = Vector3::new(2.0, -3.0, 6.0) * (size / 7.0);
            assert!((So3::exp(&phi).log() - phi).norm() <= 1e-15 * size, "{size}");
        }
    }

    #[test]
    fn the_series_meet_the_closed_forms() {
        for n in [2_u32, 3, 4, 5] {
            // At ½ the closed form loses at most three digits to cancellation.
            let t: f64 = 0.5;
            let closed = match n {
                2 => (1.0 - cos(t)) / t.powi(2),
                3 => (t - sin(t)) / t.powi(3),
                4 => (cos(t) - 1.0 + t * t / 2.0) / t.powi(4),
                _ => (sin(t) - t + t.powi(3) / 6.0) / t.powi(5),
            };
            assert!((factorial_series(n, t * t) - closed).abs() < 1e-13, "{n}");
        }
    }
}

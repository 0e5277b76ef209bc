//! SE(3): rigid motions, tangent (ρ, φ), with the exact closed-form Jacobians (Barfoot's Q block).

use super::so3::{self, So3, factorial_series, hat};
use libm::{cos, sin};
use nalgebra::{Matrix3, Matrix4, Matrix6, Vector3, Vector6};

/// Below this angle (rad) the Q block uses its series.
const SMALL_ANGLE: f64 = 0.5;

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
    #[inline]
    pub fn identity() -> Self {
        Self { rotation: So3::identity(), translation: Vector3::zeros() }
    }

    /// From its parts.
    #[inline]
    pub fn new(rotation: So3, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// From untrusted numbers: a quaternion `[x, y, z, w]` of any length but zero and a translation. `None` if any is
    /// not finite or the quaternion has no length.
    pub fn from_xyzw(xyzw: [f64; 4], translation: [f64; 3]) -> Option<Self> {
        let rotation = So3::from_xyzw(xyzw)?;
        translation.iter().all(|x| x.is_finite()).then(|| Self::new(rotation, Vector3::from(translation)))
    }

    /// The 4×4 homogeneous matrix.
    #[inline]
    pub fn matrix(&self) -> Matrix4<f64> {
        let mut m = Matrix4::identity();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.rotation.matrix());
        m.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.translation);
        m
    }

    /// From a 4×4 homogeneous matrix (the upper-left block assumed orthonormal).
    pub fn from_matrix(m: &Matrix4<f64>) -> Self {
        Self::new(So3::from_matrix(&m.fixed_view::<3, 3>(0, 0).into_owned()), m.fixed_view::<3, 1>(0, 3).into_owned())
    }

    /// exp(ξ^), ξ = (ρ, φ).
    #[inline]
    pub fn exp(xi: &Vector6<f64>) -> Self {
        let (rho, phi) = split(xi);
        Self::new(So3::exp(&phi), so3::left_jacobian(&phi) * rho)
    }

    /// log: ξ = (ρ, φ) with |φ| ≤ π.
    #[inline]
    pub fn log(&self) -> Vector6<f64> {
        let phi = self.rotation.log();
        join(&(so3::left_jacobian_inv(&phi) * self.translation), &phi)
    }

    /// The inverse.
    #[must_use]
    #[inline]
    pub fn inverse(&self) -> Self {
        let r = self.rotation.inverse();
        Self::new(r, -(r * self.translation))
    }

    /// `T ⊕ δ = T exp(δ^)`.
    #[must_use]
    #[inline]
    pub fn retract(&self, delta: &Vector6<f64>) -> Self {
        *self * Self::exp(delta)
    }

    /// The δ with `self ⊕ δ = other`.
    #[inline]
    pub fn local(&self, other: &Self) -> Vector6<f64> {
        (self.inverse() * *other).log()
    }

    /// Ad(T): `T exp(ξ^) T⁻¹ = exp((Ad ξ)^)`.
    #[inline]
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
    #[inline]
    fn mul(self, other: Self) -> Self {
        Self::new(self.rotation * other.rotation, self.rotation * other.translation + self.translation)
    }
}

impl core::ops::Mul<Vector3<f64>> for Se3 {
    type Output = Vector3<f64>;
    #[inline]
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

/// ad(ξ): [[φ^, ρ^], [0, φ^]].
pub fn ad(xi: &Vector6<f64>) -> Matrix6<f64> {
    let (rho, phi) = split(xi);
    let w = hat(&phi);
    blocks(&w, &hat(&rho), &w)
}

/// (ρ, φ) of a tangent vector.
#[inline]
pub fn split(xi: &Vector6<f64>) -> (Vector3<f64>, Vector3<f64>) {
    (xi.fixed_rows::<3>(0).into_owned(), xi.fixed_rows::<3>(3).into_owned())
}

/// The tangent vector (ρ, φ).
#[inline]
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
        (factorial_series(3, t2), -factorial_series(4, t2), -factorial_series(5, t2))
    } else {
        let (s, co) = (sin(t), cos(t));
        ((t - s) / (t2 * t), (1.0 - 0.5 * t2 - co) / (t2 * t2), (t - s - t2 * t / 6.0) / (t2 * t2 * t))
    };
    let pr = p * r;
    let rp = r * p;
    let prp = pr * p;
    r * 0.5 + (pr + rp + prp) * a - (p * pr + rp * p - prp * 3.0) * b - (prp * p + p * prp) * (0.5 * (b - 3.0 * c))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// J_l by its definition, Σ adᵏ/(k+1)!, summed until it stands still.
    fn series(xi: &Vector6<f64>) -> Matrix6<f64> {
        let (a, mut term, mut sum) = (ad(xi), Matrix6::identity(), Matrix6::identity());
        for k in 1..60 {
            term = term * a / f64::from(k + 1);
            sum += term;
        }
        sum
    }

    #[test]
    fn the_closed_form_is_the_series_at_every_angle() {
        let axis = Vector3::new(2.0, -3.0, 6.0) / 7.0;
        let rho = Vector3::new(-4.0, 5.0, 1.0);
        for theta in [0.0, 1e-9, 1e-4, 0.05, 0.3, 0.499, 0.501, 1.0, 2.0, 3.1, core::f64::consts::PI] {
            let xi = join(&rho, &(axis * theta));
            assert!((left_jacobian(&xi) - series(&xi)).amax() < 3e-14, "{theta}");
            assert!((left_jacobian(&xi) * left_jacobian_inv(&xi) - Matrix6::identity()).amax() < 3e-14, "{theta}");
        }
    }

    #[test]
    fn untrusted_parts_are_checked() {
        assert!(Se3::from_xyzw([0.0, 0.0, 0.0, -2.0], [1.0, 2.0, 3.0]).is_some());
        assert!(Se3::from_xyzw([0.0; 4], [0.0; 3]).is_none());
        assert!(Se3::from_xyzw([f64::NAN, 0.0, 0.0, 1.0], [0.0; 3]).is_none());
        assert!(Se3::from_xyzw([0.0, 0.0, 0.0, 1.0], [0.0, f64::INFINITY, 0.0]).is_none());
    }
}

//! SE(2): rigid motions of the plane, tangent (ρ, θ), with the exact closed-form Jacobians. The subgroup of SE(3) that
//! keeps z and turns about it: exp, log, Ad and Jacobians are those of [`Se3`] at the places (x, y, yaw).

use super::se3::Se3;
use super::so3::{So3, factorial_series};
use libm::{atan2, cos, sin};
use nalgebra::{Matrix2, Matrix3, Matrix6, Vector2, Vector3};

/// Places of (x, y, yaw) in a tangent vector (ρ, φ) of SE(3).
pub const IN_PLANE: [usize; 3] = [0, 1, 5];
/// Places of (z, roll, pitch).
pub const OUT_OF_PLANE: [usize; 3] = [2, 3, 4];
/// Below this angle (rad) the Jacobians use their series.
const SMALL_ANGLE: f64 = 0.5;

/// A rigid motion of the plane: `t_a_b * p_b = p_a`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Se2 {
    /// cos and sin of the angle; a unit vector.
    heading: Vector2<f64>,
    /// Translation, m.
    pub translation: Vector2<f64>,
}

impl Se2 {
    /// The identity.
    pub fn identity() -> Self {
        Self { heading: Vector2::x(), translation: Vector2::zeros() }
    }

    /// Turns by `angle`, rad, and shifts.
    pub fn new(angle: f64, translation: Vector2<f64>) -> Self {
        Self { heading: Vector2::new(cos(angle), sin(angle)), translation }
    }

    /// What a rigid motion of space does in the plane: exact where it keeps z and turns about it.
    pub fn of(t: &Se3) -> Self {
        let m = t.rotation.matrix();
        Self::new(atan2(m[(1, 0)], m[(0, 0)]), t.translation.xy())
    }

    /// The motion of space that keeps z.
    pub fn in_space(&self) -> Se3 {
        let rotation = So3::exp(&Vector3::new(0.0, 0.0, self.angle()));
        Se3::new(rotation, Vector3::new(self.translation.x, self.translation.y, 0.0))
    }

    /// The angle, rad, in (−π, π].
    pub fn angle(&self) -> f64 {
        atan2(self.heading.y, self.heading.x)
    }

    /// exp(ξ^), ξ = (ρ, θ).
    pub fn exp(xi: &Vector3<f64>) -> Self {
        Self::new(xi.z, v(xi.z) * xi.xy())
    }

    /// log: ξ = (ρ, θ) with |θ| ≤ π.
    pub fn log(&self) -> Vector3<f64> {
        let angle = self.angle();
        let rho = v_inv(angle) * self.translation;
        Vector3::new(rho.x, rho.y, angle)
    }

    /// The inverse.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let heading = Vector2::new(self.heading.x, -self.heading.y);
        Self { heading, translation: -turned(&heading, &self.translation) }
    }

    /// `T ⊕ δ = T exp(δ^)`.
    #[must_use]
    pub fn retract(&self, delta: &Vector3<f64>) -> Self {
        *self * Self::exp(delta)
    }

    /// The δ with `self ⊕ δ = other`.
    pub fn local(&self, other: &Self) -> Vector3<f64> {
        (self.inverse() * *other).log()
    }

    /// Ad(T): `T exp(ξ^) T⁻¹ = exp((Ad ξ)^)`.
    pub fn adjoint(&self) -> Matrix3<f64> {
        let (c, s, t) = (self.heading.x, self.heading.y, self.translation);
        Matrix3::new(c, -s, t.y, s, c, -t.x, 0.0, 0.0, 1.0)
    }

    fn applied_to(&self, p: &Vector2<f64>) -> Vector2<f64> {
        turned(&self.heading, p) + self.translation
    }

    /// The pose a fraction `s` of the way (along the geodesic) to `other`.
    #[must_use]
    pub fn interpolate(&self, other: &Self, s: f64) -> Self {
        self.retract(&(self.local(other) * s))
    }
}

impl core::ops::Mul for Se2 {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        // One step of Newton's keeps the product's heading a unit vector.
        let heading = turned(&self.heading, &other.heading);
        Self {
            heading: heading * (1.5 - 0.5 * heading.norm_squared()),
            translation: self.applied_to(&other.translation),
        }
    }
}

impl core::ops::Mul<Vector2<f64>> for Se2 {
    type Output = Vector2<f64>;
    fn mul(self, p: Vector2<f64>) -> Vector2<f64> {
        self.applied_to(&p)
    }
}

/// What a covariance of (ρ, φ) says of (x, y, yaw): its marginal.
pub fn in_plane(sigma: &Matrix6<f64>) -> Matrix3<f64> {
    Matrix3::from_fn(|r, c| sigma[(IN_PLANE[r], IN_PLANE[c])])
}

/// ad(ξ).
pub fn ad(xi: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -xi.z, xi.y, xi.z, 0.0, -xi.x, 0.0, 0.0, 0.0)
}

/// Exact left Jacobian J_l(ξ).
pub fn left_jacobian(xi: &Vector3<f64>) -> Matrix3<f64> {
    let (v, (a, b)) = (v(xi.z), second(xi.z));
    let of_angle = Vector2::new(a * xi.x + b * xi.y, a * xi.y - b * xi.x);
    blocks(&v, &of_angle)
}

/// Exact inverse left Jacobian J_l⁻¹(ξ).
pub fn left_jacobian_inv(xi: &Vector3<f64>) -> Matrix3<f64> {
    let (v_inv, (a, b)) = (v_inv(xi.z), second(xi.z));
    let of_angle = Vector2::new(a * xi.x + b * xi.y, a * xi.y - b * xi.x);
    blocks(&v_inv, &-(v_inv * of_angle))
}

/// Exact right Jacobian J_r(ξ) = J_l(−ξ).
pub fn right_jacobian(xi: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian(&-xi)
}

/// Exact inverse right Jacobian.
pub fn right_jacobian_inv(xi: &Vector3<f64>) -> Matrix3<f64> {
    left_jacobian_inv(&-xi)
}

/// A vector turned by a heading (cos, sin).
fn turned(heading: &Vector2<f64>, p: &Vector2<f64>) -> Vector2<f64> {
    Vector2::new(heading.x * p.x - heading.y * p.y, heading.y * p.x + heading.x * p.y)
}

/// The left Jacobian of SO(2) on ρ: ∫₀¹ R(sθ) ds.
fn v(angle: f64) -> Matrix2<f64> {
    let (a, b) = if angle.abs() < SMALL_ANGLE {
        let t2 = angle * angle;
        (1.0 - t2 * factorial_series(3, t2), angle * factorial_series(2, t2))
    } else {
        let half = sin(0.5 * angle);
        (sin(angle) / angle, 2.0 * half * half / angle)
    };
    Matrix2::new(a, -b, b, a)
}

/// Its inverse: (θ/2) cot(θ/2) on the diagonal, finite at π.
fn v_inv(angle: f64) -> Matrix2<f64> {
    let half = 0.5 * angle;
    // x cot x = cos x / (sin x / x); the quotient's series is exact to rounding where x is small.
    let sinc = if half.abs() < SMALL_ANGLE {
        let t2 = half * half;
        1.0 - t2 * factorial_series(3, t2)
    } else {
        sin(half) / half
    };
    let a = cos(half) / sinc;
    Matrix2::new(a, half, -half, a)
}

/// (θ − sin θ)/θ² and (1 − cos θ)/θ².
fn second(angle: f64) -> (f64, f64) {
    let t2 = angle * angle;
    if angle.abs() < SMALL_ANGLE {
        (angle * factorial_series(3, t2), factorial_series(2, t2))
    } else {
        let half = sin(0.5 * angle);
        ((angle - sin(angle)) / t2, 2.0 * half * half / t2)
    }
}

fn blocks(of_rho: &Matrix2<f64>, of_angle: &Vector2<f64>) -> Matrix3<f64> {
    let mut m = Matrix3::identity();
    m.fixed_view_mut::<2, 2>(0, 0).copy_from(of_rho);
    m.fixed_view_mut::<2, 1>(0, 2).copy_from(of_angle);
    m
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3;
    use core::f64::consts::PI;
    use nalgebra::Vector6;
    use proptest::prelude::*;

    fn tangent() -> impl Strategy<Value = Vector3<f64>> {
        // At the half turn itself either sign of a log is right.
        let turn = PI - 1e-3;
        ((-20.0..20.0_f64), (-20.0..20.0_f64), (-turn..turn)).prop_map(|(x, y, angle)| Vector3::new(x, y, angle))
    }

    fn in_space(xi: &Vector3<f64>) -> Vector6<f64> {
        Vector6::new(xi.x, xi.y, 0.0, 0.0, 0.0, xi.z)
    }

    proptest! {
        #[test]
        fn the_plane_is_that_of_space(a in tangent(), b in tangent()) {
            let (flat, spatial) = (Se2::exp(&a) * Se2::exp(&b).inverse(), Se3::exp(&in_space(&a)) * Se3::exp(&in_space(&b)).inverse());
            prop_assert!(flat.in_space().local(&spatial).norm() < 1e-12);
            prop_assert!(flat.local(&Se2::of(&spatial)).norm() < 1e-12);
            prop_assert!((in_space(&flat.log()) - spatial.log()).norm() < 1e-11);
            for (flat, spatial) in [
                (flat.adjoint(), spatial.adjoint()),
                (left_jacobian(&a), se3::left_jacobian(&in_space(&a))),
                (left_jacobian_inv(&a), se3::left_jacobian_inv(&in_space(&a))),
                (ad(&a), se3::ad(&in_space(&a))),
            ] {
                prop_assert!((flat - in_plane(&spatial)).amax() < 1e-11 * (1.0 + flat.amax()), "{flat} {spatial}");
                // What leaves the plane does not come back: the blocks between are zero.
                for (r, c) in IN_PLANE.into_iter().flat_map(|r| OUT_OF_PLANE.map(|c| (r, c))) {
                    prop_assert!(spatial[(r, c)].abs().max(spatial[(c, r)].abs()) < 1e-11 * (1.0 + flat.amax()));
                }
            }
        }
    }
}

//! SIM(3): similarities, tangent (ρ, φ, λ) with scale `s = e^λ`, as matrices `[sR t; 0 1]` (MATH §1).
//!
//! Every function is exact to machine precision for scales far beyond 0.05–20 and angles up to π, with no branch near
//! θ = 0 or λ = 0: `V(φ, λ) = ∫₀¹ e^{uλ} R(uφ) du = A I + B Ω + C Ω²` (the translation part of exp) is integrated by
//! Gauss–Legendre quadrature, whose error for these entire integrands is below rounding, and whose terms are all
//! positive, so that nothing cancels. `J_l = Σ adᵏ/(k+1)!` is summed for a halved argument and doubled back.

use super::se3::Se3;
use super::so3::{self, So3, hat};
use libm::{exp, log, sin};
use nalgebra::{Matrix3, Matrix4, SMatrix, SVector, Vector3};

/// Tangent vector (ρ, φ, λ).
pub type Vector7 = SVector<f64, 7>;
/// Linear map of tangent vectors.
pub type Matrix7 = SMatrix<f64, 7, 7>;

/// Smallest scale [`Sim3::from_xyzw`] accepts; the largest is its inverse.
pub const SCALE_MIN: f64 = 1e-3;

/// Terms of the Jacobian's series: 2⁻¹⁴/15! is below rounding.
const SERIES_TERMS: u32 = 14;
/// Halvings at most; reached only by arguments beyond any log.
const HALVINGS_MAX: u32 = 32;

/// A similarity `p_a = s R p_b + t`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sim3 {
    /// Rotation.
    pub rotation: So3,
    /// Translation, in units of the target frame.
    pub translation: Vector3<f64>,
    /// Scale s > 0: units of the target frame per unit of the source frame.
    pub scale: f64,
}

impl Sim3 {
    /// The identity.
    #[inline]
    pub fn identity() -> Self {
        Self::from_se3(&Se3::identity())
    }

    /// From its parts, `scale` > 0 assumed.
    #[inline]
    pub fn new(rotation: So3, translation: Vector3<f64>, scale: f64) -> Self {
        Self { rotation, translation, scale }
    }

    /// From untrusted numbers: a quaternion `[x, y, z, w]` of any length but zero, a translation and a scale. `None` if
    /// any is not finite, the quaternion has no length, or the scale is outside [[`SCALE_MIN`], 1/[`SCALE_MIN`]].
    pub fn from_xyzw(xyzw: [f64; 4], translation: [f64; 3], scale: f64) -> Option<Self> {
        let rigid = Se3::from_xyzw(xyzw, translation)?;
        (SCALE_MIN..=1.0 / SCALE_MIN).contains(&scale).then(|| Self::new(rigid.rotation, rigid.translation, scale))
    }

    /// A rigid motion as a similarity of scale 1.
    #[inline]
    pub fn from_se3(t: &Se3) -> Self {
        Self::new(t.rotation, t.translation, 1.0)
    }

    /// Rotation and translation, the scale dropped.
    #[inline]
    pub fn to_se3(&self) -> Se3 {
        Se3::new(self.rotation, self.translation)
    }

    /// The matrix `[sR t; 0 1]`.
    #[inline]
    pub fn matrix(&self) -> Matrix4<f64> {
        let mut m = Matrix4::identity();
        m.fixed_view_mut::<3, 3>(0, 0).copy_from(&(self.rotation.matrix() * self.scale));
        m.fixed_view_mut::<3, 1>(0, 3).copy_from(&self.translation);
        m
    }

    /// exp(ξ^), ξ = (ρ, φ, λ).
    #[inline]
    pub fn exp(xi: &Vector7) -> Self {
        let (rho, phi, lambda) = split(xi);
        Self::new(So3::exp(&phi), Coefficients::new(phi.norm(), lambda).v(&phi) * rho, exp(lambda))
    }

    /// log: ξ = (ρ, φ, λ) with |φ| ≤ π.
    #[inline]
    pub fn log(&self) -> Vector7 {
        let phi = self.rotation.log();
        let lambda = log(self.scale);
        join(&(Coefficients::new(phi.norm(), lambda).v_inv(&phi) * self.translation), &phi, lambda)
    }

    /// The inverse.
    #[must_use]
    #[inline]
    pub fn inverse(&self) -> Self {
        let r = self.rotation.inverse();
        Self::new(r, -(r * self.translation) / self.scale, 1.0 / self.scale)
    }

    /// `T ⊕ δ = T exp(δ^)`.
    #[must_use]
    #[inline]
    pub fn retract(&self, delta: &Vector7) -> Self {
        *self * Self::exp(delta)
    }

    /// The δ with `self ⊕ δ = other`.
    #[inline]
    pub fn local(&self, other: &Self) -> Vector7 {
        (self.inverse() * *other).log()
    }

    /// Ad(T): `T exp(ξ^) T⁻¹ = exp((Ad ξ)^)`; [[sR, t^R, −t], [0, R, 0], [0, 0, 1]].
    #[inline]
    pub fn adjoint(&self) -> Matrix7 {
        let r = self.rotation.matrix();
        blocks(&(r * self.scale), &(hat(&self.translation) * r), &-self.translation, &r, 1.0)
    }

    /// The similarity a fraction `s` of the way (along the geodesic; scale moves geometrically) to `other`.
    #[must_use]
    pub fn interpolate(&self, other: &Self, s: f64) -> Self {
        self.retract(&(self.local(other) * s))
    }
}

impl core::ops::Mul for Sim3 {
    type Output = Self;
    #[inline]
    fn mul(self, other: Self) -> Self {
        Self::new(self.rotation * other.rotation, self * other.translation, self.scale * other.scale)
    }
}

impl core::ops::Mul<Vector3<f64>> for Sim3 {
    type Output = Vector3<f64>;
    #[inline]
    fn mul(self, p: Vector3<f64>) -> Vector3<f64> {
        self.rotation * p * self.scale + self.translation
    }
}

/// Exact left Jacobian J_l(ξ) = Σ adᵏ/(k+1)! (MATH §1).
///
/// With X = ad(ξ)/2ⁿ small, the series needs few terms and cannot cancel; `J(2X) = J(X) + ½ X J(X)²` undoes each
/// halving. Only (φ, λ) decide n: ρ enters `ad` in nilpotent blocks, hence linearly, whatever its size.
pub fn left_jacobian(xi: &Vector7) -> Matrix7 {
    let (_, phi, lambda) = split(xi);
    let mut size = phi.norm() + lambda.abs();
    let mut halvings = 0;
    let mut x = ad(xi);
    while size > 0.5 && halvings < HALVINGS_MAX {
        size *= 0.5;
        x *= 0.5;
        halvings += 1;
    }
    let mut j = Matrix7::identity();
    for k in (2..=SERIES_TERMS + 1).rev() {
        j = Matrix7::identity() + x * j / f64::from(k);
    }
    for _ in 0..halvings {
        j += x * j * j * 0.5;
        x *= 2.0;
    }
    j
}

/// Exact inverse left Jacobian J_l⁻¹(ξ), |φ| < 2π: the block inverse of [`left_jacobian`].
pub fn left_jacobian_inv(xi: &Vector7) -> Matrix7 {
    let (_, phi, lambda) = split(xi);
    let j = left_jacobian(xi);
    let v_inv = Coefficients::new(phi.norm(), lambda).v_inv(&phi);
    let r_inv = so3::left_jacobian_inv(&phi);
    let q = j.fixed_view::<3, 3>(0, 3).into_owned();
    let l = j.fixed_view::<3, 1>(0, 6).into_owned();
    blocks(&v_inv, &(-v_inv * q * r_inv), &(-v_inv * l), &r_inv, 1.0)
}

/// Exact right Jacobian J_r(ξ) = J_l(−ξ).
pub fn right_jacobian(xi: &Vector7) -> Matrix7 {
    left_jacobian(&-xi)
}

/// Exact inverse right Jacobian.
pub fn right_jacobian_inv(xi: &Vector7) -> Matrix7 {
    left_jacobian_inv(&-xi)
}

/// ad(ξ): [[φ^ + λI, ρ^, −ρ], [0, φ^, 0], [0, 0, 0]].
pub fn ad(xi: &Vector7) -> Matrix7 {
    let (rho, phi, lambda) = split(xi);
    let w = hat(&phi);
    blocks(&(w + Matrix3::identity() * lambda), &hat(&rho), &-rho, &w, 0.0)
}

/// (ρ, φ, λ) of a tangent vector.
#[inline]
pub fn split(xi: &Vector7) -> (Vector3<f64>, Vector3<f64>, f64) {
    (xi.fixed_rows::<3>(0).into_owned(), xi.fixed_rows::<3>(3).into_owned(), xi[6])
}

/// The tangent vector (ρ, φ, λ).
#[inline]
pub fn join(rho: &Vector3<f64>, phi: &Vector3<f64>, lambda: f64) -> Vector7 {
    Vector7::from([rho.x, rho.y, rho.z, phi.x, phi.y, phi.z, lambda])
}

fn blocks(a: &Matrix3<f64>, b: &Matrix3<f64>, c: &Vector3<f64>, d: &Matrix3<f64>, e: f64) -> Matrix7 {
    let mut m = Matrix7::zeros();
    m.fixed_view_mut::<3, 3>(0, 0).copy_from(a);
    m.fixed_view_mut::<3, 3>(0, 3).copy_from(b);
    m.fixed_view_mut::<3, 1>(0, 6).copy_from(c);
    m.fixed_view_mut::<3, 3>(3, 3).copy_from(d);
    m[(6, 6)] = e;
    m
}

/// A, B, C of V = A I + B Ω + C Ω².
struct Coefficients {
    a: f64,
    b: f64,
    c: f64,
    theta: f64,
}

impl Coefficients {
    #[inline]
    fn new(theta: f64, lambda: f64) -> Self {
        let (mut a, mut b, mut c) = (0.0, 0.0, 0.0);
        for (high, low, weight) in GAUSS_LEGENDRE {
            for u in [high, low] {
                let e = weight * exp(u * lambda);
                // e^{uλ}, e^{uλ} sin(uθ)/θ and e^{uλ} (1 − cos uθ)/θ²
                a += e;
                b += e * u * sinc(u * theta);
                let half = u * sinc(0.5 * u * theta);
                c += 0.5 * e * half * half;
            }
        }
        Self { a, b, c, theta }
    }

    fn v(&self, phi: &Vector3<f64>) -> Matrix3<f64> {
        polynomial(phi, self.a, self.b, self.c)
    }

    /// V⁻¹, again a polynomial in Ω: its eigenvalues are 1/A on the axis and 1/(A − θ²C ± iθB) across it.
    fn v_inv(&self, phi: &Vector3<f64>) -> Matrix3<f64> {
        let p = self.a - self.theta * self.theta * self.c;
        let q = self.theta * self.b;
        let n = p * p + q * q;
        polynomial(phi, 1.0 / self.a, -self.b / n, (self.b * self.b - p * self.c) / (self.a * n))
    }
}

fn polynomial(phi: &Vector3<f64>, a: f64, b: f64, c: f64) -> Matrix3<f64> {
    let w = hat(phi);
    Matrix3::identity() * a + w * b + w * w * c
}

/// sin(x)/x; the quotient is exact for every x but 0.
fn sinc(x: f64) -> f64 {
    if x == 0.0 { 1.0 } else { sin(x) / x }
}

/// 16-point Gauss–Legendre on [0, 1]: (node, 1 − node, weight of both). For e^{uz} its relative error is about
/// 3e-55 |z|³²: below rounding up to |z| = |λ + iθ| ≈ 15, scales of e^±15.
const GAUSS_LEGENDRE: [(f64, f64, f64); 8] = [
    (0.994700467495825, 0.005299532504175033, 0.013576229705877048),
    (0.9722875115366163, 0.02771248846338371, 0.031126761969323947),
    (0.9328156011939158, 0.06718439880608412, 0.04757925584124639),
    (0.8777022041775016, 0.12229779582249849, 0.06231448562776694),
    (0.8089381222013219, 0.19106187779867811, 0.07479799440828837),
    (0.7290083888286137, 0.2709916111713863, 0.08457825969750127),
    (0.6408017753896295, 0.35919822461037054, 0.09130170752246179),
    (0.5475062549188188, 0.4524937450811813, 0.09472530522753425),
];

#[cfg(test)]
mod tests {
    use super::*;
    use crate::se3;

    #[test]
    fn scale_one_is_se3() {
        let xi = join(&Vector3::new(3.0, -1.0, 2.0), &Vector3::new(0.4, 1.1, -0.7), 0.0);
        let xi6 = xi.fixed_rows::<6>(0).into_owned();
        let (sim, rigid) = (Sim3::exp(&xi), Se3::exp(&xi6));
        assert!((sim.translation - rigid.translation).amax() < 1e-14);
        let (j7, j6) = (left_jacobian(&xi), se3::left_jacobian(&xi6));
        assert!((j7.fixed_view::<6, 6>(0, 0) - j6).amax() < 1e-14);
        let (i7, i6) = (left_jacobian_inv(&xi), se3::left_jacobian_inv(&xi6));
        assert!((i7.fixed_view::<6, 6>(0, 0) - i6).amax() < 1e-14);
    }

    #[test]
    fn two_routes_to_v_agree_in_every_corner() {
        // The quadrature and the series share nothing but the definition.
        let axis = Vector3::new(2.0, -3.0, 6.0) / 7.0;
        for theta in [0.0, 1e-12, 1e-8, 1e-4, 1e-2, 0.3, 1.0, 3.0, core::f64::consts::PI] {
            for lambda in [0.0, 1e-12, -1e-9, 1e-6, -1e-3, 0.1, -0.7, 3.0, -3.0, 6.9] {
                let phi = axis * theta;
                let k = Coefficients::new(theta, lambda);
                let (v, v_inv) = (k.v(&phi), k.v_inv(&phi));
                let j = left_jacobian(&join(&Vector3::zeros(), &phi, lambda));
                let scale = v.amax();
                assert!((j.fixed_view::<3, 3>(0, 0) - v).amax() < 2e-14 * scale, "{theta} {lambda}");
                assert!((v * v_inv - Matrix3::identity()).amax() < 1e-13, "{theta} {lambda}");
            }
        }
    }

    #[test]
    fn the_axis_coefficient_is_expm1_over_lambda() {
        for lambda in [-6.0, -0.5, -1e-5, 1e-9, 0.2, 3.0, 12.0] {
            let a = Coefficients::new(1.0, lambda).a;
            assert!((a - libm::expm1(lambda) / lambda).abs() < 4e-15 * a, "{lambda}");
        }
    }

    #[test]
    fn untrusted_parts_are_checked() {
        let q = [0.0, 0.0, 0.6, 0.8];
        assert!(Sim3::from_xyzw(q, [1.0, 2.0, 3.0], SCALE_MIN).is_some());
        assert!(Sim3::from_xyzw(q, [1.0, 2.0, 3.0], 1.0 / SCALE_MIN).is_some());
        for scale in [0.0, -1.0, SCALE_MIN * 0.999, 1.001 / SCALE_MIN, f64::NAN, f64::INFINITY] {
            assert!(Sim3::from_xyzw(q, [0.0; 3], scale).is_none(), "{scale}");
        }
        assert!(Sim3::from_xyzw([0.0; 4], [0.0; 3], 1.0).is_none());
        assert!(Sim3::from_xyzw(q, [f64::NAN, 0.0, 0.0], 1.0).is_none());
    }
}

//! Gaussians over poses: a mean on the group and a covariance of the local (right) perturbation, tangent order
//! (ρ, φ[, λ]) (MATH §1). A [`Covariance`] is finite, symmetric and positive definite by construction; first-order
//! propagation keeps it so, and where it cannot, widens: an uncertainty is never made smaller by rounding.

use super::sim3::Matrix7;
use super::{Se3, Sim3, se3, sim3};
use nalgebra::{DMatrix, Matrix6, SMatrix, SVector};
use thiserror::Error;

/// Largest asymmetry accepted, relative to the largest diagonal element.
const ASYMMETRY_MAX: f64 = 1e-6;
/// Largest variance accepted (m², rad²): beyond it "unknown" should be said otherwise.
const VARIANCE_MAX: f64 = 1e12;
/// Smallest variance accepted.
const VARIANCE_MIN: f64 = 1e-18;

/// A symmetric positive definite matrix: the covariance of a tangent vector of dimension `N`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Covariance<const N: usize>(SMatrix<f64, N, N>);

/// Why a matrix is no covariance.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum CovarianceError {
    /// An element is NaN or infinite.
    #[error("covariance holds a NaN or infinite element; send finite variances")]
    NotFinite,
    /// The matrix is not symmetric.
    #[error("covariance is not symmetric; send (P + Pᵀ)/2")]
    NotSymmetric,
    /// A diagonal element is outside the accepted range.
    #[error("covariance has a variance outside [1e-18, 1e12]; state the uncertainty in m² and rad²")]
    OutOfRange,
    /// The matrix has an eigenvalue that is not positive.
    #[error("covariance is not positive definite; every direction needs a positive variance")]
    NotPositiveDefinite,
}

impl<const N: usize> Covariance<N> {
    /// Checks and symmetrises `m`.
    ///
    /// # Errors
    /// [`CovarianceError`], naming the first check that failed.
    pub fn new(m: SMatrix<f64, N, N>) -> Result<Self, CovarianceError> {
        if m.iter().any(|x| !x.is_finite()) {
            return Err(CovarianceError::NotFinite);
        }
        if m.diagonal().iter().any(|&v| !(VARIANCE_MIN..=VARIANCE_MAX).contains(&v)) {
            return Err(CovarianceError::OutOfRange);
        }
        if (m - m.transpose()).amax() > ASYMMETRY_MAX * m.diagonal().amax() {
            return Err(CovarianceError::NotSymmetric);
        }
        let sym = (m + m.transpose()) * 0.5;
        if !is_positive_definite(&sym) {
            return Err(CovarianceError::NotPositiveDefinite);
        }
        Ok(Self(sym))
    }

    /// The covariance `m`, or where rounding or range made `m` none, a diagonal one that bounds it: N·diag(m), in
    /// range.
    ///
    /// N·diag(P) − P is positive semidefinite for every covariance P (Cauchy–Schwarz).
    #[must_use]
    pub fn new_or_wider(m: SMatrix<f64, N, N>) -> Self {
        let sym = (m + m.transpose()) * 0.5;
        Self::new(sym).unwrap_or_else(|_| {
            let variance = |v: f64| if v.is_nan() { VARIANCE_MAX } else { v.clamp(VARIANCE_MIN, VARIANCE_MAX) };
            Self(SMatrix::from_diagonal(&sym.diagonal().map(|v| variance(v * N as f64))))
        })
    }

    /// A diagonal covariance from standard deviations.
    ///
    /// # Errors
    /// As [`Covariance::new`].
    pub fn from_sigmas(sigmas: [f64; N]) -> Result<Self, CovarianceError> {
        Self::new(SMatrix::from_diagonal(&SVector::from(sigmas).map(|s| s * s)))
    }

    /// The matrix.
    pub fn matrix(&self) -> &SMatrix<f64, N, N> {
        &self.0
    }

    /// Standard deviations: the square roots of the diagonal.
    pub fn sigmas(&self) -> SVector<f64, N> {
        self.0.diagonal().map(f64::sqrt)
    }

    /// `a P aᵀ`, symmetrised.
    ///
    /// # Errors
    /// As [`Covariance::new`] (a singular or non-finite `a`).
    pub fn transported(&self, a: &SMatrix<f64, N, N>) -> Result<Self, CovarianceError> {
        let m = a * self.0 * a.transpose();
        Self::new((m + m.transpose()) * 0.5)
    }

    /// The sum of two covariances.
    #[must_use]
    pub fn plus(&self, other: &Self) -> Self {
        Self::new_or_wider(self.0 + other.0)
    }

    /// Of the covariances that share the axes along which both are diagonal, the largest that neither is smaller than:
    /// with `B = L Lᵀ` and `L⁻¹ A L⁻ᵀ = Q diag(w) Qᵀ`, `L Q diag(min(w, 1)) Qᵀ Lᵀ`. `None` where rounding leaves none.
    pub fn meet(&self, other: &Self) -> Option<SMatrix<f64, N, N>> {
        let l = other.0.cholesky()?.l();
        let half = l.solve_lower_triangular(&self.0)?;
        let whitened = l.solve_lower_triangular(&half.transpose())?;
        let symmetric = (whitened + whitened.transpose()) * 0.5;
        // Dynamic, because the eigen-solver wants a statically smaller type.
        let eigen = DMatrix::from_iterator(N, N, symmetric.iter().copied()).symmetric_eigen();
        let root = l * SMatrix::<f64, N, N>::from_iterator(eigen.eigenvectors.iter().copied());
        let smaller = |i: usize| eigen.eigenvalues[i].clamp(0.0, 1.0);
        let diagonal = SMatrix::<f64, N, N>::from_fn(|r, c| if r == c { smaller(r) } else { 0.0 });
        let sum = root * diagonal * root.transpose();
        Some((sum + sum.transpose()) * 0.5)
    }

    /// The covariance times `k` > 0, widened at the ends of the accepted range.
    #[must_use]
    pub fn scaled(&self, k: f64) -> Self {
        Self::new_or_wider(self.0 * k)
    }

    /// Squared Mahalanobis distance `eᵀ P⁻¹ e`.
    pub fn mahalanobis_squared(&self, e: &SVector<f64, N>) -> f64 {
        match self.0.cholesky() {
            Some(c) => c.solve(e).dot(e),
            None => f64::INFINITY,
        }
    }

    /// The information matrix `P⁻¹`.
    pub fn information(&self) -> SMatrix<f64, N, N> {
        self.0.cholesky().map_or_else(SMatrix::zeros, |c| c.inverse())
    }
}

impl Covariance<6> {
    /// The lower triangle, column by column: all that there is, and little more than half of the matrix.
    pub fn packed(&self) -> [f64; 21] {
        let mut out = [0.0; 21];
        let below = (0..6).flat_map(|c| (c..6).map(move |r| (r, c)));
        out.iter_mut().zip(below).for_each(|(x, at)| *x = self.0[at]);
        out
    }

    /// The covariance, to the bit, that was packed.
    pub fn unpacked(packed: &[f64; 21]) -> Self {
        let mut out = Matrix6::zeros();
        let below = (0..6).flat_map(|c| (c..6).map(move |r| (r, c)));
        packed.iter().zip(below).for_each(|(&x, (r, c))| (out[(r, c)], out[(c, r)]) = (x, x));
        Self(out)
    }
}

/// Positive definite also after scaling to unit diagonal, so that mixed units do not hide a tiny negative eigenvalue.
fn is_positive_definite<const N: usize>(m: &SMatrix<f64, N, N>) -> bool {
    let d = m.diagonal().map(|v| 1.0 / v.sqrt());
    let scaled = SMatrix::<f64, N, N>::from_fn(|r, c| m[(r, c)] * d[r] * d[c]);
    let floor = SMatrix::<f64, N, N>::identity() * 1e-12;
    (scaled - floor).cholesky().is_some() && m.cholesky().is_some()
}

/// A pose and the covariance of its local perturbation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PoseWithCovariance {
    /// The mean.
    pub pose: Se3,
    /// Covariance of δ in `pose ⊕ δ`, order (ρ, φ); m² and rad².
    pub covariance: Covariance<6>,
}

/// A similarity and the covariance of its local perturbation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimWithCovariance {
    /// The mean.
    pub sim: Sim3,
    /// Covariance of δ in `sim ⊕ δ`, order (ρ, φ, λ); units² of the source frame, rad², 1.
    pub covariance: Covariance<7>,
}

/// Standard deviation of log-scale given to a metric pose lifted to SIM(3). A metric frame's scale is exact by
/// definition, but a covariance must be positive definite: one part in a million moves a point 1 km away by 1 mm.
pub const LIFTED_LOG_SCALE_SIGMA: f64 = 1e-6;

macro_rules! gaussian_on_group {
    ($gaussian:ident, $mean:ident, $group:ty, $module:ident, $dimension:literal, $matrix:ty) => {
        impl $gaussian {
            /// From a covariance of the log coordinates ξ, T = exp(ξ^): `Σ = J_r(ξ) Σ_ξ J_r(ξ)ᵀ`.
            #[must_use]
            pub fn from_log_coordinates($mean: $group, of_log: &Covariance<$dimension>) -> Self {
                let j = $module::right_jacobian(&$mean.log());
                Self { $mean, covariance: Covariance::new_or_wider(j * of_log.matrix() * j.transpose()) }
            }

            /// The covariance of the log coordinates: `J_r⁻¹(ξ) Σ J_r⁻¹(ξ)ᵀ`.
            #[must_use]
            pub fn log_covariance(&self) -> Covariance<$dimension> {
                let j = $module::right_jacobian_inv(&self.$mean.log());
                Covariance::new_or_wider(j * self.covariance.matrix() * j.transpose())
            }

            /// From a covariance of a left perturbation, exp(δ^) T: `Σ = Ad(T⁻¹) Σ_left Ad(T⁻¹)ᵀ`.
            #[must_use]
            pub fn from_left($mean: $group, of_left: &Covariance<$dimension>) -> Self {
                let a = $mean.inverse().adjoint();
                Self { $mean, covariance: Covariance::new_or_wider(a * of_left.matrix() * a.transpose()) }
            }

            /// The covariance of the left perturbation: `Ad(T) Σ Ad(T)ᵀ`.
            #[must_use]
            pub fn left_covariance(&self) -> Covariance<$dimension> {
                let a = self.$mean.adjoint();
                Covariance::new_or_wider(a * self.covariance.matrix() * a.transpose())
            }

            /// `self ∘ other` for independent errors: `Σ = Ad(T₂⁻¹) Σ₁ Ad(T₂⁻¹)ᵀ + Σ₂`.
            #[must_use]
            pub fn compose(&self, other: &Self) -> Self {
                self.compose_correlated(other, &<$matrix>::zeros())
            }

            /// `self ∘ other` where `cross = E[δ_self δ_otherᵀ]`.
            #[must_use]
            pub fn compose_correlated(&self, other: &Self, cross: &$matrix) -> Self {
                let a = other.$mean.inverse().adjoint();
                let mixed = a * cross;
                let m = a * self.covariance.matrix() * a.transpose() + other.covariance.matrix();
                Self {
                    $mean: self.$mean * other.$mean,
                    covariance: Covariance::new_or_wider(m + mixed + mixed.transpose()),
                }
            }

            /// The inverse: `Σ' = Ad(T) Σ Ad(T)ᵀ`.
            #[must_use]
            pub fn inverse(&self) -> Self {
                Self { $mean: self.$mean.inverse(), covariance: self.left_covariance() }
            }

            /// `self⁻¹ ∘ other` for independent errors of two things in one frame: `t_a_b` of `t_f_a` and `t_f_b`.
            #[must_use]
            pub fn between(&self, other: &Self) -> Self {
                self.between_correlated(other, &<$matrix>::zeros())
            }

            /// `self⁻¹ ∘ other` where `cross = E[δ_self δ_otherᵀ]`, exact to first order:
            /// δ_ab = δ_b − Ad(T_ab⁻¹) δ_a. Correlated errors (one trajectory) largely cancel.
            #[must_use]
            pub fn between_correlated(&self, other: &Self, cross: &$matrix) -> Self {
                let t_a_b = self.$mean.inverse() * other.$mean;
                let a = t_a_b.inverse().adjoint();
                let mixed = a * cross;
                let m = a * self.covariance.matrix() * a.transpose() + other.covariance.matrix();
                Self { $mean: t_a_b, covariance: Covariance::new_or_wider(m - mixed - mixed.transpose()) }
            }

            /// Squared Mahalanobis distance of two independent measurements of one thing: e = log(T₁⁻¹ T₂),
            /// `Σ_e = J_l⁻¹(e) Σ₁ J_l⁻¹(e)ᵀ + J_r⁻¹(e) Σ₂ J_r⁻¹(e)ᵀ`. Symmetric; χ² with the dimension's degrees of
            /// freedom where both are true.
            pub fn distance_squared(&self, other: &Self) -> f64 {
                let e = self.$mean.local(&other.$mean);
                let (l, r) = ($module::left_jacobian_inv(&e), $module::right_jacobian_inv(&e));
                let m = l * self.covariance.matrix() * l.transpose() + r * other.covariance.matrix() * r.transpose();
                Covariance::new_or_wider(m).mahalanobis_squared(&e)
            }
        }
    };
}

gaussian_on_group!(PoseWithCovariance, pose, Se3, se3, 6, Matrix6<f64>);
gaussian_on_group!(SimWithCovariance, sim, Sim3, sim3, 7, Matrix7);

impl SimWithCovariance {
    /// A metric pose as a similarity of scale 1, log-scale known to [`LIFTED_LOG_SCALE_SIGMA`].
    #[must_use]
    pub fn from_metric(metric: &PoseWithCovariance) -> Self {
        let mut m = Matrix7::zeros();
        m.fixed_view_mut::<6, 6>(0, 0).copy_from(metric.covariance.matrix());
        m[(6, 6)] = LIFTED_LOG_SCALE_SIGMA * LIFTED_LOG_SCALE_SIGMA;
        Self { sim: Sim3::from_se3(&metric.pose), covariance: Covariance::new_or_wider(m) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sampling::{covariance, matrix, pose, rng, similarity};
    use nalgebra::Vector6;

    #[test]
    fn packing_keeps_every_bit() {
        let rng = &mut rng(30);
        for _ in 0..100 {
            let p: Covariance<6> = covariance(rng);
            assert_eq!(Covariance::unpacked(&p.packed()), p);
        }
    }

    /// Propagates a covariance through `f` numerically: Σ = J Σ₀ Jᵀ with J by central differences at 0.
    fn numeric<const N: usize, const M: usize>(
        f: impl Fn(&SVector<f64, N>) -> SVector<f64, M>,
        sigma: &SMatrix<f64, N, N>,
    ) -> SMatrix<f64, M, M> {
        let mut j = SMatrix::<f64, M, N>::zeros();
        for k in 0..N {
            let mut d = SVector::zeros();
            d[k] = 1e-5;
            j.set_column(k, &((f(&d) - f(&-d)) / 2e-5));
        }
        j * sigma * j.transpose()
    }

    fn assert_near<const N: usize>(a: &SMatrix<f64, N, N>, b: &SMatrix<f64, N, N>) {
        assert!((a - b).amax() < 1e-7 * b.amax(), "{a} {b}");
    }

    #[test]
    fn conventions_convert_and_convert_back() {
        let mut rng = rng(1);
        for _ in 0..20 {
            let p = PoseWithCovariance { pose: pose(&mut rng), covariance: covariance(&mut rng) };
            let xi = p.pose.log();
            let local = PoseWithCovariance::from_log_coordinates(p.pose, &p.covariance);
            assert_near(
                local.covariance.matrix(),
                &numeric(|d: &Vector6<f64>| p.pose.local(&Se3::exp(&(xi + d))), p.covariance.matrix()),
            );
            assert_near(local.log_covariance().matrix(), p.covariance.matrix());
            let left = PoseWithCovariance::from_left(p.pose, &p.covariance);
            assert_near(
                left.covariance.matrix(),
                &numeric(|d: &Vector6<f64>| p.pose.local(&(Se3::exp(d) * p.pose)), p.covariance.matrix()),
            );
            assert_near(left.left_covariance().matrix(), p.covariance.matrix());
        }
    }

    #[test]
    fn composition_and_between_keep_correlations() {
        let mut rng = rng(2);
        for _ in 0..20 {
            let (a, b) = (pose(&mut rng), pose(&mut rng));
            let joint: SMatrix<f64, 12, 12> = matrix(&mut rng);
            let block = |r, c| joint.fixed_view::<6, 6>(r, c).into_owned();
            let with = |pose, k| PoseWithCovariance { pose, covariance: Covariance::new(block(k, k)).unwrap() };
            let (pa, pb) = (with(a, 0), with(b, 6));
            let split = |d: &SVector<f64, 12>| (d.fixed_rows::<6>(0).into_owned(), d.fixed_rows::<6>(6).into_owned());
            let product = numeric(
                |d| {
                    let (da, db) = split(d);
                    (a * b).local(&(a.retract(&da) * b.retract(&db)))
                },
                &joint,
            );
            assert_near(pa.compose_correlated(&pb, &block(0, 6)).covariance.matrix(), &product);
            let between = numeric(
                |d| {
                    let (da, db) = split(d);
                    (a.inverse() * b).local(&(a.retract(&da).inverse() * b.retract(&db)))
                },
                &joint,
            );
            assert_near(pa.between_correlated(&pb, &block(0, 6)).covariance.matrix(), &between);
            assert_near(pa.between(&pb).covariance.matrix(), pa.inverse().compose(&pb).covariance.matrix());
        }
    }

    #[test]
    fn similarities_compose_and_invert() {
        let mut rng = rng(3);
        for _ in 0..20 {
            let a = SimWithCovariance { sim: similarity(&mut rng), covariance: covariance(&mut rng) };
            let b = SimWithCovariance { sim: similarity(&mut rng), covariance: covariance(&mut rng) };
            let inverse = numeric(|d| a.sim.inverse().local(&a.sim.retract(d).inverse()), a.covariance.matrix());
            assert_near(a.inverse().covariance.matrix(), &inverse);
            let ab = a.compose(&b);
            let back = ab.compose(&b.inverse());
            assert!((back.sim.local(&a.sim)).norm() < 1e-9);
            let of_a = numeric(|d| ab.sim.local(&(a.sim.retract(d) * b.sim)), a.covariance.matrix());
            assert_near(ab.covariance.matrix(), &(of_a + b.covariance.matrix()));
        }
    }

    #[test]
    fn a_repeated_measurement_is_as_far_as_its_noise_says() {
        // Mean d² of two noisy measurements of one pose is the dimension: a χ² mean over 2,000 draws has σ 0.077.
        let mut rng = rng(4);
        let (n, truth) = (2000, pose(&mut rng));
        let p: Covariance<6> = covariance(&mut rng).scaled(0.02);
        let q: Covariance<6> = covariance(&mut rng).scaled(0.01);
        let mut sum = 0.0;
        for _ in 0..n {
            let a = PoseWithCovariance { pose: truth.retract(&crate::sampling::draw(&mut rng, &p)), covariance: p };
            let b = PoseWithCovariance { pose: truth.retract(&crate::sampling::draw(&mut rng, &q)), covariance: q };
            let d2 = a.distance_squared(&b);
            assert!((d2 - b.distance_squared(&a)).abs() < 1e-9 * (1.0 + d2), "symmetric");
            sum += d2;
        }
        let mean = sum / f64::from(n);
        assert!((5.7..6.3).contains(&mean), "{mean}");
    }

    #[test]
    fn hostile_matrices_are_refused() {
        let good = SMatrix::<f64, 6, 6>::identity() * 1e-4;
        assert!(Covariance::new(good).is_ok());
        let with = |r: usize, c: usize, v: f64| {
            let mut m = good;
            m[(r, c)] = v;
            m
        };
        assert_eq!(Covariance::new(with(0, 1, f64::NAN)), Err(CovarianceError::NotFinite));
        assert_eq!(Covariance::new(with(0, 1, f64::INFINITY)), Err(CovarianceError::NotFinite));
        assert_eq!(Covariance::new(with(2, 2, -1e-4)), Err(CovarianceError::OutOfRange));
        assert_eq!(Covariance::new(with(2, 2, 0.99e-18)), Err(CovarianceError::OutOfRange));
        assert!(Covariance::new(with(2, 2, VARIANCE_MIN)).is_ok());
        assert!(Covariance::new(with(2, 2, VARIANCE_MAX)).is_ok());
        assert_eq!(Covariance::new(with(2, 2, VARIANCE_MAX * 1.01)), Err(CovarianceError::OutOfRange));
        assert_eq!(Covariance::new(with(0, 1, 5e-5)), Err(CovarianceError::NotSymmetric));
        let mut singular = with(0, 1, 1e-4);
        singular[(1, 0)] = 1e-4;
        assert_eq!(Covariance::new(singular), Err(CovarianceError::NotPositiveDefinite));
    }

    #[test]
    fn what_two_have_in_common_is_in_both() {
        let mut rng = rng(9);
        let least = |m: SMatrix<f64, 6, 6>| m.symmetric_eigenvalues().min();
        for _ in 0..50 {
            let (a, b): (Covariance<6>, Covariance<6>) = (covariance(&mut rng), covariance(&mut rng));
            let meet = a.meet(&b).unwrap();
            let slack = 1e-10 * a.matrix().amax().max(b.matrix().amax());
            assert!([a, b].iter().all(|one| least(one.matrix() - meet) > -slack));
            assert!((b.meet(&a).unwrap() - meet).amax() < slack, "in either order");
            // As large as can be: along each of the six axes it is the one or the other.
            let beyond = |one: &Covariance<6>| {
                (one.matrix() - meet).symmetric_eigenvalues().iter().filter(|&&w| w > slack).count()
            };
            assert_eq!(beyond(&a) + beyond(&b), 6);
            assert!((a.scaled(0.5).meet(&a).unwrap() - a.matrix() * 0.5).amax() < slack);
        }
    }

    #[test]
    fn a_fallback_only_widens() {
        let mut rng = rng(5);
        let p: Covariance<6> = covariance(&mut rng);
        for k in [1e-30, 1.0, 1e30] {
            let wide = p.scaled(k);
            assert!(Covariance::new(*wide.matrix()).is_ok(), "{k}");
            if k <= 1.0 {
                let gap = wide.matrix() - p.matrix() * k;
                assert!(gap.symmetric_eigenvalues().min() >= -1e-12 * wide.matrix().amax(), "{k}");
            }
        }
        let broken = SMatrix::<f64, 6, 6>::from_element(f64::NAN);
        assert_eq!(Covariance::new_or_wider(broken).matrix()[(0, 0)], VARIANCE_MAX);
    }
}

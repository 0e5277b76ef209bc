//! Gaussians over poses: a mean on the group and a covariance of the local (right) perturbation, tangent order
//! (ρ, φ[, λ]). A [`Covariance`] is finite, symmetric and positive definite by construction.

use super::{Se3, Sim3};
use nalgebra::{Matrix6, SMatrix, SVector};
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
        Self(self.0 + other.0)
    }

    /// The covariance times `k`, 0 < k, saturating at the accepted range.
    #[must_use]
    pub fn scaled(&self, k: f64) -> Self {
        Self::new(self.0 * k).unwrap_or(*self)
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

impl PoseWithCovariance {
    /// `self ∘ other` for independent errors: `Σ = Ad(T₂⁻¹) Σ₁ Ad(T₂⁻¹)ᵀ + Σ₂`.
    #[must_use]
    pub fn compose(&self, other: &Self) -> Self {
        let a = other.pose.inverse().adjoint();
        let m: Matrix6<f64> = a * self.covariance.matrix() * a.transpose() + other.covariance.matrix();
        let covariance = Covariance::new((m + m.transpose()) * 0.5).unwrap_or(other.covariance);
        Self { pose: self.pose * other.pose, covariance }
    }

    /// The inverse pose: `Σ' = Ad(T) Σ Ad(T)ᵀ`.
    #[must_use]
    pub fn inverse(&self) -> Self {
        let covariance = self.covariance.transported(&self.pose.adjoint()).unwrap_or(self.covariance);
        Self { pose: self.pose.inverse(), covariance }
    }
}

/// A similarity and the covariance of its local perturbation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SimWithCovariance {
    /// The mean.
    pub sim: Sim3,
    /// Covariance of δ in `sim ⊕ δ`, order (ρ, φ, λ).
    pub covariance: Covariance<7>,
}

/// A relative measurement or estimate between two frames or submaps: rigid where both have metric scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Relative {
    /// Both metric: SE(3).
    Metric(PoseWithCovariance),
    /// At least one of unknown scale: SIM(3).
    Similarity(SimWithCovariance),
}

impl Relative {
    /// The mean as a similarity (scale 1 where metric).
    pub fn sim(&self) -> Sim3 {
        match self {
            Self::Metric(p) => Sim3::from_se3(&p.pose),
            Self::Similarity(s) => s.sim,
        }
    }
}

//! Seeded random poses, covariances and draws, for tests and simulations.

use super::{Covariance, Se3, Sim3, se3, sim3};
use core::f64::consts::PI;
use nalgebra::{SMatrix, SVector, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

/// Random numbers that a seed tells.
pub fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Uniform in [low, high).
pub fn uniform(rng: &mut impl Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Standard normal (Box–Muller).
pub fn normal(rng: &mut impl Rng) -> f64 {
    let (u, v) = (1.0 - rng.random::<f64>(), rng.random::<f64>());
    libm::sqrt(-2.0 * libm::log(u)) * libm::cos(2.0 * PI * v)
}

/// N independent standard normal numbers.
pub fn normals<const N: usize>(rng: &mut impl Rng) -> SVector<f64, N> {
    SVector::from_fn(|_, _| normal(rng))
}

/// A pose some metres from the origin, turned by up to 3 rad about any axis.
pub fn pose(rng: &mut impl Rng) -> Se3 {
    let rho: Vector3<f64> = normals(rng) * 5.0;
    let phi: Vector3<f64> = normals(rng);
    Se3::exp(&se3::join(&rho, &(phi * (uniform(rng, 0.0, 3.0) / phi.norm()))))
}

/// As [`pose`], with a log-scale of −2 to 2.
pub fn similarity(rng: &mut impl Rng) -> Sim3 {
    let rigid = pose(rng);
    Sim3::exp(&sim3::join(&rigid.translation, &rigid.rotation.log(), uniform(rng, -2.0, 2.0)))
}

/// A well-conditioned random positive definite matrix.
pub fn matrix<const N: usize>(rng: &mut impl Rng) -> SMatrix<f64, N, N> {
    let a = SMatrix::<f64, N, N>::from_fn(|_, _| normal(rng));
    (a * a.transpose() / N as f64 + SMatrix::identity() * 0.1) * 0.01
}

#[allow(
    clippy::unwrap_used,
    reason = "a product with its transpose, and a tenth of the identity, is positive definite"
)]
/// As [`matrix`]: standard deviations of about a tenth.
pub fn covariance<const N: usize>(rng: &mut impl Rng) -> Covariance<N> {
    Covariance::new(matrix(rng)).unwrap()
}

#[allow(clippy::unwrap_used, reason = "a covariance is positive definite")]
/// A draw from N(0, Σ).
pub fn draw<const N: usize>(rng: &mut impl Rng, sigma: &Covariance<N>) -> SVector<f64, N> {
    sigma.matrix().cholesky().unwrap().l() * normals(rng)
}

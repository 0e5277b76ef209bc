//! Seeded random poses, covariances and draws for tests.

use super::{Covariance, Se3, Sim3, se3, sim3};
use core::f64::consts::PI;
use nalgebra::{SMatrix, SVector, Vector3};
use rand::{Rng, RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

pub(crate) fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// Uniform in [low, high).
pub(crate) fn uniform(rng: &mut impl Rng, low: f64, high: f64) -> f64 {
    low + (high - low) * rng.random::<f64>()
}

/// Standard normal (Box–Muller).
pub(crate) fn normal(rng: &mut impl Rng) -> f64 {
    let (u, v) = (1.0 - rng.random::<f64>(), rng.random::<f64>());
    libm::sqrt(-2.0 * libm::log(u)) * libm::cos(2.0 * PI * v)
}

pub(crate) fn normals<const N: usize>(rng: &mut impl Rng) -> SVector<f64, N> {
    SVector::from_fn(|_, _| normal(rng))
}

pub(crate) fn pose(rng: &mut impl Rng) -> Se3 {
    let rho: Vector3<f64> = normals(rng) * 5.0;
    let phi: Vector3<f64> = normals(rng);
    Se3::exp(&se3::join(&rho, &(phi * (uniform(rng, 0.0, 3.0) / phi.norm()))))
}

pub(crate) fn similarity(rng: &mut impl Rng) -> Sim3 {
    let rigid = pose(rng);
    Sim3::exp(&sim3::join(&rigid.translation, &rigid.rotation.log(), uniform(rng, -2.0, 2.0)))
}

/// A well-conditioned random positive definite matrix.
pub(crate) fn matrix<const N: usize>(rng: &mut impl Rng) -> SMatrix<f64, N, N> {
    let a = SMatrix::<f64, N, N>::from_fn(|_, _| normal(rng));
    (a * a.transpose() / N as f64 + SMatrix::identity() * 0.1) * 0.01
}

pub(crate) fn covariance<const N: usize>(rng: &mut impl Rng) -> Covariance<N> {
    Covariance::new(matrix(rng)).unwrap()
}

/// A draw from N(0, Σ).
pub(crate) fn draw<const N: usize>(rng: &mut impl Rng, sigma: &Covariance<N>) -> SVector<f64, N> {
    sigma.matrix().cholesky().unwrap().l() * normals(rng)
}

//! Compact covariances that are positive definite by construction and never optimistic.
//!
//! A covariance P is sent as a lower-triangular factor L on a lattice: `L_ij = q_ij 2^(e_i − BITS)` with integers
//! `|q_ij| ≤ 2^BITS`, `q_ii ≥ 1` and one exponent a row, so P = L Lᵀ is positive definite whatever the integers say.
//! Rounding L could make P smaller in some direction; the encoder therefore rounds the factor of `P + δ diag(P)` with
//! the smallest δ of a doubling sequence for which the result dominates P: **decoded ⪰ P**, and
//! `decoded ⪯ P + 2δ diag(P)`. Row-wise Cauchy–Schwarz bounds the δ needed by 2 N^1.5 2^−BITS: 2.8e-5 of a variance for
//! the 20 bits of facts, 3 % for the 10 bits of beacons.
//!
//! Products of such integers are exact in f64, and so is the Cholesky factorisation of a decoded matrix: what was once
//! decoded encodes to the same integers again. That makes decode ∘ encode a projection, to the bit.

use crate::geometry::{Covariance, CovarianceError};
use libm::{frexp, ldexp};
use nalgebra::SMatrix;

/// Lattice bits of covariances in facts.
pub(super) const FACT_BITS: i32 = 20;
/// Lattice bits of covariances in beacons.
pub(super) const BEACON_BITS: i32 = 10;
/// Exponents accepted: standard deviations from 1e-9 to 1e6 need −29 to 21.
const EXPONENT_MAX: i8 = 40;

/// A lower-triangular factor on the lattice; elements above the diagonal are zero.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Lattice<const N: usize> {
    /// Power of two that bounds each row.
    pub exponents: [i8; N],
    /// Integer elements, row by row.
    pub factor: [[i32; N]; N],
}

impl<const N: usize> Lattice<N> {
    /// The closest lattice factor that dominates `p`.
    ///
    /// # Errors
    /// [`CovarianceError`] if `p` lies so close to the edge of the accepted range that no lattice point inside it does.
    pub fn encode(p: &Covariance<N>, bits: i32) -> Result<Self, CovarianceError> {
        let p = p.matrix();
        let first = Self::round(p, bits)?;
        if first.matrix(bits) == *p {
            return Ok(first);
        }
        let mut delta = ldexp(1.0, -bits - 2);
        // 2^(7 − BITS) exceeds the proven bound 2 N^1.5 2^−BITS for N ≤ 7.
        for _ in 0..10 {
            let inflated = p + SMatrix::<f64, N, N>::from_diagonal(&(p.diagonal() * delta));
            let candidate = Self::round(&inflated, bits)?;
            if dominates(&candidate.matrix(bits), p) {
                candidate.decode(bits)?;
                return Ok(candidate);
            }
            delta *= 2.0;
        }
        Err(CovarianceError::NotPositiveDefinite)
    }

    /// The covariance.
    ///
    /// # Errors
    /// [`CovarianceError`] if an integer is outside the lattice, or the matrix outside the accepted range.
    pub fn decode(&self, bits: i32) -> Result<Covariance<N>, CovarianceError> {
        let bound = 1i32 << bits;
        for (r, row) in self.factor.iter().enumerate() {
            let inside = row.iter().all(|q| (-bound..=bound).contains(q));
            let lower = row[r + 1..].iter().all(|&q| q == 0);
            if !inside || !lower || row[r] < 1 || self.exponents[r].unsigned_abs() > EXPONENT_MAX.unsigned_abs() {
                return Err(CovarianceError::OutOfRange);
            }
        }
        Covariance::new(self.matrix(bits))
    }

    /// L Lᵀ, exactly: at most 7 · 2^40 in units of a power of two.
    fn matrix(&self, bits: i32) -> SMatrix<f64, N, N> {
        SMatrix::from_fn(|r, c| {
            let dot: i64 = (0..N).map(|k| i64::from(self.factor[r][k]) * i64::from(self.factor[c][k])).sum();
            ldexp(dot as f64, i32::from(self.exponents[r]) + i32::from(self.exponents[c]) - 2 * bits)
        })
    }

    /// The Cholesky factor of `p`, rounded to the lattice.
    fn round(p: &SMatrix<f64, N, N>, bits: i32) -> Result<Self, CovarianceError> {
        let l = cholesky(p).ok_or(CovarianceError::NotPositiveDefinite)?;
        let mut out = Self { exponents: [0; N], factor: [[0; N]; N] };
        for r in 0..N {
            let (_, exponent) = frexp(p[(r, r)].sqrt());
            // Rounding may carry the row's norm over its power of two; then the next one is the canonical choice.
            for exponent in [exponent, exponent + 1] {
                out.exponents[r] = i8::try_from(exponent).map_err(|_| CovarianceError::OutOfRange)?;
                for c in 0..=r {
                    out.factor[r][c] = ldexp(l[(r, c)], bits - exponent).round() as i32;
                }
                out.factor[r][r] = out.factor[r][r].max(1);
                if out.factor[r].iter().map(|&q| i64::from(q) * i64::from(q)).sum::<i64>() < 1 << (2 * bits) {
                    break;
                }
            }
        }
        Ok(out)
    }
}

/// The lower Cholesky factor, by the plain recurrence: exact where the true factor lies on the lattice.
fn cholesky<const N: usize>(p: &SMatrix<f64, N, N>) -> Option<SMatrix<f64, N, N>> {
    let mut l = SMatrix::<f64, N, N>::zeros();
    for r in 0..N {
        for c in 0..=r {
            let rest = (0..c).fold(p[(r, c)], |sum, k| sum - l[(r, k)] * l[(c, k)]);
            l[(r, c)] = if r > c { rest / l[(c, c)] } else { rest.sqrt() };
        }
        if !(l[(r, r)] > 0.0 && l[(r, r)].is_finite()) {
            return None;
        }
    }
    Some(l)
}

/// Whether `a ⪰ b`, in units of b's variances.
fn dominates<const N: usize>(a: &SMatrix<f64, N, N>, b: &SMatrix<f64, N, N>) -> bool {
    let d = b.diagonal().map(|v| 1.0 / v.sqrt());
    cholesky(&SMatrix::<f64, N, N>::from_fn(|r, c| (a[(r, c)] - b[(r, c)]) * d[r] * d[c])).is_some()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix6, SVector};
    use proptest::prelude::*;

    /// Covariances with standard deviations over many decades and correlations up to almost one.
    fn covariance<const N: usize>() -> impl Strategy<Value = Covariance<N>> {
        let basis = proptest::collection::vec(-1.0..1.0f64, N * N);
        let decades = proptest::collection::vec(-6.0..3.0f64, N);
        (basis, decades, 0.0..5.0f64).prop_filter_map("not positive definite", |(basis, decades, spread)| {
            let b = SMatrix::<f64, N, N>::from_vec(basis);
            let shape = SVector::<f64, N>::from_fn(|i, _| 10f64.powf(-spread * i as f64 / N as f64));
            let m = b * SMatrix::from_diagonal(&shape) * b.transpose();
            let d = SMatrix::from_diagonal(&SVector::<f64, N>::from_fn(|i, _| 10f64.powf(decades[i])));
            let p = d * m * d;
            Covariance::new((p + p.transpose()) * 0.5).ok()
        })
    }

    fn never_optimistic<const N: usize>(p: &Covariance<N>, bits: i32) {
        let q = Lattice::encode(p, bits).unwrap().decode(bits).unwrap();
        assert!(dominates(&(q.matrix() * (1.0 + 1e-12)), p.matrix()), "decoded does not dominate");
        let delta = 4.0 * (N as f64).powf(1.5) * ldexp(1.0, -bits);
        let diagonal = SMatrix::<f64, N, N>::from_diagonal(&(p.matrix().diagonal() * (2.0 * delta)));
        assert!(dominates(&(p.matrix() + diagonal), q.matrix()), "decoded is inflated beyond the bound");
        assert_eq!(Lattice::encode(&q, bits).unwrap().decode(bits).unwrap(), q, "not a projection");
    }

    proptest! {
        #[test]
        fn facts_are_never_optimistic(p in covariance::<6>(), q in covariance::<7>()) {
            never_optimistic(&p, FACT_BITS);
            never_optimistic(&q, FACT_BITS);
        }

        #[test]
        fn beacons_are_never_optimistic(p in covariance::<6>()) {
            never_optimistic(&p, BEACON_BITS);
        }
    }

    #[test]
    fn the_dominance_check_bites() {
        let p = Matrix6::<f64>::identity();
        assert!(dominates(&(p * 1.000_001), &p));
        assert!(!dominates(&(p * 0.999_999), &p));
    }

    #[test]
    fn integers_off_the_lattice_are_refused() {
        let good = Lattice::encode(&Covariance::<6>::from_sigmas([0.1; 6]).unwrap(), FACT_BITS).unwrap();
        assert!(good.decode(FACT_BITS).is_ok());
        let with = |change: &dyn Fn(&mut Lattice<6>)| {
            let mut bad = good;
            change(&mut bad);
            bad.decode(FACT_BITS)
        };
        assert!(with(&|l| l.factor[0][0] = 0).is_err());
        assert!(with(&|l| l.factor[0][0] = -5).is_err());
        assert!(with(&|l| l.factor[5][0] = (1 << FACT_BITS) + 1).is_err());
        assert!(with(&|l| l.factor[5][0] = i32::MIN).is_err());
        assert!(with(&|l| l.exponents[3] = EXPONENT_MAX + 1).is_err());
        assert!(with(&|l| l.exponents[3] = i8::MIN).is_err());
        assert!(with(&|l| l.factor[0][1] = 1).is_err());
        let correlated = |diagonal| {
            with(&|l| {
                l.factor[5][4] = 1 << (FACT_BITS - 1);
                l.factor[5][5] = diagonal;
            })
        };
        assert!(correlated(1000).is_ok());
        assert!(correlated(0).is_err());
    }
}

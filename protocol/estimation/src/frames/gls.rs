//! Joint generalised least squares of T_αβ over alignments that share trajectory error (MATH §3): all residuals are
//! stacked under their full covariance. *Measured* in the prototype at 10 alignments: ANEES 5.84 of 6, where summing
//! independent marginals gives 31.

use super::clique::{self, Set};
use super::measured::{Alignment, Measured};
use super::scaled::Scaled;
use crate::residual::Residual;
use libm::log;
use nalgebra::{DMatrix, Dyn, SMatrix, SVector, linalg::Cholesky};

/// Gauss–Newton steps at most; from a member's own hypothesis three or four suffice.
const ITERATIONS_MAX: usize = 10;
/// A step this small (m, rad) ends the iteration.
const STEP_MIN: f64 = 1e-10;

/// The joint estimate over one set.
pub(super) struct Gls<const N: usize, G> {
    pub(super) t_alpha_beta: G,
    /// Covariance of its local perturbation, before any scale.
    pub(super) covariance: SMatrix<f64, N, N>,
    /// χ² of the residuals.
    pub(super) chi_squared: f64,
    /// Its degrees of freedom: all values measured less those of T_αβ.
    pub(super) freedom: usize,
    /// ln √(|C| |Jᵀ C⁻¹ J|), of the residuals' covariance C: what the residuals' density and the freedom to choose T_αβ
    /// cost.
    pub(super) log_sqrt_det: f64,
    /// Each member as the others predict it, in the set's order. Empty for a single member.
    pub(super) left_out: Vec<LeftOut>,
}

/// A member of a set as all the others predict it, trajectory correlations included.
#[derive(Clone, Copy)]
pub(super) struct LeftOut {
    /// Squared Mahalanobis distance from the prediction: χ² with as many degrees of freedom as the member measures.
    pub(super) distance_squared: f64,
    /// ln √det of the prediction's covariance, the member's own included.
    pub(super) log_sqrt_det: f64,
}

impl<const N: usize, G: Scaled<N>> Gls<N, G> {
    /// χ² without a member of `dimension` values that lies `distance_squared` from what the others predict, and its
    /// degrees of freedom.
    pub(super) fn others(&self, distance_squared: f64, dimension: usize) -> (f64, f64) {
        ((self.chi_squared - distance_squared).max(0.0), self.freedom.saturating_sub(dimension) as f64)
    }

    /// Solves over `set`, starting from `t_alpha_beta`. `None` where the covariance is numerically singular
    /// or the iteration runs away.
    pub(super) fn solve(measured: &Measured<'_, N, G>, set: Set, mut t_alpha_beta: G) -> Option<Self> {
        let members: Vec<&Alignment<N, G>> = clique::vertices(set).map(|l| &measured.alignments[l]).collect();
        let mut system = System::new(measured, &members, &t_alpha_beta)?;
        for _ in 0..ITERATIONS_MAX {
            let step = system.covariance * system.gradient;
            t_alpha_beta = t_alpha_beta.retract(&-step);
            if !step.iter().all(|x| x.is_finite()) || !(1e-6..1e6).contains(&t_alpha_beta.scale()) {
                return None;
            }
            system = System::new(measured, &members, &t_alpha_beta)?;
            if step.norm() < STEP_MIN {
                break;
            }
        }
        let explained = (system.covariance * system.gradient).dot(&system.gradient);
        let left_out = if members.len() > 1 { system.left_out(members.len()) } else { Vec::new() };
        Some(Self {
            t_alpha_beta,
            covariance: system.covariance,
            chi_squared: system.h.column(0).norm_squared() - explained,
            freedom: members.iter().map(|m| m.dimension()).sum::<usize>().saturating_sub(N),
            log_sqrt_det: system.log_sqrt_det(),
            left_out,
        })
    }
}

/// The whitened linear system at one T_αβ.
struct System<const N: usize> {
    factor: Cholesky<f64, Dyn>,
    /// L⁻¹ J.
    j: DMatrix<f64>,
    /// L⁻¹ h.
    h: DMatrix<f64>,
    /// Jᵀ C⁻¹ h.
    gradient: SVector<f64, N>,
    /// (Jᵀ C⁻¹ J)⁻¹.
    covariance: SMatrix<f64, N, N>,
}

impl<const N: usize> System<N> {
    fn new<G: Scaled<N>>(
        measured: &Measured<'_, N, G>,
        members: &[&Alignment<N, G>],
        t_alpha_beta: &G,
    ) -> Option<Self> {
        let residuals: Vec<(Residual<N>, SMatrix<f64, N, N>)> = members
            .iter()
            .map(|m| {
                let (t_alpha_i, t_beta_j) = (measured.alpha.pose(m.i)?, measured.beta.pose(m.j)?);
                let (t_i_j, sigma) = m.at(t_alpha_beta.scale());
                let r = Residual::new(&G::embed(&t_alpha_i), &t_i_j, t_alpha_beta, &G::embed(&t_beta_j));
                Some((r, sigma))
            })
            .collect::<Option<_>>()?;
        let rows = N * members.len();
        let mut c = DMatrix::<f64>::zeros(rows, rows);
        let (mut j, mut h) = (DMatrix::zeros(rows, N), DMatrix::zeros(rows, 1));
        for (b, ((rb, _), mb)) in residuals.iter().zip(members).enumerate() {
            j.fixed_view_mut::<N, N>(N * b, 0).copy_from(&rb.j_alpha_beta);
            h.fixed_view_mut::<N, 1>(N * b, 0).copy_from(&rb.h);
            // The factorisation reads the lower triangle only.
            for (a, ((ra, sigma), ma)) in residuals.iter().zip(members).enumerate().skip(b) {
                let of_alpha = G::embed_covariance(&measured.alpha.cross_covariance(ma.i, mb.i)?);
                let of_beta = G::embed_covariance(&measured.beta.cross_covariance(ma.j, mb.j)?);
                let mut block = ra.j_i * of_alpha * rb.j_i.transpose() + ra.j_j * of_beta * rb.j_j.transpose();
                if a == b {
                    block += ra.j_ij * sigma * ra.j_ij.transpose();
                }
                c.fixed_view_mut::<N, N>(N * a, N * b).copy_from(&block);
            }
        }
        let factor = c.cholesky()?;
        (factor.l_dirty().solve_lower_triangular_mut(&mut j) && factor.l_dirty().solve_lower_triangular_mut(&mut h))
            .then_some(())?;
        // Column dots, not a matrix product: the latter's order of summation depends on the processor.
        let information = SMatrix::<f64, N, N>::from_fn(|r, c| j.column(r).dot(&j.column(c)));
        let gradient = SVector::<f64, N>::from_fn(|r, _| j.column(r).dot(&h.column(0)));
        let covariance = information.cholesky()?.inverse();
        Some(Self { factor, j, h, gradient, covariance })
    }

    /// ln √(|C| |Jᵀ C⁻¹ J|).
    fn log_sqrt_det(&self) -> f64 {
        let of_c: f64 = self.factor.l_dirty().diagonal().iter().map(|&x| log(x)).sum();
        let of_covariance = self.covariance.cholesky().map(|f| f.l_dirty().diagonal().iter().map(|&x| log(x)).sum());
        of_c - of_covariance.unwrap_or(f64::NEG_INFINITY)
    }

    /// With the projected information P = C⁻¹ − C⁻¹J (JᵀC⁻¹J)⁻¹ JᵀC⁻¹, member l's prediction by the others is off by
    /// P_ll⁻¹ (P h)_l with covariance P_ll⁻¹, so d² = (P h)_lᵀ P_ll⁻¹ (P h)_l: one factorisation serves all.
    fn left_out(&self, members: usize) -> Vec<LeftOut> {
        let rows = N * members;
        let mut l_inv = DMatrix::<f64>::identity(rows, rows);
        if !self.factor.l_dirty().solve_lower_triangular_mut(&mut l_inv) {
            return vec![LeftOut { distance_squared: f64::INFINITY, log_sqrt_det: f64::INFINITY }; members];
        }
        // L⁻¹ (h − J x̂)
        let fit = self.covariance * self.gradient;
        let mut unexplained = self.h.column(0).clone_owned();
        for k in 0..N {
            unexplained.axpy(-fit[k], &self.j.column(k), 1.0);
        }
        (0..members)
            .map(|l| {
                let column = |k: usize| l_inv.column(N * l + k);
                let of_j = SMatrix::<f64, N, N>::from_fn(|r, c| column(r).dot(&self.j.column(c)));
                let c_inv = SMatrix::<f64, N, N>::from_fn(|r, c| column(r).dot(&column(c)));
                let p = c_inv - of_j * self.covariance * of_j.transpose();
                let p_h = SVector::<f64, N>::from_fn(|r, _| column(r).dot(&unexplained));
                p.cholesky().map_or(LeftOut { distance_squared: f64::INFINITY, log_sqrt_det: f64::INFINITY }, |f| {
                    LeftOut {
                        distance_squared: f.solve(&p_h).dot(&p_h),
                        log_sqrt_det: -f.l_dirty().diagonal().iter().map(|&x| log(x)).sum::<f64>(),
                    }
                })
            })
            .collect()
    }
}

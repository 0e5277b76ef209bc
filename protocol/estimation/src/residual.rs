//! The residual of one inter-robot alignment, h = log((T_i T_ij)⁻¹ T_αβ T_j)^∨ (S(6), MATH §2), its exact Jacobians in
//! local perturbations, and its covariance (MATH §3). The same form compares two alignments with each other: see
//! [`super::frames`]. The source's own log-coordinate Jacobians are in [`source_forms`].

pub mod source_forms;

use crate::geometry::Group;
use nalgebra::{SMatrix, SVector};

/// h and its exact Jacobians with respect to local perturbations of the four poses.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Residual<const N: usize> {
    /// The residual, tangent order (ρ, φ[, λ]), in units of submap j.
    pub h: SVector<f64, N>,
    /// ∂h/∂T_i = −J_l⁻¹(h) Ad(T_ij⁻¹).
    pub j_i: SMatrix<f64, N, N>,
    /// ∂h/∂T_j = J_r⁻¹(h).
    pub j_j: SMatrix<f64, N, N>,
    /// ∂h/∂T_ij = −J_l⁻¹(h).
    pub j_ij: SMatrix<f64, N, N>,
    /// ∂h/∂T_αβ = J_r⁻¹(h) Ad(T_j⁻¹); absent in the source.
    pub j_alpha_beta: SMatrix<f64, N, N>,
}

/// h = log((T_i T_ij)⁻¹ T_αβ T_j): S(6) with the logarithm its print lacks. Zero where the alignment `t_i_j` says
/// exactly what the anchors and `t_alpha_beta` say.
pub fn residual<const N: usize, G: Group<N>>(
    t_alpha_i: &G,
    t_i_j: &G,
    t_alpha_beta: &G,
    t_beta_j: &G,
) -> SVector<f64, N> {
    ((*t_alpha_i * *t_i_j).inverse() * *t_alpha_beta * *t_beta_j).log()
}

impl<const N: usize> Residual<N> {
    /// h and its Jacobians at the given poses. Exact but at |φ| = π, where log is not differentiable.
    pub fn new<G: Group<N>>(t_alpha_i: &G, t_i_j: &G, t_alpha_beta: &G, t_beta_j: &G) -> Self {
        let h = residual(t_alpha_i, t_i_j, t_alpha_beta, t_beta_j);
        let (left, right) = (G::left_jacobian_inv(&h), G::right_jacobian_inv(&h));
        Self {
            h,
            j_i: -left * t_i_j.inverse().adjoint(),
            j_j: right,
            j_ij: -left,
            j_alpha_beta: right * t_beta_j.inverse().adjoint(),
        }
    }

    /// Σ_h = J_i Σ_i J_iᵀ + J_j Σ_j J_jᵀ + J_ij Σ_ij J_ijᵀ for independent trajectories: right for a single alignment
    /// only, since several share trajectory error (MATH §3).
    pub fn covariance(
        &self,
        sigma_i: &SMatrix<f64, N, N>,
        sigma_j: &SMatrix<f64, N, N>,
        sigma_ij: &SMatrix<f64, N, N>,
    ) -> SMatrix<f64, N, N> {
        self.j_i * sigma_i * self.j_i.transpose()
            + self.j_j * sigma_j * self.j_j.transpose()
            + self.j_ij * sigma_ij * self.j_ij.transpose()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sampling::{normals, pose, rng, similarity};
    use crate::geometry::{Covariance, Se3, Sim3};

    /// Draws four poses whose residual has about the size `h`.
    fn poses<const N: usize, G: Group<N>>(mut pose: impl FnMut() -> G, h: SVector<f64, N>) -> [G; 4] {
        let (t_alpha_i, t_i_j, t_beta_j) = (pose(), pose(), pose());
        [t_alpha_i, t_i_j, t_alpha_i * t_i_j * G::exp(&h) * t_beta_j.inverse(), t_beta_j]
    }

    /// Relative error of each Jacobian against fourth-order central differences.
    fn errors<const N: usize, G: Group<N>>(p: [G; 4]) -> [f64; 4] {
        let exact = Residual::new(&p[0], &p[1], &p[2], &p[3]);
        let jacobians = [exact.j_i, exact.j_ij, exact.j_alpha_beta, exact.j_j];
        core::array::from_fn(|which| {
            let at = |k: usize, step: f64| {
                let mut moved = p;
                let mut delta = SVector::<f64, N>::zeros();
                delta[k] = step;
                moved[which] = p[which].retract(&delta);
                residual(&moved[0], &moved[1], &moved[2], &moved[3])
            };
            let e = 1e-4;
            let mut numeric = SMatrix::<f64, N, N>::zeros();
            for k in 0..N {
                let column = (at(k, e) - at(k, -e)) * 8.0 - (at(k, 2.0 * e) - at(k, -2.0 * e));
                numeric.set_column(k, &(column / (12.0 * e)));
            }
            (numeric - jacobians[which]).norm() / numeric.norm()
        })
    }

    #[test]
    fn the_jacobians_are_exact_in_se3() {
        let mut rng = rng(21);
        for size in [0.0, 1e-6, 0.01, 0.3, 1.0] {
            for _ in 0..40 {
                let h = normals(&mut rng) * size;
                for error in errors::<6, Se3>(poses(|| pose(&mut rng), h)) {
                    assert!(error < 1e-8, "|h| about {size}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn the_jacobians_are_exact_in_sim3() {
        let mut rng = rng(22);
        for size in [0.0, 1e-6, 0.01, 0.3, 1.0] {
            for _ in 0..40 {
                let h = normals(&mut rng) * size;
                for error in errors::<7, Sim3>(poses(|| similarity(&mut rng), h)) {
                    assert!(error < 1e-8, "|h| about {size}: {error:e}");
                }
            }
        }
    }

    #[test]
    fn true_alignments_are_as_far_as_their_covariance_says() {
        // MATH §6: mean of d² 6 ± 0.5 and 0.5 to 2 % above the 99 % quantile. 10,000 draws: σ of the mean 0.035.
        let mut rng = rng(23);
        let sigma = |k: f64| Covariance::<6>::from_sigmas([k, k, k, k * 0.3, k * 0.3, k * 0.3]).unwrap();
        let (s_i, s_j, s_ij) = (sigma(0.1), sigma(0.05), sigma(0.03));
        let (n, mut sum, mut above) = (10_000, 0.0, 0);
        for _ in 0..n {
            let [t_i, t_ij, t_ab, t_j] = poses(|| pose(&mut rng), SVector::zeros());
            let mut noisy = |t: Se3, s: &Covariance<6>| t.retract(&s.sigmas().component_mul(&normals(&mut rng)));
            let r = Residual::new(&noisy(t_i, &s_i), &noisy(t_ij, &s_ij), &t_ab, &noisy(t_j, &s_j));
            let m = r.covariance(s_i.matrix(), s_j.matrix(), s_ij.matrix());
            let d2 = m.cholesky().unwrap().solve(&r.h).dot(&r.h);
            sum += d2;
            above += u32::from(d2 > 16.812);
        }
        let (mean, above) = (sum / f64::from(n), f64::from(above) / f64::from(n));
        assert!((5.5..6.5).contains(&mean), "mean d² {mean}");
        assert!((0.005..0.02).contains(&above), "{above} above the 99 % quantile");
    }
}

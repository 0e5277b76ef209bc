//! The source's Jacobians of h in **log coordinates** ξ (T = exp(ξ^)), as references: S(8), S(10), S(11) with exact J_l
//! and J_r⁻¹ agree with finite differences; with its first-order S(4) and S(9) they do not, and nothing uses them.
//! Misprints are corrected as MATH §2 tells (wrong baselines in S(10) and S(11), one inverse in S(11)).

use super::residual;
use crate::geometry::Group;
use nalgebra::{SMatrix, SVector};

/// Which J_l and J_r⁻¹ the forms are filled with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Order {
    /// Exact closed forms.
    Exact,
    /// S(4) `J_l(ξ) ≈ I + ½ ad(ξ)` and S(9) `J_r⁻¹(h) ≈ I + ½ ad(h)`. Relative error of the result (*measured*):
    /// 0.2 % for poses of 0.1 rad, 13 % at 0.5 rad and 1 m, 130 % at 1.5 rad and 5 m.
    First,
}

/// ∂h/∂ξ_j, ∂h/∂ξ_i and ∂h/∂ξ_ij: equations S(8), S(10) and S(11).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LogJacobians<const N: usize> {
    /// S(8): J_r⁻¹(h) Ad(T_j⁻¹) J_l(ξ_j).
    pub xi_j: SMatrix<f64, N, N>,
    /// S(10): −J_r⁻¹(h) Ad((T_αβ T_j)⁻¹) J_l(ξ_i).
    pub xi_i: SMatrix<f64, N, N>,
    /// S(11): −J_r⁻¹(h) Ad((T_i⁻¹ T_αβ T_j)⁻¹) J_l(ξ_ij).
    pub xi_ij: SMatrix<f64, N, N>,
}

/// S(8), S(10) and S(11) at the given log coordinates of T_i, T_ij and T_j.
pub fn log_jacobians<const N: usize, G: Group<N>>(
    xi_i: &SVector<f64, N>,
    xi_ij: &SVector<f64, N>,
    t_alpha_beta: &G,
    xi_j: &SVector<f64, N>,
    order: Order,
) -> LogJacobians<N> {
    let (t_i, t_ij, t_j) = (G::exp(xi_i), G::exp(xi_ij), G::exp(xi_j));
    let h = residual(&t_i, &t_ij, t_alpha_beta, &t_j);
    let first = |xi: &SVector<f64, N>| SMatrix::<f64, N, N>::identity() + G::ad(xi) * 0.5;
    let left = |xi: &SVector<f64, N>| match order {
        Order::Exact => G::left_jacobian(xi),
        Order::First => first(xi),
    };
    let right_inv = match order {
        Order::Exact => G::right_jacobian_inv(&h),
        Order::First => first(&h),
    };
    let t_alpha_j = *t_alpha_beta * t_j;
    LogJacobians {
        xi_j: right_inv * t_j.inverse().adjoint() * left(xi_j),
        xi_i: -right_inv * t_alpha_j.inverse().adjoint() * left(xi_i),
        xi_ij: -right_inv * (t_i.inverse() * t_alpha_j).inverse().adjoint() * left(xi_ij),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sampling::{normals, rng, uniform};
    use crate::geometry::{Se3, Sim3};
    use nalgebra::Vector3;
    use rand_chacha::ChaCha8Rng;

    /// Log coordinates with |φ| up to `angle` rad and translations of about `metres`.
    fn draw<const N: usize>(rng: &mut ChaCha8Rng, angle: f64, metres: f64) -> SVector<f64, N> {
        let phi: Vector3<f64> = normals(rng);
        let phi = phi * (uniform(rng, 0.05, 1.0) * angle / phi.norm());
        let rho: Vector3<f64> = normals(rng) * (metres / 3.0_f64.sqrt());
        let lambda = uniform(rng, -0.5, 0.5);
        SVector::from_fn(|r, _| match r {
            0..3 => rho[r],
            3..6 => phi[r - 3],
            _ => lambda,
        })
    }

    /// Largest relative error of the three forms against finite differences over seeded draws.
    fn worst<const N: usize, G: Group<N>>(angle: f64, metres: f64, order: Order) -> f64 {
        let mut rng = rng(31);
        let mut worst: f64 = 0.0;
        for _ in 0..60 {
            let x: [SVector<f64, N>; 3] = [
                draw(&mut rng, angle, metres),
                draw(&mut rng, angle.min(1.0), metres.min(2.0)),
                draw(&mut rng, angle, metres),
            ];
            let h: SVector<f64, N> = normals(&mut rng) * 0.02;
            let t_alpha_beta = G::exp(&x[0]) * G::exp(&x[1]) * G::exp(&h) * G::exp(&x[2]).inverse();
            let forms = log_jacobians(&x[0], &x[1], &t_alpha_beta, &x[2], order);
            for (which, form) in [forms.xi_i, forms.xi_ij, forms.xi_j].iter().enumerate() {
                let at = |k: usize, step: f64| {
                    let mut x = x;
                    x[which][k] += step;
                    residual(&G::exp(&x[0]), &G::exp(&x[1]), &t_alpha_beta, &G::exp(&x[2]))
                };
                let e = 1e-4;
                let mut numeric = SMatrix::<f64, N, N>::zeros();
                for k in 0..N {
                    let column = (at(k, e) - at(k, -e)) * 8.0 - (at(k, 2.0 * e) - at(k, -2.0 * e));
                    numeric.set_column(k, &(column / (12.0 * e)));
                }
                worst = worst.max((form - numeric).norm() / numeric.norm());
            }
        }
        worst
    }

    #[test]
    fn with_exact_jacobians_the_source_is_right() {
        for (angle, metres) in [(0.1, 0.05), (0.5, 1.0), (1.5, 5.0), (3.0, 20.0)] {
            let (se3, sim3) =
                (worst::<6, Se3>(angle, metres, Order::Exact), worst::<7, Sim3>(angle, metres, Order::Exact));
            assert!(se3 < 1e-8 && sim3 < 1e-8, "{angle} rad: {se3:e} {sim3:e}");
        }
    }

    #[test]
    fn to_first_order_it_is_right_for_small_poses_only() {
        let error = |angle, metres| worst::<6, Se3>(angle, metres, Order::First);
        let small = error(0.1, 0.05);
        assert!(small > 1e-5 && small < 0.02, "{small}");
        let (medium, large) = (error(0.5, 1.0), error(1.5, 5.0));
        assert!(medium > 0.02 && medium < 0.5, "{medium}");
        assert!(large > 0.3, "{large}");
    }
}

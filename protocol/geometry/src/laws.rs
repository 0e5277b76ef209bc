//! The laws that any group here must obey, as a macro: group axioms, exp and log, Ad, and the exact Jacobians against
//! finite differences. A new group is one more invocation below.

use super::{se2, se3, sim3, so3};
use core::f64::consts::PI;
use nalgebra::{SVector, Vector3, Vector6};
use proptest::prelude::*;

/// Step of the central differences: the truncation is about h², the rounding 1e-16/h.
const STEP: f64 = 1e-5;
/// Jacobians must agree with central differences to this, relative to the Jacobian's size.
const JACOBIAN_TOLERANCE: f64 = 1e-6;
/// Translations drawn, in either direction.
const TRANSLATION_MAX: f64 = 20.0;

macro_rules! group_laws {
    ($name:ident, $group:ty, $module:path, $dimension:literal, $point:expr, $angle:expr, $tangent:expr) => {
        mod $name {
            use super::*;
            use $module::{left_jacobian, left_jacobian_inv, right_jacobian, right_jacobian_inv};
            type Group = $group;
            type Tangent = SVector<f64, $dimension>;
            type Jacobian = nalgebra::SMatrix<f64, $dimension, $dimension>;

            fn group() -> impl Strategy<Value = Group> {
                $tangent.prop_map(|xi| Group::exp(&xi))
            }

            /// Small perturbations are compared as tangents, which has no cut at a half turn.
            fn close(a: &Group, b: &Group) -> Result<(), TestCaseError> {
                let error = a.local(b).norm();
                let size = 1.0 + a.adjoint().amax() + a.inverse().adjoint().amax();
                prop_assert!(error < 1e-13 * size, "{error:e} of {size:e}\n{a:?}\n{b:?}");
                Ok(())
            }

            /// d f(δ)/dδ at 0 by central differences, as local perturbations of f(0).
            fn differences(f: impl Fn(&Tangent) -> Group) -> Jacobian {
                let origin = f(&Tangent::zeros());
                let mut m = Jacobian::zeros();
                for k in 0..$dimension {
                    let mut delta = Tangent::zeros();
                    delta[k] = STEP;
                    let column = (origin.local(&f(&delta)) - origin.local(&f(&-delta))) / (2.0 * STEP);
                    m.set_column(k, &column);
                }
                m
            }

            fn near(exact: &Jacobian, approximate: &Jacobian, tolerance: f64) -> Result<(), TestCaseError> {
                let error = (exact - approximate).amax() / exact.amax().max(1.0);
                prop_assert!(error < tolerance, "{error:e}: {exact} {approximate}");
                Ok(())
            }

            proptest! {
                #[test]
                fn axioms(a in group(), b in group(), c in group(), p in $point) {
                    close(&((a * b) * c), &(a * (b * c)))?;
                    close(&(a * a.inverse()), &Group::identity())?;
                    close(&(a.inverse() * a), &Group::identity())?;
                    close(&(a * Group::identity()), &a)?;
                    close(&(Group::identity() * a), &a)?;
                    let (one_by_one, at_once) = (a * (b * p), (a * b) * p);
                    prop_assert!((one_by_one - at_once).norm() < 1e-13 * (1.0 + at_once.norm() + (a * p).norm()) * 50.0);
                }

                #[test]
                fn log_inverts_exp(xi in $tangent, a in group()) {
                    // Just inside the half turn the log is unique.
                    let angle: fn(&Tangent) -> f64 = $angle;
                    prop_assume!(angle(&xi) < PI - 1e-9);
                    let error = (Group::exp(&xi).log() - xi).norm();
                    prop_assert!(error < 1e-13 * (1.0 + xi.norm()), "{error:e}");
                    close(&Group::exp(&a.log()), &a)?;
                }

                #[test]
                fn retract_inverts_local(a in group(), b in group()) {
                    close(&a.retract(&a.local(&b)), &b)?;
                    close(&a.interpolate(&b, 0.0), &a)?;
                    close(&a.interpolate(&b, 1.0), &b)?;
                    let half = a.interpolate(&b, 0.5);
                    prop_assert!((a.local(&half) - half.local(&b)).norm() < 1e-12 * (1.0 + a.local(&b).norm()));
                }

                #[test]
                fn adjoint_moves_perturbations_across(a in group(), b in group(), xi in $tangent) {
                    let xi = xi * 0.1;
                    close(&(a * Group::exp(&xi)), &(Group::exp(&(a.adjoint() * xi)) * a))?;
                    near(&(a * b).adjoint(), &(a.adjoint() * b.adjoint()), 1e-13)?;
                    near(&(a.adjoint() * a.inverse().adjoint()), &Jacobian::identity(), 1e-11)?;
                }

                #[test]
                fn left_and_right_jacobians_differ_by_the_adjoint(xi in $tangent) {
                    let ad_inv = Group::exp(&xi).inverse().adjoint();
                    near(&(ad_inv * left_jacobian(&xi)), &right_jacobian(&xi), 1e-12)?;
                }

                #[test]
                fn inverse_jacobians_invert(xi in $tangent) {
                    near(&(left_jacobian(&xi) * left_jacobian_inv(&xi)), &Jacobian::identity(), 1e-11)?;
                    near(&(right_jacobian(&xi) * right_jacobian_inv(&xi)), &Jacobian::identity(), 1e-11)?;
                }

                #[test]
                fn jacobians_are_the_derivatives(xi in $tangent) {
                    let j_r = differences(|delta| Group::exp(&(xi + delta)));
                    near(&right_jacobian(&xi), &j_r, JACOBIAN_TOLERANCE)?;
                    // exp(ξ + δ) = exp(J_l δ) exp(ξ): a left perturbation is a local one of the inverse, negated.
                    let j_l = -differences(|delta| Group::exp(&(xi + delta)).inverse());
                    near(&left_jacobian(&xi), &j_l, JACOBIAN_TOLERANCE)?;
                }
            }
        }
    };
}

fn point() -> impl Strategy<Value = Vector3<f64>> {
    proptest::array::uniform3(-TRANSLATION_MAX..TRANSLATION_MAX).prop_map(Vector3::from)
}

/// Rotation vectors of every size: angles to π, with weight on the two ends where closed forms break.
fn rotation() -> impl Strategy<Value = Vector3<f64>> {
    let axis = proptest::array::uniform3(-1.0..1.0_f64).prop_filter_map("an axis has length", |v| {
        let v = Vector3::from(v);
        (v.norm() > 0.1).then(|| v.normalize())
    });
    let angle = prop_oneof![
        4 => 0.0..=PI,
        1 => (-14.0..-0.5_f64).prop_map(|e| libm::pow(10.0, e)),
        1 => (-14.0..-0.5_f64).prop_map(|e| PI - libm::pow(10.0, e)),
        1 => Just(0.0),
        1 => Just(PI),
    ];
    (axis, angle).prop_map(|(axis, angle)| axis * angle)
}

/// Log-scales of scales 0.05 to 20, with weight on 1.
fn log_scale() -> impl Strategy<Value = f64> {
    prop_oneof![
        4 => -3.0..3.0_f64,
        1 => ((-14.0..-1.0_f64), any::<bool>()).prop_map(|(e, sign)| libm::pow(10.0, e) * if sign { 1.0 } else { -1.0 }),
        1 => Just(0.0),
    ]
}

group_laws!(so3_laws, so3::So3, crate::so3, 3, point(), |xi| xi.norm(), rotation());
group_laws!(se2_laws, se2::Se2, crate::se2, 3, point().prop_map(|p| p.xy()), |xi| xi.z.abs(), {
    (point(), rotation()).prop_map(|(rho, phi)| Vector3::new(rho.x, rho.y, phi.norm().copysign(phi.x)))
});
group_laws!(se3_laws, se3::Se3, crate::se3, 6, point(), |xi| xi.rows(3, 3).norm(), {
    (point(), rotation()).prop_map(|(rho, phi)| -> Vector6<f64> { se3::join(&rho, &phi) })
});
group_laws!(sim3_laws, sim3::Sim3, crate::sim3, 7, point(), |xi| xi.rows(3, 3).norm(), {
    (point(), rotation(), log_scale()).prop_map(|(rho, phi, lambda)| sim3::join(&rho, &phi, lambda))
});

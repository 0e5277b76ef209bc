//! Rotations, rigid motions and similarities with exact Jacobians, and Gaussians over them.
//!
//! Conventions (MATH §1), used everywhere in this workspace:
//! - `t_a_b` maps coordinates of frame b into frame a.
//! - Tangent order is **(ρ, φ[, λ])**: translation, rotation, log-scale.
//! - Perturbations are **local (right)**: `T ⊕ δ = T · exp(δ^)`; a stored covariance is that of δ.
//!
//! ```text
//!  So3 ─► Se3 ─► Sim3          one Group each: exp, log, adjoint, left and right Jacobians
//!    Se2 ┘│      │            the motions of the plane in those of space
//!  PoseWithCovariance, SimWithCovariance ─► Relative: either, between two frames
//! ```
//!
//! ```
//! use merganser_geometry::{Covariance, PoseWithCovariance, Se3, So3};
//! use nalgebra::Vector3;
//!
//! let quarter_turn = So3::exp(&Vector3::new(0.0, 0.0, core::f64::consts::FRAC_PI_2));
//! let t_a_b = Se3::new(quarter_turn, Vector3::new(1.0, 0.0, 0.0));
//! let in_a = t_a_b * Vector3::new(2.0, 0.0, 0.0); // a point of frame b
//! assert!((in_a - Vector3::new(1.0, 2.0, 0.0)).norm() < 1e-12);
//! // One standard deviation: 0.1 m and 0.01 rad about each axis of b.
//! let covariance = Covariance::from_sigmas([0.1, 0.1, 0.1, 0.01, 0.01, 0.01])?;
//! let measured = PoseWithCovariance { pose: t_a_b, covariance };
//! let error = t_a_b.local(&measured.pose); // (ρ, φ)
//! assert!(measured.covariance.mahalanobis_squared(&error) < 1e-12);
//! # Ok::<(), merganser_geometry::CovarianceError>(())
//! ```

pub mod chi2;
pub mod gaussian;
pub mod group;
#[cfg(test)]
mod laws;
pub mod quaternion_order;
pub mod relative;
pub mod sampling;
pub mod se2;
pub mod se3;
pub mod sim3;
pub mod so3;
pub mod split_ci;

pub use gaussian::{Covariance, CovarianceError, PoseWithCovariance, SimWithCovariance};
pub use group::Group;
pub use relative::{Disagreement, Relative};
pub use se2::Se2;
pub use se3::Se3;
pub use sim3::Sim3;
pub use so3::So3;

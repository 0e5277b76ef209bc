//! Rotations, rigid motions and similarities with exact Jacobians, and Gaussians over them.
//!
//! Conventions (MATH §1), used everywhere in this workspace:
//! - `t_a_b` maps coordinates of frame b into frame a.
//! - Tangent order is **(ρ, φ[, λ])**: translation, rotation, log-scale.
//! - Perturbations are **local (right)**: `T ⊕ δ = T · exp(δ^)`; a stored covariance is that of δ.

pub mod gaussian;
pub mod group;
#[cfg(test)]
mod laws;
pub mod relative;
pub mod sampling;
pub mod se3;
pub mod sim3;
pub mod so3;
pub mod split_ci;

pub use gaussian::{Covariance, CovarianceError, PoseWithCovariance, SimWithCovariance};
pub use group::Group;
pub use relative::{Disagreement, Relative};
pub use se3::Se3;
pub use sim3::Sim3;
pub use so3::So3;

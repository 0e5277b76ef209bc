//! Covariance of the motion between two keyframes: as reported, or derived from the covariances of absolute poses, or
//! assumed across a gap. Local perturbations throughout (MATH §1).

use super::stated::{Axes, is_constant};
use super::{CovarianceOf, Keyframe};
use crate::config::SubmapConfig;
use crate::geometry::{Covariance, PoseWithCovariance, Se3};
use nalgebra::Matrix6;

/// Least standard deviation of a motion derived from pose covariances, per unit travelled: below what any odometry
/// holds, above what a difference of two nearly equal covariances leaves by rounding.
const DERIVED_SIGMA_PER_M: f64 = 1e-3;
/// ...and per radian turned.
const DERIVED_SIGMA_PER_RAD: f64 = 1e-3;
/// ...and, at rest, in voxels and in radians.
const DERIVED_SIGMA_VOXELS: f64 = 1e-3;
const DERIVED_SIGMA_RAD: f64 = 1e-4;
/// Turn assumed possible unnoticed across a gap of one submap's length, rad; scaled by `gap_sigma_per_m` as the rest.
const GAP_TURN_PER_SUBMAP: f64 = 0.2;

/// `t_last_next` with the covariance of its local perturbation, if no keyframe between the two was lost.
pub fn motion(last: &Keyframe, next: &Keyframe, config: &SubmapConfig) -> PoseWithCovariance {
    let pose = last.pose.pose.inverse() * next.pose.pose;
    let axes = Axes::unmeasured(&next.pose.covariance, config);
    let covariance = match (next.covariance_of, last.covariance_of) {
        (CovarianceOf::Motion, _) => next.pose.covariance,
        _ if is_constant(last, next, config) => across_gap(&pose, config, &next.pose.covariance).covariance,
        (CovarianceOf::Pose, CovarianceOf::Pose) => derived(last, next, &pose, config).0,
        (CovarianceOf::Pose, CovarianceOf::Motion) => across_gap(&pose, config, &next.pose.covariance).covariance,
    };
    let covariance = match axes.is_empty() {
        true => covariance,
        false => axes.loosened(&covariance, &across_gap(&pose, config, &covariance).covariance),
    };
    PoseWithCovariance { pose, covariance }
}

/// The same if some were lost. `None` where the covariance spans the gap by itself: differences of poses do, if they
/// are a chain's; a motion's covers only the last step of it.
pub fn motion_across(last: &Keyframe, next: &Keyframe, config: &SubmapConfig) -> Option<PoseWithCovariance> {
    let PoseWithCovariance { pose, covariance } = motion(last, next, config);
    let is_chain = (last.covariance_of, next.covariance_of) == (CovarianceOf::Pose, CovarianceOf::Pose)
        && !derived(last, next, &pose, config).1;
    let widened = || covariance.plus(&across_gap(&pose, config, &next.pose.covariance).covariance);
    (!is_chain).then(|| PoseWithCovariance { pose, covariance: widened() })
}

/// A motion over which odometry is not known: σ = `gap_sigma_per_m` × (distance + one voxel) for the translation and
/// `gap_sigma_per_m` × (turn + 0.2 rad per submap's length) for the rotation.
pub fn across_gap(pose: &Se3, config: &SubmapConfig, otherwise: &Covariance<6>) -> PoseWithCovariance {
    across_gap_after(pose, 0.0, config, otherwise)
}

/// The same where the two ends were besides told by two odometries that both drove `way`.
pub fn across_gap_after(pose: &Se3, way: f64, config: &SubmapConfig, otherwise: &Covariance<6>) -> PoseWithCovariance {
    let distance = pose.translation.norm() + config.voxel_m + way;
    let turn = pose.rotation.angle() + GAP_TURN_PER_SUBMAP * distance / config.distance_m;
    let (rho, phi) = (config.gap_sigma_per_m * distance, config.gap_sigma_per_m * turn);
    PoseWithCovariance { pose: *pose, covariance: isotropic(rho, phi, otherwise) }
}

/// A covariance with standard deviations `rho` and `phi` on every axis; `otherwise` where they are out of range.
pub fn isotropic(rho: f64, phi: f64, otherwise: &Covariance<6>) -> Covariance<6> {
    Covariance::from_sigmas([rho, rho, rho, phi, phi, phi]).unwrap_or(*otherwise)
}

/// Σ_M = Σ_next − Ad(M⁻¹) Σ_last Ad(M⁻¹)ᵀ: what compounding must have added, if the SLAM's poses form a chain. A loop
/// closure between the two makes it indefinite, so it is raised to a floor in every direction. Whether it had to be.
fn derived(last: &Keyframe, next: &Keyframe, t_last_next: &Se3, config: &SubmapConfig) -> (Covariance<6>, bool) {
    let ad = t_last_next.inverse().adjoint();
    let axes = Axes::unmeasured(&next.pose.covariance, config);
    // What is not measured must not be taken for the error of an axis that is, where the body turns.
    let [before, after] = [last, next].map(|keyframe| {
        let stated = &keyframe.pose.covariance;
        axes.loosened(stated, &isotropic(DERIVED_SIGMA_RAD, DERIVED_SIGMA_RAD, stated))
    });
    let difference = after.matrix() - ad * before.matrix() * ad.transpose();
    let rho = DERIVED_SIGMA_PER_M * t_last_next.translation.norm() + DERIVED_SIGMA_VOXELS * config.voxel_m;
    let phi = DERIVED_SIGMA_PER_RAD * t_last_next.rotation.angle() + DERIVED_SIGMA_RAD;
    raised(&difference, &isotropic(rho, phi, &next.pose.covariance))
}

/// The smallest covariance that is at least `m` and at least `floor` in every direction of the floor's metric; whether
/// it is more than `m`.
fn raised(m: &Matrix6<f64>, floor: &Covariance<6>) -> (Covariance<6>, bool) {
    let sigmas = floor.sigmas();
    let scaled = Matrix6::from_fn(|r, c| 0.5 * (m[(r, c)] + m[(c, r)]) / (sigmas[r] * sigmas[c]));
    let eigen = scaled.symmetric_eigen();
    let is_below = eigen.eigenvalues.iter().any(|v| !v.is_finite() || *v < 1.0);
    let values = eigen.eigenvalues.map(|v| if v.is_finite() { v.max(1.0) } else { 1.0 });
    let lifted = eigen.eigenvectors * Matrix6::from_diagonal(&values) * eigen.eigenvectors.transpose();
    let m = Matrix6::from_fn(|r, c| 0.5 * (lifted[(r, c)] + lifted[(c, r)]) * sigmas[r] * sigmas[c]);
    (Covariance::new(m).unwrap_or(*floor), is_below)
}

//! Keyframes become submaps; submaps become keypoints, descriptors and a summary.

use crate::geometry::PoseWithCovariance;
use crate::time::Stamp;

/// One keyframe of the robot's own SLAM.
#[derive(Clone, Debug, PartialEq)]
pub struct Keyframe {
    /// When, on the robot's clock; must rise.
    pub stamp: Stamp,
    /// `t_frame_body`: pose of the body in the SLAM's local frame, and a covariance whose meaning `covariance_of` tells.
    pub pose: PoseWithCovariance,
    /// What the covariance describes.
    pub covariance_of: CovarianceOf,
    /// Points in the body frame, frame units.
    pub points: Vec<[f32; 3]>,
}

/// What a keyframe's covariance describes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum CovarianceOf {
    /// The motion since the previous keyframe (local perturbation of the relative pose). Preferred.
    #[default]
    Motion,
    /// The absolute pose in the SLAM's frame; the motion's is derived by subtraction.
    Pose,
}

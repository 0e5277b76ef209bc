//! Planar robots with a 2-D laser (`submap.sensor = "laser_2d"`): the same path from keyframes to alignments, in three
//! degrees of freedom.
//!
//! `Sharpener` corrects the motion between keyframes by scan matching before a submap is built of them.
//! [`describe()`] turns a submap into the same [`Features`](super::Features), keypoints and summary as in space, with
//! points at z = 0 and normals in the plane, so that wire, store and negotiation stay as they are. [`register()`]
//! tries *all* poses of their keypoints on a raster of my submap (`search`), because a floor plan of bare walls has
//! no local features to speak of, and judges the best of them (`verifier`).
//!
//! **What is not known.** A laser at some height over some floor sees nothing of height, roll and pitch. An alignment
//! says of them that both robots stand on about one floor ([`OUT_OF_PLANE_ALIGNED`]); the motion of a robot that does
//! not leave its plane says that they stay ([`OUT_OF_PLANE_DRIVEN`]). So they are a gauge that the joint estimate can
//! solve for and that no alignment makes worse.
//!
//! Lengths are in voxels unless said otherwise.

mod codec;
mod describe;
mod elsewhere;
mod fit;
mod lines;
mod motion;
mod register;
mod se2;
mod search;
#[cfg(test)]
mod tests;
mod verifier;

pub use describe::describe;
pub(super) use motion::Sharpener;
pub use register::{PlanarConfig, register};

use crate::geometry::{PoseWithCovariance, Se3};
use se2::in_plane;
pub(super) use se2::{Se2, in_space, wrapped};

/// Standard deviations of height (m) and of roll and pitch (rad) that an alignment claims: two robots on one floor,
/// their lasers mounted and their floor laid as such things are.
pub const OUT_OF_PLANE_ALIGNED: (f64, f64) = (0.4, 0.08);
/// The same of one keyframe's motion: next to nothing, but enough that products stay well conditioned.
pub const OUT_OF_PLANE_DRIVEN: (f64, f64) = (1e-3, 1e-4);
/// A body that tilts by more (rad) is no planar robot.
pub const TILT_MAX: f64 = 0.17;

/// What is left in the plane of a pose in space.
pub(super) fn flat(pose: &Se3) -> Se3 {
    Se2::of(pose, 1.0).se3(1.0)
}

/// What is left in the plane of a motion, by a body that stays in it.
pub(super) fn flat_motion(motion: &PoseWithCovariance) -> PoseWithCovariance {
    in_space(&Se2::of(&motion.pose, 1.0), 1.0, &in_plane(&motion.covariance, 1.0), OUT_OF_PLANE_DRIVEN)
}

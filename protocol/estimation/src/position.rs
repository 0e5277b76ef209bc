//! Where something was seen, not how it is turned: a range and a bearing to another robot.
//!
//! The measurement is a point of `j`, of known place `p_j` in its anchor's frame, seen at `p_i` in that of `i`: `p_i =
//! t_i_j p_j + e`. The graph's measurements are whole poses, so it is completed to one once there is a map that says
//! how `j` is turned: that rotation, about the point, with a standard deviation of [`TURN_SIGMA`]. What the map is told
//! again of itself is its own information times (σ / 2.5 rad)², which is 2e-5 for a σ of 0.6° and 0.5 % for 10°. In the
//! other three directions this is the measurement, to first order in what the rotation is off.

use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, So3};
use crate::ids::{EntryId, SubmapId};
use nalgebra::{Matrix6, Vector3};

/// Standard deviation of the rotation that is filled in, rad: below the 3 rad from which a measurement says nothing.
pub const TURN_SIGMA: f64 = 2.5;
/// Dimension of the measurement.
pub(super) const DIMENSION: usize = 3;

/// A point of one submap, seen from another.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenPoint {
    /// Where it was seen, in the frame of `i`'s anchor.
    pub p_i: Vector3<f64>,
    /// The same point in the frame of `j`'s anchor.
    pub p_j: Vector3<f64>,
    /// Of `p_i − t_i_j p_j`, along the axes of `i`'s anchor.
    pub covariance: Covariance<3>,
}

/// A [`SeenPoint`] as its observer stated it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StatedPoint {
    /// The log entry that states it.
    pub entry: EntryId,
    /// The observer's anchor.
    pub i: SubmapId,
    /// The anchor of the robot that was seen.
    pub j: SubmapId,
    /// What was seen.
    pub point: SeenPoint,
}

impl SeenPoint {
    /// `t_i_j`, if `j` is turned so.
    pub(super) fn completed(&self, r_i_j: &So3) -> Relative {
        let r = r_i_j.matrix();
        let mut about = Matrix6::identity() * (TURN_SIGMA * TURN_SIGMA);
        about.fixed_view_mut::<3, 3>(0, 0).copy_from(&(r.transpose() * self.covariance.matrix() * r));
        // The frame of `j`, moved to the point and back.
        let t_point_j = Se3::new(So3::identity(), -self.p_j);
        let ad = t_point_j.inverse().adjoint();
        let covariance = Covariance::new_or_wider(ad * about * ad.transpose());
        let pose = Se3::new(*r_i_j, self.p_i) * t_point_j;
        Relative::Metric(PoseWithCovariance { pose, covariance })
    }

    /// Every number of it, for canonical order.
    pub(super) fn numbers(&self) -> impl Iterator<Item = f64> + '_ {
        self.p_i.iter().chain(self.p_j.iter()).chain(self.covariance.matrix().iter()).copied()
    }
}

#[cfg(test)]
#[path = "position_tests.rs"]
mod tests;

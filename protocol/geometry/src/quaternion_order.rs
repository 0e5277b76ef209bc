//! Whether quaternions that are read `[x, y, z, w]` were written w first: told by how the body moves.
//!
//! A quaternion tells nothing of its order by itself, and neighbours that differ little do so in either order. But a
//! body goes one way in its own axes (ahead, if it drives) whatever its heading is, and in the wrong order that way turns
//! with the heading. So steps are taken in the axes of the body by both orders. The order is doubted if
//! - only the other one has steps along one axis (`ALONG_MIN`, `ALONG_RATIO`), or
//! - the body only ever turns about x, while it moves in the plane of x and y: in the other order it drives in that
//!   plane, or
//! - the first pose is a half turn about x, which is the identity in the other order, and the other order's steps are
//!   along one axis more clearly (`ALONG_LEAD`).
//!
//! A body that moves any way (a camera in a hand), that goes one straight way, or hardly moves, gives no doubt.
//!
//! *Measured* on 160 tracks (KITTI's, 7-Scenes', pose graphs of 127 files), at every length: no doubt where x stands
//! first. With w first, all that drive or fly and turn by more than a few degrees are doubted.

use crate::{Se3, So3};
use nalgebra::{Matrix3, Vector3};

/// Steps it takes.
pub const STEPS_MIN: u32 = 16;
/// Share of the steps' scatter along one axis of a body that goes ahead.
const ALONG_MIN: f64 = 0.85;
/// In the wrong order it is less than this times that in the right one.
const ALONG_RATIO: f64 = 0.75;
/// By how much it is more in the right order than in the wrong one, at least, if the first pose speaks for it, too.
const ALONG_LEAD: f64 = 0.1;
/// Root mean square of the parts of quaternions that vanish where a body only turns about x.
const ASIDE_MAX: f64 = 0.05;
/// Angles about x whose mean direction is longer than this do not vary.
const VARIES: f64 = 0.9;
/// Shares of the steps' scatter: along z at most, and along x at least, where a body moves in the plane of x and y.
const LEVEL_MAX: f64 = 0.05;
const FORTH_MIN: f64 = 0.2;
/// The x of a half turn about x.
const HALF_TURN: f64 = 0.999;

/// The rotation whose quaternion was meant where `[w, x, y, z]` was read as `[x, y, z, w]`.
pub fn w_first(read: &So3) -> So3 {
    let [w, x, y, z] = read.xyzw();
    So3::from_xyzw([x, y, z, w]).unwrap_or_else(So3::identity)
}

/// Looks at poses as they come, in order.
#[derive(Clone, Debug, Default)]
pub struct QuaternionOrder {
    poses: u32,
    steps: u32,
    last: Option<Se3>,
    /// The first pose's x.
    first: f64,
    /// Scatter of the steps in the body's axes, as read and in the other order, and in the frame's axes; each step counts
    /// by its length.
    scatters: [Matrix3<f64>; 3],
    /// Sum of the squares of y and z.
    aside: f64,
    /// Sum of the directions of the angles about x.
    about_x: [f64; 2],
}

impl QuaternionOrder {
    /// Takes the next pose; one that is not finite is left out.
    pub fn push(&mut self, pose: &Se3) {
        let [x, y, z, w] = pose.rotation.xyzw();
        if ![x, y, z, w].iter().chain(&pose.translation).all(|number| number.is_finite()) {
            return;
        }
        if self.poses == 0 {
            self.first = x.abs();
        }
        self.poses = self.poses.saturating_add(1);
        self.aside += y * y + z * z;
        let across = (x * x + w * w).max(f64::MIN_POSITIVE);
        self.about_x[0] += (w * w - x * x) / across;
        self.about_x[1] += 2.0 * x * w / across;
        let Some(last) = self.last.replace(*pose) else { return };
        let step = pose.translation - last.translation;
        let way = step.norm();
        if !(way > 0.0 && way.is_finite()) {
            return;
        }
        self.steps = self.steps.saturating_add(1);
        for (scatter, turn) in self.scatters.iter_mut().zip([last.rotation, w_first(&last.rotation), So3::identity()]) {
            let along: Vector3<f64> = turn.matrix().transpose() * (step / way.sqrt());
            *scatter += along * along.transpose();
        }
    }

    /// Steps so far.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Whether quaternions seem to be written w first.
    pub fn is_doubtful(&self) -> bool {
        if self.steps < STEPS_MIN {
            return false;
        }
        let [read, other, in_frame] = &self.scatters;
        let way = in_frame.trace();
        if !(way > 0.0 && way.is_finite()) {
            return false;
        }
        let along = |scatter: &Matrix3<f64>| scatter.symmetric_eigenvalues().max() / way;
        let (read, other) = (along(read), along(other));
        // A half turn about (0, s, c) maps x to −x: a way along the frame's x looks driven however the body turns.
        let goes_ahead = other >= ALONG_MIN && in_frame[(0, 0)] < ALONG_MIN * way;
        let poses = f64::from(self.poses);
        let turns_about_x = (self.aside / poses).sqrt() <= ASIDE_MAX
            && self.about_x[0].hypot(self.about_x[1]) <= VARIES * poses
            && in_frame[(2, 2)] <= LEVEL_MAX * way
            && in_frame[(0, 0)] >= FORTH_MIN * way;
        let begins_so = self.first >= HALF_TURN && read <= other - ALONG_LEAD;
        turns_about_x || (goes_ahead && (read <= ALONG_RATIO * other || begins_so))
    }
}

#[cfg(test)]
#[path = "quaternion_order_tests.rs"]
mod tests;

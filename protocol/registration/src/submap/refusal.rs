//! Why a keyframe is refused: each says what is wrong, and how to mend it.

use super::builder::{POINTS_PER_KEYFRAME_MAX, POSITION_MAX};
use super::continuity::RESTART_KEYFRAMES;
use super::planar::TILT_MAX;
use thiserror::Error;

/// Why a keyframe was refused. The submaps are as they were before; only the odometry across the refused keyframe
/// becomes less certain, and several [jumps](Self::Jump) that go on from one another tell of a new frame.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum KeyframeError {
    /// The stamp is not after the last one.
    #[error("keyframe stamp {stamp} ns is not after the last one, {last} ns; send keyframes in order, once")]
    StampNotRising {
        /// The keyframe's stamp, ns.
        stamp: i64,
        /// The last accepted stamp, ns.
        last: i64,
    },
    /// Of a run of the front end after which another one began.
    #[error(
        "session {session} is over, another one has begun; stop the SLAM that still sends it, and let each start choose a \
         number of its own"
    )]
    SessionOver {
        /// What the run calls itself.
        session: u64,
    },
    /// The stamp is farther than [`STAMP_MAX`](super::builder::STAMP_MAX) from the clock's zero.
    #[error("keyframe stamp {stamp} ns is more than 146 years from zero; send nanoseconds")]
    StampOutOfRange {
        /// The keyframe's stamp, ns.
        stamp: i64,
    },
    /// A translation is NaN, infinite or farther than [`POSITION_MAX`] from the origin.
    #[error("keyframe position is not finite or beyond {POSITION_MAX} from the origin; use a local frame")]
    BadPosition,
    /// A planar robot's body is tilted.
    #[error(
        "the body is tilted by {tilt:.2} rad, more than {TILT_MAX}; is this a planar robot (see \
             submap.sensor), and its quaternion [x, y, z, w]?"
    )]
    NotPlanar {
        /// Angle between the body's and the frame's upward axis, rad.
        tilt: f64,
    },
    /// A coordinate of a point is NaN or infinite.
    #[error("point {index} of the keyframe is not finite; leave out invalid returns")]
    PointNotFinite {
        /// Position in the keyframe's points.
        index: usize,
    },
    /// Landmarks without marks, or marks of what are no landmarks.
    #[error(
        "keyframe has {points} points and {marks} marks; with submap.sensor = \"landmarks\" or \"landmarks_2d\" send a \
         mark for each point, else none"
    )]
    Marks {
        /// Points.
        points: usize,
        /// Marks.
        marks: usize,
    },
    /// A landmark's covariance is out of range.
    #[error(
        "landmark {index} has a standard deviation outside 1e-6 to 1e4; state its covariance in frame units squared"
    )]
    MarkOutOfRange {
        /// Position in the keyframe's points.
        index: usize,
    },
    /// A place descriptor unlike those before.
    #[error(
        "the place vector has {numbers} numbers by {model:?}, unlike those before it; send one model, metric and length"
    )]
    OtherPlace {
        /// Its numbers.
        numbers: usize,
        /// What made it.
        model: String,
    },
    /// More points than a keyframe may hold.
    #[error("keyframe has {count} points, at most {POINTS_PER_KEYFRAME_MAX} are accepted; thin it first")]
    TooManyPoints {
        /// How many it has.
        count: usize,
    },
    /// The body moved or turned farther than it can: a wrong pose, or a SLAM that restarted or relocalised (see
    /// [`continuity`](super::continuity)).
    #[error(
        "the body moved by {moved:.1} and turned by {turned_deg:.0} degrees in the {secs:.2} s since the last keyframe; at \
         most {allowed:.1} and {allowed_deg:.0} degrees go on from there. Send poses of an odometry frame, which never jump; \
         if the SLAM restarted, say so (another `session`), else {RESTART_KEYFRAMES} keyframes that go on from here begin a \
         new epoch; if the body did move so, send keyframes more often, or raise submap.distance_m, speed_max_m_s or \
         turn_max_deg_s"
    )]
    Jump {
        /// Distance from the last keyframe, frame units.
        moved: f64,
        /// Angle from the last keyframe, degrees.
        turned_deg: f64,
        /// Time since the last keyframe, s.
        secs: f64,
        /// The farthest that is accepted, frame units.
        allowed: f64,
        /// The most that is accepted, degrees.
        allowed_deg: f64,
    },
}

//! Why a message of a robot's own SLAM is refused.

use super::{COORDINATE_MAX, POINTS_MAX};
use crate::depth::DepthError;
use merganser_protocol::geometry::CovarianceError;
use merganser_protocol::submap::{PlaceError, UpError};
use thiserror::Error;

/// Why a message is refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum ObservationError {
    /// Not the JSON wanted.
    #[error("JSON: {0}")]
    Json(String),
    /// JSON that is said to be postcard.
    #[error(
        "this looks like JSON: state the encoding application/json, in Python \
         put(key, text, encoding=zenoh.Encoding.APPLICATION_JSON); without one a message is taken for postcard"
    )]
    Encoding,
    /// Not the postcard wanted.
    #[error("postcard: {0}; the fields are those of the JSON form, in its order")]
    Postcard(String),
    /// Bytes after the end.
    #[error("{0} bytes follow the message")]
    Trailing(usize),
    /// A number is NaN, infinite or absurd.
    #[error("{0} holds a number that is not finite or beyond {COORDINATE_MAX:e}")]
    Number(&'static str),
    /// The rotation is no rotation.
    #[error("rotation: a quaternion [x, y, z, w] cannot be zero")]
    Rotation,
    /// The covariance is none.
    #[error("{0}")]
    Covariance(#[from] CovarianceError),
    /// Not one landmark for each point.
    #[error("{landmarks} landmarks for {points} points; state what is known of each point, or of none")]
    Landmarks {
        /// Points.
        points: usize,
        /// Landmarks.
        landmarks: usize,
    },
    /// The covariance of a landmark is none.
    #[error("landmark {index} (counted from 0): {error}")]
    LandmarkCovariance {
        /// Which.
        index: usize,
        /// What is wrong with it.
        error: CovarianceError,
    },
    /// The place descriptor is none.
    #[error("{0}")]
    Place(#[from] PlaceError),
    /// Neither points nor a depth image.
    #[error("neither points nor depth; send one of them, and \"points\": [] where nothing was seen")]
    Neither,
    /// Points and a depth image.
    #[error("both points and depth; send one of them")]
    Both,
    /// The depth image is refused.
    #[error("depth: {0}")]
    Depth(#[from] DepthError),
    /// The camera's rotation is no rotation.
    #[error("depth.t_body_camera.rotation: a quaternion [x, y, z, w] cannot be zero")]
    CameraRotation,
    /// Organised landmarks.
    #[error("organised clouds leave points out, so landmarks could not be told apart; send the landmarks there are")]
    OrganisedLandmarks,
    /// Nothing of an organised cloud was measured.
    #[error("none of the {0} points of the organised cloud is finite; leave the keyframe out")]
    Unmeasured(usize),
    /// The vertical is none.
    #[error("{0}")]
    Up(#[from] UpError),
    /// Too many points.
    #[error("too many points: {0}; send at most {POINTS_MAX}, thinned if need be")]
    Points(usize),
}

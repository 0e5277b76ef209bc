//! What a robot's own SLAM sends to its agent, as it travels: a keyframe, a sighting or a position, in JSON or
//! postcard, told by the sample's encoding. Decoding is strict (the whole input, known fields only, bounded, finite,
//! positive definite) and gives domain values, or one clear error.
//!
//! ```json
//! {"stamp_ns": 1700000000000000000, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1],
//!  "covariance": [1e-4, 0, 0, 0, 0, 0,  1e-4, 0, 0, 0, 0,  1e-4, 0, 0, 0,  1e-6, 0, 0,  1e-6, 0,  1e-6],
//!  "covariance_of": "motion", "points": [[1.5, 0.2, 0.0]]}
//! ```
//!
//! Where points are landmarks (`submap.sensor = "landmarks"` or `"landmarks_2d"`), `landmarks` says of each point what
//! else is known, in the points' order: the upper triangle of its covariance, row by row, and a label or a descriptor
//! of 256 bits (32 bytes) or both. A message without `landmarks` (in postcard: one that ends with its points) has none.
//!
//! ```text
//! "points": [[1.5, 0.2, 0.0]], "landmarks": [{"covariance": [1e-3, 0, 0, 1e-3, 0, 1e-3], "label": 72}]
//! ```
//!
//! `place` is what your own place recognition (NetVLAD and the like) says of the keyframe: a vector of 2 to 16,384
//! numbers, how two are compared (`"cosine"` or `"euclidean"`), and a name for what made it, for only vectors of one
//! model are compared. Submaps that have one are proposed for alignment by it. A message may do without (in postcard:
//! end with its landmarks).
//!
//! ```text
//! "place": {"model": "netvlad-pitts30k", "metric": "cosine", "vector": [0.017, -0.004, 0.021]}
//! ```
//!
//! A depth camera may send its image as it is, as `depth` instead of `points`: 16 bits a pixel, rectified, with the
//! intrinsics of this very image in pixels and what one count is. `data` is, in JSON, the base64 of two bytes a pixel,
//! low byte first (ROS's `16UC1`), or of a PNG of 16-bit grey if `encoding` is `"png"`; in postcard those bytes
//! themselves. `range_m` (what to trust) and `t_body_camera` (without it the body is the camera: x right, y down, z
//! forward) may be left out. Large images are thinned to 10,000 pixels; who wants other points sends points.
//!
//! ```text
//! "depth": {"width": 640, "height": 480, "fx": 585, "fy": 585, "cx": 320, "cy": 240, "unit_m": 0.001,
//!           "range_m": [0.3, 4.0],
//!           "t_body_camera": {"translation": [0.1, 0, 0.3], "rotation": [-0.5, 0.5, -0.5, 0.5]},
//!           "encoding": "raw", "data": "6AMAAOgD…"}
//! ```
//!
//! An organised cloud, which keeps the camera's or the LiDAR's grid, has NaN or infinity where nothing was measured:
//! say `"organised": true` and such points are left out. Of any other cloud they are a mistake and refuse it. JSON has
//! no NaN; there, leave the points out yourself.
//!
//! Poses are of an odometry frame: one in which the body moves and never jumps, however it drifts (`odom` in ROS's
//! terms, not `map`). A SLAM that corrects its poses by loop closures sends them without the corrections, as the chain
//! of motions from keyframe to keyframe: our joint estimate closes loops itself, and with a corrected pose it would
//! take the correction for a motion. Small corrections (within `submap.distance_m`) pass unseen, and are as wrong as
//! they are large; larger ones are refused, and if the SLAM stays there, a new epoch begins: a frame of its own, which
//! merges with the old one by alignment. With `covariance_of = "pose"` the covariances of a chain are wanted, which do
//! not shrink.
//!
//! `session` tells of which run of the SLAM a keyframe is: a number that is larger with each start, such as the time of
//! it. Another one begins a new epoch at once, since what a SLAM that was reset to its origin says has nothing to do
//! with what it said before. Without it a reset shows only by the jump, if that is longer than a few keyframes' way,
//! and a few keyframes are lost. Two that take turns are two SLAMs: of the one that began earlier all is refused. An
//! agent that starts again itself remembers the session; where none was said it takes the SLAM to go on, and with one
//! that was reset meanwhile must be run with `--new-epoch`. A message may do without (in postcard: end with its place).
//!
//! ```text
//! "session": 1700000000
//! ```
//!
//! `up` is the direction against gravity in the body frame, of length 1, if an inertial sensor tells it, and its
//! standard deviation about each horizontal axis, rad (0.001 to 0.5; 0.02 if it is left out). If the frame's own z axis
//! points up, say so in the configuration instead (`submap.gravity = "frame_z"`). A message may do without (in
//! postcard: end with its place).
//!
//! ```text
//! "up": {"direction": [0.012, -0.031, 0.9994], "sigma_rad": 0.01}
//! ```
//!
//! A sighting of another robot states how it lies and is turned (`in/sighting`: `translation`, `rotation` and
//! `covariance` of `t_body_other`, as in a keyframe); a range and a bearing, or a detection in an image of known depth,
//! states where its body is alone (`in/position`), with the upper triangle of the 3×3 covariance, row by row:
//!
//! ```text
//! {"stamp_ns": 1700000000000000000, "robot": "beta", "position": [2.1, -0.4, 0.0],
//!  "covariance": [1e-2, 0, 0, 4e-3, 0, 1.0]}
//! ```

mod depth;
mod diagnose;
mod error;

pub use depth::{CameraPose, Data, DepthEncoding, DepthMessage};
pub use error::ObservationError;

use crate::unmeasured::marked_unmeasured;
use merganser_protocol::agent::io::{PositionSighting, Sighting};
use merganser_protocol::config::UP_SIGMA_RAD;
use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::landmarks::Descriptor;
use merganser_protocol::submap::place::Metric;
use merganser_protocol::submap::{CovarianceOf, Keyframe, Mark, PlaceDescriptor, Up};
use merganser_protocol::time::Stamp;
use nalgebra::{Matrix3, Matrix6, Vector3};
use serde::de::{DeserializeOwned, IgnoredAny};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Points in one keyframe at most.
pub const POINTS_MAX: usize = 400_000;
/// Largest coordinate accepted, in frame units.
pub const COORDINATE_MAX: f64 = 1e7;

/// A keyframe as it travels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KeyframeMessage {
    /// When, in nanoseconds on the robot's clock.
    pub stamp_ns: i64,
    /// Translation of `t_frame_body`.
    pub translation: [f64; 3],
    /// Quaternion `[x, y, z, w]` of `t_frame_body`; normalised on arrival.
    pub rotation: [f64; 4],
    /// Upper triangle, row by row, of the 6×6 covariance of the local perturbation (ρ, φ).
    pub covariance: [f64; 21],
    /// What the covariance describes.
    #[serde(default)]
    pub covariance_of: CovarianceOf,
    /// Points in the body frame; none if the keyframe has a depth image.
    #[serde(default)]
    pub points: Vec<[f32; 3]>,
    /// What else is known of each point, if these are landmarks; else none.
    #[serde(default)]
    pub landmarks: Vec<LandmarkMessage>,
    /// What the user's own place recognition says, if there is one.
    #[serde(default)]
    pub place: Option<PlaceMessage>,
    /// What a depth camera saw, instead of points.
    #[serde(default)]
    pub depth: Option<DepthMessage>,
    /// Whether points that are not finite stand for nothing measured.
    #[serde(default)]
    pub organised: bool,
    /// Which run of the SLAM it is of, if it says: a number that is larger with each start.
    #[serde(default)]
    pub session: Option<u64>,
    /// Which way is up, if an inertial sensor tells.
    #[serde(default)]
    pub up: Option<UpMessage>,
}

/// The direction against gravity.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct UpMessage {
    /// In the body frame, of length 1.
    pub direction: [f64; 3],
    /// Standard deviation about each horizontal axis, rad.
    #[serde(default = "default_up_sigma_rad")]
    pub sigma_rad: f64,
}

fn default_up_sigma_rad() -> f64 {
    UP_SIGMA_RAD
}

/// A place descriptor of the user's own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaceMessage {
    /// What made it; only vectors of one model are compared.
    #[serde(default)]
    pub model: String,
    /// How two are compared.
    pub metric: Metric,
    /// The numbers.
    pub vector: Vec<f32>,
}

/// What is known of a landmark besides its place.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LandmarkMessage {
    /// Upper triangle, row by row, of the covariance of its place in the body frame, m² (frame units squared).
    pub covariance: [f64; 6],
    /// Who it is; equal labels are one landmark.
    #[serde(default)]
    pub label: Option<u32>,
    /// What it looks like: 256 bits, compared by how many differ.
    #[serde(default)]
    pub descriptor: Option<Descriptor>,
}

/// A sighting as it travels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SightingMessage {
    /// When, in nanoseconds on the observer's clock.
    pub stamp_ns: i64,
    /// Who was seen.
    pub robot: Name,
    /// Translation of `t_body_other`.
    pub translation: [f64; 3],
    /// Quaternion `[x, y, z, w]` of `t_body_other`.
    pub rotation: [f64; 4],
    /// Upper triangle, row by row, of the 6×6 covariance of the local perturbation (ρ, φ).
    pub covariance: [f64; 21],
}

/// Where another robot was seen, as it travels.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PositionMessage {
    /// When, in nanoseconds on the observer's clock.
    pub stamp_ns: i64,
    /// Who was seen.
    pub robot: Name,
    /// `p_body_other`: its body's origin in the observer's body frame, m.
    pub position: [f64; 3],
    /// Upper triangle, row by row, of the 3×3 covariance along the axes of the observer's body, m².
    pub covariance: [f64; 6],
}

/// How a message is encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `application/json`.
    Json,
    /// `application/octet-stream`.
    Postcard,
}

/// Decodes and checks a keyframe.
///
/// # Errors
/// [`ObservationError`].
pub fn keyframe(format: Format, bytes: &[u8]) -> Result<Keyframe, ObservationError> {
    let message = decode::<KeyframeMessage>(format, bytes).or_else(|error| match error {
        ObservationError::Postcard(_) => of_earlier_days(bytes).ok_or(error),
        _ => Err(error),
    })?;
    let is_empty = message.points.is_empty() && message.depth.is_none();
    if format == Format::Json && is_empty && !states_points(bytes) {
        return Err(ObservationError::Neither);
    }
    Keyframe::try_from(message)
}

/// Whether a JSON message says that there are no points, and does not merely lack them.
fn states_points(json: &[u8]) -> bool {
    serde_json::from_slice::<BTreeMap<String, IgnoredAny>>(json).is_ok_and(|fields| fields.contains_key("points"))
}

/// A postcard message that ends with its points or with what was added after them until some day: the rest was not
/// known yet. Each addition is a zero byte where there is nothing of it.
fn of_earlier_days(bytes: &[u8]) -> Option<KeyframeMessage> {
    const ADDED: usize = 6;
    let completed = |missing: usize| {
        let complete = [bytes, &[0; ADDED][..missing]].concat();
        let (message, rest) = postcard::take_from_bytes::<KeyframeMessage>(&complete).ok()?;
        // What was added stands for what is not there, and for nothing else. The last addition comes first.
        let m = &message;
        let nothing: [bool; ADDED] = [
            m.up.is_none(),
            m.session.is_none(),
            !m.organised,
            m.depth.is_none(),
            m.place.is_none(),
            m.landmarks.is_empty(),
        ];
        let is_so = rest.is_empty() && nothing.iter().take(missing).all(|nothing| *nothing);
        is_so.then_some(message)
    };
    (1..=ADDED).find_map(completed)
}

/// Decodes and checks a sighting.
///
/// # Errors
/// [`ObservationError`].
pub fn sighting(format: Format, bytes: &[u8]) -> Result<Sighting, ObservationError> {
    Sighting::try_from(decode::<SightingMessage>(format, bytes)?)
}

/// Decodes and checks a position.
///
/// # Errors
/// [`ObservationError`].
pub fn position(format: Format, bytes: &[u8]) -> Result<PositionSighting, ObservationError> {
    PositionSighting::try_from(decode::<PositionMessage>(format, bytes)?)
}

fn decode<T: DeserializeOwned>(format: Format, bytes: &[u8]) -> Result<T, ObservationError> {
    match format {
        Format::Json => serde_json::from_slice(bytes).map_err(|error| diagnose::json::<T>(bytes, &error)),
        Format::Postcard => match postcard::take_from_bytes(bytes) {
            Ok((value, [])) => Ok(value),
            _ if diagnose::is_json(bytes) => Err(ObservationError::Encoding),
            Ok((_, rest)) => Err(ObservationError::Trailing(rest.len())),
            Err(e) => Err(ObservationError::Postcard(e.to_string())),
        },
    }
}

impl TryFrom<KeyframeMessage> for Keyframe {
    type Error = ObservationError;
    fn try_from(mut message: KeyframeMessage) -> Result<Self, ObservationError> {
        let pose = pose(&message.translation, message.rotation, &message.covariance)?;
        if message.points.len() > POINTS_MAX {
            return Err(ObservationError::Points(message.points.len()));
        }
        if let Some(depth) = &message.depth {
            if !message.points.is_empty() {
                return Err(ObservationError::Both);
            }
            message.points = depth.points()?;
        }
        if message.organised {
            measured(&mut message)?;
        }
        if !message.points.iter().flatten().all(|&x| sane(f64::from(x))) {
            return Err(ObservationError::Number("points"));
        }
        let (points, landmarks) = (message.points.len(), message.landmarks.len());
        if landmarks != 0 && landmarks != points {
            return Err(ObservationError::Landmarks { points, landmarks });
        }
        let mark = |(index, landmark): (usize, &LandmarkMessage)| {
            mark(landmark).map_err(|error| ObservationError::LandmarkCovariance { index, error })
        };
        let marks = message.landmarks.iter().enumerate().map(mark).collect::<Result<_, _>>()?;
        let named = |place: PlaceMessage| PlaceDescriptor::new(&place.model, place.metric, place.vector);
        let place = message.place.map(named).transpose()?;
        let up = message.up.map(|up| Up::new(up.direction, up.sigma_rad)).transpose()?;
        let KeyframeMessage { stamp_ns, covariance_of, points, session, .. } = message;
        Ok(Self { stamp: Stamp(stamp_ns), session, pose, covariance_of, points, marks, place, up })
    }
}

/// Leaves the points of an organised cloud out where nothing was measured.
fn measured(message: &mut KeyframeMessage) -> Result<(), ObservationError> {
    if !message.landmarks.is_empty() {
        return Err(ObservationError::OrganisedLandmarks);
    }
    let all = message.points.len();
    message.points.retain(|point| point.iter().all(|x| x.is_finite()));
    let left_out = all - message.points.len();
    if message.points.is_empty() && all > 0 {
        return Err(ObservationError::Unmeasured(all));
    }
    tracing::debug!(left_out, of = all, "nothing was measured at some points of an organised cloud");
    Ok(())
}

/// Checks what is known of a landmark.
fn mark(landmark: &LandmarkMessage) -> Result<Mark, CovarianceError> {
    let [xx, xy, xz, yy, yz, zz] = landmark.covariance;
    let covariance = Covariance::new(Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz))?;
    Ok(Mark { covariance, label: landmark.label, descriptor: landmark.descriptor })
}

impl From<&Mark> for LandmarkMessage {
    fn from(mark: &Mark) -> Self {
        let m = mark.covariance.matrix();
        let covariance = [m[(0, 0)], m[(0, 1)], m[(0, 2)], m[(1, 1)], m[(1, 2)], m[(2, 2)]];
        Self { covariance, label: mark.label, descriptor: mark.descriptor }
    }
}

impl From<&PlaceDescriptor> for PlaceMessage {
    fn from(place: &PlaceDescriptor) -> Self {
        Self { model: place.model().into(), metric: place.metric(), vector: place.vector().to_vec() }
    }
}

impl From<&Up> for UpMessage {
    fn from(up: &Up) -> Self {
        Self { direction: (*up.direction()).into(), sigma_rad: up.sigma() }
    }
}

impl From<&Keyframe> for KeyframeMessage {
    fn from(keyframe: &Keyframe) -> Self {
        let covariance = keyframe.pose.covariance.matrix();
        Self {
            stamp_ns: keyframe.stamp.0,
            translation: keyframe.pose.pose.translation.into(),
            rotation: keyframe.pose.pose.rotation.xyzw(),
            covariance: upper_triangle(covariance),
            covariance_of: keyframe.covariance_of,
            points: keyframe.points.clone(),
            landmarks: keyframe.marks.iter().map(Into::into).collect(),
            place: keyframe.place.as_ref().map(Into::into),
            depth: None,
            organised: false,
            session: keyframe.session,
            up: keyframe.up.as_ref().map(Into::into),
        }
    }
}

impl TryFrom<SightingMessage> for Sighting {
    type Error = ObservationError;
    fn try_from(message: SightingMessage) -> Result<Self, ObservationError> {
        let checked = pose(&message.translation, message.rotation, &message.covariance)?;
        let ([x, y, z], [i, j, k, w]) = (message.translation, checked.pose.rotation.xyzw());
        Ok(Self {
            stamp: Stamp(message.stamp_ns),
            robot: message.robot,
            t_body_other: [x, y, z, i, j, k, w],
            covariance: upper_triangle(checked.covariance.matrix()),
        })
    }
}

impl TryFrom<PositionMessage> for PositionSighting {
    type Error = ObservationError;
    fn try_from(message: PositionMessage) -> Result<Self, ObservationError> {
        let PositionMessage { stamp_ns, robot, position, covariance } = message;
        if !position.iter().all(|&x| sane(x)) {
            return Err(ObservationError::Number("position"));
        }
        let [xx, xy, xz, yy, yz, zz] = covariance;
        Covariance::new(Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz))?;
        Ok(Self { stamp: Stamp(stamp_ns), robot, position, covariance })
    }
}

fn pose(
    translation: &[f64; 3],
    rotation: [f64; 4],
    covariance: &[f64; 21],
) -> Result<PoseWithCovariance, ObservationError> {
    if !translation.iter().all(|&x| sane(x)) {
        return Err(ObservationError::Number("translation"));
    }
    let rotation = So3::from_xyzw(rotation).ok_or(ObservationError::Rotation)?;
    let covariance = Covariance::new(marked_unmeasured(symmetric(covariance)))?;
    Ok(PoseWithCovariance { pose: Se3::new(rotation, Vector3::from(*translation)), covariance })
}

fn sane(x: f64) -> bool {
    x.abs() <= COORDINATE_MAX // false for NaN
}

fn symmetric(upper: &[f64; 21]) -> Matrix6<f64> {
    let mut m = Matrix6::zeros();
    let places = (0..6).flat_map(|r| (r..6).map(move |c| (r, c)));
    for ((r, c), value) in places.zip(upper) {
        m[(r, c)] = *value;
        m[(c, r)] = *value;
    }
    m
}

fn upper_triangle(m: &Matrix6<f64>) -> [f64; 21] {
    let mut upper = [0.0; 21];
    let places = (0..6).flat_map(|r| (r..6).map(move |c| (r, c)));
    for (value, (r, c)) in upper.iter_mut().zip(places) {
        *value = m[(r, c)];
    }
    upper
}

#[cfg(test)]
#[path = "observation_tests.rs"]
mod tests;

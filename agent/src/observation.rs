//! What a robot's own SLAM sends to its agent, as it travels: a keyframe or a sighting, in JSON or postcard, told by the
//! sample's encoding. Decoding is strict (the whole input, known fields only, bounded, finite, positive definite) and
//! gives domain values, or one clear error.
//!
//! ```json
//! {"stamp_ns": 1700000000000000000, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1],
//!  "covariance": [1e-4, 0, 0, 0, 0, 0,  1e-4, 0, 0, 0, 0,  1e-4, 0, 0, 0,  1e-6, 0, 0,  1e-6, 0,  1e-6],
//!  "covariance_of": "motion", "points": [[1.5, 0.2, 0.0]]}
//! ```
//!
//! Where points are landmarks (`submap.sensor = "landmarks"` or `"landmarks_2d"`), `landmarks` says of each point what else
//! is known, in the points' order: the upper triangle of its covariance, row by row, and a label or a descriptor of 256 bits
//! (32 bytes) or both. A message without `landmarks` (in postcard: one that ends with its points) has none.
//!
//! ```text
//! "points": [[1.5, 0.2, 0.0]], "landmarks": [{"covariance": [1e-3, 0, 0, 1e-3, 0, 1e-3], "label": 72}]
//! ```
//!
//! `place` is what your own place recognition (NetVLAD and the like) says of the keyframe: a vector of 2 to 16,384 numbers,
//! how two are compared (`"cosine"` or `"euclidean"`), and a name for what made it, for only vectors of one model are
//! compared. Submaps that have one are proposed for alignment by it. A message may do without (in postcard: end with its
//! landmarks).
//!
//! ```text
//! "place": {"model": "netvlad-pitts30k", "metric": "cosine", "vector": [0.017, -0.004, 0.021]}
//! ```

use merganser_protocol::agent::io::Sighting;
use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::landmarks::Descriptor;
use merganser_protocol::submap::place::Metric;
use merganser_protocol::submap::{CovarianceOf, Keyframe, Mark, PlaceDescriptor, PlaceError};
use merganser_protocol::time::Stamp;
use nalgebra::{Matrix3, Matrix6, Vector3};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};
use thiserror::Error;

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
    /// Points in the body frame.
    pub points: Vec<[f32; 3]>,
    /// What else is known of each point, if these are landmarks; else none.
    #[serde(default)]
    pub landmarks: Vec<LandmarkMessage>,
    /// What the user's own place recognition says, if there is one.
    #[serde(default)]
    pub place: Option<PlaceMessage>,
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

/// How a message is encoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Format {
    /// `application/json`.
    Json,
    /// `application/octet-stream`.
    Postcard,
}

/// Why a message is refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum ObservationError {
    /// Not the JSON wanted.
    #[error("JSON: {0}")]
    Json(String),
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
    /// Too many points.
    #[error("{0} points; send at most {POINTS_MAX}, thinned if need be")]
    Points(usize),
}

/// Decodes and checks a keyframe.
///
/// # Errors
/// [`ObservationError`].
pub fn keyframe(format: Format, bytes: &[u8]) -> Result<Keyframe, ObservationError> {
    let message = decode::<KeyframeMessage>(format, bytes).or_else(|error| match error {
        ObservationError::Postcard(_) => of_earlier_days(bytes).ok_or(error),
        _ => Err(error),
    });
    Keyframe::try_from(message?)
}

/// A postcard message that ends with its landmarks or with its points: what follows was not known yet.
fn of_earlier_days(bytes: &[u8]) -> Option<KeyframeMessage> {
    let completed = |missing: usize| {
        let complete = [bytes, &[0, 0][..missing]].concat();
        let (message, rest) = postcard::take_from_bytes::<KeyframeMessage>(&complete).ok()?;
        // What was added stands for what is not there, and for nothing else.
        let is_so = rest.is_empty() && message.place.is_none() && (missing == 1 || message.landmarks.is_empty());
        is_so.then_some(message)
    };
    completed(1).or_else(|| completed(2))
}

/// Decodes and checks a sighting.
///
/// # Errors
/// [`ObservationError`].
pub fn sighting(format: Format, bytes: &[u8]) -> Result<Sighting, ObservationError> {
    Sighting::try_from(decode::<SightingMessage>(format, bytes)?)
}

fn decode<T: DeserializeOwned>(format: Format, bytes: &[u8]) -> Result<T, ObservationError> {
    match format {
        Format::Json => serde_json::from_slice(bytes).map_err(|e| ObservationError::Json(e.to_string())),
        Format::Postcard => match postcard::take_from_bytes(bytes) {
            Ok((value, [])) => Ok(value),
            Ok((_, rest)) => Err(ObservationError::Trailing(rest.len())),
            Err(e) => Err(ObservationError::Postcard(e.to_string())),
        },
    }
}

impl TryFrom<KeyframeMessage> for Keyframe {
    type Error = ObservationError;
    fn try_from(message: KeyframeMessage) -> Result<Self, ObservationError> {
        let pose = pose(&message.translation, message.rotation, &message.covariance)?;
        if message.points.len() > POINTS_MAX {
            return Err(ObservationError::Points(message.points.len()));
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
        let stamp = Stamp(message.stamp_ns);
        Ok(Self { stamp, pose, covariance_of: message.covariance_of, points: message.points, marks, place })
    }
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

fn pose(
    translation: &[f64; 3],
    rotation: [f64; 4],
    covariance: &[f64; 21],
) -> Result<PoseWithCovariance, ObservationError> {
    if !translation.iter().all(|&x| sane(x)) {
        return Err(ObservationError::Number("translation"));
    }
    let rotation = So3::from_xyzw(rotation).ok_or(ObservationError::Rotation)?;
    let covariance = Covariance::new(symmetric(covariance))?;
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
mod tests {
    use super::*;

    fn message() -> KeyframeMessage {
        let mut covariance = [0.0; 21];
        for (i, start) in [0, 6, 11, 15, 18, 20].into_iter().enumerate() {
            covariance[start] = 1e-4 * (i + 1) as f64;
        }
        KeyframeMessage {
            stamp_ns: -5,
            translation: [1.0, 2.0, 3.0],
            rotation: [0.1, 0.2, 0.3, 0.9],
            covariance,
            covariance_of: CovarianceOf::Pose,
            points: vec![[1.0, 2.0, 3.0], [-1.0, 0.5, 0.25]],
            landmarks: vec![],
            place: None,
        }
    }

    fn of_a_place() -> KeyframeMessage {
        let place = PlaceMessage { model: "net".into(), metric: Metric::Euclidean, vector: vec![0.25, -3.0, 1.5] };
        KeyframeMessage { place: Some(place), ..message() }
    }

    fn of_landmarks() -> KeyframeMessage {
        let covariance = [0.01, 0.001, 0.0, 0.02, 0.0, 0.03];
        let named = LandmarkMessage { covariance, label: Some(72), descriptor: None };
        let described = LandmarkMessage { covariance, label: None, descriptor: Some([7; 32]) };
        KeyframeMessage { landmarks: vec![named, described], ..message() }
    }

    #[test]
    fn landmarks_travel_with_their_points() {
        let json = serde_json::to_vec(&of_landmarks()).unwrap();
        let postcard = postcard::to_stdvec(&of_landmarks()).unwrap();
        let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
        assert_eq!(a, b);
        assert_eq!((a.marks[0].label, a.marks[1].descriptor), (Some(72), Some([7; 32])));
        assert_eq!(KeyframeMessage::from(&a).landmarks, of_landmarks().landmarks);
    }

    #[test]
    fn a_place_travels_and_is_checked() {
        let json = serde_json::to_vec(&of_a_place()).unwrap();
        let postcard = postcard::to_stdvec(&of_a_place()).unwrap();
        let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
        assert_eq!(a, b);
        assert_eq!(
            KeyframeMessage::from(&a),
            KeyframeMessage { rotation: a.pose.pose.rotation.xyzw(), ..of_a_place() }
        );
        let mut zero = of_a_place();
        zero.place.as_mut().unwrap().vector = vec![0.0; 3];
        assert_eq!(Keyframe::try_from(zero), Err(ObservationError::Place(PlaceError::Zero)));
        let written = br#"{"metric": "cosine", "vector": [1, 2]}"#;
        assert_eq!(serde_json::from_slice::<PlaceMessage>(written).unwrap().model, "");
    }

    #[test]
    fn what_was_sent_before_there_were_places_or_landmarks_is_understood() {
        let whole = |message: &KeyframeMessage| postcard::to_stdvec(message).unwrap();
        let of = |bytes: &[u8]| keyframe(Format::Postcard, bytes);
        let (plain, marked, placed) = (whole(&message()), whole(&of_landmarks()), whole(&of_a_place()));
        assert!(plain.ends_with(&[0, 0]) && marked.ends_with(&[0]));
        for missing in [1, 2] {
            assert_eq!(of(&plain[..plain.len() - missing]), of(&plain));
        }
        assert_eq!(of(&marked[..marked.len() - 1]), of(&marked));
        // Anything shorter was cut.
        for (bytes, known) in [(&plain, plain.len() - 2), (&marked, marked.len() - 1), (&placed, placed.len())] {
            // Up to the end of its points or of no landmarks, it is a plain one.
            let is_plain =
                |len: usize| (plain.len() - 2..plain.len()).contains(&len) && plain.starts_with(&bytes[..len]);
            for len in (0..known).filter(|&len| !is_plain(len)) {
                assert!(of(&bytes[..len]).is_err(), "cut to {len} of {}", bytes.len());
            }
        }
        for extra in [&[0][..], &[0, 0], &[1]] {
            let longer = [&plain[..], extra].concat();
            assert_eq!(of(&longer), Err(ObservationError::Trailing(extra.len())));
        }
    }

    #[test]
    fn landmarks_that_do_not_fit_are_refused() {
        let told = |change: &dyn Fn(&mut KeyframeMessage)| {
            let mut message = of_landmarks();
            change(&mut message);
            Keyframe::try_from(message).map(drop)
        };
        assert_eq!(told(&|_| ()), Ok(()));
        assert_eq!(told(&|m| m.landmarks.truncate(1)), Err(ObservationError::Landmarks { points: 2, landmarks: 1 }));
        let error = CovarianceError::NotPositiveDefinite;
        let refused = ObservationError::LandmarkCovariance { index: 1, error };
        assert_eq!(told(&|m| m.landmarks[1].covariance[1] = 0.5), Err(refused));
        let refused = ObservationError::LandmarkCovariance { index: 0, error: CovarianceError::NotFinite };
        assert_eq!(told(&|m| m.landmarks[0].covariance[5] = f64::NAN), Err(refused));
    }

    #[test]
    fn json_and_postcard_say_the_same() {
        let json = serde_json::to_vec(&message()).unwrap();
        let postcard = postcard::to_stdvec(&message()).unwrap();
        let (a, b) = (keyframe(Format::Json, &json).unwrap(), keyframe(Format::Postcard, &postcard).unwrap());
        assert_eq!(a, b);
        assert_eq!((a.stamp, a.covariance_of, a.points.len()), (Stamp(-5), CovarianceOf::Pose, 2));
    }

    #[test]
    fn the_documented_json_is_a_keyframe() {
        let text: String = include_str!("observation.rs")
            .lines()
            .skip_while(|line| *line != "//! ```json")
            .skip(1)
            .take_while(|line| *line != "//! ```")
            .map(|line| line.trim_start_matches("//!"))
            .collect();
        keyframe(Format::Json, text.as_bytes()).unwrap();
    }

    #[test]
    fn each_damage_is_refused() {
        let refused = |change: &dyn Fn(&mut KeyframeMessage)| {
            let mut bad = message();
            change(&mut bad);
            keyframe(Format::Postcard, &postcard::to_stdvec(&bad).unwrap()).unwrap_err()
        };
        assert_eq!(refused(&|m| m.translation[1] = f64::NAN), ObservationError::Number("translation"));
        assert_eq!(refused(&|m| m.translation[1] = 2.0 * COORDINATE_MAX), ObservationError::Number("translation"));
        assert_eq!(refused(&|m| m.rotation = [0.0; 4]), ObservationError::Rotation);
        assert_eq!(refused(&|m| m.points[1][2] = f32::INFINITY), ObservationError::Number("points"));
        assert_eq!(refused(&|m| m.points = vec![[0.0; 3]; POINTS_MAX + 1]), ObservationError::Points(POINTS_MAX + 1));
        assert!(matches!(refused(&|m| m.covariance[6] = -1.0), ObservationError::Covariance(_)));
        assert!(matches!(refused(&|m| m.covariance[1] = 1.0), ObservationError::Covariance(_)));
    }

    #[test]
    fn decoding_takes_the_whole_input_and_known_fields_alone() {
        let good = postcard::to_stdvec(&message()).unwrap();
        let long = [good, vec![0, 0]].concat();
        assert_eq!(keyframe(Format::Postcard, &long), Err(ObservationError::Trailing(2)));
        let mut json = serde_json::to_value(message()).unwrap();
        json["colour"] = 1.into();
        assert!(matches!(keyframe(Format::Json, json.to_string().as_bytes()), Err(ObservationError::Json(_))));
    }

    #[test]
    fn a_sighting_is_checked_like_a_keyframe() {
        let m = message();
        let (translation, rotation, covariance) = (m.translation, m.rotation, m.covariance);
        let robot = Name::new("beta").unwrap();
        let good = SightingMessage { stamp_ns: 7, robot, translation, rotation, covariance };
        let json = serde_json::to_vec(&good).unwrap();
        let seen = sighting(Format::Json, &json).unwrap();
        assert_eq!((seen.stamp, seen.covariance), (Stamp(7), covariance));
        let bad = SightingMessage { rotation: [0.0; 4], ..good };
        assert_eq!(Sighting::try_from(bad), Err(ObservationError::Rotation));
    }
}

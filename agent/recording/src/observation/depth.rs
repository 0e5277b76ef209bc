//! A depth image as it travels in a keyframe instead of points.

use super::{ObservationError, sane};
use crate::depth::{Camera, Counts, DepthError, DepthImage};
use base64::Engine as _;
use base64::prelude::BASE64_STANDARD;
use merganser_protocol::geometry::{Se3, So3};
use nalgebra::Vector3;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};

/// A depth image and the pinhole camera that took it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DepthMessage {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Focal length along the rows, pixels.
    pub fx: f64,
    /// Focal length along the columns, pixels.
    pub fy: f64,
    /// Principal point along the rows, pixels from the middle of the first.
    pub cx: f64,
    /// Principal point along the columns, pixels from the middle of the first.
    pub cy: f64,
    /// What one count is, m: 0.001 for millimetres.
    pub unit_m: f64,
    /// Least and largest depth to use, m; without it all but the counts 0 and 65535, which stand for nothing measured.
    #[serde(default)]
    pub range_m: Option<[f64; 2]>,
    /// Where the camera is; without it the body is the camera: x right, y down, z forward.
    #[serde(default)]
    pub t_body_camera: Option<CameraPose>,
    /// What the data are.
    #[serde(default)]
    pub encoding: DepthEncoding,
    /// The image.
    pub data: Data,
}

/// The camera's pose in the body frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraPose {
    /// Translation, m.
    pub translation: [f64; 3],
    /// Quaternion `[x, y, z, w]`; normalised on arrival.
    pub rotation: [f64; 4],
}

/// How the image is written. Append only.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum DepthEncoding {
    /// Two bytes a pixel, low byte first, row by row.
    #[default]
    Raw,
    /// A PNG of 16-bit grey.
    Png,
}

/// Bytes: base64 (of the standard alphabet, padded) in JSON, themselves in postcard.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Data(pub Vec<u8>);

impl Serialize for Data {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        if serializer.is_human_readable() {
            serializer.serialize_str(&BASE64_STANDARD.encode(&self.0))
        } else {
            serializer.serialize_bytes(&self.0)
        }
    }
}

impl<'de> Deserialize<'de> for Data {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        if !deserializer.is_human_readable() {
            return Vec::deserialize(deserializer).map(Self);
        }
        let text = String::deserialize(deserializer)?;
        let refused = |error| de::Error::custom(format!("depth.data is no padded base64: {error}"));
        BASE64_STANDARD.decode(text).map(Self).map_err(refused)
    }
}

impl DepthMessage {
    /// The points that the image shows, in the body frame; of a large one, of every so many pixels
    /// ([`DepthImage::stride`]).
    pub(super) fn points(&self) -> Result<Vec<[f32; 3]>, ObservationError> {
        let t_body_camera = self.t_body_camera.map(|pose| pose.checked()).transpose()?;
        let counts = Counts::new(self.unit_m, self.range_m)?;
        let stated = [self.width, self.height];
        let image = match self.encoding {
            DepthEncoding::Raw => DepthImage::from_raw(stated, &self.data.0)?,
            DepthEncoding::Png => DepthImage::from_png(&self.data.0)?,
        };
        if image.size() != stated {
            return Err(DepthError::Size { found: image.size(), stated }.into());
        }
        let camera = Camera { fx: self.fx, fy: self.fy, cx: self.cx, cy: self.cy };
        let mut points = image.points(&camera, &counts, image.stride())?;
        if let Some(t_body_camera) = t_body_camera {
            for point in &mut points {
                let moved = t_body_camera * Vector3::from(point.map(f64::from));
                *point = [moved.x as f32, moved.y as f32, moved.z as f32];
            }
        }
        Ok(points)
    }
}

impl CameraPose {
    fn checked(self) -> Result<Se3, ObservationError> {
        if !self.translation.iter().all(|&x| sane(x)) {
            return Err(ObservationError::Number("depth.t_body_camera.translation"));
        }
        let rotation = So3::from_xyzw(self.rotation).ok_or(ObservationError::CameraRotation)?;
        Ok(Se3::new(rotation, Vector3::from(self.translation)))
    }
}

#[cfg(test)]
#[path = "depth_tests.rs"]
mod tests;

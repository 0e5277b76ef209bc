//! Depth images, and the pinhole cameras that take them: what a live keyframe and a folder of images have in common.
//! The camera looks along z, x is right and y is down; a pixel (u, v) of depth z lies at ((u − cx) z / fx, (v − cy) z /
//! fy, z). Images are rectified: a fish eye's distortion is to be taken out before.

use std::io::Cursor;
use std::ops::RangeInclusive;
use thiserror::Error;

/// Pixels of an image at most, 2048 × 2048 and more than any depth camera has: a header must not make us allocate more.
pub const PIXELS_MAX: u64 = 1 << 22;
/// Pixels that become points, at most, where nobody states a stride: every sixth of every sixth row of 640 × 480. A
/// submap keeps one point a voxel, so more would cost time and say nothing new.
pub const PIXELS_USED_MAX: usize = 10_000;
/// A camera's focal length by the width, or height, of its image: 127° to 19° of sight. Beyond lie fish eyes, whose
/// images are not rectified, and mistakes.
pub const FOCAL_BY_SIZE: RangeInclusive<f64> = 0.25..=3.0;
/// Where the principal point lies, by the width, or height. Outside this are intrinsics of an image of twice or half
/// the size: at the edge, or at a quarter.
pub const CENTRE_BY_SIZE: RangeInclusive<f64> = 0.3..=0.7;
/// What one count may be, m: from a hundredth of a millimetre to a decimetre.
pub const UNIT_M: RangeInclusive<f64> = 1e-5..=0.1;

/// Why a depth image is refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum DepthError {
    /// Not as many bytes as pixels of two bytes.
    #[error(
        "{found} bytes for {width} × {height} pixels, where {due} are due: two a pixel, row by row, low byte first"
    )]
    Length {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
        /// Bytes that are there.
        found: usize,
        /// Bytes due.
        due: u64,
    },
    /// No or too many pixels.
    #[error("{width} × {height} pixels: a depth image has one to {PIXELS_MAX} pixels; send a smaller one")]
    Pixels {
        /// Pixels in a row.
        width: u32,
        /// Rows.
        height: u32,
    },
    /// The image is of another size than stated.
    #[error("the PNG has {found:?} pixels, but width and height say {stated:?}")]
    Size {
        /// Width and height of the image.
        found: [u32; 2],
        /// As stated.
        stated: [u32; 2],
    },
    /// The PNG cannot be read.
    #[error("PNG: {0}")]
    Png(String),
    /// The PNG is no depth image.
    #[error("a depth image is 16-bit grey, not {0}")]
    Kind(String),
    /// The intrinsics are of another image.
    #[error(
        "no camera of focal lengths {fx} and {fy} and principal point {cx}, {cy} takes an image of {width} × {height} \
         pixels: all are in pixels of this very image, focal lengths {low} to {high} times its size, the principal point \
         near its middle",
        low = FOCAL_BY_SIZE.start(), high = FOCAL_BY_SIZE.end()
    )]
    Camera {
        /// Focal length along the rows, pixels.
        fx: f64,
        /// Focal length along the columns, pixels.
        fy: f64,
        /// Principal point along the rows, pixels.
        cx: f64,
        /// Principal point along the columns, pixels.
        cy: f64,
        /// Pixels in a row.
        width: usize,
        /// Rows.
        height: usize,
    },
    /// The unit can be none.
    #[error("unit_m = {0}: state how many metres one count is, {low} to {high}: 0.001 for millimetres",
        low = UNIT_M.start(), high = UNIT_M.end())]
    Unit(f64),
    /// The range can be none.
    #[error("range_m = {0:?}: state the least and the largest depth to use, in metres, the least first")]
    Range([f64; 2]),
    /// No pixel counts.
    #[error(
        "of {pixels} pixels none shows a depth of {near} to {far} m: the counts go from {low} to {high}; check unit_m and \
         range_m, or leave the keyframe out"
    )]
    Nothing {
        /// Pixels looked at.
        pixels: usize,
        /// Least depth used, m.
        near: f64,
        /// Largest depth used, m.
        far: f64,
        /// Least count there is.
        low: u16,
        /// Largest count there is.
        high: u16,
    },
}

/// Focal lengths and principal point, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Camera {
    /// Focal length along the rows.
    pub fx: f64,
    /// Focal length along the columns.
    pub fy: f64,
    /// Principal point along the rows.
    pub cx: f64,
    /// Principal point along the columns.
    pub cy: f64,
}

impl Camera {
    /// Whether it can have taken an image of so many pixels. False for NaN.
    fn takes(&self, width: usize, height: usize) -> bool {
        let one =
            |f: f64, c: f64, size: f64| FOCAL_BY_SIZE.contains(&(f / size)) && CENTRE_BY_SIZE.contains(&(c / size));
        one(self.fx, self.cx, width as f64) && one(self.fy, self.cy, height as f64)
    }
}

/// What counts mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Counts {
    unit_m: f64,
    range_m: [f64; 2],
}

impl Counts {
    /// Counts of `unit_m` metres, of which depths within `range_m` are used; without a range all but 0 and 65535, by
    /// which cameras say that they measured nothing.
    ///
    /// # Errors
    /// [`DepthError::Unit`], [`DepthError::Range`].
    pub fn new(unit_m: f64, range_m: Option<[f64; 2]>) -> Result<Self, DepthError> {
        if !UNIT_M.contains(&unit_m) {
            return Err(DepthError::Unit(unit_m));
        }
        let [near, far] = range_m.unwrap_or([unit_m, f64::from(u16::MAX - 1) * unit_m]);
        if !(near >= 0.0 && near < far && far.is_finite()) {
            return Err(DepthError::Range([near, far]));
        }
        Ok(Self { unit_m, range_m: [near.max(unit_m), far] })
    }

    /// The depth of a count, if it is used.
    fn depth(&self, count: u16) -> Option<f64> {
        let ([near, far], z) = (self.range_m, f64::from(count) * self.unit_m);
        (near..=far).contains(&z).then_some(z)
    }
}

/// An image of depths, row by row.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct DepthImage {
    width: usize,
    height: usize,
    counts: Vec<u16>,
}

impl DepthImage {
    /// An image of counts of two bytes, low byte first, row by row: what ROS calls `16UC1`.
    ///
    /// # Errors
    /// [`DepthError::Pixels`], [`DepthError::Length`].
    pub fn from_raw([width, height]: [u32; 2], bytes: &[u8]) -> Result<Self, DepthError> {
        let due = pixels(width, height)? * 2;
        if bytes.len() as u64 != due {
            return Err(DepthError::Length { width, height, found: bytes.len(), due });
        }
        let counts = bytes.as_chunks::<2>().0.iter().map(|pair| u16::from_le_bytes(*pair)).collect();
        Ok(Self { width: width as usize, height: height as usize, counts })
    }

    /// An image from a PNG of 16-bit grey.
    ///
    /// # Errors
    /// [`DepthError::Png`], [`DepthError::Pixels`], [`DepthError::Kind`].
    pub fn from_png(bytes: &[u8]) -> Result<Self, DepthError> {
        let told = |error: png::DecodingError| DepthError::Png(error.to_string());
        let mut reader = png::Decoder::new(Cursor::new(bytes)).read_info().map_err(told)?;
        let (width, height, kind) = (reader.info().width, reader.info().height, reader.output_color_type());
        pixels(width, height)?;
        let size = reader.output_buffer_size().filter(|_| kind == (png::ColorType::Grayscale, png::BitDepth::Sixteen));
        let mut samples = vec![0; size.ok_or_else(|| DepthError::Kind(format!("{kind:?}")))?];
        reader.next_frame(&mut samples).map_err(told)?;
        let counts = samples.as_chunks::<2>().0.iter().map(|pair| u16::from_be_bytes(*pair)).collect();
        Ok(Self { width: width as usize, height: height as usize, counts })
    }

    /// Width and height, pixels.
    pub fn size(&self) -> [u32; 2] {
        [self.width as u32, self.height as u32]
    }

    /// The least stride that leaves at most [`PIXELS_USED_MAX`] pixels.
    pub fn stride(&self) -> usize {
        let left = |stride: usize| self.width.div_ceil(stride) * self.height.div_ceil(stride);
        (1..).find(|stride| left(*stride) <= PIXELS_USED_MAX).unwrap_or(1)
    }

    /// The points, in the camera's frame, of every `stride`-th pixel of every `stride`-th row.
    ///
    /// # Errors
    /// [`DepthError::Camera`], [`DepthError::Nothing`].
    pub fn points(&self, camera: &Camera, counts: &Counts, stride: usize) -> Result<Vec<[f32; 3]>, DepthError> {
        let (Camera { fx, fy, cx, cy }, width, height) = (*camera, self.width, self.height);
        if !camera.takes(width, height) {
            return Err(DepthError::Camera { fx, fy, cx, cy, width, height });
        }
        let mut points = Vec::new();
        for (v, row) in self.counts.chunks_exact(width).enumerate().step_by(stride.max(1)) {
            for (u, count) in row.iter().enumerate().step_by(stride.max(1)) {
                if let Some(z) = counts.depth(*count) {
                    let (x, y) = ((u as f64 - cx) / fx * z, (v as f64 - cy) / fy * z);
                    points.push([x as f32, y as f32, z as f32]);
                }
            }
        }
        if points.is_empty() {
            let [near, far] = counts.range_m;
            let (low, high) = (self.counts.iter().min(), self.counts.iter().max());
            let (low, high) = (low.copied().unwrap_or(0), high.copied().unwrap_or(0));
            return Err(DepthError::Nothing { pixels: self.counts.len(), near, far, low, high });
        }
        Ok(points)
    }
}

fn pixels(width: u32, height: u32) -> Result<u64, DepthError> {
    match u64::from(width) * u64::from(height) {
        pixels @ 1..=PIXELS_MAX => Ok(pixels),
        _ => Err(DepthError::Pixels { width, height }),
    }
}

#[cfg(test)]
#[path = "depth_tests.rs"]
mod tests;

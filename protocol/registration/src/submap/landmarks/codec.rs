//! The binary layout of landmarks, for blobs (sent) and for records (kept). Landmarks are held quantised, as points
//! are, so that what was decoded equals what was encoded.
//!
//! Little-endian. Header: magic, version, 3 spare, voxel edge and position step (f32, frame units), count (u32), and
//! the upper triangle of the covariance that all have in common (21 × f32). Landmark: what follows (bit 0 a label, bit
//! 1 a descriptor), position 3 × i16 steps, standard deviations 3 × u8 (logarithmic), correlations xy, xz, yz 3 × i8,
//! label u32, descriptor 32 bytes.

use super::super::block::{BlockError, HEADER_LEN};
use super::{Constellation, DESCRIPTOR_LEN, Landmark, Mark};
use crate::geometry::Covariance;
use nalgebra::{Matrix3, Matrix6, Vector3};

/// Version of the layout.
const VERSION: u8 = 1;
/// Bytes of a landmark without label and descriptor.
const BARE_LEN: usize = 13;
/// Position steps per voxel: where the submap is small enough, and at least.
const STEPS_PER_VOXEL: (f64, f64) = (64.0, 16.0);
/// Largest coordinate in steps.
const STEP_MAX: f64 = 32767.0;
/// Accepted voxel edges, frame units.
const VOXEL_RANGE: core::ops::RangeInclusive<f32> = 1e-4..=1e3;
/// Levels of a standard deviation per octave; it is rounded up.
const LEVELS_PER_OCTAVE: f64 = 12.0;
/// The level of one voxel.
const LEVEL_OF_VOXEL: f64 = 128.0;
/// Steps of a correlation of one...
const CORRELATION_STEPS: f64 = 127.0;
/// ...and what is left of it, so that rounding leaves the matrix positive definite.
const CORRELATION_KEPT: f64 = 0.97;
/// Bytes of the common covariance.
const COMMON_LEN: usize = 84;
/// Bits that tell what follows.
const LABEL: u8 = 1;
const DESCRIPTOR: u8 = 2;

/// A landmark as it is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Stored {
    position: [i16; 3],
    sigmas: [u8; 3],
    correlations: [i8; 3],
    label: Option<u32>,
    descriptor: Option<[u8; DESCRIPTOR_LEN]>,
}

/// Landmarks with their scales, most important first.
#[derive(Clone, Debug, PartialEq)]
pub struct Codec {
    voxel: f32,
    step: f32,
    /// Upper triangle.
    common: [f32; 21],
    landmarks: Vec<Stored>,
}

impl Codec {
    /// The landmarks that can be stored: those too far out are left out.
    pub fn new(voxel: f64, constellation: &Constellation) -> Self {
        let Constellation { landmarks, common } = constellation;
        let reach = landmarks.iter().fold(0.0_f64, |most, l| most.max(l.at.amax()));
        let (fine, coarse) = STEPS_PER_VOXEL;
        let step = (reach / STEP_MAX).clamp(voxel / fine, voxel / coarse);
        let mut triangle = [0.0; 21];
        triangle.iter_mut().zip(upper()).for_each(|(value, at)| *value = common.matrix()[at] as f32);
        let mut chart = Self { voxel: voxel as f32, step: step as f32, common: triangle, landmarks: Vec::new() };
        chart.landmarks = landmarks.iter().filter_map(|l| chart.stored(l)).collect();
        chart
    }

    /// Edge of the thinning voxel, frame units.
    pub fn voxel(&self) -> f64 {
        f64::from(self.voxel)
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.landmarks.len()
    }

    /// The first `count`.
    #[must_use]
    pub fn first(&self, count: usize) -> Self {
        Self { landmarks: self.landmarks.iter().take(count).copied().collect(), ..*self }
    }

    /// All but the first `count`.
    #[must_use]
    pub fn after(&self, count: usize) -> Self {
        Self { landmarks: self.landmarks.iter().skip(count).copied().collect(), ..*self }
    }

    /// These landmarks and those of another chart; `None` if its scales or its common covariance are others.
    pub fn with(&self, other: &Self) -> Option<Self> {
        let landmarks = [&self.landmarks[..], &other.landmarks].concat();
        let is_alike = (self.voxel, self.step, self.common) == (other.voxel, other.step, other.common);
        is_alike.then_some(Self { landmarks, ..*self })
    }

    /// As many of the first as fit into so many bytes.
    #[must_use]
    pub fn within(&self, bytes: usize) -> Self {
        let mut left = bytes.saturating_sub(HEADER_LEN + COMMON_LEN);
        let fits = |l: &&Stored| {
            left = left.saturating_sub(l.len());
            left > 0
        };
        let count = self.landmarks.iter().take_while(fits).count();
        self.first(count)
    }

    /// Where the landmarks are.
    pub fn positions(&self) -> impl Iterator<Item = Vector3<f64>> {
        self.landmarks.iter().map(|l| Vector3::from(l.position.map(f64::from)) * f64::from(self.step))
    }

    /// The landmarks in usable form; how often each was seen is not kept.
    pub fn landmarks(&self) -> Vec<Landmark> {
        let landmark = |(at, l): (Vector3<f64>, &Stored)| Landmark { at, mark: self.mark(l), sightings: 1 };
        self.positions().zip(&self.landmarks).map(landmark).collect()
    }

    /// What the errors of all have in common.
    pub fn common(&self) -> Covariance<6> {
        Covariance::new_or_wider(matrix(&self.common))
    }

    fn stored(&self, landmark: &Landmark) -> Option<Stored> {
        let steps = landmark.at.map(|x| (x / f64::from(self.step)).round());
        if !steps.iter().all(|s| s.abs() <= STEP_MAX) {
            return None;
        }
        let covariance = landmark.mark.covariance.matrix();
        let sigmas = landmark.mark.covariance.sigmas();
        let correlation = |(r, c): (usize, usize)| {
            let value = covariance[(r, c)] / (sigmas[r] * sigmas[c]) * CORRELATION_KEPT;
            (value * CORRELATION_STEPS).round().clamp(-CORRELATION_STEPS, CORRELATION_STEPS) as i8
        };
        let level = |sigma: f64| {
            let octaves = libm::log2(sigma / self.voxel());
            (octaves * LEVELS_PER_OCTAVE + LEVEL_OF_VOXEL).ceil().clamp(0.0, 255.0) as u8
        };
        Some(Stored {
            position: [steps.x as i16, steps.y as i16, steps.z as i16],
            sigmas: [level(sigmas.x), level(sigmas.y), level(sigmas.z)],
            correlations: [(0, 1), (0, 2), (1, 2)].map(correlation),
            label: landmark.mark.label,
            descriptor: landmark.mark.descriptor,
        })
    }

    fn covariance(&self, stored: &Stored) -> Matrix3<f64> {
        let sigma = |level: u8| self.voxel() * libm::exp2((f64::from(level) - LEVEL_OF_VOXEL) / LEVELS_PER_OCTAVE);
        let sigmas = Vector3::from(stored.sigmas.map(sigma));
        let [xy, xz, yz] = stored.correlations.map(|c| f64::from(c) / CORRELATION_STEPS);
        let correlations = Matrix3::new(1.0, xy, xz, xy, 1.0, yz, xz, yz, 1.0);
        Matrix3::from_fn(|r, c| correlations[(r, c)] * sigmas[r] * sigmas[c])
    }

    fn mark(&self, stored: &Stored) -> Mark {
        let covariance = Covariance::new_or_wider(self.covariance(stored));
        Mark { covariance, label: stored.label, descriptor: stored.descriptor }
    }

    /// The landmarks as bytes, `magic` first.
    pub fn encode(&self, magic: [u8; 2]) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER_LEN + self.landmarks.iter().map(Stored::len).sum::<usize>());
        bytes.extend(magic);
        bytes.extend([VERSION, 0, 0, 0]);
        bytes.extend(self.voxel.to_le_bytes());
        bytes.extend(self.step.to_le_bytes());
        bytes.extend(u32::try_from(self.landmarks.len()).unwrap_or(u32::MAX).to_le_bytes());
        self.common.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
        for landmark in &self.landmarks {
            bytes.push(landmark.follows());
            landmark.position.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
            bytes.extend(landmark.sigmas);
            bytes.extend(landmark.correlations.map(i8::cast_unsigned));
            bytes.extend(landmark.label.into_iter().flat_map(u32::to_le_bytes));
            bytes.extend(landmark.descriptor.into_iter().flatten());
        }
        bytes
    }

    /// Parses bytes that claim to be landmarks of the kind `magic`, at most `count_max`. Accepts exactly what
    /// [`Codec::encode`] writes.
    ///
    /// # Errors
    /// [`BlockError`], naming the first check that failed.
    pub fn decode(bytes: &[u8], magic: [u8; 2], count_max: usize) -> Result<Self, BlockError> {
        let cut = BlockError::NoHeader { len: bytes.len() };
        let (header, body) = bytes.split_first_chunk::<HEADER_LEN>().ok_or(cut.clone())?;
        let [m0, m1, version, a, b, c, v0, v1, v2, v3, s0, s1, s2, s3, c0, c1, c2, c3] = *header;
        if [m0, m1] != magic {
            return Err(BlockError::WrongKind { found: [m0, m1], expected: magic });
        }
        if [version, a, b, c] != [VERSION, 0, 0, 0] {
            return Err(BlockError::UnknownLayout { version, dimensions: a, bits: b });
        }
        let voxel = f32::from_le_bytes([v0, v1, v2, v3]);
        let step = f32::from_le_bytes([s0, s1, s2, s3]);
        let count = u32::from_le_bytes([c0, c1, c2, c3]);
        let steps_per_voxel = f64::from(voxel) / f64::from(step);
        let (fine, coarse) = STEPS_PER_VOXEL;
        if !VOXEL_RANGE.contains(&voxel) || !(coarse * 0.999..=fine * 1.001).contains(&steps_per_voxel) {
            return Err(BlockError::BadScale);
        }
        if count as usize > count_max {
            return Err(BlockError::TooManyPoints { count, max: count_max });
        }
        let (common, mut body) = body.split_first_chunk::<COMMON_LEN>().ok_or(cut)?;
        let common: [f32; 21] =
            core::array::from_fn(|k| f32::from_le_bytes(core::array::from_fn(|byte| common[4 * k + byte])));
        if Covariance::new(matrix(&common)).is_err() {
            return Err(BlockError::BadScale);
        }
        let mut chart = Self { voxel, step, common, landmarks: Vec::new() };
        for index in 0..count as usize {
            let cut = BlockError::WrongLength { len: bytes.len(), expected: bytes.len() - body.len() + BARE_LEN };
            let landmark;
            (landmark, body) = Stored::take(body).ok_or(cut)?;
            let good = landmark.position.iter().all(|&x| x != i16::MIN)
                && Covariance::new(chart.covariance(&landmark)).is_ok();
            if !good || landmark.follows() != bytes_at(bytes, body, &landmark) {
                return Err(BlockError::NotCanonical { index });
            }
            chart.landmarks.push(landmark);
        }
        if !body.is_empty() {
            return Err(BlockError::WrongLength { len: bytes.len(), expected: bytes.len() - body.len() });
        }
        Ok(chart)
    }
}

/// Places of the upper triangle, row by row.
fn upper() -> impl Iterator<Item = (usize, usize)> {
    (0..6).flat_map(|row| (row..6).map(move |column| (row, column)))
}

fn matrix(triangle: &[f32; 21]) -> Matrix6<f64> {
    let mut m = Matrix6::zeros();
    for (&value, (row, column)) in triangle.iter().zip(upper()) {
        (m[(row, column)], m[(column, row)]) = (f64::from(value), f64::from(value));
    }
    m
}

/// The byte that a landmark begins with, of which `rest` is what follows it in `bytes`.
fn bytes_at(bytes: &[u8], rest: &[u8], landmark: &Stored) -> u8 {
    let begin = bytes.len().saturating_sub(rest.len() + landmark.len());
    bytes.get(begin).copied().unwrap_or(u8::MAX)
}

impl Stored {
    fn follows(&self) -> u8 {
        LABEL * u8::from(self.label.is_some()) + DESCRIPTOR * u8::from(self.descriptor.is_some())
    }

    fn len(&self) -> usize {
        let label = if self.label.is_some() { 4 } else { 0 };
        BARE_LEN + label + if self.descriptor.is_some() { DESCRIPTOR_LEN } else { 0 }
    }

    /// The first landmark of `bytes` and the rest; `None` if it is cut off.
    fn take(bytes: &[u8]) -> Option<(Self, &[u8])> {
        let (bare, mut rest) = bytes.split_first_chunk::<BARE_LEN>()?;
        let [follows, x0, x1, y0, y1, z0, z1, sx, sy, sz, xy, xz, yz] = *bare;
        let (mut label, mut descriptor) = (None, None);
        if follows & LABEL != 0 {
            let value;
            (value, rest) = rest.split_first_chunk::<4>()?;
            label = Some(u32::from_le_bytes(*value));
        }
        if follows & DESCRIPTOR != 0 {
            let value;
            (value, rest) = rest.split_first_chunk::<DESCRIPTOR_LEN>()?;
            descriptor = Some(*value);
        }
        let position = [[x0, x1], [y0, y1], [z0, z1]].map(i16::from_le_bytes);
        let correlations = [xy, xz, yz].map(u8::cast_signed);
        Some((Self { position, sigmas: [sx, sy, sz], correlations, label, descriptor }, rest))
    }
}

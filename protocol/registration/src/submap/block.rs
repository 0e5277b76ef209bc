//! The one binary layout of points, used for keypoint blobs (sent, with descriptors) and for features (kept, without):
//! a header with every dimension and scale, then 9 bytes a point and its descriptor. Points are held quantised, so that
//! what was decoded equals what was encoded, and what a restarted robot computes equals what it computed before.
//!
//! Little-endian. Header: magic, version, descriptor dimensions, bits, voxel edge and position step (f32, frame units),
//! count. Point: position 3 × i16 steps, normal as octahedral 2 × u8, roughness u8 (255: no surface), descriptor.

use super::descriptor;
use super::surface::Normal;
use nalgebra::Vector3;
use thiserror::Error;

/// Version of the layout.
const VERSION: u8 = 2;
/// Bytes before the first point.
pub const HEADER_LEN: usize = 18;
/// Bytes of one point without its descriptor.
pub const BARE_LEN: usize = 9;
/// Position steps per voxel where the cloud is small enough: quantisation then costs 0.5 % of a voxel.
const STEPS_PER_VOXEL: f64 = 64.0;
/// Position steps per voxel at least: points so far out that they need coarser ones are left out.
const STEPS_PER_VOXEL_MIN: f64 = 16.0;
/// Largest coordinate in steps.
const STEP_MAX: f64 = 32767.0;
/// Roughness levels per voxel.
const ROUGHNESS_LEVELS_PER_VOXEL: f64 = 200.0;
/// The roughness level of a point without a surface.
const NO_SURFACE: u8 = 255;
/// Half the range of an octahedral coordinate: 0 to 254 with 127 in the middle, so that axes are exact.
const OCTAHEDRAL_HALF: f64 = 127.0;
/// Accepted voxel edges, frame units.
const VOXEL_RANGE: core::ops::RangeInclusive<f32> = 1e-4..=1e3;

/// Why bytes are no block of points.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum BlockError {
    /// Fewer bytes than the header.
    #[error("{len} bytes are shorter than the {HEADER_LEN}-byte header of a point block; fetch it again")]
    NoHeader {
        /// How many there are.
        len: usize,
    },
    /// Another kind of data.
    #[error("not the expected kind of point block: it begins with {found:02x?}, not {expected:02x?}")]
    WrongKind {
        /// The first two bytes.
        found: [u8; 2],
        /// What they should be.
        expected: [u8; 2],
    },
    /// A layout this code does not know.
    #[error("point block of version {version} with {dimensions} dimensions of {bits} bits: update the older robot")]
    UnknownLayout {
        /// Layout version.
        version: u8,
        /// Numbers in a descriptor.
        dimensions: u8,
        /// Bits of each.
        bits: u8,
    },
    /// The voxel edge or the position step is not a usable number.
    #[error("point block states a voxel edge or position step out of range; its writer is faulty")]
    BadScale,
    /// The header claims more points than accepted.
    #[error("point block claims {count} points, at most {max} are accepted")]
    TooManyPoints {
        /// The claim.
        count: u32,
        /// The bound.
        max: usize,
    },
    /// The length does not fit the count.
    #[error("point block of {len} bytes should have {expected}; it was cut or padded")]
    WrongLength {
        /// How many bytes there are.
        len: usize,
        /// How many the header asks for.
        expected: usize,
    },
    /// A point uses a code that no encoder writes.
    #[error("point {index} of the block is not in canonical form; its writer is faulty")]
    NotCanonical {
        /// Which point.
        index: usize,
    },
}

/// A point as it is stored: quantised, with `N` bytes of descriptor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stored<const N: usize> {
    position: [i16; 3],
    normal: [u8; 2],
    roughness: u8,
    /// The point's descriptor.
    pub descriptor: [u8; N],
}

impl Stored<0> {
    /// The point with a descriptor.
    pub fn with<const N: usize>(self, descriptor: [u8; N]) -> Stored<N> {
        let Self { position, normal, roughness, .. } = self;
        Stored { position, normal, roughness, descriptor }
    }
}

/// A point as it is used: a small piece of surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Surfel {
    /// Position in the submap's anchor frame, frame units.
    pub position: Vector3<f64>,
    /// Unit normal, towards the sensor.
    pub normal: Vector3<f64>,
    /// Standard deviation of the neighbourhood about its plane, frame units; `None` where the normal means nothing.
    pub roughness: Option<f64>,
}

/// Points with their scales.
#[derive(Clone, Debug, PartialEq)]
pub struct Block<const N: usize> {
    /// Edge of the thinning voxel, frame units.
    voxel: f32,
    /// Frame units per position step.
    step: f32,
    /// The points, most important first.
    pub points: Vec<Stored<N>>,
}

impl<const N: usize> Block<N> {
    /// Bytes of one point.
    pub const POINT_LEN: usize = BARE_LEN + N;
    /// What the header says of descriptors: how many numbers, and bits of each.
    const LAYOUT: (usize, usize) = if N == 0 { (0, 0) } else { (descriptor::DIMENSIONS, descriptor::BITS) };

    /// An empty block for points of a cloud thinned to `voxel`, the farthest at `reach` along any axis.
    pub fn new(voxel: f64, reach: f64) -> Self {
        let step = (reach / STEP_MAX).clamp(voxel / STEPS_PER_VOXEL, voxel / STEPS_PER_VOXEL_MIN);
        Self { voxel: voxel as f32, step: step as f32, points: Vec::new() }
    }

    /// An empty block with this one's scales.
    pub fn like<const M: usize>(&self) -> Block<M> {
        Block { voxel: self.voxel, step: self.step, points: Vec::new() }
    }

    /// These points and those of another block; `None` if its scales are others.
    pub fn with(&self, other: &Self) -> Option<Self> {
        let points = [&self.points[..], &other.points].concat();
        (self.voxel == other.voxel && self.step == other.step).then_some(Self { points, ..*self })
    }

    /// Edge of the thinning voxel, frame units.
    pub fn voxel(&self) -> f64 {
        f64::from(self.voxel)
    }

    /// Frame units per position step.
    pub fn step(&self) -> f64 {
        f64::from(self.step)
    }

    /// The point in stored form (the normal's roughness is in voxels); `None` if it lies too far out.
    pub fn store(&self, position: &Vector3<f64>, normal: &Normal, descriptor: [u8; N]) -> Option<Stored<N>> {
        let steps = position.map(|x| (x / f64::from(self.step)).round());
        if !steps.iter().all(|s| s.abs() <= STEP_MAX) {
            return None;
        }
        let roughness = normal.roughness.map_or(NO_SURFACE, |r| {
            (r * ROUGHNESS_LEVELS_PER_VOXEL).round().clamp(0.0, f64::from(NO_SURFACE - 1)) as u8
        });
        Some(Stored {
            position: [steps.x as i16, steps.y as i16, steps.z as i16],
            normal: octahedral(&normal.direction),
            roughness,
            descriptor,
        })
    }

    /// Whether a point can be stored.
    pub fn reaches(&self, position: &[f32; 3]) -> bool {
        position.iter().all(|x| (f64::from(*x) / f64::from(self.step)).round().abs() <= STEP_MAX)
    }

    /// The points in usable form.
    pub fn surfels(&self) -> Vec<Surfel> {
        self.points.iter().map(|p| self.surfel(p)).collect()
    }

    fn surfel(&self, point: &Stored<N>) -> Surfel {
        let roughness = f64::from(point.roughness) * self.voxel() / ROUGHNESS_LEVELS_PER_VOXEL;
        Surfel {
            position: Vector3::from(point.position.map(f64::from)) * f64::from(self.step),
            normal: from_octahedral(point.normal),
            roughness: (point.roughness != NO_SURFACE).then_some(roughness),
        }
    }

    /// The block as bytes, `magic` first.
    pub fn encode(&self, magic: [u8; 2]) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(HEADER_LEN + self.points.len() * Self::POINT_LEN);
        bytes.extend(magic);
        bytes.extend([VERSION, Self::LAYOUT.0 as u8, Self::LAYOUT.1 as u8, 0]);
        bytes.extend(self.voxel.to_le_bytes());
        bytes.extend(self.step.to_le_bytes());
        bytes.extend(u32::try_from(self.points.len()).unwrap_or(u32::MAX).to_le_bytes());
        for point in &self.points {
            point.position.iter().for_each(|x| bytes.extend(x.to_le_bytes()));
            bytes.extend(point.normal);
            bytes.push(point.roughness);
            bytes.extend(point.descriptor);
        }
        bytes
    }

    /// Parses bytes that claim to be a block of the kind `magic` with at most `points_max` points. Accepts exactly what
    /// [`Block::encode`] writes.
    ///
    /// # Errors
    /// [`BlockError`], naming the first check that failed.
    pub fn decode(bytes: &[u8], magic: [u8; 2], points_max: usize) -> Result<Self, BlockError> {
        let (header, body) =
            bytes.split_first_chunk::<HEADER_LEN>().ok_or(BlockError::NoHeader { len: bytes.len() })?;
        let [m0, m1, version, dimensions, bits, spare, scales_and_count @ ..] = *header;
        if [m0, m1] != magic {
            return Err(BlockError::WrongKind { found: [m0, m1], expected: magic });
        }
        if (version, usize::from(dimensions), usize::from(bits), spare) != (VERSION, Self::LAYOUT.0, Self::LAYOUT.1, 0)
        {
            return Err(BlockError::UnknownLayout { version, dimensions, bits });
        }
        let [v0, v1, v2, v3, s0, s1, s2, s3, c0, c1, c2, c3] = scales_and_count;
        let voxel = f32::from_le_bytes([v0, v1, v2, v3]);
        let step = f32::from_le_bytes([s0, s1, s2, s3]);
        let count = u32::from_le_bytes([c0, c1, c2, c3]);
        let steps_per_voxel = f64::from(voxel) / f64::from(step);
        let steps_accepted = STEPS_PER_VOXEL_MIN * 0.999..=STEPS_PER_VOXEL * 1.001;
        if !VOXEL_RANGE.contains(&voxel) || !steps_accepted.contains(&steps_per_voxel) {
            return Err(BlockError::BadScale);
        }
        if count as usize > points_max {
            return Err(BlockError::TooManyPoints { count, max: points_max });
        }
        let expected = HEADER_LEN + count as usize * Self::POINT_LEN;
        if bytes.len() != expected {
            return Err(BlockError::WrongLength { len: bytes.len(), expected });
        }
        let points = body.chunks_exact(Self::POINT_LEN).enumerate();
        let points = points.map(|(index, p)| stored(p).ok_or(BlockError::NotCanonical { index }));
        Ok(Self { voxel, step, points: points.collect::<Result<_, _>>()? })
    }
}

/// Parses one point; `None` if it uses a code that [`Block::store`] never makes.
fn stored<const N: usize>(bytes: &[u8]) -> Option<Stored<N>> {
    let (bare, descriptor) = bytes.split_first_chunk::<BARE_LEN>()?;
    let [x0, x1, y0, y1, z0, z1, n0, n1, roughness] = *bare;
    let position = [i16::from_le_bytes([x0, x1]), i16::from_le_bytes([y0, y1]), i16::from_le_bytes([z0, z1])];
    let good = position.iter().all(|&x| x != i16::MIN) && n0 != 255 && n1 != 255;
    let descriptor = descriptor.try_into().ok()?;
    good.then_some(Stored { position, normal: [n0, n1], roughness, descriptor })
}

/// A unit vector as a point of the unfolded octahedron (Cigolle et al. 2014), about 0.5° apart.
fn octahedral(n: &Vector3<f64>) -> [u8; 2] {
    unfolded(n).map(|c| ((c + 1.0) * OCTAHEDRAL_HALF).round().clamp(0.0, 2.0 * OCTAHEDRAL_HALF) as u8)
}

fn from_octahedral(code: [u8; 2]) -> Vector3<f64> {
    folded(code.map(|c| f64::from(c) / OCTAHEDRAL_HALF - 1.0))
}

/// Where a unit vector lies on the unfolded octahedron: two coordinates from -1 to 1.
pub(super) fn unfolded(n: &Vector3<f64>) -> [f64; 2] {
    let sum = n.x.abs() + n.y.abs() + n.z.abs();
    let (x, y) = (n.x / sum, n.y / sum);
    if n.z < 0.0 { [fold(x, y), fold(y, x)] } else { [x, y] }
}

/// The unit vector there.
pub(super) fn folded([x, y]: [f64; 2]) -> Vector3<f64> {
    let z = 1.0 - x.abs() - y.abs();
    let (x, y) = if z < 0.0 { (fold(x, y), fold(y, x)) } else { (x, y) };
    Vector3::new(x, y, z).normalize()
}

/// Mirrors the coordinate `a` of the lower half of the octahedron over its rim.
fn fold(a: f64, b: f64) -> f64 {
    (1.0 - b.abs()) * if a < 0.0 { -1.0 } else { 1.0 }
}

#[cfg(test)]
#[path = "block_tests.rs"]
mod tests;

//! Poses and similarities as plain numbers. Translations are f64 (lossless); a rotation is the three smaller
//! components of its unit quaternion on a lattice, the largest made positive and recomputed, so that no quaternion of
//! another length, zero included, can be stated. Loss: at most 2.6e-8 rad in facts, 2.2e-4 rad in beacons.

use super::lattice::{BEACON_BITS, FACT_BITS, Lattice};
use super::limits::{SCALE_MAX, TRANSLATION_MAX};
use crate::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3, Sim3, SimWithCovariance, So3};
use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Quaternion lattice in facts: components in units of 2^−27.
const FACT_ROTATION_BITS: u32 = 27;
/// Quaternion lattice in beacons.
const BEACON_ROTATION_BITS: u32 = 14;

/// Why numbers are no pose.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum PoseError {
    /// A coordinate is NaN or infinite.
    #[error("translation is not finite")]
    NotFinite,
    /// A coordinate is larger than [`TRANSLATION_MAX`].
    #[error("translation is beyond {TRANSLATION_MAX} units; use a local frame")]
    TooFar,
    /// The quaternion is zero, not finite or not of unit length.
    #[error("quaternion is zero or no rotation; send a unit quaternion x, y, z, w")]
    Rotation,
    /// The scale is not a positive number in range.
    #[error("scale is not in [1/{SCALE_MAX}, {SCALE_MAX}]")]
    Scale,
}

/// A pose from seven plain numbers: translation `[x, y, z]`, quaternion `[x, y, z, w]` of any non-zero length.
///
/// # Errors
/// [`PoseError`] for NaN, infinite or out-of-range coordinates and for a (nearly) zero quaternion.
pub fn pose_from_numbers([x, y, z, qx, qy, qz, qw]: [f64; 7]) -> Result<Se3, PoseError> {
    let translation = translation([x, y, z])?;
    Ok(Se3::new(So3::from_xyzw([qx, qy, qz, qw]).ok_or(PoseError::Rotation)?, translation))
}

fn translation(t: [f64; 3]) -> Result<Vector3<f64>, PoseError> {
    if t.iter().any(|c| !c.is_finite()) {
        return Err(PoseError::NotFinite);
    }
    if t.iter().any(|c| c.abs() > TRANSLATION_MAX) {
        return Err(PoseError::TooFar);
    }
    Ok(Vector3::from(t))
}

/// The place of the largest component and the other three, in units of 2^−bits. Ties on the lattice go to the first.
fn encode_rotation(rotation: &So3, bits: u32) -> (u8, [i32; 3]) {
    let unit = f64::from(1u32 << bits);
    let q = rotation.xyzw().map(|c| (c * unit).round() as i32);
    let mut largest = 0;
    for i in 1..4 {
        if q[i].abs() > q[largest].abs() {
            largest = i;
        }
    }
    let sign = q[largest].signum();
    let mut others = [0; 3];
    for (k, i) in (0..4).filter(|&i| i != largest).enumerate() {
        others[k] = sign * q[i];
    }
    (largest as u8, others)
}

fn decode_rotation(largest: u8, others: [i32; 3], bits: u32) -> Result<So3, PoseError> {
    let one = 1i64 << (2 * bits);
    let squares = others.iter().try_fold(0i64, |sum, &q| sum.checked_add(i64::from(q) * i64::from(q)));
    let rest = squares.and_then(|s| one.checked_sub(s)).filter(|&rest| rest > 0).ok_or(PoseError::Rotation)?;
    let largest = usize::from(largest);
    if largest > 3 {
        return Err(PoseError::Rotation);
    }
    let unit = f64::from(1u32 << bits);
    let mut q = [0.0; 4];
    q[largest] = (rest as f64).sqrt() / unit;
    for (k, i) in (0..4).filter(|&i| i != largest).enumerate() {
        q[i] = f64::from(others[k]) / unit;
    }
    So3::from_xyzw(q).ok_or(PoseError::Rotation)
}

/// A rigid motion in a fact: 38 bytes or fewer.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RawPose {
    translation: [f64; 3],
    largest: u8,
    others: [i32; 3],
}

impl RawPose {
    pub fn of(pose: &Se3) -> Result<Self, PoseError> {
        let t: [f64; 3] = pose.translation.into();
        translation(t)?;
        let (largest, others) = encode_rotation(&pose.rotation, FACT_ROTATION_BITS);
        Ok(Self { translation: t, largest, others })
    }

    pub fn parse(&self) -> Result<Se3, PoseError> {
        let translation = translation(self.translation)?;
        Ok(Se3::new(decode_rotation(self.largest, self.others, FACT_ROTATION_BITS)?, translation))
    }
}

/// A pose with covariance in a fact.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RawPoseWithCovariance {
    pose: RawPose,
    exponents: [i8; 6],
    factor: [i32; 21],
}

/// The covariance of a point in a fact.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RawPointCovariance {
    exponents: [i8; 3],
    factor: [i32; 6],
}

impl RawPointCovariance {
    pub fn of(covariance: &Covariance<3>) -> Result<Self, EstimateError> {
        let lattice = Lattice::encode(covariance, FACT_BITS)?;
        Ok(Self { exponents: lattice.exponents, factor: packed(&lattice.factor) })
    }

    pub fn parse(&self) -> Result<Covariance<3>, EstimateError> {
        Ok(Lattice { exponents: self.exponents, factor: unpacked(&self.factor) }.decode(FACT_BITS)?)
    }
}

/// A pose or a covariance that cannot be read or written.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum EstimateError {
    /// The mean.
    #[error(transparent)]
    Pose(#[from] PoseError),
    /// The covariance.
    #[error(transparent)]
    Covariance(#[from] CovarianceError),
}

impl RawPoseWithCovariance {
    pub fn of(p: &PoseWithCovariance) -> Result<Self, EstimateError> {
        let lattice = Lattice::encode(&p.covariance, FACT_BITS)?;
        Ok(Self { pose: RawPose::of(&p.pose)?, exponents: lattice.exponents, factor: packed(&lattice.factor) })
    }

    pub fn parse(&self) -> Result<PoseWithCovariance, EstimateError> {
        let lattice = Lattice { exponents: self.exponents, factor: unpacked(&self.factor) };
        Ok(PoseWithCovariance { pose: self.pose.parse()?, covariance: lattice.decode(FACT_BITS)? })
    }
}

/// A similarity with covariance in a fact.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RawSimWithCovariance {
    pose: RawPose,
    scale: f64,
    exponents: [i8; 7],
    factor: [i32; 28],
}

impl RawSimWithCovariance {
    pub fn of(s: &SimWithCovariance) -> Result<Self, EstimateError> {
        let lattice = Lattice::encode(&s.covariance, FACT_BITS)?;
        let pose = RawPose::of(&s.sim.to_se3())?;
        let scale = scale(s.sim.scale)?;
        Ok(Self { pose, scale, exponents: lattice.exponents, factor: packed(&lattice.factor) })
    }

    pub fn parse(&self) -> Result<SimWithCovariance, EstimateError> {
        let lattice = Lattice { exponents: self.exponents, factor: unpacked(&self.factor) };
        let pose = self.pose.parse()?;
        let sim = Sim3::new(pose.rotation, pose.translation, scale(self.scale)?);
        Ok(SimWithCovariance { sim, covariance: lattice.decode(FACT_BITS)? })
    }
}

fn scale(s: f64) -> Result<f64, PoseError> {
    if (1.0 / SCALE_MAX..=SCALE_MAX).contains(&s) { Ok(s) } else { Err(PoseError::Scale) }
}

/// The lower triangle, row by row.
fn packed<const N: usize, const M: usize>(factor: &[[i32; N]; N]) -> [i32; M] {
    let mut out = [0; M];
    for (k, (r, c)) in lower_triangle(N).enumerate() {
        out[k] = factor[r][c];
    }
    out
}

fn unpacked<const N: usize, const M: usize>(packed: &[i32; M]) -> [[i32; N]; N] {
    let mut out = [[0; N]; N];
    for (k, (r, c)) in lower_triangle(N).enumerate() {
        out[r][c] = packed[k];
    }
    out
}

fn lower_triangle(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(|r| (0..=r).map(move |c| (r, c)))
}

/// Bytes of a beacon's rotation: 2 + 3·15 bits.
const ROTATION_LEN: usize = 6;
/// Bytes of a beacon's covariance factor: 21·11 bits.
const FACTOR_LEN: usize = 29;

/// A pose with covariance in a beacon, in exactly 53 bytes: f32 translation, everything else packed to the bit.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct RawBeaconPose {
    translation: [f32; 3],
    rotation: [u8; ROTATION_LEN],
    exponents: [i8; 6],
    factor: [u8; FACTOR_LEN],
}

impl RawBeaconPose {
    pub fn of(p: &PoseWithCovariance) -> Result<Self, EstimateError> {
        let t: [f64; 3] = p.pose.translation.into();
        translation(t)?;
        let (largest, others) = encode_rotation(&p.pose.rotation, BEACON_ROTATION_BITS);
        let mut rotation = Bits::<ROTATION_LEN>::default();
        rotation.put(i32::from(largest), 2);
        others.iter().for_each(|&q| rotation.put(q, BEACON_ROTATION_BITS + 1));
        let lattice = Lattice::encode(&p.covariance, BEACON_BITS)?;
        let mut factor = Bits::<FACTOR_LEN>::default();
        lower_triangle(6).for_each(|(r, c)| factor.put(lattice.factor[r][c], BEACON_BITS as u32 + 1));
        Ok(Self {
            translation: t.map(|c| c as f32),
            rotation: rotation.bytes,
            exponents: lattice.exponents,
            factor: factor.bytes,
        })
    }

    pub fn parse(&self) -> Result<PoseWithCovariance, EstimateError> {
        let translation = translation(self.translation.map(f64::from))?;
        let mut rotation = Bits { bytes: self.rotation, at: 0 };
        let largest = rotation.take(2) as u8 & 3;
        let others = core::array::from_fn(|_| rotation.take(BEACON_ROTATION_BITS + 1));
        let rotation = decode_rotation(largest, others, BEACON_ROTATION_BITS)?;
        let mut bits = Bits { bytes: self.factor, at: 0 };
        let mut lattice = Lattice { exponents: self.exponents, factor: [[0; 6]; 6] };
        lower_triangle(6).for_each(|(r, c)| lattice.factor[r][c] = bits.take(BEACON_BITS as u32 + 1));
        Ok(PoseWithCovariance { pose: Se3::new(rotation, translation), covariance: lattice.decode(BEACON_BITS)? })
    }
}

/// Signed integers packed to the bit, least significant first.
struct Bits<const LEN: usize> {
    bytes: [u8; LEN],
    at: usize,
}

impl<const LEN: usize> Default for Bits<LEN> {
    fn default() -> Self {
        Self { bytes: [0; LEN], at: 0 }
    }
}

impl<const LEN: usize> Bits<LEN> {
    fn put(&mut self, value: i32, width: u32) {
        for bit in 0..width {
            self.bytes[self.at / 8] |= ((value >> bit & 1) as u8) << (self.at % 8);
            self.at += 1;
        }
    }

    fn take(&mut self, width: u32) -> i32 {
        let mut value = 0u32;
        for bit in 0..width {
            value |= u32::from(self.bytes[self.at / 8] >> (self.at % 8) & 1) << bit;
            self.at += 1;
        }
        // Extend the sign.
        (value << (32 - width)) as i32 >> (32 - width)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn rotations_survive_within_the_stated_loss(q in proptest::array::uniform4(-1.0..1.0f64)) {
            let Some(rotation) = So3::from_xyzw(q) else { return Ok(()) };
            for (bits, loss) in [(FACT_ROTATION_BITS, 2.6e-8), (BEACON_ROTATION_BITS, 2.2e-4)] {
                let (largest, others) = encode_rotation(&rotation, bits);
                let back = decode_rotation(largest, others, bits).unwrap();
                prop_assert!((rotation.inverse() * back).angle() <= loss);
            }
        }

        #[test]
        fn packed_integers_come_back(values in proptest::collection::vec(-1024..1024i32, 21)) {
            let mut bits = Bits::<FACTOR_LEN>::default();
            values.iter().for_each(|&v| bits.put(v, 11));
            let mut bits = Bits { bytes: bits.bytes, at: 0 };
            for v in values {
                prop_assert_eq!(bits.take(11), v);
            }
        }
    }

    #[test]
    fn numbers_that_are_no_pose_are_refused() {
        let good = [1.0, 2.0, 3.0, 0.0, 0.0, 0.0, 2.0];
        assert!(pose_from_numbers(good).is_ok());
        for (at, value, error) in [
            (0, f64::NAN, PoseError::NotFinite),
            (2, f64::INFINITY, PoseError::NotFinite),
            (1, 2.0 * TRANSLATION_MAX, PoseError::TooFar),
            (6, 0.0, PoseError::Rotation),
            (6, f64::NAN, PoseError::Rotation),
        ] {
            let mut bad = good;
            bad[at] = value;
            assert_eq!(pose_from_numbers(bad), Err(error));
        }
        let one = 1 << FACT_ROTATION_BITS;
        assert_eq!(decode_rotation(0, [one, 0, 0], FACT_ROTATION_BITS), Err(PoseError::Rotation));
        assert_eq!(decode_rotation(0, [i32::MIN; 3], FACT_ROTATION_BITS), Err(PoseError::Rotation));
        assert_eq!(decode_rotation(4, [0; 3], FACT_ROTATION_BITS), Err(PoseError::Rotation));
        assert!(decode_rotation(3, [0; 3], FACT_ROTATION_BITS).is_ok());
    }

    #[test]
    fn scales_are_checked_on_both_sides() {
        for good in [1.0 / SCALE_MAX, 1.0, SCALE_MAX] {
            assert_eq!(scale(good), Ok(good));
        }
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 2.0 * SCALE_MAX, 0.5 / SCALE_MAX] {
            assert_eq!(scale(bad), Err(PoseError::Scale));
        }
    }
}

//! Point clouds on disk: reads any [`CloudFormat`] into bounded memory, writes PLY and the raw formats. Points are
//! metres in the body frame; every point must be finite, and no claim in a header makes us allocate more than the file
//! itself can hold.

pub use super::limits::{CLOUD_BYTES_MAX, POINTS_MAX};

use super::bounded::{Fault, bounded, read_bytes};
use super::error::{Problem, RecordingError};
use super::{pcd, ply};
use crate::manifest::{CloudFormat, XYZ_I16_UNIT_M};
use crate::observation::COORDINATE_MAX;
use std::path::Path;

/// Reads a cloud.
///
/// # Errors
/// [`RecordingError`]: unreadable, empty, cut off, over [`POINTS_MAX`] or [`CLOUD_BYTES_MAX`], or not finite.
pub fn read(path: &Path, format: CloudFormat) -> Result<Vec<[f32; 3]>, RecordingError> {
    let bytes = read_bytes(path)?;
    parse(&bytes, format).map_err(|fault| RecordingError {
        path: path.into(),
        line: fault.line,
        problem: fault.problem,
    })
}

fn parse(bytes: &[u8], format: CloudFormat) -> Result<Vec<[f32; 3]>, Fault> {
    let points = match format {
        CloudFormat::Ply => ply::parse(bytes)?,
        CloudFormat::Pcd => pcd::parse(bytes)?,
        CloudFormat::KittiBin => raw::<16>(bytes, f32s)?,
        CloudFormat::XyzBin => raw::<12>(bytes, f32s)?,
        CloudFormat::XyzI16 => raw::<6>(bytes, i16s)?,
    };
    if points.is_empty() {
        return Err(Problem::CloudEmpty.into());
    }
    let near = |c: &f32| f64::from(c.abs()) <= COORDINATE_MAX; // false for NaN
    match points.iter().position(|point| !point.iter().all(near)) {
        Some(index) => Err(Problem::Point(index).into()),
        None => Ok(points),
    }
}

/// Records of `N` bytes without a header.
fn raw<const N: usize>(bytes: &[u8], point: fn(&[u8; N]) -> [f32; 3]) -> Result<Vec<[f32; 3]>, Problem> {
    let (records, rest) = bytes.as_chunks::<N>();
    if !rest.is_empty() {
        return Err(Problem::CloudLength { found: bytes.len(), expected: (records.len() + 1) * N });
    }
    bounded(records.len() as u64)?;
    Ok(records.iter().map(point).collect())
}

fn f32s<const N: usize>(record: &[u8; N]) -> [f32; 3] {
    let (words, _) = record.as_chunks::<4>();
    [0, 1, 2].map(|axis| f32::from_le_bytes(words[axis]))
}

fn i16s(record: &[u8; 6]) -> [f32; 3] {
    let (words, _) = record.as_chunks::<2>();
    [0, 1, 2].map(|axis| (f64::from(i16::from_le_bytes(words[axis])) * XYZ_I16_UNIT_M) as f32)
}

/// The bytes of a cloud in a format that we write.
///
/// # Errors
/// [`Problem::Pcd`]: PCD is read only. [`Problem::Point`]: a coordinate that [`CloudFormat::XyzI16`] cannot hold.
pub fn encode(points: &[[f32; 3]], format: CloudFormat) -> Result<Vec<u8>, Problem> {
    match format {
        CloudFormat::Ply => Ok(ply::encode(points)),
        CloudFormat::Pcd => Err(Problem::Pcd("clouds are not written as PCD; choose ply".into())),
        CloudFormat::KittiBin => Ok(floats(points.iter().flat_map(|p| [p[0], p[1], p[2], 0.0]))),
        CloudFormat::XyzBin => Ok(floats(points.iter().copied().flatten())),
        CloudFormat::XyzI16 => {
            let mut bytes = Vec::with_capacity(points.len() * 6);
            for (index, point) in points.iter().enumerate() {
                for c in point {
                    let units = (f64::from(*c) / XYZ_I16_UNIT_M).round();
                    if !(f64::from(i16::MIN)..=f64::from(i16::MAX)).contains(&units) {
                        return Err(Problem::Point(index));
                    }
                    bytes.extend((units as i16).to_le_bytes());
                }
            }
            Ok(bytes)
        }
    }
}

fn floats(values: impl Iterator<Item = f32>) -> Vec<u8> {
    values.flat_map(f32::to_le_bytes).collect()
}

/// The usual file ending of a format.
pub fn extension(format: CloudFormat) -> &'static str {
    match format {
        CloudFormat::Ply => "ply",
        CloudFormat::Pcd => "pcd",
        CloudFormat::KittiBin | CloudFormat::XyzBin => "bin",
        CloudFormat::XyzI16 => "i16",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Vec<[f32; 3]> {
        (0..50).map(|i| [i as f32 * 0.126, -(i as f32), 0.5]).collect()
    }

    fn problem(bytes: &[u8], format: CloudFormat) -> Problem {
        parse(bytes, format).err().unwrap().problem
    }

    #[test]
    fn written_clouds_read_back() {
        for format in [CloudFormat::Ply, CloudFormat::KittiBin, CloudFormat::XyzBin] {
            let bytes = encode(&sample(), format).unwrap();
            assert_eq!(parse(&bytes, format).ok().unwrap(), sample(), "{format:?}");
        }
        let bytes = encode(&sample(), CloudFormat::XyzI16).unwrap();
        for (read, written) in parse(&bytes, CloudFormat::XyzI16).ok().unwrap().iter().zip(sample()) {
            for (r, w) in read.iter().zip(written) {
                assert!((r - w).abs() <= 1.001e-3, "{r} {w}");
            }
        }
    }

    #[test]
    fn i16_clouds_end_at_their_range() {
        assert!(encode(&[[65.534, 0.0, -65.536]], CloudFormat::XyzI16).is_ok());
        assert!(matches!(encode(&[[65.54, 0.0, 0.0]], CloudFormat::XyzI16), Err(Problem::Point(0))));
    }

    #[test]
    fn raw_clouds_are_refused_when_cut_off_empty_not_finite_or_too_large() {
        for (format, size) in [(CloudFormat::KittiBin, 16), (CloudFormat::XyzBin, 12), (CloudFormat::XyzI16, 6)] {
            let bytes = encode(&sample(), format).unwrap();
            for cut in 1..size {
                let problem = problem(&bytes[..bytes.len() - cut], format);
                assert!(matches!(problem, Problem::CloudLength { .. }), "{format:?} less {cut}: {problem}");
            }
            assert!(matches!(problem(&[], format), Problem::CloudEmpty));
            assert!(parse(&vec![0; POINTS_MAX * size], format).is_ok());
            let large = vec![0; (POINTS_MAX + 1) * size];
            assert!(matches!(problem(&large, format), Problem::CloudPoints(n) if n == POINTS_MAX as u64 + 1));
        }
        let nan = encode(&[[0.0; 3], [1.0, f32::NAN, 0.0]], CloudFormat::XyzBin).unwrap();
        assert!(matches!(problem(&nan, CloudFormat::XyzBin), Problem::Point(1)));
    }
}

//! Point clouds on disk: reads any [`CloudFormat`] into bounded memory, writes PLY and the raw formats. Points are
//! metres in the body frame; every point must be finite and within what single precision tells apart, and no claim in a
//! header makes us allocate more than the file itself can hold.

pub use super::limits::{CLOUD_BYTES_MAX, POINTS_MAX, UNPACKING_BYTES_MAX};

use super::bounded::{Fault, Read, bounded, read_bytes};
use super::error::{Problem, RecordingError};
use super::remark::Remark;
use super::{bin, pcd, ply};
use crate::manifest::{CloudFormat, XYZ_I16_UNIT_M};
use crate::observation::COORDINATE_MAX;
use merganser_protocol::submap::Mark;
use std::path::Path;

/// How far single precision may move a point, as a share of the cloud's extent, and in units whatever the extent.
const ROUNDING: (f64, f64) = (1e-5, 1e-3);

/// Reads a cloud.
///
/// # Errors
/// [`RecordingError`]: unreadable, empty, cut off, over [`POINTS_MAX`] or [`CLOUD_BYTES_MAX`], not finite, or too far
/// from the body for single precision.
pub fn read(path: &Path, format: CloudFormat) -> Result<Vec<[f32; 3]>, RecordingError> {
    read_remarked(path, format).map(|(points, _)| points)
}

/// The same, with what was odd.
///
/// # Errors
/// As [`read`].
pub fn read_remarked(path: &Path, format: CloudFormat) -> Result<(Vec<[f32; 3]>, Vec<Remark>), RecordingError> {
    let bytes = read_bytes(path)?;
    parse(&bytes, format).map_err(|fault| RecordingError {
        path: path.into(),
        line: fault.line,
        problem: fault.problem,
    })
}

/// What a PLY says of each of its points besides its place, if these are landmarks: properties `cxx cxy cxz cyy cyz czz`
/// (its covariance, body frame, m²), and perhaps `label` and `d0` to `d31`.
///
/// # Errors
/// [`RecordingError`]: no PLY, no covariances, or a covariance, label or descriptor that cannot be one.
pub fn landmarks(path: &Path, format: CloudFormat) -> Result<Vec<Mark>, RecordingError> {
    super::landmarks::read(path, format)
}

fn parse(bytes: &[u8], format: CloudFormat) -> Result<(Vec<[f32; 3]>, Vec<Remark>), Fault> {
    let Read { points, remarks } = match format {
        CloudFormat::Ply => ply::parse(bytes)?,
        CloudFormat::Pcd => pcd::parse(bytes)?,
        CloudFormat::KittiBin => bin::kitti(bytes)?,
        CloudFormat::XyzBin => raw::<12>(bytes, f32s)?,
        CloudFormat::XyzI16 => raw::<6>(bytes, i16s)?,
    };
    if points.is_empty() {
        return Err(Problem::CloudEmpty.into());
    }
    let near = |c: &f64| c.abs() <= COORDINATE_MAX; // false for NaN
    if let Some(index) = points.iter().position(|point| !point.iter().all(near)) {
        return Err(Problem::Point(index).into());
    }
    holds(&points)?;
    Ok((points.iter().map(|point| point.map(|c| c as f32)).collect(), remarks))
}

/// Refuses points that single precision cannot tell apart: those of a map's frame, far from the body.
fn holds(points: &[[f64; 3]]) -> Result<(), Problem> {
    let size = |point: &[f64; 3]| point.iter().fold(0.0_f64, |most, c| most.max(c.abs()));
    let farthest = points.iter().enumerate().max_by(|x, y| size(x.1).total_cmp(&size(y.1)));
    let Some((index, far)) = farthest.map(|(index, point)| (index, size(point))) else { return Ok(()) };
    let extent = |axis: usize| {
        let ends = |(low, high): (f64, f64), p: &[f64; 3]| (low.min(p[axis]), high.max(p[axis]));
        let (low, high) = points.iter().fold((f64::INFINITY, f64::NEG_INFINITY), ends);
        high - low
    };
    let across = (0..3).map(extent).fold(0.0, f64::max);
    // Half the distance of neighbouring numbers, at most.
    let moved = far * f64::from(f32::EPSILON) / 2.0;
    if moved <= (ROUNDING.0 * across).max(ROUNDING.1) {
        return Ok(());
    }
    let single = far as f32;
    let step = f64::from(single.next_up()) - f64::from(single);
    Err(Problem::Offset { index, far, across, step })
}

/// Records of `N` bytes without a header.
fn raw<const N: usize>(bytes: &[u8], point: fn(&[u8; N]) -> [f64; 3]) -> Result<Read, Problem> {
    let (records, rest) = bytes.as_chunks::<N>();
    if !rest.is_empty() {
        return Err(Problem::CloudLength { found: bytes.len(), expected: (records.len() + 1) * N });
    }
    bounded(records.len() as u64)?;
    Ok(Read { points: records.iter().map(point).collect(), remarks: Vec::new() })
}

fn f32s(record: &[u8; 12]) -> [f64; 3] {
    let (words, _) = record.as_chunks::<4>();
    [0, 1, 2].map(|axis| f64::from(f32::from_le_bytes(words[axis])))
}

fn i16s(record: &[u8; 6]) -> [f64; 3] {
    let (words, _) = record.as_chunks::<2>();
    [0, 1, 2].map(|axis| f64::from(i16::from_le_bytes(words[axis])) * XYZ_I16_UNIT_M)
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
            assert_eq!(parse(&bytes, format).ok().unwrap().0, sample(), "{format:?}");
        }
        let bytes = encode(&sample(), CloudFormat::XyzI16).unwrap();
        for (read, written) in parse(&bytes, CloudFormat::XyzI16).ok().unwrap().0.iter().zip(sample()) {
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
                assert!(
                    matches!(problem, Problem::CloudLength { .. } | Problem::BinLength { .. }),
                    "{format:?} less {cut}: {problem}"
                );
            }
            assert!(matches!(problem(&[], format), Problem::CloudEmpty));
            assert!(parse(&vec![0; POINTS_MAX * size], format).is_ok());
            let large = vec![0; (POINTS_MAX + 1) * size];
            assert!(matches!(problem(&large, format), Problem::CloudPoints(n) if n == POINTS_MAX as u64 + 1));
        }
        let nan = encode(&[[0.0; 3], [1.0, f32::NAN, 0.0]], CloudFormat::XyzBin).unwrap();
        assert!(matches!(problem(&nan, CloudFormat::XyzBin), Problem::Point(1)));
    }
    #[test]
    fn coordinates_of_a_map_are_refused_before_single_precision_loses_them() {
        let doubles = |offset: f64, across: f64| {
            let mut bytes = b"ply\nformat binary_little_endian 1.0\nelement vertex 5\nproperty double x\n\
                property double y\nproperty double z\nend_header\n"
                .to_vec();
            for k in 0..5 {
                let at = [offset + f64::from(k) * across / 4.0, -offset, 0.25];
                bytes.extend(at.iter().flat_map(|c| c.to_le_bytes()));
            }
            parse(&bytes, CloudFormat::Ply)
        };
        // A grid of 0.5 m, one that is a hundred thousandth of the cloud, and just more than that.
        let Err(Fault { problem: Problem::Offset { index, far, across, step }, .. }) = doubles(5e6, 40.0) else {
            panic!("must be refused")
        };
        assert_eq!((index, far, across, step), (4, 5_000_040.0, 40.0, 0.5));
        for (offset, across, fits) in [(1e4, 1.0, true), (1.6e4, 1.0, true), (2e4, 1.0, false), (2e4, 130.0, true)] {
            let read = doubles(offset, across);
            assert_eq!(read.is_ok(), fits, "{offset} {across}");
            for (k, point) in read.into_iter().flat_map(|(points, _)| points).enumerate() {
                let want = offset + k as f64 * across / 4.0;
                assert!((f64::from(point[0]) - want).abs() <= (1e-5 * across).max(1e-3), "{point:?}");
            }
        }
        let single = encode(&[[5e5, 4e6, 0.0], [5e5, 4e6, 1.0]], CloudFormat::XyzBin).unwrap();
        let problem = problem(&single, CloudFormat::XyzBin);
        assert!(problem.to_string().contains("0.25 m apart; points are wanted in the body frame"), "{problem}");
    }
}

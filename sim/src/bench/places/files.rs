//! Reading the recorded sets' own formats.

use anyhow::{Context, ensure};
use merganser_protocol::geometry::{Se3, So3};
use nalgebra::{Matrix4, Vector3};
use std::fs;
use std::io::Read;
use std::path::Path;

/// Depth used, m: nearer is noise, farther is coarse.
const DEPTH_M: (f32, f32) = (0.3, 4.0);
/// Every so many pixels with a depth are used.
const STRIDE: usize = 4;
/// Focal length and principal point of the 7-Scenes camera, pixels.
const CAMERA: [f32; 3] = [585.0, 320.0, 240.0];

/// The text of a file, unpacked if its name ends in `.xz`.
pub(super) fn text(path: &Path) -> anyhow::Result<String> {
    let name = || path.display().to_string();
    let bytes = fs::read(path).with_context(name)?;
    if path.extension().is_none_or(|extension| extension != "xz") {
        return String::from_utf8(bytes).with_context(name);
    }
    let mut text = String::new();
    lzma_rust2::XzReader::new(bytes.as_slice(), true).read_to_string(&mut text).with_context(name)?;
    Ok(text)
}

/// The first three of every `stride` little-endian floats.
pub(super) fn points(path: &Path, stride: usize) -> anyhow::Result<Vec<[f32; 3]>> {
    let bytes = fs::read(path).with_context(|| path.display().to_string())?;
    let floats: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    Ok(floats.chunks_exact(stride).map(|p| [p[0], p[1], p[2]]).collect())
}

/// A line `index x y z qx qy qz qw`, the index with or without a letter.
pub(super) fn indexed_pose(line: &str) -> anyhow::Result<(usize, Se3)> {
    let v = numbers(line.trim_start_matches('v'))?;
    ensure!(v.len() == 8, "{line:?} is no index and pose");
    let rotation = So3::from_xyzw([v[4], v[5], v[6], v[7]]).context("a quaternion that is none")?;
    Ok((v[0] as usize, Se3::new(rotation, Vector3::new(v[1], v[2], v[3]))))
}

/// A line `index` and 4×4 matrix by rows.
pub(super) fn indexed_matrix(line: &str) -> anyhow::Result<(usize, Se3)> {
    let v = numbers(line)?;
    ensure!(v.len() == 17, "{line:?} is no index and matrix");
    Ok((v[0] as usize, Se3::from_matrix(&Matrix4::from_row_slice(&v[1..]))))
}

/// The numbers of a line, between white space.
pub(super) fn numbers(line: &str) -> anyhow::Result<Vec<f64>> {
    line.split_whitespace().map(|word| word.parse().with_context(|| format!("{word:?} is no number"))).collect()
}

/// The points of a depth image in millimetres, in the camera's frame.
pub(super) fn depth_image(path: &Path) -> anyhow::Result<Vec<[f32; 3]>> {
    let name = || path.display().to_string();
    let file = std::io::BufReader::new(fs::File::open(path).with_context(name)?);
    let mut reader = png::Decoder::new(file).read_info().with_context(name)?;
    let mut pixels = vec![0; reader.output_buffer_size().with_context(name)?];
    let info = reader.next_frame(&mut pixels).with_context(name)?;
    ensure!(
        (info.bit_depth, info.color_type) == (png::BitDepth::Sixteen, png::ColorType::Grayscale),
        "{}: a depth image has 16 bits of grey",
        path.display()
    );
    let width = info.width as usize;
    let [focal, cx, cy] = CAMERA;
    let depths = pixels.as_chunks::<2>().0.iter().map(|b| f32::from(u16::from_be_bytes(*b)) / 1000.0).enumerate();
    let seen = depths.filter(|(_, z)| *z > DEPTH_M.0 && *z <= DEPTH_M.1).step_by(STRIDE);
    let point =
        |(k, z): (usize, f32)| [((k % width) as f32 - cx) * z / focal, ((k / width) as f32 - cy) * z / focal, z];
    Ok(seen.map(point).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn poses_are_read_and_nonsense_is_named() {
        let (index, pose) = indexed_pose("v3 1 2 3 0 0 0 1").unwrap();
        assert_eq!((index, pose.translation.as_slice()), (3, &[1.0, 2.0, 3.0][..]));
        assert!(indexed_pose("3 1 2 3").is_err() && indexed_pose("3 1 2 3 0 0 0 0").is_err());
        assert!(indexed_pose("3 1 2 x 0 0 0 1").unwrap_err().to_string().contains("\"x\""));
        let (index, pose) = indexed_matrix("7 1 0 0 4 0 1 0 5 0 0 1 6 0 0 0 1").unwrap();
        assert_eq!((index, pose.translation.as_slice()), (7, &[4.0, 5.0, 6.0][..]));
        assert!(indexed_matrix("7 1 0").is_err());
        assert!(text(Path::new("/no/such.xz")).unwrap_err().to_string().contains("/no/such.xz"));
    }
}

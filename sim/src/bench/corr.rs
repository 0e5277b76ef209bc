//! Correspondence problems with known truth, from `.corr` files.
//!
//! Little-endian: `CORRv001`, u32 N, u32 outliers (not used), f64 σ, scale, 9 of R by rows, 3 of t, then f32 source (3
//! N), f32 target (3 N), u8 kind (N): 1 true, 0 random, 2 of a second, false motion. A file's name tells its cell:
//! `<group>_N<points>_o<outliers in %>_s<seed>.corr`, group SE3, SIM3 or ALIAS.

use super::row::Problem;
use merganser_protocol::align::{COORDINATE_MAX, POINTS_LIMIT};
use merganser_protocol::geometry::{Sim3, So3};
use nalgebra::{Matrix3, Vector3};
use std::path::Path;
use thiserror::Error;

const MAGIC: &[u8] = b"CORRv001";
const HEADER_LEN: usize = 128;
const POINT_LEN: usize = 25;
/// How far RᵀR may be from the identity.
const ROTATION_ERROR_MAX: f64 = 1e-6;

/// A problem and its truth.
#[derive(Clone, Debug, PartialEq)]
pub struct Corr {
    /// Which problem it is.
    pub problem: Problem,
    /// Points in the source frame.
    pub source: Vec<[f64; 3]>,
    /// What they were matched with.
    pub target: Vec<[f64; 3]>,
    /// Whether each match is true.
    pub inlier: Vec<bool>,
    /// `t_target_source`.
    pub truth: Sim3,
    /// Standard deviation of the noise per axis.
    pub sigma: f64,
}

/// Why a file is no problem.
#[derive(Debug, Error)]
pub enum CorrError {
    /// It cannot be read.
    #[error("cannot be read")]
    Io(#[from] std::io::Error),
    /// Its name does not tell the cell.
    #[error("name is not <group>_N<points>_o<percent>_s<seed>.corr with group SE3, SIM3 or ALIAS")]
    Name,
    /// Another format.
    #[error("does not begin with CORRv001: not a correspondence file")]
    Magic,
    /// Shorter than its header.
    #[error("{len} bytes, the header alone has 128: truncated")]
    Header {
        /// Bytes there are.
        len: usize,
    },
    /// No points, or too many.
    #[error("{n} points; 1 to {POINTS_LIMIT} can be aligned")]
    Count {
        /// Points claimed.
        n: u32,
    },
    /// Length and number of points do not match.
    #[error("{len} bytes, {n} points need {needed}: truncated, or not what it claims")]
    Length {
        /// Bytes there are.
        len: usize,
        /// Points claimed.
        n: u32,
        /// Bytes needed.
        needed: usize,
    },
    /// Name and header disagree.
    #[error("{n} points by its header, {named} by its name")]
    Renamed {
        /// Points in the header.
        n: u32,
        /// Points in the name.
        named: u32,
    },
    /// A number that is none, or out of range.
    #[error("{what} is not a finite number in range")]
    Number {
        /// Which.
        what: &'static str,
    },
    /// R is no rotation.
    #[error("the true rotation is none")]
    Rotation,
    /// A point's kind is unknown.
    #[error("match {index} is of kind {kind}; kinds are 0, 1 and 2")]
    Kind {
        /// The match.
        index: usize,
        /// Its kind.
        kind: u8,
    },
}

/// Reads one file.
///
/// # Errors
/// [`CorrError`], the first thing that is wrong with it.
pub fn read(path: &Path) -> Result<Corr, CorrError> {
    let name = path.file_stem().and_then(|s| s.to_str()).ok_or(CorrError::Name)?;
    parse(Problem::of_name(name).ok_or(CorrError::Name)?, &std::fs::read(path)?)
}

/// Parses a file's bytes.
///
/// # Errors
/// As [`read`].
pub fn parse(problem: Problem, bytes: &[u8]) -> Result<Corr, CorrError> {
    if bytes.get(..MAGIC.len()).is_none_or(|magic| magic != MAGIC) {
        return Err(CorrError::Magic);
    }
    let len = bytes.len();
    let (header, body) = bytes.split_at_checked(HEADER_LEN).ok_or(CorrError::Header { len })?;
    let n = header[8..].first_chunk().copied().map_or(0, u32::from_le_bytes);
    let points = n as usize;
    if !(1..=POINTS_LIMIT).contains(&points) {
        return Err(CorrError::Count { n });
    }
    let needed = HEADER_LEN + POINT_LEN * points;
    if len != needed {
        return Err(CorrError::Length { len, n, needed });
    }
    if n != problem.n {
        return Err(CorrError::Renamed { n, named: problem.n });
    }
    let doubles: Vec<f64> = header[16..].as_chunks().0.iter().map(|&chunk| f64::from_le_bytes(chunk)).collect();
    let (sigma, scale) = (positive(doubles[0], "σ")?, positive(doubles[1], "the true scale")?);
    let rotation = Matrix3::from_row_slice(&doubles[2..11]);
    let error = (rotation.transpose() * rotation - Matrix3::identity()).amax();
    // A NaN fails as well.
    if !(error <= ROTATION_ERROR_MAX && rotation.determinant() > 0.0) {
        return Err(CorrError::Rotation);
    }
    let translation = Vector3::from_row_slice(&doubles[11..14]);
    if !translation.iter().all(|x| x.abs() <= COORDINATE_MAX) {
        return Err(CorrError::Number { what: "the true translation" });
    }
    let (source, rest) = body.split_at(12 * points);
    let (target, kinds) = rest.split_at(12 * points);
    let strange = kinds.iter().position(|&kind| kind > 2);
    if let Some(index) = strange {
        return Err(CorrError::Kind { index, kind: kinds[index] });
    }
    Ok(Corr {
        problem,
        source: coordinates(source, "a source point")?,
        target: coordinates(target, "a target point")?,
        inlier: kinds.iter().map(|&kind| kind == 1).collect(),
        truth: Sim3::new(So3::from_matrix(&rotation), translation, scale),
        sigma,
    })
}

fn positive(x: f64, what: &'static str) -> Result<f64, CorrError> {
    if x > 0.0 && x <= COORDINATE_MAX { Ok(x) } else { Err(CorrError::Number { what }) }
}

fn coordinates(bytes: &[u8], what: &'static str) -> Result<Vec<[f64; 3]>, CorrError> {
    let floats: Vec<f64> = bytes.as_chunks().0.iter().map(|&chunk| f64::from(f32::from_le_bytes(chunk))).collect();
    if !floats.iter().all(|x| x.abs() <= COORDINATE_MAX) {
        return Err(CorrError::Number { what });
    }
    Ok(floats.as_chunks().0.to_vec())
}

/// Rotation error, °, of the least-squares fit to the true matches alone: the best that can be had. `None` below three.
pub fn oracle_degrees(corr: &Corr) -> Option<f64> {
    let pairs = || {
        let both = corr.source.iter().zip(&corr.target).zip(&corr.inlier);
        both.filter(|(_, inlier)| **inlier).map(|((p, q), _)| (Vector3::from(*p), Vector3::from(*q)))
    };
    let n = pairs().count();
    if n < 3 {
        return None;
    }
    let (p, q) = pairs().fold((Vector3::zeros(), Vector3::zeros()), |(a, b), (p, q)| (a + p, b + q));
    let (p, q) = (p / n as f64, q / n as f64);
    let h: Matrix3<f64> = pairs().map(|(a, b)| (b - q) * (a - p).transpose()).sum();
    let svd = h.svd(true, true);
    let (u, v) = (svd.u?, svd.v_t?);
    let proper = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v).determinant().signum()));
    let rotation = So3::from_matrix(&(u * proper * v));
    Some((rotation.inverse() * corr.truth.rotation).angle().to_degrees())
}

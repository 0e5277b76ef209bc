//! The recording format `merganser-recording`: what both the agent (which reads it) and the simulator (which writes it)
//! agree on. Pure text: no file is opened here.
//!
//! A recording is a folder:
//! - `recording.toml`: a [`Manifest`].
//! - `keyframes.csv`: a header line ([`KEYFRAMES_HEADER`]), then one line per keyframe with rising stamps:
//!   `stamp_ns,x,y,z,qx,qy,qz,qw,c00,c01,…,c55,cloud` (21 numbers of the covariance's upper triangle, tangent order
//!   (ρ, φ), local perturbation).
//! - `truth.csv` (optional): a header line, then `stamp_ns,x,y,z,qx,qy,qz,qw` of the body in the world, m, one per
//!   keyframe.
//! - `places.f32` (if the manifest has `[places]`): what the user's own place recognition says of each keyframe, a row
//!   of little-endian f32 each, as `numpy.ndarray.tofile` writes them; a row of NaN where there is nothing to say.
//! - `positions.csv` (optional): a header line ([`POSITIONS_HEADER`]), then with stamps that do not fall where other
//!   robots were seen: `stamp_ns,robot,x,y,z,c00,c01,c02,c11,c12,c22` (the body's origin in the observer's body frame,
//!   m, and the upper triangle of its covariance). Only robots whose recordings state `begins_ns` can be played so that
//!   they meet.
//! - `up.csv` (optional): a header line ([`UP_HEADER`]), then `stamp_ns,x,y,z,sigma_rad` for each keyframe that knows
//!   the direction against gravity in the body frame (length 1) and its standard deviation about each horizontal axis.
//!   Where the SLAM's frame has its z axis upwards, `config.submap.gravity = "frame_z"` in the manifest says so for
//!   all.
//! - the clouds that the keyframes name, relative to the folder, points in the body frame.
//!
//! A data set for several robots is a folder whose sub-folders are recordings.

use serde::{Deserialize, Serialize};

/// The version of the format this code reads and writes.
pub const VERSION: u32 = 1;
/// The value of [`Manifest::format`].
pub const FORMAT: &str = "merganser-recording";
/// First line of `keyframes.csv`.
pub const KEYFRAMES_HEADER: &str = "stamp_ns,x,y,z,qx,qy,qz,qw,c00,c01,c02,c03,c04,c05,c11,c12,c13,c14,c15,c22,c23,c24,c25,c33,c34,c35,c44,c45,c55,cloud";
/// First line of `truth.csv`.
pub const TRUTH_HEADER: &str = "stamp_ns,x,y,z,qx,qy,qz,qw";
/// First line of `positions.csv`.
pub const POSITIONS_HEADER: &str = "stamp_ns,robot,x,y,z,c00,c01,c02,c11,c12,c22";
/// First line of `up.csv`.
pub const UP_HEADER: &str = "stamp_ns,x,y,z,sigma_rad";
/// Units that a recording may be in, m.
pub const UNIT_RANGE_M: core::ops::RangeInclusive<f64> = 1e-3..=1e3;
/// Keyframes in one recording at most.
pub const KEYFRAMES_MAX: usize = 1_000_000;

/// `recording.toml`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Always [`FORMAT`].
    pub format: String,
    /// Always [`VERSION`].
    pub version: u32,
    /// The robot's name.
    pub robot: merganser_protocol::ids::Name,
    /// What made the points: free text for people, e.g. `lidar3d`, `depth`.
    pub sensor: String,
    /// What the covariance of a keyframe describes.
    #[serde(default)]
    pub covariance_of: merganser_protocol::submap::CovarianceOf,
    /// How clouds are stored.
    pub clouds: CloudFormat,
    /// Number of keyframes; must equal the lines of `keyframes.csv`.
    pub keyframes: usize,
    /// Where the data came from and what was laid on it (drift, cuts), for people.
    #[serde(default)]
    pub origin: String,
    /// What one is in poses and points, m, where `config.submap.scale = "unknown"` and it is known all the same. The
    /// map is judged by it; no agent is told. In [`UNIT_RANGE_M`].
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit_m: Option<f64>,
    /// What this robot's clock showed when all recordings of the data set began; without it, when its first keyframe
    /// came.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub begins_ns: Option<i64>,
    /// What the rows of `places.f32` are, if there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub places: Option<PlaceFormat>,
    /// Overrides of the agent's core configuration that suit this sensor (e.g. `submap.voxel_m`).
    #[serde(default)]
    pub config: merganser_protocol::config::Config,
}

/// What `places.f32` holds.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlaceFormat {
    /// What made the vectors; only those of one model are compared.
    #[serde(default)]
    pub model: String,
    /// How they are compared.
    pub metric: merganser_protocol::submap::place::Metric,
    /// Numbers of each.
    pub numbers: usize,
}

/// How a cloud file is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CloudFormat {
    /// PLY, ASCII or binary, vertex properties x, y, z of any type; others, and other elements, are passed over.
    Ply,
    /// PCD with fields x, y, z of any type. `VIEWPOINT` is not applied.
    Pcd,
    /// KITTI velodyne: little-endian f32 x, y, z, reflectance; or nuScenes' x, y, z, intensity, ring, if all rings are
    /// such.
    KittiBin,
    /// Little-endian f32 x, y, z.
    XyzBin,
    /// Little-endian i16 x, y, z in units of 2 mm (±65 m), made by the simulator.
    XyzI16,
}

/// Metres per unit of [`CloudFormat::XyzI16`].
pub const XYZ_I16_UNIT_M: f64 = 0.002;

//! What can be wrong with a recording: one [`Problem`] per bad case, always told with the file and, where it is text,
//! the line.

use super::limits::{CLOUD_BYTES_MAX, POINTS_MAX, UNPACKING_BYTES_MAX};
use crate::manifest::{FORMAT, KEYFRAMES_MAX, VERSION};
use crate::observation::COORDINATE_MAX;
use merganser_protocol::config::ConfigError;
use merganser_protocol::geometry::CovarianceError;
use merganser_protocol::submap::PlaceError;
use merganser_ros::bag::{BagError, BagProblem};
use merganser_ros::join::JoinError;
use std::io;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Why a recording cannot be used (or written). Nothing is loaded in part: the first problem refuses the whole.
#[derive(Debug, Error)]
#[error("{}{}: {problem}", path.display(), line.map_or(String::new(), |line| format!(":{line}")))]
pub struct RecordingError {
    /// The file or folder.
    pub path: PathBuf,
    /// The line, counted from 1, where the file is text.
    pub line: Option<usize>,
    /// What is wrong, and how to mend it.
    pub problem: Problem,
}

/// What is wrong with a file of a recording.
#[derive(Debug, Error)]
pub enum Problem {
    /// The file cannot be read or written.
    #[error("{0}")]
    Io(#[from] io::Error),
    /// `recording.toml` is not what it should be.
    #[error("{0}")]
    Manifest(String),
    /// `format` is something else.
    #[error("format = {0:?} is no recording of ours; write format = {FORMAT:?}")]
    Format(String),
    /// `version` is something else.
    #[error("version = {0} is unknown to this program, which reads version {VERSION}; update it or record again")]
    Version(i64),
    /// `[config]` holds a value that cannot work.
    #[error("config.{0}")]
    Config(#[from] ConfigError),
    /// `unit_m` is stated for a SLAM that knows the metre.
    #[error(
        "unit_m is for SLAMs that do not know the metre; leave it out, or write scale = \"unknown\" under [config.submap]"
    )]
    UnitOfMetres,
    /// `unit_m` can be none.
    #[error("unit_m = {0}: state what one is in this recording, 0.001 to 1000 m, or leave it out")]
    UnitRange(f64),
    /// The first keyframe does not come soon after the beginning.
    #[error(
        "begins_ns = {begins}: the first keyframe, at {first} ns, must come up to a day later; state both on one clock"
    )]
    Begins {
        /// As stated, ns.
        begins: i64,
        /// Stamp of the first keyframe, ns.
        first: i64,
    },
    /// `[places]` describes no vectors.
    #[error("places.numbers: {0}")]
    Place(PlaceError),
    /// The file of place descriptors does not hold one for each keyframe.
    #[error(
        "{found} bytes instead of {expected}; write places.numbers little-endian f32 for each keyframe, NaN for none"
    )]
    PlacesLength {
        /// Bytes of the file.
        found: u64,
        /// Bytes of a row for each keyframe.
        expected: u64,
    },
    /// The first line of a table is not the expected one.
    #[error("the columns are not the expected ones; the first line must be \"{0}\"")]
    Header(&'static str),
    /// A line has too few or too many fields.
    #[error("{found} fields instead of {expected}")]
    Fields {
        /// Fields on the line.
        found: usize,
        /// Columns of the table.
        expected: usize,
    },
    /// A line is absurdly long.
    #[error("the line is longer than {0} bytes; is the file damaged?")]
    LineLength(usize),
    /// A field is not a number.
    #[error("{column} = {text:?} is not a number")]
    Number {
        /// The column.
        column: &'static str,
        /// What it holds.
        text: String,
    },
    /// A field is NaN or infinite.
    #[error("{column} is {value}; every number must be finite: leave the keyframe out")]
    NotFinite {
        /// The column.
        column: &'static str,
        /// What it holds.
        value: f64,
    },
    /// A position is too far from the origin for clouds in f32 and poses in f64.
    #[error("the position is beyond {COORDINATE_MAX:e} m; use a local frame")]
    Far,
    /// A quaternion has no direction.
    #[error("the quaternion has length {0}; write a unit quaternion as qx,qy,qz,qw")]
    Quaternion(f64),
    /// A matrix is not a rotation.
    #[error("the upper left 3×3 block is not a rotation (off by {0:.1e}); write an orthonormal matrix")]
    Rotation(f64),
    /// Stamps do not rise.
    #[error("stamp {stamp} does not come after {previous}; sort the keyframes and leave repeated ones out")]
    Unsorted {
        /// This line's stamp, ns.
        stamp: i64,
        /// The one before, ns.
        previous: i64,
    },
    /// The covariance cannot be one.
    #[error("{0}")]
    Covariance(#[from] CovarianceError),
    /// `keyframes` in the manifest and the table differ.
    #[error("holds {found} keyframes, but recording.toml states keyframes = {stated}")]
    Count {
        /// Lines of the table.
        found: usize,
        /// What the manifest says.
        stated: usize,
    },
    /// No or too many keyframes.
    #[error("keyframes = {0}; a recording holds 1 to {KEYFRAMES_MAX}")]
    KeyframesRange(usize),
    /// `truth.csv` does not match `keyframes.csv`.
    #[error("holds {found} poses for {keyframes} keyframes; state the truth of each keyframe or remove the file")]
    TruthCount {
        /// Lines of the table.
        found: usize,
        /// Keyframes.
        keyframes: usize,
    },
    /// A stamp of `truth.csv` is not that of the keyframe on the same line.
    #[error("stamp {found} is not {expected}, the stamp of the keyframe on the same line of keyframes.csv")]
    TruthStamp {
        /// The truth's stamp, ns.
        found: i64,
        /// The keyframe's stamp, ns.
        expected: i64,
    },
    /// A cloud's path leaves the folder.
    #[error("cloud {0:?} must be a plain path inside the recording's folder")]
    CloudPath(String),
    /// A cloud that a keyframe names does not exist.
    #[error("cloud {0:?} is missing")]
    CloudMissing(String),
    /// A cloud has no point.
    #[error("the cloud is empty; leave the keyframe out")]
    CloudEmpty,
    /// A cloud ends early, or has bytes left over.
    #[error("the cloud is {found} bytes long where {expected} are due; was it cut off while being copied?")]
    CloudLength {
        /// Bytes present (of the points).
        found: usize,
        /// Bytes due.
        expected: usize,
    },
    /// A `.bin` that does not divide into points of four floats.
    #[error(
        "{found} bytes are no whole number of points of four 32-bit floats, x y z reflectance{}; write those, or state \
         clouds = \"xyz-bin\" for points of x y z alone",
        if *fives { format!(" (though {} points of five)", found / 20) } else { ", or the file was cut off".into() }
    )]
    BinLength {
        /// Bytes of the file.
        found: usize,
        /// Whether they are points of five floats.
        fives: bool,
    },
    /// The fourth number of a point of a `.bin` is no reflectance.
    #[error(
        "the fourth number of point {index} (counted from 0) is {value}, which is no reflectance (0 to 65535): these \
         are not points of four 32-bit floats, x y z reflectance; write those, or state clouds = \"xyz-bin\" for \
         points of x y z alone"
    )]
    Reflectance {
        /// The point.
        index: usize,
        /// Its fourth number.
        value: f32,
    },
    /// Points lie so far from the body that single precision loses them.
    #[error(
        "point {index} (counted from 0) is {far:.0} m from the body in a cloud {across:.0} m across, where numbers of \
         32 bits are {step} m apart; points are wanted in the body frame: undo the pose, and subtract the offset of \
         map coordinates (UTM) from poses and points alike"
    )]
    Offset {
        /// The point.
        index: usize,
        /// Its largest coordinate, m.
        far: f64,
        /// Largest extent of the cloud, m.
        across: f64,
        /// The grid on which single precision would put it, m.
        step: f64,
    },
    /// A cloud has too many points.
    #[error("the cloud has {0} points; at most {POINTS_MAX} (POINTS_MAX) are read: thin it")]
    CloudPoints(u64),
    /// A file has too many bytes.
    #[error("the file has {0} bytes; at most {CLOUD_BYTES_MAX} (CLOUD_BYTES_MAX) are read: thin the cloud")]
    CloudBytes(u64),
    /// An `.xz` file wants more memory than it gets.
    #[error(
        "wants more than {} MiB (UNPACKING_BYTES_MAX) for its dictionary; pack it by `xz -9` or less, or unpack it",
        UNPACKING_BYTES_MAX >> 20
    )]
    Dictionary,
    /// A point is NaN, infinite or absurdly far.
    #[error(
        "point {0} (counted from 0) is not finite or beyond {COORDINATE_MAX:e} m; leave invalid returns \
         out, or write a PCD of more than one row, where NaN stands for nothing measured"
    )]
    Point(usize),
    /// A PLY file is not as expected.
    #[error("{0}")]
    Ply(String),
    /// A PCD file is not as expected.
    #[error("{0}")]
    Pcd(String),
    /// A depth image is not as expected.
    #[error("{0}")]
    Image(String),
    /// A bag cannot be read.
    #[error("{0}")]
    Bag(Box<BagProblem>),
    /// Clouds and poses of a bag do not come together.
    #[error("{0}")]
    Join(Box<JoinError>),
    /// The same, of a bag that cannot be read in full.
    #[error("{error} (of what can be read: {told})")]
    Damaged {
        /// Why.
        error: Box<JoinError>,
        /// What is damaged.
        told: String,
    },
    /// A folder holds nothing that can be fed to robots.
    #[error("{0}")]
    Data(String),
}

impl Problem {
    /// The problem, told of a file as a whole.
    pub fn of(self, path: impl Into<PathBuf>) -> RecordingError {
        RecordingError { path: path.into(), line: None, problem: self }
    }

    /// The problem, told of one line (from 1) of a file.
    pub fn at(self, path: impl Into<PathBuf>, line: usize) -> RecordingError {
        RecordingError { path: path.into(), line: Some(line), problem: self }
    }
}

impl From<BagError> for RecordingError {
    fn from(BagError { path, problem }: BagError) -> Self {
        match problem {
            BagProblem::Io(error) => Problem::Io(error).of(path),
            problem => Problem::Bag(Box::new(problem)).of(path),
        }
    }
}

/// Turns an I/O result into a [`RecordingError`] about `path`.
pub(super) fn on<T>(path: &Path, result: io::Result<T>) -> Result<T, RecordingError> {
    result.map_err(|error| Problem::Io(error).of(path))
}

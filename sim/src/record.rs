//! Writing recordings, the demo's among them: what each robot of a scenario drives and sees, in the format of
//! `merganser_recording::manifest`, with the truth beside it. One seed gives the same bytes on every machine: all noise
//! is seeded, all floats are printed with a fixed number of digits, and clouds are whole numbers of 2 mm.

use crate::scenario::Scenario;
use crate::stage::{Stage, StageError};
use crate::world::trajectory::Trajectory;
use core::fmt::Write as _;
use merganser_protocol::geometry::{Covariance, Se3};
use merganser_protocol::ids::{Name, NameError};
use merganser_protocol::submap::landmarks::DESCRIPTOR_LEN;
use merganser_protocol::submap::{CovarianceOf, Mark};
use merganser_protocol::wire::fact::ScaleKind;
use merganser_recording::manifest::{
    CloudFormat, FORMAT, KEYFRAMES_HEADER, Manifest, PlaceFormat, TRUTH_HEADER, UP_HEADER, VERSION, XYZ_I16_UNIT_M,
};
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Stamp of the first keyframe, ns.
const FIRST_STAMP_NS: i64 = 1_000_000_000;

/// Why a recording could not be written.
#[derive(Debug, Error)]
pub enum RecordError {
    /// A file or folder.
    #[error("{path}: {source}; choose a folder that can be written")]
    Io {
        /// Which.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// The scenario's robots cannot be recorded.
    #[error(transparent)]
    Name(#[from] NameError),
    /// The scenario's drives cannot be made.
    #[error(transparent)]
    Stage(#[from] StageError),
    /// The manifest cannot be written as TOML.
    #[error(transparent)]
    Toml(#[from] toml::ser::Error),
}

/// What was written for one robot.
#[derive(Clone, Debug, PartialEq)]
pub struct Recorded {
    /// The robot's name, also its folder's.
    pub robot: String,
    /// Keyframes.
    pub keyframes: usize,
    /// Points in all.
    pub points: usize,
    /// Bytes in all.
    pub bytes: u64,
    /// Metres driven.
    pub metres: f64,
    /// Seconds driven.
    pub secs: f64,
}

/// Writes one folder per robot of the scenario into `out`; robots drive `along` a recorded drive, if there is one.
/// Tells `progress` how many of how many keyframes are done.
///
/// # Errors
/// [`RecordError`]; what was written before stays.
pub fn record(
    scenario: &Scenario,
    along: Option<&Trajectory>,
    seed: u64,
    out: &Path,
    mut progress: impl FnMut(usize, usize),
) -> Result<Vec<Recorded>, RecordError> {
    let (stage, place) = match along {
        Some(drive) => (Stage::along(scenario, drive, seed)?, format!(" along {}", drive.name())),
        None => (Stage::new(scenario, seed)?, String::new()),
    };
    let origin = format!(
        "made by merganser-sim record, scenario {}{place}, seed {seed}; seeded odometry drift, stated covariance",
        scenario.name
    );
    let all = (0..scenario.robots).map(|robot| stage.steps(robot).len()).sum();
    let mut done = 0;
    let mut one = || {
        done += 1;
        progress(done, all);
    };
    (0..scenario.robots).map(|robot| record_robot(scenario, &stage, &origin, robot, out, &mut one)).collect()
}

fn record_robot(
    scenario: &Scenario,
    stage: &Stage,
    origin: &str,
    robot: usize,
    out: &Path,
    progress: &mut impl FnMut(),
) -> Result<Recorded, RecordError> {
    let name = &stage.names()[robot];
    let folder = out.join(name);
    let mut done = Recorded { robot: name.clone(), keyframes: 0, points: 0, bytes: 0, metres: 0.0, secs: 0.0 };
    let mut keyframes = format!("{KEYFRAMES_HEADER}\n");
    let mut truth = format!("{TRUTH_HEADER}\n");
    let mut ups = format!("{UP_HEADER}\n");
    let mut put = |path: PathBuf, bytes: &[u8]| {
        done.bytes += bytes.len() as u64;
        write_file(path, bytes)
    };
    let (mut places, mut format) = (Vec::new(), None);
    let steps = stage.steps(robot);
    for (index, step) in steps.iter().enumerate() {
        let (points, marks) = stage.scan(robot, index).map_err(StageError::Drift)?;
        let (cloud, bytes) = match scenario.landmarks {
            Some(_) => (format!("clouds/{index:04}.ply"), landmarks(&points, &marks)),
            None => (format!("clouds/{index:04}.xyz"), pack(&points)),
        };
        put(folder.join(&cloud), &bytes)?;
        done.points += points.len();
        if let Some(place) = stage.place(robot, index) {
            places.extend(place.vector().iter().flat_map(|x| x.to_le_bytes()));
            let (model, metric) = (place.model().to_owned(), place.metric());
            format = Some(PlaceFormat { model, metric, numbers: place.vector().len() });
        }
        let stamp = FIRST_STAMP_NS.saturating_add_unsigned(step.nanos);
        if let Some(up) = stage.up(robot, index) {
            let [x, y, z] = (*up.direction()).into();
            let _ = writeln!(ups, "{stamp},{x},{y},{z},{}", up.sigma());
        }
        let odometry = numbers(&pose(&step.t_frame_body), false);
        let covariance = numbers(&triangle(&step.motion.covariance), true);
        let _ = writeln!(keyframes, "{stamp},{odometry},{covariance},{cloud}");
        let _ = writeln!(truth, "{stamp},{}", numbers(&pose(&step.t_world_body), false));
        progress();
    }
    put(folder.join("keyframes.csv"), keyframes.as_bytes())?;
    put(folder.join("truth.csv"), truth.as_bytes())?;
    if ups.lines().count() > 1 {
        put(folder.join("up.csv"), ups.as_bytes())?;
    }
    if format.is_some() {
        put(folder.join("places.f32"), &places)?;
    }
    let manifest = Manifest { places: format, ..manifest(scenario, origin, name, steps.len(), stage.unit_m(robot))? };
    put(folder.join("recording.toml"), toml::to_string(&manifest)?.as_bytes())?;
    done.keyframes = steps.len();
    done.metres = scenario.drive.keyframe_m * steps.len().saturating_sub(1) as f64;
    done.secs = steps.last().map_or(0.0, |step| step.nanos as f64 * 1e-9);
    Ok(done)
}

fn manifest(
    scenario: &Scenario,
    origin: &str,
    name: &str,
    keyframes: usize,
    unit_m: f64,
) -> Result<Manifest, RecordError> {
    let config = scenario.config_of(name);
    let unit_is_unknown = config.submap.scale == ScaleKind::Unknown;
    Ok(Manifest {
        format: FORMAT.to_owned(),
        version: VERSION,
        robot: Name::new(name)?,
        sensor: if scenario.landmarks.is_some() { "camera" } else { "lidar3d" }.to_owned(),
        covariance_of: CovarianceOf::Motion,
        clouds: if scenario.landmarks.is_some() { CloudFormat::Ply } else { CloudFormat::XyzI16 },
        keyframes,
        origin: origin.to_owned(),
        unit_m: unit_is_unknown.then_some(unit_m),
        begins_ns: None,
        places: None,
        config,
    })
}

/// `[x, y, z, qx, qy, qz, qw]`.
fn pose(t: &Se3) -> Vec<f64> {
    t.translation.iter().copied().chain(t.rotation.xyzw()).collect()
}

/// Row-major upper triangle.
fn triangle(covariance: &Covariance<6>) -> Vec<f64> {
    let m = covariance.matrix();
    (0..6).flat_map(|row| (row..6).map(move |column| m[(row, column)])).collect()
}

fn numbers(values: &[f64], scientific: bool) -> String {
    // Adding 0.0 turns a negative zero into a plain one.
    let print = |v: &f64| if scientific { format!("{:.6e}", v + 0.0) } else { format!("{:.9}", v + 0.0) };
    values.iter().map(print).collect::<Vec<_>>().join(",")
}

/// Little-endian i16 in units of [`XYZ_I16_UNIT_M`]; the sensor's range keeps it inside i16.
fn pack(points: &[[f32; 3]]) -> Vec<u8> {
    let unit = |v: f32| libm::round(f64::from(v) / XYZ_I16_UNIT_M) as i16;
    points.iter().flatten().flat_map(|&v| unit(v).to_le_bytes()).collect()
}

/// A binary PLY: places, their covariances, and descriptors.
fn landmarks(points: &[[f32; 3]], marks: &[Mark]) -> Vec<u8> {
    let mut text = format!("ply\nformat binary_little_endian 1.0\nelement vertex {}\n", points.len());
    ["x", "y", "z"].iter().for_each(|name| text += &format!("property float {name}\n"));
    ["xx", "xy", "xz", "yy", "yz", "zz"].iter().for_each(|name| text += &format!("property float c{name}\n"));
    (0..DESCRIPTOR_LEN).for_each(|k| text += &format!("property uchar d{k}\n"));
    let mut bytes = (text + "end_header\n").into_bytes();
    for (point, mark) in points.iter().zip(marks) {
        let m = mark.covariance.matrix();
        let upper = (0..3).flat_map(|row| (row..3).map(move |column| m[(row, column)] as f32));
        bytes.extend(point.iter().copied().chain(upper).flat_map(f32::to_le_bytes));
        bytes.extend(mark.descriptor.unwrap_or_default());
    }
    bytes
}

fn write_file(path: PathBuf, bytes: &[u8]) -> Result<(), RecordError> {
    let io = |source| RecordError::Io { path: path.clone(), source };
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(io)?;
    }
    std::fs::write(&path, bytes).map_err(io)
}

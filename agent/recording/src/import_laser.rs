//! A CARMEN log (`*.clf`, or packed `*.clf.bz2`) becomes three planar robots with its real odometry. Each drives a
//! stretch of the way, the stretches overlap, and each is given every third scan: two robots never hold the same one.

use super::Writer;
use super::cloud::read_bytes;
use super::error::{Problem, RecordingError, on};
use super::import::NAMES;
use crate::carmen::{Parser, Scan, keyframes};
use crate::manifest::{CloudFormat, FORMAT, Manifest, VERSION};
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::CovarianceOf;
use std::io::{Cursor, Read};
use std::path::Path;

/// How the names of logs end.
pub(super) const SUFFIXES: [&str; 2] = [".clf", ".clf.bz2"];
/// Bytes of an unpacked log at most.
const LOG_BYTES_MAX: u64 = 512_000_000;
/// Robots made.
const ROBOTS: usize = 3;
/// Share of the log by which a robot's stretch reaches into each neighbour's.
const REACH: f64 = 0.1;

/// Writes three recordings into `out`.
pub(super) fn import(data: &Path, out: &Path) -> Result<(), RecordingError> {
    let mut logs = Vec::new();
    for entry in on(data, data.read_dir())? {
        let path = on(data, entry)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if SUFFIXES.iter().any(|suffix| name.ends_with(suffix)) {
            logs.push(path);
        }
    }
    logs.sort();
    let [log] = logs.as_slice() else {
        let why = format!("holds {} CARMEN logs; one log at a time can be cut into robots", logs.len());
        return Err(Problem::Data(why).of(data));
    };
    let scans = read_log(log)?;
    let mut config = Config::default();
    config.submap.sensor = Sensor::Laser2d;
    config.submap.distance_m = 6.0;
    // Never by rotation: a submap that shows a place from all sides is recognised better.
    config.submap.rotation_deg = 360.0;
    config.submap.keyframes_max = 32;
    for (robot, name) in NAMES.iter().enumerate().take(ROBOTS) {
        let folder = out.join(name);
        // What an earlier run left must not pass for part of this one.
        if folder.exists() {
            on(&folder, std::fs::remove_dir_all(&folder))?;
        }
        let share = |k: f64| ((k.clamp(0.0, 1.0) * scans.len() as f64) as usize).min(scans.len());
        let from = share(robot as f64 / ROBOTS as f64 - REACH);
        let to = share((robot + 1) as f64 / ROBOTS as f64 + REACH);
        let own = (from..to).filter(|k| k % ROBOTS == robot).map(|k| &scans[k]);
        let manifest = Manifest {
            format: FORMAT.into(),
            version: VERSION,
            robot: Name::new(*name).map_err(|error| Problem::Data(error.to_string()).of(&folder))?,
            sensor: "laser2d".into(),
            covariance_of: CovarianceOf::Motion,
            clouds: CloudFormat::Ply,
            keyframes: 0,
            unit_m: None,
            begins_ns: None,
            places: None,
            origin: format!(
                "CARMEN log of {} scans, real odometry; every third scan from {from} to {to} (counted from 0)",
                scans.len()
            ),
            config: config.clone(),
        };
        let mut writer = Writer::create(&folder, manifest)?;
        for keyframe in keyframes(own) {
            writer.push(&keyframe, None)?;
        }
        writer.finish()?;
    }
    Ok(())
}

/// The scans of a log, at least one for each robot.
fn read_log(path: &Path) -> Result<Vec<Scan>, RecordingError> {
    let mut bytes = read_bytes(path)?;
    if path.extension().is_some_and(|extension| extension == "bz2") {
        let mut unpacked = Vec::new();
        let packed = bzip2::read::MultiBzDecoder::new(Cursor::new(bytes));
        on(path, packed.take(LOG_BYTES_MAX + 1).read_to_end(&mut unpacked))?;
        bytes = unpacked;
    }
    if bytes.len() as u64 > LOG_BYTES_MAX {
        return Err(Problem::Data(format!("is longer than {LOG_BYTES_MAX} bytes; cut the log")).of(path));
    }
    let mut parser = Parser::default();
    for (index, line) in bytes.split(|byte| *byte == b'\n').enumerate() {
        let text = std::str::from_utf8(line).map_err(|_| {
            Problem::Data("is no text; a CARMEN log holds plain text, packed ones end in .bz2".into())
                .at(path, index + 1)
        })?;
        parser.line(text).map_err(|error| Problem::Data(error.what.to_string()).at(path, error.line))?;
    }
    let scans = parser.finish();
    if scans.len() < ROBOTS {
        let why = format!("holds {} FLASER scans; {ROBOTS} robots need at least one each", scans.len());
        return Err(Problem::Data(why).of(path));
    }
    Ok(scans)
}

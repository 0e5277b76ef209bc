//! A CARMEN log (`*.clf`, perhaps packed as `*.clf.bz2` or `*.clf.xz`) becomes three planar robots with its real
//! odometry. Each drives a stretch of the way, the stretches overlap, and two robots never hold the same scan: of a log
//! with many scans to a metre each robot is given every third, of any other all of its stretch, alternately where
//! another robot drives, too.

use super::Writer;
use super::bounded::{read_bytes, unpacked_xz};
use super::cut::NAMES;
use super::error::{Problem, RecordingError, on};
use crate::carmen::{Log, Parser, keyframes};
use crate::deal::deal;
use crate::manifest::{CloudFormat, FORMAT, Manifest, VERSION};
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::CovarianceOf;
use std::io::{Cursor, Read};
use std::path::Path;

/// How the names of logs end...
const SUFFIXES: [&str; 3] = [".clf", ".clf.bz2", ".clf.xz"];
/// ...or, where no name ends so: many other things are called a log.
const LOOSE_SUFFIXES: [&str; 3] = [".log", ".log.bz2", ".log.xz"];
/// Bytes of an unpacked log at most.
const LOG_BYTES_MAX: u64 = 512_000_000;
/// Robots made.
const ROBOTS: usize = 3;
/// A submap may take as long as it likes, s: wheels drift by the way, and the stamps of some logs only count scans.
const SECS_MAX: f64 = 1e6;

/// What suits a planar laser on wheels.
pub(super) fn planar() -> Config {
    let mut config = Config::default();
    config.submap.sensor = Sensor::Laser2d;
    config.submap.distance_m = 6.0;
    // Never by rotation: a submap that shows a place from all sides is recognised better.
    config.submap.rotation_deg = 360.0;
    config.submap.keyframes_max = 32;
    config.submap.secs_max = SECS_MAX;
    config
}

/// The name of a log without its ending; `None` if it is not named as one.
pub fn log_name(file: &str) -> Option<&str> {
    SUFFIXES.iter().chain(&LOOSE_SUFFIXES).find_map(|suffix| file.strip_suffix(suffix))
}

/// Of the names in a folder, those of logs.
pub(super) fn logs<'a>(names: &[&'a str]) -> Vec<&'a str> {
    let ending = |suffixes: &[&str]| -> Vec<&'a str> {
        names.iter().copied().filter(|name| suffixes.iter().any(|suffix| name.ends_with(suffix))).collect()
    };
    let sure = ending(&SUFFIXES);
    if sure.is_empty() { ending(&LOOSE_SUFFIXES) } else { sure }
}

/// Whether a name is that of a laser's log and of nothing else.
pub(super) fn is_surely_log(name: &str) -> bool {
    SUFFIXES.iter().any(|suffix| name.ends_with(suffix))
}

/// Writes three recordings into `out`, and returns what there is to say of the log.
pub(super) fn import(data: &Path, out: &Path) -> Result<Vec<String>, RecordingError> {
    let mut names = Vec::new();
    for entry in on(data, data.read_dir())? {
        names.push(on(data, entry)?.file_name().to_string_lossy().into_owned());
    }
    names.sort();
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let found = logs(&names);
    let [log] = found.as_slice() else {
        let why = format!("holds {} CARMEN logs; one log at a time can be cut into robots", found.len());
        return Err(Problem::Data(why).of(data));
    };
    let log = &data.join(log);
    import_log(log, out, ROBOTS)
}

/// Writes so many recordings of one log into `out`, and returns what there is to say of it.
pub(super) fn import_log(path: &Path, out: &Path, robots: usize) -> Result<Vec<String>, RecordingError> {
    let log = read_log(path)?;
    if log.scans.len() < robots {
        let scans = log.scans.len();
        let why = format!("holds {scans} scans (FLASER or ROBOTLASER1); {robots} robots need at least one each");
        return Err(Problem::Data(why).of(path));
    }
    let config = planar();
    let dealt = deal(log.scans.iter().map(|scan| &scan.pose), robots);
    for (robot, name) in NAMES.iter().enumerate().take(robots) {
        let folder = out.join(name);
        // What an earlier run left must not pass for part of this one.
        if folder.exists() {
            on(&folder, std::fs::remove_dir_all(&folder))?;
        }
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
                "CARMEN log of {} scans ({} late, {} repeated), real odometry; {}",
                log.scans.len(),
                log.late,
                log.repeated,
                dealt.how(robot)
            ),
            config: config.clone(),
        };
        let mut writer = Writer::create(&folder, manifest)?;
        for keyframe in keyframes(dealt.of(robot).map(|k| &log.scans[k])) {
            writer.push(&keyframe, None)?;
        }
        writer.finish()?;
    }
    Ok(remarks(&log))
}

/// What was amiss with a log, and what was done about it.
fn remarks(log: &Log) -> Vec<String> {
    let Log { scans, late, repeated } = log;
    let all = scans.len() + repeated;
    let mut remarks = Vec::new();
    if *late > 0 {
        remarks.push(format!(
            "{late} of {all} scans stand behind a later one in the log; they are sorted by their stamps"
        ));
    }
    if *repeated > 0 {
        remarks
            .push(format!("{repeated} of {all} scans have the stamp of one before them in the log; they are left out"));
    }
    remarks
}

/// Reads a log, packed or not.
///
/// # Errors
/// [`RecordingError`]: the file, or its first line that cannot be used.
pub fn read_log(path: &Path) -> Result<Log, RecordingError> {
    let bytes = read_bytes(path)?;
    let bytes = match path.extension().and_then(|extension| extension.to_str()) {
        Some("bz2") => unpacked(path, bzip2::read::MultiBzDecoder::new(Cursor::new(bytes)))?,
        Some("xz") => unpacked_xz(path, &bytes, LOG_BYTES_MAX + 1)?,
        _ => bytes,
    };
    if bytes.len() as u64 > LOG_BYTES_MAX {
        return Err(Problem::Data(format!("is longer than {LOG_BYTES_MAX} bytes; cut the log")).of(path));
    }
    let mut parser = Parser::default();
    for (index, line) in bytes.split(|byte| *byte == b'\n').enumerate() {
        let text = std::str::from_utf8(line).map_err(|_| {
            Problem::Data("is no text; a CARMEN log holds plain text, packed ones end in .bz2 or .xz".into())
                .at(path, index + 1)
        })?;
        parser.line(text).map_err(|error| Problem::Data(error.what.to_string()).at(path, error.line))?;
    }
    Ok(parser.finish())
}

fn unpacked(path: &Path, packed: impl Read) -> Result<Vec<u8>, RecordingError> {
    let mut bytes = Vec::new();
    on(path, packed.take(LOG_BYTES_MAX + 1).read_to_end(&mut bytes))?;
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::{log_name, logs};

    /// Many things are called a log: beside one that is surely a laser's, none of them is.
    #[test]
    fn what_is_only_called_a_log_is_one_where_nothing_else_is() {
        assert_eq!(logs(&["aces.clf.bz2", "build.log", "notes.txt"]), ["aces.clf.bz2"]);
        assert_eq!(logs(&["intel.log.xz", "notes.txt"]), ["intel.log.xz"]);
        assert_eq!(logs(&["a.clf", "b.clf.xz"]), ["a.clf", "b.clf.xz"], "two, which are refused");
        assert!(logs(&["notes.txt"]).is_empty());
        assert_eq!((log_name("intel.log.xz"), log_name("notes.txt")), (Some("intel"), None));
    }
}

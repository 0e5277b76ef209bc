//! An MRCLAM data set becomes its robots: `RobotN_Odometry.dat` and `RobotN_Measurement.dat` of each, `Barcodes.dat` of
//! all (each may be packed, `.xz`). A filter stands in for each robot's own SLAM (`crate::mrclam`); landmarks are
//! handed over under their bar codes, and where other robots were seen.

use super::Writer;
use super::bounded::{read_bytes, unpacked_xz};
use super::error::{Problem, RecordingError, on};
use crate::manifest::{CloudFormat, FORMAT, Manifest, VERSION};
use crate::mrclam::{MrclamError, keyframes, position, sightings, speeds, subjects};
use merganser_protocol::agent::io::PositionSighting;
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use std::path::{Path, PathBuf};

/// What a robot's odometry file is called, around its number.
const ODOMETRY: [&str; 2] = ["Robot", "_Odometry.dat"];
/// The bar codes of all subjects.
const BARCODES: &str = "Barcodes.dat";
/// How a packed file ends.
const PACKED: &str = ".xz";
/// Bytes of an unpacked file at most.
const FILE_BYTES_MAX: u64 = 512_000_000;

/// The number in the name of an odometry file.
pub(super) fn robot(name: &str) -> Option<u32> {
    let [before, after] = ODOMETRY;
    name.strip_suffix(PACKED).unwrap_or(name).strip_prefix(before)?.strip_suffix(after)?.parse().ok()
}

/// Writes a recording for each robot into `out`.
pub(super) fn import(data: &Path, out: &Path) -> Result<(), RecordingError> {
    let mut robots = Vec::new();
    for entry in on(data, data.read_dir())? {
        robots.extend(robot(&on(data, entry)?.file_name().to_string_lossy()));
    }
    robots.sort_unstable();
    robots.dedup();
    let subjects = read(data, BARCODES, subjects)?;
    let mut config = Config::default();
    config.submap.sensor = Sensor::Landmarks2d;
    // Never by rotation: a submap that saw all around has more landmarks in common with others.
    config.submap.rotation_deg = 360.0;
    config.submap.keyframes_max = 32;
    let mut made = Vec::new();
    for robot in &robots {
        let speeds = read(data, &format!("Robot{robot}_Odometry.dat"), speeds)?;
        let (measured, file) = (format!("Robot{robot}_Measurement.dat"), data.join(BARCODES));
        let mut seen = read(data, &measured, sightings)?;
        if let Some(unknown) = seen.iter().find(|s| !subjects.contains_key(&s.barcode)) {
            let known = seen.iter().filter(|s| subjects.contains_key(&s.barcode)).count();
            // A misread code or two is what real cameras give; a file of other codes is another data set's.
            if known < seen.len() / 2 {
                let why = format!("names no subject of bar code {}, which robot {robot} saw", unknown.barcode);
                return Err(Problem::Data(why).of(file));
            }
        }
        let met: Vec<PositionSighting> = seen
            .iter()
            .filter_map(|s| {
                subjects.get(&s.barcode).filter(|seen| robots.contains(seen) && *seen != robot).map(|who| (s, who))
            })
            .map(|(s, who)| Ok(position(s, name(*who, out)?)))
            .collect::<Result<_, RecordingError>>()?;
        seen.retain(|s| subjects.get(&s.barcode).is_some_and(|subject| !robots.contains(subject)));
        let keyframes = keyframes(&speeds, &seen);
        if keyframes.is_empty() {
            let why = "no landmark is seen while the odometry runs; are both files of one robot and one run?";
            return Err(Problem::Data(why.into()).of(data.join(measured)));
        }
        made.push((name(*robot, out)?, keyframes, met));
    }
    // All logs of a run are on one clock.
    let begins = made.iter().filter_map(|(_, keyframes, _)| keyframes.first()).map(|first| first.stamp).min();
    made.into_iter().try_for_each(|(robot, keyframes, met)| {
        let manifest = Manifest {
            format: FORMAT.into(),
            version: VERSION,
            robot,
            sensor: "landmarks2d".into(),
            covariance_of: CovarianceOf::Motion,
            clouds: CloudFormat::Ply,
            keyframes: 0,
            origin: "MRCLAM logs, whole; every other sighting of a landmark corrects the odometry, the others are handed over"
                .into(),
            unit_m: None,
            begins_ns: begins.map(|stamp| stamp.0),
            places: None,
            config: config.clone(),
        };
        write(out, manifest, &keyframes, &met)
    })
}

fn name(robot: u32, out: &Path) -> Result<Name, RecordingError> {
    Name::new(format!("robot{robot}")).map_err(|e| Problem::Data(e.to_string()).of(out))
}

fn write(
    out: &Path,
    manifest: Manifest,
    keyframes: &[Keyframe],
    met: &[PositionSighting],
) -> Result<(), RecordingError> {
    let folder = out.join(manifest.robot.as_str());
    // What an earlier run left must not pass for part of this one.
    if folder.exists() {
        on(&folder, std::fs::remove_dir_all(&folder))?;
    }
    let mut writer = Writer::create(&folder, manifest)?;
    keyframes.iter().try_for_each(|keyframe| writer.push(keyframe, None))?;
    met.iter().for_each(|seen| writer.push_position(seen));
    writer.finish()
}

/// Reads one file, packed or not.
fn read<T>(data: &Path, name: &str, parse: impl Fn(&str) -> Result<T, MrclamError>) -> Result<T, RecordingError> {
    let (plain, packed) = (data.join(name), data.join(format!("{name}{PACKED}")));
    let (path, text) = if plain.exists() {
        let text = read_bytes(&plain)?;
        (plain, text)
    } else {
        let text = unpacked(&packed)?;
        (packed, text)
    };
    let text = String::from_utf8(text).map_err(|_| {
        Problem::Data("is no text; the files of MRCLAM hold plain text, packed ones end in .xz".into()).of(&path)
    })?;
    parse(&text).map_err(|error| Problem::Data(error.what.to_string()).at(path, error.line))
}

fn unpacked(path: &PathBuf) -> Result<Vec<u8>, RecordingError> {
    let bytes = unpacked_xz(path, &read_bytes(path)?, FILE_BYTES_MAX + 1)?;
    if bytes.len() as u64 > FILE_BYTES_MAX {
        return Err(Problem::Data(format!("unpacks to more than {FILE_BYTES_MAX} bytes; cut the log")).of(path));
    }
    Ok(bytes)
}

#[cfg(test)]
mod tests {
    use super::super::import::{Kind, detect, prepare};
    use super::*;
    use std::fmt::Write as _;
    use std::fs;

    /// Two robots that drive straight on past two landmarks.
    fn write_good(data: &Path) {
        fs::write(data.join(BARCODES), "# Subject # Barcode #\n 1 5\n 2 14\n 6 72\n 7 27\n").unwrap();
        for robot in 1..=2 {
            let (mut odometry, mut measured) = (String::from("# Time v w\n"), String::from("# Time code r b\n"));
            for k in 0..100 {
                let time = 1000.0 + 0.1 * f64::from(k);
                let _ = writeln!(odometry, "{time:.3} \t 0.5 \t 0.0");
                let left = 10.0 - 0.05 * f64::from(k);
                let _ = writeln!(measured, "{time:.3} 72 {left:.3} 0.0");
                let _ = writeln!(measured, "{time:.3} 27 {:.3} {:.3}", left.hypot(2.0), (2.0 / left).atan());
                let _ = writeln!(measured, "{time:.3} 14 3.0 0.1");
            }
            fs::write(data.join(format!("Robot{robot}_Odometry.dat")), odometry).unwrap();
            fs::write(data.join(format!("Robot{robot}_Measurement.dat")), measured).unwrap();
        }
    }

    #[test]
    fn logs_become_recordings_of_landmarks() {
        let (data, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        write_good(data.path());
        fs::write(data.path().join("run.log"), "what a tool said").unwrap();
        assert_eq!(detect(data.path()).unwrap(), Kind::Mrclam);
        let recordings = prepare(data.path(), out.path(), 1).unwrap().recordings;
        assert_eq!(recordings.iter().map(|r| r.manifest().robot.as_str()).collect::<Vec<_>>(), ["robot1", "robot2"]);
        recordings.iter().try_for_each(|recording| recording.check_clouds().map(drop)).unwrap();
        let keyframe = recordings[0].keyframe(5).unwrap();
        assert!(!keyframe.marks.is_empty() && keyframe.marks.len() == keyframe.points.len());
        assert!(keyframe.marks.iter().all(|mark| matches!(mark.label, Some(72 | 27))), "landmarks only, no robots");
        // The first sees the second, 3 m ahead and a little to the left; the second sees its own code, which is
        // misread.
        let [met, none] = [0, 1].map(|k| recordings[k].positions());
        assert_eq!((met.len(), none.len()), (100, 0));
        assert!(met.iter().all(|seen| seen.robot.as_str() == "robot2"));
        assert!((met[7].position[0] - 3.0 * 0.1f64.cos()).abs() < 1e-9 && (met[7].position[1] - 0.3).abs() < 1e-2);
        assert_eq!(recordings[0].begins(), recordings[1].keyframes()[0].stamp.min(recordings[0].keyframes()[0].stamp));
    }

    #[test]
    fn bad_files_are_told_with_file_and_line() {
        let refused = |spoil: &dyn Fn(&Path)| {
            let (data, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
            write_good(data.path());
            spoil(data.path());
            prepare(data.path(), out.path(), 1).unwrap_err()
        };
        let edit = |data: &Path, name: &str, from: &str, to: &str| {
            let text = fs::read_to_string(data.join(name)).unwrap();
            assert!(text.contains(from));
            fs::write(data.join(name), text.replacen(from, to, 1)).unwrap();
        };
        let error = refused(&|d| edit(d, "Robot1_Odometry.dat", "1000.100 \t 0.5", "1000.100 \t fast"));
        assert_eq!((error.path.file_name().unwrap().to_str(), error.line), (Some("Robot1_Odometry.dat"), Some(3)));
        assert!(error.to_string().contains("forward velocity = \"fast\""), "{error}");
        let error = refused(&|d| edit(d, "Robot2_Measurement.dat", "1000.100 72", "900.000 72"));
        assert_eq!(error.line, Some(5), "{error}");
        assert!(error.to_string().contains("sort the file by time"), "{error}");
        let error = refused(&|d| fs::write(d.join(BARCODES), "6 72\n").unwrap());
        assert!(error.to_string().contains("names no subject of bar code"), "{error}");
        let error = refused(&|d| fs::remove_file(d.join("Robot2_Measurement.dat")).unwrap());
        assert!(error.to_string().contains("Robot2_Measurement.dat.xz"), "{error}");
        let error = refused(&|d| fs::write(d.join("Robot1_Odometry.dat"), [0xff, 0xfe]).unwrap());
        assert!(error.to_string().contains("plain text"), "{error}");
        let error = refused(&|d| fs::write(d.join("Robot1_Odometry.dat"), "# nothing\n").unwrap());
        assert!(error.to_string().contains("no landmark is seen while the odometry runs"), "{error}");
    }
}

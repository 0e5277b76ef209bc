//! Writing recordings, keyframe by keyframe. Numbers are printed in the shortest form that reads back to the same bits,
//! so the same keyframes give the same files.

use super::cloud;
use super::error::{Problem, RecordingError, on};
use super::landmarks;
use super::places::Rows;
use super::{KEYFRAMES, MANIFEST, PLACES, POSITIONS, TRUTH, UPS};
use crate::manifest::{FORMAT, KEYFRAMES_HEADER, Manifest, POSITIONS_HEADER, TRUTH_HEADER, UP_HEADER, VERSION};
use merganser_protocol::agent::io::PositionSighting;
use merganser_protocol::geometry::Se3;
use merganser_protocol::submap::Keyframe;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

/// Folder of the clouds inside a recording.
const CLOUDS: &str = "clouds";

/// A recording being written. Nothing is a recording until [`Writer::finish`] has written the manifest.
#[derive(Debug)]
pub struct Writer {
    folder: PathBuf,
    manifest: Manifest,
    keyframes: String,
    truth: String,
    places: Rows,
    positions: String,
    ups: String,
}

impl Writer {
    /// Begins a recording in `folder`, which is made if need be. Format, version, meaning of the covariances and number
    /// of keyframes of `manifest` are filled in while writing.
    ///
    /// # Errors
    /// [`RecordingError`] if the folder cannot be made.
    pub fn create(folder: &Path, manifest: Manifest) -> Result<Self, RecordingError> {
        on(folder, fs::create_dir_all(folder.join(CLOUDS)))?;
        let manifest = Manifest { format: FORMAT.into(), version: VERSION, keyframes: 0, ..manifest };
        let (keyframes, truth) = (format!("{KEYFRAMES_HEADER}\n"), format!("{TRUTH_HEADER}\n"));
        let positions = format!("{POSITIONS_HEADER}\n");
        let (places, ups) = (Rows::default(), format!("{UP_HEADER}\n"));
        Ok(Self { folder: folder.into(), manifest, keyframes, truth, places, positions, ups })
    }

    /// Adds a keyframe, with `t_world_body` where it is known: for all keyframes or for none.
    ///
    /// # Errors
    /// [`RecordingError`] if the cloud cannot be written.
    pub fn push(&mut self, keyframe: &Keyframe, truth: Option<&Se3>) -> Result<(), RecordingError> {
        let format = self.manifest.clouds;
        let cloud = format!("{CLOUDS}/{:06}.{}", self.manifest.keyframes, cloud::extension(format));
        let path = self.folder.join(&cloud);
        let bytes = if keyframe.marks.is_empty() {
            cloud::encode(&keyframe.points, format)
        } else {
            landmarks::encode(&keyframe.points, &keyframe.marks)
        };
        let bytes = bytes.map_err(|problem| problem.of(&path))?;
        on(&path, fs::write(&path, bytes))?;
        self.places.push(keyframe.place.as_ref()).map_err(|problem| problem.of(self.folder.join(PLACES)))?;
        if let Some(up) = &keyframe.up {
            let [x, y, z] = (*up.direction()).into();
            let _ = writeln!(self.ups, "{},{x},{y},{z},{}", keyframe.stamp.0, up.sigma());
        }
        line(&mut self.keyframes, keyframe.stamp.0, &keyframe.pose.pose);
        let p = keyframe.pose.covariance.matrix();
        for (row, column) in (0..6).flat_map(|row| (row..6).map(move |column| (row, column))) {
            let _ = write!(self.keyframes, ",{}", p[(row, column)]);
        }
        let _ = writeln!(self.keyframes, ",{cloud}");
        if let Some(pose) = truth {
            line(&mut self.truth, keyframe.stamp.0, pose);
            self.truth.push('\n');
        }
        self.manifest.covariance_of = keyframe.covariance_of;
        self.manifest.keyframes += 1;
        Ok(())
    }

    /// Adds where another robot was seen; stamps do not fall.
    pub fn push_position(&mut self, seen: &PositionSighting) {
        let _ = write!(self.positions, "{},{}", seen.stamp.0, seen.robot);
        for value in seen.position.iter().chain(&seen.covariance) {
            let _ = write!(self.positions, ",{value}");
        }
        self.positions.push('\n');
    }

    /// Writes the tables and the manifest.
    ///
    /// # Errors
    /// [`RecordingError`] of the file system, or if truth was given for some keyframes only.
    pub fn finish(mut self) -> Result<(), RecordingError> {
        let write = |name: &str, bytes: &[u8]| {
            let path = self.folder.join(name);
            on(&path, fs::write(&path, bytes))
        };
        write(KEYFRAMES, self.keyframes.as_bytes())?;
        if let Some((format, rows)) = self.places.finish() {
            write(PLACES, rows)?;
            self.manifest.places = Some(format);
        }
        if self.positions.lines().count() > 1 {
            write(POSITIONS, self.positions.as_bytes())?;
        }
        if self.ups.lines().count() > 1 {
            write(UPS, self.ups.as_bytes())?;
        }
        let truths = self.truth.lines().count() - 1;
        if truths != 0 {
            if truths != self.manifest.keyframes {
                let problem = Problem::TruthCount { found: truths, keyframes: self.manifest.keyframes };
                return Err(problem.of(self.folder.join(TRUTH)));
            }
            write(TRUTH, self.truth.as_bytes())?;
        }
        let manifest = toml::to_string(&self.manifest)
            .map_err(|error| Problem::Manifest(error.to_string()).of(self.folder.join(MANIFEST)))?;
        write(MANIFEST, manifest.as_bytes())
    }
}

/// `stamp,x,y,z,qx,qy,qz,qw`, without the end of the line.
fn line(table: &mut String, stamp: i64, pose: &Se3) {
    let _ = write!(table, "{stamp}");
    for value in pose.translation.iter().copied().chain(pose.rotation.xyzw()) {
        let _ = write!(table, ",{value}");
    }
}

//! What a SLAM gives an agent: its messages ([`observation`]), its recordings on disk ([`manifest`] is the format), and
//! recordings made from other people's data sets ([`import`]).
//!
//! [`Recording::open`] reads the manifest and both tables and looks for every cloud; the clouds themselves are read one
//! by one, by [`Recording::keyframe`]. A bad recording is refused with one error that names file and line.

mod axes;
mod bin;
mod bounded;
pub mod carmen;
pub mod cloud;
mod cut;
mod deal;
pub mod depth;
mod drift;
mod error;
pub mod import;
mod import_bag;
mod import_laser;
mod import_lidar;
mod import_mrclam;
mod import_rgbd;
mod landmarks;
mod limits;
mod line_error;
mod lzf;
pub mod manifest;
pub mod mrclam;
pub mod observation;
mod pcd;
mod places;
pub mod ply;
mod remark;
mod scalar;
mod table;
mod text;
mod unmeasured;
mod write;

pub use drift::Drift;
pub use error::{Problem, RecordingError};
pub use remark::{Remark, Remarks};
pub use table::{KeyframeLine, TruthLine};
pub use write::Writer;

use crate::manifest::{FORMAT, KEYFRAMES_MAX, Manifest, UNIT_RANGE_M, VERSION};
use error::on;
use merganser_protocol::agent::io::PositionSighting;
use merganser_protocol::geometry::Se3;
use merganser_protocol::geometry::quaternion_order::QuaternionOrder;
use merganser_protocol::submap::{Keyframe, Up};
use merganser_protocol::time::Stamp;
use merganser_protocol::wire::fact::ScaleKind;
use std::io::Read;
use std::path::{Path, PathBuf};

/// Name of the manifest.
pub const MANIFEST: &str = "recording.toml";
/// Name of the table of keyframes.
pub const KEYFRAMES: &str = "keyframes.csv";
/// Name of the table of true poses.
pub const TRUTH: &str = "truth.csv";
/// Name of the table of where other robots were seen.
pub const POSITIONS: &str = "positions.csv";
/// Name of the table of what is up.
pub const UPS: &str = "up.csv";
/// Name of the file of place descriptors.
pub const PLACES: &str = "places.f32";
/// Time from the beginning of a data set to a robot's first keyframe, s, at most.
const BEGINS_SECS_MAX: f64 = 86_400.0;
/// Bytes of a manifest at most.
const MANIFEST_BYTES_MAX: u64 = 1 << 20;

/// A checked recording: everything but the points is in memory.
#[derive(Clone, Debug)]
pub struct Recording {
    folder: PathBuf,
    manifest: Manifest,
    keyframes: Vec<KeyframeLine>,
    truth: Option<Vec<TruthLine>>,
    positions: Vec<PositionSighting>,
    /// Which way each keyframe has up; none at all without the table.
    ups: Vec<Option<Up>>,
}

impl Recording {
    /// Opens and checks the recording in `folder`; clouds are only seen to exist.
    ///
    /// # Errors
    /// [`RecordingError`] for the first problem.
    pub fn open(folder: &Path) -> Result<Self, RecordingError> {
        let manifest = read_manifest(&folder.join(MANIFEST))?;
        let table = folder.join(KEYFRAMES);
        let keyframes = table::read_keyframes(&table)?;
        if keyframes.len() != manifest.keyframes {
            return Err(Problem::Count { found: keyframes.len(), stated: manifest.keyframes }.of(table));
        }
        for (index, line) in keyframes.iter().enumerate() {
            if !folder.join(&line.cloud).is_file() {
                return Err(Problem::CloudMissing(line.cloud.display().to_string()).at(table, index + 2));
            }
        }
        if let Some(format) = &manifest.places {
            places::check(&folder.join(PLACES), format, manifest.keyframes)?;
        }
        let truth = folder.join(TRUTH);
        let truth = if truth.exists() { Some(read_truth(&truth, &keyframes)?) } else { None };
        if let (Some(begins), Some(first)) = (manifest.begins_ns, keyframes.first())
            && !(0.0..=BEGINS_SECS_MAX).contains(&first.stamp.secs_since(Stamp(begins)))
        {
            let problem = Problem::Begins { begins, first: first.stamp.0 };
            return Err(problem.of(folder.join(MANIFEST)));
        }
        let positions = folder.join(POSITIONS);
        let positions = if positions.exists() { table::read_positions(&positions)? } else { Vec::new() };
        let ups = folder.join(UPS);
        let ups = if ups.exists() { table::read_ups(&ups, &keyframes)? } else { Vec::new() };
        Ok(Self { folder: folder.into(), manifest, keyframes, truth, positions, ups })
    }

    /// Reads every cloud once, to find a bad one before any use; says what was odd in them.
    ///
    /// # Errors
    /// [`RecordingError`] for the first.
    pub fn check_clouds(&self) -> Result<Remarks, RecordingError> {
        let mut remarks = Remarks::default();
        for (index, line) in self.keyframes.iter().enumerate() {
            let (_, odd) = self.remarked(index)?;
            remarks.note(&self.folder.join(&line.cloud), odd);
        }
        for (table, told) in self.check_poses() {
            remarks.note(&table, vec![told]);
        }
        Ok(remarks)
    }

    /// The tables whose poses move as if their quaternions were written w first.
    pub fn check_poses(&self) -> Vec<(PathBuf, Remark)> {
        let doubted = |poses: &mut dyn Iterator<Item = Se3>| {
            let mut order = QuaternionOrder::default();
            poses.for_each(|pose| order.push(&pose));
            order.is_doubtful()
        };
        let keyframes = doubted(&mut self.keyframes.iter().map(|line| line.pose.pose));
        let truth = doubted(&mut self.truth.iter().flatten().map(|line| line.pose));
        let tables = [(KEYFRAMES, keyframes), (TRUTH, truth)];
        tables.into_iter().filter(|(_, odd)| *odd).map(|(name, _)| (self.folder.join(name), Remark::WFirst)).collect()
    }

    /// Where it lies.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// What it is.
    pub fn manifest(&self) -> &Manifest {
        &self.manifest
    }

    /// Stamps, poses and covariances, in rising order of stamps; never empty.
    pub fn keyframes(&self) -> &[KeyframeLine] {
        &self.keyframes
    }

    /// `t_world_body` at each keyframe, if the recording has it.
    pub fn truth(&self) -> Option<&[TruthLine]> {
        self.truth.as_deref()
    }

    /// Where other robots were seen, in the order of the stamps.
    pub fn positions(&self) -> &[PositionSighting] {
        &self.positions
    }

    /// What the robot's clock showed when the recording began.
    pub fn begins(&self) -> Stamp {
        let first = self.keyframes.first().map_or(Stamp(0), |first| first.stamp);
        self.manifest.begins_ns.map_or(first, Stamp)
    }

    /// Number of keyframes, at least 1.
    #[expect(clippy::len_without_is_empty, reason = "a recording without keyframes is refused")]
    pub fn len(&self) -> usize {
        self.keyframes.len()
    }

    /// Time from the first keyframe to the last, s.
    pub fn duration_secs(&self) -> f64 {
        match (self.keyframes.first(), self.keyframes.last()) {
            (Some(first), Some(last)) => last.stamp.secs_since(first.stamp),
            _ => 0.0,
        }
    }

    /// Time from the beginning to the last keyframe, s.
    pub fn ends_after_secs(&self) -> f64 {
        self.keyframes.last().map_or(0.0, |last| last.stamp.secs_since(self.begins()))
    }

    /// The points of keyframe `index`, body frame, m.
    ///
    /// # Errors
    /// [`RecordingError`] if the cloud cannot be used, or there is no such keyframe.
    pub fn points(&self, index: usize) -> Result<Vec<[f32; 3]>, RecordingError> {
        cloud::read(&self.folder.join(&self.line(index)?.cloud), self.manifest.clouds)
    }

    /// Keyframe `index` with its points.
    ///
    /// # Errors
    /// As [`Recording::points`].
    pub fn keyframe(&self, index: usize) -> Result<Keyframe, RecordingError> {
        self.remarked(index).map(|(keyframe, _)| keyframe)
    }

    /// The same, with what is odd in its cloud.
    ///
    /// # Errors
    /// As [`Recording::points`].
    pub fn remarked(&self, index: usize) -> Result<(Keyframe, Vec<Remark>), RecordingError> {
        let line = self.line(index)?;
        let (points, odd) = cloud::read_remarked(&self.folder.join(&line.cloud), self.manifest.clouds)?;
        let covariance_of = self.manifest.covariance_of;
        let marks = if self.manifest.config.submap.sensor.sees_landmarks() {
            landmarks::read(&self.folder.join(&line.cloud), self.manifest.clouds)?
        } else {
            Vec::new()
        };
        let place = match &self.manifest.places {
            Some(format) => places::read(&self.folder.join(PLACES), format, index)?,
            None => None,
        };
        let up = self.ups.get(index).copied().flatten();
        let keyframe =
            Keyframe { stamp: line.stamp, session: None, pose: line.pose, covariance_of, points, marks, place, up };
        Ok((keyframe, odd))
    }

    fn line(&self, index: usize) -> Result<&KeyframeLine, RecordingError> {
        let missing = || Problem::Data(format!("there is no keyframe {index}, only {}", self.len())).of(&self.folder);
        self.keyframes.get(index).ok_or_else(missing)
    }
}

/// Reads the manifest. Format and version are looked at first, so that a recording of a later version is told as such
/// and not by whatever else is new in it.
fn read_manifest(path: &Path) -> Result<Manifest, RecordingError> {
    let file = on(path, std::fs::File::open(path))?;
    let mut bytes = Vec::new();
    on(path, file.take(MANIFEST_BYTES_MAX + 1).read_to_end(&mut bytes))?;
    if bytes.len() as u64 > MANIFEST_BYTES_MAX {
        let why = format!("is longer than {MANIFEST_BYTES_MAX} bytes (MANIFEST_BYTES_MAX); is this the manifest?");
        return Err(Problem::Manifest(why).of(path));
    }
    let text = String::from_utf8(bytes).map_err(|error| {
        let good = &error.as_bytes()[..error.utf8_error().valid_up_to()];
        let line = good.iter().filter(|byte| **byte == b'\n').count() + 1;
        Problem::Manifest("is no text; save it as UTF-8".into()).at(path, line)
    })?;
    let refuse = |error: toml::de::Error| {
        let problem = Problem::Manifest(error.message().trim_end().to_owned());
        let line = error.span().map(|span| text.bytes().take(span.start).filter(|b| *b == b'\n').count() + 1);
        RecordingError { path: path.into(), line, problem }
    };
    let table: toml::Table = text.parse().map_err(refuse)?;
    match table.get("format") {
        Some(toml::Value::String(format)) if format == FORMAT => {}
        Some(other) => return Err(Problem::Format(other.as_str().unwrap_or_default().into()).of(path)),
        None => return Err(Problem::Manifest(format!("has no line format = {FORMAT:?}")).of(path)),
    }
    if let Some(toml::Value::Integer(version)) = table.get("version")
        && *version != i64::from(VERSION)
    {
        return Err(Problem::Version(*version).of(path));
    }
    let manifest: Manifest = toml::from_str(&text).map_err(refuse)?;
    if !(1..=KEYFRAMES_MAX).contains(&manifest.keyframes) {
        return Err(Problem::KeyframesRange(manifest.keyframes).of(path));
    }
    manifest.config.validate().map_err(|error| Problem::Config(error).of(path))?;
    if let Some(unit_m) = manifest.unit_m {
        if manifest.config.submap.scale == ScaleKind::Metric {
            return Err(Problem::UnitOfMetres.of(path));
        }
        if !UNIT_RANGE_M.contains(&unit_m) {
            return Err(Problem::UnitRange(unit_m).of(path));
        }
    }
    Ok(manifest)
}

fn read_truth(path: &Path, keyframes: &[KeyframeLine]) -> Result<Vec<TruthLine>, RecordingError> {
    let truth = table::read_truth(path)?;
    for (index, (line, keyframe)) in truth.iter().zip(keyframes).enumerate() {
        if line.stamp != keyframe.stamp {
            let problem = Problem::TruthStamp { found: line.stamp.0, expected: keyframe.stamp.0 };
            return Err(problem.at(path, index + 2));
        }
    }
    if truth.len() != keyframes.len() {
        return Err(Problem::TruthCount { found: truth.len(), keyframes: keyframes.len() }.of(path));
    }
    Ok(truth)
}

#[cfg(test)]
mod bag_tests;
#[cfg(test)]
mod import_tests;
#[cfg(test)]
mod tests;

//! A sequence whose true poses are known becomes robots: consecutive parts of equal length, with a seeded drift.

use super::error::{Problem, RecordingError, on};
use super::{Drift, Writer};
use crate::manifest::{CloudFormat, FORMAT, Manifest, VERSION};
use merganser_protocol::config::Config;
use merganser_protocol::geometry::Se3;
use merganser_protocol::ids::Name;
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::Stamp;
use std::path::{Path, PathBuf};

/// Names of the robots that a sequence is cut into.
pub(super) const NAMES: [&str; 6] = ["alpha", "beta", "gamma", "delta", "epsilon", "zeta"];

/// One measurement of a sequence whose true poses are known.
pub(super) struct Scan {
    /// On the one clock of the sequence.
    pub stamp: Stamp,
    /// `t_world_body`.
    pub truth: Se3,
    /// Where its points come from.
    pub source: PathBuf,
}

/// How a sequence becomes robots.
pub(super) struct Cut<'a> {
    pub robots: usize,
    pub sensor: &'a str,
    pub origin: String,
    pub drift: Drift,
    pub seed: u64,
    pub config: Config,
}

impl Cut<'_> {
    /// Writes consecutive parts of equal length as one recording each into sub-folders of `out`.
    pub fn write(
        &self,
        scans: &[Scan],
        out: &Path,
        points: impl Fn(&Scan) -> Result<Vec<[f32; 3]>, RecordingError>,
    ) -> Result<(), RecordingError> {
        for (index, name) in NAMES.iter().enumerate().take(self.robots) {
            let part = &scans[index * scans.len() / self.robots..(index + 1) * scans.len() / self.robots];
            let folder = out.join(name);
            // What an earlier run left must not pass for part of this one.
            if folder.exists() {
                on(&folder, std::fs::remove_dir_all(&folder))?;
            }
            let truth: Vec<Se3> = part.iter().map(|scan| scan.truth).collect();
            let seed = self.seed.wrapping_mul(1000).wrapping_add(index as u64);
            let odometry = self.drift.odometry(&truth, seed).map_err(|e| Problem::Covariance(e).of(&folder))?;
            let mut writer = Writer::create(&folder, self.manifest(name).map_err(|problem| problem.of(&folder))?)?;
            for (scan, pose) in part.iter().zip(odometry) {
                let covariance_of = CovarianceOf::Motion;
                let keyframe = Keyframe {
                    stamp: scan.stamp,
                    session: None,
                    pose,
                    covariance_of,
                    points: points(scan)?,
                    marks: vec![],
                    place: None,
                    up: None,
                };
                writer.push(&keyframe, Some(&scan.truth))?;
            }
            writer.finish()?;
        }
        Ok(())
    }

    fn manifest(&self, name: &str) -> Result<Manifest, Problem> {
        Ok(Manifest {
            format: FORMAT.into(),
            version: VERSION,
            robot: Name::new(name).map_err(|error| Problem::Data(error.to_string()))?,
            sensor: self.sensor.into(),
            covariance_of: CovarianceOf::Motion,
            clouds: CloudFormat::Ply,
            keyframes: 0,
            origin: format!("{}; laid on the true motion: {} (1 σ, seed {})", self.origin, self.drift, self.seed),
            unit_m: None,
            begins_ns: None,
            places: None,
            config: self.config.clone(),
        })
    }
}

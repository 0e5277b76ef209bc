//! A folder for the files of each thread, and a good recording in it.

use merganser_protocol::agent::io::PositionSighting;
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::place::Metric;
use merganser_protocol::submap::{CovarianceOf, Keyframe, Mark, PlaceDescriptor, Up};
use merganser_protocol::time::Stamp;
use merganser_recording::Writer;
use merganser_recording::manifest::{CloudFormat, Manifest};
use nalgebra::Vector6;
use std::cell::OnceCell;
use std::fs;
use std::path::{Path, PathBuf};

/// The cloud of landmarks of the good recording's first keyframe.
pub const LANDMARKS: &str = "clouds/000000.ply";

/// See the module.
pub struct Folder {
    dir: tempfile::TempDir,
}

impl Folder {
    /// With this thread's folder.
    pub fn with<T>(work: impl FnOnce(&Self) -> T) -> T {
        thread_local! {
            static FOLDER: OnceCell<Folder> = const { OnceCell::new() };
        }
        FOLDER.with(|folder| {
            work(folder.get_or_init(|| {
                let folder = Self { dir: tempfile::tempdir().unwrap() };
                ["good", "changed"].iter().for_each(|name| write_good(&folder.path(name)));
                folder
            }))
        })
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.dir.path().join(name)
    }

    /// A good recording with these bytes in place of a file, until [`Folder::restore`].
    pub fn recording_with(&self, file: &str, bytes: &[u8]) -> PathBuf {
        let changed = self.path("changed");
        fs::write(changed.join(file), bytes).unwrap();
        changed
    }

    /// The recording as it was.
    pub fn restore(&self, file: &str) {
        fs::copy(self.path("good").join(file), self.path("changed").join(file)).unwrap();
    }
}

/// The bytes of a file of the good recording.
pub fn good(file: &str) -> Vec<u8> {
    Folder::with(|folder| fs::read(folder.path("good").join(file)).unwrap())
}

/// A manifest of landmarks, or of such clouds.
pub fn manifest(clouds: CloudFormat, sensor: Sensor) -> Manifest {
    let mut config = Config::default();
    config.submap.sensor = sensor;
    Manifest {
        format: String::new(),
        version: 0,
        robot: Name::new("alpha").unwrap(),
        sensor: "none".into(),
        covariance_of: CovarianceOf::Motion,
        clouds,
        keyframes: 0,
        origin: "a test".into(),
        unit_m: None,
        begins_ns: Some(900),
        places: None,
        config,
    }
}

/// Four keyframes of landmarks, with all that a recording can hold.
fn write_good(folder: &Path) {
    let mut writer = Writer::create(folder, manifest(CloudFormat::Ply, Sensor::Landmarks)).unwrap();
    for i in 0..4 {
        let pose = Se3::exp(&Vector6::new(0.3 * f64::from(i), 0.0, 0.1, 0.0, 0.02, 0.7));
        let covariance = Covariance::from_sigmas([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]).unwrap();
        let mark = |k: u32| Mark {
            covariance: Covariance::from_sigmas([0.1, 0.2, 0.3]).unwrap(),
            label: (k != 1).then_some(k),
            descriptor: (k > 0).then_some([k as u8; 32]),
        };
        let keyframe = Keyframe {
            stamp: Stamp(1000 + i64::from(i)),
            session: None,
            pose: PoseWithCovariance { pose, covariance },
            covariance_of: CovarianceOf::Motion,
            points: vec![[1.0, 2.0, 3.0 + i as f32]; 3],
            marks: (0..3).map(mark).collect(),
            place: (i > 0).then(|| PlaceDescriptor::new("net", Metric::Cosine, vec![0.5, -0.25, 1.0]).unwrap()),
            up: (i % 2 == 1).then(|| Up::new([0.0, 0.0, 1.0], 0.03).unwrap()),
        };
        writer.push(&keyframe, Some(&pose)).unwrap();
    }
    for stamp in [990, 1002, 1002] {
        let covariance = [0.01, 1e-3, 0.0, 0.02, 0.0, 1.0];
        let robot = Name::new("beta").unwrap();
        writer.push_position(&PositionSighting { stamp: Stamp(stamp), robot, position: [1.5, -0.25, 0.0], covariance });
    }
    writer.finish().unwrap();
}

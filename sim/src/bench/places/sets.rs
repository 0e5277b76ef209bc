//! The recorded sets as described submaps with true poses.

use super::{aces, files};
use crate::bench::cpu::thread_seconds;
use crate::dice::Dice;
use anyhow::Context;
use merganser_protocol::config::{Sensor, SubmapConfig};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::submap::{CovarianceOf, Described, Keyframe, Submap, SubmapBuilder, Up, describe};
use merganser_protocol::time::Stamp;
use nalgebra::Vector3;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::collections::BTreeMap;
use std::path::Path;

/// Thins a turn of KITTI's LiDAR to about 20,000 points.
const DENSE_VOXEL_M: f64 = 0.3;

/// Against gravity in the world of the depth camera, whose axes are those of some camera: the mean normal of what lies
/// within 6° of level in 17 of its images. Two walls stand at 88.5° and 92.5° to it.
const SEVEN_SCENES_UP: [f64; 3] = [0.005, -0.890, -0.457];

/// A described submap.
pub(super) struct Place {
    /// Its number in the set's own counting.
    pub name: String,
    /// What is known of it.
    pub described: Described,
    /// The truth.
    pub t_world_anchor: Se3,
    /// Keyframes that it is made of.
    pub keyframes: usize,
    /// Processor time to thin and to describe it, s.
    pub thin_s: f64,
    /// See above.
    pub describe_s: f64,
    /// The single scan it is made of, as recorded, for peers.
    pub scan: Option<Scan>,
}

/// A recorded scan and how it was turned.
pub(super) struct Scan {
    /// Little-endian f32.
    pub path: std::path::PathBuf,
    /// Floats a point.
    pub stride: usize,
    /// Turns its points into the body frame used here.
    pub turn: So3,
}

/// Submaps of one world and sensor.
pub(super) struct Set {
    /// Its name.
    pub name: &'static str,
    /// What saw it.
    pub sensor: Sensor,
    /// Its submaps.
    pub places: Vec<Place>,
    /// An alignment is right within this angle...
    pub rotation_deg: f64,
    /// ...and distance.
    pub translation_m: f64,
    /// Directions to find at least, of those that overlap by a quarter.
    pub found_min: usize,
    /// Wrong answers at most. A building with two halves alike is not told apart by one pair of submaps.
    pub wrong_max: usize,
}

/// Loads all sets; each submap's body is turned at random.
pub(super) fn load(data: &Path, keypoints: usize, gravity: Option<f64>, seed: u64) -> anyhow::Result<Vec<Set>> {
    let gravity = gravity.map(|sigma| (sigma, Dice::new(seed, "gravity")));
    let mut maker = Maker { keypoints, gravity, rng: ChaCha8Rng::seed_from_u64(seed) };
    let aces = aces::load(data, keypoints)?;
    Ok(vec![maker.seven_scenes(data)?, maker.kitti07(data)?, maker.kitti00(data)?, aces])
}

/// A whole LiDAR turn thinned less than usual: about 20,000 points.
///
/// # Errors
/// Data that is not there.
pub(super) fn dense(data: &Path, keypoints: usize, seed: u64) -> anyhow::Result<Place> {
    let mut maker = Maker { keypoints, gravity: None, rng: ChaCha8Rng::seed_from_u64(seed) };
    let points = files::points(&data.join("kitti00_scans/000000.bin"), 4)?;
    Ok(maker.place("dense".to_owned(), DENSE_VOXEL_M, &Vector3::z(), vec![(Se3::identity(), points)])?.0)
}

struct Maker {
    keypoints: usize,
    /// Standard deviation of the verticals, rad, and the dice they are drawn with; none without verticals.
    gravity: Option<(f64, Dice)>,
    rng: ChaCha8Rng,
}

impl Maker {
    /// 10 submaps of 5 depth images each.
    fn seven_scenes(&mut self, data: &Path) -> anyhow::Result<Set> {
        let folder = data.join("rgbd_7scenes");
        let poses: BTreeMap<usize, Se3> = files::text(&folder.join("poses_all_1000.txt"))?
            .lines()
            .map(files::indexed_matrix)
            .collect::<Result<_, _>>()?;
        let mut places = Vec::new();
        for first in (0..1000).step_by(100) {
            let mut keyframes = Vec::new();
            for frame in (first..first + 100).step_by(20) {
                let pose = *poses.get(&frame).with_context(|| format!("no pose of frame {frame}"))?;
                keyframes.push((pose, files::depth_image(&folder.join(format!("frame-{frame:06}.depth.png")))?));
            }
            places.push(self.place((first / 100).to_string(), 0.05, &SEVEN_SCENES_UP.into(), keyframes)?.0);
        }
        Ok(Set {
            name: "7scenes",
            sensor: Sensor::Points3d,
            places,
            rotation_deg: 15.0,
            translation_m: 0.3,
            found_min: 76,
            wrong_max: 0,
        })
    }

    /// 5 scans, each a submap.
    fn kitti07(&mut self, data: &Path) -> anyhow::Result<Set> {
        let folder = data.join("lidar_gtsam_points/kitti_07_dump");
        let mut places = Vec::new();
        for line in files::text(&folder.join("graph.txt"))?.lines() {
            let (k, pose) = files::indexed_pose(line)?;
            places.push(self.scan(k.to_string(), pose, folder.join(format!("{k:06}/points.bin")), 3)?);
        }
        Ok(Set {
            name: "kitti07",
            sensor: Sensor::Lidar3d,
            places,
            rotation_deg: 5.0,
            translation_m: 2.0,
            found_min: 17,
            wrong_max: 0,
        })
    }

    /// 5 scans of another street.
    fn kitti00(&mut self, data: &Path) -> anyhow::Result<Set> {
        let text = files::text(&data.join("kitti_poses_lidar/kitti00.txt.xz"))?;
        let mut places = Vec::new();
        for k in [0, 5, 94, 198, 199] {
            let (_, pose) = files::indexed_pose(text.lines().nth(k).context("kitti00.txt.xz is cut")?)?;
            places.push(self.scan(k.to_string(), pose, data.join(format!("kitti00_scans/{k:06}.bin")), 4)?);
        }
        Ok(Set {
            name: "kitti00",
            sensor: Sensor::Lidar3d,
            places,
            rotation_deg: 5.0,
            translation_m: 2.0,
            found_min: 4,
            wrong_max: 0,
        })
    }

    fn scan(&mut self, name: String, pose: Se3, path: std::path::PathBuf, stride: usize) -> anyhow::Result<Place> {
        let points = files::points(&path, stride)?;
        let (place, turn) = self.place(name, 0.5, &Vector3::z(), vec![(pose, points)])?;
        Ok(Place { scan: Some(Scan { path, stride, turn }), ..place })
    }

    /// A submap of keyframes at true poses, whose body is turned.
    fn place(
        &mut self,
        name: String,
        voxel_m: f64,
        world_up: &Vector3<f64>,
        keyframes: Vec<(Se3, Vec<[f32; 3]>)>,
    ) -> anyhow::Result<(Place, So3)> {
        let turn = self.turn();
        let back = Se3::new(turn.inverse(), Vector3::zeros());
        let turned = |p: [f32; 3]| -> [f32; 3] { (turn * Vector3::from(p.map(f64::from))).map(|x| x as f32).into() };
        let keyframes: Vec<(Se3, Vec<[f32; 3]>)> = keyframes
            .into_iter()
            .map(|(pose, points)| (pose * back, points.into_iter().map(turned).collect()))
            .collect();
        let config = self.config(voxel_m);
        let up = self.up(world_up);
        let start = thread_seconds();
        let submap = build(&config, &keyframes, up.as_ref())?;
        let thinned = thread_seconds();
        let described = describe(&submap, &config);
        let done = thread_seconds();
        // The builder was told true poses: its anchor's is one of them.
        let t_world_anchor = submap.t_frame_anchor;
        let (thin_s, describe_s) = (thinned - start, done - thinned);
        let keyframes = submap.keyframes.len();
        Ok((Place { name, described, t_world_anchor, keyframes, thin_s, describe_s, scan: None }, turn))
    }

    /// What a submap's keyframes take for up, in the world: off by a draw that they have in common.
    fn up(&mut self, world_up: &Vector3<f64>) -> Option<(Vector3<f64>, f64)> {
        let (sigma, dice) = self.gravity.as_mut()?;
        let tilt = Vector3::from_fn(|_, _| *sigma * dice.normal());
        Some((So3::exp(&tilt) * *world_up, *sigma))
    }

    fn config(&self, voxel_m: f64) -> SubmapConfig {
        SubmapConfig {
            voxel_m,
            keyframes_max: 10_000,
            distance_m: 1e3,
            rotation_deg: 1e6,
            keypoints: self.keypoints,
            ..Default::default()
        }
    }

    /// Uniform over all rotations.
    fn turn(&mut self) -> So3 {
        loop {
            let q: [f64; 4] =
                core::array::from_fn(|_| f64::from(self.rng.next_u32()) / f64::from(u32::MAX) * 2.0 - 1.0);
            let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
            if (0.1..=1.0).contains(&norm)
                && let Some(turn) = So3::from_xyzw(q.map(|x| x / norm))
            {
                return turn;
            }
        }
    }
}

fn build(
    config: &SubmapConfig,
    keyframes: &[(Se3, Vec<[f32; 3]>)],
    up: Option<&(Vector3<f64>, f64)>,
) -> anyhow::Result<Submap> {
    let mut builder = SubmapBuilder::new(config.clone());
    for (k, (pose, points)) in (1..).zip(keyframes) {
        let covariance = Covariance::from_sigmas([0.01; 6])?;
        let in_body = |&(up, sigma): &(Vector3<f64>, f64)| Up::new((pose.rotation.inverse() * up).into(), sigma);
        let up = up.map(in_body).transpose()?;
        let pose = PoseWithCovariance { pose: *pose, covariance };
        let (stamp, covariance_of, points) = (Stamp(k), CovarianceOf::Motion, points.clone());
        builder.push(Keyframe { stamp, session: None, pose, covariance_of, points, marks: vec![], place: None, up })?;
    }
    builder.flush().context("no keyframes")
}

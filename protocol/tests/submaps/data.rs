//! Real submaps with true poses, from the data folder (`MERGANSER_SHARED` or `../shared` beside the workspace): the
//! sets of the prototype, ten RGB-D submaps of one room and five LiDAR scans along a street.

use merganser_protocol::config::{Sensor, SubmapConfig};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::submap::{CovarianceOf, Described, Keyframe, SubmapBuilder, describe};
use merganser_protocol::time::Stamp;
use nalgebra::{Matrix4, Vector3};
use std::fs;
use std::path::{Path, PathBuf};

/// A described submap and its true place.
pub struct Place {
    pub sensor: Sensor,
    pub described: Described,
    pub t_world_anchor: Se3,
    /// Processor time that describing it took, if the system tells.
    pub describe_ms: Option<f64>,
}

/// Submaps of one world with the rule for a successful alignment.
pub struct Set {
    pub name: &'static str,
    pub places: Vec<Place>,
    pub rotation_deg_max: f64,
    pub translation_max: f64,
}

/// The data folder, or a printed reason why there is none.
pub fn shared() -> Option<PathBuf> {
    let beside = PathBuf::from("../../shared");
    let folder = std::env::var_os("MERGANSER_SHARED").map_or(beside, PathBuf::from).join("data");
    if !folder.is_dir() {
        println!("skipped: no real data at {} (set MERGANSER_SHARED)", folder.display());
        return None;
    }
    Some(folder)
}

pub fn config(sensor: Sensor, voxel_m: f64, keyframes_max: u32) -> SubmapConfig {
    let uncut = SubmapConfig { distance_m: 1e3, rotation_deg: 1e6, ..Default::default() };
    SubmapConfig { sensor, voxel_m, keyframes_max, keypoints: 512, ..uncut }
}

/// A submap of keyframes at poses that are true.
pub fn place(config: &SubmapConfig, keyframes: Vec<(Se3, Vec<[f32; 3]>)>) -> Place {
    let truth: Vec<Se3> = keyframes.iter().map(|(pose, _)| *pose).collect();
    place_drifted(config, keyframes, &truth)
}

/// What the builder says of how views fit together: each time it says something, in voxels.
pub fn misfits(config: SubmapConfig, keyframes: Vec<(Se3, Vec<[f32; 3]>)>) -> Vec<f64> {
    let mut builder = SubmapBuilder::new(config);
    let mut told = Vec::new();
    for (k, (pose, points)) in keyframes.into_iter().enumerate() {
        builder.push(keyframe(k, pose, points)).unwrap();
        told.extend(builder.take_misfit());
    }
    told
}

fn keyframe(k: usize, pose: Se3, points: Vec<[f32; 3]>) -> Keyframe {
    let pose = PoseWithCovariance { pose, covariance: Covariance::from_sigmas([0.01; 6]).unwrap() };
    let (stamp, covariance_of) = (Stamp(k as i64 + 1), CovarianceOf::Motion);
    Keyframe { stamp, session: None, pose, covariance_of, points, marks: Vec::new(), place: None, up: None }
}

/// A submap of keyframes at believed poses; the anchor is truly where the keyframe is that it was placed at.
pub fn place_drifted(config: &SubmapConfig, keyframes: Vec<(Se3, Vec<[f32; 3]>)>, truth: &[Se3]) -> Place {
    let mut builder = SubmapBuilder::new(SubmapConfig { keyframes_max: 10_000, ..config.clone() });
    for (k, (pose, points)) in keyframes.into_iter().enumerate() {
        builder.push(keyframe(k, pose, points)).unwrap();
    }
    let submap = builder.flush().unwrap();
    let t_world_anchor = truth[submap.keyframes.iter().position(|t| t.log().amax() < 1e-9).unwrap()];
    let start = thread_cpu_ms();
    let described = describe(&submap, config);
    let describe_ms = start.and_then(|start| Some(thread_cpu_ms()? - start));
    Place { sensor: config.sensor, described, t_world_anchor, describe_ms }
}

/// Processor time of this thread so far.
fn thread_cpu_ms() -> Option<f64> {
    let text = fs::read_to_string("/proc/thread-self/schedstat").ok()?;
    Some(text.split_whitespace().next()?.parse::<f64>().ok()? * 1e-6)
}

/// Focal length of the camera of 7-Scenes, pixels.
pub const FOCAL: f32 = 585.0;

/// 7-Scenes: 10 submaps of 5 depth images each.
pub fn seven_scenes(data: &Path) -> Set {
    let folder = data.join("rgbd_7scenes");
    let poses = camera_poses(&folder);
    let config = config(Sensor::Points3d, 0.05, 5);
    let places = (0..1000).step_by(100).map(|first| {
        let frames = (first..first + 100).step_by(20);
        place(&config, frames.map(|k| (poses[k], depth_points(&folder, k, FOCAL))).collect())
    });
    Set { name: "7scenes", places: places.collect(), rotation_deg_max: 15.0, translation_max: 0.3 }
}

/// 7-Scenes as a robot has it whose camera is believed to have this focal length: three keyframes a second at true
/// poses.
pub fn believed_scenes(data: &Path, focal: f32) -> Vec<(Se3, Vec<[f32; 3]>)> {
    let folder = data.join("rgbd_7scenes");
    let poses = camera_poses(&folder);
    (0..500).step_by(10).map(|k| (poses[k], depth_points(&folder, k, focal))).collect()
}

fn camera_poses(folder: &Path) -> Vec<Se3> {
    let text = fs::read_to_string(folder.join("poses_all_1000.txt")).unwrap();
    text.lines().map(numbers).map(|v| Se3::from_matrix(&Matrix4::from_row_slice(&v[1..17]))).collect()
}

/// KITTI 07: 5 scans, each a submap.
pub fn kitti07(data: &Path) -> Set {
    let folder = data.join("lidar_gtsam_points/kitti_07_dump");
    let config = config(Sensor::Lidar3d, 0.5, 1);
    let graph = fs::read_to_string(folder.join("graph.txt")).unwrap();
    let places = graph.lines().enumerate().map(|(k, line)| {
        let v = numbers(line.trim_start_matches('v'));
        let pose = Se3::new(So3::from_xyzw([v[4], v[5], v[6], v[7]]).unwrap(), Vector3::new(v[1], v[2], v[3]));
        let bytes = fs::read(folder.join(format!("{k:06}/points.bin"))).unwrap();
        place(&config, vec![(pose, floats(&bytes, 3))])
    });
    Set { name: "kitti07", places: places.collect(), rotation_deg_max: 5.0, translation_max: 2.0 }
}

/// KITTI 00: 5 scans of another street, 2 pairs of which overlap.
pub fn kitti00(data: &Path) -> Vec<Place> {
    let config = config(Sensor::Lidar3d, 0.5, 1);
    let scans = ["000000", "000005", "000094", "000198", "000199"];
    let load = |name: &str| {
        let bytes = fs::read(data.join(format!("kitti00_scans/{name}.bin"))).unwrap();
        place(&config, vec![(Se3::identity(), floats(&bytes, 4))])
    };
    scans.iter().map(|name| load(name)).collect()
}

fn numbers(line: &str) -> Vec<f64> {
    line.split_whitespace().map(|x| x.parse().unwrap()).collect()
}

/// The first three of every `stride` little-endian floats.
fn floats(bytes: &[u8], stride: usize) -> Vec<[f32; 3]> {
    let all: Vec<f32> = bytes.as_chunks::<4>().0.iter().map(|b| f32::from_le_bytes(*b)).collect();
    all.chunks_exact(stride).map(|p| [p[0], p[1], p[2]]).collect()
}

/// Every fourth pixel with a depth of 0.3 to 4 m.
fn depth_points(folder: &Path, frame: usize, focal: f32) -> Vec<[f32; 3]> {
    let (cx, cy) = (320.0, 240.0);
    let file = fs::File::open(folder.join(format!("frame-{frame:06}.depth.png"))).unwrap();
    let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    let width = info.width as usize;
    let depths = pixels.as_chunks::<2>().0.iter().map(|b| f32::from(u16::from_be_bytes(*b)) / 1000.0);
    let points = depths.enumerate().filter(|(_, z)| *z > 0.3 && *z <= 4.0).step_by(4).map(|(k, z)| {
        let (u, v) = ((k % width) as f32, (k / width) as f32);
        [(u - cx) * z / focal, (v - cy) * z / focal, z]
    });
    points.collect()
}

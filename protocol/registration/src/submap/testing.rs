//! Small made-up submaps for this module's tests.
#![allow(missing_docs, clippy::unwrap_used, reason = "tests of this crate and of the core use it, and nothing else")]

use super::{CovarianceOf, Described, Keyframe, Submap, SubmapBuilder, describe};
use crate::config::SubmapConfig;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use crate::time::Stamp;
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;
use std::sync::Mutex;

pub fn config() -> SubmapConfig {
    SubmapConfig { voxel_m: 0.1, keypoints: 300, ..Default::default() }
}

/// Points on the walls of a box and of some furniture, all seen from the middle.
pub fn room_points(seed: u64) -> Vec<Vector3<f64>> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut boxes = vec![(Vector3::new(-2.5, -2.0, -1.0), Vector3::new(5.0, 4.0, 2.5))];
    for _ in 0..12 {
        let corner = Vector3::from_fn(|_, _| rng.random_range(-2.0..1.2));
        boxes.push((corner, Vector3::from_fn(|_, _| rng.random_range(0.2..1.0))));
    }
    let mut points = Vec::new();
    for (corner, size) in boxes {
        let area = size.x * size.y + size.y * size.z + size.z * size.x;
        for _ in 0..(area * 500.0) as usize {
            let mut at = Vector3::from_fn(|_, _| rng.random_range(0.0..1.0));
            at[rng.random_range(0..3)] = f64::from(rng.random_range(0..2u8));
            points.push(corner + at.component_mul(&size) + Vector3::from_fn(|_, _| rng.random_range(-0.01..0.01)));
        }
    }
    points
}

pub fn keyframe(stamp: i64, pose: Se3, points: &[Vector3<f64>]) -> Keyframe {
    Keyframe {
        stamp: Stamp(stamp),
        pose: PoseWithCovariance { pose, covariance: Covariance::from_sigmas([0.01; 6]).unwrap() },
        covariance_of: CovarianceOf::Motion,
        session: None,
        points: points.iter().map(|p| [p.x as f32, p.y as f32, p.z as f32]).collect(),
        marks: Vec::new(),
        place: None,
        up: None,
    }
}

/// The points as the one keyframe of a submap, in the body frame.
pub fn submap(points: &[Vector3<f64>]) -> Submap {
    let mut builder = SubmapBuilder::new(SubmapConfig { keyframes_max: 1, ..config() });
    builder.push(keyframe(1, Se3::identity(), points)).unwrap().unwrap()
}

/// A described room; made once per seed.
pub fn room(seed: u64) -> Described {
    static ROOMS: Mutex<BTreeMap<u64, Described>> = Mutex::new(BTreeMap::new());
    let mut rooms = ROOMS.lock().unwrap();
    rooms.entry(seed).or_insert_with(|| describe(&submap(&room_points(seed)), &config())).clone()
}

/// A room as a robot sees it whose body frame is turned by `phi` and moved by `at`: `t_body_room` is also returned.
pub fn moved_room(seed: u64, phi: Vector3<f64>, at: Vector3<f64>) -> (Described, Se3) {
    let t_body_room = Se3::new(So3::exp(&phi), at);
    let points: Vec<_> = room_points(seed).iter().map(|p| t_body_room * *p).collect();
    (describe(&submap(&points), &config()), t_body_room)
}

//! Graphs for tests: seeded noise, a world of robots, and a reader of g2o files.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::print_stderr,
    reason = "tests of this crate and of the core use it, and nothing else"
)]

use super::graph::{Factor, Source};
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, So3};
use crate::ids::{FrameId, RobotId, SubmapId};
use nalgebra::{Matrix6, Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::path::PathBuf;

pub fn rng(seed: u64) -> ChaCha8Rng {
    ChaCha8Rng::seed_from_u64(seed)
}

/// A standard normal number (Box and Muller).
pub fn normal(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v): (f64, f64) = (rng.random(), rng.random());
    (-2.0 * (1.0 - u).ln()).sqrt() * (core::f64::consts::TAU * v).cos()
}

/// A tangent vector drawn from `covariance`.
pub fn noise(rng: &mut ChaCha8Rng, covariance: &Covariance<6>) -> Vector6<f64> {
    covariance.matrix().cholesky().unwrap().l() * Vector6::from_fn(|_, _| normal(rng))
}

pub fn sigmas(rho: f64, phi: f64) -> Covariance<6> {
    Covariance::from_sigmas([rho, rho, rho, phi, phi, phi]).unwrap()
}

pub fn frame(robot: u8) -> FrameId {
    FrameId { robot: RobotId([robot; 8]), epoch: 0 }
}

pub fn submap(robot: u8, index: usize) -> SubmapId {
    SubmapId { frame: frame(robot), index: index as u32 }
}

/// A random pose within `reach` metres, any rotation.
pub fn any_pose(rng: &mut ChaCha8Rng, reach: f64) -> Se3 {
    let phi = Vector3::from_fn(|_, _| normal(rng)).normalize() * rng.random_range(0.0..core::f64::consts::PI);
    Se3::new(So3::exp(&phi), Vector3::from_fn(|_, _| rng.random_range(-reach..reach)))
}

/// A step of a robot that mostly moves forward and turns about its vertical.
pub fn any_step(rng: &mut ChaCha8Rng) -> Se3 {
    let turn = Vector3::new(0.03 * normal(rng), 0.03 * normal(rng), 0.4 * normal(rng));
    Se3::new(So3::exp(&turn), Vector3::new(2.0 + 0.2 * normal(rng), 0.1 * normal(rng), 0.05 * normal(rng)))
}

/// The measurement of `truth` with the noise its covariance claims.
pub fn measured(rng: &mut ChaCha8Rng, truth: &Se3, covariance: Covariance<6>) -> PoseWithCovariance {
    PoseWithCovariance { pose: truth.retract(&noise(rng, &covariance)), covariance }
}

/// Reads `VERTEX_SE3:QUAT` and `EDGE_SE3:QUAT` lines; every vertex becomes an anchor of one frame.
pub fn read_g2o(text: &str) -> (Vec<(SubmapId, Se3)>, Vec<Factor<SubmapId>>) {
    let (mut nodes, mut factors) = (Vec::new(), Vec::new());
    for line in text.lines() {
        let mut words = line.split_whitespace();
        let tag = words.next().unwrap_or_default();
        let ids = if tag.starts_with("VERTEX") { 1 } else { 2 };
        let ids: Vec<usize> = words.by_ref().take(ids).map(|w| w.parse().unwrap()).collect();
        let x: Vec<f64> = words.map(|w| w.parse().unwrap()).collect();
        if x.len() < 7 {
            continue;
        }
        let pose = Se3::new(So3::from_xyzw([x[3], x[4], x[5], x[6]]).unwrap(), Vector3::new(x[0], x[1], x[2]));
        match tag {
            "VERTEX_SE3:QUAT" => nodes.push((submap(0, ids[0]), pose)),
            "EDGE_SE3:QUAT" => {
                let mut information = Matrix6::zeros();
                let mut k = 7;
                for r in 0..6 {
                    for c in r..6 {
                        (information[(r, c)], information[(c, r)]) = (x[k], x[k]);
                        k += 1;
                    }
                }
                let inverse = information.try_inverse().unwrap();
                let covariance = Covariance::new((inverse + inverse.transpose()) * 0.5).unwrap();
                let t_i_j = Relative::Metric(PoseWithCovariance { pose, covariance });
                factors.push(Factor {
                    label: Source::Odometry,
                    i: submap(0, ids[0]),
                    j: submap(0, ids[1]),
                    t_i_j,
                    weight: 1.0,
                });
            }
            _ => {}
        }
    }
    nodes.sort_by_key(|n| n.0);
    (nodes, factors)
}

/// A file of the shared data, or `None` (with the reason printed) where it is absent.
pub fn shared(path: &str) -> Option<String> {
    let root = std::env::var_os("MERGANSER_SHARED").map_or_else(|| PathBuf::from("../../../shared"), PathBuf::from);
    let file = root.join(path);
    match std::fs::read_to_string(&file) {
        Ok(text) => Some(text),
        Err(error) => {
            eprintln!("skipped: {} cannot be read ({error})", file.display());
            None
        }
    }
}

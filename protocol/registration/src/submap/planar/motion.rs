//! Wheels slip and skid; the laser sees by how much. Each keyframe's scan is fitted to the walls of the keyframes
//! before it, with the odometry as a prior: the maximum a posteriori of both. Along a bare corridor the odometry stays
//! as it is, and the covariance says so.

use super::OUT_OF_PLANE_DRIVEN;
use super::fit::{Walls, system};
use super::lines::lines;
use super::se2::{Se2, in_plane, in_space};
use crate::geometry::PoseWithCovariance;
use nalgebra::{Matrix3, Vector2};
use std::collections::VecDeque;

/// Scans that make the walls a scan is fitted to.
const SCANS: usize = 24;
/// Points of a scan at most: thinned evenly beyond it.
const POINTS_MAX: usize = 720;
/// Search radii, one an iteration; the last is kept until steps are small...
const RADII: [f64; 6] = [8.0, 6.0, 4.0, 3.0, 2.0, 1.5];
/// ...or so many iterations are over.
const ITERATIONS_MAX: usize = 25;
/// A step below this (voxels, and rad at 30 voxels) is small.
const STEP: f64 = 0.01;
/// Cosine of the largest angle between a beam and what it hits.
const FACING: f64 = 0.1;
/// Pairs without which the odometry stays as it is.
const PAIRS_MIN: usize = 20;
/// Independent measurements that the pairs of one scan amount to: they lie on a few walls, and the walls were
/// themselves drawn from scans.
const INDEPENDENT_MAX: f64 = 20.0;
/// Least standard deviation of a sharpened motion: voxels...
const FLOOR: f64 = 0.1;
/// ...and rad.
const FLOOR_RAD: f64 = 0.003;
/// A fit that contradicts the odometry by more (χ²₃, 1e-5) is none.
const CHI2_MAX: f64 = 25.9;

/// Corrects motions, keyframe by keyframe.
#[derive(Clone, Debug, Default)]
pub struct Sharpener {
    /// Scans in the body frame and `t_frame_body` of each, in the frame of the first.
    recent: VecDeque<(Se2, Vec<Vector2<f64>>)>,
}

impl Sharpener {
    /// The motion since the last keyframe (none: there was no keyframe yet) as scan matching has it, in the plane.
    /// `points` are the new keyframe's, body frame; lengths are in frame units, `voxel` of them to a voxel.
    pub fn sharpen(
        &mut self,
        motion: Option<PoseWithCovariance>,
        points: &[[f32; 3]],
        voxel: f64,
    ) -> Option<PoseWithCovariance> {
        let scan = thinned(points, voxel);
        let Some(motion) = motion else {
            self.recent.clear();
            self.keep(Se2::new(0.0, Vector2::zeros()), scan);
            return None;
        };
        let (odometry, prior) = (Se2::of(&motion.pose, voxel), in_plane(&motion.covariance, voxel));
        let last = self.recent.back().map_or_else(|| Se2::new(0.0, Vector2::zeros()), |(pose, _)| *pose);
        let (step, covariance) = self.fitted(&last, &odometry, &prior, &scan).unwrap_or((odometry, prior));
        self.keep(last.after(&step), scan);
        Some(in_space(&step, voxel, &covariance, OUT_OF_PLANE_DRIVEN))
    }

    fn keep(&mut self, pose: Se2, scan: Vec<Vector2<f64>>) {
        self.recent.push_back((pose, scan));
        if self.recent.len() > SCANS {
            self.recent.pop_front();
        }
    }

    /// The walls of recent scans in the body frame of the last.
    fn walls(&self, last: &Se2) -> Walls {
        let (mut points, mut from) = (Vec::new(), Vec::new());
        for (pose, scan) in &self.recent {
            let t_last_then = last.inverse().after(pose);
            points.extend(scan.iter().map(|p| t_last_then.apply(p)));
            from.resize(points.len(), t_last_then.at);
        }
        let lines = lines(&points, |k| from[k]);
        let clear = points.into_iter().zip(lines).filter(|(_, line)| line.roughness.is_some());
        let (points, normals) = clear.map(|(p, line)| (p, line.normal)).unzip();
        Walls { points, normals }
    }

    fn fitted(
        &self,
        last: &Se2,
        odometry: &Se2,
        prior: &Matrix3<f64>,
        scan: &[Vector2<f64>],
    ) -> Option<(Se2, Matrix3<f64>)> {
        let near = self.walls(last).near();
        // A single scan's far points lie too sparse for lines of their own: all that is known is that they face the
        // sensor.
        let normals = scan.iter().map(|p| (-p).try_normalize(1e-9).unwrap_or_else(Vector2::x)).collect();
        let walls = Walls { points: scan.to_vec(), normals };
        let information = prior.try_inverse()?;
        let mut pose = *odometry;
        for iteration in 0..ITERATIONS_MAX {
            let settled = iteration + 1 >= RADII.len();
            let system = system(&walls, &near, &pose, RADII[iteration.min(RADII.len() - 1)], FACING);
            if system.pairs < PAIRS_MIN {
                return None;
            }
            let weight = (INDEPENDENT_MAX / system.pairs as f64).min(1.0) / (system.sigma * system.sigma);
            let off = odometry.local(&pose);
            let total = system.h * weight + information;
            let step = -total.cholesky()?.solve(&(system.g * weight + information * off));
            pose = pose.retract(&step);
            if settled && step.xy().norm() + 30.0 * step.z.abs() < STEP {
                break;
            }
        }
        let off = odometry.local(&pose);
        if off.dot(&(information * off)) > CHI2_MAX {
            return None;
        }
        let system = system(&walls, &near, &pose, RADII[RADII.len() - 1], FACING);
        let weight = (INDEPENDENT_MAX / system.pairs.max(1) as f64).min(1.0) / (system.sigma * system.sigma);
        let mut covariance = (system.h * weight + information).try_inverse()?;
        for (k, floor) in [FLOOR, FLOOR, FLOOR_RAD].into_iter().enumerate() {
            covariance[(k, k)] += floor * floor;
        }
        Some((pose, covariance))
    }
}

/// In the plane and in voxels.
fn thinned(points: &[[f32; 3]], voxel: f64) -> Vec<Vector2<f64>> {
    let stride = points.len().div_ceil(POINTS_MAX).max(1);
    let flat = |p: &[f32; 3]| Vector2::new(f64::from(p[0]), f64::from(p[1])) / voxel;
    points.iter().step_by(stride).map(flat).collect()
}

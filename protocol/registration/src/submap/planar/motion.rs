//! Wheels slip and skid; the laser sees by how much. Each keyframe's scan is fitted to the walls of the keyframes
//! before it, with the odometry as a prior: the maximum a posteriori of both. Along a bare corridor the odometry stays
//! as it is, and the covariance says so. Wheels may also be wrong by far more than they say (`elsewhere`): where a scan
//! fits so much better at another place that this is the likelier, the motion is that to there.

use super::super::near::Near;
use super::OUT_OF_PLANE_DRIVEN;
use super::elsewhere::{self, Evidence, Odometry};
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
pub(super) const FACING: f64 = 0.1;
/// Pairs without which the odometry stays as it is.
const PAIRS_MIN: usize = 20;
/// Independent measurements that the pairs of one scan amount to: they lie on a few walls, and the walls were
/// themselves drawn from scans.
const INDEPENDENT_MAX: f64 = 20.0;
/// Least standard deviation of a sharpened motion: voxels...
const FLOOR: f64 = 0.1;
/// ...and rad.
const FLOOR_RAD: f64 = 0.003;
/// A fit that contradicts the odometry by more (χ²₃, 1e-5) is weighed against the odometry itself.
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
        let before = self.recent.back().map_or(&[][..], |(_, scan)| scan);
        let walls = self.walls(last);
        let near = walls.near();
        // A single scan's far points lie too sparse for lines of their own: all that is known is that they face the
        // sensor.
        let normals = scan.iter().map(|p| (-p).try_normalize(1e-9).unwrap_or_else(Vector2::x)).collect();
        let seen = Walls { points: scan.to_vec(), normals };
        let told = Odometry { motion: *odometry, information: prior.try_inverse()? };
        let settled = settled(&seen, &near, &told)?;
        let mut poses = vec![settled];
        poses.extend(elsewhere::candidates(&seen, &walls, &near, &told, &settled));
        if told.distance_squared(&settled) > CHI2_MAX {
            poses.push(*odometry);
        }
        let (pose, doubt) = weighed(&poses, || Evidence::new(scan, before, &near), &told);
        let system = system(&seen, &near, &pose, RADII[RADII.len() - 1], FACING);
        let weight = (INDEPENDENT_MAX / system.pairs.max(1) as f64).min(1.0) / (system.sigma * system.sigma);
        let information = if told.is_slip(&pose) { told.reach() } else { told.information };
        let mut covariance = (system.h * weight + information).try_inverse()? + doubt;
        for (k, floor) in [FLOOR, FLOOR, FLOOR_RAD].into_iter().enumerate() {
            covariance[(k, k)] += floor * floor;
        }
        Some((pose, covariance))
    }
}

/// The maximum a posteriori of a scan's fit to the walls and the odometry, from where the odometry has it.
fn settled(scan: &Walls, near: &Near, told: &Odometry) -> Option<Se2> {
    let mut pose = told.motion;
    for iteration in 0..ITERATIONS_MAX {
        let is_last_radius = iteration + 1 >= RADII.len();
        let system = system(scan, near, &pose, RADII[iteration.min(RADII.len() - 1)], FACING);
        if system.pairs < PAIRS_MIN {
            return None;
        }
        let weight = (INDEPENDENT_MAX / system.pairs as f64).min(1.0) / (system.sigma * system.sigma);
        let off = told.motion.local(&pose);
        let total = system.h * weight + told.information;
        let step = -total.cholesky()?.solve(&(system.g * weight + told.information * off));
        pose = pose.retract(&step);
        if is_last_radius && step.xy().norm() + 30.0 * step.z.abs() < STEP {
            break;
        }
    }
    Some(pose)
}

/// The most likely of several motions, by the scan and the odometry, and what the covariance grows by where others are
/// about as likely. Only the first is taken if there is no other.
fn weighed<'a>(poses: &[Se2], evidence: impl Fn() -> Evidence<'a>, told: &Odometry) -> (Se2, Matrix3<f64>) {
    if let [only] = poses {
        return (*only, Matrix3::zeros());
    }
    let evidence = evidence();
    let of = |pose: &Se2| INDEPENDENT_MAX * evidence.log_likelihood(pose) + told.log_likelihood(pose);
    let scores: Vec<f64> = poses.iter().map(of).collect();
    // The first of equals.
    let best = (0..poses.len()).fold(0, |best, k| if scores[k] > scores[best] { k } else { best });
    let others = (0..poses.len()).filter(|k| elsewhere::differ(&poses[*k], &poses[best]));
    let (mut spread, mut sum) = (Matrix3::zeros(), 1.0);
    for k in others {
        let share = libm::exp(scores[k] - scores[best]);
        let off = poses[best].local(&poses[k]);
        spread += off * off.transpose() * share;
        sum += share;
    }
    (poses[best], spread / sum)
}

/// In the plane and in voxels.
fn thinned(points: &[[f32; 3]], voxel: f64) -> Vec<Vector2<f64>> {
    let stride = points.len().div_ceil(POINTS_MAX).max(1);
    let flat = |p: &[f32; 3]| Vector2::new(f64::from(p[0]), f64::from(p[1])) / voxel;
    points.iter().step_by(stride).map(flat).collect()
}

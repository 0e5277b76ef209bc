//! One frame's submap anchors along its odometry: poses, covariances, and how their errors correlate. Odometry errors
//! are independent from step to step, so an anchor's error is carried, unchanged but for Ad, into every later anchor;
//! what two alignments between the same two frames share follows from that (MATH §3).

use crate::geometry::{Covariance, PoseWithCovariance, Se3};
use nalgebra::{Matrix6, Vector3};

/// Anchors 0, 1, … of one frame. Grows only at its end.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Trajectory {
    steps: Vec<PoseWithCovariance>,
    anchors: Vec<PoseWithCovariance>,
}

impl Trajectory {
    /// From odometry steps: `steps[0]` is `t_frame_anchor0`, `steps[k]` is `t_anchor(k-1)_anchor(k)`; errors
    /// independent.
    pub fn new(steps: impl IntoIterator<Item = PoseWithCovariance>) -> Self {
        let mut trajectory = Self::default();
        steps.into_iter().for_each(|step| trajectory.push(step));
        trajectory
    }

    /// Appends an anchor.
    pub fn push(&mut self, step: PoseWithCovariance) {
        let anchor = self.anchors.last().map_or(step, |last| last.compose(&step));
        self.steps.push(step);
        self.anchors.push(anchor);
    }

    /// Number of anchors.
    pub fn len(&self) -> usize {
        self.anchors.len()
    }

    /// Whether there is no anchor.
    pub fn is_empty(&self) -> bool {
        self.anchors.is_empty()
    }

    /// `t_frame_anchor(i)`, or `None` past the end.
    pub fn pose(&self, i: usize) -> Option<Se3> {
        self.anchors.get(i).map(|a| a.pose)
    }

    /// Covariance of anchor `i` in the frame, or `None` past the end.
    pub fn covariance(&self, i: usize) -> Option<Covariance<6>> {
        self.anchors.get(i).map(|a| a.covariance)
    }

    /// `t_frame_anchor(i)` with its covariance, or `None` past the end.
    pub fn anchor(&self, i: usize) -> Option<&PoseWithCovariance> {
        self.anchors.get(i)
    }

    /// `t_anchor(i)_anchor(k)` with the covariance of the odometry between them alone, or `None` past the end. An
    /// anchor relative to itself is the identity with the smallest covariance there is.
    pub fn relative(&self, i: usize, k: usize) -> Option<PoseWithCovariance> {
        let (pose, sigma) = self.relative_exact(i, k)?;
        Some(PoseWithCovariance { pose, covariance: Covariance::new_or_wider(sigma) })
    }

    /// As [`Self::relative`] with the plain matrix, zero for `i = k`. Walks the odometry: no difference of large
    /// absolute covariances is ever taken.
    pub(super) fn relative_exact(&self, i: usize, k: usize) -> Option<(Se3, Matrix6<f64>)> {
        let forward = |from: usize, to: usize| {
            let steps = self.steps.get(from + 1..=to)?;
            Some(steps.iter().fold((Se3::identity(), Matrix6::zeros()), |(pose, sigma), step| {
                let a = step.pose.inverse().adjoint();
                (pose * step.pose, a * sigma * a.transpose() + step.covariance.matrix())
            }))
        };
        if i <= k {
            return forward(i, k);
        }
        let (pose, sigma) = forward(k, i)?;
        let a = pose.adjoint();
        Some((pose.inverse(), a * sigma * a.transpose()))
    }

    /// Cross covariance E[δ_i δ_kᵀ] of two anchors' local perturbations, `Σ_i Ad(T_ik⁻¹)ᵀ` for i ≤ k, or `None` past
    /// the end.
    pub fn cross_covariance(&self, i: usize, k: usize) -> Option<Matrix6<f64>> {
        if i > k {
            return self.cross_covariance(k, i).map(|m| m.transpose());
        }
        let (a, b) = (self.anchor(i)?, self.anchor(k)?);
        Some(a.covariance.matrix() * (b.pose.inverse() * a.pose).adjoint().transpose())
    }

    /// Edges of the box around all anchors, along the frame's axes.
    pub fn extent(&self) -> Vector3<f64> {
        let mut positions = self.anchors.iter().map(|a| a.pose.translation);
        let Some(first) = positions.next() else { return Vector3::zeros() };
        let (low, high) = positions.fold((first, first), |(low, high), p| (low.inf(&p), high.sup(&p)));
        high - low
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::sampling::{covariance, pose, rng};

    fn trajectory(n: usize) -> Trajectory {
        let mut rng = rng(41);
        Trajectory::new(
            (0..n).map(|_| PoseWithCovariance {
                pose: pose(&mut rng),
                covariance: covariance::<6>(&mut rng).scaled(1e-2),
            }),
        )
    }

    fn assert_near(a: &Matrix6<f64>, b: &Matrix6<f64>) {
        assert!((a - b).amax() < 1e-12 * (1.0 + b.amax()), "{a} {b}");
    }

    #[test]
    fn relatives_follow_from_the_joint_covariance() {
        let t = trajectory(8);
        for (i, k) in [(0, 7), (7, 0), (2, 5), (5, 2), (3, 4), (6, 6)] {
            let (a, b) = (t.anchor(i).unwrap(), t.anchor(k).unwrap());
            let cross = t.cross_covariance(i, k).unwrap();
            let (pose, sigma) = t.relative_exact(i, k).unwrap();
            assert!((a.pose.inverse() * b.pose).local(&pose).norm() < 1e-12);
            let m = pose.inverse().adjoint();
            let mixed = m * cross;
            let joint = m * a.covariance.matrix() * m.transpose() + b.covariance.matrix() - mixed - mixed.transpose();
            assert_near(&sigma, &joint);
            assert_eq!(t.relative(i, k).unwrap().pose, pose);
        }
    }

    #[test]
    fn cross_covariances_are_transposes_and_contain_the_marginals() {
        let t = trajectory(6);
        for i in 0..6 {
            assert_near(&t.cross_covariance(i, i).unwrap(), t.covariance(i).unwrap().matrix());
            for k in 0..6 {
                assert_near(&t.cross_covariance(i, k).unwrap(), &t.cross_covariance(k, i).unwrap().transpose());
            }
        }
    }

    #[test]
    fn anchors_past_the_end_are_none() {
        let t = trajectory(3);
        assert_eq!(t.len(), 3);
        assert!(t.pose(2).is_some() && t.pose(3).is_none() && t.covariance(3).is_none());
        assert!(t.relative(0, 3).is_none() && t.relative(3, 0).is_none() && t.relative(3, 3).is_none());
        assert!(t.cross_covariance(3, 1).is_none() && t.cross_covariance(1, 3).is_none());
        assert!(Trajectory::default().is_empty());
        assert_eq!(Trajectory::default().extent(), Vector3::zeros());
    }
}

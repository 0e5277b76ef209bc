//! The odometry between the anchors that measurements stand on, each stretch of it walked once: what would cost the
//! trajectory's length for every pair of measurements costs it for all of them together.

use super::trajectory::Trajectory;
use crate::geometry::Se3;
use nalgebra::Matrix6;

/// A pose and the covariance of the odometry that leads there; zero where none does.
pub(super) type OdometryStep = (Se3, Matrix6<f64>);

/// RelativeOdometry between distinct anchors of one trajectory.
pub(super) struct RelativeOdometry {
    /// The distinct anchors, ascending.
    distinct: Vec<usize>,
    /// From each distinct anchor to the next.
    steps: Vec<OdometryStep>,
}

impl RelativeOdometry {
    /// Between those of these anchors that the trajectory has.
    pub(super) fn new(trajectory: &Trajectory, anchors: impl Iterator<Item = usize>) -> Self {
        let mut distinct: Vec<usize> = anchors.filter(|&anchor| anchor < trajectory.len()).collect();
        distinct.sort_unstable();
        distinct.dedup();
        let steps = distinct.windows(2).filter_map(|w| trajectory.relative_exact(w[0], w[1])).collect();
        Self { distinct, steps }
    }

    /// Position of an anchor among the distinct ones.
    pub(super) fn slot(&self, anchor: usize) -> usize {
        self.distinct.partition_point(|&distinct| distinct < anchor)
    }

    /// Every distinct anchor relative to the one at position `own`; none if there is no such anchor.
    pub(super) fn from(&self, own: usize) -> Vec<OdometryStep> {
        if own >= self.distinct.len() {
            return Vec::new();
        }
        let mut ways = vec![(Se3::identity(), Matrix6::zeros()); self.distinct.len()];
        for k in own..self.steps.len() {
            ways[k + 1] = compose(&ways[k], &self.steps[k]);
        }
        for k in (0..own).rev() {
            ways[k] = compose(&ways[k + 1], &inverse(&self.steps[k]));
        }
        ways
    }
}

/// One way, and then another.
pub(super) fn compose((a, sigma_a): &OdometryStep, (b, sigma_b): &OdometryStep) -> OdometryStep {
    let m = b.inverse().adjoint();
    (*a * *b, m * sigma_a * m.transpose() + sigma_b)
}

/// The way back.
pub(super) fn inverse((a, sigma): &OdometryStep) -> OdometryStep {
    let m = a.adjoint();
    (a.inverse(), m * sigma * m.transpose())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::PoseWithCovariance;
    use crate::geometry::sampling::{covariance, pose, rng};

    #[test]
    fn ways_are_what_the_trajectory_has_between_its_anchors() {
        let mut rng = rng(43);
        let step = |_| PoseWithCovariance { pose: pose(&mut rng), covariance: covariance::<6>(&mut rng).scaled(1e-2) };
        let trajectory = Trajectory::new((0..9).map(step).collect::<Vec<_>>());
        let anchors = [7, 2, 2, 0, 5, 7, 12];
        let ways = RelativeOdometry::new(&trajectory, anchors.into_iter());
        for from in [0, 2, 5, 7] {
            let all = ways.from(ways.slot(from));
            assert_eq!(all.len(), 4);
            for to in [0, 2, 5, 7] {
                let (t, sigma) = &all[ways.slot(to)];
                let (expected, of_it) = trajectory.relative_exact(from, to).unwrap();
                assert!(t.local(&expected).norm() < 1e-12 && (sigma - of_it).amax() < 1e-12 * (1.0 + of_it.amax()));
                let (back, sigma) = inverse(&(*t, *sigma));
                let (expected, of_it) = trajectory.relative_exact(to, from).unwrap();
                assert!(back.local(&expected).norm() < 1e-12 && (sigma - of_it).amax() < 1e-12 * (1.0 + of_it.amax()));
            }
        }
        assert!(
            ways.from(ways.slot(12)).is_empty()
                && RelativeOdometry::new(&trajectory, [].into_iter()).from(0).is_empty()
        );
    }
}

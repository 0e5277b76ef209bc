//! The two-sided rule (DESIGN §3): what two measured counts, if they agree. Each looks from its own dense cloud at the
//! other's keypoints. Of two submaps of one robot, which no other robot looks at, the robot itself looks both ways: a
//! place that is taken for another from one side seldom is from the other.

use crate::geometry::{Covariance, PoseWithCovariance, Relative, SimWithCovariance, chi2};

/// Whether two independent measurements of one relative pose agree: d² of their difference under the sum of their
/// covariances, χ² at 99.9 %.
pub fn agree(a: &Relative, b: &Relative) -> bool {
    match (a, b) {
        (Relative::Metric(a), Relative::Metric(b)) => {
            let sum = a.covariance.plus(&b.covariance);
            sum.mahalanobis_squared(&a.pose.local(&b.pose)) <= chi2::P999[5]
        }
        (Relative::Similarity(a), Relative::Similarity(b)) => {
            let sum = a.covariance.plus(&b.covariance);
            sum.mahalanobis_squared(&a.sim.local(&b.sim)) <= chi2::P999[6]
        }
        _ => false,
    }
}

/// What two measurements that agree amount to: the pose midway, with the larger (by determinant) of the covariances.
/// Their sampling errors differ and partly cancel; what they share stays in the covariance, and neither can overstate
/// its certainty. `None` if one knows the scale and the other does not.
pub fn midway(a: &Relative, b: &Relative) -> Option<Relative> {
    match (a, b) {
        (Relative::Metric(a), Relative::Metric(b)) => Some(Relative::Metric(PoseWithCovariance {
            pose: a.pose.interpolate(&b.pose, 0.5),
            covariance: larger(a.covariance, b.covariance),
        })),
        (Relative::Similarity(a), Relative::Similarity(b)) => Some(Relative::Similarity(SimWithCovariance {
            sim: a.sim.interpolate(&b.sim, 0.5),
            covariance: larger(a.covariance, b.covariance),
        })),
        _ => None,
    }
}

fn larger<const N: usize>(a: Covariance<N>, b: Covariance<N>) -> Covariance<N> {
    let volume = |c: &Covariance<N>| -> f64 {
        c.matrix().cholesky().map_or(f64::INFINITY, |l| l.l().diagonal().iter().map(|&x| libm::log(x)).sum())
    };
    if volume(&b) > volume(&a) { b } else { a }
}

//! The two-sided rule (DESIGN §3): what two measured counts, if they agree. Each looks from its own dense cloud at the
//! other's keypoints. Of two submaps of one robot, which no other robot looks at, the robot itself looks both ways: a
//! place that is taken for another from one side seldom is from the other.

use crate::geometry::{Covariance, PoseWithCovariance, Relative, SimWithCovariance};

/// χ² 99.9 % quantiles for 6 and 7 degrees of freedom: two independent alignments of one pair agree below these.
const CHI2_6_999: f64 = 22.457_744_484_825_32;
const CHI2_7_999: f64 = 24.321_886_347_856_85;

/// Whether two independent measurements of one relative pose agree: d² of their difference under the sum of their
/// covariances, χ² at 99.9 %.
pub fn agree(a: &Relative, b: &Relative) -> bool {
    match (a, b) {
        (Relative::Metric(a), Relative::Metric(b)) => {
            let sum = a.covariance.plus(&b.covariance);
            sum.mahalanobis_squared(&a.pose.local(&b.pose)) <= CHI2_6_999
        }
        (Relative::Similarity(a), Relative::Similarity(b)) => {
            let sum = a.covariance.plus(&b.covariance);
            sum.mahalanobis_squared(&a.sim.local(&b.sim)) <= CHI2_7_999
        }
        _ => false,
    }
}

/// What two measurements that agree amount to: the pose midway, with the smallest covariance that neither's exceeds.
/// Their sampling errors differ and partly cancel; what they share stays in the covariance, and neither can overstate its
/// certainty in any direction. `None` if one knows the scale and the other does not.
pub fn midway(a: &Relative, b: &Relative) -> Option<Relative> {
    match (a, b) {
        (Relative::Metric(a), Relative::Metric(b)) => Some(Relative::Metric(PoseWithCovariance {
            pose: a.pose.interpolate(&b.pose, 0.5),
            covariance: join(&a.covariance, &b.covariance),
        })),
        (Relative::Similarity(a), Relative::Similarity(b)) => Some(Relative::Similarity(SimWithCovariance {
            sim: a.sim.interpolate(&b.sim, 0.5),
            covariance: join(&a.covariance, &b.covariance),
        })),
        _ => None,
    }
}

fn join<const N: usize>(a: &Covariance<N>, b: &Covariance<N>) -> Covariance<N> {
    a.join(b).and_then(|joined| Covariance::new(joined).ok()).unwrap_or_else(|| a.plus(b))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Se3;
    use nalgebra::{Matrix6, Vector6};

    /// Whatever the errors of two measurements have in common, that of the pose midway is no larger than stated.
    #[test]
    fn midway_never_claims_more_than_any_way_of_erring_allows() {
        let pose = Se3::exp(&Vector6::from([1.0, 5.0, -2.0, 0.4, 0.1, 2.0]));
        let here = Covariance::from_sigmas([0.02, 0.02, 0.02, 0.005, 0.005, 0.005]).unwrap();
        let there = here.transported(&pose.adjoint()).unwrap();
        let of = |covariance| Relative::Metric(PoseWithCovariance { pose, covariance });
        let stated = *midway(&of(here), &of(there)).unwrap().metric().unwrap().covariance.matrix();
        let [a, b] = [here, there].map(|one| one.matrix().cholesky().unwrap().l());
        for cross in [Matrix6::identity(), Matrix6::zeros(), -Matrix6::identity()] {
            // Errors a x and b y of which x and y correlate by `cross`.
            let cross = a * cross * b.transpose();
            let true_one = (here.matrix() + there.matrix() + cross + cross.transpose()) * 0.25;
            let least = (stated - true_one).symmetric_eigenvalues().min();
            assert!(least > -1e-12, "{least}");
        }
        // Neither covariance alone would do, though their volumes are the same.
        let uncorrelated = (here.matrix() + there.matrix()) * 0.25;
        assert!((here.matrix() - uncorrelated).symmetric_eigenvalues().min() < 0.0);
        let same = midway(&of(here), &of(here)).unwrap();
        assert!((same.metric().unwrap().covariance.matrix() - here.matrix()).amax() < 1e-12);
        for one in [here, there] {
            let more = stated - one.matrix();
            assert!(more.symmetric_eigenvalues().min() > -1e-12, "neither may overstate its certainty");
        }
    }
}

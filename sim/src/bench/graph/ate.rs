//! How far estimated poses are from others, and whether their covariances say so.

use crate::bench::fit::rms_after_fit;
use merganser_protocol::geometry::{PoseWithCovariance, Se3};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// RMS distance of positions after the best rigid alignment.
pub(super) fn ate(reference: &BTreeMap<u64, Se3>, found: &BTreeMap<u64, Se3>) -> f64 {
    let pairs: Vec<(Vector3<f64>, Vector3<f64>)> =
        found.iter().filter_map(|(id, t)| Some((reference.get(id)?.translation, t.translation))).collect();
    rms_after_fit(&pairs)
}

/// Mean normalised squared error of poses relative to the smallest one, by the degrees of freedom: 1 for honest
/// covariances. Where the truth is planar, of the three directions in the plane.
pub(super) fn anees(truth: &BTreeMap<u64, Se3>, found: &BTreeMap<u64, PoseWithCovariance>) -> Option<f64> {
    let (first, _) = found.first_key_value()?;
    let origin = truth.get(first)?.inverse();
    let planar = truth.values().all(|t| t.translation.z.abs() < 1e-6);
    let kept: &[usize] = if planar { &[0, 1, 5] } else { &[0, 1, 2, 3, 4, 5] };
    let nees = |(id, t): (&u64, &PoseWithCovariance)| {
        let off = t.pose.local(&(origin * *truth.get(id)?));
        let off = off.select_rows(kept);
        let sigma = t.covariance.matrix().select_rows(kept).select_columns(kept);
        Some(sigma.cholesky()?.solve(&off).dot(&off) / kept.len() as f64)
    };
    let all: Vec<f64> = found.iter().filter(|(id, _)| *id != first).filter_map(nees).collect();
    (!all.is_empty()).then(|| all.iter().sum::<f64>() / all.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::geometry::Covariance;
    use nalgebra::Vector6;

    #[test]
    fn poses_that_are_off_by_their_sigmas_have_an_anees_of_one() {
        let at = |x: f64| Se3::exp(&Vector6::new(x, 0.5 * x, 0.0, 0.0, 0.0, 0.1 * x));
        let truth: BTreeMap<u64, Se3> = (0..9).map(|k| (k, at(k as f64))).collect();
        let covariance = Covariance::from_sigmas([0.1, 0.2, 0.3, 0.01, 0.01, 0.02]).unwrap();
        let found = |sigmas: f64| -> BTreeMap<u64, PoseWithCovariance> {
            let off = Vector6::new(0.1, 0.2, 0.0, 0.0, 0.0, 0.02) * sigmas;
            let of = |(&k, t): (&u64, &Se3)| {
                let t = truth[&0].inverse() * *t;
                (k, PoseWithCovariance { pose: if k == 0 { t } else { t.retract(&off) }, covariance })
            };
            truth.iter().map(of).collect()
        };
        assert!((anees(&truth, &found(1.0)).unwrap() - 1.0).abs() < 1e-9);
        assert!((anees(&truth, &found(2.0)).unwrap() - 4.0).abs() < 1e-9);
        assert!(ate(&truth, &truth) < 1e-9);
    }
}

//! The rigid motion that fits points best (Umeyama 1991, without scale).

use nalgebra::{Matrix3, Vector3};

/// Root mean square distance of paired points after the best rigid alignment; NaN for none.
pub(super) fn rms_after_fit(pairs: &[(Vector3<f64>, Vector3<f64>)]) -> f64 {
    let n = pairs.len() as f64;
    let (a, b) =
        (pairs.iter().map(|p| p.0).sum::<Vector3<f64>>() / n, pairs.iter().map(|p| p.1).sum::<Vector3<f64>>() / n);
    let cross: Matrix3<f64> = pairs.iter().map(|(x, y)| (x - a) * (y - b).transpose()).sum();
    let svd = cross.svd(true, true);
    let (Some(u), Some(v_t)) = (svd.u, svd.v_t) else { return f64::NAN };
    let flip = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * v_t).determinant().signum()));
    let rotation = u * flip * v_t;
    (pairs.iter().map(|(x, y)| (x - a - rotation * (y - b)).norm_squared()).sum::<f64>() / n).sqrt()
}

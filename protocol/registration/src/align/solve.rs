//! Closed-form motions from matched points: three points (a triangle onto a triangle) and weighted least squares by
//! Horn's quaternion method with Umeyama's scale. Only + − × ÷ √ are used, so results are the same to the bit on every
//! machine.

use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

/// A similarity in search coordinates: `q = scale · rotation · p + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Motion {
    pub scale: f64,
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
}

impl Motion {
    /// `q` for `p`.
    pub fn apply(&self, p: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * p * self.scale + self.translation
    }

    /// Divisor of residuals: min(s, 1), so that shrinking never wins.
    pub fn residual_unit(&self) -> f64 {
        self.scale.min(1.0)
    }
}

/// The least-squares motion of a triangle onto a triangle, vertices in order; `None` where either is collinear.
///
/// The optimum maps plane onto plane, so it is a change of basis and a planar Procrustes rotation, without an
/// eigenproblem.
pub(super) fn triangle(p: [&Vector3<f64>; 3], q: [&Vector3<f64>; 3], with_scale: bool) -> Option<Motion> {
    let (cp, cq) = ((p[0] + p[1] + p[2]) / 3.0, (q[0] + q[1] + q[2]) / 3.0);
    let (bp, bq) = (basis(p)?, basis(q)?);
    let (mut dot, mut cross, mut spread) = (0.0, 0.0, 0.0);
    for k in 0..3 {
        let (a, b) = (p[k] - cp, q[k] - cq);
        let (ax, ay) = (bp.column(0).dot(&a), bp.column(1).dot(&a));
        let (bx, by) = (bq.column(0).dot(&b), bq.column(1).dot(&b));
        dot += ax * bx + ay * by;
        cross += ax * by - ay * bx;
        spread += ax * ax + ay * ay;
    }
    let norm = (dot * dot + cross * cross).sqrt();
    if !(norm > 0.0 && norm.is_finite()) {
        return None;
    }
    let (c, s) = (dot / norm, cross / norm);
    let turn = Matrix3::new(c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0);
    let rotation = bq * turn * bp.transpose();
    let scale = if with_scale { norm / spread } else { 1.0 };
    Some(Motion { scale, rotation, translation: cq - rotation * cp * scale })
}

/// Orthonormal columns: along the first edge, in the plane, normal.
fn basis(p: [&Vector3<f64>; 3]) -> Option<Matrix3<f64>> {
    let u = p[1] - p[0];
    let n = u.cross(&(p[2] - p[0]));
    let (un, nn) = (u.norm(), n.norm());
    if !(un > 0.0 && nn > 1e-9 * un * un && nn.is_finite()) {
        return None;
    }
    let (u, n) = (u / un, n / nn);
    Some(Matrix3::from_columns(&[u, n.cross(&u), n]))
}

/// The motion that minimises `Σ w |q − (s R p + t)|²` over matches of positive weight; `None` if the weights sum to
/// nothing or the scale has no solution.
pub(super) fn weighted(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    weights: &[f64],
    with_scale: bool,
) -> Option<Motion> {
    let (mut total, mut cp, mut cq) = (0.0, Vector3::zeros(), Vector3::zeros());
    for ((p, q), &w) in source.iter().zip(target).zip(weights).filter(|(_, w)| **w > 0.0) {
        total += w;
        cp += p * w;
        cq += q * w;
    }
    if !(total > 0.0 && total.is_finite()) {
        return None;
    }
    cp /= total;
    cq /= total;
    let (mut h, mut spread) = (Matrix3::zeros(), 0.0);
    for ((p, q), &w) in source.iter().zip(target).zip(weights).filter(|(_, w)| **w > 0.0) {
        let (a, b) = (p - cp, (q - cq) * w);
        spread += w * a.norm_squared();
        h += a * b.transpose();
    }
    let rotation = rotation_of_cross_covariance(&h);
    let scale = if with_scale { (rotation * h).trace() / spread } else { 1.0 };
    (scale > 0.0 && scale.is_finite()).then(|| Motion { scale, rotation, translation: cq - rotation * cp * scale })
}

/// The rotation that maximises tr(R H), H = Σ w p qᵀ: the top eigenvector of Horn's 4×4 matrix.
fn rotation_of_cross_covariance(h: &Matrix3<f64>) -> Matrix3<f64> {
    let (xx, xy, xz) = (h[(0, 0)], h[(0, 1)], h[(0, 2)]);
    let (yx, yy, yz) = (h[(1, 0)], h[(1, 1)], h[(1, 2)]);
    let (zx, zy, zz) = (h[(2, 0)], h[(2, 1)], h[(2, 2)]);
    #[rustfmt::skip]
    let n = Matrix4::new(
        xx + yy + zz, yz - zy,      zx - xz,       xy - yx,
        yz - zy,      xx - yy - zz, xy + yx,       zx + xz,
        zx - xz,      xy + yx,      -xx + yy - zz, yz + zy,
        xy - yx,      zx + xz,      yz + zy,       -xx - yy + zz,
    );
    let v = top_eigenvector(n);
    let (w, x, y, z) = (v[0], v[1], v[2], v[3]);
    #[rustfmt::skip]
    let r = Matrix3::new(
        w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z,
    );
    r / v.norm_squared()
}

/// The eigenvector of the largest eigenvalue of a symmetric matrix, by cyclic Jacobi rotations.
fn top_eigenvector(mut a: Matrix4<f64>) -> Vector4<f64> {
    const SWEEPS_MAX: usize = 24;
    let mut v = Matrix4::identity();
    let scale = a.amax();
    for _ in 0..SWEEPS_MAX {
        let off = (0..4).flat_map(|r| (0..r).map(move |c| (r, c))).fold(0.0_f64, |m, rc| m.max(a[rc].abs()));
        if off <= 1e-15 * scale || !off.is_finite() {
            break;
        }
        for p in 0..3 {
            for q in p + 1..4 {
                jacobi_rotate(&mut a, &mut v, p, q);
            }
        }
    }
    let best = (1..4).fold(0, |b, k| if a[(k, k)] > a[(b, b)] { k } else { b });
    v.column(best).into_owned()
}

/// Zeroes `a[(p, q)]` by a plane rotation, accumulated in `v`.
fn jacobi_rotate(a: &mut Matrix4<f64>, v: &mut Matrix4<f64>, p: usize, q: usize) {
    let apq = a[(p, q)];
    if apq == 0.0 {
        return;
    }
    let theta = (a[(q, q)] - a[(p, p)]) / (2.0 * apq);
    let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
    let c = 1.0 / (t * t + 1.0).sqrt();
    let s = t * c;
    for k in 0..4 {
        let (x, y) = (a[(k, p)], a[(k, q)]);
        a[(k, p)] = c * x - s * y;
        a[(k, q)] = s * x + c * y;
    }
    for k in 0..4 {
        let (x, y) = (a[(p, k)], a[(q, k)]);
        a[(p, k)] = c * x - s * y;
        a[(q, k)] = s * x + c * y;
        let (x, y) = (v[(k, p)], v[(k, q)]);
        v[(k, p)] = c * x - s * y;
        v[(k, q)] = s * x + c * y;
    }
}

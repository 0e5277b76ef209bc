//! Normals of a thinned cloud by principal components of the neighbourhood, turned towards the viewpoint. Lengths are
//! in voxels.

use super::grid::{Grid, LANES, Lanes, bounds};
use crate::simd::wide;
use core::f64::consts::TAU;
use libm::{acos, cos};
use nalgebra::Vector3;
use pulp::Arch;

/// Radius of the neighbourhood that a normal is fitted to.
pub const NORMAL_RADIUS: f32 = 3.0;
/// Edge of the search cells: small cells waste few distances.
const CELL: f32 = 3.0;
/// Points (itself included) a normal needs at least.
const NEIGHBOURS_MIN: f32 = 5.0;
/// A surface is at least this wide for its length (ratio of standard deviations), else it is a line...
const WIDTH_MIN: f64 = 0.2;
/// ...and at most this thick for its width, else it is a blob.
const THICKNESS_MAX: f64 = 0.8;

/// A point's normal and how well a plane fits around it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Normal {
    /// Unit normal, towards the viewpoint.
    pub direction: Vector3<f64>,
    /// Standard deviation of the neighbourhood about its plane; `None` where there is no plane to speak of (too few
    /// neighbours, a line, a blob).
    pub roughness: Option<f64>,
    /// Points within [`NORMAL_RADIUS`], the point itself included.
    pub neighbours: u32,
}

/// The normals of all points, each seen from `viewpoint(k)`.
pub fn normals(points: &[[f32; 3]], viewpoint: impl Fn(usize) -> Vector3<f64>) -> Vec<Normal> {
    let grid = Grid::new(points, CELL);
    let arch = Arch::new();
    let nothing = Normal { direction: Vector3::z(), roughness: None, neighbours: 0 };
    let mut normals = vec![nothing; points.len()];
    let (mut near, mut lanes) = (Vec::new(), Lanes::new());
    for cell in grid.cells() {
        let (low, high) = bounds(cell.iter().map(|&k| &points[k as usize]));
        grid.around(&low, &high, NORMAL_RADIUS, &mut near);
        lanes.fill(points, &near);
        for &k in cell {
            let k = k as usize;
            let moments = wide(arch, || moments(&lanes, &points[k]));
            let towards = viewpoint(k) - Vector3::from(points[k].map(f64::from));
            normals[k] = normal(&moments, &towards);
        }
    }
    normals
}

/// Number, sum and (upper triangle of) products of the offsets of the points within [`NORMAL_RADIUS`].
#[inline(always)]
fn moments(lanes: &Lanes<3>, at: &[f32; 3]) -> [f32; 10] {
    let mut sums = [[0.0; LANES]; 10];
    for [xs, ys, zs] in &lanes.groups {
        let (mut x, mut y, mut z, mut d) = ([0.0; LANES], [0.0; LANES], [0.0; LANES], [0.0; LANES]);
        let mut least = f32::MAX;
        for l in 0..LANES {
            (x[l], y[l], z[l]) = (xs[l] - at[0], ys[l] - at[1], zs[l] - at[2]);
            d[l] = x[l] * x[l] + y[l] * y[l] + z[l] * z[l];
        }
        for squared in d {
            least = if squared < least { squared } else { least };
        }
        if least > NORMAL_RADIUS * NORMAL_RADIUS {
            continue;
        }
        for l in 0..LANES {
            let w = if d[l] <= NORMAL_RADIUS * NORMAL_RADIUS { 1.0 } else { 0.0 };
            let (wx, wy, wz) = (w * x[l], w * y[l], w * z[l]);
            let terms = [w, wx, wy, wz, wx * x[l], wx * y[l], wx * z[l], wy * y[l], wy * z[l], wz * z[l]];
            for (sum, term) in sums.iter_mut().zip(terms) {
                sum[l] += term;
            }
        }
    }
    sums.map(|lanes| lanes.iter().sum())
}

fn normal(moments: &[f32; 10], towards: &Vector3<f64>) -> Normal {
    let neighbours = moments[0] as u32;
    let unknown =
        Normal { direction: towards.try_normalize(1e-9).unwrap_or_else(Vector3::z), roughness: None, neighbours };
    if moments[0] < NEIGHBOURS_MIN {
        return unknown;
    }
    let [n, x, y, z, xx, xy, xz, yy, yz, zz] = moments.map(f64::from);
    let (x, y, z) = (x / n, y / n, z / n);
    let spread = [xx / n - x * x, xy / n - x * y, xz / n - x * z, yy / n - y * y, yz / n - y * z, zz / n - z * z];
    let Some((axis, variances)) = least_axis(&spread) else { return unknown };
    let direction = if axis.dot(towards) < 0.0 { -axis } else { axis };
    let [thickness, width, length] = variances.map(|v| v.max(0.0).sqrt());
    let is_surface = width >= WIDTH_MIN * length && thickness <= THICKNESS_MAX * width;
    Normal { direction, roughness: is_surface.then_some(thickness), neighbours }
}

/// The eigenvector of the smallest eigenvalue of a symmetric matrix (upper triangle by rows), and all eigenvalues
/// ascending, in closed form; `None` for a multiple of the identity.
pub fn least_axis(&[xx, xy, xz, yy, yz, zz]: &[f64; 6]) -> Option<(Vector3<f64>, [f64; 3])> {
    let mean = (xx + yy + zz) / 3.0;
    let (a, b, c) = (xx - mean, yy - mean, zz - mean);
    let size = ((a * a + b * b + c * c + 2.0 * (xy * xy + xz * xz + yz * yz)) / 6.0).sqrt();
    if size.is_nan() || size <= 1e-9 {
        return None;
    }
    let determinant = a * (b * c - yz * yz) - xy * (xy * c - yz * xz) + xz * (xy * yz - b * xz);
    let angle = acos((determinant / (2.0 * size * size * size)).clamp(-1.0, 1.0)) / 3.0;
    let (most, least) = (mean + 2.0 * size * cos(angle), mean + 2.0 * size * cos(angle + TAU / 3.0));
    // The axis is normal to all rows of M − λI: of their products the longest is the most certain.
    let rows = [Vector3::new(xx - least, xy, xz), Vector3::new(xy, yy - least, yz), Vector3::new(xz, yz, zz - least)];
    let products = [rows[0].cross(&rows[1]), rows[0].cross(&rows[2]), rows[1].cross(&rows[2])];
    let longest = products.into_iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    Some((longest.try_normalize(1e-12 * size * size)?, [least, 3.0 * mean - most - least, most]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Matrix3;
    use proptest::prelude::*;

    #[test]
    fn normals_face_the_viewpoint_and_lines_and_places_have_none() {
        let plane: Vec<[f32; 3]> = (0..49).map(|k| [(k % 7) as f32, (k / 7) as f32, 2.0]).collect();
        for z in [-5.0, 5.0] {
            let n = normals(&plane, |_| Vector3::new(1.0, 2.0, z))[24];
            assert!((n.direction - Vector3::z() * (z - 2.0).signum()).norm() < 1e-6, "{n:?}");
            assert!(n.roughness.unwrap() < 1e-3);
            assert_eq!(n.neighbours, 29);
        }
        let line: Vec<[f32; 3]> = (0..9).map(|k| [k as f32 * 0.5, 0.0, 0.0]).collect();
        assert!(normals(&line, |_| Vector3::z()).iter().all(|n| n.roughness.is_none()));
        let place = vec![[0.0; 3]; 9];
        assert_eq!(
            normals(&place, |_| Vector3::x())[4],
            Normal { direction: Vector3::x(), roughness: None, neighbours: 9 }
        );
        assert!(normals(&[], |_| Vector3::x()).is_empty());
    }

    proptest! {
        #[test]
        fn the_closed_form_agrees_with_an_iteration(v in prop::array::uniform9(-1.0..1.0f64)) {
            let root = Matrix3::from_row_slice(&v);
            let m = root * root.transpose();
            let eigen = m.symmetric_eigen();
            let mut expected: Vec<f64> = eigen.eigenvalues.iter().copied().collect();
            expected.sort_by(f64::total_cmp);
            prop_assume!(expected[1] - expected[0] > 1e-3 * expected[2]);
            let (axis, variances) =
                least_axis(&[m[(0, 0)], m[(0, 1)], m[(0, 2)], m[(1, 1)], m[(1, 2)], m[(2, 2)]]).unwrap();
            for (a, b) in variances.iter().zip(&expected) {
                prop_assert!((a - b).abs() < 1e-8 * expected[2]);
            }
            prop_assert!((m * axis - axis * expected[0]).norm() < 1e-6 * expected[2]);
        }
    }
}

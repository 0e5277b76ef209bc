//! Geometry of a thinned cloud: neighbours within a radius (kiddo's k-d tree), and normals by principal components
//! of the neighbourhood, turned towards the viewpoint.
//!
//! The tree only proposes: distances are recomputed here in f64 and ties go to the smaller position, so that results do
//! not depend on how the tree was laid out or compiled.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::{Matrix3, Vector3};

/// Radius of the neighbourhood that a normal is fitted to, in voxels.
pub const NORMAL_RADIUS_VOXELS: f64 = 3.0;
/// Neighbours used for a normal at most (the nearest).
const NORMAL_NEIGHBOURS_MAX: usize = 30;
/// Points (itself included) a normal needs at least.
const NORMAL_NEIGHBOURS_MIN: usize = 5;
/// A surface is at least this wide for its length (ratio of standard deviations), else it is a line...
const WIDTH_MIN: f64 = 0.2;
/// ...and at most this thick for its width, else it is a blob.
const THICKNESS_MAX: f64 = 0.8;
/// Slack on the radius asked of the tree, so that rounding inside it cannot lose a neighbour.
const RADIUS_SLACK: f64 = 1.0 + 1e-9;

/// A neighbour: position in the cloud and squared distance.
pub type Neighbour = (u32, f64);

/// Neighbour search over fixed points.
pub struct Index<'a> {
    points: &'a [Vector3<f64>],
    tree: Option<ImmutableKdTree<f64, 3>>,
}

impl<'a> Index<'a> {
    /// Indexes `points` (all finite).
    pub fn new(points: &'a [Vector3<f64>]) -> Self {
        let raw: Vec<[f64; 3]> = points.iter().map(|p| [p.x, p.y, p.z]).collect();
        let tree = if raw.is_empty() { None } else { ImmutableKdTree::new_from_slice(&raw).ok() };
        Self { points, tree }
    }

    /// All points within `radius` of `at`, nearest first.
    pub fn within(&self, at: &Vector3<f64>, radius: f64) -> Vec<Neighbour> {
        let squared_max = radius * radius;
        let mut found: Vec<Neighbour> = self
            .tree
            .iter()
            .flat_map(|tree| {
                tree.query(&[at.x, at.y, at.z])
                    .within::<SquaredEuclidean<f64>>(squared_max * RADIUS_SLACK)
                    .unsorted()
                    .execute()
            })
            .map(|hit| (hit.item, (self.points[hit.item as usize] - at).norm_squared()))
            .filter(|hit| hit.1 <= squared_max)
            .collect();
        found.sort_unstable_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        found
    }

    /// The point nearest to `at` within `radius`.
    pub fn nearest(&self, at: &Vector3<f64>, radius: f64) -> Option<Neighbour> {
        self.within(at, radius).first().copied()
    }
}

/// A point's normal and how well a plane fits around it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Normal {
    /// Unit normal, towards the viewpoint.
    pub direction: Vector3<f64>,
    /// Standard deviation of the neighbourhood about its plane, frame units; `None` where there is no plane to speak
    /// of (too few neighbours, a line, a blob).
    pub roughness: Option<f64>,
}

/// The normal at `at` from its neighbours (nearest first, itself included), as seen from `viewpoint`.
pub fn normal(
    points: &[Vector3<f64>],
    neighbours: &[Neighbour],
    at: &Vector3<f64>,
    viewpoint: &Vector3<f64>,
) -> Normal {
    let near = &neighbours[..neighbours.len().min(NORMAL_NEIGHBOURS_MAX)];
    let towards = viewpoint - at;
    let unknown = Normal { direction: towards.try_normalize(1e-9).unwrap_or_else(Vector3::z), roughness: None };
    if near.len() < NORMAL_NEIGHBOURS_MIN {
        return unknown;
    }
    // Relative to the point itself: coordinates far from the anchor would cost digits.
    let count = near.len() as f64;
    let offset = |n: &Neighbour| points[n.0 as usize] - at;
    let mean = near.iter().map(offset).sum::<Vector3<f64>>() / count;
    let spread = near.iter().map(|n| offset(n) - mean).map(|d| d * d.transpose()).sum::<Matrix3<f64>>() / count;
    let eigen = spread.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let [thickness, width, length] = order.map(|k| eigen.eigenvalues[k].max(0.0).sqrt());
    let Some(axis) = eigen.eigenvectors.column(order[0]).into_owned().try_normalize(1e-9) else { return unknown };
    let direction = if axis.dot(&towards) < 0.0 { -axis } else { axis };
    let is_surface = length > 0.0 && width >= WIDTH_MIN * length && thickness <= THICKNESS_MAX * width;
    Normal { direction, roughness: is_surface.then_some(thickness) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn brute(points: &[Vector3<f64>], at: &Vector3<f64>, radius: f64) -> Vec<Neighbour> {
        let mut all: Vec<Neighbour> = (0u32..).zip(points).map(|(k, p)| (k, (p - at).norm_squared())).collect();
        all.retain(|n| n.1 <= radius * radius);
        all.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        all
    }

    proptest! {
        /// Lattices hold the ties (equal coordinates, equal distances, duplicates) that real clouds of walls hold.
        #[test]
        fn neighbours_are_those_of_a_full_search(
            lattice in prop::collection::vec((0..6i32, 0..6i32, 0..3i32), 0..600),
            at in (0..6i32, 0..6i32, 0..3i32),
            radius in 0.0..4.0f64,
        ) {
            let v = |(x, y, z): (i32, i32, i32)| Vector3::new(f64::from(x), f64::from(y), f64::from(z)) * 0.5;
            let points: Vec<_> = lattice.into_iter().map(v).collect();
            prop_assert_eq!(Index::new(&points).within(&v(at), radius), brute(&points, &v(at), radius));
        }
    }

    #[test]
    fn a_flat_wall_and_a_single_place_are_searched_in_full() {
        for z in [0.0, 1.0] {
            let wall: Vec<_> = (0..3000)
                .map(|k| Vector3::new(f64::from(k % 60) * 0.1 * z, f64::from(k / 60) * 0.1 * z, 0.3))
                .collect();
            let at = wall[1234];
            assert_eq!(Index::new(&wall).within(&at, 0.35), brute(&wall, &at, 0.35));
        }
        assert!(Index::new(&[]).nearest(&Vector3::zeros(), 1.0).is_none());
    }

    #[test]
    fn normals_face_the_viewpoint_and_lines_have_none() {
        let plane: Vec<_> = (0..49).map(|k| Vector3::new(f64::from(k % 7), f64::from(k / 7), 2.0)).collect();
        let at = plane[24];
        let all = brute(&plane, &at, 3.0);
        for z in [-5.0, 5.0] {
            let n = normal(&plane, &all, &at, &Vector3::new(1.0, 2.0, z));
            assert!((n.direction - Vector3::z() * z.signum()).norm() < 1e-12);
            assert_eq!(n.roughness, Some(0.0));
        }
        let line: Vec<_> = (0..9).map(|k| Vector3::new(f64::from(k), 0.0, 0.0)).collect();
        assert_eq!(normal(&line, &brute(&line, &line[4], 9.0), &line[4], &Vector3::z()).roughness, None);
        let place = vec![Vector3::zeros(); 9];
        assert_eq!(normal(&place, &brute(&place, &place[4], 9.0), &place[4], &Vector3::z()).roughness, None);
    }
}

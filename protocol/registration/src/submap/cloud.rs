//! Neighbours within a radius among the points of a thinned cloud (kiddo's k-d tree).
//!
//! The tree only proposes: distances are recomputed here in f64 and ties go to the smaller position, so that results do
//! not depend on how the tree was laid out or compiled.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Vector3;

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
}

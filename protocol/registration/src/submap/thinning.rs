//! Voxel thinning of a growing cloud in bounded memory: each occupied voxel keeps the mean of its points and the
//! keyframe that saw it first. When voxels outnumber the bound, those with the largest hash are dropped and never
//! readmitted, so what stays is a uniform sample of the surface whatever the order of the points.

use std::collections::BTreeMap;

/// Voxels along an axis on either side of the anchor; points farther out are not mapped.
pub const VOXELS_PER_AXIS_MAX: i32 = 1 << 20;

/// A voxel's integer coordinates about the anchor.
type Key = [i32; 3];

#[derive(Clone, Debug)]
struct Cell {
    sum: [f64; 3],
    count: u32,
    keyframe: u16,
}

/// The thinned cloud of one submap while it grows.
#[derive(Clone, Debug)]
pub struct Thinner {
    voxel: f64,
    points_max: usize,
    cells: BTreeMap<Key, Cell>,
    /// Voxels whose hash lies above were dropped.
    hash_max: u64,
}

impl Thinner {
    /// An empty cloud of at most `points_max` points, one per voxel of edge `voxel`.
    pub fn new(voxel: f64, points_max: usize) -> Self {
        Self { voxel, points_max, cells: BTreeMap::new(), hash_max: u64::MAX }
    }

    /// Adds points in the anchor frame, all seen by `keyframe`. Points beyond [`VOXELS_PER_AXIS_MAX`] are skipped.
    pub fn add(&mut self, points: impl Iterator<Item = [f64; 3]>, keyframe: u16) {
        let mut keyed: Vec<(Key, [f64; 3])> = points.filter_map(|p| Some((self.key(&p)?, p))).collect();
        // Stable: the order of equal keys, hence of the sums, is that of the points.
        keyed.sort_by_key(|(key, _)| *key);
        for run in keyed.chunk_by(|a, b| a.0 == b.0) {
            if hash_of(&run[0].0) > self.hash_max {
                continue;
            }
            let cell = self.cells.entry(run[0].0).or_insert(Cell { sum: [0.0; 3], count: 0, keyframe });
            for (_, p) in run {
                (0..3).for_each(|axis| cell.sum[axis] += p[axis]);
            }
            cell.count = cell.count.saturating_add(u32::try_from(run.len()).unwrap_or(u32::MAX));
        }
        // Twice the bound, so that the sort is paid rarely.
        if self.cells.len() > 2 * self.points_max {
            self.shed();
        }
    }

    /// The means, in order of their voxels, and the keyframe that first saw each.
    pub fn finish(mut self) -> (Vec<[f32; 3]>, Vec<u16>) {
        if self.cells.len() > self.points_max {
            self.shed();
        }
        let mean = |c: &Cell| c.sum.map(|s| (s / f64::from(c.count)) as f32);
        self.cells.values().map(|c| (mean(c), c.keyframe)).unzip()
    }

    fn key(&self, p: &[f64; 3]) -> Option<Key> {
        let mut key = [0; 3];
        for axis in 0..3 {
            let cell = (p[axis] / self.voxel).floor();
            if cell.is_nan() || cell.abs() >= f64::from(VOXELS_PER_AXIS_MAX) {
                return None;
            }
            key[axis] = cell as i32;
        }
        Some(key)
    }

    /// Keeps the `points_max` voxels of smallest hash.
    fn shed(&mut self) {
        let mut hashes: Vec<u64> = self.cells.keys().map(hash_of).collect();
        let (_, &mut nth, _) = hashes.select_nth_unstable(self.points_max.saturating_sub(1));
        self.hash_max = nth;
        self.cells.retain(|key, _| hash_of(key) <= nth);
    }
}

/// A fixed mixing of a voxel's coordinates (the finaliser of SplitMix64): a pseudo-random but reproducible order.
pub fn hash_of(key: &Key) -> u64 {
    key.iter().fold(0x9e37_79b9_7f4a_7c15, |h, &k| {
        let mut z = (h ^ u64::from(k as u32)).wrapping_add(0x9e37_79b9_7f4a_7c15);
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_voxel_holds_the_mean_of_its_points_and_its_first_keyframe() {
        let mut t = Thinner::new(1.0, 100);
        t.add([[0.2, 0.2, 0.2], [5.5, 0.0, 0.0]].into_iter(), 3);
        t.add([[0.4, 0.6, 0.8]].into_iter(), 4);
        let (cloud, keyframes) = t.finish();
        assert_eq!(cloud, vec![[0.3, 0.4, 0.5], [5.5, 0.0, 0.0]]);
        assert_eq!(keyframes, vec![3, 3]);
    }

    #[test]
    fn memory_is_bounded_and_what_stays_is_spread_evenly() {
        let mut t = Thinner::new(1.0, 1000);
        for x in 0..400 {
            t.add((0..100).map(|y| [f64::from(x) + 0.5, f64::from(y) + 0.5, 0.5]), 0);
            assert!(t.cells.len() <= 2000);
        }
        let (cloud, _) = t.finish();
        assert_eq!(cloud.len(), 1000);
        let first_half = cloud.iter().filter(|p| p[0] < 200.0).count();
        assert!((400..=600).contains(&first_half), "{first_half}");
    }

    #[test]
    fn far_and_absurd_points_are_skipped() {
        let edge = f64::from(VOXELS_PER_AXIS_MAX);
        let mut t = Thinner::new(1.0, 10);
        t.add([[edge, 0.0, 0.0], [f64::NAN, 0.0, 0.0], [0.0, -edge, 0.0], [0.0, 0.0, f64::INFINITY]].into_iter(), 0);
        assert!(t.cells.is_empty());
        t.add([[edge - 0.5, 0.0, 0.0]].into_iter(), 0);
        assert_eq!(t.finish().0.len(), 1);
    }
}

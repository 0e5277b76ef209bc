//! Where else a submap would fit, upright as it stands: what repeats itself in steps. Descriptors seldom tell, since
//! from where a robot stood the next shelf is seen from another side; surfaces do. Every keypoint votes for the shifts
//! that bring it, along the ground, onto a surface that faces the same way; who votes for many says little of each.
//! What faces up or down, and so fits anywhere, has no vote. Where it is not known which way is up, the ground is what
//! most surfaces lie in. Lengths are in voxels.

use super::scene::{Cloud, Pose};
use nalgebra::{Matrix3, Vector3};

/// Shifts that are looked at, at most.
const SHIFTS_MAX: usize = 24;
/// Longest shift along either axis, voxels.
const REACH: f64 = 102.0;
/// Edge of what counts as one shift, voxels.
const CELL: f64 = 3.0;
/// Cells along an axis.
const CELLS: usize = 68;
/// A keypoint comes this near to a surface's height, voxels.
const LEVEL: f64 = 1.0;
/// Cosine of the largest angle between normals that face the same way.
const ALIKE_COS_MIN: f64 = 0.9;
/// What faces the ground's normal by more than this cosine faces up or down.
const UPRIGHT_COS_MAX: f64 = 0.7;
/// Votes that are as good as one.
const VOTES_OF_ONE: f64 = 10.0;

/// The pose, which puts their points where `placed` says, moved by the shifts with most votes that are `least` or
/// longer. `up` is of length 1, in my frame.
pub(super) fn shifts(
    (placed, pose): (&[Vector3<f64>], &Pose),
    theirs: &Cloud,
    mine: &Cloud,
    up: Option<&Vector3<f64>>,
    least: f64,
) -> Vec<Pose> {
    let up = up.copied().unwrap_or_else(|| most_faced(mine));
    let Some([along, across]) = ground(&up) else { return Vec::new() };
    let level: Vec<(f64, [f64; 2])> =
        mine.points.iter().map(|p| (p.dot(&up), [p.dot(&along), p.dot(&across)])).collect();
    let mut votes = vec![0.0; CELLS * CELLS];
    let mut cells: Vec<usize> = Vec::new();
    for (point, normal) in placed.iter().zip(&theirs.normals) {
        let normal = pose.rotation * normal;
        if normal.dot(&up).abs() > UPRIGHT_COS_MAX {
            continue;
        }
        let (height, [x, y]) = (point.dot(&up), [point.dot(&along), point.dot(&across)]);
        cells.clear();
        cells.extend(mine.normals.iter().zip(&level).filter_map(|(facing, (h, at))| {
            ((h - height).abs() <= LEVEL && facing.dot(&normal) >= ALIKE_COS_MIN)
                .then(|| cell([at[0] - x, at[1] - y]))?
        }));
        cells.sort_unstable();
        cells.dedup();
        let vote = 1.0 / (VOTES_OF_ONE + cells.len() as f64);
        cells.iter().for_each(|&cell| votes[cell] += vote);
    }
    let middle = |k: usize| (k as f64 + 0.5) * CELL - REACH;
    let shift = |cell: usize| along * middle(cell % CELLS) + across * middle(cell / CELLS);
    votes.iter_mut().enumerate().filter(|(cell, _)| shift(*cell).norm() < least).for_each(|(_, votes)| *votes = 0.0);
    let moved = |cell| Pose { translation: pose.translation + shift(cell), ..*pose };
    peaks(&votes).into_iter().map(moved).collect()
}

/// The direction that most of a cloud's surfaces face.
fn most_faced(cloud: &Cloud) -> Vector3<f64> {
    let spread: Matrix3<f64> = cloud.normals.iter().map(|n| n * n.transpose()).sum();
    let eigen = spread.symmetric_eigen();
    eigen.eigenvectors.column(eigen.eigenvalues.imax()).into_owned()
}

/// Two axes of the plane whose normal is `up`.
fn ground(up: &Vector3<f64>) -> Option<[Vector3<f64>; 2]> {
    let aside = Vector3::ith(up.iamin(), 1.0);
    let along = up.cross(&aside).try_normalize(1e-9)?;
    Some([along, up.cross(&along)])
}

/// The cell of a shift; none of one that is too long.
fn cell([x, y]: [f64; 2]) -> Option<usize> {
    let index = |v: f64| {
        let k = ((v + REACH) / CELL).floor();
        (k >= 0.0 && k < CELLS as f64).then_some(k as usize)
    };
    Some(index(y)? * CELLS + index(x)?)
}

/// The cells with most votes, none beside another.
fn peaks(votes: &[f64]) -> Vec<usize> {
    let mut ranked: Vec<usize> = (0..votes.len()).filter(|&cell| votes[cell] > 0.0).collect();
    ranked.sort_by(|&a, &b| votes[b].total_cmp(&votes[a]).then(a.cmp(&b)));
    let mut chosen: Vec<usize> = Vec::new();
    for cell in ranked {
        let beside =
            |other: &usize| (cell % CELLS).abs_diff(other % CELLS) <= 1 && (cell / CELLS).abs_diff(other / CELLS) <= 1;
        if !chosen.iter().any(beside) {
            chosen.push(cell);
        }
        if chosen.len() == SHIFTS_MAX {
            break;
        }
    }
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Crates of so many voxels along x, one every `step`, on open ground: their sides, and the ground.
    fn crates(count: i32, step: f64) -> Cloud {
        let mut cloud = Cloud::default();
        let mut add = |at: [f64; 3], normal: [f64; 3]| {
            cloud.points.push(at.into());
            cloud.normals.push(normal.into());
        };
        for (x, y) in (-40..160).step_by(4).flat_map(|x| (-40..40).step_by(4).map(move |y| (x, y))) {
            add([f64::from(x), f64::from(y), 0.0], [0.0, 0.0, 1.0]);
        }
        for k in 0..count {
            let from = f64::from(k) * step;
            for (u, z) in (0..4).flat_map(|u| (0..5).map(move |z| (2.0 * f64::from(u), 2.0 * f64::from(z)))) {
                add([from, u, z], [-1.0, 0.0, 0.0]);
                add([from + 7.0, u, z], [1.0, 0.0, 0.0]);
                add([from + u, 0.0, z], [0.0, -1.0, 0.0]);
                add([from + u, 7.0, z], [0.0, 1.0, 0.0]);
            }
        }
        cloud
    }

    #[test]
    fn what_stands_at_every_step_is_found_there() {
        let (one, row) = (crates(1, 0.0), crates(4, 26.0));
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        let found = shifts((&one.points, &pose), &one, &row, None, 12.0);
        for want in [26.0, 52.0, 78.0] {
            let near = |pose: &Pose| (pose.translation - Vector3::new(want, 0.0, 0.0)).norm() <= CELL;
            assert!(found.iter().take(8).any(near), "{want} is not among the first of {found:?}");
        }
        assert!(found.len() <= SHIFTS_MAX && found.iter().all(|pose| pose.translation.z.abs() < 1e-9));
        assert!(found.iter().all(|pose| pose.translation.norm() >= 12.0), "the pose itself takes no turn");
    }

    /// Long shelves along x, one every 26 voxels along y: most surfaces face y.
    #[test]
    fn who_knows_which_way_is_up_takes_no_shelf_for_the_ground() {
        let shelves = |count: i32| {
            let mut cloud = Cloud::default();
            for (k, x, z) in (0..count).flat_map(|k| (0..30).flat_map(move |x| (0..20).map(move |z| (k, x, z)))) {
                cloud.points.push([2.0 * f64::from(x), 26.0 * f64::from(k), 2.0 * f64::from(z)].into());
                cloud.normals.push(Vector3::y());
            }
            cloud
        };
        let (one, rows) = (shelves(1), shelves(3));
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        let next_is_found = |up: Option<&Vector3<f64>>| {
            let found = shifts((&one.points, &pose), &one, &rows, up, 12.0);
            found.iter().any(|pose| (pose.translation - Vector3::new(0.0, 26.0, 0.0)).norm() <= CELL)
        };
        assert!(next_is_found(Some(&Vector3::z())) && !next_is_found(None));
    }

    #[test]
    fn shifts_are_bounded_and_nothing_has_none() {
        let edge = REACH - 1e-9;
        assert!(cell([edge, -REACH]).is_some() && cell([REACH, 0.0]).is_none() && cell([0.0, f64::NAN]).is_none());
        let pose = Pose { rotation: Matrix3::identity(), translation: Vector3::zeros() };
        assert!(shifts((&[], &pose), &Cloud::default(), &Cloud::default(), None, 12.0).is_empty());
        let one = crates(1, 0.0);
        assert!(shifts((&[], &pose), &Cloud::default(), &one, None, 12.0).is_empty());
    }
}

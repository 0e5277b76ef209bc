//! A plain three-point RANSAC, only for judging matches here.

use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::submap::Matches;
use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};

/// The pose with most matches within `radius`, and how many there are.
pub fn solve(matches: &Matches, radius: f64, seed: u64) -> (Se3, usize) {
    let v = |p: &[f64; 3]| Vector3::from(*p);
    let source: Vec<_> = matches.source.iter().map(v).collect();
    let target: Vec<_> = matches.target.iter().map(v).collect();
    let n = source.len();
    let mut best = (Se3::identity(), 0);
    if n < 3 {
        return best;
    }
    let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(seed);
    for _ in 0..400_000 {
        let k = [rng.random_range(0..n), rng.random_range(0..n), rng.random_range(0..n)];
        let good = [(0, 1), (1, 2), (2, 0)].iter().all(|&(a, b)| {
            let (s, t) = ((source[k[a]] - source[k[b]]).norm(), (target[k[a]] - target[k[b]]).norm());
            s > 6.0 * radius && (s - t).abs() < 1.5 * radius
        });
        if !good {
            continue;
        }
        let pose = rigid(&k.map(|i| source[i]), &k.map(|i| target[i]));
        let count = inliers(&pose, &source, &target, radius).len();
        if count > best.1 {
            best = (pose, count);
        }
    }
    for _ in 0..5 {
        let kept = inliers(&best.0, &source, &target, radius);
        if kept.len() < 3 {
            break;
        }
        let pick = |from: &[Vector3<f64>]| kept.iter().map(|&i| from[i]).collect::<Vec<_>>();
        best = (rigid(&pick(&source), &pick(&target)), kept.len());
    }
    best
}

fn inliers(pose: &Se3, source: &[Vector3<f64>], target: &[Vector3<f64>], radius: f64) -> Vec<usize> {
    let r = pose.rotation.matrix();
    (0..source.len()).filter(|&i| (r * source[i] + pose.translation - target[i]).norm() < radius).collect()
}

fn rigid(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Se3 {
    let n = source.len() as f64;
    let (ms, mt) = (source.iter().sum::<Vector3<f64>>() / n, target.iter().sum::<Vector3<f64>>() / n);
    let h: Matrix3<f64> = source.iter().zip(target).map(|(s, t)| (t - mt) * (s - ms).transpose()).sum();
    let svd = h.svd(true, true);
    let (u, vt) = (svd.u.unwrap(), svd.v_t.unwrap());
    let d = Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, (u * vt).determinant().signum()));
    let r = So3::from_matrix(&(u * d * vt));
    Se3::new(r, mt - r * ms)
}

//! From where to look at a map: a plan view. The direction of sight is the one in which the points' shadow is most
//! concentrated (walls seen edge-on), searched around the sensor's usual "up"; the plan is then turned so that it lies
//! wide and compact.

use nalgebra::{Matrix2x3, Vector2, Vector3};

/// Directions searched lie this close to the usual "up".
const TILT_DEG_MAX: f64 = 35.0;
/// Steps of the search: each ring searches around the best of the one before.
const STEPS_DEG: [f64; 2] = [2.5, 0.5];
/// Cells of the shadow along the map's longer side.
const CELLS: f64 = 160.0;
/// Points looked at.
const POINTS: usize = 12_000;

/// The 2×3 matrix that takes a point to plan coordinates: x right, y up, m.
pub(super) fn plan(points: &[Vector3<f64>], up: &Vector3<f64>) -> Matrix2x3<f64> {
    let step = points.len().div_ceil(POINTS).max(1);
    let sample: Vec<Vector3<f64>> = points.iter().step_by(step).copied().collect();
    // Cells are as large as the map, wherever its frame's origin is.
    let middle = sample.iter().sum::<Vector3<f64>>() / (sample.len().max(1) as f64);
    let sample: Vec<Vector3<f64>> = sample.into_iter().map(|p| p - middle).collect();
    let sight = sight(&sample, &up.normalize());
    let [u, v] = basis(&sight);
    let flat = Matrix2x3::from_rows(&[u.transpose(), v.transpose()]);
    turned(&sample, &flat)
}

/// The direction around `up` with the most concentrated shadow.
fn sight(points: &[Vector3<f64>], up: &Vector3<f64>) -> Vector3<f64> {
    if points.len() < 3 {
        return *up;
    }
    let extent = points.iter().map(|p| p.amax()).fold(0.0, f64::max).max(1e-9);
    let cell = 2.0 * extent / CELLS;
    let mut best = (f64::NEG_INFINITY, *up);
    for step in STEPS_DEG {
        let rings = if step == STEPS_DEG[0] { (TILT_DEG_MAX / step) as i32 } else { 5 };
        let centre = best.1;
        let [u, v] = basis(&centre);
        for (i, j) in (-rings..=rings).flat_map(|i| (-rings..=rings).map(move |j| (i, j))) {
            let tilt = |k: i32| (f64::from(k) * step).to_radians().tan();
            let candidate = (centre + u * tilt(i) + v * tilt(j)).normalize();
            if candidate.dot(up) < TILT_DEG_MAX.to_radians().cos() {
                continue;
            }
            let score = concentration(points, &candidate, cell);
            if score > best.0 {
                best = (score, candidate);
            }
        }
    }
    best.1
}

/// Σ n ln n over the cells of the shadow: the less the shadow's entropy, the more.
fn concentration(points: &[Vector3<f64>], sight: &Vector3<f64>, cell: f64) -> f64 {
    let [u, v] = basis(sight);
    // A point is at most √3 times its largest coordinate away.
    let side = (2.0 * CELLS) as usize;
    let mut counts = vec![0.0_f64; side * side];
    for p in points {
        let [x, y] = [p.dot(&u), p.dot(&v)].map(|along| (along / cell + CELLS) as usize);
        if let Some(count) = counts.get_mut(x * side + y) {
            *count += 1.0;
        }
    }
    counts.into_iter().filter(|n| *n > 0.0).map(|n| n * n.ln()).sum()
}

/// Two axes across `sight`, which comes toward the viewer: (right, up, sight) is right-handed.
fn basis(sight: &Vector3<f64>) -> [Vector3<f64>; 2] {
    let helper = if sight.x.abs() < 0.8 { Vector3::x() } else { Vector3::y() };
    let u = (helper - sight * helper.dot(sight)).normalize();
    [u, sight.cross(&u)]
}

/// `flat`, turned so that the bounding box of the points is smallest and lies on its longer side.
fn turned(points: &[Vector3<f64>], flat: &Matrix2x3<f64>) -> Matrix2x3<f64> {
    let shadow: Vec<Vector2<f64>> = points.iter().map(|p| flat * p).collect();
    let mut best = (f64::INFINITY, *flat);
    for degrees in 0..180 {
        let (s, c) = f64::from(degrees).to_radians().sin_cos();
        let (x, y) = (Vector2::new(c, s), Vector2::new(-s, c));
        let span = |axis: &Vector2<f64>| {
            let mut along: Vec<f64> = shadow.iter().map(|p| p.dot(axis)).collect();
            along.sort_by(f64::total_cmp);
            // Stray points beyond the outer hundredth do not count.
            let cut = along.len() / 100;
            along.get(along.len().saturating_sub(cut + 1)).zip(along.get(cut)).map_or(0.0, |(high, low)| high - low)
        };
        let (width, height) = (span(&x), span(&y));
        if width >= height && width * height < best.0 {
            let turn = nalgebra::Matrix2::new(c, s, -s, c);
            best = (width * height, turn * flat);
        }
    }
    best.1
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::{Rng, SeedableRng};

    /// A room of 8 × 5 × 2.5 m: points on walls, floor and ceiling. Not on a grid, whose rows would line up.
    fn room() -> Vec<Vector3<f64>> {
        let mut dice = ChaCha8Rng::seed_from_u64(1);
        let size = Vector3::new(8.0, 5.0, 2.5);
        let mut points = Vec::new();
        for (axis, count) in [(0, 1250), (1, 2000), (2, 4000)] {
            for _ in 0..2 * count {
                let mut p = size.map(|s| s * f64::from(dice.next_u32()) / f64::from(u32::MAX));
                p[axis] = (p[axis] / size[axis]).round() * size[axis];
                points.push(p);
            }
        }
        points
    }

    #[test]
    fn a_tilted_room_is_seen_from_above_and_lies_wide() {
        let tilt = Rotation3::from_euler_angles(0.3, -0.25, 1.1);
        let points: Vec<_> = room().iter().map(|p| tilt * p).collect();
        let plan = plan(&points, &Vector3::z());
        let sight = plan.row(0).transpose().cross(&plan.row(1).transpose());
        let off = sight.dot(&(tilt * Vector3::z())).clamp(-1.0, 1.0).acos().to_degrees();
        assert!(off < 2.0, "{off}° from the vertical");
        let along = plan * (tilt * Vector3::x());
        assert!(along.x.abs() > 0.998, "the longer walls lie across: {along}");
    }

    #[test]
    fn few_points_are_no_trouble() {
        for n in 0..4 {
            let points: Vec<_> = (0..n).map(|i| Vector3::repeat(f64::from(i))).collect();
            let plan = plan(&points, &Vector3::z());
            assert!(plan.iter().all(|x| x.is_finite()));
        }
    }
}

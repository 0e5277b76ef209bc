//! How the surface lies around a point, blind to rotation and translation: in six rings of growing radius the mean of
//! the three cosines that a point with normal n forms with a neighbour with normal m in direction e (n·e, n·m, m·e),
//! of their squares and products, and how full the ring is. The first two orders of the joint distribution that FPFH
//! keeps three histograms of; on real submaps they find twice as many right matches, and they need no histogram, so
//! that eight neighbours are worked on at once. Lengths are in voxels.
//!
//! Neighbours are drawn from an even thinning of the cloud, finer for the inner rings: what lies densely does not count
//! more than what lies sparsely, as things do in the near and the far of a LiDAR scan.

use super::grid::{Grid, LANES, Lanes, bounds, cell_key};
use core::f32::consts::TAU;
use pulp::{Arch, Simd, WithSimd};

/// Radii at which each ring's weight peaks; it falls linearly to zero at the neighbouring radii. The last is the end.
const RADII: [f32; RINGS + 1] = [2.0, 5.0, 8.0, 11.0, 14.0, 18.0, 23.0];
/// Rings.
const RINGS: usize = 6;
/// The inner ones, which draw on the finer thinning.
const INNER: usize = 2;
/// Edges of the thinning for the inner and the outer rings.
const THINNING: [f32; 2] = [2.0, 3.0];
/// Edge of the search cells: of the points described, of the inner and of the outer neighbours.
const CELLS: [f32; 3] = [6.0, 3.0, 4.0];
/// Sums over a ring: the weights, then nine products of cosines.
const SUMS: usize = 10;
/// Numbers that describe a point.
pub const NUMBERS: usize = RINGS * SUMS;

/// What [`describe_points`] says of a point: per ring the means of three orthonormal (Legendre) polynomials of first
/// degree, three of second, three products, and the root of the ring's fill relative to a plane's.
pub type Numbers = [f32; NUMBERS];

/// A ring's weight as a function of the distance: rises from `low`, falls to `high`.
#[derive(Clone, Copy)]
struct Hat {
    low: f32,
    rise: f32,
    high: f32,
    fall: f32,
}

impl Hat {
    fn new(ring: usize) -> Self {
        let (peak, high) = (RADII[ring], RADII[ring + 1]);
        let fall = 1.0 / (high - peak);
        match ring.checked_sub(1).map(|inner| RADII[inner]) {
            Some(low) => Self { low, rise: 1.0 / (peak - low), high, fall },
            // The innermost is full down to the point itself.
            None => Self { low: -1.0, rise: 1.0, high, fall },
        }
    }
}

/// A thinned copy of the cloud.
struct Support {
    /// Positions and normals.
    surfels: Vec<[f32; 6]>,
    grid: Grid,
    radius: f32,
    near: Vec<u32>,
    lanes: Lanes<6>,
}

impl Support {
    fn new(points: &[[f32; 3]], normals: &[[f32; 3]], thinning: f32, cell: f32, radius: f32) -> Self {
        let kept = thinned(points, thinning);
        let at: Vec<[f32; 3]> = kept.iter().map(|&k| points[k as usize]).collect();
        let surfel = |k: u32| {
            let ([x, y, z], [u, v, w]) = (points[k as usize], normals[k as usize]);
            [x, y, z, u, v, w]
        };
        let grid = Grid::new(&at, cell);
        let surfels = kept.into_iter().map(surfel).collect();
        Self { surfels, grid, radius, near: Vec::new(), lanes: Lanes::new() }
    }

    fn gather(&mut self, low: &[f32; 3], high: &[f32; 3]) -> &Lanes<6> {
        self.grid.around(low, high, self.radius, &mut self.near);
        self.lanes.fill(&self.surfels, &self.near);
        &self.lanes
    }
}

/// The numbers of the `chosen` among `points`, which have unit `normals`.
pub fn describe_points(points: &[[f32; 3]], normals: &[[f32; 3]], chosen: &[u32]) -> Vec<Numbers> {
    let arch = Arch::new();
    let inner_hats: [Hat; INNER] = core::array::from_fn(Hat::new);
    let outer_hats: [Hat; RINGS - INNER] = core::array::from_fn(|ring| Hat::new(INNER + ring));
    let mut inner = Support::new(points, normals, THINNING[0], CELLS[1], RADII[INNER]);
    let mut outer = Support::new(points, normals, THINNING[1], CELLS[2], RADII[RINGS]);
    let at: Vec<[f32; 3]> = chosen.iter().map(|&k| points[k as usize]).collect();
    let mut numbers = vec![[0.0; NUMBERS]; chosen.len()];
    for cell in Grid::new(&at, CELLS[0]).cells() {
        let (low, high) = bounds(cell.iter().map(|&k| &at[k as usize]));
        let (inner, outer) = (inner.gather(&low, &high), outer.gather(&low, &high));
        for &k in cell {
            let k = k as usize;
            let (p, n) = (&at[k], &normals[chosen[k] as usize]);
            let near = arch.dispatch(Around { lanes: inner, p, n, hats: &inner_hats });
            let far = arch.dispatch(Around { lanes: outer, p, n, hats: &outer_hats });
            let rings = numbers[k].chunks_exact_mut(SUMS).zip(near.iter().chain(&far)).enumerate();
            rings.for_each(|(ring, (numbers, sums))| finish(ring, sums, numbers));
        }
    }
    numbers
}

/// What [`sums`] needs, as something to be run with the widest instructions: it is too large to be inlined from a
/// closure.
struct Around<'a, const R: usize> {
    lanes: &'a Lanes<6>,
    p: &'a [f32; 3],
    n: &'a [f32; 3],
    hats: &'a [Hat; R],
}

impl<const R: usize> WithSimd for Around<'_, R> {
    type Output = [[f32; SUMS]; R];

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> Self::Output {
        sums(self.lanes, self.p, self.n, self.hats)
    }
}

/// The [`SUMS`] of each ring about the point `p` with normal `n`.
#[inline(always)]
fn sums<const R: usize>(lanes: &Lanes<6>, p: &[f32; 3], n: &[f32; 3], hats: &[Hat; R]) -> [[f32; SUMS]; R] {
    let mut sums = [[[0.0; LANES]; SUMS]; R];
    let reach = hats[R - 1].high * hats[R - 1].high;
    for [xs, ys, zs, us, vs, ws] in &lanes.groups {
        let (mut x, mut y, mut z, mut d) = ([0.0; LANES], [0.0; LANES], [0.0; LANES], [0.0; LANES]);
        let mut least = f32::MAX;
        for l in 0..LANES {
            (x[l], y[l], z[l]) = (xs[l] - p[0], ys[l] - p[1], zs[l] - p[2]);
            d[l] = x[l] * x[l] + y[l] * y[l] + z[l] * z[l];
        }
        for squared in d {
            least = if squared < least { squared } else { least };
        }
        if least > reach {
            continue;
        }
        let mut terms = [[0.0; LANES]; SUMS];
        for l in 0..LANES {
            d[l] = d[l].sqrt();
            let along = 1.0 / if d[l] > 1e-6 { d[l] } else { 1e-6 };
            let a = (x[l] * n[0] + y[l] * n[1] + z[l] * n[2]) * along;
            let b = us[l] * n[0] + vs[l] * n[1] + ws[l] * n[2];
            let c = (x[l] * us[l] + y[l] * vs[l] + z[l] * ws[l]) * along;
            let products = [1.0, a, b, c, a * a, b * b, c * c, a * b, a * c, b * c];
            for (term, product) in terms.iter_mut().zip(products) {
                term[l] = product;
            }
        }
        for (sums, hat) in sums.iter_mut().zip(hats) {
            let mut weights = [0.0; LANES];
            let mut most = 0.0;
            for l in 0..LANES {
                let (up, down) = ((d[l] - hat.low) * hat.rise, (hat.high - d[l]) * hat.fall);
                let w = if up < down { up } else { down };
                let w = if w < 1.0 { w } else { 1.0 };
                weights[l] = if w > 0.0 { w } else { 0.0 };
            }
            for w in weights {
                most = if w > most { w } else { most };
            }
            if most > 0.0 {
                for (sum, term) in sums.iter_mut().zip(&terms) {
                    for l in 0..LANES {
                        sum[l] += weights[l] * term[l];
                    }
                }
            }
        }
    }
    sums.map(|ring| ring.map(|lanes| lanes.iter().sum()))
}

/// From sums to means of orthonormal polynomials; an empty ring says zero.
fn finish(ring: usize, sums: &[f32; SUMS], numbers: &mut [f32]) {
    let weight = sums[0];
    if weight > 0.0 {
        let mean = |k: usize| sums[k] / weight;
        for k in 1..4 {
            numbers[k - 1] = 3f32.sqrt() * mean(k);
            numbers[k + 2] = 5f32.sqrt() * (1.5 * mean(k + 3) - 0.5);
            numbers[k + 5] = 3.0 * mean(k + 6);
        }
    }
    let thinning = THINNING[usize::from(ring >= INNER)];
    let width = if ring == 0 { RADII[0] } else { RADII[ring] - RADII[ring - 1] };
    numbers[SUMS - 1] = (weight * thinning * thinning / (TAU * RADII[ring] * width)).sqrt();
}

/// One point of each cube of the given edge: the nearest to its middle, as far as 16 bits tell.
fn thinned(points: &[[f32; 3]], edge: f32) -> Vec<u32> {
    let keyed = |(k, p): (u32, &[f32; 3])| {
        let scaled = p.map(|x| x / edge);
        let cube = scaled.map(f32::floor);
        let aside: f32 = (0..3).map(|axis| (scaled[axis] - cube[axis] - 0.5) * (scaled[axis] - cube[axis] - 0.5)).sum();
        (cell_key(cube.map(|x| x as i32)), ((aside * 65536.0) as u32, k))
    };
    let mut keyed: Vec<(u64, (u32, u32))> = (0..).zip(points).map(keyed).collect();
    keyed.sort_unstable();
    keyed.dedup_by_key(|k| k.0);
    keyed.into_iter().map(|(_, (_, k))| k).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A plane with a step.
    fn cloud() -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
        let at = |k: i32| [(k % 60) as f32, (k / 60) as f32, if k % 60 > 30 { 3.0 } else { 0.0 }];
        (0..3600).map(|k| (at(k), [0.0, 0.0, 1.0])).unzip()
    }

    #[test]
    fn the_sums_are_those_of_the_definition() {
        let (points, normals) = cloud();
        let at = 60 * 30 + 28;
        let numbers = describe_points(&points, &normals, &[at])[0];
        let p = points[at as usize];
        for ring in 0..RINGS {
            let hat = Hat::new(ring);
            let (mut weight, mut lean) = (0.0, 0.0);
            for k in thinned(&points, THINNING[usize::from(ring >= INNER)]) {
                let q = points[k as usize];
                let e = [q[0] - p[0], q[1] - p[1], q[2] - p[2]];
                let d = (e[0] * e[0] + e[1] * e[1] + e[2] * e[2]).sqrt();
                let w = ((d - hat.low) * hat.rise).min((hat.high - d) * hat.fall).clamp(0.0, 1.0);
                weight += w;
                lean += w * e[2] / d.max(1e-6);
            }
            assert!((numbers[ring * SUMS] - 3f32.sqrt() * lean / weight).abs() < 1e-4, "ring {ring}");
        }
    }

    #[test]
    fn on_a_plane_every_normal_agrees_and_an_alone_point_says_nothing() {
        let (points, normals) = cloud();
        let numbers = describe_points(&points, &normals, &[60 * 30 + 4])[0];
        let (along, fill) = (numbers[1], numbers[SUMS - 1]);
        assert!((along - 3f32.sqrt()).abs() < 1e-5);
        assert!((0.8..1.3).contains(&fill), "{fill}");
        let alone = describe_points(&[[0.0; 3], [100.0; 3]], &[[0.0, 0.0, 1.0]; 2], &[1])[0];
        assert!(alone[SUMS..].iter().all(|&x| x == 0.0));
        assert!(describe_points(&[], &[], &[]).is_empty());
    }
}

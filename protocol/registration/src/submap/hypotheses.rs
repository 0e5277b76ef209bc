//! Poses worth a look, from matches of which one in two hundred may be right. Two matches of oriented points determine
//! a pose and over-determine it fourfold: the distance, each normal's angle with the line between, and the angle
//! between the normals must agree. Pairs of matches that do are ranked by how many further matches agree with both
//! (second-order compatibility, Chen et al. 2022), and polished on those. Lengths are in voxels.

use super::matching::Pairing;
use super::scene::{Cloud, Pose};
use crate::simd::wide;
use nalgebra::{Matrix3, Matrix4, Vector3};
use pulp::Arch;

/// Distances of a pair agree within this.
const LENGTH_TOLERANCE: f64 = 1.5;
/// Matches nearer to each other than this say little of the rotation.
const LENGTH_MIN: f64 = 4.0;
/// Cosines of a pair agree within this.
const COSINE_TOLERANCE: f64 = 0.3;
/// Pairs that are tried as poses at most, where nothing is known yet.
pub const POSES_MAX: usize = 1000;
/// Pairs ranked at most; matches of the last keypoints are left out beyond it.
const PAIRS_MAX: usize = 400_000;
/// Two poses that place everything within this distance and angle (rad) are one.
const SAME: (f64, f64) = (1.0, 0.05);
/// A normal counts as much as a point this far away.
const LEVER: f64 = 4.0;
/// Matches within this of a pose polish it.
const POLISH: f64 = 3.0;
/// Rounds of polishing.
const POLISH_ROUNDS: usize = 2;

/// Distinct poses, the one with the most agreement first, of `tries` pairs at most.
pub fn hypotheses(theirs: &Cloud, mine: &Cloud, matches: &[Pairing], tries: usize) -> Vec<Pose> {
    let agreement = Agreement::of(theirs, mine, matches);
    let mut poses: Vec<Pose> = Vec::new();
    // A bit for each pose, match by match.
    let words = tries.div_ceil(64);
    let mut explained = vec![0_u64; words * matches.len()];
    let mut members: Vec<Pairing> = Vec::new();
    let middle = theirs.points.iter().sum::<Vector3<f64>>() / theirs.points.len().max(1) as f64;
    let mut tried = 0;
    for (x, y) in agreement.ranked() {
        let (x, y) = (x as usize, y as usize);
        // What an earlier pose explains leads to it again, and must not use up the tries of others.
        let by = |k: usize| explained[words * k..words * (k + 1)].iter();
        if by(x).zip(by(y)).any(|(a, b)| a & b != 0) {
            continue;
        }
        if tried == tries {
            break;
        }
        tried += 1;
        members.clear();
        members.extend([x, y].into_iter().chain(agreement.common(x, y)).map(|k| matches[k]));
        let Some(pose) = polished(theirs, mine, &members) else { continue };
        if poses.iter().all(|other| pose.differs(other, &middle, SAME.0, SAME.1)) {
            for k in [x, y].into_iter().chain(agreement.common(x, y)) {
                if explains(&pose, theirs, mine, &matches[k]) {
                    explained[words * k + poses.len() / 64] |= 1 << (poses.len() % 64);
                }
            }
            poses.push(pose);
        }
    }
    poses
}

/// Which matches agree with which.
struct Agreement {
    /// Words of a row.
    words: usize,
    /// A bit for each match, row by row.
    bits: Vec<u64>,
    pairs: Vec<(u32, u32)>,
}

impl Agreement {
    fn of(theirs: &Cloud, mine: &Cloud, matches: &[Pairing]) -> Self {
        let words = matches.len().div_ceil(64);
        let mut agreement = Self { words, bits: vec![0; words * matches.len()], pairs: Vec::new() };
        let arch = Arch::new();
        let ends = Ends::of(theirs, mine, matches);
        let mut fits = vec![false; matches.len()];
        for (x, first) in matches.iter().enumerate() {
            ends.fit(arch, x, &mut fits);
            for (y, second) in matches.iter().enumerate().skip(x + 1) {
                if fits[y] && agree(theirs, mine, first, second) {
                    agreement.bits[x * words + y / 64] |= 1 << (y % 64);
                    agreement.bits[y * words + x / 64] |= 1 << (x % 64);
                    agreement.pairs.push((x as u32, y as u32));
                }
            }
            if agreement.pairs.len() > PAIRS_MAX {
                break;
            }
        }
        agreement
    }

    fn row(&self, x: usize) -> &[u64] {
        &self.bits[x * self.words..(x + 1) * self.words]
    }

    /// Matches that agree with both.
    fn common(&self, x: usize, y: usize) -> impl Iterator<Item = usize> {
        let both = self.row(x).iter().zip(self.row(y)).map(|(a, b)| a & b).enumerate();
        both.flat_map(|(word, bits)| (0..64).filter(move |bit| bits >> bit & 1 == 1).map(move |bit| 64 * word + bit))
    }

    /// The pairs, those with the most in common first, of equal ones the first found: they are counted into places, as
    /// there are hundreds of thousands of pairs and some hundreds of counts.
    fn ranked(&self) -> Vec<(u32, u32)> {
        let common = self.commons();
        let most = common.iter().copied().max().unwrap_or(0) as usize;
        let place = |common: u32| most - common as usize;
        let mut starts = vec![0_usize; most + 2];
        common.iter().for_each(|&common| starts[place(common) + 1] += 1);
        for k in 1..starts.len() {
            starts[k] += starts[k - 1];
        }
        let mut ranked = vec![(0, 0); self.pairs.len()];
        for (pair, &common) in self.pairs.iter().zip(&common) {
            let next = &mut starts[place(common)];
            ranked[*next] = *pair;
            *next += 1;
        }
        ranked
    }

    /// For each pair the number of matches that agree with both.
    fn commons(&self) -> Vec<u32> {
        wide(
            Arch::new(),
            #[inline(always)]
            || {
                let mut commons = Vec::with_capacity(self.pairs.len());
                for &(x, y) in &self.pairs {
                    let mut common = 0;
                    for (a, b) in self.row(x as usize).iter().zip(self.row(y as usize)) {
                        common += (a & b).count_ones();
                    }
                    commons.push(common);
                }
                commons
            },
        )
    }
}

/// The ends of matches, coordinate by coordinate, so that the distances of one match from all are worked out together.
struct Ends {
    theirs: [Vec<f64>; 3],
    mine: [Vec<f64>; 3],
}

impl Ends {
    fn of(theirs: &Cloud, mine: &Cloud, matches: &[Pairing]) -> Self {
        let along = |axis: usize| {
            (
                matches.iter().map(|p| theirs.points[p.their as usize][axis]).collect(),
                matches.iter().map(|p| mine.points[p.my as usize][axis]).collect(),
            )
        };
        let [x, y, z] = [0, 1, 2].map(along);
        Self { theirs: [x.0, y.0, z.0], mine: [x.1, y.1, z.1] }
    }

    /// Whether each match after `x` is as far from it at both ends: the first part of [`agree`], which lets few pass.
    fn fit(&self, arch: Arch, x: usize, fits: &mut [bool]) {
        let from = [&self.theirs, &self.mine].map(|ends| [ends[0][x], ends[1][x], ends[2][x]]);
        wide(
            arch,
            #[inline(always)]
            || {
                let count = fits.len();
                let [tx, ty, tz] = [0, 1, 2].map(|axis| &self.theirs[axis][..count]);
                let [mx, my, mz] = [0, 1, 2].map(|axis| &self.mine[axis][..count]);
                for y in x + 1..count {
                    let their = length([tx[y], ty[y], tz[y]], from[0]);
                    fits[y] = lengths_agree(their, length([mx[y], my[y], mz[y]], from[1]));
                }
            },
        );
    }
}

/// Whether one motion may take both points to their counterparts.
fn agree(theirs: &Cloud, mine: &Cloud, first: &Pairing, second: &Pairing) -> bool {
    if first.their == second.their || first.my == second.my {
        return false;
    }
    let [t1, t2] = [first.their, second.their].map(|k| k as usize);
    let [m1, m2] = [first.my, second.my].map(|k| k as usize);
    let (dt, dm) = (theirs.points[t2] - theirs.points[t1], mine.points[m2] - mine.points[m1]);
    let (lt, lm) = (dt.norm(), dm.norm());
    if !lengths_agree(lt, lm) {
        return false;
    }
    let (n1, n2) = (&theirs.normals[t1], &theirs.normals[t2]);
    let (k1, k2) = (&mine.normals[m1], &mine.normals[m2]);
    (n1.dot(n2) - k1.dot(k2)).abs() <= COSINE_TOLERANCE
        && (n1.dot(&dt) / lt - k1.dot(&dm) / lm).abs() <= COSINE_TOLERANCE
        && (n2.dot(&dt) / lt - k2.dot(&dm) / lm).abs() <= COSINE_TOLERANCE
}

/// The distance of two points, in the order of sums of a vector's norm.
#[inline(always)]
fn length(to: [f64; 3], from: [f64; 3]) -> f64 {
    let [x, y, z] = [to[0] - from[0], to[1] - from[1], to[2] - from[2]];
    (x * x + y * y + z * z).sqrt()
}

/// Whether two matches are as far from each other at both ends, and far enough to tell a rotation.
#[inline(always)]
fn lengths_agree(theirs: f64, mine: f64) -> bool {
    !(((theirs - mine).abs() > LENGTH_TOLERANCE) | (theirs < LENGTH_MIN) | (mine < LENGTH_MIN))
}

/// The pose of the first two matches, then of all that are near it.
fn polished(theirs: &Cloud, mine: &Cloud, members: &[Pairing]) -> Option<Pose> {
    let mut pose = least_squares(theirs, mine, members.get(..2)?)?;
    let mut near = Vec::with_capacity(members.len());
    for _ in 0..POLISH_ROUNDS {
        near.clear();
        near.extend(members.iter().filter(|p| explains(&pose, theirs, mine, p)).copied());
        if near.len() >= 2 {
            pose = least_squares(theirs, mine, &near)?;
        }
    }
    Some(pose)
}

/// Whether the pose takes a match's ends near to each other.
fn explains(pose: &Pose, theirs: &Cloud, mine: &Cloud, pairing: &Pairing) -> bool {
    let aside = pose.apply(&theirs.points[pairing.their as usize]) - mine.points[pairing.my as usize];
    aside.norm_squared() <= POLISH * POLISH
}

/// The least-squares motion of points and normals (Horn's quaternion method).
fn least_squares(theirs: &Cloud, mine: &Cloud, matches: &[Pairing]) -> Option<Pose> {
    let count = matches.len() as f64;
    let ends = || matches.iter().map(|p| (p.their as usize, p.my as usize));
    let from = ends().map(|(t, _)| theirs.points[t]).sum::<Vector3<f64>>() / count;
    let to = ends().map(|(_, m)| mine.points[m]).sum::<Vector3<f64>>() / count;
    let product = |(t, m): (usize, usize)| {
        (theirs.points[t] - from) * (mine.points[m] - to).transpose()
            + theirs.normals[t] * mine.normals[m].transpose() * (LEVER * LEVER)
    };
    let rotation = rotation_of(&ends().map(product).sum())?;
    Some(Pose { rotation, translation: to - rotation * from })
}

/// The rotation that maximises tr(R H), H = Σ p qᵀ: the top eigenvector of Horn's 4×4 matrix, by repeated squaring.
fn rotation_of(h: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let (xx, xy, xz) = (h[(0, 0)], h[(0, 1)], h[(0, 2)]);
    let (yx, yy, yz) = (h[(1, 0)], h[(1, 1)], h[(1, 2)]);
    let (zx, zy, zz) = (h[(2, 0)], h[(2, 1)], h[(2, 2)]);
    #[rustfmt::skip]
    let horn = Matrix4::new(
        xx + yy + zz, yz - zy,      zx - xz,       xy - yx,
        yz - zy,      xx - yy - zz, xy + yx,       zx + xz,
        zx - xz,      xy + yx,      -xx + yy - zz, yz + zy,
        xy - yx,      zx + xz,      yz + zy,       -xx - yy + zz,
    );
    // Shifted, so that the largest eigenvalue is the largest in size too.
    let size = horn.norm();
    if !(size > 0.0 && size.is_finite()) {
        return None;
    }
    let mut power = horn / size + Matrix4::identity();
    for _ in 0..SQUARINGS {
        power = power * power;
        power /= power.norm();
    }
    let v = power
        .column(power.column_iter().map(|c| c.norm_squared()).enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?.0)
        .normalize();
    let (w, x, y, z) = (v[0], v[1], v[2], v[3]);
    #[rustfmt::skip]
    let rotation = Matrix3::new(
        w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z,
    );
    Some(rotation)
}

/// The eigenvalue's share grows to its 2¹⁰th power.
const SQUARINGS: usize = 10;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::So3;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    /// A hundred and twenty matches say one pose, a hundred and five the next bay: both must be found, though the pairs
    /// of the first alone are more than are tried.
    #[test]
    fn many_matches_of_one_pose_do_not_hide_another() {
        let mut dice = ChaCha8Rng::seed_from_u64(4);
        let mut vector = |half: f64| Vector3::from_fn(|_, _| dice.random_range(-half..half));
        let (mut theirs, mut mine) = (Cloud::default(), Cloud::default());
        let rotation = So3::exp(&Vector3::new(0.2, -0.4, 1.1)).matrix();
        let bays = [0.0, 25.0].map(|along| Pose { rotation, translation: Vector3::new(along, 3.0, -2.0) });
        let mut matches = Vec::new();
        for (bay, count) in bays.iter().zip([120, 105]) {
            for _ in 0..count {
                let (point, normal) = (vector(30.0), vector(1.0).normalize());
                let k = theirs.points.len() as u32;
                matches.push(Pairing { distance: 0, their: k, my: k });
                theirs.points.push(point);
                theirs.normals.push(normal);
                mine.points.push(bay.apply(&point));
                mine.normals.push(rotation * normal);
            }
        }
        let found = hypotheses(&theirs, &mine, &matches, POSES_MAX);
        for bay in &bays {
            assert!(found.iter().any(|pose| !pose.differs(bay, &Vector3::zeros(), 0.1, 0.01)), "{bay:?}");
        }
        assert!(found.len() <= POSES_MAX);
        assert!(hypotheses(&theirs, &mine, &[], POSES_MAX).is_empty());
    }
}

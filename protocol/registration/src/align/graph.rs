//! The matches of one search step in single precision, by axis, so that plain loops over 64 of them vectorise; which
//! pairs of them agree in length, as bitsets; and how well a motion explains them.

use super::prepare::Matches;
use super::refine::Context;
use super::solve::Motion;
use super::tally::{Tally, Worth};
use crate::simd::wide;
use nalgebra::Vector3;
use pulp::Arch;
use wide::i8x16;

/// Half the squared 99 % quantile of χ₃.
const EXPONENT_GATE: f32 = 0.5 * 3.368_2 * 3.368_2;

/// Matches of a pool, in a unit in which coordinates are near 1, so that f32 neither overflows nor loses the tolerance.
#[derive(Debug, Default)]
pub(super) struct Cloud {
    pub count: usize,
    /// 64-match words.
    pub words: usize,
    /// Target and source length units.
    pub unit: f64,
    pub source_unit: f64,
    /// Padded with NaN to whole words: NaN agrees with nothing.
    pub source: [Vec<f32>; 3],
    pub target: [Vec<f32>; 3],
    /// Squared residuals of the motion looked at last, in squared units.
    squared: Vec<f32>,
}

impl Cloud {
    /// Replaces the matches by those in `pool`.
    pub fn load(&mut self, context: &Context, pool: &[u32], sigma: f64) {
        let matches: &Matches = context.matches;
        self.count = pool.len();
        self.words = pool.len().div_ceil(64);
        self.unit = matches.target_extent.iter().fold(sigma, |m, &l| m.max(l));
        self.source_unit = self.unit / (context.scale_range.0 * context.scale_range.1).sqrt();
        let padded = self.words * 64;
        let fill = |column: &mut Vec<f32>, points: &[Vector3<f64>], axis: usize, factor: f64| {
            column.clear();
            column.extend(pool.iter().map(|&i| (points[i as usize][axis] * factor) as f32));
            column.resize(padded, f32::NAN);
        };
        for axis in 0..3 {
            fill(&mut self.source[axis], &matches.source, axis, 1.0 / self.source_unit);
            fill(&mut self.target[axis], &matches.target, axis, 1.0 / self.unit);
        }
        self.squared.clear();
        self.squared.resize(padded, 0.0);
    }

    /// What a motion is worth.
    pub fn worth(&mut self, arch: Arch, context: &Context, motion: &Motion, tally: &mut Tally) -> Worth {
        self.measure(arch, motion);
        let limit = Tally::limit(context, motion.residual_unit(), self.unit);
        let squared = &self.squared;
        wide(
            arch,
            #[inline(always)]
            || {
                tally.clear();
                for block in squared.as_chunks::<64>().0 {
                    let mut rest = below(block, limit);
                    while rest != 0 {
                        tally.add(block[rest.trailing_zeros() as usize]);
                        rest &= rest - 1;
                    }
                }
            },
        );
        tally.worth()
    }

    /// The weights e^{−r²/2σ²} of the matches within 3.4 σ, σ in target units.
    pub fn weights(&mut self, arch: Arch, motion: &Motion, sigma: f64, out: &mut Vec<f64>) {
        self.measure(arch, motion);
        let sigma = sigma / self.unit;
        let inverse = (0.5 / (sigma * sigma)) as f32;
        let weight = |&r2: &f32| {
            let x = r2 * inverse;
            if x < EXPONENT_GATE { f64::from(exp_negative(x)) } else { 0.0 }
        };
        out.clear();
        out.extend(self.squared[..self.count].iter().map(weight));
    }

    /// The matches within `reach` (target units), as a bitset.
    pub fn near(&mut self, arch: Arch, motion: &Motion, reach: f64, out: &mut Vec<u64>) {
        self.measure(arch, motion);
        let reach = reach / self.unit;
        let limit = (reach * reach) as f32;
        out.clear();
        out.extend(self.squared.as_chunks::<64>().0.iter().map(|block| below(block, limit)));
    }

    /// Fills `squared` with the residuals of a motion, NaN in the padding.
    fn measure(&mut self, arch: Arch, motion: &Motion) {
        let m = motion.rotation * (motion.scale * self.source_unit / self.unit);
        let m: [f32; 9] = core::array::from_fn(|k| m[(k / 3, k % 3)] as f32);
        let t: [f32; 3] = core::array::from_fn(|k| (motion.translation[k] / self.unit) as f32);
        let (source, target, squared) = (&self.source, &self.target, &mut self.squared);
        wide(
            arch,
            #[inline(always)]
            || {
                for (w, out) in squared.as_chunks_mut::<64>().0.iter_mut().enumerate() {
                    let (p, q) = (block(source, w * 64), block(target, w * 64));
                    for k in 0..64 {
                        let a = q[0][k] - (m[0] * p[0][k] + m[1] * p[1][k] + m[2] * p[2][k] + t[0]);
                        let b = q[1][k] - (m[3] * p[0][k] + m[4] * p[1][k] + m[5] * p[2][k] + t[1]);
                        let c = q[2][k] - (m[6] * p[0][k] + m[7] * p[1][k] + m[8] * p[2][k] + t[2]);
                        out[k] = a * a + b * b + c * c;
                    }
                }
            },
        );
    }
}

/// Which of 64 numbers are below a limit.
#[inline(always)]
fn below(block: &[f32; 64], limit: f32) -> u64 {
    let mut flags = [0_u8; 64];
    for k in 0..64 {
        flags[k] = u8::from(block[k] < limit);
    }
    pack(&flags)
}

/// Which pairs of matches agree: symmetric, without self-loops.
#[derive(Debug, Default)]
pub(super) struct Graph {
    pub count: usize,
    /// Words a row.
    pub words: usize,
    pub rows: Vec<u64>,
}

impl Graph {
    pub fn row(&self, i: usize) -> &[u64] {
        &self.rows[i * self.words..(i + 1) * self.words]
    }

    /// Without any edge.
    pub fn clear(&mut self, count: usize) {
        self.count = count;
        self.words = count.div_ceil(64);
        self.rows.clear();
        self.rows.resize(count * self.words, 0);
    }

    /// Adds an edge.
    #[inline(always)]
    pub fn connect(&mut self, i: usize, j: usize) {
        self.rows[i * self.words + j / 64] |= 1 << (j % 64);
        self.rows[j * self.words + i / 64] |= 1 << (i % 64);
    }

    /// Connects the pairs whose lengths agree within `tolerance` (cloud units) at scale `ratio`, and are that long.
    pub fn build_rigid(&mut self, arch: Arch, cloud: &Cloud, ratio: f32, tolerance: f32) {
        self.clear(cloud.count);
        wide(
            arch,
            #[inline(always)]
            || {
                for i in 0..cloud.count {
                    for w in i / 64..cloud.words {
                        let bits = rigid_word(cloud, i, w * 64, ratio, tolerance);
                        let above = if w == i / 64 { (u64::MAX << (i % 64)) & !(1 << (i % 64)) } else { u64::MAX };
                        let bits = bits & above;
                        self.rows[i * self.words + w] |= bits;
                        let mut rest = bits;
                        while rest != 0 {
                            let j = w * 64 + rest.trailing_zeros() as usize;
                            self.rows[j * self.words + i / 64] |= 1 << (i % 64);
                            rest &= rest - 1;
                        }
                    }
                }
            },
        );
    }
}

/// Bit k: whether match `i` and match `start + k` agree.
#[inline(always)]
fn rigid_word(cloud: &Cloud, i: usize, start: usize, ratio: f32, tolerance: f32) -> u64 {
    let (d, e) = lengths(cloud, i, start);
    let mut flags = [0_u8; 64];
    for k in 0..64 {
        let d = ratio * d[k];
        flags[k] = u8::from(((d - e[k]).abs() <= tolerance) & (d >= tolerance) & (e[k] >= tolerance));
    }
    pack(&flags)
}

/// Distances from match `i` to 64 matches from `start` on, in source and target.
#[inline(always)]
pub(super) fn lengths(cloud: &Cloud, i: usize, start: usize) -> ([f32; 64], [f32; 64]) {
    #[inline(always)]
    fn from(columns: &[Vec<f32>; 3], i: usize, start: usize) -> [f32; 64] {
        let [x, y, z] = block(columns, start);
        let p = [columns[0][i], columns[1][i], columns[2][i]];
        let mut out = [0.0; 64];
        for k in 0..64 {
            let (a, b, c) = (x[k] - p[0], y[k] - p[1], z[k] - p[2]);
            out[k] = (a * a + b * b + c * c).sqrt();
        }
        out
    }
    (from(&cloud.source, i, start), from(&cloud.target, i, start))
}

/// Bit k is set where byte k is not 0.
#[inline(always)]
pub(super) fn pack(flags: &[u8; 64]) -> u64 {
    let mut bits = 0;
    for (k, bytes) in flags.as_chunks::<16>().0.iter().enumerate() {
        let lanes = i8x16::from(bytes.map(|b| (b as i8).wrapping_neg()));
        bits |= u64::from(lanes.to_bitmask()) << (16 * k);
    }
    bits
}

/// Room that [`positions`] needs beyond the number of bits.
const POSITIONS_ROOM: usize = 72;

/// Writes the positions of the bits set (after `after`) to the beginning of `out`, which has room for all bits and
/// [`POSITIONS_ROOM`]; returns their number. Eight a time, so that the processor need not guess how many are in a word.
#[inline(always)]
pub(super) fn positions(words: &[u64], after: Option<usize>, out: &mut Vec<u32>) -> usize {
    if out.len() < words.len() * 64 + POSITIONS_ROOM {
        out.resize(words.len() * 64 + POSITIONS_ROOM, 0);
    }
    let mut len = 0;
    for (w, &word) in words.iter().enumerate().skip(after.map_or(0, |k| k / 64)) {
        let mut rest = word;
        if let Some(after) = after
            && w == after / 64
        {
            rest &= !(u64::MAX >> (63 - after % 64));
        }
        let count = rest.count_ones() as usize;
        let Some(slots) = out[len..].first_chunk_mut::<POSITIONS_ROOM>() else { break };
        let mut done = 0;
        while done < count {
            for slot in &mut slots[done..done + 8] {
                *slot = w as u32 * 64 + rest.trailing_zeros();
                rest &= rest.wrapping_sub(1);
            }
            done += 8;
        }
        len += count;
    }
    len
}

/// Number of common bits.
#[inline(always)]
pub(super) fn common(a: &[u64], b: &[u64]) -> u32 {
    let (mut total, (a, a_rest), (b, b_rest)) = (0_u64, a.as_chunks::<4>(), b.as_chunks::<4>());
    // Without iterator adapters, which are not always inlined and then lose the wide instructions.
    for k in 0..a.len().min(b.len()) {
        for l in 0..4 {
            total += u64::from((a[k][l] & b[k][l]).count_ones());
        }
    }
    for k in 0..a_rest.len().min(b_rest.len()) {
        total += u64::from((a_rest[k] & b_rest[k]).count_ones());
    }
    total as u32
}

/// 64 points from `start` on, by axis.
#[inline(always)]
fn block(columns: &[Vec<f32>; 3], start: usize) -> [&[f32; 64]; 3] {
    const EMPTY: [f32; 64] = [f32::NAN; 64];
    columns.each_ref().map(|column| column[start..].first_chunk().unwrap_or(&EMPTY))
}

/// e^{−x} for 0 ≤ x ≤ [`EXPONENT_GATE`] within 1e-4 of the value: the Taylor polynomial of e^{−x/8}, to the eighth
/// power.
#[inline(always)]
fn exp_negative(x: f32) -> f32 {
    let y = x * 0.125;
    let tail = 1.0 - y / 5.0 * (1.0 - y / 6.0 * (1.0 - y / 7.0));
    let p = 1.0 - y * (1.0 - y / 2.0 * (1.0 - y / 3.0 * (1.0 - y / 4.0 * tail)));
    let p2 = p * p;
    let p4 = p2 * p2;
    p4 * p4
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_prescores_exponential_is_as_good_as_it_says() {
        for k in 0..=1000 {
            let x = EXPONENT_GATE * k as f32 / 1000.0;
            let exact = libm::exp(-f64::from(x));
            assert!((f64::from(exp_negative(x)) / exact - 1.0).abs() < 1e-4, "{x}");
        }
    }

    #[test]
    fn positions_are_those_of_the_bits() {
        let words = [0x8000_0000_0000_0001, 0, 6, u64::MAX];
        let mut out = Vec::new();
        for (after, expected) in [(0, vec![63, 129, 130]), (62, vec![63, 129, 130]), (63, vec![129, 130])] {
            let len = positions(&words, Some(after), &mut out);
            assert_eq!(out[..expected.len()], expected[..]);
            assert_eq!(out[expected.len()..len], (192..256).collect::<Vec<_>>()[..]);
        }
        assert_eq!(positions(&words, None, &mut out), 68);
        assert_eq!(positions(&words, Some(255), &mut out), 0);
    }

    #[test]
    fn flags_become_bits_in_order() {
        for k in 0..64 {
            let mut flags = [0; 64];
            flags[k] = 1;
            assert_eq!(pack(&flags), 1 << k);
        }
        let mut flags = [1; 64];
        flags[17] = 0;
        assert_eq!(pack(&flags), !(1 << 17));
    }
}

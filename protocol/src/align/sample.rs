//! Hypotheses from triangles of matches whose edge lengths agree.
//!
//! A rigid motion keeps lengths, so true matches are mutually compatible: they form a dense part of the compatibility
//! graph, kept as bitsets. Edges are ranked by their common neighbours, triangles by theirs, so that even ten true among a
//! thousand matches are among the first hypotheses. For SIM(3) the graph is built per narrow range of scale. Each
//! hypothesis is scored by the MAGSAC++ loss in closed form (n = 3: 1 − e^{−x} − c x), improved by two reweighted solves,
//! and triangles that a kept hypothesis explains are skipped: the candidates are distinct.

use super::prepare::Matches;
use super::refine::Context;
use super::solve::{self, Motion};
use core::cmp::Reverse;
use libm::exp;
use nalgebra::Vector3;

/// Edges whose common neighbours are counted, at most, in all graphs of a step; beyond, an even selection.
const EDGES_MAX: usize = 65_536;
/// ...and in each of them at least.
const EDGES_MIN: usize = 8_192;
/// Edges expanded to triangles, in all graphs of a step.
const EDGES_EXPANDED: usize = 256;
/// ...and at least, in each of them.
const EDGES_EXPANDED_MIN: usize = 32;
/// Triangles kept per expanded edge.
const TRIANGLES_PER_EDGE: usize = 3;
/// Candidates kept.
pub(super) const CANDIDATES_MAX: usize = 6;
/// Half the squared 99 % quantile of χ₃.
const EXPONENT_GATE: f64 = 0.5 * 3.368_2 * 3.368_2;
/// Edge lengths may differ by this many √2 σ.
const LENGTH_GATE: f64 = 2.0;
/// A triangle's height over its longest edge, in σ, from which its motion is worth something.
const HEIGHT_MIN: f64 = 3.0;
/// A hypothesis is improved if it scores this share of the best raw score so far.
const RAW_SHARE: f64 = 0.75;
/// A triangle is tried while at least this share of the best candidate's matches would agree with it: a structure of
/// comparable size has such triangles.
const COMMON_SHARE: f64 = 0.35;
/// Ratio of the largest to the smallest scale of one graph.
const SCALE_STEP: f64 = 1.1;

/// One search step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    /// Noise scale assumed, target units.
    pub sigma: f64,
    /// Hypotheses scored at most.
    pub hypotheses_max: usize,
}

/// A motion worth a full evaluation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    pub motion: Motion,
    pub score: f64,
}

/// Buffers reused over steps.
#[derive(Debug, Default)]
pub(super) struct Sampler {
    graph: Graph,
    edges: Vec<Edge>,
    triangles: Vec<Triangle>,
    common: Vec<u64>,
    source: Vec<Vector3<f64>>,
    target: Vec<Vector3<f64>>,
    weights: Vec<f64>,
    /// What each candidate explains, as bitsets over the pool.
    explained: Vec<Vec<u64>>,
}

/// Ordered by most common neighbours.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Edge {
    common: Reverse<u32>,
    i: u32,
    j: u32,
}

/// Ordered by how surprising its common neighbours are in its graph.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Triangle {
    surprise: Reverse<u32>,
    common: Reverse<u32>,
    vertices: [u32; 3],
}

impl Sampler {
    /// The best distinct motions of the matches in `pool`, best first.
    pub fn propose(&mut self, context: &Context, pool: &[u32], step: &Step, out: &mut Vec<Candidate>) {
        out.clear();
        self.source.clear();
        self.source.extend(pool.iter().map(|&i| context.matches.source[i as usize]));
        self.target.clear();
        self.target.extend(pool.iter().map(|&i| context.matches.target[i as usize]));
        self.triangles.clear();
        self.graph.load(context, pool, step.sigma);
        let graphs = scale_steps(context.scale_range);
        for k in 0..graphs {
            self.graph.build(scale_step(context.scale_range, k, graphs), step.sigma);
            self.rank_edges((EDGES_MAX / graphs).max(EDGES_MIN), (EDGES_EXPANDED / graphs).max(EDGES_EXPANDED_MIN));
            self.expand_edges();
        }
        self.triangles.sort_unstable();
        self.triangles.dedup();
        self.try_triangles(context, step, true, out);
        if out.is_empty() {
            self.try_triangles(context, step, false, out);
        }
        out.sort_by(|a, b| b.score.total_cmp(&a.score));
    }

    /// The edges with the most common neighbours.
    fn rank_edges(&mut self, edges_max: usize, expanded: usize) {
        let graph = &self.graph;
        let degree_sum: usize = graph.rows.iter().map(|w| w.count_ones() as usize).sum();
        let stride = (degree_sum / 2).div_ceil(edges_max.max(1)).max(1);
        self.edges.clear();
        let mut skip = 0;
        for i in 0..graph.count {
            let row = graph.row(i);
            for j in ones(row, i + 1) {
                skip += 1;
                if skip < stride {
                    continue;
                }
                skip = 0;
                let common = row.iter().zip(graph.row(j)).map(|(a, b)| (a & b).count_ones()).sum();
                if common > 0 {
                    self.edges.push(Edge { common: Reverse(common), i: i as u32, j: j as u32 });
                }
            }
        }
        if self.edges.len() > expanded {
            self.edges.select_nth_unstable(expanded);
            self.edges.truncate(expanded);
        }
    }

    /// Adds the best triangles of each ranked edge.
    fn expand_edges(&mut self) {
        let graph = &self.graph;
        let expected = graph.count as f64 * graph.density().powi(3);
        for edge in &self.edges {
            let (i, j) = (edge.i as usize, edge.j as usize);
            self.common.clear();
            self.common.extend(graph.row(i).iter().zip(graph.row(j)).map(|(a, b)| a & b));
            let first = self.triangles.len();
            for k in ones(&self.common, 0) {
                let common: u32 = self.common.iter().zip(graph.row(k)).map(|(a, b)| (a & b).count_ones()).sum();
                let mut vertices = [edge.i, edge.j, k as u32];
                vertices.sort_unstable();
                let surprise = Reverse(surprise(common, expected));
                let triangle = Triangle { surprise, common: Reverse(common), vertices };
                if self.triangles.len() - first < TRIANGLES_PER_EDGE {
                    self.triangles.push(triangle);
                } else if let Some(worst) = self.triangles[first..].iter_mut().max()
                    && triangle < *worst
                {
                    *worst = triangle;
                }
            }
        }
    }

    /// Turns triangles, most supported first, into distinct candidates.
    fn try_triangles(&mut self, context: &Context, step: &Step, fat: bool, out: &mut Vec<Candidate>) {
        self.explained.clear();
        let (mut tried, mut best_raw, mut best) = (0, 0.0_f64, 0.0_f64);
        for t in 0..self.triangles.len() {
            let triangle = self.triangles[t];
            if tried >= step.hypotheses_max {
                break;
            }
            if f64::from(triangle.common.0) < COMMON_SHARE * best - 3.0 {
                continue;
            }
            let v = triangle.vertices.map(|k| k as usize);
            if self.explained.iter().any(|set| v.iter().all(|&k| set[k / 64] >> (k % 64) & 1 == 1)) {
                continue;
            }
            let Some(motion) = self.minimal(context, step, v, fat) else { continue };
            tried += 1;
            let score = self.graph.score(&motion, step.sigma);
            best_raw = best_raw.max(score);
            if score < RAW_SHARE * best_raw {
                continue;
            }
            let (motion, score) = self.improve(context, step, motion, score);
            let full = out.len() == CANDIDATES_MAX;
            if !full || out.iter().any(|c| c.score < score) {
                best = best.max(score);
                self.keep(Candidate { motion, score }, step.sigma, out);
            }
        }
    }

    /// The motion of one triangle, if its shape determines one within the scale range.
    fn minimal(&self, context: &Context, step: &Step, v: [usize; 3], fat: bool) -> Option<Motion> {
        let (p, q) = (v.map(|k| &self.source[k]), v.map(|k| &self.target[k]));
        let thin = height(q) < HEIGHT_MIN * step.sigma;
        if thin == fat {
            return None;
        }
        let motion = if fat {
            solve::triangle(p, q, context.with_scale)?
        } else {
            solve::weighted(&p.map(|x| *x), &q.map(|x| *x), &[1.0; 3], context.with_scale)?
        };
        let (low, high) = context.scale_range;
        let gate = 3.0 * step.sigma;
        let fits = (0..3).all(|k| (q[k] - motion.apply(p[k])).norm_squared() <= gate * gate);
        (fits && (low..=high).contains(&motion.scale)).then_some(motion)
    }

    /// Two reweighted solves over the pool; kept while the score grows.
    fn improve(&mut self, context: &Context, step: &Step, motion: Motion, score: f64) -> (Motion, f64) {
        let mut best = (motion, score);
        for _ in 0..2 {
            self.graph.weights(&best.0, step.sigma, &mut self.weights);
            let Some(motion) = solve::weighted(&self.source, &self.target, &self.weights, context.with_scale) else {
                break;
            };
            if !(context.scale_range.0..=context.scale_range.1).contains(&motion.scale) {
                break;
            }
            let score = self.graph.score(&motion, step.sigma);
            if score <= best.1 {
                break;
            }
            best = (motion, score);
        }
        best
    }

    /// Keeps a candidate, in place of the worst if full, and what it explains.
    fn keep(&mut self, candidate: Candidate, sigma: f64, out: &mut Vec<Candidate>) {
        let slot = if out.len() < CANDIDATES_MAX {
            out.push(candidate);
            self.explained.push(Vec::new());
            out.len() - 1
        } else {
            let worst = (1..out.len()).fold(0, |w, k| if out[k].score < out[w].score { k } else { w });
            out[worst] = candidate;
            worst
        };
        let set = &mut self.explained[slot];
        set.clear();
        set.resize(self.graph.words, 0);
        self.graph.for_each_near(&candidate.motion, sigma, 4.5, |k, _| set[k / 64] |= 1 << (k % 64));
    }
}

/// −1000 ln of the Poisson tail's leading term: how unlikely so many common neighbours are where `expected` are.
fn surprise(common: u32, expected: f64) -> u32 {
    let (count, expected) = (f64::from(common), expected.max(0.05));
    if count > expected { (1000.0 * (count * libm::log(count / expected) - count + expected)) as u32 } else { 0 }
}

/// Graphs needed to cover a range of scales.
fn scale_steps((low, high): (f64, f64)) -> usize {
    (libm::log(high / low) / libm::log(SCALE_STEP)).ceil().max(1.0) as usize
}

/// The k-th of `count` equal steps of a range of scales.
fn scale_step((low, high): (f64, f64), k: usize, count: usize) -> (f64, f64) {
    let at = |k: usize| low * libm::pow(high / low, k as f64 / count as f64);
    (at(k), at(k + 1))
}

/// Height of a triangle over its longest edge.
fn height(q: [&Vector3<f64>; 3]) -> f64 {
    let area2 = (q[1] - q[0]).cross(&(q[2] - q[0])).norm();
    let longest = (q[1] - q[0]).norm().max((q[2] - q[0]).norm()).max((q[2] - q[1]).norm());
    if longest > 0.0 { area2 / longest } else { 0.0 }
}

/// Positions of set bits from `from` on.
fn ones(words: &[u64], from: usize) -> impl Iterator<Item = usize> {
    let first = from / 64;
    words.iter().enumerate().skip(first).flat_map(move |(w, &bits)| {
        let mut bits = if w == first { bits & (u64::MAX << (from % 64)) } else { bits };
        core::iter::from_fn(move || {
            let k = bits.trailing_zeros() as usize;
            bits &= bits.wrapping_sub(1);
            (k < 64).then_some(w * 64 + k)
        })
    })
}

/// The pool's points in single precision, by axis, and which pairs of matches agree in length.
#[derive(Debug, Default)]
struct Graph {
    count: usize,
    /// Words a row.
    words: usize,
    rows: Vec<u64>,
    /// Unit of the coordinates below: they are near 1, so that f32 neither overflows nor loses the tolerance.
    unit: f64,
    source_unit: f64,
    /// Padded with NaN to whole words: NaN agrees with nothing.
    source: [Vec<f32>; 3],
    target: [Vec<f32>; 3],
}

impl Graph {
    fn row(&self, i: usize) -> &[u64] {
        &self.rows[i * self.words..(i + 1) * self.words]
    }

    /// Share of pairs that are connected.
    fn density(&self) -> f64 {
        let n = self.count as f64;
        let ends: usize = self.rows.iter().map(|w| w.count_ones() as usize).sum();
        ends as f64 / (n * (n - 1.0)).max(1.0)
    }

    fn load(&mut self, context: &Context, pool: &[u32], sigma: f64) {
        let matches: &Matches = context.matches;
        self.count = pool.len();
        self.words = pool.len().div_ceil(64);
        self.unit = matches.target_extent.iter().fold(sigma, |m, &l| m.max(l));
        self.source_unit = self.unit / (context.scale_range.0 * context.scale_range.1).sqrt();
        let fill = |column: &mut Vec<f32>, points: &[Vector3<f64>], axis: usize, factor: f64| {
            column.clear();
            column.extend(pool.iter().map(|&i| (points[i as usize][axis] * factor) as f32));
            column.resize(pool.len().div_ceil(64) * 64, f32::NAN);
        };
        for axis in 0..3 {
            fill(&mut self.source[axis], &matches.source, axis, 1.0 / self.source_unit);
            fill(&mut self.target[axis], &matches.target, axis, 1.0 / self.unit);
        }
    }

    /// Connects the pairs whose lengths agree at some scale in `scale`.
    fn build(&mut self, scale: (f64, f64), sigma: f64) {
        let tolerance = (LENGTH_GATE * core::f64::consts::SQRT_2 * sigma / self.unit) as f32;
        let ratio = self.source_unit / self.unit;
        let (low, high) = ((scale.0 * ratio) as f32, (scale.1 * ratio) as f32);
        self.rows.clear();
        self.rows.resize(self.count * self.words, 0);
        for i in 0..self.count {
            for w in i / 64..self.words {
                let bits = self.compatible(i, w * 64, low, high, tolerance);
                let bits = if w == i / 64 { bits & (u64::MAX << (i % 64)) & !(1 << (i % 64)) } else { bits };
                self.rows[i * self.words + w] |= bits;
                let mut rest = bits;
                while rest != 0 {
                    let j = w * 64 + rest.trailing_zeros() as usize;
                    self.rows[j * self.words + i / 64] |= 1 << (i % 64);
                    rest &= rest - 1;
                }
            }
        }
    }

    /// Bit k: whether match `i` and match `start + k` agree: `low·d − τ ≤ e ≤ high·d + τ` for source length d and target
    /// length e, both at least τ (in target units).
    fn compatible(&self, i: usize, start: usize, low: f32, high: f32, tolerance: f32) -> u64 {
        let (s, t) = (block(&self.source, start), block(&self.target, start));
        let p = [self.source[0][i], self.source[1][i], self.source[2][i]];
        let q = [self.target[0][i], self.target[1][i], self.target[2][i]];
        let mut flags = [0_u8; 64];
        for k in 0..64 {
            let (a, b, c) = (s[0][k] - p[0], s[1][k] - p[1], s[2][k] - p[2]);
            let d = (a * a + b * b + c * c).sqrt();
            let (a, b, c) = (t[0][k] - q[0], t[1][k] - q[1], t[2][k] - q[2]);
            let e = (a * a + b * b + c * c).sqrt();
            let long = (high * d >= tolerance) & (e >= tolerance);
            flags[k] = u8::from((low * d - tolerance <= e) & (e <= high * d + tolerance) & long);
        }
        // Eight 0/1 bytes to eight bits at a time.
        let mut bits = 0;
        for (k, bytes) in flags.chunks_exact(8).enumerate() {
            let word = bytes.iter().rev().fold(0_u64, |w, &b| w << 8 | u64::from(b));
            bits |= (word.wrapping_mul(0x0102_0408_1020_4080) >> 56) << (8 * k);
        }
        bits
    }

    /// MAGSAC++ gain of the pool at this σ: 1 for a perfect match, 0 beyond the 99 % quantile.
    fn score(&self, motion: &Motion, sigma: f64) -> f64 {
        let edge = exp(-EXPONENT_GATE);
        let full = 1.0 - edge - edge * EXPONENT_GATE;
        let mut score = 0.0;
        self.for_each_near(motion, sigma, EXPONENT_GATE, |_, x| score += full - (1.0 - exp(-x) - edge * x));
        score
    }

    /// e^{−x} where it counts, x = r²/2σ².
    fn weights(&self, motion: &Motion, sigma: f64, out: &mut Vec<f64>) {
        out.clear();
        out.resize(self.count, 0.0);
        self.for_each_near(motion, sigma, EXPONENT_GATE, |k, x| out[k] = exp(-x));
    }

    /// Calls `f(k, x)` for each match with x = r²/2σ² below `gate`, in order; r in units of the residual unit.
    fn for_each_near(&self, motion: &Motion, sigma: f64, gate: f64, mut f: impl FnMut(usize, f64)) {
        let m = motion.rotation * (motion.scale * self.source_unit / self.unit);
        let m: [f32; 9] = core::array::from_fn(|k| m[(k / 3, k % 3)] as f32);
        let t: [f32; 3] = core::array::from_fn(|k| (motion.translation[k] / self.unit) as f32);
        let sigma = sigma * motion.residual_unit() / self.unit;
        let inverse = 0.5 / (sigma * sigma);
        let limit = (gate / inverse) as f32;
        for w in 0..self.words {
            let (p, q) = (block(&self.source, w * 64), block(&self.target, w * 64));
            let mut squared = [0.0_f32; 64];
            for k in 0..64 {
                let a = q[0][k] - (m[0] * p[0][k] + m[1] * p[1][k] + m[2] * p[2][k] + t[0]);
                let b = q[1][k] - (m[3] * p[0][k] + m[4] * p[1][k] + m[5] * p[2][k] + t[1]);
                let c = q[2][k] - (m[6] * p[0][k] + m[7] * p[1][k] + m[8] * p[2][k] + t[2]);
                squared[k] = a * a + b * b + c * c;
            }
            for (k, &r2) in squared.iter().enumerate() {
                if r2 < limit {
                    f(w * 64 + k, f64::from(r2) * inverse);
                }
            }
        }
    }
}

/// 64 points from `start` on, by axis.
fn block(columns: &[Vec<f32>; 3], start: usize) -> [&[f32; 64]; 3] {
    const EMPTY: [f32; 64] = [f32::NAN; 64];
    columns.each_ref().map(|column| column[start..].first_chunk().unwrap_or(&EMPTY))
}

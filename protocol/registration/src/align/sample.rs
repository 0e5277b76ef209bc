//! Hypotheses from triangles of matches whose edge lengths agree.
//!
//! A rigid motion keeps lengths, so true matches are mutually compatible: they form a dense part of the compatibility
//! graph, kept as bitsets. Edges whose ends have no more common neighbours than chance gives are dropped, and the
//! common neighbours of the rest counted again among the rest: even ten true among a thousand matches then stand alone.
//! For SIM(3) there is a graph per narrow bin of scale ([`super::scales`]), too dense for that; there whole bundles of
//! matches that agree about a pair take the place of triangles ([`super::turns`]). Each motion is worth its own number
//! of false alarms ([`super::tally`]), is improved by reweighted solves, and spares the triangles it explains:
//! candidates are distinct.

use super::graph::{Cloud, Graph, common, positions};
use super::refine::Context;
use super::scales::{Scales, Vote};
use super::solve::{self, Motion};
use super::tally::{Tally, Worth};
use super::turns::{self, Noise, Turns};
use crate::simd::wide;
use core::cmp::Reverse;
use nalgebra::Vector3;
use pulp::Arch;

/// Edges whose common neighbours are counted, at most, in one graph; beyond, an even selection.
const EDGES_MAX: usize = 262_144;
/// An edge is kept if its ends have this many standard deviations more common neighbours than their degrees explain, or
/// if they share most: where nearly all matches are true, degrees explain everything.
const EXCESS_MIN: f32 = 1.0;
/// Edges expanded to triangles, at most and at least. Where the ends of the best share more than [`DENSE`] of all
/// matches, nearly all good edges are of one structure, and fewer serve.
const EDGES_EXPANDED: [usize; 2] = [256, 24];
/// See [`EDGES_EXPANDED`].
const DENSE: f64 = 0.06;
/// Triangles kept per expanded edge.
const TRIANGLES_PER_EDGE: usize = 3;
/// Third vertices tried per expanded edge; beyond, an even selection.
const THIRDS_MAX: usize = 16;
/// Candidates kept.
pub(super) const CANDIDATES_MAX: usize = 6;
/// Edge lengths may differ by this many √2 σ.
const LENGTH_GATE: f64 = 2.0;
/// A triangle's height over its longest edge, in σ, from which its motion is worth something.
const HEIGHT_MIN: f64 = 3.0;
/// Members of a bundle farther than so many σ from its motion are dropped,
const TRIM_GATE: f64 = 4.0;
/// unless the mean squared distance is this much larger yet: then its motion is still too far off to tell.
const TRIM_SHARE: f64 = 0.5;
/// Times that is done.
const TRIMS: usize = 3;
/// A hypothesis is improved if its NFA is within this factor (ln) of the best raw one so far.
const RAW_MARGIN: f64 = 7.0;
/// Reweighted solves of a hypothesis, at most.
const IMPROVEMENTS: usize = 4;
/// A triangle is tried while at least this share of the best candidate's matches would agree with it: a structure of
/// comparable size has such triangles.
const COMMON_SHARE: f64 = 0.35;
/// A match within so many times a candidate's radius is explained by it.
const EXPLAINED: f64 = 1.25;
/// A consensus' radius is about so many σ.
const RADIUS: f64 = 2.0;

/// One search step.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    /// Noise scale assumed, target units.
    pub sigma: f64,
    /// Scales looked for.
    pub scales: (f64, f64),
    /// Hypotheses scored at most.
    pub hypotheses_max: usize,
}

/// A motion worth a full evaluation.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate {
    pub motion: Motion,
    pub worth: Worth,
}

/// Buffers reused over steps.
#[derive(Debug)]
pub(super) struct Sampler {
    arch: Arch,
    cloud: Cloud,
    tally: Tally,
    scales: Scales,
    turns: Turns,
    /// The pairs that bundles are sought about.
    seeds: Graph,
    graph: Graph,
    /// The edges of `graph` with more common neighbours than chance gives.
    kept: Graph,
    degrees: Vec<u32>,
    neighbours: Vec<u32>,
    edges: Vec<Edge>,
    triangles: Vec<Triangle>,
    common: Vec<u64>,
    shared: Vec<u64>,
    source: Vec<Vector3<f64>>,
    target: Vec<Vector3<f64>>,
    weights: Vec<f64>,
    /// What each candidate explains, as bitsets over the pool.
    explained: Vec<Vec<u64>>,
}

/// Ordered by most common neighbours among kept edges, then among all.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Edge {
    kept: Reverse<u32>,
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

/// What was tried so far.
#[derive(Clone, Copy, Debug)]
struct Race {
    tried: usize,
    best_raw: f64,
    best: Worth,
}

impl Default for Race {
    fn default() -> Self {
        Self { tried: 0, best_raw: f64::NEG_INFINITY, best: Worth::default() }
    }
}

impl Default for Sampler {
    fn default() -> Self {
        Self {
            arch: Arch::new(),
            cloud: Cloud::default(),
            tally: Tally::default(),
            scales: Scales::default(),
            turns: Turns::default(),
            seeds: Graph::default(),
            graph: Graph::default(),
            kept: Graph::default(),
            degrees: Vec::new(),
            neighbours: Vec::new(),
            edges: Vec::new(),
            triangles: Vec::new(),
            common: Vec::new(),
            shared: Vec::new(),
            source: Vec::new(),
            target: Vec::new(),
            weights: Vec::new(),
            explained: Vec::new(),
        }
    }
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
        self.cloud.load(context, pool, step.sigma);
        self.tally.load(context, pool.len(), self.cloud.unit);
        let tolerance = LENGTH_GATE * core::f64::consts::SQRT_2 * step.sigma;
        if context.with_scale {
            let per_scale = tolerance * context.sigma_max / step.sigma;
            let vote = Vote { range: step.scales, tolerance, tolerance_per_scale: per_scale };
            self.scales.measure(self.arch, &self.cloud, &vote);
            self.find_bundles(context, step);
            self.try_bundles(context, step, out);
        } else {
            let ratio = self.cloud.source_unit / self.cloud.unit;
            let tolerance = tolerance / self.cloud.unit;
            self.graph.build_rigid(self.arch, &self.cloud, ratio as f32, tolerance as f32);
            self.find_triangles();
            self.try_triangles(context, step, true, out);
            if out.is_empty() {
                self.try_triangles(context, step, false, out);
            }
        }
        out.sort_by(|a, b| b.worth.score.total_cmp(&a.worth.score));
    }

    /// The triangles of the graph's best edges, most surprising first.
    fn find_triangles(&mut self) {
        let arch = self.arch;
        wide(
            arch,
            #[inline(always)]
            || {
                self.keep_edges();
                self.rank_edges();
                self.expand_edges();
            },
        );
        self.triangles.sort_unstable();
        self.triangles.dedup();
    }

    /// The bundles of all scales, most surprising first.
    fn find_bundles(&mut self, context: &Context, step: &Step) {
        self.turns.clear();
        let noise = Noise {
            sigma: (step.sigma / self.cloud.unit) as f32,
            sigma_per_scale: (context.sigma_max / self.cloud.source_unit) as f32,
        };
        let bins = self.scales.bins();
        for bin in 0..bins {
            self.scales.build(self.arch, bin, self.cloud.count, &mut self.graph);
            self.scales.build_seeds(self.arch, bin, self.cloud.count, &mut self.seeds);
            let (cloud, turns, graph, seeds) = (&self.cloud, &mut self.turns, &self.graph, &self.seeds);
            wide(
                self.arch,
                #[inline(always)]
                || turns.find(cloud, noise, graph, seeds, Turns::pairs_of(bins)),
            );
        }
        self.turns.bundles.sort_unstable();
    }

    /// Keeps the edges whose ends have more common neighbours than chance gives.
    #[inline(always)]
    fn keep_edges(&mut self) {
        let graph = &self.graph;
        self.degrees.clear();
        for i in 0..graph.count {
            self.degrees.push(common(graph.row(i), graph.row(i)));
        }
        let edges = self.degrees.iter().map(|&d| d as usize).sum::<usize>() / 2;
        let stride = edges.div_ceil(EDGES_MAX).max(1);
        self.kept.clear(graph.count);
        self.edges.clear();
        let inverse = 1.0 / graph.count.max(1) as f32;
        let mut skip = 0;
        for i in 0..graph.count {
            let (row, share) = (graph.row(i), self.degrees[i] as f32 * inverse);
            let neighbours = positions(row, Some(i), &mut self.neighbours);
            while skip < neighbours {
                let j = self.neighbours[skip] as usize;
                skip += stride;
                let count = common(row, graph.row(j));
                let expected = share * self.degrees[j] as f32;
                let excess = count as f32 - expected;
                let clique = 2 * count > self.degrees[i].min(self.degrees[j]);
                if (excess * excess.abs() > EXCESS_MIN * EXCESS_MIN * (expected + 0.25)) | clique {
                    self.kept.connect(i, j);
                    self.edges.push(Edge { kept: Reverse(0), common: Reverse(count), i: i as u32, j: j as u32 });
                }
            }
            skip -= neighbours;
        }
    }

    /// The kept edges whose ends have the most common neighbours among kept edges.
    #[inline(always)]
    fn rank_edges(&mut self) {
        for edge in &mut self.edges {
            edge.kept = Reverse(common(self.kept.row(edge.i as usize), self.kept.row(edge.j as usize)));
        }
        self.edges.retain(|e| e.kept.0 > 0);
        let most = self.edges.iter().map(|e| e.kept.0).max().unwrap_or(0);
        let dense = f64::from(most) / (DENSE * self.graph.count.max(1) as f64);
        let [high, low] = EDGES_EXPANDED;
        let expanded = ((high as f64 / dense.max(1.0)) as usize).max(low);
        if self.edges.len() > expanded {
            self.edges.select_nth_unstable(expanded);
            self.edges.truncate(expanded);
        }
    }

    /// Adds the best triangles of each ranked edge.
    #[inline(always)]
    fn expand_edges(&mut self) {
        let graph = &self.graph;
        let inverse = 1.0 / (graph.count as f64 * graph.count as f64);
        for edge in &self.edges {
            let (i, j) = (edge.i as usize, edge.j as usize);
            self.common.clear();
            self.common.extend(graph.row(i).iter().zip(graph.row(j)).map(|(a, b)| a & b));
            let first = self.triangles.len();
            let expected = f64::from(self.degrees[i]) * f64::from(self.degrees[j]) * inverse;
            self.shared.clear();
            self.shared.extend_from_slice(self.kept.row(i));
            for (shared, word) in self.shared.iter_mut().zip(self.kept.row(j)) {
                *shared &= word;
            }
            let thirds = positions(&self.shared, None, &mut self.neighbours);
            for k in (0..thirds).step_by(thirds.div_ceil(THIRDS_MAX).max(1)) {
                let k = self.neighbours[k] as usize;
                let common = common(&self.common, graph.row(k));
                let mut vertices = [edge.i, edge.j, k as u32];
                vertices.sort_unstable();
                let surprise = Reverse(surprise(common, expected * f64::from(self.degrees[k])));
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
        let mut race = Race::default();
        for t in 0..self.triangles.len() {
            let triangle = self.triangles[t];
            if race.tried >= step.hypotheses_max {
                break;
            }
            if f64::from(triangle.common.0) < COMMON_SHARE * f64::from(race.best.count) - 3.0 {
                continue;
            }
            if self.explained.iter().any(|set| triangle.vertices.iter().all(|&k| holds(set, k))) {
                continue;
            }
            let v = triangle.vertices.map(|k| k as usize);
            let Some(motion) = self.minimal(context, step, v, fat) else { continue };
            self.try_motion(context, motion, &mut race, out);
        }
    }

    /// Turns bundles, most surprising first, into distinct candidates.
    fn try_bundles(&mut self, context: &Context, step: &Step, out: &mut Vec<Candidate>) {
        self.explained.clear();
        let mut race = Race::default();
        for b in 0..self.turns.bundles.len() {
            if race.tried >= step.hypotheses_max {
                break;
            }
            let members = self.turns.members(b);
            let (pair, thirds) = members.split_at(2);
            let explains = |set: &Vec<u64>| {
                pair.iter().all(|&k| holds(set, k))
                    && 2 * thirds.iter().filter(|&&k| holds(set, k)).count() >= thirds.len()
            };
            if self.explained.iter().any(explains) {
                continue;
            }
            let Some(motion) = self.shared_motion(context, step, b) else { continue };
            self.try_motion(context, motion, &mut race, out);
        }
    }

    /// Improves a motion that is worth it, and keeps it if it is among the best.
    fn try_motion(&mut self, context: &Context, motion: Motion, race: &mut Race, out: &mut Vec<Candidate>) {
        race.tried += 1;
        let worth = self.cloud.worth(self.arch, context, &motion, &mut self.tally);
        race.best_raw = race.best_raw.max(worth.score);
        if worth.score < race.best_raw - RAW_MARGIN {
            return;
        }
        let candidate = self.improve(context, Candidate { motion, worth }, &[1.0]);
        if !kept_by(out, &candidate, RAW_MARGIN) {
            return;
        }
        // A few true matches that chance ones have tilted are led out of that trap by a wider view.
        let candidate = self.improve(context, candidate, &[1.0, 2.0]);
        if !kept_by(out, &candidate, 0.0) {
            return;
        }
        if candidate.worth.score > race.best.score {
            race.best = candidate.worth;
        }
        self.keep(candidate, out);
    }

    /// The motion of most of a bundle, if its scale is in range.
    fn shared_motion(&self, context: &Context, step: &Step, bundle: usize) -> Option<Motion> {
        let members = self.turns.members(bundle);
        let (mut p, mut q) = ([Vector3::zeros(); turns::MEMBERS_MAX], [Vector3::zeros(); turns::MEMBERS_MAX]);
        for (k, &member) in members.iter().enumerate() {
            (p[k], q[k]) = (self.source[member as usize], self.target[member as usize]);
        }
        let (p, q) = (&p[..members.len()], &q[..members.len()]);
        let (mut weights, mut squared) = ([1.0; turns::MEMBERS_MAX], [0.0; turns::MEMBERS_MAX]);
        let (weights, squared) = (&mut weights[..members.len()], &mut squared[..members.len()]);
        let mut motion = solve::weighted(p, q, weights, true)?;
        let gate = TRIM_GATE * step.sigma * motion.residual_unit();
        for _ in 0..TRIMS {
            for k in 0..members.len() {
                squared[k] = (q[k] - motion.apply(&p[k])).norm_squared();
            }
            let mean = squared.iter().sum::<f64>() / weights.iter().sum::<f64>();
            let limit = (gate * gate).max(TRIM_SHARE * mean);
            let mut changed = false;
            for (weight, r2) in weights.iter_mut().zip(squared.iter()) {
                let kept = if *r2 > limit { 0.0 } else { 1.0 };
                changed |= kept != *weight;
                *weight = kept;
            }
            if !changed {
                break;
            }
            motion = solve::weighted(p, q, weights, true)?;
        }
        let (low, high) = context.scale_range;
        (low..=high).contains(&motion.scale).then_some(motion)
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

    /// Reweighted solves over the pool while the worth grows, at the first of these multiples of the consensus' radius
    /// at which it does.
    fn improve(&mut self, context: &Context, start: Candidate, multiples: &[f64]) -> Candidate {
        let mut best = start;
        for _ in 0..IMPROVEMENTS {
            let near = best.worth.radius / RADIUS;
            let Some(better) = multiples.iter().find_map(|m| self.resolve(context, &best, m * near)) else { break };
            best = better;
        }
        best
    }

    /// A solve with weights e^{−r²/2σ²}, if that is worth more.
    fn resolve(&mut self, context: &Context, from: &Candidate, sigma: f64) -> Option<Candidate> {
        self.cloud.weights(self.arch, &from.motion, sigma, &mut self.weights);
        let motion = solve::weighted(&self.source, &self.target, &self.weights, context.with_scale)?;
        if !(context.scale_range.0..=context.scale_range.1).contains(&motion.scale) {
            return None;
        }
        let worth = self.cloud.worth(self.arch, context, &motion, &mut self.tally);
        (worth.score > from.worth.score).then_some(Candidate { motion, worth })
    }

    /// Keeps a candidate, in place of the worst if full, and what it explains.
    fn keep(&mut self, candidate: Candidate, out: &mut Vec<Candidate>) {
        let slot = if out.len() < CANDIDATES_MAX {
            out.push(candidate);
            self.explained.push(Vec::new());
            out.len() - 1
        } else {
            let worst = (1..out.len()).fold(0, |w, k| if out[k].worth.score < out[w].worth.score { k } else { w });
            out[worst] = candidate;
            worst
        };
        let reach = EXPLAINED * candidate.worth.radius;
        self.cloud.near(self.arch, &candidate.motion, reach, &mut self.explained[slot]);
    }
}

/// Whether a bitset holds a number.
fn holds(set: &[u64], k: u32) -> bool {
    set[k as usize / 64] >> (k % 64) & 1 == 1
}

/// Whether a candidate is among the best, or would be with a score better by `margin`.
fn kept_by(out: &[Candidate], candidate: &Candidate, margin: f64) -> bool {
    out.len() < CANDIDATES_MAX || out.iter().any(|c| c.worth.score < candidate.worth.score + margin)
}

/// How unlikely so many common neighbours are where `expected` are: of two Poisson counts 1000 times the squared
/// difference after the square root has made their variances equal (a quarter), which is near enough −1000 ln of the
/// tail.
fn surprise(common: u32, expected: f64) -> u32 {
    let excess = f64::from(common).sqrt() - expected.max(0.05).sqrt();
    if excess > 0.0 { (4000.0 * excess * excess) as u32 } else { 0 }
}

/// Height of a triangle over its longest edge.
fn height(q: [&Vector3<f64>; 3]) -> f64 {
    let area2 = (q[1] - q[0]).cross(&(q[2] - q[0])).norm();
    let longest = (q[1] - q[0]).norm().max((q[2] - q[0]).norm()).max((q[2] - q[1]).norm());
    if longest > 0.0 { area2 / longest } else { 0.0 }
}

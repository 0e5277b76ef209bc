//! Hypotheses for a similarity: two matches, and the turn about the line through them on which others agree.
//!
//! Two matches fix a similarity up to that turn. A third one whose distances to both agree in scale fixes it, and true
//! ones fix the same turn, whereas chance ones fix any: a histogram of turns therefore tells a true pair from a chance
//! one long before any motion is solved for. It replaces the search for triangles where a graph of equal scales is too
//! dense to show cliques: a pair of lengths tells a scale only as well as a single coordinate, a match near a triangle
//! all three.

use super::graph::{Cloud, Graph, common, positions};
use core::cmp::Reverse;

/// Pairs of matches whose thirds are looked at, in all scale bins of a step,
const PAIRS: usize = 2048;
/// and at least, in each bin.
const PAIRS_MIN: usize = 32;
/// Their common neighbours exceed what their degrees explain by so many standard deviations.
const EXCESS_MIN: f32 = 1.0;
/// Thirds looked at per pair; beyond, an even selection.
const THIRDS_MAX: usize = 64;
/// Thirds a bundle holds at most, and at least.
const THIRDS_KEPT: usize = 16;
const THIRDS_MIN: usize = 2;
/// Matches in a bundle at most.
pub(super) const MEMBERS_MAX: usize = THIRDS_KEPT + 2;
/// Cells of the circle.
const CELLS: usize = 64;
/// A third votes for turns within so many σ over its distance from the line.
const TURN_GATE: f32 = 2.5;

/// Matches that agree on one similarity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) struct Bundle {
    /// How surprising the agreement is.
    surprise: Reverse<u32>,
    /// Where its members begin, and their number; the first two are the pair.
    first: u32,
    len: u32,
}

/// A pair of matches in a graph of equal scale.
#[derive(Clone, Copy, Debug)]
struct Pair {
    excess: f32,
    i: u32,
    j: u32,
}

/// The arc of cells that a third votes for.
#[derive(Clone, Copy, Debug, Default)]
struct Arc {
    first: u32,
    extent: u32,
}

/// Buffers reused over steps.
#[derive(Debug, Default)]
pub(super) struct Turns {
    pub bundles: Vec<Bundle>,
    members: Vec<u32>,
    degrees: Vec<u32>,
    neighbours: Vec<u32>,
    pairs: Vec<Pair>,
    shared: Vec<u64>,
    arcs: Vec<Arc>,
}

/// Half-widths of the votes in cloud units.
#[derive(Clone, Copy, Debug)]
pub(super) struct Noise {
    /// σ in the target,
    pub sigma: f32,
    /// but at most this times the scale.
    pub sigma_per_scale: f32,
}

impl Turns {
    /// Forgets all bundles.
    pub fn clear(&mut self) {
        self.bundles.clear();
        self.members.clear();
    }

    /// The matches of a bundle, the pair first.
    pub fn members(&self, bundle: usize) -> &[u32] {
        let bundle = self.bundles[bundle];
        &self.members[bundle.first as usize..(bundle.first + bundle.len) as usize]
    }

    /// Pairs looked at in each of so many bins.
    pub fn pairs_of(bins: usize) -> usize {
        (PAIRS / bins.max(1)).max(PAIRS_MIN)
    }

    /// Adds the bundles about the most promising `quota` of the pairs in `seeds`, whose neighbours are those of
    /// `graph`.
    #[inline(always)]
    pub fn find(&mut self, cloud: &Cloud, noise: Noise, graph: &Graph, seeds: &Graph, quota: usize) {
        self.rank_pairs(graph, seeds, quota);
        for k in 0..self.pairs.len() {
            self.bundle(cloud, noise, graph, self.pairs[k]);
        }
    }

    #[inline(always)]
    fn rank_pairs(&mut self, graph: &Graph, seeds: &Graph, quota: usize) {
        self.degrees.clear();
        for i in 0..graph.count {
            self.degrees.push(common(graph.row(i), graph.row(i)));
        }
        self.pairs.clear();
        let inverse = 1.0 / graph.count.max(1) as f32;
        for i in 0..graph.count {
            let (row, share) = (graph.row(i), self.degrees[i] as f32 * inverse);
            let partners = positions(seeds.row(i), Some(i), &mut self.neighbours);
            for &j in &self.neighbours[..partners] {
                let common = common(row, graph.row(j as usize));
                let expected = share * self.degrees[j as usize] as f32;
                let over = common as f32 - expected;
                let excess = over * over.abs() / (expected + 0.25);
                if excess > EXCESS_MIN * EXCESS_MIN {
                    self.pairs.push(Pair { excess, i: i as u32, j });
                }
            }
        }
        if self.pairs.len() > quota {
            let order = |a: &Pair, b: &Pair| b.excess.total_cmp(&a.excess).then_with(|| (a.i, a.j).cmp(&(b.i, b.j)));
            self.pairs.select_nth_unstable_by(quota, order);
            self.pairs.truncate(quota);
        }
    }

    /// Adds the bundle of a pair, if any.
    #[inline(always)]
    fn bundle(&mut self, cloud: &Cloud, noise: Noise, graph: &Graph, pair: Pair) {
        let (i, j) = (pair.i as usize, pair.j as usize);
        self.shared.clear();
        self.shared.extend(graph.row(i).iter().zip(graph.row(j)).map(|(a, b)| a & b));
        let thirds = positions(&self.shared, None, &mut self.neighbours);
        let stride = thirds.div_ceil(THIRDS_MAX).max(1);
        let Some(turn) = Turn::about(cloud, noise, i, j) else { return };
        let mut votes = [0_u32; CELLS];
        let mut total = 0;
        self.arcs.clear();
        for k in (0..thirds).step_by(stride) {
            let arc = turn.of(cloud, self.neighbours[k] as usize);
            for cell in 0..=arc.extent {
                votes[(arc.first + cell) as usize % CELLS] += 1;
            }
            total += arc.extent + 1;
            self.arcs.push(arc);
        }
        let mut peak = 0;
        for cell in 1..CELLS {
            if votes[cell] > votes[peak] {
                peak = cell;
            }
        }
        let agreeing = votes[peak] as usize;
        if agreeing < THIRDS_MIN {
            return;
        }
        let first = self.members.len();
        self.members.extend([pair.i, pair.j]);
        let every = agreeing.div_ceil(THIRDS_KEPT);
        let mut seen = 0;
        for (k, arc) in self.arcs.iter().enumerate() {
            if (peak as u32 + CELLS as u32 - arc.first) % CELLS as u32 <= arc.extent {
                if seen % every == 0 {
                    self.members.push(self.neighbours[k * stride]);
                }
                seen += 1;
            }
        }
        let surprise = surprise(agreeing as f32, total as f32 / CELLS as f32);
        self.bundles.push(Bundle {
            surprise: Reverse((1000.0 * surprise) as u32),
            first: first as u32,
            len: (self.members.len() - first) as u32,
        });
    }
}

/// The turn about the line through two matches.
#[derive(Clone, Copy, Debug)]
struct Turn {
    source: Frame,
    target: Frame,
    /// Half the width of a vote, times the distance from the line.
    reach: f32,
}

/// An origin and two unit vectors across a line through it.
#[derive(Clone, Copy, Debug)]
struct Frame {
    origin: [f32; 3],
    x: [f32; 3],
    y: [f32; 3],
}

impl Turn {
    /// `None` where the two are one point.
    #[inline(always)]
    fn about(cloud: &Cloud, noise: Noise, i: usize, j: usize) -> Option<Self> {
        let (source, d) = Frame::across(&cloud.source, i, j)?;
        let (target, e) = Frame::across(&cloud.target, i, j)?;
        let sigma = noise.sigma.min(noise.sigma_per_scale * e / d);
        Some(Self { source, target, reach: TURN_GATE * sigma })
    }

    /// The cells that a third match votes for.
    #[inline(always)]
    fn of(&self, cloud: &Cloud, k: usize) -> Arc {
        const QUARTER: f32 = (CELLS / 4) as f32;
        let ([a, b], [c, d]) = (self.source.across_of(&cloud.source, k), self.target.across_of(&cloud.target, k));
        let (cosine, sine) = (a * c + b * d, a * d - b * c);
        let sum = cosine.abs() + sine.abs();
        // From −1 to 3, growing with the angle: up to half as fast at the diagonals as at the axes.
        let at = if cosine >= 0.0 { sine / sum } else { 2.0 - sine / sum };
        let slope = (cosine * cosine + sine * sine) / (sum * sum);
        let half = QUARTER * slope * self.reach / (c * c + d * d).sqrt();
        let told = half < 0.5 * (CELLS - 2) as f32 && sum > 0.0;
        if !told {
            return Arc { first: 0, extent: CELLS as u32 - 1 };
        }
        let middle = QUARTER * (at + 1.0) + CELLS as f32;
        let (low, high) = ((middle - half) as u32, (middle + half) as u32);
        Arc { first: low % CELLS as u32, extent: high - low }
    }
}

impl Frame {
    /// The frame about the line from point `i` to `j`, and their distance.
    #[inline(always)]
    fn across(points: &[Vec<f32>; 3], i: usize, j: usize) -> Option<(Self, f32)> {
        let origin = points.each_ref().map(|axis| axis[i]);
        let along = points.each_ref().map(|axis| axis[j] - axis[i]);
        let length = dot(&along, &along).sqrt();
        if length <= 0.0 {
            return None;
        }
        let u = along.map(|a| a / length);
        // Across the axis that is least along the line.
        let [a, b, c] = u.map(f32::abs);
        let x = if a <= b && a <= c {
            [0.0, u[2], -u[1]]
        } else if b <= c {
            [-u[2], 0.0, u[0]]
        } else {
            [u[1], -u[0], 0.0]
        };
        let norm = dot(&x, &x).sqrt();
        let x = x.map(|a| a / norm);
        let y = [u[1] * x[2] - u[2] * x[1], u[2] * x[0] - u[0] * x[2], u[0] * x[1] - u[1] * x[0]];
        Some((Self { origin, x, y }, length))
    }

    /// Coordinates of a point across the line.
    #[inline(always)]
    fn across_of(&self, points: &[Vec<f32>; 3], k: usize) -> [f32; 2] {
        let p = [points[0][k] - self.origin[0], points[1][k] - self.origin[1], points[2][k] - self.origin[2]];
        [dot(&self.x, &p), dot(&self.y, &p)]
    }
}

#[inline(always)]
fn dot(a: &[f32; 3], b: &[f32; 3]) -> f32 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// How unlikely so many are where `expected` are: of Poisson counts four times the squared difference after the square
/// root has made their variances equal, which is near enough −2 ln of the tail.
fn surprise(count: f32, expected: f32) -> f32 {
    let excess = count.sqrt() - expected.max(0.05).sqrt();
    if excess > 0.0 { 4.0 * excess * excess } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points here and there, without two alike.
    fn scattered(k: usize) -> [f32; 3] {
        [7.0, 11.0, 13.0].map(|p: f32| (k as f32 * p.sqrt()).fract())
    }

    /// Points, and their images turned by `angle` about the z-axis, at scale 2.
    fn turned(count: usize, angle: f32) -> Cloud {
        let (sine, cosine) = (libm::sinf(angle), libm::cosf(angle));
        let mut cloud = Cloud::default();
        cloud.count = count;
        for p in (0..count).map(scattered) {
            let q = [cosine * p[0] - sine * p[1], sine * p[0] + cosine * p[1], p[2]];
            for axis in 0..3 {
                cloud.source[axis].push(p[axis]);
                cloud.target[axis].push(2.0 * q[axis] + 5.0);
            }
        }
        cloud
    }

    fn covers(arc: &Arc, cell: usize) -> bool {
        (cell + CELLS - arc.first as usize) % CELLS <= arc.extent as usize
    }

    #[test]
    fn true_thirds_vote_for_one_turn_and_chance_ones_for_any() {
        let noise = Noise { sigma: 0.01, sigma_per_scale: 0.01 };
        for step in 0..40 {
            let mut cloud = turned(40, step as f32 * 0.157);
            let shuffled = cloud.target.each_ref().map(|axis| axis.iter().rev().copied().collect::<Vec<f32>>());
            let truth = Turn::about(&cloud, noise, 3, 17).expect("two points");
            let arcs: Vec<Arc> = (0..40).filter(|k| ![3, 17].contains(k)).map(|k| truth.of(&cloud, k)).collect();
            let agree = |arcs: &[Arc]| (0..CELLS).map(|c| arcs.iter().filter(|a| covers(a, c)).count()).max();
            assert_eq!(agree(&arcs), Some(38), "turn {step}");
            for (axis, shuffled) in cloud.target.iter_mut().zip(&shuffled) {
                for k in (0..40).filter(|k| ![3, 17].contains(k)) {
                    axis[k] = shuffled[k];
                }
            }
            let arcs: Vec<Arc> = (0..40).filter(|k| ![3, 17].contains(k)).map(|k| truth.of(&cloud, k)).collect();
            assert!(agree(&arcs) < Some(20), "turn {step}: {:?}", agree(&arcs));
        }
    }

    #[test]
    fn a_third_on_the_line_votes_for_every_turn_and_one_point_is_no_line() {
        let mut cloud = turned(6, 1.0);
        for side in [&mut cloud.source, &mut cloud.target] {
            for axis in side {
                axis[2] = 0.5 * (axis[0] + axis[1]);
                axis[4] = axis[3];
            }
        }
        let noise = Noise { sigma: 0.01, sigma_per_scale: 0.01 };
        let turn = Turn::about(&cloud, noise, 0, 1).expect("two points");
        assert_eq!(turn.of(&cloud, 2).extent as usize, CELLS - 1);
        assert!(Turn::about(&cloud, noise, 3, 4).is_none());
    }
}

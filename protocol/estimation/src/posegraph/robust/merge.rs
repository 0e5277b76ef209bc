//! Parts of the map that few closures tie: decides which of them become one.
//!
//! Closures between two parts agree or contradict each other through the parts between their ends, whose relative
//! covariances hold all that ties their robots; so pairs of robots with a closure or two each are told by those of
//! their neighbours. The largest set that agrees pairwise (Mangelson et al. 2018) merges its parts if chance would do
//! as well in fewer than the configured number of false alarms, and no other set has about as many members. The surest
//! merges come first, along a spanning forest; each makes the next surer.

use super::world::{Part, World};
use crate::frames::clique::{self, Set, bit};
use crate::frames::scales_to;
use crate::geometry::{PoseWithCovariance, Relative, Se3, chi2};
use crate::graph::Disjoint;
use crate::ids::SubmapId;
use core::f64::consts::PI;
use libm::{lgamma, log};
use std::collections::{BTreeMap, BTreeSet};

/// Closures between two parts that are compared, at most; of more, evenly from first to last.
const COMPARED_MAX: usize = 64;
/// χ²₆ at 99.9 %.
const GATE: f64 = chi2::P999[5];
/// A second set with this share of the first one's members leaves the answer open.
const RIVAL_SHARE: f64 = 0.8;

/// Two parts and the closures that merge them.
struct Merge {
    parts: (usize, usize),
    used: Vec<usize>,
    log10_nfa: f64,
    /// `t_a_b` between the worlds of the two parts.
    t_a_b: Se3,
}

impl World<'_> {
    /// Merges what can be told; whether anything was.
    pub(super) fn merge(&mut self) -> bool {
        self.merge_on(self.config.alignments_min, self.config.log10_nfa_max)
    }

    /// Merges on so many closures or more, and as few false alarms; whether anything was.
    pub(super) fn merge_on(&mut self, closures_min: usize, log10_nfa_max: f64) -> bool {
        let mut tied: BTreeMap<(usize, usize), Vec<usize>> = BTreeMap::new();
        for (k, c) in self.closures.iter().enumerate().filter(|(_, c)| c.is_candidate()) {
            let of = |id: SubmapId| self.parts.iter().position(|p| p.frames.contains(&id.frame));
            if let (Some(a), Some(b)) = (of(c.i), of(c.j))
                && a != b
            {
                tied.entry((a.min(b), a.max(b))).or_default().push(k);
            }
        }
        let mut merges: Vec<Merge> = tied.iter().filter_map(|(&parts, list)| self.consider(parts, list)).collect();
        merges.retain(|m| m.used.len() >= closures_min && m.log10_nfa <= log10_nfa_max);
        merges.sort_by(|x, y| x.log10_nfa.total_cmp(&y.log10_nfa).then(x.parts.cmp(&y.parts)));
        let mut sets = Disjoint::new(self.parts.len());
        merges.retain(|m| sets.join(m.parts.0, m.parts.1));
        for (part, t_world_part) in laid_out(&merges) {
            let frames = self.parts[part].frames.clone();
            self.place(&frames, &t_world_part);
        }
        for &k in merges.iter().flat_map(|m| &m.used) {
            self.closures[k].unused = None;
        }
        !merges.is_empty()
    }

    fn consider(&self, parts: (usize, usize), closures: &[usize]) -> Option<Merge> {
        let (a, b) = (&self.parts[parts.0], &self.parts[parts.1]);
        let kept = closures.len().min(COMPARED_MAX);
        let chosen: Vec<usize> = (0..kept).map(|k| closures[k * closures.len() / kept]).collect();
        let turned = |&k: &usize| {
            let c = &self.closures[k];
            if a.frames.contains(&c.i.frame) { (c.i, c.j, c.t_i_j) } else { (c.j, c.i, c.t_i_j.inverse()) }
        };
        let between: Vec<Between> = chosen.iter().map(turned).collect();
        let distances = Distances::new(a, b, &between)?;
        let everyone: Set = (0..kept).map(bit).sum();
        let volume = a.volume.max(b.volume);
        let mut best: Option<(Surest, u32)> = None;
        let scales = scales_to(self.config.covariance_scale_max.max(1.0));
        let widest = distances.graph(scales.into_iter().fold(1.0, f64::max));
        for scale in scales {
            let graph = distances.graph(scale);
            for clique in (0..kept).map(|v| clique::largest_with(&graph, v)) {
                let Some(surest) = distances.surest(clique, volume, scale) else { continue };
                if best.as_ref().is_none_or(|(b, _)| surest.log10_nfa < b.log10_nfa) {
                    // A rival is one that more noise does not reconcile.
                    let set = surest.set;
                    let contradicts = |&v: &usize| 2 * (widest[v] & set).count_ones() < set.count_ones();
                    let others: Set = clique::vertices(everyone & !set).filter(contradicts).map(bit).sum();
                    best = Some((surest, clique::maximum_clique(&graph, others).count_ones()));
                }
            }
        }
        let (Surest { set, hub, log10_nfa }, rivals) = best?;
        let members = set.count_ones();
        if f64::from(rivals) >= RIVAL_SHARE * f64::from(members) {
            return None;
        }
        let (i, j, t) = &between[hub];
        let value = |p: &Part, id: SubmapId| Some(p.solution.values()[p.solution.graph().position(id)?].to_se3());
        let t_a_b = value(a, *i)? * t.pose * value(b, *j)?.inverse();
        Some(Merge { parts, used: clique::vertices(set).map(|k| chosen[k]).collect(), log10_nfa, t_a_b })
    }
}

/// A closure between two parts, turned from the first to the second.
type Between = (SubmapId, SubmapId, PoseWithCovariance);

/// How far closures between two parts are from one another.
struct Distances {
    n: usize,
    /// Of one under the hypothesis of another: d², and ln √det of its covariance.
    of: Vec<(f64, f64)>,
}

impl Distances {
    fn new(a: &Part, b: &Part, between: &[Between]) -> Option<Self> {
        let n = between.len();
        let mut of = vec![(f64::INFINITY, 0.0); n * n];
        for (h, (i_h, j_h, t_h)) in between.iter().enumerate() {
            for (l, (i_l, j_l, t_l)) in between.iter().enumerate().filter(|(l, _)| *l > h) {
                let (there, back) = (relative(a, *i_l, *i_h)?, relative(b, *j_h, *j_l)?);
                let told = there.compose(t_h).compose(&back);
                let d2 = told.distance_squared(t_l);
                let sum = told.covariance.matrix() + t_l.covariance.matrix();
                let log_sqrt_det = sum.cholesky().map_or(0.0, |c| c.l().diagonal().iter().map(|&x| log(x)).sum());
                of[h * n + l] = (d2, log_sqrt_det);
                of[l * n + h] = (d2, log_sqrt_det);
            }
        }
        Some(Self { n, of })
    }

    fn graph(&self, scale: f64) -> Vec<Set> {
        let agrees = |h: usize, l: usize| self.of[h * self.n + l].0 <= GATE * scale * scale;
        (0..self.n).map(|h| (0..self.n).filter(|&l| l != h && agrees(h, l)).map(bit).sum()).collect()
    }

    /// Of the sets of a clique's members that are nearest to one of them, the one that chance is the least likely to
    /// bring forth; `None` of a clique of one.
    ///
    /// A false closure comes as near to a hypothesis as d² = r² with the probability α(r) of that ellipsoid in the
    /// search volume. k among n closures agree with one of them within a radius fixed beforehand in n C(n − 1, k − 1) Π
    /// α cases; with the radius of the farthest of them, which the data choose, in (n − 1) times as many (MATH §5). The
    /// smaller of the two counts, doubled.
    fn surest(&self, clique: Set, volume: f64, scale: f64) -> Option<Surest> {
        let n = self.n as f64;
        let mut best: Option<Surest> = None;
        for hub in clique::vertices(clique) {
            let distance = |l: usize| self.of[hub * self.n + l];
            let mut others: Vec<usize> = clique::vertices(clique & !bit(hub)).collect();
            others.sort_by(|&x, &y| distance(x).0.total_cmp(&distance(y).0).then(x.cmp(&y)));
            for k in 1..=others.len() {
                let chosen = &others[..k];
                let choices = log(n) + lgamma(n) - lgamma(k as f64 + 1.0) - lgamma(n - k as f64);
                let chance = |radius_squared: f64| {
                    let ball = 3.0 * log(PI * radius_squared) - log(6.0) - log(volume);
                    chosen.iter().map(|&l| (ball + distance(l).1).min(0.0)).sum::<f64>()
                };
                let told = distance(chosen[k - 1]).0.max(6.0 * scale * scale);
                let log_nfa = chance(GATE * scale * scale).min(chance(told) + log((n - 1.0).max(1.0)));
                let log10_nfa = (core::f64::consts::LN_2 + choices + log_nfa) / core::f64::consts::LN_10;
                if best.as_ref().is_none_or(|b| log10_nfa < b.log10_nfa) {
                    let set = chosen.iter().map(|&l| bit(l)).sum::<Set>() | bit(hub);
                    best = Some(Surest { set, hub, log10_nfa });
                }
            }
        }
        best
    }
}

/// A set of closures that agree with one of them.
struct Surest {
    set: Set,
    hub: usize,
    log10_nfa: f64,
}

fn relative(part: &Part, i: SubmapId, k: SubmapId) -> Option<PoseWithCovariance> {
    match part.solution.relative(i, k, &BTreeSet::new())? {
        Relative::Metric(t) => Some(t),
        Relative::Similarity(_) => None,
    }
}

/// Where the merged parts lie in the world of the first of each tree.
fn laid_out(merges: &[Merge]) -> BTreeMap<usize, Se3> {
    let mut neighbours: BTreeMap<usize, Vec<(usize, Se3)>> = BTreeMap::new();
    for m in merges {
        neighbours.entry(m.parts.0).or_default().push((m.parts.1, m.t_a_b));
        neighbours.entry(m.parts.1).or_default().push((m.parts.0, m.t_a_b.inverse()));
    }
    let mut out: BTreeMap<usize, Se3> = BTreeMap::new();
    for &root in neighbours.keys() {
        if out.contains_key(&root) {
            continue;
        }
        out.insert(root, Se3::identity());
        let mut next = vec![root];
        while let Some(part) = next.pop() {
            let t_world_part = out[&part];
            for (other, t_part_other) in &neighbours[&part] {
                if !out.contains_key(other) {
                    out.insert(*other, t_world_part * *t_part_other);
                    next.push(*other);
                }
            }
        }
    }
    out
}

//! Frame-level consensus where a unit is unknown: decides which alignments between two frames belong together, in
//! SIM(3).
//!
//! The recipe is that of MATH §5, as for metric pairs: pairwise distances through the odometry that joins two
//! alignments' ends, consistency graphs at a few covariance scales, the largest clique of each, the clique with the
//! fewest expected false alarms. The frames' relation then comes from the pair's own factor graph, in which shared
//! trajectory errors are exact and each unknown unit is one variable.

use super::graph::{Factor, Graph, Label};
use super::intake::{Chain, Intake};
use super::pairs::{Oriented, Outcome};
use super::solve::solve;
use crate::config::EstimateConfig;
use crate::geometry::{Relative, Sim3};
use crate::ids::{FrameId, SubmapId};
use crate::snapshot::PairStatus;
use std::collections::BTreeMap;

/// Covariance scales (of standard deviations) tried between 1 and the configured largest.
const SCALES: usize = 5;
/// χ²₇ quantile at 99 %: the gate of a consistent pair at covariance scale 1.
const GATE_SQUARED: f64 = 18.475_306_906_582_357;
/// log₁₀ of the volume 16π³/105 of the unit ball in seven dimensions.
const LOG10_BALL: f64 = 0.674_389_7;
/// log₁₀ of the volume of rotations (8π²) times the range of log-scales that chance could give (ln 400).
const LOG10_TURNS_AND_SCALES: f64 = 1.897_412_2 + 0.777_539_2;
/// A frame's extent counts at least this share of its largest along every axis.
const EXTENT_SHARE_MIN: f64 = 0.1;
/// A rival group whose log₁₀ NFA reaches this share of the best one's makes the pair ambiguous.
const RIVAL_SHARE: f64 = 0.5;
/// Alignments of one pair considered; the first in canonical order.
const ALIGNMENTS_MAX: usize = 128;
/// Steps of the clique search; beyond, the largest clique found so far is taken.
const CLIQUE_STEPS_MAX: usize = 200_000;

/// A group of mutually consistent alignments.
struct Group {
    members: Vec<usize>,
    log10_nfa: f64,
    sigma_scale: f64,
}

/// Distances between alignments, and by chance how often one falls so near.
struct Distances {
    squared: Vec<Vec<f64>>,
    /// log₁₀ of the volume of the unit ellipsoid of each distance.
    log10_volume: Vec<Vec<f64>>,
    log10_space: f64,
}

/// Runs the consensus on the alignments of frames (a, b).
pub(super) fn consensus(
    intake: &Intake,
    (a, b): (FrameId, FrameId),
    alignments: &[Oriented],
    config: &EstimateConfig,
) -> Outcome {
    let (chain_a, chain_b) = (&intake.chains[&a], &intake.chains[&b]);
    let alignments = &alignments[..alignments.len().min(ALIGNMENTS_MAX)];
    let distances = Distances::new(chain_a, chain_b, alignments);
    let everyone: Vec<usize> = (0..alignments.len()).collect();
    let Some(best) = distances.best(&everyone, config) else {
        return Outcome::without(PairStatus::Provisional);
    };
    let rest: Vec<usize> = everyone.iter().copied().filter(|k| !best.members.contains(k)).collect();
    let rival = distances.best(&rest, config);
    let accepted = |g: &Group| g.members.len() >= config.alignments_min && g.log10_nfa <= config.log10_nfa_max;
    let status = if alignments.len() < config.alignments_min {
        PairStatus::Provisional
    } else if rival.is_some_and(|r| accepted(&r) && r.log10_nfa <= RIVAL_SHARE * best.log10_nfa) {
        PairStatus::Ambiguous
    } else if accepted(&best) {
        PairStatus::Merged
    } else {
        PairStatus::Inconsistent
    };
    let t_a_b = matches!(status, PairStatus::Merged | PairStatus::Provisional)
        .then(|| relation(intake, (a, b), alignments, &best, config.iterations_max))
        .flatten();
    // Without a relation there is nothing to merge by.
    let status = if t_a_b.is_none() && status == PairStatus::Merged { PairStatus::Inconsistent } else { status };
    Outcome { status, used: best.members, sigma_scale: best.sigma_scale, log10_nfa: Some(best.log10_nfa), t_a_b }
}

impl Outcome {
    fn without(status: PairStatus) -> Self {
        Self { status, used: Vec::new(), sigma_scale: 1.0, log10_nfa: None, t_a_b: None }
    }
}

impl Distances {
    fn new(a: &Chain, b: &Chain, alignments: &[Oriented]) -> Self {
        let n = alignments.len();
        let mut squared = vec![vec![0.0; n]; n];
        let mut log10_volume = vec![vec![0.0; n]; n];
        for l in 0..n {
            for m in 0..l {
                let (x, y) = (&alignments[l], &alignments[m]);
                let out = Relative::Metric(a.between(x.i, y.i));
                let back = Relative::Metric(b.between(y.j, x.j));
                let through = out.compose(&y.t_i_j).compose(&back).lifted();
                let own = x.t_i_j.lifted();
                let distance = through.distance_squared(&own);
                let volume = match (through.covariance.matrix() + own.covariance.matrix()).cholesky() {
                    Some(c) => LOG10_BALL + c.l_dirty().diagonal().iter().map(|&d| libm::log10(d)).sum::<f64>(),
                    None => f64::INFINITY,
                };
                (squared[l][m], squared[m][l]) = (distance, distance);
                (log10_volume[l][m], log10_volume[m][l]) = (volume, volume);
            }
        }
        let scale = alignments.first().map_or(1.0, |x| x.t_i_j.sim().scale);
        let (extent_a, extent_b) = (a.extent(), b.extent());
        let edges = extent_a.iter().zip(&extent_b).map(|(x, y)| libm::log10(x + scale * y));
        Self { squared, log10_volume, log10_space: edges.sum::<f64>() + LOG10_TURNS_AND_SCALES }
    }

    /// Over the covariance scales, the largest clique among `candidates` with the fewest expected false alarms.
    fn best(&self, candidates: &[usize], config: &EstimateConfig) -> Option<Group> {
        let steps = (0..SCALES).map(|k| k as f64 / (SCALES - 1) as f64);
        let groups = steps.filter_map(|s| {
            let sigma_scale = 1.0 + s * (config.covariance_scale_max - 1.0);
            let near = |x: usize, y: usize| self.squared[x][y] <= GATE_SQUARED * sigma_scale * sigma_scale;
            let members = largest_clique(candidates, &near);
            let log10_nfa = self.log10_nfa(&members, candidates.len(), sigma_scale)?;
            Some(Group { members, log10_nfa, sigma_scale })
        });
        groups.min_by(|x, y| x.log10_nfa.total_cmp(&y.log10_nfa))
    }

    /// log₁₀ of the expected number of groups as large and as tight by chance, seen from the member that fits best:
    /// n · scales · C(n−1, k−1) · Π α.
    fn log10_nfa(&self, members: &[usize], n: usize, sigma_scale: f64) -> Option<f64> {
        let k = members.len();
        let log10_gate = 3.5 * libm::log10(GATE_SQUARED) + 7.0 * libm::log10(sigma_scale);
        let from = |&m: &usize| {
            let others = members.iter().filter(|&&l| l != m);
            others.map(|&l| (log10_gate + self.log10_volume[m][l] - self.log10_space).min(0.0)).sum::<f64>()
        };
        let chance = members.iter().map(from).min_by(f64::total_cmp)?;
        let choose = (1..k).map(|i| libm::log10((n - k + i) as f64 / i as f64)).sum::<f64>();
        Some(libm::log10((n * SCALES) as f64) + choose + chance)
    }
}

/// The largest clique; the first in lexicographic order among equals.
fn largest_clique(candidates: &[usize], near: &dyn Fn(usize, usize) -> bool) -> Vec<usize> {
    let mut search = CliqueSearch { near, best: Vec::new(), steps: 0 };
    search.grow(&mut Vec::new(), candidates);
    search.best
}

struct CliqueSearch<'a> {
    near: &'a dyn Fn(usize, usize) -> bool,
    best: Vec<usize>,
    steps: usize,
}

impl CliqueSearch<'_> {
    fn grow(&mut self, clique: &mut Vec<usize>, candidates: &[usize]) {
        self.steps += 1;
        if clique.len() > self.best.len() {
            self.best.clone_from(clique);
        }
        for (k, &next) in candidates.iter().enumerate() {
            if clique.len() + candidates.len() - k <= self.best.len() || self.steps > CLIQUE_STEPS_MAX {
                return;
            }
            let rest: Vec<usize> = candidates[k + 1..].iter().copied().filter(|&c| (self.near)(next, c)).collect();
            clique.push(next);
            self.grow(clique, &rest);
            clique.pop();
        }
    }
}

/// `t_a_b` between the frames' origins, from the factor graph of the two frames and the group's alignments.
fn relation(
    intake: &Intake,
    (a, b): (FrameId, FrameId),
    alignments: &[Oriented],
    group: &Group,
    iterations_max: usize,
) -> Option<Relative> {
    let (chain_a, chain_b) = (&intake.chains[&a], &intake.chains[&b]);
    let nodes = chain_a.ids(a).chain(chain_b.ids(b)).collect();
    let mut factors: Vec<Factor> = chain_a.factors(a).chain(chain_b.factors(b)).collect();
    let weight = 1.0 / (group.sigma_scale * group.sigma_scale);
    factors.extend(group.members.iter().map(|&k| {
        let Oriented { i, j, t_i_j } = alignments[k];
        let (i, j) = (SubmapId { frame: a, index: i as u32 }, SubmapId { frame: b, index: j as u32 });
        Factor { label: Label::Odometry, i, j, t_i_j, weight }
    }));
    let first = &alignments[*group.members.first()?];
    let t_a_b =
        Sim3::from_se3(&chain_a.poses[first.i]) * first.t_i_j.sim() * Sim3::from_se3(&chain_b.poses[first.j]).inverse();
    let start: BTreeMap<SubmapId, Sim3> = (chain_a.ids(a).zip(chain_a.poses.iter().map(Sim3::from_se3)))
        .chain(chain_b.ids(b).zip(chain_b.poses.iter().map(|t| t_a_b * Sim3::from_se3(t))))
        .collect();
    let graph = Graph::components(&nodes, &intake.unknown_scale, factors).ok()?.into_iter().next()?;
    let start = graph.nodes().iter().map(|id| start.get(id).copied()).collect::<Option<Vec<_>>>()?;
    let solution = solve(graph, start, iterations_max).ok()?;
    let (a0, b0) = (SubmapId { frame: a, index: 0 }, SubmapId { frame: b, index: 0 });
    let t_a0_b0 = solution.relative(a0, b0, &intake.unknown_scale)?;
    Some(Relative::Metric(chain_a.origin).compose(&t_a0_b0).compose(&Relative::Metric(chain_b.origin).inverse()))
}

impl Chain {
    /// Edges of the box about the anchors, none shorter than a share of the longest.
    fn extent(&self) -> [f64; 3] {
        let along = |k: usize| {
            let at = self.poses.iter().map(|t| t.translation[k]);
            at.clone().fold(f64::MIN, f64::max) - at.fold(f64::MAX, f64::min)
        };
        let edges = [along(0), along(1), along(2)];
        let least = (edges.iter().copied().fold(0.0, f64::max) * EXTENT_SHARE_MIN).max(1e-3);
        edges.map(|e| e.max(least))
    }
}

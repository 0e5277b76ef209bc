//! Pairs of frames: decides which of them merge before the joint estimate is solved (MATH §5, DESIGN §6.6).
//!
//! Each pair's alignments go through the frame-level consensus. Merged pairs are then taken from the strongest (lowest
//! number of false alarms) to the weakest into a spanning forest, which also gives the start of the joint estimate. Pairs
//! that contradict one another around a loop are left out as [`blame`] says: a false merge is worse than a missing one.

use super::admission::{Admission, Chain};
use super::blame::{self, Blame};
use super::forest::{Forest, Tie};
use super::frames::{FrameConsensusConfig, FrameOutcome, PairAlignment, align_frames, align_frames_sim, promising};
use super::graph::is_rigid;
use super::joint::{AgreedAlignment, EdgeEstimate, JointEstimate, Unused};
use super::loops::{self, Loops};
use super::verdicts::{Verdict, Verdicts};
use crate::config::EstimateConfig;
use crate::geometry::{Relative, Sim3};
use crate::ids::{FrameId, SubmapId};
use crate::kinds::PairStatus;
use std::collections::{BTreeMap, BTreeSet};

/// Alignments of one pair that its consensus weighs against one another. More say little more about the frames, and
/// cost the cube of their number; the others wait for the map, which tells the good ones better than a pair could.
const WEIGHED_MAX: usize = 32;

/// A pair of frames is ambiguous from this ratio on: pairs of submaps that fit in several ways, over alignments that
/// are used. Measured in simulated halls: false merges, where every shelf is the same, had 1 to 2.3; true ones have up
/// to 0.2 with LiDARs and up to 0.7 with landmarks.
const AMBIGUOUS_SHARE: f64 = 0.8;

/// Loop closures of one frame that its odometry refutes, or that fit at another place as well, from which on they tell
/// of a place that repeats itself: fewer may be chance.
const REPEATED_MIN: usize = 2;

/// A pair of frames with at least one agreed alignment, `a < b`.
#[derive(Clone, Debug, PartialEq)]
pub struct PairEstimate {
    /// First frame.
    pub a: FrameId,
    /// Second frame.
    pub b: FrameId,
    /// Merged, or why not.
    pub status: PairStatus,
    /// Agreed alignments that could be considered.
    pub agreed: usize,
    /// Alignments in the joint estimate.
    pub used: usize,
    /// log₁₀ of the number of false alarms of the consensus.
    pub log10_nfa: Option<f64>,
    /// `t_a_b` between the frames' origins: the joint estimate if their component holds both, the pair's own consensus
    /// otherwise.
    pub t_a_b: Option<Relative>,
    /// Of a merged pair: how the two lie in the middle of what both saw. The origins of the frames may be far from it,
    /// and [`PairEstimate::t_a_b`] as uncertain as the way there.
    pub middle: Option<Middle>,
    /// The pair agrees with itself but was left out, for pairs around a loop contradict one another: who may be wrong.
    pub blame: Option<Blame>,
}

/// How two anchors of different frames lie by the joint estimate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Middle {
    /// In the first frame of the pair.
    pub i: SubmapId,
    /// In the second.
    pub j: SubmapId,
    /// `t_i_j`, cross-correlations included.
    pub t_i_j: Relative,
}

/// A pair of frames, `a < b`, and what its own alignments say.
pub(super) struct Pair {
    pub(super) a: FrameId,
    pub(super) b: FrameId,
    /// Its alignments among the admission's edges.
    members: Vec<usize>,
    /// Those among them that the consensus weighed.
    weighed: Vec<usize>,
    /// What a second look found is judged by the map.
    second_looks: Vec<usize>,
    outcome: Outcome,
    blame: Option<Blame>,
    /// Part of the spanning forest.
    in_tree: bool,
}

/// What the frame-level consensus says.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Outcome {
    pub(super) status: PairStatus,
    /// Indices among the alignments given.
    pub(super) used: Vec<usize>,
    /// By how much the standard deviations of the alignments are to be grown.
    pub(super) sigma_scale: f64,
    pub(super) log10_nfa: Option<f64>,
    /// `t_a_b` between the frames' origins.
    pub(super) t_a_b: Option<Relative>,
}

/// Runs the consensus on every pair, and marks the admission's edges accordingly.
pub(super) fn consensus(admission: &mut Admission, config: &EstimateConfig, known: &mut Verdicts) -> Vec<Pair> {
    let loops = loops::gate(admission);
    let repeat = repeating(&loops, &admission.ambiguous);
    let mut members: BTreeMap<(FrameId, FrameId), Vec<usize>> = BTreeMap::new();
    let mut second: BTreeMap<(FrameId, FrameId), Vec<usize>> = BTreeMap::new();
    for (k, edge) in admission.edges.iter().enumerate() {
        let (i, j) = (edge.measurement.i.frame, edge.measurement.j.frame);
        let list = match edge.unused {
            None if edge.merges() => &mut members,
            Some(Unused::Waiting) if edge.second_look => &mut second,
            _ => continue,
        };
        if i != j {
            list.entry((i.min(j), i.max(j))).or_default().push(k);
        }
    }
    let verdicts = known.on(&members, admission, config, |pair, members| {
        let weighed = weighed(admission, pair, members, config);
        let edges: Vec<usize> = weighed.iter().map(|&k| members[k]).collect();
        Verdict { outcome: decide(admission, pair, &edges, config), weighed }
    });
    let mut pair = |(((a, b), members), Verdict { weighed, outcome }): (((FrameId, FrameId), Vec<usize>), Verdict)| {
        let weighed = weighed.into_iter().map(|k| members[k]).collect();
        let ambiguous = admission.ambiguous.get(&(a, b)).copied().unwrap_or(0);
        let outcome = if repeat.contains(&a) || repeat.contains(&b) {
            outcome.unless_merged()
        } else {
            outcome.unless_ambiguous(ambiguous, members.len())
        };
        let second_looks = second.remove(&(a, b)).unwrap_or_default();
        Pair { a, b, members, weighed, second_looks, outcome, blame: None, in_tree: false }
    };
    let mut pairs: Vec<Pair> = members.into_iter().zip(verdicts).map(&mut pair).collect();
    for pair in &pairs {
        pair.mark(admission);
    }
    span(admission, &mut pairs);
    pairs
}

/// Frames in which about as many places look like others, as was told (`ambiguous`) or as their odometry tells, as were
/// seen again: what looks the same there is not. *Measured*, simulated LiDARs: of the loops that were looked at,
/// ambiguous or refuted 19 of 19 in rows of equal rooms and 16 of 18 in rows of equal shelves (a seed each); ambiguous
/// 0 of 418 in a furnished hall, 0 to 3 of 50 to 60 in halls of cells that are not quite alike, and a fifth along
/// streets, where all merge.
fn repeating(loops: &BTreeMap<FrameId, Loops>, ambiguous: &BTreeMap<(FrameId, FrameId), usize>) -> BTreeSet<FrameId> {
    let repeats = |frame: &FrameId| {
        let Loops { held, refuted } = loops.get(frame).copied().unwrap_or_default();
        let repeated = ambiguous.get(&(*frame, *frame)).copied().unwrap_or(0).saturating_add(refuted);
        repeated >= REPEATED_MIN && repeated as f64 >= AMBIGUOUS_SHARE * held as f64
    };
    let within = ambiguous.keys().filter(|(a, b)| a == b).map(|(frame, _)| *frame);
    loops.keys().copied().chain(within).filter(repeats).collect()
}

/// `t_world_anchor` of every anchor: odometry, laid out along the spanning forest. Where a tree holds a frame in metres
/// the world is in metres, and so are all such frames, also those reached through one of unknown scale: what the way
/// there says of a scale is not exact, and no later step could put it right.
pub(super) fn start(admission: &Admission, pairs: &[Pair]) -> BTreeMap<SubmapId, Sim3> {
    let forest = forest(pairs);
    let mut world: BTreeMap<FrameId, Sim3> = BTreeMap::new();
    let is_metric = |frame: &FrameId| !admission.unknown_scale.contains(frame);
    let (metric, unknown): (Vec<FrameId>, Vec<FrameId>) = admission.chains.keys().partition(|&frame| is_metric(frame));
    for root in metric.into_iter().chain(unknown) {
        if !world.contains_key(&root) {
            for (reached, t_root_reached) in forest.reach(root) {
                let t = t_root_reached.map_or_else(Sim3::identity, |t| t.sim());
                let rigid = is_metric(&root) && is_metric(&reached);
                world.insert(reached, if rigid { Sim3::from_se3(&t.to_se3()) } else { t });
            }
        }
    }
    let anchors = |(&frame, chain): (&FrameId, &Chain)| {
        let t_world_frame = world.get(&frame).copied().unwrap_or_else(Sim3::identity);
        let place = |id: SubmapId| {
            let t_frame_anchor = chain.trajectory.pose(id.index as usize)?;
            Some((id, t_world_frame * Sim3::from_se3(&t_frame_anchor)))
        };
        chain.ids(frame).filter_map(place).collect::<Vec<_>>()
    };
    admission.chains.iter().flat_map(anchors).collect()
}

/// Undoes merges of which too few alignments survive.
pub(super) fn demote(admission: &mut Admission, pairs: &mut [Pair], alignments_min: usize) {
    for pair in pairs.iter_mut().filter(|p| p.outcome.status == PairStatus::Merged) {
        if used(&pair.members, &admission.edges) < alignments_min {
            pair.outcome.status = PairStatus::Inconsistent;
            pair.refuse(admission, Unused::TooFew);
        }
    }
}

impl Pair {
    /// Sets weights and reasons of the pair's alignments after the consensus.
    fn mark(&self, admission: &mut Admission) {
        for &edge in &self.members {
            admission.edges[edge].refuse(Unused::Waiting);
            admission.edges[edge].joins = self.outcome.status == PairStatus::Merged;
        }
        for (k, &edge) in self.weighed.iter().enumerate() {
            let edge = &mut admission.edges[edge];
            edge.unused = None;
            if self.outcome.status != PairStatus::Merged {
                edge.refuse(Unused::Unmerged(self.outcome.status));
            } else if self.outcome.used.contains(&k) {
                edge.weight = edge.weight_at(self.outcome.sigma_scale);
            } else if self.members.len() > self.weighed.len() {
                // So many stand for the pair that the map may be asked again.
                edge.refuse(Unused::Waiting);
            } else {
                edge.refuse(Unused::Outvoted);
            }
        }
    }

    fn is_merged(&self) -> bool {
        self.outcome.status == PairStatus::Merged
    }

    fn tie(&self) -> Option<Tie> {
        self.outcome.t_a_b.map(|t_a_b| Tie { a: self.a, b: self.b, t_a_b })
    }

    /// Pairs around a loop contradict one another, and this one may be wrong.
    fn leave_out(&mut self, admission: &mut Admission, blame: Blame) {
        self.blame = Some(blame);
        self.outcome.status = PairStatus::Inconsistent;
        self.refuse(admission, Unused::FrameLoop);
    }

    fn refuse(&self, admission: &mut Admission, reason: Unused) {
        for &k in &self.members {
            admission.edges[k].joins = false;
            if admission.edges[k].is_used() {
                admission.edges[k].refuse(reason);
            }
        }
    }

    pub(super) fn estimate(self, map: &JointEstimate) -> PairEstimate {
        PairEstimate {
            a: self.a,
            b: self.b,
            status: self.outcome.status,
            agreed: self.members.len() + self.second_looks.len(),
            used: used(&self.members, map.edges()) + used(&self.second_looks, map.edges()),
            log10_nfa: self.outcome.log10_nfa,
            t_a_b: map.frame(self.a, self.b).or(self.outcome.t_a_b),
            middle: self.middle(map),
            blame: self.blame,
        }
    }
}

impl Pair {
    /// The relation of the anchors of the alignment that is used and lies in the middle of those used, along the first
    /// frame's way.
    fn middle(&self, map: &JointEstimate) -> Option<Middle> {
        let edges = self.members.iter().chain(&self.second_looks).map(|&k| &map.edges()[k]);
        let turned = |e: &EdgeEstimate| match e.measurement {
            AgreedAlignment { i, j, .. } if i.frame == self.a => (i, j),
            AgreedAlignment { i, j, .. } => (j, i),
        };
        let mut ends: Vec<(SubmapId, SubmapId)> = edges.filter(|e| e.is_used()).map(turned).collect();
        ends.sort_unstable();
        let (i, j) = *ends.get(ends.len() / 2)?;
        Some(Middle { i, j, t_i_j: map.relative(i, j)? })
    }
}

fn used(of: &[usize], edges: &[EdgeEstimate]) -> usize {
    of.iter().filter(|&&k| edges[k].is_used()).count()
}

/// Positions of at most [`WEIGHED_MAX`] of a pair's alignments: the most promising where units are equal, else evenly
/// from first to last in canonical order.
fn weighed(
    admission: &Admission,
    (a, b): (FrameId, FrameId),
    members: &[usize],
    config: &EstimateConfig,
) -> Vec<usize> {
    if members.len() <= WEIGHED_MAX {
        return (0..members.len()).collect();
    }
    let oriented = members.iter().map(|&k| orient(&admission.edges[k], a));
    let metric = oriented.map(|(i, j, t)| t.metric().map(|&t_i_j| PairAlignment { i, j, t_i_j }));
    match metric.collect::<Option<Vec<_>>>() {
        Some(alignments) if is_rigid(a, b, &admission.unknown_scale) => {
            let (alpha, beta) = (&admission.chains[&a].trajectory, &admission.chains[&b].trajectory);
            promising(alpha, beta, &alignments, &FrameConsensusConfig::from(config), WEIGHED_MAX)
        }
        _ => (0..WEIGHED_MAX).map(|k| k * members.len() / WEIGHED_MAX).collect(),
    }
}

/// By pair of merged frames: by how much the standard deviations of its alignments are to be grown.
pub(super) fn sigma_scales(pairs: &[Pair]) -> BTreeMap<(FrameId, FrameId), f64> {
    let merged = pairs.iter().filter(|p| p.outcome.status == PairStatus::Merged);
    merged.map(|p| ((p.a, p.b), p.outcome.sigma_scale)).collect()
}

/// Takes merged pairs into the forest, the strongest first, and leaves out those to blame for contradictions.
fn span(admission: &mut Admission, pairs: &mut [Pair]) {
    let nfa = |k: &usize| pairs[*k].outcome.log10_nfa.unwrap_or(f64::INFINITY);
    let mut order: Vec<usize> = (0..pairs.len()).filter(|&k| pairs[k].is_merged()).collect();
    order.sort_by(|x, y| nfa(x).total_cmp(&nfa(y)).then(x.cmp(y)));
    order.retain(|&k| pairs[k].outcome.t_a_b.is_some());
    let ties: Vec<Tie> = order.iter().filter_map(|&k| pairs[k].tie()).collect();
    let settled = blame::settle(&ties);
    settled.tree.into_iter().for_each(|k| pairs[order[k]].in_tree = true);
    for (k, blame) in settled.out {
        pairs[order[k]].leave_out(admission, blame);
    }
}

/// The spanning forest of merged frames.
fn forest(pairs: &[Pair]) -> Forest {
    let mut forest = Forest::default();
    for (k, pair) in pairs.iter().enumerate().filter(|(_, pair)| pair.in_tree) {
        pair.tie().into_iter().for_each(|tie| forest.add(k, &tie));
    }
    forest
}

/// The frame-level consensus of one pair, in SE(3) or SIM(3) as its units ask.
fn decide(admission: &Admission, (a, b): (FrameId, FrameId), members: &[usize], config: &EstimateConfig) -> Outcome {
    let (alpha, beta) = (&admission.chains[&a].trajectory, &admission.chains[&b].trajectory);
    let oriented = members.iter().map(|&k| orient(&admission.edges[k], a));
    let config = FrameConsensusConfig::from(config);
    if is_rigid(a, b, &admission.unknown_scale) {
        let metric = |(i, j, t): (_, _, Relative)| t.metric().map(|&t_i_j| PairAlignment { i, j, t_i_j });
        let alignments: Vec<_> = oriented.filter_map(metric).collect();
        Outcome::of(align_frames(alpha, beta, &alignments, &config), Relative::Metric)
    } else {
        let alignments: Vec<_> = oriented.map(|(i, j, t)| PairAlignment { i, j, t_i_j: t.lifted() }).collect();
        Outcome::of(align_frames_sim(alpha, beta, &alignments, &config), Relative::Similarity)
    }
}

impl Outcome {
    /// Not merged, where `ambiguous` pairs of submaps tell that the place repeats itself: about as many as alignments
    /// are used, of all `members` that were weighed or wait.
    fn unless_ambiguous(self, ambiguous: usize, members: usize) -> Self {
        let waiting = members.saturating_sub(WEIGHED_MAX);
        let speak_for_it = (self.used.len() + waiting) as f64;
        if ambiguous as f64 >= AMBIGUOUS_SHARE * speak_for_it { self.unless_merged() } else { self }
    }

    /// Ambiguous, if it is to be merged.
    fn unless_merged(self) -> Self {
        if self.status == PairStatus::Merged {
            return Self { status: PairStatus::Ambiguous, used: Vec::new(), t_a_b: None, ..self };
        }
        self
    }

    fn of<T>(outcome: FrameOutcome<T>, relative: impl Fn(T) -> Relative) -> Self {
        let (status, consensus) = match outcome {
            FrameOutcome::Merged(c) => (PairStatus::Merged, Some(c)),
            FrameOutcome::Provisional(c) => (PairStatus::Provisional, Some(c)),
            // Neither of two rivals is worth showing as the answer.
            FrameOutcome::Ambiguous { .. } => (PairStatus::Ambiguous, None),
            FrameOutcome::BaselineTooShort { .. } | FrameOutcome::Inconsistent | FrameOutcome::None => {
                (PairStatus::Inconsistent, None)
            }
        };
        match consensus {
            Some(c) => Self {
                status,
                used: c.used,
                sigma_scale: c.covariance_scale,
                log10_nfa: Some(c.log10_nfa),
                t_a_b: Some(relative(c.t_alpha_beta)),
            },
            None => Self { status, used: Vec::new(), sigma_scale: 1.0, log10_nfa: None, t_a_b: None },
        }
    }
}

/// An alignment's anchors and measurement, one of several between two frames, turned so that `i` lies in the first.
fn orient(edge: &EdgeEstimate, a: FrameId) -> (usize, usize, Relative) {
    let m = &edge.measurement;
    let t_i_j = edge.among_others();
    if m.i.frame == a {
        (m.i.index as usize, m.j.index as usize, t_i_j)
    } else {
        (m.j.index as usize, m.i.index as usize, t_i_j.inverse())
    }
}

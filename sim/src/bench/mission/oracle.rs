//! The solver that is given every true loop: the same odometry, and between any two submaps that overlap an alignment with
//! errors like those of the swarm's own.

use crate::bench::anchors::Anchor;
use crate::dice::Dice;
use crate::swarm::Outcome;
use crate::truth::{rigid, square};
use anyhow::Context;
use merganser_protocol::agent::Agent;
use merganser_protocol::config::EstimateConfig;
use merganser_protocol::estimate::joint::{AgreedAlignment, FrameChain, MapProblem, solve_map};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3};
use merganser_protocol::ids::{EntryId, FrameId, RobotId, SubmapId};
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::Vector6;
use std::collections::{BTreeMap, BTreeSet};

/// Loops of one submap, the nearest: more of the same place would only cost time.
const LOOPS_PER_SUBMAP: usize = 6;
/// Submaps of one robot so near in its chain are no loop.
const LOOP_GAP: u32 = 5;

/// Root mean square errors of the alignments that the swarm uses, m and rad and per axis, and what they count as.
pub(super) struct Errors {
    pub(super) true_ones: (f64, f64),
    pub(super) claimed: (f64, f64),
}

/// Of all alignments that the swarm uses; `None` for none.
pub(super) fn alignment_errors(snapshot: &Snapshot, anchors: &[Anchor]) -> Option<Errors> {
    let names: BTreeMap<&str, &Se3> = anchors.iter().map(|a| (a.name.as_str(), &a.t_world_anchor)).collect();
    let (mut squares, mut claimed, mut count) = ((0.0, 0.0), (0.0, 0.0), 0.0);
    for edge in snapshot.graph.edges.iter().filter(|edge| edge.weight > 0.0) {
        let ends = [&edge.i, &edge.j].map(|name| names.get(name.as_str()));
        let ([Some(i), Some(j)], Some(t)) = (ends, rigid(&edge.t_i_j.pose)) else {
            continue;
        };
        let off = t.local(&(i.inverse() * **j));
        squares.0 += off.fixed_rows::<3>(0).norm_squared() / 3.0;
        squares.1 += off.fixed_rows::<3>(3).norm_squared() / 3.0;
        let variances = square::<6>(&edge.t_i_j.covariance).diagonal() / edge.weight;
        claimed.0 += variances.fixed_rows::<3>(0).mean();
        claimed.1 += variances.fixed_rows::<3>(3).mean();
        count += 1.0;
    }
    let root = |sums: (f64, f64)| ((sums.0 / count).sqrt(), (sums.1 / count).sqrt());
    (count > 0.0).then(|| Errors { true_ones: root(squares), claimed: root(claimed) })
}

/// Pairs of anchors that overlap.
pub(super) fn loops(anchors: &[Anchor], metres: f64) -> BTreeSet<(usize, usize)> {
    let mut all = BTreeSet::new();
    for (k, a) in anchors.iter().enumerate() {
        let is_loop = |b: &Anchor| b.robot != a.robot || b.index.abs_diff(a.index) >= LOOP_GAP;
        let mut near: Vec<(f64, usize)> = (0..anchors.len())
            .filter(|&l| l != k && is_loop(&anchors[l]) && a.is_near(&anchors[l], metres))
            .map(|l| ((a.t_world_anchor.translation - anchors[l].t_world_anchor.translation).norm(), l))
            .collect();
        near.sort_by(|x, y| x.0.total_cmp(&y.0));
        all.extend(near.iter().take(LOOPS_PER_SUBMAP).map(|&(_, l)| (k.min(l), k.max(l))));
    }
    all
}

/// Loops as they would be measured with errors like those of the swarm's own alignments.
pub(super) fn measured(
    seed: u64,
    anchors: &[Anchor],
    loops: &BTreeSet<(usize, usize)>,
    (metres, radians): (f64, f64),
) -> Vec<(usize, usize, Se3)> {
    let mut dice = Dice::new(seed, "oracle");
    let sigmas = [metres, metres, metres, radians, radians, radians];
    let measure = |&(i, j): &(usize, usize)| {
        let noise = Vector6::from_fn(|k, _| sigmas[k] * dice.normal());
        (i, j, (anchors[i].t_world_anchor.inverse() * anchors[j].t_world_anchor).retract(&noise))
    };
    loops.iter().map(measure).collect()
}

/// The alignments that the swarm uses.
pub(super) fn used(snapshot: &Snapshot, anchors: &[Anchor]) -> Vec<(usize, usize, Se3)> {
    let names: BTreeMap<&str, usize> = anchors.iter().enumerate().map(|(k, a)| (a.name.as_str(), k)).collect();
    let place = |name: &str| names.get(name).copied();
    let used = snapshot.graph.edges.iter().filter(|edge| edge.weight > 0.0);
    used.filter_map(|edge| Some((place(&edge.i)?, place(&edge.j)?, rigid(&edge.t_i_j.pose)?))).collect()
}

/// Where the solver puts each submap, by robot and index, if all alignments err by so much.
///
/// # Errors
/// Robots that it cannot bring into one frame.
pub(super) fn solve(
    outcome: &Outcome<Agent>,
    anchors: &[Anchor],
    loops: &[(usize, usize, Se3)],
    (metres, radians): (f64, f64),
) -> anyhow::Result<BTreeMap<(usize, u32), Se3>> {
    let frame = |robot: usize| FrameId { robot: RobotId([robot as u8; 8]), epoch: 1 };
    let mut frames: BTreeMap<FrameId, FrameChain> = BTreeMap::new();
    let mut before: BTreeMap<usize, usize> = BTreeMap::new();
    for anchor in anchors {
        let first = before.get(&anchor.robot).map_or(0, |step| step + 1);
        let steps = &outcome.stage.steps(anchor.robot)[first..=anchor.step];
        let motion = steps.iter().map(|step| step.motion).reduce(|a, b| a.compose(&b)).context("two anchors in one")?;
        let chain = frames.entry(frame(anchor.robot));
        chain.or_insert(FrameChain { scale: ScaleKind::Metric, odometry: Vec::new() }).odometry.push(motion);
        before.insert(anchor.robot, anchor.step);
    }
    let id = |k: usize| SubmapId { frame: frame(anchors[k].robot), index: anchors[k].index };
    let covariance = Covariance::from_sigmas([metres, metres, metres, radians, radians, radians])?;
    let alignment = |(seq, &(i, j, pose)): (usize, &(usize, usize, Se3))| {
        let t_i_j = Relative::Metric(PoseWithCovariance { pose, covariance });
        AgreedAlignment {
            entry: EntryId { frame: frame(anchors[i].robot), seq: seq as u32 },
            i: id(i),
            j: id(j),
            t_i_j,
        }
    };
    let alignments = loops.iter().enumerate().map(alignment).collect();
    let problem = MapProblem { frames, alignments, ..MapProblem::default() };
    let map = solve_map(&problem, &EstimateConfig::default());
    let own = frame(anchors.first().context("no submap")?.robot);
    let robot = |frame: FrameId| usize::from(frame.robot.0[0]);
    let places = map.anchors(own).into_iter();
    Ok(places.map(|(id, t)| ((robot(id.frame), id.index), t.sim().to_se3())).collect())
}

//! The solver that is given every true loop: the same odometry, and between any two submaps that overlap an alignment
//! with errors like those of the swarm's own.

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
use merganser_protocol::snapshot::{EdgeView, Snapshot};
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::Vector6;
use std::collections::{BTreeMap, BTreeSet};

/// Loops of one submap, the nearest: more of the same place would only cost time.
const LOOPS_PER_SUBMAP: usize = 6;
/// Submaps of one robot so near in its chain are no loop.
const LOOP_GAP: u32 = 5;

/// What the alignments that the swarm uses count as: root mean square, m and rad and per axis; `None` for none.
pub(super) fn claimed(snapshot: &Snapshot) -> Option<(f64, f64)> {
    let used: Vec<_> = snapshot.graph.edges.iter().filter(|edge| edge.weight > 0.0).collect();
    let mean = |from: usize| {
        let variance = |edge: &&EdgeView| square::<6>(&edge.t_i_j.covariance).diagonal() / edge.weight;
        used.iter().map(|edge| variance(edge).fixed_rows::<3>(from).mean()).sum::<f64>() / used.len() as f64
    };
    (!used.is_empty()).then(|| (mean(0).sqrt(), mean(3).sqrt()))
}

/// Root mean square errors of measurements, m and rad and per axis; `None` for none.
pub(super) fn rms(anchors: &[Anchor], measured: &[(usize, usize, Se3)]) -> Option<(f64, f64)> {
    let off = |&(i, j, t): &(usize, usize, Se3)| {
        let off = t.local(&(anchors[i].t_world_anchor.inverse() * anchors[j].t_world_anchor));
        [0, 3].map(|from| off.fixed_rows::<3>(from).norm_squared() / 3.0)
    };
    let sums = measured.iter().map(off).fold([0.0; 2], |sums, one| [sums[0] + one[0], sums[1] + one[1]]);
    let [metres, radians] = sums.map(|sum| (sum / measured.len() as f64).sqrt());
    (!measured.is_empty()).then_some((metres, radians))
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

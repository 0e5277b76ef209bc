//! What the swarm's own registration makes of every true loop, if it is told where to look: the same submaps, cut and
//! described once more, each pair refined from the truth as both its robots would refine it.

use crate::bar::progress_bar;
use crate::bench::anchors::Anchor;
use crate::swarm::Outcome;
use anyhow::{Context, ensure};
use merganser_protocol::agent::Agent;
use merganser_protocol::config::SubmapConfig;
use merganser_protocol::geometry::{PoseWithCovariance, Se3};
use merganser_protocol::submap::{CovarianceOf, Described, Keyframe, RefineConfig, SubmapBuilder, describe, refine};
use merganser_protocol::time::Stamp;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};

/// `t_i_j` of each loop; `None` of those that no refinement settles.
///
/// # Errors
/// Keyframes that make other submaps than the swarm's.
pub(super) fn registered(
    outcome: &Outcome<Agent>,
    anchors: &[Anchor],
    loops: &BTreeSet<(usize, usize)>,
) -> anyhow::Result<BTreeMap<(usize, usize), Option<Se3>>> {
    let described = described(outcome, anchors)?;
    let config = RefineConfig::of(outcome.scenario.config.submap.sensor);
    let loops: Vec<(usize, usize)> = loops.iter().copied().collect();
    let bar = progress_bar(loops.len() as u64, "true loops")?;
    let (next, threads) = (AtomicUsize::new(0), std::thread::available_parallelism().map_or(1, usize::from));
    let measure = || {
        let mut measured = Vec::new();
        while let Some(&(i, j)) = loops.get(next.fetch_add(1, Ordering::Relaxed)) {
            let truth = anchors[i].t_world_anchor.inverse() * anchors[j].t_world_anchor;
            measured.push(((i, j), both_ways(&described[i], &described[j], &truth, &config)));
            bar.inc(1);
        }
        measured
    };
    let all = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads).map(|_| scope.spawn(measure)).collect();
        workers.into_iter().map(|worker| worker.join().ok()).collect::<Option<Vec<_>>>()
    });
    bar.finish_and_clear();
    Ok(all.context("a registration panicked")?.into_iter().flatten().collect())
}

/// Midway of what both see, as agreed alignments are.
fn both_ways(i: &Described, j: &Described, t_i_j: &Se3, config: &RefineConfig) -> Option<Se3> {
    let by_i = refine(&j.keypoints, &i.features, t_i_j, config).ok()?.pose.pose;
    let by_j = refine(&i.keypoints, &j.features, &t_i_j.inverse(), config).ok()?.pose.pose;
    Some(by_i.interpolate(&by_j.inverse(), 0.5))
}

/// The submap of each anchor.
fn described(outcome: &Outcome<Agent>, anchors: &[Anchor]) -> anyhow::Result<Vec<Described>> {
    let config = &outcome.scenario.config.submap;
    let robots: BTreeSet<usize> = anchors.iter().map(|anchor| anchor.robot).collect();
    let bar = progress_bar(robots.len() as u64, "robots' scans")?;
    let mut all = BTreeMap::new();
    for robot in robots {
        all.extend(of_robot(outcome, robot, config)?);
        bar.inc(1);
    }
    bar.finish_and_clear();
    let mut of = |anchor: &Anchor| {
        let (t_frame_anchor, described) = all.remove(&(anchor.robot, anchor.index)).context("a submap is missing")?;
        let off = (t_frame_anchor.translation - anchor.t_frame_anchor.translation).norm();
        ensure!(off < 1e-3, "{} was cut {off} m elsewhere", anchor.name);
        Ok(described)
    };
    anchors.iter().map(&mut of).collect()
}

type Cut = BTreeMap<(usize, u32), (Se3, Described)>;

/// Of a robot that saw all its keyframes.
fn of_robot(outcome: &Outcome<Agent>, robot: usize, config: &SubmapConfig) -> anyhow::Result<Cut> {
    let mut builder = SubmapBuilder::new(config.clone());
    let mut submaps = Vec::new();
    for (index, step) in outcome.stage.steps(robot).iter().enumerate() {
        let (points, marks) = outcome.stage.scan(robot, index)?;
        let keyframe = Keyframe {
            stamp: Stamp(i64::try_from(step.nanos)?),
            pose: PoseWithCovariance { pose: step.t_frame_body, covariance: step.motion.covariance },
            covariance_of: CovarianceOf::Motion,
            session: None,
            points,
            marks,
            place: None,
            up: None,
        };
        submaps.extend(builder.push(keyframe)?);
    }
    submaps.extend(builder.flush());
    Ok(submaps.iter().map(|s| ((robot, s.index), (s.t_frame_anchor, describe(s, config)))).collect())
}

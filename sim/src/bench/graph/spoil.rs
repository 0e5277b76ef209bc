//! Multi-robot graphs whose loop closures between robots are partly replaced by random ones, solved as a swarm would:
//! which closures are used, and what that does to the poses.

use super::ate::{anees, ate};
use super::files::Source;
use super::peer::or_told;
use super::peer_robust;
use crate::bench::cpu::thread_seconds;
use merganser_protocol::config::EstimateConfig;
use merganser_protocol::estimate::posegraph::PoseGraph;
use merganser_protocol::estimate::posegraph::robust::{Verdict, robot_of};
use merganser_protocol::estimate::posegraph::solve::Start;
use merganser_protocol::geometry::Se3;
use nalgebra::{Vector3, Vector6};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::Path;

const ITERATIONS_MAX: usize = 100;
/// What is asked of a set: shares of closures used that are true and of true ones that are used, and the error of poses
/// as a multiple of that of the solution told which are true, beside what iterations leave, m.
const PRECISION_MIN: f64 = 0.99;
const RECALL_MIN: f64 = 0.95;
const ATE_RATIO_MAX: f64 = 1.05;
const ATE_SLACK_M: f64 = 1e-3;

/// What came of one spoiled graph.
pub(super) struct Spoiled {
    name: String,
    robots: usize,
    truths: usize,
    lies: usize,
    /// Components the robots ended in.
    parts: usize,
    /// RMS distance of poses from those of the unspoiled graph, of the solution told which are true, m.
    ate_told: f64,
    /// Normalised error of our poses against the truth by degrees of freedom, where the truth is known.
    anees: Option<f64>,
    /// Ours, then the peers'.
    answers: Vec<Answer>,
}

/// What a solver made of it.
struct Answer {
    name: String,
    used_truths: usize,
    used_lies: usize,
    ate: f64,
    cpu_s: f64,
}

/// Spoils a share of the closures between robots and solves.
///
/// # Errors
/// A graph that cannot be solved even unspoiled.
pub(super) fn measure(
    source: &Source,
    percent: u32,
    seed: u64,
    python: Option<&Path>,
) -> anyhow::Result<Option<Spoiled>> {
    let clean = source.read_robots()?;
    let between = |graph: &PoseGraph, k: usize| {
        let m = &graph.measurements[k];
        robot_of(m.i) != robot_of(m.j)
    };
    let closures: Vec<usize> = (0..clean.measurements.len()).filter(|&k| between(&clean, k)).collect();
    if closures.is_empty() || clean.parts().len() != 1 {
        return Ok(None);
    }
    let reference = solved(&clean)?;
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let mut graph = clean.clone();
    let lies = spoil(&mut graph, &closures, percent, &reference, rng);
    let told = PoseGraph {
        measurements: graph
            .measurements
            .iter()
            .enumerate()
            .filter(|(k, _)| !lies[*k])
            .map(|(_, m)| m.clone())
            .collect(),
        ..graph.clone()
    };
    let ate_told = match told.parts().len() {
        1 => ate(&reference, &solved(&told)?),
        _ => f64::NAN,
    };
    let start = thread_seconds();
    let out = graph.solve_robustly(&EstimateConfig { iterations_max: ITERATIONS_MAX, ..EstimateConfig::default() });
    let cpu_s = thread_seconds() - start;
    let answer = |name: String, used: &dyn Fn(usize) -> bool, ate: f64, cpu_s: f64| {
        let count = |lie: bool| closures.iter().filter(|&&k| lies[k] == lie && used(k)).count();
        Answer { name, used_truths: count(false), used_lies: count(true), ate, cpu_s }
    };
    let all = out.components.iter().max_by_key(|c| c.len()).cloned().unwrap_or_default();
    let is_used = |k: usize| matches!(out.verdicts[k], Verdict::Used(_));
    let mut answers = vec![answer("merganser".to_owned(), &is_used, ate(&reference, &all), cpu_s)];
    if let Some(python) = python {
        for peer in or_told(peer_robust::measure(python, &graph), &source.name).unwrap_or_default() {
            let used = |k: usize| peer.used.binary_search(&k).is_ok();
            let ate = ate(&reference, &peer.poses());
            answers.push(answer(peer.name.clone(), &used, ate, peer.cpu_s));
        }
    }
    let truth = source.truth()?;
    Ok(Some(Spoiled {
        name: source.name.clone(),
        robots: clean.poses.keys().map(|&id| robot_of(id)).collect::<std::collections::BTreeSet<_>>().len(),
        truths: closures.iter().filter(|&&k| !lies[k]).count(),
        lies: closures.iter().filter(|&&k| lies[k]).count(),
        parts: out.components.len(),
        ate_told,
        anees: if truth.is_empty() { None } else { anees(&truth, &out.marginals()) },
        answers,
    }))
}

/// Replaces closures by random ones between random poses of the same robots; which measurements are lies.
fn spoil(
    graph: &mut PoseGraph,
    closures: &[usize],
    percent: u32,
    reference: &BTreeMap<u64, Se3>,
    rng: &mut ChaCha8Rng,
) -> Vec<bool> {
    let of_robot = |robot: u8| graph.poses.keys().copied().filter(|&id| robot_of(id) == robot).collect::<Vec<_>>();
    let poses: BTreeMap<u8, Vec<u64>> =
        (0..=u8::MAX).map(|robot| (robot, of_robot(robot))).filter(|(_, list)| !list.is_empty()).collect();
    let centre = reference.values().map(|t| t.translation).sum::<Vector3<f64>>() / reference.len().max(1) as f64;
    let extent = reference.values().map(|t| (t.translation - centre).norm()).fold(1.0, f64::max);
    let planar = reference.values().all(|t| t.translation.z.abs() < 1e-6);
    let mut lies = vec![false; graph.measurements.len()];
    for &k in closures {
        if rng.next_u32() % 100 >= percent {
            continue;
        }
        let uniform = |rng: &mut ChaCha8Rng| 2.0 * (f64::from(rng.next_u32()) / f64::from(u32::MAX)) - 1.0;
        let mut xi = Vector6::from_fn(|_, _| uniform(rng));
        xi *= std::f64::consts::PI;
        let place = Vector3::new(uniform(rng), uniform(rng), uniform(rng)) * extent;
        if planar {
            (xi[3], xi[4]) = (0.0, 0.0);
        }
        let rotation = Se3::exp(&Vector6::new(0.0, 0.0, 0.0, xi[3], xi[4], xi[5])).rotation;
        let m = &mut graph.measurements[k];
        let any = |list: &[u64], rng: &mut ChaCha8Rng| list[rng.next_u32() as usize % list.len()];
        (m.i, m.j) = (any(&poses[&robot_of(m.i)], rng), any(&poses[&robot_of(m.j)], rng));
        m.t_i_j = Se3::new(rotation, if planar { Vector3::new(place.x, place.y, 0.0) } else { place });
        m.printed = rotation.matrix();
        lies[k] = true;
    }
    lies
}

fn solved(graph: &PoseGraph) -> anyhow::Result<BTreeMap<u64, Se3>> {
    let start = graph.start(Start::Chordal, ITERATIONS_MAX)?;
    let values = graph.minimise(&start, ITERATIONS_MAX)?.values;
    Ok(graph.poses.keys().copied().zip(values).collect())
}

impl Spoiled {
    /// Whether what was used is nearly all true and nearly all that is, and the poses are as if it had been told.
    pub(super) fn is_good(&self) -> bool {
        self.answers.first().is_some_and(|ours| {
            ours.precision() >= PRECISION_MIN
                && ours.used_truths as f64 >= RECALL_MIN * self.truths as f64
                && self.parts == 1
                && ours.ate <= ATE_RATIO_MAX * self.ate_told + ATE_SLACK_M
        })
    }
}

impl Answer {
    fn precision(&self) -> f64 {
        self.used_truths as f64 / (self.used_truths + self.used_lies).max(1) as f64
    }
}

/// The rows as text.
pub(super) fn table(percent: u32, seed: u64, rows: &[Spoiled]) -> String {
    let mut text = format!(
        "{percent} % of the closures between robots replaced by random ones, seed {seed}\n\
         {:<32} {:>6} {:>6} {:>6} {:>9} {:>6} {:>6}  {:<10} {:>9} {:>9} {:>9} {:>9}\n",
        "", "robots", "true", "false", "told m", "parts", "ANEES", "", "precision", "recall", "ATE m", "cpu ms"
    );
    for row in rows {
        let skip = row.name.chars().count().saturating_sub(32);
        for (k, answer) in row.answers.iter().enumerate() {
            if k == 0 {
                let _ = write!(
                    text,
                    "{:<32} {:>6} {:>6} {:>6} {:>9.4} {:>6} {:>6}",
                    row.name.chars().skip(skip).collect::<String>(),
                    row.robots,
                    row.truths,
                    row.lies,
                    row.ate_told,
                    row.parts,
                    row.anees.map_or_else(|| "-".to_owned(), |x| format!("{x:.3}"))
                );
            } else {
                let _ = write!(text, "{:<77}", "");
            }
            let _ = writeln!(
                text,
                "  {:<10} {:>9.4} {:>9.4} {:>9.4} {:>9.0}",
                answer.name,
                answer.precision(),
                answer.used_truths as f64 / row.truths.max(1) as f64,
                answer.ate,
                1e3 * answer.cpu_s
            );
        }
    }
    let good = rows.iter().filter(|row| row.is_good()).count();
    let _ = writeln!(
        text,
        "good: {good} of {} (one part, precision at least {PRECISION_MIN}, recall at least {RECALL_MIN}, ATE within {:.0} % of told)",
        rows.len(),
        100.0 * (ATE_RATIO_MAX - 1.0)
    );
    text + "precision, recall: of closures between robots that count in the estimate; ATE: RMS distance of all poses from \
            the unspoiled graph's; told: of the solution from the true closures alone; ANEES: of our poses against the \
            truth, where it is known, by degrees of freedom (--draws tells what is usual); peers start where PCM lays the robots out\n"
}

//! Eight real robots in look-alike tunnels: which of their closures count, beside the weights that another robust
//! solver left in the tables, and why the two differ most where they do.
//!
//! The solver had not ended: weights of closures between robots are all below 0.01. So it is taken to keep as many
//! closures as we do, those of the largest weights.

use crate::bench::cpu::thread_seconds;
use anyhow::{Context, bail};
use merganser_protocol::config::EstimateConfig;
use merganser_protocol::estimate::posegraph::kimera::{Importer, Recorded};
use merganser_protocol::estimate::posegraph::robust::{Verdict, robot_of};
use merganser_protocol::estimate::posegraph::{Measurement, PoseGraph};
use merganser_protocol::geometry::Se3;
use std::collections::BTreeMap;
use std::fmt::Write;
use std::io::{BufRead, BufReader};
use std::path::Path;

const ITERATIONS_MAX: usize = 100;
/// Closures between the same robots are neighbours if both their ends are this few poses apart.
const NEAR_POSES: u64 = 5;
/// Sigmas of six degrees of freedom beyond which two measurements contradict each other: χ² of one in a million.
const CONTRADICTS: f64 = 6.2;
/// Disagreements printed.
const SHOWN: usize = 10;

type Poses = BTreeMap<u64, Se3>;

/// Solves, compares, and tells as text; whether all robots share one frame.
///
/// # Errors
/// A folder without tables, or one that cannot be read.
pub(super) fn run(folder: &Path) -> anyhow::Result<(String, bool)> {
    let (graph, recorded) = read(folder)?;
    let config = EstimateConfig { iterations_max: ITERATIONS_MAX, ..EstimateConfig::default() };
    let start = thread_seconds();
    let ours = graph.solve_robustly(&config);
    let cpu_s = thread_seconds() - start;
    let poses = ours.components.iter().max_by_key(|c| c.len()).cloned().unwrap_or_default();
    let whole = ours.components.len() == 1;
    let closures: Vec<usize> =
        (0..graph.measurements.len()).filter(|&k| ours.verdicts[k] != Verdict::Odometry).collect();
    let used = |k: usize| matches!(ours.verdicts[k], Verdict::Used(_));
    let mut weights: Vec<f64> = closures.iter().map(|&k| recorded[k].weight).collect();
    weights.sort_by(|x, y| y.total_cmp(x));
    let least = weights.get(closures.iter().filter(|&&k| used(k)).count()).copied().unwrap_or(0.0);
    let kept = |k: usize| recorded[k].weight > least;
    let count = |wanted: &dyn Fn(usize) -> bool| closures.iter().filter(|&&k| wanted(k)).count();
    let mut text = format!(
        "{} poses in {} parts, {:.1} s; of {} closures {} used, {} have a recorded weight above {least:.5}\n\
         both {}, ours only {}, recorded only {}, neither {}; AUC of the recorded weights for our choice {:.3}\n",
        graph.poses.len(),
        ours.components.len(),
        cpu_s,
        closures.len(),
        count(&used),
        count(&kept),
        count(&|k| used(k) && kept(k)),
        count(&|k| used(k) && !kept(k)),
        count(&|k| !used(k) && kept(k)),
        count(&|k| !used(k) && !kept(k)),
        auc(&closures, &used, |k| -recorded[k].weight),
    );
    if !whole {
        return Ok((text, false));
    }
    let theirs = solved_as_recorded(&graph, |k| recorded[k].known || kept(k), &poses)?;
    let off = |k: usize, at: &Poses| sigmas(&graph.measurements[k], at);
    let mut differ: Vec<usize> = closures.iter().copied().filter(|&k| used(k) != kept(k)).collect();
    let by = |k: &usize| (off(*k, &poses) - off(*k, &theirs)).abs();
    differ.sort_by(|x, y| by(y).total_cmp(&by(x)).then(x.cmp(y)));
    let _ = writeln!(
        text,
        "{:<22} {:>8} {:>6} {:>12} {:>12} {:>22}  why ours",
        "largest disagreements", "recorded", "ours", "σ in our map", "σ in theirs", "neighbours they keep"
    );
    for &k in differ.iter().take(SHOWN) {
        let m = &graph.measurements[k];
        let near: Vec<usize> =
            closures.iter().copied().filter(|&n| n != k && kept(n) && are_near(m, &graph.measurements[n])).collect();
        let against = near.iter().filter(|&&n| apart(m, &graph.measurements[n], &poses) > CONTRADICTS).count();
        let why = match &ours.verdicts[k] {
            Verdict::Unused(reason) => reason.to_string(),
            _ => "agrees with the map".to_owned(),
        };
        let _ = writeln!(
            text,
            "{:<22} {:>8.5} {:>6} {:>12.1} {:>12.1} {:>22}  {why}",
            format!("{} - {}", name(m.i), name(m.j)),
            recorded[k].weight,
            if used(k) { "used" } else { "out" },
            off(k, &poses),
            off(k, &theirs),
            format!("{} contradict, {} agree", against, near.len() - against),
        );
    }
    text += "σ: of six degrees of freedom, as the tables state them; neighbours: closures of the same robots within five \
             poses at both ends, held against this one through our map\n";
    Ok((text, whole))
}

fn read(folder: &Path) -> anyhow::Result<(PoseGraph, Vec<Recorded>)> {
    let mut tables: Vec<_> = std::fs::read_dir(folder)
        .with_context(|| folder.display().to_string())?
        .filter_map(|entry| Some(entry.ok()?.path().join("measurements.csv")))
        .filter(|path| path.is_file())
        .collect();
    tables.sort();
    if tables.is_empty() {
        bail!("{}: no folder in it has a measurements.csv", folder.display());
    }
    let mut importer = Importer::default();
    for path in &tables {
        let place = || path.display().to_string();
        importer.begin();
        for line in BufReader::new(std::fs::File::open(path).with_context(place)?).lines() {
            importer.line(&line.with_context(place)?).with_context(place)?;
        }
    }
    Ok(importer.finish())
}

/// The map of the measurements that the recorded weights keep, from ours.
fn solved_as_recorded(graph: &PoseGraph, keep: impl Fn(usize) -> bool, from: &Poses) -> anyhow::Result<Poses> {
    let kept = graph.measurements.iter().enumerate().filter(|(k, _)| keep(*k));
    let measurements = kept.map(|(_, m)| m.clone()).collect();
    let kept = PoseGraph { measurements, ..graph.clone() };
    let start: Vec<Se3> = graph.poses.keys().map(|id| from.get(id).copied().unwrap_or_else(Se3::identity)).collect();
    let values = kept.minimise(&start, ITERATIONS_MAX)?.values;
    Ok(graph.poses.keys().copied().zip(values).collect())
}

/// By how many sigmas a measurement is off in a map.
fn sigmas(m: &Measurement, poses: &Poses) -> f64 {
    let (Some(i), Some(j)) = (poses.get(&m.i), poses.get(&m.j)) else { return f64::INFINITY };
    let r = m.t_i_j.local(&(i.inverse() * *j));
    r.dot(&(m.information * r)).sqrt()
}

/// By how many sigmas two measurements nearby are apart, brought together along a map.
fn apart(m: &Measurement, other: &Measurement, poses: &Poses) -> f64 {
    let between = |a: u64, b: u64| Some(poses.get(&a)?.inverse() * *poses.get(&b)?);
    let (i, j, t) = if robot_of(m.i) == robot_of(other.i) {
        (other.i, other.j, other.t_i_j)
    } else {
        (other.j, other.i, other.t_i_j.inverse())
    };
    let Some((there, back)) = between(m.i, i).zip(between(j, m.j)) else { return f64::INFINITY };
    let r = m.t_i_j.local(&(there * t * back));
    (0.5 * r.dot(&(m.information * r))).sqrt()
}

fn are_near(a: &Measurement, b: &Measurement) -> bool {
    let near = |x: u64, y: u64| robot_of(x) == robot_of(y) && x.abs_diff(y) <= NEAR_POSES;
    (near(a.i, b.i) && near(a.j, b.j)) || (near(a.i, b.j) && near(a.j, b.i))
}

/// Robot and pose, as the tables number them.
fn name(id: u64) -> String {
    format!("{}/{}", robot_of(id).saturating_sub(b'a'), id & ((1 << 56) - 1))
}

/// Probability that one that was kept is nearer than one that was not.
fn auc(closures: &[usize], kept: &dyn Fn(usize) -> bool, off: impl Fn(usize) -> f64) -> f64 {
    let mut order: Vec<(f64, bool)> = closures.iter().map(|&k| (off(k), kept(k))).collect();
    order.sort_by(|x, y| x.0.total_cmp(&y.0));
    let (mut seen, mut wins, mut others) = (0.0, 0.0, 0.0);
    for &(_, is_kept) in order.iter().rev() {
        if is_kept {
            seen += 1.0;
            wins += others;
        } else {
            others += 1.0;
        }
    }
    wins / (seen * others)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_perfect_ranking_has_an_auc_of_one_and_a_reversed_one_of_zero() {
        let closures = [0, 1, 2, 3];
        let auc = |off: [f64; 4]| auc(&closures, &|k| k < 2, |k| off[k]);
        assert_eq!((auc([1.0, 2.0, 3.0, 4.0]), auc([3.0, 4.0, 1.0, 2.0]), auc([1.0, 3.0, 2.0, 4.0])), (1.0, 0.0, 0.75));
    }
}

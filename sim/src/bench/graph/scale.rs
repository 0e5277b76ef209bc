//! A swarm's graph that grows: batch solve, all covariances, then single additions, timed and compared with a batch.

use super::swarm::{Swarm, submap};
use crate::bar::progress_bar;
use crate::bench::cpu::thread_seconds;
use merganser_protocol::estimate::graph::{Factor, Graph};
use merganser_protocol::estimate::incremental::{Addition, Incremental, Update};
use merganser_protocol::estimate::solve::{Solution, solve};
use merganser_protocol::geometry::{Relative, Sim3};
use merganser_protocol::ids::SubmapId;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// Iterations after which a minimisation gives up.
const ITERATIONS_MAX: usize = 100;
/// Single additions, and every how many of them closes a loop.
const ADDITIONS: usize = 200;
const LOOP_EVERY: usize = 10;
/// How far a grown estimate may lie from a batch solve's, in standard deviations.
const APART_MAX: f64 = 0.05;

/// Robots and anchors of each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Size {
    pub robots: usize,
    pub anchors: usize,
}

impl std::str::FromStr for Size {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let parse = |(robots, anchors): (&str, &str)| Some((robots.parse().ok()?, anchors.parse().ok()?));
        let is_fair = |&(robots, anchors): &(usize, usize)| {
            (1..=1000).contains(&robots) && (2..=10_000).contains(&anchors) && robots * anchors <= 100_000
        };
        let size = text.split_once('x').and_then(parse).filter(is_fair);
        let (robots, anchors) = size.ok_or("wants ROBOTSxANCHORS, at most 1000 robots and 100,000 anchors in all")?;
        Ok(Self { robots, anchors })
    }
}

/// What one addition cost.
struct Cost {
    closes_loop: bool,
    cpu_s: f64,
    update: Update,
}

/// Measures and describes. Whether all solves converged and the grown estimate is that of a batch.
///
/// # Errors
/// A graph that cannot be solved.
pub(super) fn run(size: Size, seed: u64) -> anyhow::Result<(String, bool)> {
    let mut swarm = Swarm::new(seed, size.robots, size.anchors);
    let mut text = String::new();
    let start = swarm.start();
    let factors = std::mem::take(&mut swarm.new_factors);
    let (nodes, factor_count) = (start.len(), factors.len());
    let (batch_s, solution) = timed(|| batch(factors, &start))?;
    drop(start);
    let _ = writeln!(
        text,
        "{} robots, {nodes} anchors, {factor_count} factors, seed {seed}\nbatch from frame alignments: {batch_s:.3} s, \
         {} iterations, χ² {:.1} of {} degrees of freedom",
        size.robots, solution.iterations, solution.chi2, solution.dof
    );
    let mut is_good = solution.converged;
    let first = submap(0, 0);
    let (marginals_s, marginals) = timed(|| anyhow::Ok(solution.relatives_to(first, &BTreeSet::new()).len()))?;
    let _ = writeln!(text, "covariances of all {marginals}: {marginals_s:.3} s");
    let (takeover_s, mut grown) = timed(|| Ok(Incremental::new(solution, &BTreeSet::new())?))?;
    let kept = grown.kept_bytes() as f64 / 1e6;
    let _ = writeln!(text, "taking it over: {takeover_s:.3} s; the factorisation keeps {kept:.1} MB");
    let bar = progress_bar(ADDITIONS as u64, "additions")?;
    let mut additions = Vec::with_capacity(ADDITIONS);
    for k in 0..ADDITIONS {
        let closes_loop = closes_loop(k);
        let id = swarm.drive_on(closes_loop);
        let factors = std::mem::take(&mut swarm.new_factors);
        let addition = Addition { nodes: BTreeSet::from([id]), unknown_scale: BTreeSet::new(), factors };
        let (cpu_s, update) = timed(|| Ok(grown.add(addition)?))?;
        is_good &= update.settled;
        additions.push(Cost { closes_loop, cpu_s, update });
        bar.inc(1);
    }
    bar.finish_and_clear();
    describe(&mut text, &additions, batch_s);
    if let Some(peak) = peak_mb() {
        let _ = writeln!(text, "peak memory so far: {peak:.0} MB, {ALLOCATOR}");
    }
    let values: BTreeMap<SubmapId, Sim3> = grown.values().map(|(id, value)| (id, *value)).collect();
    let again = batch(driven_again(size, seed), &values)?;
    let (apart, metres) = apart(&again, &grown);
    let _ = writeln!(text, "farthest from a batch solve: {apart:.1e} standard deviations, {metres:.1e} m");
    is_good &= again.converged && apart <= APART_MAX;
    let (settle_s, steps) = timed(|| Ok(grown.settle()?))?;
    let (apart, metres) = self::apart(&again, &grown);
    let _ = writeln!(
        text,
        "settled ({steps} steps, {settle_s:.3} s): {apart:.1e} standard deviations, {metres:.1e} m; χ² {:.6}, batch {:.6}",
        grown.chi2(),
        again.chi2
    );
    Ok((text, is_good))
}

/// All factors of a run, drawn again: kept, they would count in the memory.
fn driven_again(size: Size, seed: u64) -> Vec<Factor<SubmapId>> {
    let mut swarm = Swarm::new(seed, size.robots, size.anchors);
    swarm.start();
    (0..ADDITIONS).for_each(|k| {
        swarm.drive_on(closes_loop(k));
    });
    swarm.new_factors
}

fn closes_loop(addition: usize) -> bool {
    (addition + 1).is_multiple_of(LOOP_EVERY)
}

fn batch(factors: Vec<Factor<SubmapId>>, start: &BTreeMap<SubmapId, Sim3>) -> anyhow::Result<Solution<SubmapId>> {
    let nodes = start.keys().copied().collect();
    let mut graphs = Graph::components(&nodes, &BTreeSet::new(), factors)?;
    anyhow::ensure!(graphs.len() == 1, "the swarm's graph falls into {} parts; take another seed", graphs.len());
    let graph = graphs.remove(0);
    let start = graph.nodes().iter().map(|id| start[id]).collect();
    Ok(solve(graph, start, ITERATIONS_MAX)?)
}

fn describe(text: &mut String, additions: &[Cost], batch_s: f64) {
    let _ = writeln!(
        text,
        "\n{:<12} {:>5} {:>9} {:>9} {:>9} {:>9} {:>12} {:>9} {:>9}",
        "additions", "n", "median ms", "95 % ms", "max ms", "of batch", "of fronts", "moved", "relin."
    );
    for (name, wanted) in [("all", None), ("odometry", Some(false)), ("with a loop", Some(true))] {
        let chosen: Vec<&Cost> =
            additions.iter().filter(|a| wanted.is_none_or(|loops| a.closes_loop == loops)).collect();
        let ms = |share| 1e3 * quantile(chosen.iter().map(|a| a.cpu_s), share);
        let median = |of: fn(&Update) -> f64| quantile(chosen.iter().map(|a| of(&a.update)), 0.5);
        let _ = writeln!(
            text,
            "{name:<12} {:>5} {:>9.2} {:>9.2} {:>9.2} {:>8.2}% {:>11.2}% {:>9.0} {:>9.0}",
            chosen.len(),
            ms(0.5),
            ms(0.95),
            ms(1.0),
            ms(0.5) / batch_s / 10.0,
            100.0 * median(|u| u.eliminated as f64 / u.fronts.max(1) as f64),
            median(|u| u.moved as f64),
            median(|u| u.relinearised as f64),
        );
    }
}

/// How far the grown estimate lies from a batch solve, relative to its first anchor: standard deviations, m.
fn apart(batch: &Solution<SubmapId>, grown: &Incremental<SubmapId>) -> (f64, f64) {
    let first = submap(0, 0);
    let mut worst = (0.0_f64, 0.0_f64);
    let Some(origin) = grown.value(first).map(Sim3::inverse) else { return (f64::NAN, f64::NAN) };
    for (id, relative) in batch.relatives_to(first, &BTreeSet::new()).into_iter().skip(1) {
        let (Relative::Metric(p), Some(value)) = (relative, grown.value(id)) else { return (f64::NAN, f64::NAN) };
        let delta = p.pose.local(&(origin * *value).to_se3());
        worst.0 = worst.0.max(p.covariance.mahalanobis_squared(&delta).sqrt());
        worst.1 = worst.1.max(delta.fixed_rows::<3>(0).norm());
    }
    worst
}

fn timed<T>(run: impl FnOnce() -> anyhow::Result<T>) -> anyhow::Result<(f64, T)> {
    let start = thread_seconds();
    let out = run()?;
    Ok((thread_seconds() - start, out))
}

fn quantile(values: impl Iterator<Item = f64>, share: f64) -> f64 {
    let mut values: Vec<f64> = values.collect();
    values.sort_by(f64::total_cmp);
    let place = (share * values.len() as f64).ceil() as usize;
    values.get(place.saturating_sub(1)).copied().unwrap_or(f64::NAN)
}

/// Whose memory is measured: an allocator keeps what was freed, the simulator's up to two thirds of what is held, the
/// system's a tenth.
const ALLOCATOR: &str = if cfg!(feature = "mimalloc") {
    "much of it kept by the simulator's allocator (--no-default-features takes the system's, as robots do)"
} else {
    "with the system's allocator, as robots have it"
};

/// This process's memory at its largest, MB; `None` where the system does not tell.
fn peak_mb() -> Option<f64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:"))?;
    Some(line.trim().strip_suffix(" kB")?.trim().parse::<f64>().ok()? / 1e3)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_are_read_within_their_limits() {
        assert_eq!("100x100".parse(), Ok(Size { robots: 100, anchors: 100 }));
        assert_eq!("10x10000".parse(), Ok(Size { robots: 10, anchors: 10_000 }));
        for bad in ["", "100", "0x10", "1x1", "x", "1001x2", "11x10000", "-1x5", "2x3x4"] {
            assert!(bad.parse::<Size>().is_err(), "{bad}");
        }
    }

    #[test]
    fn quantiles_are_those_of_the_sorted() {
        let of = |share| quantile([3.0, 1.0, 2.0, 4.0].into_iter(), share);
        assert_eq!([of(0.5), of(0.95), of(1.0)], [2.0, 4.0, 4.0]);
    }

    #[test]
    fn a_small_swarm_grows_to_what_a_batch_solve_has() {
        let (text, is_good) = run(Size { robots: 4, anchors: 30 }, 3).unwrap();
        assert!(is_good, "{text}");
        assert!(text.contains("farthest from a batch solve") && text.contains("with a loop     20"), "{text}");
    }
}

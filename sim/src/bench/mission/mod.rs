//! `merganser-sim bench mission`: a swarm that drives for minutes with ray-cast scans, as it would be used. When do
//! robots merge that see the same, how far off is the map at the end beside that of a solver who is given every true
//! loop, and what does each robot send for it?

mod oracle;
mod registered;

use crate::bar::progress_bar;
use crate::bench::anchors::{Anchor, anchors, errors};
use crate::bench::table::median;
use crate::scenario::Scenario;
use crate::swarm::{Outcome, Swarm, Usage};
use crate::world::places::PlaceOptions;
use anyhow::{Context, ensure};
use clap::Args;
use merganser_protocol::agent::Agent;
use merganser_protocol::agent::io::Event;
use merganser_protocol::geometry::Se3;
use merganser_protocol::snapshot::Snapshot;
use std::collections::{BTreeMap, BTreeSet};
use std::io::Write;

/// The hall, the sensor and the configuration.
const SCENARIO: &str = include_str!("../../../scenarios/ten.toml");
/// Two submaps whose anchors are no farther apart overlap for certain, m: the sensor looks all around, 15 m far.
const OVERLAP_M: f64 = 3.0;
/// Longest time from an overlap to the merge, s.
const MERGE_SECS_MAX: f64 = 60.0;
/// Largest absolute trajectory error beside that of the solver given every true loop.
const RATIO_MAX: f64 = 1.1;
/// Most that a robot sends in the second half of its drive, bytes per second.
const SENT_MAX: f64 = 1000.0;

/// `bench mission`.
#[derive(Debug, Args)]
pub struct Mission {
    /// Robots
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u16).range(2..=50))]
    robots: u16,
    /// Time driven, s
    #[arg(long, default_value_t = 600, value_parser = clap::value_parser!(u32).range(10..=7200))]
    secs: u32,
    /// What world, drives and noise are drawn from
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..1 << 62))]
    seed: u64,
    /// A place-recognition network of the robots' own proposes what to align
    #[arg(long)]
    places: bool,
}

/// Measures and prints. Returns whether all goals were reached.
///
/// # Errors
/// Standard output that cannot be written, a scenario that does not start.
pub fn run(options: &Mission) -> anyhow::Result<bool> {
    let mut scenario = Scenario::parse(SCENARIO)?;
    (scenario.robots, scenario.duration_secs) = (usize::from(options.robots), f64::from(options.secs));
    scenario.places = options.places.then(PlaceOptions::default);
    let swarm = Swarm::<Agent>::new(scenario, options.seed)?;
    let bar = progress_bar(swarm.end().as_secs_f64() as u64, "virtual s")?;
    let outcome = swarm.run(|now| bar.set_position(now.as_secs_f64() as u64));
    bar.finish_and_clear();
    let outcome = outcome?;
    if let Some(violation) = &outcome.violation {
        anyhow::bail!("{} at {:.1} s: {}", violation.invariant, violation.at_secs, violation.what);
    }
    let snapshot = outcome.robots.first().and_then(|robot| robot.snapshot.as_ref()).context("no robot is left")?;
    let anchors = anchors(&outcome, snapshot)?;
    let mut out = std::io::stdout().lock();
    let used = snapshot.graph.edges.iter().filter(|edge| edge.weight > 0.0).count();
    writeln!(
        out,
        "{} robots, {} s, seed {}: {} submaps, {} alignments stated, {used} used",
        options.robots,
        options.secs,
        options.seed,
        anchors.len(),
        snapshot.graph.edges.len()
    )?;
    let merged = merges(&outcome, &anchors, &mut out)?;
    let accurate = accuracy(&outcome, snapshot, &anchors, &mut out)?;
    let frugal = traffic(&outcome, &mut out)?;
    work(&outcome, &mut out)?;
    expectations(&outcome, &mut out)?;
    second_looks(&outcome, &mut out)?;
    Ok(merged && accurate && frugal)
}

/// From the first overlap of any two robots to the moment at which both had merged.
fn merges(outcome: &Outcome<Agent>, anchors: &[Anchor], out: &mut impl Write) -> anyhow::Result<bool> {
    let finished = finished(outcome);
    let mut overlaps: BTreeMap<(usize, usize), f64> = BTreeMap::new();
    for (k, a) in anchors.iter().enumerate() {
        for b in anchors[k + 1..].iter().filter(|b| b.robot != a.robot && a.is_near(b, OVERLAP_M)) {
            let Some(at) = finished.get(&(a.robot, a.index)).zip(finished.get(&(b.robot, b.index))) else { continue };
            let first = overlaps.entry((a.robot.min(b.robot), a.robot.max(b.robot))).or_insert(f64::INFINITY);
            *first = first.min(at.0.max(*at.1));
        }
    }
    let since = merged_since(outcome);
    let waits: Vec<f64> = overlaps
        .iter()
        .map(|(&(a, b), overlap)| {
            let both = [(a, b), (b, a)].map(|pair| since.get(&pair).copied().unwrap_or(f64::INFINITY));
            (both[0].max(both[1]) - overlap).max(0.0)
        })
        .collect();
    let worst = waits.iter().copied().fold(0.0, f64::max);
    writeln!(
        out,
        "pairs of robots that saw the same: {}; from that to both having merged: median {:.1} s, at most {worst:.1} s \
         (goal {MERGE_SECS_MAX} s)",
        waits.len(),
        median(waits.clone())
    )?;
    Ok(worst <= MERGE_SECS_MAX)
}

/// When each submap was finished, s.
fn finished(outcome: &Outcome<Agent>) -> BTreeMap<(usize, u32), f64> {
    let submap = |(at, robot, event): &(f64, usize, Event)| match event {
        Event::SubmapFinished { submap, .. } => Some(((*robot, submap.index), *at)),
        _ => None,
    };
    outcome.told.iter().filter_map(submap).collect()
}

/// Since when each robot has had each other's frame in its own, for good.
fn merged_since(outcome: &Outcome<Agent>) -> BTreeMap<(usize, usize), f64> {
    let frames: BTreeMap<_, usize> = outcome
        .told
        .iter()
        .filter_map(|(_, robot, event)| match event {
            Event::SubmapFinished { submap, .. } => Some((submap.frame, *robot)),
            _ => None,
        })
        .collect();
    let mut since = BTreeMap::new();
    for (at, robot, event) in &outcome.told {
        match event {
            Event::Merged { frame } => frames.get(frame).map(|other| since.insert((*robot, *other), *at)),
            Event::Unmerged { frame } => frames.get(frame).map(|other| since.remove(&(*robot, *other))),
            _ => None,
        };
    }
    since
}

/// The map's error beside that of a solver who is given every true loop, and that of odometry.
fn accuracy(
    outcome: &Outcome<Agent>,
    snapshot: &Snapshot,
    anchors: &[Anchor],
    out: &mut impl Write,
) -> anyhow::Result<bool> {
    let joined = anchors.iter().filter(|anchor| anchor.t_own_anchor.is_some()).count();
    ensure!(joined > 0, "no submap is in the map");
    let ours = errors(anchors, Anchor::estimated);
    let used = oracle::used(snapshot, anchors);
    let sigmas = oracle::rms(anchors, &used).context("no alignment is used")?;
    let claimed = oracle::claimed(snapshot).context("no alignment is used")?;
    let loops = oracle::loops(anchors, OVERLAP_M);
    let given = |loops: &[(usize, usize, Se3)], sigmas: (f64, f64)| -> anyhow::Result<f64> {
        let solved = oracle::solve(outcome, anchors, loops, sigmas)?;
        Ok(errors(anchors, |anchor| solved.get(&(anchor.robot, anchor.index)).copied()))
    };
    // Registration sees what the submaps hold, and they are bent as the robots' odometry bent them.
    let drawn = oracle::measured(outcome.seed, anchors, &loops, sigmas);
    let registered = registered::registered(outcome, anchors, &loops)?;
    let settled = registered.values().flatten().count();
    let seen: Vec<(usize, usize, Se3)> =
        drawn.iter().map(|&(i, j, t)| (i, j, registered.get(&(i, j)).copied().flatten().unwrap_or(t))).collect();
    let of_loops = oracle::rms(anchors, &seen).context("no true loop")?;
    let theirs = given(&seen, of_loops)?;
    let independent = given(&drawn, sigmas)?;
    // What is lost by weighing alignments as they are weighed, by their errors, and by there being no more of them.
    let pairs: BTreeSet<(usize, usize)> = used.iter().map(|&(i, j, _)| (i.min(j), i.max(j))).collect();
    let weighed = given(&used, sigmas)?;
    let anew = given(&oracle::measured(outcome.seed, anchors, &pairs, sigmas), sigmas)?;
    let robots: BTreeSet<usize> = anchors.iter().map(|anchor| anchor.robot).collect();
    let alone = robots.iter().map(|robot| {
        let own: Vec<Anchor> = anchors.iter().filter(|anchor| anchor.robot == *robot).cloned().collect();
        errors(&own, |anchor| Some(anchor.t_frame_anchor))
    });
    writeln!(
        out,
        "absolute trajectory error: {ours:.4} m ({joined} of {} submaps in one map); odometry of each alone: {:.3} m\n\
         given every true loop ({}, {settled} of them registered from the truth): {theirs:.4} m; ratio {:.2} (goal \
         {RATIO_MAX}); were their errors independent: {independent:.4} m, ratio {:.2}\n\
         that solver given our {} alignments: {weighed:.4} m; given the same pairs with errors drawn anew: {anew:.4} m\n\
         alignments err by {:.3} m and {:.2}° an axis, count as {:.3} m and {:.2}°; true loops err by {:.3} m and {:.2}°",
        anchors.len(),
        median(alone.collect()),
        loops.len(),
        ours / theirs,
        ours / independent,
        used.len(),
        sigmas.0,
        sigmas.1.to_degrees(),
        claimed.0,
        claimed.1.to_degrees(),
        of_loops.0,
        of_loops.1.to_degrees(),
    )?;
    Ok(joined == anchors.len() && ours <= RATIO_MAX * theirs)
}

/// What aligning took of each robot's computer, and how much of it was in vain.
fn work(outcome: &Outcome<Agent>, out: &mut impl Write) -> anyhow::Result<()> {
    let stats = outcome.robots.iter().filter_map(|robot| robot.snapshot.as_ref()).map(|snapshot| &snapshot.stats.work);
    let done = |kind: &str| stats.clone().filter_map(|work| work.get(kind)).sum::<u64>();
    let secs = outcome.ended.as_secs_f64() * outcome.usage.len() as f64;
    let laps = outcome.stopwatch.laps();
    let share = |kind: &str| 100.0 * laps.iter().filter(|lap| lap.0 == kind).map(|lap| lap.2).sum::<f64>() / secs;
    writeln!(
        out,
        "alignments tried: {}, of which {} came to nothing; of a core each robot took {:.1} % for them, {:.1} % for \
         describing and {:.1} % for solving",
        done("align"),
        done("refused"),
        share("align"),
        share("describe"),
        share("solve")
    )?;
    Ok(())
}

/// Whether tries came out as probable as they had seemed.
fn expectations(outcome: &Outcome<Agent>, out: &mut impl Write) -> anyhow::Result<()> {
    let tries = outcome.told.iter().filter_map(|(_, _, event)| match event {
        Event::AlignmentTried { expected, found, .. } => Some((*expected, f64::from(u8::from(*found)))),
        _ => None,
    });
    let tries: Vec<(f64, f64)> = tries.collect();
    let mean = |of: &[f64]| of.iter().sum::<f64>() / of.len() as f64;
    let fifths = (0..5).map(|fifth| {
        let is_in = |expected: f64| ((expected * 5.0) as usize).min(4) == fifth;
        let found: Vec<f64> = tries.iter().filter(|one| is_in(one.0)).map(|one| one.1).collect();
        let share = if found.is_empty() { "–".to_owned() } else { format!("{:.0} %", 100.0 * mean(&found)) };
        format!("to {} %: {share} of {}", 20 * (fifth + 1), found.len())
    });
    let error = mean(&tries.iter().map(|(expected, found)| (expected - found).powi(2)).collect::<Vec<_>>());
    let rate = mean(&tries.iter().map(|one| one.1).collect::<Vec<_>>());
    writeln!(
        out,
        "of tries that seemed good for so much came to something: {}; mean squared error {error:.3}, of who knows no more \
         than the rate {:.3}",
        fifths.collect::<Vec<_>>().join(", "),
        rate * (1.0 - rate)
    )?;
    Ok(())
}

/// How many refused pairs were looked at again, and what came of it.
fn second_looks(outcome: &Outcome<Agent>, out: &mut impl Write) -> anyhow::Result<()> {
    let looks = outcome.told.iter().filter_map(|(_, _, event)| match event {
        Event::LookedAgain { found, .. } => Some(*found),
        _ => None,
    });
    let looks: Vec<bool> = looks.collect();
    let found = looks.iter().filter(|found| **found).count();
    writeln!(
        out,
        "refused pairs looked at again with further keypoints: {}, of which {found} came to something",
        looks.len()
    )?;
    Ok(())
}

/// What each robot sent.
fn traffic(outcome: &Outcome<Agent>, out: &mut impl Write) -> anyhow::Result<bool> {
    let (ended, half) = (outcome.ended.as_secs_f64(), 0.5 * outcome.scenario.duration_secs);
    sent(outcome, &format!("sent by a robot over {ended:.0} s"), |usage| usage.bytes as f64 / ended, out)?;
    let steady = format!("in the second half of the drive (goal {SENT_MAX:.0} at most)");
    Ok(sent(outcome, &steady, |usage| usage.later as f64 / half, out)? <= SENT_MAX)
}

/// Prints what a robot sends by kind, bytes per second, and returns the most that one sends.
fn sent(
    outcome: &Outcome<Agent>,
    when: &str,
    rate: impl Fn(&Usage) -> f64,
    out: &mut impl Write,
) -> anyhow::Result<f64> {
    let mut of_kind: BTreeMap<&str, f64> = BTreeMap::new();
    for (kind, usage) in outcome.usage.iter().flatten() {
        *of_kind.entry(kind).or_default() += rate(usage) / outcome.usage.len() as f64;
    }
    let most = outcome.usage.iter().map(|kinds| kinds.values().map(&rate).sum()).fold(0.0, f64::max);
    let mean = of_kind.values().sum::<f64>();
    let kinds: Vec<String> = of_kind.iter().map(|(kind, bytes)| format!("{kind} {bytes:.0}")).collect();
    writeln!(out, "{when}: {mean:.0} B/s, at most {most:.0}: {}", kinds.join(", "))?;
    Ok(most)
}

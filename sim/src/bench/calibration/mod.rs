//! `merganser-sim bench calibration`: whether what robots believe of one another is as uncertain as they say. Whole
//! swarms of real agents run with messages lost, halves cut apart for a while, and logs condensed; only alignments are
//! made up: the truth, with the noise that they state. At the end the errors of frames, submaps and live poses, in the
//! first robot's frame, are normalised by the covariances claimed for them (NEES). A run is one sample of each: its
//! mean, as errors within a run are much alike.

use crate::bar::progress_bar;
use crate::bench::anchors::anchors;
use crate::scenario::Scenario;
use crate::swarm::{Outcome, Swarm};
use crate::truth::nees;
use anyhow::{Context, ensure};
use clap::{Args, ValueEnum};
use core::fmt;
use merganser_protocol::agent::Agent;
use merganser_protocol::config::Sensor;
use merganser_protocol::geometry::Se3;
use merganser_protocol::snapshot::Snapshot;
use std::io::Write;

const SCENARIO: &str = include_str!("honest.toml");
/// Degrees of freedom of a pose.
const DOF: f64 = 6.0;
/// Where the mean of many runs is to lie, by degrees of freedom.
const BAND: [f64; 2] = [0.93, 1.07];
/// Standard errors that the mean of few runs may be off by.
const ERRORS: f64 = 2.576;

/// Standard deviations that may be asked for, m or rad.
const SIGMA: core::ops::RangeInclusive<f64> = 1e-4..=1.0;

/// `bench calibration`.
#[derive(Debug, Args)]
pub struct Calibration {
    /// What robots see with, and so how much alike alignments of one submap err
    #[arg(long, value_enum)]
    world: Vec<World>,
    /// Swarms of each
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u64).range(2..=100_000))]
    seeds: u64,
    /// The first swarm's seed
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..1 << 62))]
    first: u64,
    /// How sure alignments are: standard deviations, m and rad
    #[arg(long, num_args = 2, value_names = ["M", "RAD"], value_parser = sigma)]
    sigma: Option<Vec<f64>>,
}

/// How alignments err.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum World {
    /// A LiDAR: a fifth of the variance is common to alignments of the one submap, and of the other
    Lidar,
    /// A depth camera, which bends every view of a place alike: half of it is
    Depth,
}

/// NEES by degrees of freedom, the mean of one run.
#[derive(Clone, Copy, Debug)]
struct Sample {
    frames: f64,
    submaps: f64,
    live: f64,
    /// Logs were condensed.
    condensed: bool,
}

/// Mean of many swarms and its standard error.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mean {
    /// NEES by degrees of freedom.
    pub mean: f64,
    /// Standard error.
    pub error: f64,
}

/// What many swarms amount to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Means {
    /// Of frames, submaps and live poses.
    pub of: [Mean; 3],
    /// Swarms.
    pub swarms: usize,
    /// Swarms in which logs were condensed.
    pub condensed: usize,
}

/// Measures and prints. Returns whether all means may lie in the band.
///
/// # Errors
/// A run that cannot be made, that broke an invariant or did not merge; standard output that cannot be written.
pub fn run(options: &Calibration) -> anyhow::Result<bool> {
    let sigma = options.sigma.as_deref().and_then(|sigma| <[f64; 2]>::try_from(sigma).ok());
    let worlds = if options.world.is_empty() { vec![World::Lidar, World::Depth] } else { options.world.clone() };
    let bar = progress_bar(worlds.len() as u64 * options.seeds, "swarms")?;
    let mut out = std::io::stdout().lock();
    let mut all = true;
    writeln!(
        out,
        "{:<8} {:>6} {:>10} {:>15} {:>15} {:>15}",
        "", "swarms", "condensed", "frames", "submaps", "live poses"
    )?;
    for world in worlds {
        let means = measure(world, sigma, options.first..options.first + options.seeds, || bar.inc(1))?;
        let [frames, submaps, live] = means.of.map(|mean| mean.to_string());
        let (swarms, condensed) = (means.swarms, means.condensed);
        bar.suspend(|| writeln!(out, "{world:<8} {swarms:>6} {condensed:>10} {frames:>15} {submaps:>15} {live:>15}"))?;
        all &= means.of.iter().all(|mean| mean.may_be_honest());
    }
    bar.finish_and_clear();
    writeln!(
        out,
        "normalised squared errors by degrees of freedom in the first robot's frame, mean over swarms and its standard \
         error; honest within {} to {}",
        BAND[0], BAND[1]
    )?;
    Ok(all)
}

/// Runs swarms of these seeds, with alignments as sure as `sigma` says or as the scenario does; `tick` is called after
/// each.
///
/// # Errors
/// A run that cannot be made, that broke an invariant or did not merge.
pub fn measure(
    world: World,
    sigma: Option<[f64; 2]>,
    seeds: core::ops::Range<u64>,
    mut tick: impl FnMut(),
) -> anyhow::Result<Means> {
    let mut samples = Vec::new();
    for seed in seeds {
        samples.push(sample(world, sigma, seed).with_context(|| format!("{world} seed {seed}"))?);
        tick();
    }
    let of = [|s: &Sample| s.frames, |s: &Sample| s.submaps, |s: &Sample| s.live].map(|of| Mean::of(&samples, of));
    Ok(Means { of, swarms: samples.len(), condensed: samples.iter().filter(|sample| sample.condensed).count() })
}

fn sample(world: World, sigma: Option<[f64; 2]>, seed: u64) -> anyhow::Result<Sample> {
    let mut scenario = Scenario::parse(SCENARIO)?;
    let (sensor, common) = match world {
        World::Lidar => (Sensor::Lidar3d, 0.2),
        World::Depth => (Sensor::Points3d, 0.5),
    };
    scenario.config.submap.sensor = sensor;
    let summary = scenario.summary.as_mut().context("no summary")?;
    summary.common = common;
    summary.sigma = sigma.unwrap_or(summary.sigma);
    let outcome = Swarm::<Agent>::new(scenario, seed)?.run(|_| {})?;
    if let Some(violation) = &outcome.violation {
        anyhow::bail!("{} at {:.1} s: {}", violation.invariant, violation.at_secs, violation.what);
    }
    let snapshot = outcome.robots.first().and_then(|robot| robot.snapshot.as_ref()).context("no robot is left")?;
    let t_world_own = outcome.truth.get(&snapshot.frames.own).context("a frame without truth")?.to_se3();
    Ok(Sample {
        frames: mean(frames(&outcome, snapshot, &t_world_own)?)?,
        submaps: mean(submaps(&outcome, snapshot, &t_world_own)?)?,
        live: mean(live(&outcome, snapshot, &t_world_own)?)?,
        condensed: outcome.counts.condensed > 0,
    })
}

/// Of the other frames.
fn frames(outcome: &Outcome<Agent>, snapshot: &Snapshot, t_world_own: &Se3) -> anyhow::Result<Vec<f64>> {
    let others = snapshot.frames.frames.iter().filter(|frame| frame.frame != snapshot.frames.own);
    let of = |frame: &merganser_protocol::snapshot::FrameView| {
        let t_world_frame = outcome.truth.get(&frame.frame).context("a frame without truth")?;
        let relation = frame.t_own_frame.as_ref().with_context(|| format!("{} is not merged", frame.frame))?;
        Ok(nees(relation, &(t_world_own.inverse() * t_world_frame.to_se3())))
    };
    others.map(of).collect()
}

/// Of all submaps, but for the first of the own frame, which hardly moves.
fn submaps(outcome: &Outcome<Agent>, snapshot: &Snapshot, t_world_own: &Se3) -> anyhow::Result<Vec<f64>> {
    let all = anchors(outcome, snapshot)?;
    let others = all.iter().filter(|anchor| anchor.robot != 0 || anchor.index != 0);
    let of = |anchor: &crate::bench::anchors::Anchor| {
        let relation = anchor.t_own_anchor.as_ref().with_context(|| format!("{} is not merged", anchor.name))?;
        Ok(nees(relation, &(t_world_own.inverse() * anchor.t_world_anchor)))
    };
    others.map(of).collect()
}

/// Of robots where they were last.
fn live(outcome: &Outcome<Agent>, snapshot: &Snapshot, t_world_own: &Se3) -> anyhow::Result<Vec<f64>> {
    let of = |view: &merganser_protocol::snapshot::RobotView| {
        let robot = outcome.stage.names().iter().position(|name| *name == view.robot).context("an unknown robot")?;
        let steps = outcome.stage.steps(robot);
        // Stamps are of the robot's own clock, which its first keyframe tells.
        let first = snapshot.map.submaps.iter().find(|submap| submap.robot == view.robot && submap.index == 0);
        let began = first.context("its first submap is gone")?.stamps_secs[0];
        let nanos = steps[0].nanos as f64 + 1e9 * (view.stamp_secs - began);
        let step = steps.iter().min_by(|a, b| {
            let off = |step: &crate::world::drive::Step| (step.nanos as f64 - nanos).abs();
            off(a).total_cmp(&off(b))
        });
        let t_world_body = step.context("a robot that never drove")?.t_world_body;
        let relation = view.t_own_body.as_ref().with_context(|| format!("{} is not merged", view.robot))?;
        Ok(nees(relation, &(t_world_own.inverse() * t_world_body)))
    };
    snapshot.poses.robots.iter().map(of).collect()
}

fn mean(nees: Vec<f64>) -> anyhow::Result<f64> {
    ensure!(!nees.is_empty(), "nothing to measure");
    Ok(nees.iter().sum::<f64>() / nees.len() as f64 / DOF)
}

fn sigma(text: &str) -> Result<f64, String> {
    let value: f64 = text.parse().map_err(|_| format!("{text} is no number"))?;
    let holds = SIGMA.contains(&value);
    holds.then_some(value).ok_or_else(|| format!("{value} is out of range; use {} to {}", SIGMA.start(), SIGMA.end()))
}

impl Mean {
    fn of(samples: &[Sample], value: impl Fn(&Sample) -> f64) -> Self {
        let n = samples.len() as f64;
        let mean = samples.iter().map(&value).sum::<f64>() / n;
        let variance = samples.iter().map(|s| (value(s) - mean).powi(2)).sum::<f64>() / (n - 1.0);
        Self { mean, error: (variance / n).sqrt() }
    }

    /// Whether the mean of ever more swarms may lie in the band.
    pub fn may_be_honest(&self) -> bool {
        let off = ERRORS * self.error;
        self.mean - off <= BAND[1] && self.mean + off >= BAND[0]
    }
}

impl fmt::Display for Mean {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:.3} ± {:.3}", self.mean, self.error)
    }
}

impl fmt::Display for World {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(match self {
            Self::Lidar => "lidar",
            Self::Depth => "depth",
        })
    }
}

//! The demonstration: an agent process per recording, over real Zenoh, watched from outside until all hold one map;
//! then the map is compared with the recordings' truth, and everything is printed, written and drawn.

mod bundle;
pub mod certainty;
pub mod evaluate;
mod outputs;
mod report;
mod scene;
mod swarm;
pub mod track;
pub mod trajectory;
pub mod views;
mod warnings;
mod watch;

#[cfg(test)]
mod certainty_tests;
#[cfg(test)]
mod far_tests;
#[cfg(test)]
mod scale_tests;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod vain_tests;

use crate::commands::topics::Topics;
use crate::commands::{runtime, say};
use crate::config::{LogConfig, LogFormat};
use crate::recording::Recording;
use crate::recording::import::{self, Prepared};
use crate::telemetry;
use anyhow::{Context, Result, bail};
use evaluate::{Bounds, Evaluation};
use outputs::Outcome;
use std::fs;
use std::path::{Path, PathBuf};
use std::time::Duration;
use swarm::Swarm;
use track::Track;
use watch::{Ending, Interrupts, Seen};

/// Folder, inside the output folder, of what the agents need while they run.
const WORK: &str = "work";
/// Folder of recordings made for this run.
const RECORDINGS: &str = "recordings";
/// A file by which we know a folder of ours, so that nobody else's is ever removed.
const MARK: &str = ".merganser-demo";
/// Without `--timeout`: this long after the last keyframe, if robots still work then. A map is judged when all tries are
/// done.
const TIMEOUT_AFTER_SECS: f64 = 600.0;

/// What `merganser demo` can be told.
#[derive(Clone, Debug, clap::Args)]
pub struct DemoArgs {
    /// Use this data instead of the built-in recordings: a folder of recordings (one folder per robot), of 7-Scenes
    /// RGB-D frames, of LiDAR scans (KITTI's, or a gtsam_points dump), of logs, or of ROS bags; or one bag.
    #[arg(long, value_name = "PATH")]
    pub data: Option<PathBuf>,
    /// Which topics of a ROS bag.
    #[command(flatten)]
    pub topics: Topics,
    /// Feed the recordings this many times faster than they were made.
    #[arg(long, value_name = "X", default_value_t = 10.0, value_parser = positive)]
    pub speed: f64,
    /// Where the map, the paths and the picture go; `target/demo` inside a Cargo workspace, else `./merganser-demo`.
    #[arg(long, value_name = "DIR")]
    pub out: Option<PathBuf>,
    /// Seed of the drift laid on data sets that have none, and of the agents.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Keep the agents' stores, keys, configurations and logs, and the recordings.
    #[arg(long)]
    pub keep: bool,
    /// Give up after so many seconds, though robots still work; 600 after the last keyframe, if absent.
    #[arg(long, value_name = "SECS", value_parser = positive)]
    pub timeout: Option<f64>,
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (1e-3..=1e6).contains(&value) => Ok(value),
        _ => Err("use a number from 0.001 to 1000000".into()),
    }
}

/// Runs the demonstration; `Ok(true)` if all robots merged and every check held.
///
/// # Errors
/// Whatever stopped it: bad data, an agent that ended, a file that could not be written, an interruption.
pub fn run(args: DemoArgs) -> Result<bool> {
    telemetry::init(&LogConfig { format: LogFormat::Text, filter: "warn,zenoh=off".into() });
    let out = args.out.clone().unwrap_or_else(default_out);
    let work = fresh(&out)?;
    let (recordings, bounds) = prepare(&args, &work)?;
    outputs::remove_old(&out)?;
    let tracks: Vec<Track> = recordings.iter().map(Track::of).collect();
    say(&format!("{} robots, each with its own recording, local frame and process", recordings.len()))?;
    say(&report::recordings(&recordings, args.speed))?;
    let runtime = runtime()?;
    let played = runtime.block_on(play(&args, &recordings, &tracks, &work));
    runtime.shutdown_timeout(Duration::from_millis(200));
    let Played { seen, memory, tails, warnings } = played?;
    let evaluation = evaluate::evaluate(&tracks, &seen.views, bounds.as_ref());
    let files = write(&recordings, &tracks, &seen, &evaluation, &out)?;
    say(&told(&seen))?;
    if !warnings.is_empty() {
        say(&format!("The robots warned:\n{warnings}"))?;
    }
    say(&report::evaluation(&evaluation, &tracks))?;
    say(&report::costs(&seen.views, &memory))?;
    say(&report::checks(&evaluation.checks))?;
    say(&format!("Written to {}: {files}", out.display()))?;
    if !evaluation.held() {
        say(&format!("Not every check held. The agents' files are in {}.", work.display()))?;
        if seen.ending != Ending::Done {
            say(&format!("The ends of their logs:\n{tails}"))?;
        }
        return Ok(false);
    }
    if !args.keep {
        fs::remove_dir_all(&work).with_context(|| work.display().to_string())?;
    }
    Ok(true)
}

/// What is left when the agents have ended.
struct Played {
    seen: Seen,
    /// Resident memory of each agent, now and at its largest.
    memory: Vec<Option<(u64, u64)>>,
    /// The ends of the logs.
    tails: String,
    /// What the logs warn of.
    warnings: String,
}

async fn play(args: &DemoArgs, recordings: &[Recording], tracks: &[Track], work: &Path) -> Result<Played> {
    // Before there is an agent that could be left behind.
    let mut interrupts = Interrupts::catch()?;
    let mut swarm = Swarm::start(recordings, &work.join("robots"), args.speed, args.seed)?;
    if let Some(endpoint) = swarm.endpoints.first() {
        say(&format!("Look on meanwhile: merganser watch --no-multicast --connect {endpoint}\n"))?;
    }
    let playing = recordings.iter().map(Recording::ends_after_secs).fold(0.0, f64::max) / args.speed;
    let timeout = args.timeout.unwrap_or(playing + TIMEOUT_AFTER_SECS);
    let timeout = Duration::try_from_secs_f64(timeout).context("--timeout")?;
    let playing = Duration::try_from_secs_f64(playing).context("--speed")?;
    let seen = tokio::select! {
        seen = watch::watch(&mut swarm, tracks, playing, timeout) => seen?,
        told = interrupts.wait() => told?,
    };
    let memory = swarm.agents.iter().map(swarm::Agent::memory).collect();
    let tails = swarm.agents.iter().map(|agent| format!("{}: {}\n", agent.name, agent.log_tail())).collect();
    let warnings = warnings::told(swarm.agents.iter().map(|agent| (&agent.name, agent.log_start())));
    Ok(Played { seen, memory, tails, warnings })
}

/// The recordings, and how large the errors may be in the built-in ones, which are known. What others can be like, only
/// the robots can tell: they are judged by what they claim.
fn prepare(args: &DemoArgs, work: &Path) -> Result<(Vec<Recording>, Option<Bounds>)> {
    let folder = work.join(RECORDINGS);
    let Some(data) = &args.data else {
        args.topics.refuse("--data")?;
        bundle::unpack(&folder)?;
        return Ok((import::open_all(&folder)?, Some(Bounds { translation_m: 0.15, rotation_deg: 1.5 })));
    };
    let Prepared { recordings, remarks } = import::prepare_topics(data, &folder, args.seed, &args.topics.wanted())?;
    let warn = |text: String| drop(console::Term::stderr().write_line(&format!("merganser: {text}")));
    remarks.into_iter().for_each(|remark| warn(format!("{}: {remark}", data.display())));
    for recording in &recordings {
        recording.check_clouds()?.told().into_iter().for_each(warn);
    }
    Ok((recordings, None))
}

fn write(
    recordings: &[Recording],
    tracks: &[Track],
    seen: &Seen,
    evaluation: &Evaluation,
    out: &Path,
) -> Result<String> {
    let keyframes: usize = recordings.iter().map(Recording::len).sum();
    let error =
        evaluation.trajectory.as_ref().map_or(String::new(), |t| format!(", trajectory error {:.3} m", t.merged_m.1));
    let headline = format!("{keyframes} keyframes, {:.1} s{error}", seen.after.as_secs_f64());
    let outcome = Outcome { recordings, tracks, views: &seen.views, evaluation, headline };
    let (files, offset) = outputs::write(&outcome, out)?;
    let names: Vec<String> =
        files.iter().filter_map(|path| Some(path.file_name()?.to_string_lossy().into_owned())).collect();
    let told = offset.map_or(String::new(), |offset| {
        let [x, y, z] = offset.into();
        format!("; the merged map is written relative to ({x}, {y}, {z}), so that 32 bits suffice")
    });
    Ok(names.join(", ") + &told)
}

fn told(seen: &Seen) -> String {
    let secs = seen.after.as_secs_f64();
    match seen.ending {
        Ending::Done => format!("All robots hold one map after {secs:.1} s.\n"),
        Ending::Settled => format!("After {secs:.1} s nothing moves any more, but not all robots merged.\n"),
        Ending::TimedOut => format!("Gave up after {secs:.1} s.\n"),
    }
}

/// `target/demo` of the Cargo workspace around the current folder, if there is one.
fn default_out() -> PathBuf {
    let here = std::env::current_dir().unwrap_or_default();
    let workspace =
        here.ancestors().find(|folder| folder.join("Cargo.lock").is_file() && folder.join("target").is_dir());
    workspace.map_or_else(|| PathBuf::from("merganser-demo"), |folder| folder.join("target").join("demo"))
}

/// An empty work folder in `out`. One that an earlier run left is removed; anything else is not.
fn fresh(out: &Path) -> Result<PathBuf> {
    let work = out.join(WORK);
    let mark = work.join(MARK);
    if mark.is_file() {
        fs::remove_dir_all(&work).with_context(|| work.display().to_string())?;
    } else if work.exists() {
        bail!("{} exists and is not ours; choose another folder with --out", work.display());
    }
    fs::create_dir_all(&work).with_context(|| work.display().to_string())?;
    fs::write(&mark, "").with_context(|| mark.display().to_string())?;
    Ok(work)
}

//! `merganser doctor`: looks at keyframes as an agent does, before there is a swarm: those of recordings or of a data set,
//! or what a running SLAM sends. It tells what it sees and what to change.

mod clock;
mod examine;
mod report;

use super::scratch::Scratch;
use super::topics::Topics;
use super::{BadInput, runtime, say};
use crate::config::FileConfig;
use crate::keys;
use crate::link::overhear::overhear;
use crate::recording::Recording;
use crate::recording::import;
use anyhow::Result;
pub use examine::{Examination, Examined};
use merganser_protocol::time::{Instant, Stamp};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// What `merganser doctor` can be told.
#[derive(Clone, Debug, clap::Args)]
#[command(
    after_help = "PATH is a recording, a folder of recordings, a data set that `merganser demo --data` reads, a ROS bag, or one CARMEN log. With \
                        --config it listens to a running SLAM instead, where this robot's agent would; the agent must \
                        not run meanwhile.\n\
                        Exit codes: 0 nothing to change, 1 something, 2 the command line or a file is wrong."
)]
#[group(required = true, multiple = false)]
pub struct Source {
    /// What to look at.
    pub path: Option<PathBuf>,
    /// Listen to the SLAM of the robot with this configuration.
    #[arg(long, short, value_name = "FILE")]
    pub config: Option<PathBuf>,
}

/// See [`Source`].
#[derive(Clone, Debug, clap::Args)]
pub struct DoctorArgs {
    #[command(flatten)]
    source: Source,
    #[command(flatten)]
    topics: Topics,
    /// How long to listen.
    #[arg(long, value_name = "SECS", default_value_t = 10.0, value_parser = secs)]
    pub secs: f64,
    /// Print JSON: a list with an object for each robot.
    #[arg(long)]
    pub json: bool,
}

fn secs(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(secs) if (1.0..=3600.0).contains(&secs) => Ok(secs),
        _ => Err("use 1 to 3600 s".into()),
    }
}

/// Robots that a log is cut into: the fewest that there can be.
const LOG_ROBOTS: usize = 2;

/// Looks, tells, and whether there is nothing to change.
///
/// # Errors
/// A file that cannot be used, or an endpoint that cannot be had.
pub fn run(args: &DoctorArgs) -> Result<bool> {
    let examined = match &args.source {
        Source { config: Some(config), .. } => {
            args.topics.refuse("its path")?;
            vec![listen(&FileConfig::load(config)?, args.secs)?]
        }
        Source { path: Some(path), .. } => of_path(path, &args.topics)?,
        Source { .. } => return Err(BadInput::told("name a recording, or a configuration by --config")),
    };
    let text = if args.json {
        serde_json::to_string_pretty(&examined)?
    } else {
        examined.iter().map(report::text).collect::<Vec<_>>().join("\n")
    };
    say(text.trim_end())?;
    Ok(examined.iter().all(|examined| examined.remarks.is_empty()))
}

fn listen(config: &FileConfig, secs: f64) -> Result<Examined> {
    let told = |endpoints: &[String]| {
        let line = format!("listening for {secs} s at {}", endpoints.join(" and "));
        let _ = console::Term::stderr().write_line(&line); // who cannot read it can wait
    };
    let runtime = runtime()?;
    let heard = runtime.block_on(overhear(config, Duration::from_secs_f64(secs), told));
    runtime.shutdown_timeout(Duration::from_millis(200));
    let heard = heard?;
    let mut examination = Examination::new(config.robot.to_string(), config.core.clone());
    heard.refused.into_iter().for_each(|(reason, count)| examination.refuse(reason, count));
    let first = heard.keyframes.first().map(|(at, _)| *at);
    let came = first
        .and_then(|first| SystemTime::now().checked_sub(first.elapsed())?.duration_since(SystemTime::UNIX_EPOCH).ok());
    if let Some(came) = came.and_then(|since| i64::try_from(since.as_nanos()).ok()) {
        examination.came(Stamp(came));
    }
    for (at, keyframe) in heard.keyframes {
        let since = first.map_or(Duration::ZERO, |first| at.duration_since(first));
        examination.take(Some(Instant::ZERO.after(since)), keyframe);
    }
    let key = keys::of(&config.swarm, &config.robot, "in/keyframe");
    Ok(examination.finish(Some(&key)))
}

fn of_path(path: &Path, topics: &Topics) -> Result<Vec<Examined>> {
    if path.join(crate::recording::MANIFEST).is_file() {
        import::refuse_topics(path, &topics.wanted())?;
        return Ok(vec![of_recording(&Recording::open(path)?)?]);
    }
    let scratch = Scratch::new("doctor")?;
    let prepared = if import::is_bag(path) {
        import::prepare_bag(path, scratch.path(), &topics.wanted())?
    } else {
        import::refuse_topics(path, &topics.wanted())?;
        if path.is_file() {
            import::prepare_log(path, scratch.path(), LOG_ROBOTS)?
        } else {
            import::prepare(path, scratch.path(), 1)?
        }
    };
    for remark in prepared.remarks {
        console::Term::stderr().write_line(&format!("merganser: {}: {remark}", path.display()))?;
    }
    prepared.recordings.iter().map(of_recording).collect()
}

fn of_recording(recording: &Recording) -> Result<Examined> {
    let manifest = recording.manifest();
    let mut examination = Examination::new(manifest.robot.to_string(), manifest.config.clone());
    for index in 0..recording.len() {
        if examination.has_enough() {
            break;
        }
        examination.take(None, recording.keyframe(index)?);
    }
    Ok(examination.finish(None))
}

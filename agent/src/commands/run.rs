//! `merganser run`: one robot's agent, from its configuration to an orderly end on SIGINT or SIGTERM.

use super::scratch::Scratch;
use super::topics::Topics;
use super::{BadInput, runtime, say};
use crate::config::FileConfig;
use crate::driver::Finished;
use crate::host::{Host, Options};
use crate::link::refusals::Refusals;
use crate::link::scouting::Scouting;
use crate::link::session::{self, LinkError};
use crate::queue::{Drops, Inbox};
use crate::recording::import::{self, Prepared};
use crate::recording::{Recording, Remarks};
use crate::telemetry;
use anyhow::{Context, Result};
use merganser_protocol::agent::io::{Command, Input};
use merganser_protocol::time::Stamp;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tracing::{info, warn};

/// Time between two warnings about what was dropped.
const DROPS_EVERY: Duration = Duration::from_secs(10);
/// Keyframes read ahead of their time.
const READ_AHEAD: usize = 4;

/// What `merganser run` can be told.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    /// The configuration file.
    #[arg(long, short, value_name = "FILE")]
    pub config: PathBuf,
    /// Feed keyframes of this recording or ROS bag, as if the robot's SLAM sent them.
    #[arg(long, value_name = "PATH")]
    pub recording: Option<PathBuf>,
    /// Which topics of a ROS bag.
    #[command(flatten)]
    pub topics: Topics,
    /// Feed the recording this many times faster than it was made.
    #[arg(long, value_name = "X", default_value_t = 1.0, requires = "recording", value_parser = speed)]
    pub speed: f64,
    /// Write all inputs to this file, for `merganser replay`.
    #[arg(long, value_name = "FILE")]
    pub journal: Option<PathBuf>,
    /// Begin a new epoch: the robot's SLAM restarted in a new map frame.
    #[arg(long)]
    pub new_epoch: bool,
    /// Seed of the core's random choices; the system's randomness if absent.
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// End when the standard input is closed: a parent that is killed then leaves no agent behind.
    #[arg(long, hide = true)]
    pub leash: bool,
}

fn speed(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(speed) if (1e-3..=1e4).contains(&speed) => Ok(speed),
        _ => Err("use a number from 0.001 to 10000".into()),
    }
}

/// Runs the agent until a signal ends it, then prints the digest of its facts.
///
/// # Errors
/// If the configuration, the store, the core or Zenoh does not let it start.
pub fn run(args: &RunArgs) -> Result<bool> {
    let config = FileConfig::load(&args.config)?;
    let refused = telemetry::init(&config.log);
    // What is made of a bag lies there until the agent ends.
    let mut scratch = None;
    if args.recording.is_none() {
        args.topics.refuse("--recording")?;
    }
    let recording = args.recording.as_ref().map(|path| open(path, args, &config, &mut scratch)).transpose()?;
    let runtime = runtime()?;
    let finished = runtime.block_on(live(args, config, recording, refused));
    runtime.shutdown_timeout(Duration::from_millis(200)); // a job that still runs is of no use any more
    let finished = finished?;
    say(&format!("digest {}", finished.digest))?;
    Ok(true)
}

/// A recording, or what a bag holds of this robot.
fn open(path: &Path, args: &RunArgs, config: &FileConfig, scratch: &mut Option<Scratch>) -> Result<Recording> {
    let wanted = args.topics.wanted();
    if !import::is_bag(path) {
        import::refuse_topics(path, &wanted)?;
        return Ok(Recording::open(path)?);
    }
    let scratch = scratch.insert(Scratch::new("run")?);
    let Prepared { mut recordings, remarks } = import::prepare_bag(path, scratch.path(), &wanted)?;
    remarks.iter().for_each(|remark| warn!("{remark}"));
    if recordings.len() == 1 {
        return Ok(recordings.remove(0));
    }
    let names: Vec<String> = recordings.iter().map(|recording| recording.manifest().robot.to_string()).collect();
    let mine = recordings.into_iter().find(|recording| recording.manifest().robot == config.robot);
    mine.ok_or_else(|| {
        BadInput::told(format!(
            "{}: holds the robots {}, none of which is {}: choose one by its topics, --odometry /NAME/… --cloud /NAME/…",
            path.display(),
            names.join(", "),
            config.robot
        ))
    })
}

async fn live(
    args: &RunArgs,
    mut config: FileConfig,
    recording: Option<Recording>,
    refused: Arc<Refusals>,
) -> Result<Finished> {
    let stop = stop_signal()?;
    if let Some(recording) = &recording {
        suit(&mut config, recording);
    }
    let names_peers = !session::others(&config.zenoh).is_empty();
    let mut host = Host::start(config, Options { journal: args.journal.clone(), seed: args.seed }).await?;
    let inbox = host.inbox().clone();
    let drops = tokio::spawn(tell_drops(inbox.drops.clone(), refused));
    let feed = tokio::spawn(feed(inbox, args.new_epoch, recording, args.speed));
    let feeding = feed.abort_handle();
    let scouting = host.take_scouting();
    let ended = tokio::select! {
        () = stop => Ok(()),
        error = astray(scouting, names_peers) => Err(error.into()),
        () = let_go(args.leash) => Ok(()),
        error = host.broken() => return Err(error.into()),
        bad = bad_feed(feed) => Err(bad),
    };
    [drops.abort_handle(), feeding].iter().for_each(tokio::task::AbortHandle::abort);
    let finished = host.stop().await?;
    ended.map(|()| finished)
}

/// Completes when whoever held the other end of the standard input is gone.
async fn let_go(leash: bool) {
    let (sender, receiver) = tokio::sync::oneshot::channel();
    if leash {
        // A thread of its own: reading cannot be given up, and must not keep the runtime from ending.
        std::thread::spawn(move || {
            let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
            let _ = sender.send(());
        });
        let _ = receiver.await;
    } else {
        std::future::pending().await
    }
}

/// Completes when this host has an address from which Zenoh will never scout. Whoever names peers is told and goes on:
/// these are called again and again, from wherever we are.
async fn astray(scouting: Option<Scouting>, names_peers: bool) -> LinkError {
    let Some(mut scouting) = scouting else { return std::future::pending().await };
    loop {
        let place = scouting.outgrown().await;
        if !names_peers {
            return LinkError::Astray { place };
        }
        warn!(
            %place,
            "a new address: peers that zenoh.connect does not name are not found from there until the agent starts again"
        );
    }
}

/// Completes with what was wrong with the recording; never, if it is good.
async fn bad_feed(feed: tokio::task::JoinHandle<Result<()>>) -> anyhow::Error {
    match feed.await {
        Ok(Err(bad)) => bad,
        _ => std::future::pending().await,
    }
}

/// A recording knows what suits its sensor; a file that sets any of the core's knobs knows better.
fn suit(config: &mut FileConfig, recording: &Recording) {
    if config.core == merganser_protocol::config::Config::default() {
        config.core = recording.manifest().config.clone();
    }
}

/// Completes at the first SIGINT or SIGTERM; a second one ends the process on the spot.
fn stop_signal() -> Result<impl Future<Output = ()> + Send + 'static> {
    let mut interrupt = signal(SignalKind::interrupt()).context("cannot listen for signals")?;
    let mut terminate = signal(SignalKind::terminate()).context("cannot listen for signals")?;
    let (sender, receiver) = tokio::sync::oneshot::channel();
    tokio::spawn(async move {
        let mut next = async || {
            tokio::select! {
                _ = interrupt.recv() => "SIGINT",
                _ = terminate.recv() => "SIGTERM",
            }
        };
        let name = next().await;
        info!(signal = name, "ending");
        let _ = sender.send(());
        next().await;
        std::process::exit(1);
    });
    Ok(async move {
        let _ = receiver.await;
    })
}

async fn tell_drops(drops: Arc<Drops>, refused: Arc<Refusals>) {
    let mut seen = BTreeMap::new();
    loop {
        tokio::time::sleep(DROPS_EVERY).await;
        for (refusal, count) in refused.take() {
            let others = "refused: links, for other reasons";
            if drops.count_named_times(refusal.to_string(), count, others) {
                warn!(cure = refusal.cure(), "{refusal}; the next ones of this kind are only counted");
            }
        }
        for line in drops.news(&mut seen) {
            warn!("{line}");
        }
    }
}

async fn feed(inbox: Inbox, new_epoch: bool, recording: Option<Recording>, speed: f64) -> Result<()> {
    if new_epoch {
        inbox.feed(Input::Command(Command::NewEpoch)).await;
    }
    match recording {
        Some(recording) => play(&inbox, recording, speed).await,
        None => Ok(()),
    }
}

/// Feeds a recording in its own time, `speed` times faster, and closes the last submap. Where other robots were seen
/// says something only in real time: how old their beacons are, nobody can tell whose time runs otherwise.
async fn play(inbox: &Inbox, recording: Recording, speed: f64) -> Result<()> {
    let begins = recording.begins();
    let positions = if speed == 1.0 { recording.positions().to_vec() } else { Vec::new() };
    if positions.len() < recording.positions().len() {
        info!(count = recording.positions().len(), "sightings of other robots are left out; they need --speed 1");
    }
    let mut positions = positions.into_iter().peekable();
    let (sender, mut keyframes) = mpsc::channel(READ_AHEAD);
    let reader = tokio::task::spawn_blocking(move || {
        let mut remarks = Remarks::default();
        for (index, line) in recording.keyframes().iter().enumerate() {
            let keyframe = recording.remarked(index).map(|(keyframe, odd)| {
                let news = remarks.note(&recording.folder().join(&line.cloud), odd);
                news.iter().for_each(|told| warn!("{told}"));
                keyframe
            });
            if sender.blocking_send(keyframe).is_err() {
                return; // the agent ends
            }
        }
    });
    let start = tokio::time::Instant::now();
    let due = |stamp: Stamp| start + Duration::try_from_secs_f64(stamp.secs_since(begins) / speed).unwrap_or_default();
    let mut fed = 0_u64;
    while let Some(keyframe) = keyframes.recv().await {
        let keyframe = keyframe.context("the recording ends here")?;
        while let Some(seen) = positions.next_if(|seen| seen.stamp < keyframe.stamp) {
            tokio::time::sleep_until(due(seen.stamp)).await;
            inbox.feed(Input::Position(seen)).await;
        }
        tokio::time::sleep_until(due(keyframe.stamp)).await;
        if !inbox.feed(Input::Keyframe(keyframe)).await {
            return Ok(());
        }
        fed += 1;
    }
    inbox.feed(Input::Command(Command::Flush)).await;
    info!(keyframes = fed, "recording fed");
    drop(reader);
    Ok(())
}

//! `merganser run`: one robot's agent, from its configuration to an orderly end on SIGINT or SIGTERM.

use super::{runtime, say};
use crate::config::FileConfig;
use crate::driver::{Clock, Driver, Finished, Parts};
use crate::journal::{self, Start, StoredRecord};
use crate::link::Link;
use crate::queue::{Drops, Inbox, queue};
use crate::store::{self, Store};
use crate::telemetry;
use anyhow::{Context, Result};
use merganser_protocol::agent::Agent;
use merganser_protocol::agent::io::{Command, Input};
use merganser_protocol::submap::Keyframe;
use merganser_protocol::time::Stamp;
use rand::TryRng;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::mpsc;
use tracing::{error, info, warn};

/// Time between two warnings about what was dropped.
const DROPS_EVERY: Duration = Duration::from_secs(5);
/// Keyframes read ahead of their time.
const READ_AHEAD: usize = 4;

/// What `merganser run` can be told.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    /// The configuration file.
    #[arg(long, short, value_name = "FILE")]
    pub config: PathBuf,
    /// Feed keyframes of this recording, as if the robot's SLAM sent them.
    #[arg(long, value_name = "DIR")]
    pub recording: Option<PathBuf>,
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
    telemetry::init(&config.log);
    let recording = args.recording.as_ref().map(|folder| Recorded::open(folder)).transpose()?;
    let runtime = runtime()?;
    let finished = runtime.block_on(live(args, config, recording));
    runtime.shutdown_timeout(Duration::from_millis(200)); // a job that still runs is of no use any more
    let finished = finished?;
    say(&format!("digest {}", finished.digest))?;
    Ok(true)
}

async fn live(args: &RunArgs, mut config: FileConfig, recording: Option<Recorded>) -> Result<Finished> {
    let stop = stop_signal()?;
    if let Some(recording) = &recording {
        suit(&mut config, recording);
    }
    let clock = Clock::start();
    let (inbox, outbox) = queue(config.driver.queue);
    let (core, store, journal) = begin(args, &config, clock)?;
    let deliver = inbox.clone();
    let store =
        store::Writer::spawn(store, Duration::from_millis(config.store.commit_ms), move |done| deliver.deliver(done))?;
    let (opened, network) = Link::open(&config, inbox.clone()).await?;
    let (jobs, from) = (config.driver.jobs, inbox.clone());
    let (driver, snapshots) = Driver::new(Parts { core, network, store, journal, outbox, inbox: from, clock, jobs });
    let driver = tokio::spawn(driver.run(stop));
    let link = opened.start(snapshots).await?;
    info!(robot = %config.robot, swarm = %config.swarm, listen = ?config.zenoh.listen, "agent runs");
    let side = [
        tokio::spawn(tell_drops(inbox.drops.clone())),
        tokio::spawn(feed(inbox, args.new_epoch, recording, args.speed)),
    ];
    let finished = driver.await.context("the driver panicked; this is a bug")?;
    info!(digest = %finished.digest, inputs = finished.inputs, "agent ends");
    side.iter().for_each(tokio::task::JoinHandle::abort);
    link.close().await;
    Ok(finished)
}

/// The core with what the store held, and the journal of its run.
fn begin(args: &RunArgs, config: &FileConfig, clock: Clock) -> Result<(Agent, Store, Option<journal::Writer>)> {
    let identity = config.identity()?;
    let store = Store::open(&config.store.path, &identity.swarm, &identity.name)?;
    let restored = store.load()?;
    let seed = match args.seed {
        Some(seed) => seed,
        None => rand::rngs::SysRng.try_next_u64().context("the system's random source failed")?,
    };
    let now = clock.now();
    let journal = match &args.journal {
        Some(path) => {
            let records: Vec<StoredRecord> = restored.records.iter().map(Into::into).collect();
            let start = Start {
                fresh_epoch: restored.fresh_epoch,
                restored: records,
                ..Start::new(&config.core, &identity, seed, now)
            };
            Some(journal::Writer::create(path, start).with_context(|| format!("journal {}", path.display()))?)
        }
        None => None,
    };
    info!(records = restored.records.len(), store = %config.store.path.display(), "store read");
    let core = Agent::new(config.core.clone(), identity, seed, restored, now)?;
    Ok((core, store, journal))
}

/// A recording, ready to be fed.
struct Recorded {
    /// What suits its sensor.
    config: merganser_protocol::config::Config,
    keyframes: Box<dyn Iterator<Item = Result<Keyframe>> + Send>,
}

impl Recorded {
    fn open(_folder: &Path) -> Result<Self> {
        anyhow::bail!("recordings cannot be read yet")
    }
}

/// A recording knows what suits its sensor; a file that sets any of the core's knobs knows better.
fn suit(config: &mut FileConfig, recording: &Recorded) {
    if config.core == merganser_protocol::config::Config::default() {
        config.core = recording.config.clone();
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

async fn tell_drops(drops: Arc<Drops>) {
    let mut seen = BTreeMap::new();
    loop {
        tokio::time::sleep(DROPS_EVERY).await;
        for line in drops.news(&mut seen) {
            warn!("{line}");
        }
    }
}

async fn feed(inbox: Inbox, new_epoch: bool, recording: Option<Recorded>, speed: f64) {
    if new_epoch {
        inbox.feed(Input::Command(Command::NewEpoch)).await;
    }
    if let Some(recording) = recording {
        play(&inbox, recording, speed).await;
    }
}

/// Feeds a recording in its own time, `speed` times faster, and closes the last submap.
async fn play(inbox: &Inbox, recording: Recorded, speed: f64) {
    let (sender, mut keyframes) = mpsc::channel(READ_AHEAD);
    let reader = tokio::task::spawn_blocking(move || {
        for keyframe in recording.keyframes {
            if sender.blocking_send(keyframe).is_err() {
                return; // the agent ends
            }
        }
    });
    let mut origin: Option<(tokio::time::Instant, Stamp)> = None;
    let mut fed = 0_u64;
    while let Some(keyframe) = keyframes.recv().await {
        let keyframe = match keyframe {
            Ok(keyframe) => keyframe,
            Err(reason) => {
                error!(%reason, "the recording ends here");
                break;
            }
        };
        let (start, first) = *origin.get_or_insert((tokio::time::Instant::now(), keyframe.stamp));
        let ahead = keyframe.stamp.secs_since(first) / speed;
        tokio::time::sleep_until(start + Duration::try_from_secs_f64(ahead).unwrap_or_default()).await;
        if !inbox.feed(Input::Keyframe(keyframe)).await {
            return;
        }
        fed += 1;
    }
    inbox.feed(Input::Command(Command::Flush)).await;
    info!(keyframes = fed, "recording fed");
    drop(reader);
}

//! One agent, put together: the core and its journal, the store's thread, the driver's task and the Zenoh link. The
//! program runs one of these; tests run several in one process.

use crate::config::{FileConfig, FileConfigError};
use crate::driver::{Clock, Driver, Finished, Parts, Snapshots};
use crate::journal::{self, Start};
use crate::link::Link;
use crate::link::scouting::Scouting;
use crate::link::session::{Guard, LinkError};
use crate::queue::{Inbox, queue};
use crate::store;
use merganser_protocol::agent::{Agent, Core, StartError};
use merganser_store::{Opened, Store, StoreError};
use rand::TryRng;
use std::io;
use std::path::PathBuf;
use std::time::Duration;
use thiserror::Error;
use tokio::sync::oneshot;
use tokio::task::{JoinError, JoinHandle};
use tracing::info;

/// Why an agent does not start or does not end in order.
#[derive(Debug, Error)]
pub enum HostError {
    /// The configuration or the key.
    #[error(transparent)]
    Config(#[from] FileConfigError),
    /// The disk.
    #[error(transparent)]
    Store(#[from] StoreError),
    /// The core.
    #[error(transparent)]
    Core(#[from] StartError),
    /// The network.
    #[error(transparent)]
    Link(#[from] LinkError),
    /// The journal.
    #[error("journal {path}: {source}", path = path.display())]
    Journal {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The system itself.
    #[error("the system gives no {what}: {reason}")]
    System {
        /// A thread, randomness.
        what: &'static str,
        /// What it said.
        reason: String,
    },
    /// Our mistake.
    #[error("the driver panicked; this is a bug: {0}")]
    Panicked(#[from] JoinError),
}

/// What a run may be told beyond its configuration.
#[derive(Clone, Debug, Default)]
pub struct Options {
    /// Write all inputs to this file.
    pub journal: Option<PathBuf>,
    /// Seed of the core's random choices; the system's randomness if absent.
    pub seed: Option<u64>,
}

/// A running agent.
#[derive(Debug)]
pub struct Host {
    inbox: Inbox,
    snapshots: Snapshots,
    driver: JoinHandle<Finished>,
    stop: oneshot::Sender<()>,
    link: Link,
    scouting: Option<Scouting>,
}

impl Host {
    /// Starts an agent with what its store holds.
    ///
    /// # Errors
    /// [`HostError`].
    pub async fn start(config: FileConfig, options: Options) -> Result<Self, HostError> {
        let identity = config.identity()?;
        let Opened { store, restored, report } = store::open(&config)?;
        info!(records = restored.records.len(), store = %config.store.path.display(), "store read");
        let seed = match options.seed {
            Some(seed) => seed,
            None => rand::rngs::SysRng.try_next_u64().map_err(|e| refused("randomness", e))?,
        };
        let clock = Clock::start();
        let now = clock.now();
        let journal = options.journal.map(|path| {
            let start = Start::new(&config.core, &identity, seed, &restored, now);
            journal::Writer::create(&path, start).map_err(|source| HostError::Journal { path, source })
        });
        let core = Agent::new(config.core.clone(), identity, seed, restored, now)?;
        let host = Self::assemble(&config, core, store, journal.transpose()?, clock).await?;
        (0..report.damaged_count).for_each(|_| host.inbox.drops.count("store: damaged record"));
        if report.renewed.is_some() {
            host.inbox.drops.count("store: damaged beyond mending, begun anew");
        }
        Ok(host)
    }

    /// Starts an agent around any core (tests use stand-ins).
    ///
    /// # Errors
    /// [`HostError`].
    pub async fn assemble(
        config: &FileConfig,
        core: impl Core + Send + 'static,
        store: Store,
        journal: Option<journal::Writer>,
        clock: Clock,
    ) -> Result<Self, HostError> {
        let guard = Guard::of(config)?;
        let (inbox, outbox) = queue(config.driver.queue);
        let deliver = inbox.clone();
        let wait = Duration::from_millis(config.store.commit_ms);
        let store = store::Writer::spawn(store, wait, move |done| deliver.deliver(done));
        let store = store.map_err(|e| refused("thread", e))?;
        let scouting = Scouting::begin(&config.zenoh);
        let (opened, network) = Link::open(config, guard.as_ref(), inbox.clone()).await?;
        let (jobs, own) = (config.driver.jobs, inbox.clone());
        let (driver, snapshots) = Driver::new(Parts { core, network, store, journal, outbox, inbox: own, clock, jobs });
        let (stop, stopped) = oneshot::channel();
        let driver = tokio::spawn(driver.run(async {
            let _ = stopped.await; // A dropped sender ends the agent as a sent one does.
        }));
        let link = opened.start(snapshots.clone()).await?;
        info!(robot = %config.robot, swarm = %config.swarm, listen = ?config.zenoh.listen, "agent runs");
        Ok(Self { inbox, snapshots, driver, stop, link, scouting })
    }

    /// The way to the core.
    pub fn inbox(&self) -> &Inbox {
        &self.inbox
    }

    /// What the core believes.
    pub fn snapshots(&self) -> &Snapshots {
        &self.snapshots
    }

    /// Where Zenoh scouts, if it does; for the one who asks first.
    pub fn take_scouting(&mut self) -> Option<Scouting> {
        self.scouting.take()
    }

    /// Waits until the driver ends by itself, which it does only by a mistake of ours.
    pub async fn broken(&mut self) -> HostError {
        match (&mut self.driver).await {
            Err(panic) => HostError::Panicked(panic),
            Ok(_) => refused("driver", "it ended"),
        }
    }

    /// Stops: no input is handled any more, all batches are on disk, the session is closed (in bounded time).
    ///
    /// # Errors
    /// [`HostError::Panicked`].
    pub async fn stop(self) -> Result<Finished, HostError> {
        let _ = self.stop.send(()); // fails if the driver has ended, which the next line tells
        let finished = self.driver.await?;
        info!(digest = %finished.digest, inputs = finished.inputs, "agent ends");
        self.link.close().await;
        Ok(finished)
    }
}

fn refused(what: &'static str, reason: impl ToString) -> HostError {
    HostError::System { what, reason: reason.to_string() }
}

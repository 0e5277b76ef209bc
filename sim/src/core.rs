//! What the simulator needs of an agent, so that its own tests can put a fake in the core's place.

use merganser_protocol::agent::io::{Input, Output};
use merganser_protocol::agent::{Agent, Identity, Restored, StartError};
use merganser_protocol::config::Config;
use merganser_protocol::ids::{FrameId, Hash};
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::time::Instant;
use std::collections::BTreeMap;

/// One robot's agent. The methods are those of [`Agent`].
pub trait Core: Sized {
    /// A new agent on what its store holds.
    ///
    /// # Errors
    /// [`StartError`] for a bad configuration, roster or store.
    fn start(
        config: Config,
        identity: Identity,
        seed: u64,
        restored: Restored,
        now: Instant,
    ) -> Result<Self, StartError>;
    /// Takes one input.
    fn handle(&mut self, now: Instant, input: Input);
    /// The next output, if any.
    fn poll_output(&mut self) -> Option<Output>;
    /// When a timeout is wanted.
    fn poll_timeout(&self) -> Option<Instant>;
    /// The frame it writes.
    fn frame(&self) -> FrameId;
    /// Digest of the set of entries it holds.
    fn digest(&self) -> Hash;
    /// The lengths of the logs it holds durably; `None` for those with two histories.
    fn logs(&self) -> BTreeMap<FrameId, Option<u32>>;
    /// What it believes; fakes have nothing to show.
    fn snapshot(&self, now: Instant) -> Option<Snapshot>;
}

impl Core for Agent {
    fn start(
        config: Config,
        identity: Identity,
        seed: u64,
        restored: Restored,
        now: Instant,
    ) -> Result<Self, StartError> {
        Self::new(config, identity, seed, restored, now)
    }

    fn handle(&mut self, now: Instant, input: Input) {
        Self::handle(self, now, input);
    }

    fn poll_output(&mut self) -> Option<Output> {
        Self::poll_output(self)
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Self::poll_timeout(self)
    }

    fn frame(&self) -> FrameId {
        Self::frame(self)
    }

    fn digest(&self) -> Hash {
        Self::digest(self)
    }

    fn logs(&self) -> BTreeMap<FrameId, Option<u32>> {
        self.heads().collect()
    }

    fn snapshot(&self, now: Instant) -> Option<Snapshot> {
        Some(Self::snapshot(self, now))
    }
}

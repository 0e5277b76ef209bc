//! What the simulator needs of a core beyond driving it, so that its own tests can put a fake in an agent's place.

use merganser_protocol::agent::{Agent, Core, Identity, Restored, StartError};
use merganser_protocol::config::Config;
use merganser_protocol::ids::FrameId;
use merganser_protocol::time::Instant;
use std::collections::BTreeMap;

/// A core that can be started again on what its store holds, and whose logs can be checked.
pub trait Restartable: Core + Sized {
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
    /// The frame it writes.
    fn frame(&self) -> FrameId;
    /// The lengths of the logs it holds durably; `None` for those with two histories.
    fn logs(&self) -> BTreeMap<FrameId, Option<u32>>;
}

impl Restartable for Agent {
    fn start(
        config: Config,
        identity: Identity,
        seed: u64,
        restored: Restored,
        now: Instant,
    ) -> Result<Self, StartError> {
        Self::new(config, identity, seed, restored, now)
    }

    fn frame(&self) -> FrameId {
        Self::frame(self)
    }

    fn logs(&self) -> BTreeMap<FrameId, Option<u32>> {
        self.heads().collect()
    }
}

//! What drives an agent sees of it: a shell and a simulator alike, whose own tests put a stand-in in its place.

use super::Agent;
use super::io::{Input, Output};
use crate::ids::Hash;
use crate::snapshot::Snapshot;
use crate::time::Instant;

/// An [`Agent`], or a stand-in of a test that keeps the same contract.
pub trait Core {
    /// See [`Agent::handle`].
    fn handle(&mut self, now: Instant, input: Input);
    /// See [`Agent::poll_output`].
    fn poll_output(&mut self) -> Option<Output>;
    /// See [`Agent::poll_timeout`].
    fn poll_timeout(&self) -> Option<Instant>;
    /// See [`Agent::digest`].
    fn digest(&self) -> Hash;
    /// See [`Agent::is_saving`]; a stand-in keeps nothing.
    fn is_saving(&self) -> bool {
        false
    }
    /// See [`Agent::snapshot`]; a stand-in may have nothing to show.
    fn snapshot(&self, _now: Instant) -> Option<Snapshot> {
        None
    }
    /// See [`Agent::overview`].
    fn overview(&self, now: Instant) -> Option<Snapshot> {
        self.snapshot(now)
    }
}

impl Core for Agent {
    fn handle(&mut self, now: Instant, input: Input) {
        Self::handle(self, now, input);
    }

    fn poll_output(&mut self) -> Option<Output> {
        Self::poll_output(self)
    }

    fn poll_timeout(&self) -> Option<Instant> {
        Self::poll_timeout(self)
    }

    fn digest(&self) -> Hash {
        Self::digest(self)
    }

    fn is_saving(&self) -> bool {
        Self::is_saving(self)
    }

    fn snapshot(&self, now: Instant) -> Option<Snapshot> {
        Some(Self::snapshot(self, now))
    }

    fn overview(&self, now: Instant) -> Option<Snapshot> {
        Some(Self::overview(self, now))
    }
}

//! What the program does, a file per subcommand.

pub mod align;
pub mod check;
pub mod doctor;
pub mod graph;
pub mod keys;
pub mod replay;
pub mod run;
mod scratch;
pub mod store;
pub mod topics;
pub mod watch;

use anyhow::{Context, Result};
use std::io::Write;

/// A file or an argument that cannot be used, with the cure: exit code 2.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub(crate) struct BadInput(String);

impl BadInput {
    pub(crate) fn told(text: impl Into<String>) -> anyhow::Error {
        Self(text.into()).into()
    }
}

/// Prints a line.
pub(crate) fn say(line: &str) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    writeln!(out, "{line}")?;
    out.flush()
}

/// The runtime of an agent: Zenoh needs several threads.
pub(crate) fn runtime() -> Result<tokio::runtime::Runtime> {
    tokio::runtime::Builder::new_multi_thread()
        .worker_threads(2)
        .enable_all()
        .build()
        .context("cannot start the runtime")
}

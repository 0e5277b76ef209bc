//! What the program does, a file per subcommand.

pub mod check;
pub mod graph;
pub mod keys;
pub mod replay;
pub mod run;
pub mod store;
pub mod watch;

use anyhow::{Context, Result};
use std::io::Write;

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

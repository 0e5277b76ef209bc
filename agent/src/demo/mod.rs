//! The demonstration: three agents, three recordings, one map.

use anyhow::Result;

/// What `merganser demo` can be told.
#[derive(Clone, Debug, clap::Args)]
pub struct DemoArgs {}

/// Runs the demonstration; `Ok(true)` if all robots merged and every check held.
///
/// # Errors
/// Whatever stopped it.
pub fn run(_args: DemoArgs) -> Result<bool> {
    anyhow::bail!("not here yet")
}

//! `merganser check`: is this configuration good, and what does it come to?

use super::say;
use crate::config::FileConfig;
use anyhow::Result;
use merganser_protocol::ids::RobotId;
use std::path::PathBuf;

/// What `merganser check` can be told.
#[derive(Clone, Debug, clap::Args)]
pub struct CheckArgs {
    /// The configuration file.
    #[arg(long, short, value_name = "FILE")]
    pub config: PathBuf,
}

/// Checks the configuration and the key, and prints all values, defaults included.
///
/// # Errors
/// The first thing that is wrong.
pub fn run(args: &CheckArgs) -> Result<bool> {
    let config = FileConfig::load(&args.config)?;
    config.identity()?;
    let id = config.roster.get(&config.robot).map(|key| RobotId::of_key(&key.to_bytes()).to_string());
    say(&format!(
        "# {}: good. Robot {} of swarm {}, id {}, one of {}.\n",
        args.config.display(),
        config.robot,
        config.swarm,
        id.unwrap_or_default(),
        config.roster.len()
    ))?;
    say(toml::to_string(&config)?.trim_end())?;
    Ok(true)
}

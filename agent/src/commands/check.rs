//! `merganser check`: is this configuration good, and what does it come to?

use super::say;
use crate::certificates::Problem;
use crate::certificates::expiry::{self, Standing};
use crate::config::{FileConfig, FileConfigError};
use crate::link::session::Guard;
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
    let robot = config.roster.get(&config.robot);
    if robot.is_some() {
        config.identity()?;
    }
    let links = match Guard::of(&config)? {
        Some(guard) => {
            let certificate = &guard.credentials.certificate;
            if certificate.standing(expiry::now()) == Standing::Expired {
                let path = config.zenoh.certificate.clone().unwrap_or_default();
                return Err(FileConfigError::from(Problem::Expired(certificate.last_day()).at(&path)).into());
            }
            format!("Links by TLS; certificate until {}.", certificate.last_day())
        }
        None if config.zenoh.security.is_some() => "Links are plain: zenoh.security = \"none\".".into(),
        None => "Links are plain, and stay on this host.".into(),
    };
    let (file, own, swarm, robots) = (args.config.display(), &config.robot, &config.swarm, config.roster.len());
    let who = match robot.map(|key| RobotId::of_key(&key.to_bytes())) {
        Some(id) => format!("Robot {own} of swarm {swarm}, id {id}, one of {robots}"),
        None => format!("Observer {own} of swarm {swarm}, of {robots} robots: for `merganser watch --config`"),
    };
    say(&format!("# {file}: good. {who}.\n# {links}\n"))?;
    say(toml::to_string(&config)?.trim_end())?;
    Ok(true)
}

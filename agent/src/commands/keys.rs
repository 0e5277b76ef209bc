//! `merganser keys`: a robot's secret key, and the roster line that the others need.

use super::say;
use crate::trust::SecretKey;
use anyhow::{Context, Result};
use clap::Subcommand;
use merganser_protocol::ids::Name;
use std::path::PathBuf;

/// What `merganser keys` can be told.
#[derive(Clone, Debug, Subcommand)]
pub enum KeysCommand {
    /// Make a new key and print its roster line.
    Generate {
        /// The robot's name.
        #[arg(long, value_parser = name)]
        name: Name,
        /// The folder for `NAME.key`.
        #[arg(long, value_name = "DIR", default_value = ".")]
        out: PathBuf,
    },
    /// Print the roster line of a key file.
    Show {
        /// The robot's name.
        #[arg(long, value_parser = name)]
        name: Name,
        /// The key file.
        #[arg(long, value_name = "FILE")]
        key: PathBuf,
    },
}

fn name(text: &str) -> Result<Name, String> {
    Name::new(text).map_err(|error| error.to_string())
}

/// Makes or shows a key.
///
/// # Errors
/// If the file exists already, or cannot be written or read.
pub fn run(command: KeysCommand) -> Result<bool> {
    let (name, key) = match command {
        KeysCommand::Generate { name, out } => {
            std::fs::create_dir_all(&out).with_context(|| format!("cannot make the folder {}", out.display()))?;
            let key = SecretKey::generate()?;
            key.save(&out.join(format!("{name}.key")))?;
            (name, key)
        }
        KeysCommand::Show { name, key } => (name, SecretKey::load(&key)?),
    };
    say(&format!("{name} = \"{}\"", key.public()))?;
    Ok(true)
}

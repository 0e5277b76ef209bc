//! `merganser keys`: a robot's secret key and the roster line that the others need; a swarm's authority, and the
//! certificates by which robots, observers and routers link.

use super::{BadInput, say};
use crate::certificates::authority::{AUTHORITY_DAYS, Authority, DAYS, DAYS_MAX, Files, write_new, write_over};
use crate::certificates::{Holder, Problem, router};
use crate::config::FileConfig;
use crate::trust::passphrase::Passphrase;
use crate::trust::{PublicKey, SecretKey};
use anyhow::{Context, Result};
use clap::Subcommand;
use merganser_protocol::ids::Name;
use std::collections::BTreeMap;
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

/// Where the passphrase of an encrypted key file is.
#[derive(Clone, Debug, clap::Args)]
pub struct PassphraseArgs {
    /// The key file is encrypted; its passphrase is the first line of this file, which only its owner may read.
    #[arg(long, value_name = "FILE", conflicts_with = "passphrase_env")]
    passphrase_file: Option<PathBuf>,
    /// The key file is encrypted; its passphrase is in this environment variable.
    #[arg(long, value_name = "VARIABLE")]
    passphrase_env: Option<String>,
}

impl PassphraseArgs {
    pub(super) fn passphrase(&self) -> Passphrase {
        Passphrase::of(self.passphrase_file.clone(), self.passphrase_env.clone())
    }
}

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
        /// Encrypt it.
        #[command(flatten)]
        passphrase: PassphraseArgs,
    },
    /// Print the roster line of a key file.
    Show {
        /// The robot's name.
        #[arg(long, value_parser = name)]
        name: Name,
        /// The key file.
        #[arg(long, value_name = "FILE")]
        key: PathBuf,
        /// If it is encrypted.
        #[command(flatten)]
        passphrase: PassphraseArgs,
    },
    /// Make a swarm's authority, which signs certificates; keep its key off the robots.
    Authority {
        /// The swarm's name.
        #[arg(long, value_parser = name)]
        swarm: Name,
        /// Days until it ends.
        #[arg(long, default_value_t = AUTHORITY_DAYS, value_parser = days())]
        days: u32,
        /// The folder for `SWARM.authority.key` and `SWARM.authority.crt`.
        #[arg(long, value_name = "DIR", default_value = ".")]
        out: PathBuf,
    },
    /// Make certificates for the robots and observers of a configuration, or renew them.
    Certificate {
        /// The key of the swarm's authority.
        #[arg(long, value_name = "FILE")]
        authority: PathBuf,
        /// A configuration of the swarm, of any robot.
        #[arg(long, short, value_name = "FILE")]
        config: PathBuf,
        /// One robot or observer; all, if absent. May be given more than once.
        #[arg(long, value_parser = name)]
        name: Vec<Name>,
        /// Days until they end.
        #[arg(long, default_value_t = DAYS, value_parser = days())]
        days: u32,
        /// The folder for `NAME.crt`.
        #[arg(long, value_name = "DIR", default_value = ".")]
        out: PathBuf,
    },
    /// Write the configuration of a Zenoh router, for `zenohd --config`, with its certificate and key in it.
    Router {
        /// The key of the swarm's authority.
        #[arg(long, value_name = "FILE")]
        authority: PathBuf,
        /// A configuration of the swarm, of any robot; the router stands in its `zenoh.routers`.
        #[arg(long, short, value_name = "FILE")]
        config: PathBuf,
        /// The router's name.
        #[arg(long, value_parser = name)]
        name: Name,
        /// Where it listens. May be given more than once.
        #[arg(long, value_name = "ENDPOINT", default_value = "tls/0.0.0.0:7447", value_parser = endpoint)]
        listen: Vec<String>,
        /// Another router to connect to. May be given more than once.
        #[arg(long, value_name = "ENDPOINT", value_parser = endpoint)]
        connect: Vec<String>,
        /// Days until its certificate ends.
        #[arg(long, default_value_t = DAYS, value_parser = days())]
        days: u32,
        /// The folder for `NAME.json5`.
        #[arg(long, value_name = "DIR", default_value = ".")]
        out: PathBuf,
    },
}

pub(super) fn name(text: &str) -> Result<Name, String> {
    Name::new(text).map_err(|error| error.to_string())
}

fn days() -> clap::builder::RangedI64ValueParser<u32> {
    clap::value_parser!(u32).range(1..=i64::from(DAYS_MAX))
}

fn endpoint(text: &str) -> Result<String, String> {
    match text.parse::<zenoh::config::EndPoint>() {
        Ok(_) if text.starts_with("tls/") && !text.contains(['#', '[']) => Ok(text.into()),
        _ => Err("write e.g. tls/10.0.0.2:7447, with an IPv4 address or a name".into()),
    }
}

/// Makes or shows keys and certificates.
///
/// # Errors
/// If a file exists already that must not be overwritten, or cannot be written or read.
pub fn run(command: KeysCommand) -> Result<bool> {
    match command {
        KeysCommand::Generate { name, out, passphrase } => {
            make_folder(&out)?;
            let key = SecretKey::generate()?;
            key.save_with(&out.join(format!("{name}.key")), &passphrase.passphrase())?;
            say(&format!("{name} = \"{}\"", key.public()))?;
        }
        KeysCommand::Show { name, key, passphrase } => {
            let key = SecretKey::load_with(&key, &passphrase.passphrase())?;
            say(&format!("{name} = \"{}\"", key.public()))?;
        }
        KeysCommand::Authority { swarm, days, out } => {
            make_folder(&out)?;
            let files = Files::of(&swarm, &out);
            let authority = Authority::generate(swarm, days).map_err(|problem| problem.at(&files.key))?;
            authority.save(&files)?;
            say(&told(
                &files.certificate,
                &format!("every robot gets this; until {}", authority.certificate().last_day()),
            ))?;
            say(&told(&files.key, "nobody gets this; keep it off the robots"))?;
        }
        KeysCommand::Certificate { authority, config, name, days, out } => {
            let (authority, config) = both(&authority, &config)?;
            make_folder(&out)?;
            for (holder, name, key) in chosen(&config, &name)? {
                let path = out.join(format!("{name}.crt"));
                let certificate = authority.issue(&holder, &key, days).map_err(|problem| problem.at(&path))?;
                write_over(&path, certificate.pem())?;
                say(&told(&path, &format!("{holder} until {}", certificate.last_day())))?;
            }
        }
        KeysCommand::Router { authority, config, name, listen, connect, days, out } => {
            let path = out.join(format!("{name}.json5"));
            let (authority, config) = both(&authority, &config)?;
            if !config.zenoh.routers.contains(&name) {
                return Err(BadInput::told(format!(
                    "zenoh.routers: {name} is not in it, so no robot would link with this router; add \"{name}\" in the \
                     configuration of each"
                )));
            }
            make_folder(&out)?;
            let router = router::Router { name, listen, connect, lease_secs: config.zenoh.lease_secs };
            let (text, certificate) =
                router.configuration(&authority, &config.members(), days).map_err(|problem| problem.at(&path))?;
            write_new(&path, &text, 0o600)?;
            say(&told(
                &path,
                &format!("holds the router's key; {} until {}", certificate.holder, certificate.last_day()),
            ))?;
        }
    }
    Ok(true)
}

fn told(path: &Path, what: &str) -> String {
    format!("{}: {what}", path.display())
}

pub(super) fn make_folder(out: &Path) -> Result<()> {
    // What is there stays as it is; what is made holds keys.
    std::fs::DirBuilder::new()
        .recursive(true)
        .mode(0o700)
        .create(out)
        .with_context(|| format!("cannot make the folder {}", out.display()))
}

/// An authority and a configuration of one swarm.
fn both(authority: &Path, config: &Path) -> Result<(Authority, FileConfig)> {
    let files = Files::of_key(authority);
    let authority = Authority::load(&files)?;
    let config = FileConfig::load(config)?;
    if *authority.swarm() != config.swarm {
        let [is, wanted] = [authority.swarm().clone(), config.swarm.clone()].map(Holder::Swarm);
        return Err(Problem::Holder { is, wanted }.at(&files.certificate).into());
    }
    Ok((authority, config))
}

/// Who gets a certificate.
fn chosen(config: &FileConfig, names: &[Name]) -> Result<Vec<(Holder, Name, PublicKey)>> {
    let of = |table: &BTreeMap<Name, PublicKey>, kind: fn(Name) -> Holder| {
        table.iter().map(|(name, key)| (kind(name.clone()), name.clone(), *key)).collect::<Vec<_>>()
    };
    let mut all = of(&config.roster, Holder::Robot);
    all.append(&mut of(&config.observers, Holder::Observer));
    if let Some(unknown) = names.iter().find(|name| !all.iter().any(|(_, known, _)| known == *name)) {
        return Err(BadInput::told(format!(
            "--name {unknown}: is neither in [roster] nor in [observers]; add the line that `keys generate` printed"
        )));
    }
    all.retain(|(_, name, _)| names.is_empty() || names.contains(name));
    Ok(all)
}

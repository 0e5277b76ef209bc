//! The configuration file of one agent: TOML, every key known, every value checked, one clear error with file and line.
//! Times are in seconds and sizes in bytes where the name says so. `agent/dist/default.toml` shows every key with its
//! default.

mod zenoh;

use crate::certificates::credentials::{Credentials, Files, Members};
use crate::certificates::{CertificateError, Holder};
use crate::trust::passphrase::Passphrase;
use crate::trust::{PublicKey, SecretKey, TrustError};
use merganser_protocol::agent::Identity;
use merganser_protocol::ids::Name;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use thiserror::Error;
pub use zenoh::{DOOR_PORT, Mode, Security, ZenohConfig};

/// Largest configuration file read, in bytes: room for a roster of some ten thousand robots.
const FILE_LEN_MAX: u64 = 1 << 20;
/// Everything that an agent reads from its configuration file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileConfig {
    /// The swarm's name: robots of other swarms are neither heard nor answered.
    pub swarm: Name,
    /// This robot's name; must stand in the roster. For `merganser watch` it may be an observer's.
    pub robot: Name,
    /// The file that holds this robot's secret key; relative to the configuration file's folder.
    pub key_file: PathBuf,
    /// The file whose first line is the passphrase of an encrypted key file; relative to the configuration file's folder.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key_passphrase_file: Option<PathBuf>,
    /// The environment variable that holds it instead.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub key_passphrase_env: Option<String>,
    /// Name and public key of every robot of the swarm, this one included.
    pub roster: BTreeMap<Name, PublicKey>,
    /// Name and public key of those who may read views by TLS; none of them is a robot.
    #[serde(default, skip_serializing_if = "BTreeMap::is_empty")]
    pub observers: BTreeMap<Name, PublicKey>,
    /// Where facts are kept.
    #[serde(default)]
    pub store: StoreConfig,
    /// How to reach the others.
    #[serde(default)]
    pub zenoh: ZenohConfig,
    /// Bounds on what the agent does at once.
    #[serde(default)]
    pub driver: DriverConfig,
    /// What the agent shows.
    #[serde(default)]
    pub debug: DebugConfig,
    /// What the agent tells.
    #[serde(default)]
    pub log: LogConfig,
    /// The core's knobs.
    #[serde(default)]
    pub core: merganser_protocol::config::Config,
}

/// `[store]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StoreConfig {
    /// The database file; relative to the configuration file's folder.
    pub path: PathBuf,
    /// Longest time a batch waits for others to share its commit with.
    pub commit_ms: u64,
    /// What to do about a store that is so damaged that it cannot be opened.
    pub on_damage: OnDamage,
}

impl Default for StoreConfig {
    fn default() -> Self {
        Self { path: "merganser.redb".into(), commit_ms: 20, on_damage: OnDamage::Renew }
    }
}

/// What an agent does about a store that is so damaged that it cannot be opened.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum OnDamage {
    /// It is moved aside, and an empty store begins a new epoch.
    #[default]
    Renew,
    /// The agent ends, for somebody to look at it first.
    Stop,
}

/// `[driver]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DriverConfig {
    /// Inputs that may wait for the core; what comes from the network beyond that is dropped and counted.
    pub queue: usize,
    /// Heavy jobs run at once.
    pub jobs: usize,
}

impl Default for DriverConfig {
    fn default() -> Self {
        Self { queue: 1024, jobs: 2 }
    }
}

/// `[debug]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DebugConfig {
    /// Publish the views as JSON under `…/view/*` while somebody subscribes. They can be queried in any case.
    pub publish: bool,
    /// Shortest time between two publications of a view.
    pub interval_secs: f64,
    /// Bytes a second of views that may go to the network of the robots, asked for or published: half of them for `map`,
    /// `path` and `graph`, half for the others. What a view takes beyond it is made up for before the next. Where the robot's
    /// own SLAM connects, and in a swarm that never leaves its host, nothing is held back.
    pub bytes_per_sec: f64,
}

impl Default for DebugConfig {
    fn default() -> Self {
        Self { publish: true, interval_secs: 0.5, bytes_per_sec: 262_144.0 }
    }
}

/// How log lines look.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LogFormat {
    /// For people.
    #[default]
    Text,
    /// One JSON object a line.
    Json,
}

/// `[log]`.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct LogConfig {
    /// Text or JSON.
    pub format: LogFormat,
    /// What to log, as `tracing-subscriber` filters are written: `info`, `warn,merganser=debug`, …
    pub filter: String,
}

impl Default for LogConfig {
    fn default() -> Self {
        Self { format: LogFormat::Text, filter: "warn,merganser=info".into() }
    }
}

/// Why a configuration cannot be used. Each says the file, the line where known, and what to mend.
#[derive(Debug, Error)]
pub enum FileConfigError {
    /// The file cannot be read.
    #[error("{path}: {source}", path = path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The file is not what a configuration looks like, or a value is out of range.
    #[error("{path}{line}: {message}", path = path.display(), line = line.map_or(String::new(), |l| format!(":{l}")))]
    Value {
        /// The file.
        path: PathBuf,
        /// The line, counted from 1, where known.
        line: Option<usize>,
        /// What is wrong and how to mend it.
        message: String,
    },
    /// The secret key cannot be used.
    #[error(transparent)]
    Trust(#[from] TrustError),
    /// A certificate cannot be used.
    #[error(transparent)]
    Certificate(#[from] CertificateError),
}

/// A value that cannot work, by its dotted key.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
#[error("{key}: {mend}")]
pub struct ValueError {
    /// E.g. `zenoh.lease_secs`.
    pub key: String,
    /// What it should be.
    pub mend: String,
}

impl FileConfig {
    /// A configuration with defaults for all that can have one.
    pub fn new(swarm: Name, robot: Name, key_file: PathBuf, roster: BTreeMap<Name, PublicKey>) -> Self {
        Self {
            swarm,
            robot,
            key_file,
            key_passphrase_file: None,
            key_passphrase_env: None,
            roster,
            observers: BTreeMap::new(),
            store: StoreConfig::default(),
            zenoh: ZenohConfig::default(),
            driver: DriverConfig::default(),
            debug: DebugConfig::default(),
            log: LogConfig::default(),
            core: merganser_protocol::config::Config::default(),
        }
    }

    /// Reads and checks a file; relative paths in it become relative to its folder.
    ///
    /// # Errors
    /// [`FileConfigError`] for the first thing that is wrong.
    pub fn load(path: &Path) -> Result<Self, FileConfigError> {
        let text = read_bounded(path).map_err(|source| FileConfigError::Io { path: path.into(), source })?;
        let mut config = Self::parse(&text, path)?;
        let folder = path.parent().unwrap_or(Path::new("."));
        config.key_file = folder.join(&config.key_file);
        config.store.path = folder.join(&config.store.path);
        let (zenoh, passphrase) = (&mut config.zenoh, &mut config.key_passphrase_file);
        for file in [passphrase, &mut zenoh.input_users_file, &mut zenoh.certificate, &mut zenoh.authority]
            .into_iter()
            .flatten()
        {
            *file = folder.join(&file);
        }
        Ok(config)
    }

    /// Parses and checks the text of a file; `path` is for messages alone.
    ///
    /// # Errors
    /// [`FileConfigError::Value`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, FileConfigError> {
        let refuse = |line, message| FileConfigError::Value { path: path.into(), line, message };
        let mut config: Self = toml::from_str(text).map_err(|error| {
            let line = error.span().map(|span| line_of(text, span.start));
            refuse(line, error.message().trim_end().to_string())
        })?;
        if line_of_key(text, "zenoh.listen").is_none() {
            config.zenoh.listen = config.zenoh.default_listen();
        }
        config.validate().map_err(|error| refuse(line_of_key(text, &error.key), error.to_string()))?;
        Ok(config)
    }

    /// Writes the configuration as TOML that [`FileConfig::load`] reads.
    ///
    /// # Errors
    /// Any of the file system; the values themselves can always be written.
    pub fn save(&self, path: &Path) -> io::Result<()> {
        std::fs::write(path, toml::to_string(self).map_err(io::Error::other)?)
    }

    /// Checks every value that the types do not.
    ///
    /// # Errors
    /// [`ValueError`] for the first that cannot work.
    pub fn validate(&self) -> Result<(), ValueError> {
        if !self.roster.contains_key(&self.robot) && !self.observers.contains_key(&self.robot) {
            let mend =
                format!("{:?} is not in [roster]; add the line that `keys generate` printed", self.robot.as_str());
            return Err(ValueError { key: "robot".into(), mend });
        }
        if self.key_passphrase_file.is_some() && self.key_passphrase_env.is_some() {
            let mend = "key_passphrase_env is set, too; keep one of the two".into();
            return Err(ValueError { key: "key_passphrase_file".into(), mend });
        }
        let mut names_by_key = BTreeMap::new();
        for (name, key) in &self.roster {
            if let Some(first) = names_by_key.insert(key, name) {
                let mend = format!("has the same key as {first}; generate one key for each robot");
                return Err(ValueError { key: format!("roster.{name}"), mend });
            }
        }
        for (name, key) in &self.observers {
            let refuse = |mend| Err(ValueError { key: format!("observers.{name}"), mend });
            if self.roster.contains_key(name) {
                return refuse("is the name of a robot; choose another".into());
            }
            if let Some(first) = names_by_key.insert(key, name) {
                return refuse(format!("has the same key as {first}; generate one key for each"));
            }
        }
        self.zenoh.validate()?;
        let (d, s, v) = (&self.driver, &self.store, &self.debug);
        within("driver.queue", d.queue as f64, 16.0, 1e6, "use 16 to 1000000")?;
        within("driver.jobs", d.jobs as f64, 1.0, 64.0, "use 1 to 64")?;
        within("store.commit_ms", s.commit_ms as f64, 0.0, 100.0, "use 0 to 100 ms")?;
        within("debug.interval_secs", v.interval_secs, 0.05, 3600.0, "use 0.05 to 3600 s")?;
        within("debug.bytes_per_sec", v.bytes_per_sec, 1e3, 1e9, "use 1000 to 1000000000 bytes a second")?;
        if let Err(error) = self.log.filter.parse::<tracing_subscriber::EnvFilter>() {
            return Err(ValueError { key: "log.filter".into(), mend: format!("{error}; write e.g. \"info\"") });
        }
        self.core.validate().map_err(|error| ValueError {
            key: format!("core.{}", error.key),
            mend: format!("{} does not work: {}", error.value, error.mend),
        })?;
        self.zenoh.validate_security()
    }

    /// What links by TLS need, read and checked; `None` if links are plain.
    ///
    /// # Errors
    /// [`FileConfigError`] if a file is missing, or does not fit this robot, its key or its swarm.
    pub fn credentials(&self) -> Result<Option<Credentials>, FileConfigError> {
        if !self.zenoh.is_guarded() {
            return Ok(None);
        }
        let (Some(certificate), Some(authority)) = (&self.zenoh.certificate, &self.zenoh.authority) else {
            let message = match self.zenoh.validate_security() {
                Err(error) => error.to_string(),
                Ok(()) => "zenoh.certificate: is missing".into(),
            };
            return Err(FileConfigError::Value { path: self.key_file.clone(), line: None, message });
        };
        let files = Files { certificate, authority };
        let kind = if self.observers.contains_key(&self.robot) { Holder::Observer } else { Holder::Robot };
        let holder = kind(self.robot.clone());
        Ok(Some(Credentials::load(files, &self.swarm, &holder, &self.secret_key()?)?))
    }

    /// Reads the secret key file.
    ///
    /// # Errors
    /// [`FileConfigError::Trust`].
    pub fn secret_key(&self) -> Result<SecretKey, FileConfigError> {
        let passphrase = Passphrase::of(self.key_passphrase_file.clone(), self.key_passphrase_env.clone());
        Ok(SecretKey::load_with(&self.key_file, &passphrase)?)
    }

    /// All who may link by TLS.
    pub fn members(&self) -> Members {
        let (robots, observers) = (self.roster.keys().cloned().collect(), self.observers.keys().cloned().collect());
        Members { robots, observers, routers: self.zenoh.routers.iter().cloned().collect() }
    }

    /// The core's identity: reads the secret key file.
    ///
    /// # Errors
    /// [`FileConfigError::Trust`], or [`FileConfigError::Value`] if the roster has another key for this robot.
    pub fn identity(&self) -> Result<Identity, FileConfigError> {
        if !self.roster.contains_key(&self.robot) {
            let message =
                format!("is the key of the observer {}, who is no robot: only `merganser watch` takes it", self.robot);
            return Err(FileConfigError::Value { path: self.key_file.clone(), line: None, message });
        }
        let secret = self.secret_key()?;
        if self.roster.get(&self.robot) != Some(&secret.public()) {
            let message = format!(
                "holds the key with the public half {}, but [roster] has another for {}",
                secret.public(),
                self.robot
            );
            return Err(FileConfigError::Value { path: self.key_file.clone(), line: None, message });
        }
        Ok(Identity {
            swarm: self.swarm.clone(),
            name: self.robot.clone(),
            secret_key: *secret.to_bytes(),
            roster: self.roster.iter().map(|(name, key)| (name.clone(), key.to_bytes())).collect(),
        })
    }
}

fn within(key: &str, value: f64, low: f64, high: f64, mend: &str) -> Result<(), ValueError> {
    if value.is_finite() && (low..=high).contains(&value) {
        return Ok(());
    }
    Err(ValueError { key: key.into(), mend: format!("{value} does not work: {mend}") })
}

fn read_bounded(path: &Path) -> io::Result<String> {
    use io::Read as _;
    let file = std::fs::File::open(path)?;
    if file.metadata()?.len() > FILE_LEN_MAX {
        return Err(io::Error::other(format!("the file is larger than {FILE_LEN_MAX} bytes; is it a configuration?")));
    }
    let mut text = String::new();
    file.take(FILE_LEN_MAX).read_to_string(&mut text)?;
    Ok(text)
}

/// The line (from 1) that holds the byte at `offset`.
fn line_of(text: &str, offset: usize) -> usize {
    text.bytes().take(offset).filter(|byte| *byte == b'\n').count() + 1
}

/// The line (from 1) on which a dotted key is set, if the text sets it.
fn line_of_key(text: &str, key: &str) -> Option<usize> {
    let mut table = toml::de::DeTable::parse(text).ok()?.into_inner();
    let mut line = None;
    for part in key.split('.') {
        let (found, value) = table.into_iter().find(|(name, _)| name.get_ref() == part)?;
        line = Some(line_of(text, found.span().start));
        match value.into_inner() {
            toml::de::DeValue::Table(inner) => table = inner,
            _ => break,
        }
    }
    line
}

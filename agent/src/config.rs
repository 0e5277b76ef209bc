//! The configuration file of one agent: TOML, every key known, every value checked, one clear error with file and line.
//! Times are in seconds and sizes in bytes where the name says so. `agent/dist/default.toml` shows every key with its
//! default.

use crate::link::session::in_words;
use crate::trust::{PublicKey, SecretKey, TrustError};
use merganser_protocol::agent::Identity;
use merganser_protocol::ids::Name;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use thiserror::Error;

/// Largest configuration file read, in bytes: room for a roster of some ten thousand robots.
const FILE_LEN_MAX: u64 = 1 << 20;
/// Zenoh's own bound on a batch: a message must be allowed to be at least this large.
const MESSAGE_BYTES_MIN: usize = 65_536;
/// Room for a keyframe of [`POINTS_MAX`](crate::observation::POINTS_MAX) points, of 12 bytes each in postcard, or for a
/// depth image of 1920 × 1080 pixels, in JSON too.
const INPUT_BYTES_MAX: usize = 6 << 20;
/// Largest message bound accepted; the largest answer a peer gives is far below it.
const MESSAGE_BYTES_MAX: usize = 16 << 20;

/// Where the robot's own SLAM connects if nothing else is said: the port after Zenoh's own.
pub const DOOR_PORT: u16 = 7448;
/// What the loopback interface is called on Linux and on BSD.
const LOOPBACKS: [&str; 2] = ["lo", "lo0"];

/// Everything that an agent reads from its configuration file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileConfig {
    /// The swarm's name: robots of other swarms are neither heard nor answered.
    pub swarm: Name,
    /// This robot's name; must stand in the roster.
    pub robot: Name,
    /// The file that holds this robot's secret key; relative to the configuration file's folder.
    pub key_file: PathBuf,
    /// Name and public key of every robot of the swarm, this one included.
    pub roster: BTreeMap<Name, PublicKey>,
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

/// How an agent takes part in the Zenoh network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Mode {
    /// A link to every robot in reach. Peers do not relay for one another; the agent's own gossip does.
    #[default]
    Peer,
    /// Links to some robots, Zenoh routes between the others: for large swarms with a connect list of neighbours.
    Router,
    /// One link to a router.
    Client,
}

impl Mode {
    /// As Zenoh's configuration spells it.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Peer => "peer",
            Self::Router => "router",
            Self::Client => "client",
        }
    }
}

/// `[zenoh]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ZenohConfig {
    /// Peer unless the swarm is large.
    pub mode: Mode,
    /// Endpoints to listen on, e.g. `tcp/0.0.0.0:7447`; a port of 0 takes any free one.
    pub listen: Vec<String>,
    /// Endpoints of known robots, e.g. `tcp/10.0.0.2:7447`: after a partition a complete list heals within
    /// milliseconds of contact.
    pub connect: Vec<String>,
    /// Find robots on the local network by UDP multicast. Discovered links alone do not heal a partition: keep this
    /// or a connect list.
    pub multicast: bool,
    /// Let neighbours tell of neighbours (Zenoh's gossip scouting).
    pub gossip: bool,
    /// Interface for multicast scouting, or `auto`: every one that has an IPv4 address. An agent that names no peers in
    /// `connect` ends, to be started again, when one of them gets another address.
    pub interface: String,
    /// Endpoints at which the robot's own SLAM sends `…/in/*` and reads views, by a session that looks for nobody.
    /// Absent: `tcp/127.0.0.1:7448`, or the next free port; none if the session of the robots never leaves this host
    /// ([`stays_on_this_host`](Self::stays_on_this_host)), which then takes input itself.
    pub input_listen: Option<Vec<String>>,
    /// Lines of `user:password`; whoever connects to `input_listen` must show one of them. Relative to the
    /// configuration file's folder. Needed unless all of `input_listen` is loopback.
    pub input_users_file: Option<PathBuf>,
    /// Interfaces over which the session of the robots takes `…/in/*`, too. Whoever reaches a Zenoh peer or router on
    /// this host can then feed the robot. What comes over others is dropped by Zenoh, without a word.
    pub input_interfaces: Vec<String>,
    /// Silence after which a link counts as lost. A partition shorter than this loses no message.
    pub lease_secs: f64,
    /// Largest message accepted from a peer.
    pub message_bytes_max: usize,
    /// Largest message accepted from the robot's own SLAM, in bytes. Zenoh drops what is larger by more than a little
    /// without a word, and has but one bound for all links: while pieces of a message come in, a hostile neighbour can
    /// make the agent hold sixteen times this (eight priorities, two reliabilities).
    pub input_bytes_max: usize,
    /// Longest wait for the session to close at the end.
    pub close_secs: f64,
}

impl Default for ZenohConfig {
    fn default() -> Self {
        Self {
            mode: Mode::Peer,
            listen: vec!["tcp/[::]:0".into()],
            connect: Vec::new(),
            multicast: true,
            gossip: true,
            interface: "auto".into(),
            input_listen: None,
            input_users_file: None,
            input_interfaces: Vec::new(),
            lease_secs: 10.0,
            message_bytes_max: 1 << 20,
            input_bytes_max: INPUT_BYTES_MAX,
            close_secs: 3.0,
        }
    }
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
            roster,
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
        config.zenoh.input_users_file = config.zenoh.input_users_file.map(|file| folder.join(file));
        Ok(config)
    }

    /// Parses and checks the text of a file; `path` is for messages alone.
    ///
    /// # Errors
    /// [`FileConfigError::Value`].
    pub fn parse(text: &str, path: &Path) -> Result<Self, FileConfigError> {
        let refuse = |line, message| FileConfigError::Value { path: path.into(), line, message };
        let config: Self = toml::from_str(text).map_err(|error| {
            let line = error.span().map(|span| line_of(text, span.start));
            refuse(line, error.message().trim_end().to_string())
        })?;
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
        if !self.roster.contains_key(&self.robot) {
            let mend =
                format!("{:?} is not in [roster]; add the line that `keys generate` printed", self.robot.as_str());
            return Err(ValueError { key: "robot".into(), mend });
        }
        let mut names_by_key = BTreeMap::new();
        for (name, key) in &self.roster {
            if let Some(first) = names_by_key.insert(key, name) {
                let mend = format!("has the same key as {first}; generate one key for each robot");
                return Err(ValueError { key: format!("roster.{name}"), mend });
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
        })
    }

    /// The core's identity: reads the secret key file.
    ///
    /// # Errors
    /// [`FileConfigError::Trust`], or [`FileConfigError::Value`] if the roster has another key for this robot.
    pub fn identity(&self) -> Result<Identity, FileConfigError> {
        let secret = SecretKey::load(&self.key_file)?;
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
            secret_key: secret.to_bytes(),
            roster: self.roster.iter().map(|(name, key)| (name.clone(), key.to_bytes())).collect(),
        })
    }
}

impl ZenohConfig {
    /// Checks every value that the types do not.
    ///
    /// # Errors
    /// [`ValueError`] for the first that cannot work.
    pub fn validate(&self) -> Result<(), ValueError> {
        let bytes = self.message_bytes_max as f64;
        let (low, high) = (MESSAGE_BYTES_MIN as f64, MESSAGE_BYTES_MAX as f64);
        within("zenoh.message_bytes_max", bytes, low, high, "use 65536 to 16777216 bytes")?;
        within("zenoh.input_bytes_max", self.input_bytes_max as f64, low, high, "use 65536 to 16777216 bytes")?;
        within("zenoh.lease_secs", self.lease_secs, 0.5, 600.0, "use 0.5 to 600 s")?;
        within("zenoh.close_secs", self.close_secs, 0.1, 60.0, "use 0.1 to 60 s")?;
        let inputs = self.input_listen.as_deref().unwrap_or_default();
        for (key, list) in
            [("zenoh.listen", &self.listen[..]), ("zenoh.connect", &self.connect), ("zenoh.input_listen", inputs)]
        {
            for text in list {
                if let Err(error) = text.parse::<zenoh::config::EndPoint>() {
                    let error = in_words(error);
                    let mend = format!("{text:?} is no endpoint ({error}); write e.g. \"tcp/10.0.0.2:7447\"");
                    return Err(ValueError { key: key.into(), mend });
                }
                if !text.starts_with("tcp/") {
                    let mend =
                        format!("{text:?} is not TCP, the only transport built in; write e.g. \"tcp/10.0.0.2:7447\"");
                    return Err(ValueError { key: key.into(), mend });
                }
            }
        }
        self.validate_inputs()?;
        if self.mode == Mode::Client && self.connect.is_empty() && !self.multicast {
            let mend = "a client needs an endpoint to connect to, or multicast".into();
            return Err(ValueError { key: "zenoh.connect".into(), mend });
        }
        Ok(())
    }

    fn validate_inputs(&self) -> Result<(), ValueError> {
        let Some(inputs) = &self.input_listen else { return Ok(()) };
        let refuse = |mend: String| Err(ValueError { key: "zenoh.input_listen".into(), mend });
        if inputs.is_empty() {
            return refuse("name at least one endpoint, e.g. \"tcp/127.0.0.1:7448\", or leave it out".into());
        }
        for endpoint in inputs {
            if endpoint.ends_with(":0") {
                return refuse(format!(
                    "{endpoint:?} is another port at each start, which no SLAM can know; choose one"
                ));
            }
            if self.listen.contains(endpoint) {
                return refuse(format!("{endpoint:?} is in zenoh.listen, too; choose another port"));
            }
            if !is_loopback(endpoint) && self.input_users_file.is_none() {
                return refuse(format!(
                    "{endpoint:?} is open to others than this host: name a file with a line \"user:password\" in \
                     zenoh.input_users_file, or listen on 127.0.0.1"
                ));
            }
        }
        Ok(())
    }

    /// Whether the session of the robots has its endpoints on this host's loopback alone, and does not look for others:
    /// a swarm on one computer, as in simulations and tests.
    pub fn stays_on_this_host(&self) -> bool {
        let all = [&self.listen, &self.connect];
        !self.multicast
            && self.mode != Mode::Client
            && !self.listen.is_empty()
            && all.into_iter().flatten().all(|endpoint| is_loopback(endpoint))
    }

    /// Interfaces over which the session of the robots takes input.
    pub fn feeding_interfaces(&self) -> Vec<String> {
        if self.input_interfaces.is_empty() && self.input_listen.is_none() && self.stays_on_this_host() {
            return LOOPBACKS.map(Into::into).to_vec();
        }
        self.input_interfaces.clone()
    }
}

/// Whether an endpoint like `tcp/127.0.0.1:7447` is on this host's loopback.
fn is_loopback(endpoint: &str) -> bool {
    let address = endpoint.split_once('/').map_or(endpoint, |(_, address)| address);
    let host = address.rsplit_once(':').map_or(address, |(host, _)| host).trim_matches(['[', ']']);
    host == "localhost" || host.parse::<std::net::IpAddr>().is_ok_and(|ip| ip.is_loopback())
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

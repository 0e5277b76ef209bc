//! `[zenoh]`: how to reach the others, how links are protected, and where the robot's own SLAM comes in.

use super::{ValueError, within};
use crate::link::session::in_words;
use merganser_protocol::ids::Name;
use serde::{Deserialize, Serialize};
use std::path::PathBuf;

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
/// How endpoints of the two transports begin.
const TLS: &str = "tls/";
const PLAIN: &str = "tcp/";
const TLS_IPV6: &str = "tls/[";

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

/// How links are protected.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Security {
    /// By TLS with certificates on both sides; who may say what goes by the names in them.
    Tls,
    /// Not at all: plain TCP.
    None,
}

/// `[zenoh]`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ZenohConfig {
    /// Peer unless the swarm is large.
    pub mode: Mode,
    /// How links with other robots are protected. Absent: by TLS, unless they never leave this host (no multicast, and
    /// all endpoints on the loopback) and none of them is TLS.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub security: Option<Security>,
    /// This robot's certificate, with the key of `key_file`; relative to the configuration file's folder.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub certificate: Option<PathBuf>,
    /// The certificate of the swarm's authority; relative to the configuration file's folder.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub authority: Option<PathBuf>,
    /// Zenoh routers of the swarm, by the names in their certificates. What they pass on is not told apart by robots.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub routers: Vec<Name>,
    /// Endpoints to listen on, e.g. `tls/0.0.0.0:7447`; a port of 0 takes any free one. Absent: any port of all
    /// addresses, by TLS or, where links are plain, by TCP.
    pub listen: Vec<String>,
    /// Endpoints of known robots, e.g. `tls/10.0.0.2:7447`: after a partition a complete list heals within
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
            security: None,
            certificate: None,
            authority: None,
            routers: Vec::new(),
            listen: vec!["tls/0.0.0.0:0".into()],
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
                    let mend = format!("{text:?} is no endpoint ({error}); write e.g. \"tls/10.0.0.2:7447\"");
                    return Err(ValueError { key: key.into(), mend });
                }
                if !text.starts_with(PLAIN) && !text.starts_with(TLS) {
                    let mend = format!(
                        "{text:?} is neither TLS nor TCP, the transports built in; write e.g. \"tls/10.0.0.2:7447\""
                    );
                    return Err(ValueError { key: key.into(), mend });
                }
                if text.starts_with(TLS) && text.contains('#') {
                    // Zenoh takes settings there, which would outweigh ours: other certificates, or none.
                    let mend = format!("{text:?} has settings after '#'; write the endpoint alone");
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
            if !endpoint.starts_with(PLAIN) {
                return refuse(format!(
                    "{endpoint:?} is not TCP, by which a robot's own SLAM comes in; write \"tcp/…\""
                ));
            }
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

    /// Whether links with other robots are by TLS.
    pub fn is_guarded(&self) -> bool {
        match self.security {
            Some(Security::Tls) => true,
            Some(Security::None) => false,
            None => !self.links_stay_on_this_host() || self.links().any(|endpoint| endpoint.starts_with(TLS)),
        }
    }

    /// Whether no link can lead beyond this host's loopback.
    fn links_stay_on_this_host(&self) -> bool {
        !self.multicast && self.links().all(|endpoint| is_loopback(endpoint))
    }

    /// Endpoints of links with other robots.
    fn links(&self) -> impl Iterator<Item = &String> {
        let listen: &[String] = if self.mode == Mode::Client { &[] } else { &self.listen };
        listen.iter().chain(&self.connect)
    }

    /// Where to listen if nothing is said: any free port of all addresses.
    pub fn default_listen(&self) -> Vec<String> {
        vec![if self.is_guarded() { format!("{TLS}0.0.0.0:0") } else { format!("{PLAIN}[::]:0") }]
    }

    /// Checks that links are protected, or said not to be.
    ///
    /// # Errors
    /// [`ValueError`] that says how either is done.
    pub fn validate_security(&self) -> Result<(), ValueError> {
        let listen: &[String] = if self.mode == Mode::Client { &[] } else { &self.listen };
        let lists = [("zenoh.listen", listen), ("zenoh.connect", &self.connect)];
        let endpoints = || lists.iter().flat_map(|(key, list)| list.iter().map(move |endpoint| (*key, endpoint)));
        let refuse = |key: &str, mend: String| Err(ValueError { key: key.into(), mend });
        if !self.is_guarded() {
            return match endpoints().find(|(_, endpoint)| endpoint.starts_with(TLS)) {
                Some((key, endpoint)) => {
                    refuse(key, format!("{endpoint:?} is TLS: set zenoh.security = \"tls\", or write \"tcp/…\""))
                }
                None => Ok(()),
            };
        }
        let none = "or write zenoh.security = \"none\" where the network is the swarm's alone";
        let make = "make them by `merganser keys authority` and `merganser keys certificate`";
        match (self.security, &self.certificate, &self.authority) {
            (_, Some(_), Some(_)) => {}
            (None, ..) => {
                return refuse(
                    "zenoh.security",
                    format!(
                        "this agent has links beyond this host, and nothing protects them: name zenoh.certificate and \
                         zenoh.authority ({make}), {none}"
                    ),
                );
            }
            (Some(_), None, _) => return refuse("zenoh.certificate", format!("is missing ({make}), {none}")),
            (Some(_), _, None) => return refuse("zenoh.authority", format!("is missing ({make}), {none}")),
        }
        for (key, endpoint) in endpoints() {
            if endpoint.starts_with(PLAIN) {
                return refuse(key, format!("{endpoint:?} is plain TCP: write \"tls/…\", {none}"));
            }
            if endpoint.starts_with(TLS_IPV6) {
                // It takes the brackets for a part of the name. Robots that scout would be told of this address alone.
                return refuse(
                    key,
                    format!(
                        "{endpoint:?} is an IPv6 address, to which Zenoh opens no link by TLS; write an IPv4 address, \
                         a host's name, or \"tls/0.0.0.0:…\" to listen"
                    ),
                );
            }
        }
        Ok(())
    }

    /// Whether the session of the robots has its endpoints on this host's loopback alone, and does not look for others:
    /// a swarm on one computer, as in simulations and tests.
    pub fn stays_on_this_host(&self) -> bool {
        !self.is_guarded() && self.mode != Mode::Client && !self.listen.is_empty() && self.links_stay_on_this_host()
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

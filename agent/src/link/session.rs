//! A Zenoh session as Merganser wants it: explicit endpoints, bounded messages, links that one side alone opens, TLS with
//! certificates on both sides where there are credentials, and an access list of who may speak on which keys.

use super::access;
use crate::certificates::credentials::{Credentials, Members};
use crate::config::{FileConfig, FileConfigError, Mode, ZenohConfig};
use crate::keys;
use crate::link::scouting::Place;
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use merganser_protocol::ids::Name;
use serde_json::{Value, json};
use std::time::Duration;
use thiserror::Error;
use zenoh::{Config, Session};

/// Longest wait for a session to open.
const OPEN_TIMEOUT: Duration = Duration::from_secs(15);

/// Room for Zenoh's own fields, and for what is told to be too large instead of dropped in silence.
const INPUT_SLACK_BYTES: usize = 1 << 16;

/// Why Zenoh does not serve.
#[derive(Debug, Error)]
pub enum LinkError {
    /// A setting is refused.
    #[error("zenoh refuses {key} = {value}: {reason}")]
    Setting {
        /// Zenoh's name of the setting.
        key: &'static str,
        /// The value.
        value: Value,
        /// What Zenoh said.
        reason: String,
    },
    /// The session does not open.
    #[error("zenoh does not open ({reason}); is another program listening on {listen:?}?")]
    Open {
        /// The endpoints to listen on.
        listen: Vec<String>,
        /// What Zenoh said.
        reason: String,
    },
    /// Peers can be found by scouting alone, and scouting goes on where this host is no more.
    #[error(
        "this host has a new address, {place}, and Zenoh scouts from those that it had when the agent started: it would \
         find nobody. Start the agent again (a service manager does), or name peers in zenoh.connect"
    )]
    Astray {
        /// The new address.
        place: Place,
    },
    /// A declaration is refused.
    #[error("zenoh refuses to serve {key}: {reason}")]
    Declare {
        /// The key.
        key: String,
        /// What Zenoh said.
        reason: String,
    },
}

/// What a session is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// A robot of the swarm.
    Robot,
    /// Somebody who only looks on: opens links to all it hears of, because nobody can open one to it.
    Onlooker,
}

/// What protects links: who we are, and who may be at their other ends.
#[derive(Clone, Debug)]
pub struct Guard {
    /// Our authority, certificate and key.
    pub credentials: Credentials,
    /// The swarm that links are for.
    pub swarm: Name,
    /// The robot whose links these are; `None` if somebody only looks on.
    pub robot: Option<Name>,
    /// Who may link.
    pub members: Members,
}

impl Guard {
    /// Of a robot, or of an observer; `None` if links are plain.
    ///
    /// # Errors
    /// [`FileConfigError`] if what TLS needs is missing or does not fit.
    pub fn of(config: &FileConfig) -> Result<Option<Self>, FileConfigError> {
        let guard = |credentials| Self {
            credentials,
            swarm: config.swarm.clone(),
            robot: config.roster.contains_key(&config.robot).then(|| config.robot.clone()),
            members: config.members(),
        };
        Ok(config.credentials()?.map(guard))
    }
}

/// Opens a session with plain links.
///
/// # Errors
/// [`LinkError`].
pub async fn open(config: &ZenohConfig, role: Role) -> Result<Session, LinkError> {
    opened(settings(config, role)?, &config.listen).await
}

/// Opens a session whose links are by TLS if there is a guard.
///
/// # Errors
/// [`LinkError`].
pub async fn open_guarded(config: &ZenohConfig, role: Role, guard: Option<&Guard>) -> Result<Session, LinkError> {
    match guard {
        Some(guard) => opened(guarded_settings(config, role, guard)?, &config.listen).await,
        None => open(config, role).await,
    }
}

/// Where the robot's own SLAM comes in.
#[derive(Debug)]
pub struct Entry<'a> {
    /// The robot's swarm.
    pub swarm: &'a Name,
    /// The robot whose input is taken.
    pub robot: &'a Name,
    /// Where to listen.
    pub endpoints: &'a [String],
}

/// Opens a session that looks for nobody, and on which nothing but the robot's own input can be published.
///
/// # Errors
/// [`LinkError`].
pub async fn open_entry(config: &ZenohConfig, entry: &Entry<'_>) -> Result<Session, LinkError> {
    opened(entry_settings(config, entry)?, entry.endpoints).await
}

async fn opened(settings: Config, listen: &[String]) -> Result<Session, LinkError> {
    let refused = |reason| LinkError::Open { listen: listen.to_vec(), reason };
    match tokio::time::timeout(OPEN_TIMEOUT, zenoh::open(settings)).await {
        Ok(session) => session.map_err(|error| refused(in_words(error))),
        Err(_) => Err(refused(format!("no answer in {} s", OPEN_TIMEOUT.as_secs()))),
    }
}

/// Closes a session, but waits no longer than `wait`: with many links Zenoh takes its time.
pub async fn close(session: &Session, wait: Duration) {
    match tokio::time::timeout(wait, session.close()).await {
        Ok(Ok(())) => {}
        Ok(Err(reason)) => tracing::warn!(%reason, "zenoh did not close in order"),
        Err(_) => tracing::warn!(?wait, "zenoh did not close in time"),
    }
}

fn settings(config: &ZenohConfig, role: Role) -> Result<Config, LinkError> {
    let feeding = config.feeding_interfaces();
    taken([
        ("mode", json!(config.mode.as_str())),
        (
            "listen/endpoints",
            json!(if config.mode == Mode::Client || role == Role::Onlooker { &[] } else { config.listen.as_slice() }),
        ),
        ("connect/endpoints", json!(others(config))),
        // A robot that is not there yet must not keep this one from starting.
        ("connect/timeout_ms", json!({"router": -1, "peer": -1, "client": 10_000})),
        ("connect/exit_on_failure", json!({"router": false, "peer": false, "client": true})),
        // A robot waits for nobody when it starts; else Zenoh warns each time that nobody was found yet.
        ("open/return_conditions/connect_scouted", json!(role == Role::Onlooker)),
        ("connect/retry", json!({"period_init_ms": 250, "period_max_ms": 4000, "period_increase_factor": 2.0})),
        ("scouting/multicast/enabled", json!(config.multicast)),
        ("scouting/multicast/interface", json!(config.interface)),
        ("scouting/multicast/autoconnect_strategy", strategy(role)),
        ("scouting/gossip/enabled", json!(config.gossip)),
        ("scouting/gossip/autoconnect_strategy", strategy(role)),
        ("transport/link/tx/lease", json!((config.lease_secs * 1e3) as u64)),
        ("transport/link/rx/max_message_size", json!(message_bytes_max(config, role))),
        ("transport/shared_memory/enabled", json!(false)),
        ("access_control", access::of_anyone(&feeding)),
    ])
}

/// What opens and accepts links by TLS alone, with certificates of one authority on both sides; where names are checked
/// is the access list. Zenoh's own check of names compares them to addresses, which robots change; and it also takes
/// what the public authorities of the Web sign (zenoh #2711, #2764), so that without names in the list anyone could be
/// called, who would then be told and could say nothing.
pub fn tls(credentials: &Credentials) -> [(&'static str, Value); 9] {
    let [authority, certificate, key] =
        [credentials.authority.pem(), credentials.certificate.pem(), credentials.key_pem()]
            .map(|pem| json!(STANDARD.encode(pem)));
    [
        ("transport/link/protocols", json!(["tls"])),
        ("transport/link/tls/root_ca_certificate_base64", authority),
        ("transport/link/tls/listen_certificate_base64", certificate.clone()),
        ("transport/link/tls/listen_private_key_base64", key.clone()),
        ("transport/link/tls/connect_certificate_base64", certificate),
        ("transport/link/tls/connect_private_key_base64", key),
        ("transport/link/tls/enable_mtls", json!(true)),
        ("transport/link/tls/verify_name_on_connect", json!(false)),
        ("transport/link/tls/close_link_on_expiration", json!(true)),
    ]
}

fn guarded_settings(config: &ZenohConfig, role: Role, guard: &Guard) -> Result<Config, LinkError> {
    let mut settings = settings(config, role)?;
    let feeding = config.feeding_interfaces();
    let feeding = guard.robot.as_ref().filter(|_| !feeding.is_empty()).map(|robot| (robot, feeding.as_slice()));
    let list = match guard.robot {
        Some(_) => access::by_name(&guard.swarm, &guard.members, config.mode == Mode::Router, feeding),
        None => access::of_onlooker(&guard.swarm, &guard.members),
    };
    for (key, value) in tls(&guard.credentials).into_iter().chain([("access_control", list)]) {
        settings.insert_json5(key, &value.to_string()).map_err(|error| {
            let value = if key.contains("base64") { json!("…") } else { value };
            refused_setting(key, value, error)
        })?;
    }
    Ok(settings)
}

fn entry_settings(config: &ZenohConfig, entry: &Entry<'_>) -> Result<Config, LinkError> {
    let inputs = keys::of(entry.swarm, entry.robot, "in/*");
    let everyone = json!([{"id": "everyone"}]);
    let rule = |id: &str, messages: Value, flow: Value, key: &str| json!({"id": id, "permission": "allow", "messages": messages, "flows": flow, "key_exprs": [key]});
    let mut settings = taken([
        ("mode", json!("peer")),
        ("listen/endpoints", json!(entry.endpoints)),
        ("connect/endpoints", json!([])),
        ("scouting/multicast/enabled", json!(false)),
        // Without gossip Zenoh warns at each start; so it is on, and goes to nobody.
        ("scouting/gossip/target", json!({"router": [], "peer": []})),
        ("scouting/gossip/autoconnect", json!({"router": [], "peer": []})),
        ("open/return_conditions/connect_scouted", json!(false)),
        ("transport/link/tx/lease", json!((config.lease_secs * 1e3) as u64)),
        ("transport/link/rx/max_message_size", json!(config.input_bytes_max + INPUT_SLACK_BYTES)),
        ("transport/shared_memory/enabled", json!(false)),
        (
            "access_control",
            json!({
                "enabled": true,
                "default_permission": "deny",
                "rules": [
                    rule("ask and declare", access::asking(), json!(["ingress", "egress"]), "**"),
                    rule("show", json!(["put", "delete"]), json!(["egress"]), "**"),
                    rule("feed", json!(["put"]), json!(["ingress"]), &inputs),
                ],
                "subjects": everyone,
                "policies": [{"rules": ["ask and declare", "show", "feed"], "subjects": ["everyone"]}],
            }),
        ),
    ])?;
    if let Some(users) = &config.input_users_file {
        let users = json!(users);
        let (key, value) = ("transport/auth/usrpwd/dictionary_file", users.to_string());
        settings.insert_json5(key, &value).map_err(|error| refused_setting(key, users, error))?;
    }
    Ok(settings)
}

fn taken<const N: usize>(values: [(&'static str, Value); N]) -> Result<Config, LinkError> {
    let mut settings = Config::default();
    for (key, value) in values {
        settings.insert_json5(key, &value.to_string()).map_err(|error| refused_setting(key, value, error))?;
    }
    Ok(settings)
}

fn refused_setting(key: &'static str, value: Value, error: impl std::fmt::Display) -> LinkError {
    LinkError::Setting { key, value, reason: in_words(error) }
}

/// Zenoh has one bound for all links, and drops what exceeds it without a word. Where the robot's own SLAM may send, it
/// lets in what that may send, and a little more, of which we can tell that it is too much; what peers send is measured
/// when it is whole.
fn message_bytes_max(config: &ZenohConfig, role: Role) -> usize {
    if role == Role::Robot && !config.feeding_interfaces().is_empty() {
        return config.message_bytes_max.max(config.input_bytes_max + INPUT_SLACK_BYTES);
    }
    config.message_bytes_max
}

/// An error of Zenoh without the places in its sources (` at /…/endpoint.rs:615.`), which help no user, and without the
/// keys that it writes behind endpoints.
pub fn in_words(error: impl std::fmt::Display) -> String {
    let text = without_keys(&error.to_string());
    let mut words = String::new();
    let mut rest = text.as_str();
    while let Some(at) = rest.find(" at /") {
        let place = &rest[at + 4..];
        let end = place.find(|c: char| c.is_whitespace() || c == ')').unwrap_or(place.len());
        if !place[..end].contains(".rs:") {
            words.push_str(&rest[..at + 5]);
            rest = &rest[at + 5..];
            continue;
        }
        words.push_str(&rest[..at]);
        rest = &place[end..];
    }
    words + rest
}

/// What stands behind `…_base64=` is nobody's business.
fn without_keys(text: &str) -> String {
    const BEGIN: &str = "_base64=";
    let mut parts = text.split(BEGIN);
    let mut words = parts.next().unwrap_or_default().to_owned();
    for part in parts {
        let end = part.find(|c: char| !(c.is_ascii_alphanumeric() || "+/=".contains(c))).unwrap_or(part.len());
        words.push_str(BEGIN);
        words.push('…');
        words.push_str(&part[end..]);
    }
    words
}

/// The connect list without ourselves, so that all robots can share one list.
pub fn others(config: &ZenohConfig) -> Vec<&String> {
    config.connect.iter().filter(|endpoint| !config.listen.contains(endpoint)).collect()
}

/// Of two robots that find each other, one opens the link: with two links per pair, healthy neighbours of a lost robot
/// were measured to freeze for seconds.
fn strategy(role: Role) -> Value {
    let among_peers = if role == Role::Robot { "greater-zid" } else { "always" };
    json!({"router": {"to_router": among_peers, "to_peer": among_peers},
           "peer": {"to_router": "always", "to_peer": among_peers}})
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_in_sources_are_left_out_of_errors() {
        let told = "bad endpoint: x at /home/a b/z.rs at /r/src/endpoint.rs:615.) and at /tmp/file";
        assert_eq!(in_words(told), "bad endpoint: x at /home/a b/z.rs) and at /tmp/file");
    }

    #[test]
    fn zenoh_takes_all_settings_and_does_not_connect_to_itself() {
        let mut config = ZenohConfig { listen: vec!["tcp/127.0.0.1:7001".into()], ..ZenohConfig::default() };
        config.connect = vec!["tcp/127.0.0.1:7001".into(), "tcp/127.0.0.1:7002".into()];
        for (mode, role) in [(Mode::Peer, Role::Robot), (Mode::Router, Role::Robot), (Mode::Client, Role::Robot)] {
            let settings = settings(&ZenohConfig { mode, ..config.clone() }, role).unwrap();
            let connect = settings.get_json("connect/endpoints").unwrap();
            assert!(connect.contains("7002") && !connect.contains("7001"), "{connect}");
            assert_eq!(settings.get_json("transport/link/rx/max_message_size").unwrap(), "1048576", "scouted");
        }
        let bound =
            |config: &ZenohConfig, role| settings(config, role).unwrap().get_json("transport/link/rx/max_message_size");
        config.multicast = false;
        assert_eq!(bound(&config, Role::Robot).unwrap(), "6356992", "this host alone, whose SLAM feeds it");
        assert_eq!(bound(&config, Role::Onlooker).unwrap(), "1048576", "nobody feeds an onlooker");
        config.input_bytes_max = 1 << 16;
        assert_eq!(bound(&config, Role::Robot).unwrap(), "1048576", "what peers may send, at least");
    }

    #[test]
    fn the_entry_looks_for_nobody_and_lets_in_only_the_robots_own_input() {
        let (swarm, robot) = (Name::new("demo").unwrap(), Name::new("alpha").unwrap());
        let entry = Entry { swarm: &swarm, robot: &robot, endpoints: &["tcp/127.0.0.1:7448".into()] };
        let config = ZenohConfig { input_users_file: Some("/x/users".into()), ..ZenohConfig::default() };
        let settings = entry_settings(&config, &entry).unwrap();
        let of = |key: &str| settings.get_json(key).unwrap();
        assert_eq!((of("scouting/multicast/enabled"), of("connect/endpoints")), ("false".into(), "[]".into()));
        assert_eq!(of("scouting/gossip/target"), of("scouting/gossip/autoconnect"));
        assert_eq!(of("scouting/gossip/target"), r#"{"router":[],"peer":[]}"#);
        assert_eq!(of("transport/link/rx/max_message_size"), "6356992");
        assert!(of("access_control").contains("merganser/v1/demo/alpha/in/*"));
        assert_eq!(of("transport/auth/usrpwd/dictionary_file"), "\"/x/users\"");
    }
}

//! The configuration of a Zenoh router of the swarm: one file for `zenohd --config`, with certificate and key in it. It
//! links by TLS alone, and its access list lets each robot speak under its own name only, so that what it relays can be
//! trusted as far as the router is.

use super::authority::Authority;
use super::credentials::{Credentials, Members};
use super::{Certificate, Holder, Problem};
use crate::link::access;
use crate::link::session::tls;
use crate::trust::SecretKey;
use merganser_protocol::ids::Name;
use serde_json::{Map, Value, json};

/// See the module.
#[derive(Clone, Debug)]
pub struct Router {
    /// Its name, in `zenoh.routers` of all robots.
    pub name: Name,
    /// Where it listens.
    pub listen: Vec<String>,
    /// Other routers.
    pub connect: Vec<String>,
    /// Silence after which a link counts as lost.
    pub lease_secs: f64,
}

impl Router {
    /// The file's text, and the certificate in it, made by `authority`.
    ///
    /// # Errors
    /// [`Problem::Make`].
    pub fn configuration(
        &self,
        authority: &Authority,
        members: &Members,
        days: u32,
    ) -> Result<(String, Certificate), Problem> {
        let holder = Holder::Router(self.name.clone());
        let key = SecretKey::generate().map_err(|error| Problem::Make(error.to_string()))?;
        let certificate = authority.issue(&holder, &key.public(), days)?;
        let credentials = Credentials::new(authority.certificate().clone(), certificate.clone(), &key);
        let mut all = json!({
            "mode": "router",
            "listen": {"endpoints": self.listen},
            "connect": {"endpoints": self.connect, "timeout_ms": -1, "exit_on_failure": false},
            "scouting": {"multicast": {"enabled": true}},
            "transport": {
                "link": {"tx": {"lease": (self.lease_secs * 1e3) as u64}},
                "shared_memory": {"enabled": false},
            },
            "access_control": access::by_name(authority.swarm(), members, false, None),
        });
        for (key, value) in tls(&credentials) {
            set(&mut all, key, value);
        }
        let text = serde_json::to_string_pretty(&all).map_err(|error| Problem::Make(error.to_string()))?;
        let head = format!(
            "// Zenoh router {} of swarm {}, written by `merganser keys router`. It holds the router's secret key: mode 0600.\n\
             // Its certificate ends on {}. Who may say what was taken from the roster: write it anew when that changes.\n",
            self.name,
            authority.swarm(),
            certificate.last_day()
        );
        Ok((head + &text + "\n", certificate))
    }
}

/// Sets a value by a path with slashes, as Zenoh names its settings.
fn set(all: &mut Value, path: &str, value: Value) {
    let mut at = all;
    for part in path.split('/') {
        if !at.is_object() {
            *at = Value::Object(Map::new());
        }
        at = &mut at[part];
    }
    *at = value;
}

//! The door by which the robot's own SLAM comes in: a Zenoh session of its own, on this host's loopback, that looks for
//! nobody and joins nobody. What arrives for `…/in/*` on the session of the robots may come from anyone, since a Zenoh
//! router or peer on this host passes on what it is sent; there it is counted, told and refused. An agent whose session
//! never leaves this host (a swarm on one computer) needs no door, and takes input on that session.

use super::session::{self, Entry, LinkError};
use crate::config::{DOOR_PORT, FileConfig, ZenohConfig};
use std::net::{Ipv4Addr, TcpListener};
use std::time::Duration;
use zenoh::Session;

/// Ports that are tried, from [`DOOR_PORT`] up, while others have them: for some agents on one host.
const PORTS_MAX: u16 = 16;
/// Time between two looks at who is linked.
const LOOK_EVERY: Duration = Duration::from_secs(5);

/// Where the robot's own SLAM may send, and read views.
#[derive(Debug)]
pub(super) struct Door {
    /// The session of its own; `None` if the session of the robots serves.
    pub session: Option<Session>,
    /// Where to connect.
    pub endpoints: Vec<String>,
    /// Interfaces over which the session of the robots takes input, too.
    pub interfaces: Vec<String>,
}

impl Door {
    /// # Errors
    /// [`LinkError`] if none of its endpoints can be had.
    pub async fn open(config: &FileConfig) -> Result<Self, LinkError> {
        let zenoh = &config.zenoh;
        let interfaces = zenoh.feeding_interfaces();
        if zenoh.input_listen.is_none() && zenoh.stays_on_this_host() {
            return Ok(Self { session: None, endpoints: zenoh.listen.clone(), interfaces });
        }
        let endpoints = match &zenoh.input_listen {
            Some(chosen) => chosen.clone(),
            None => vec![format!("tcp/127.0.0.1:{}", free_port())],
        };
        let entry = Entry { swarm: &config.swarm, robot: &config.robot, endpoints: &endpoints };
        let session = session::open_entry(zenoh, &entry).await?;
        if zenoh.input_listen.is_none() && !endpoints[0].ends_with(&format!(":{DOOR_PORT}")) {
            tracing::warn!(
                input = endpoints[0],
                "another program has port {DOOR_PORT}: the robot's own SLAM connects to this endpoint as long as that \
                 lasts; set zenoh.input_listen to choose one for good"
            );
        }
        tracing::info!(input = ?endpoints, "the robot's own SLAM connects here, as a client");
        Ok(Self { session: Some(session), endpoints, interfaces })
    }

    /// What somebody is told who sends input on the session of the robots.
    pub fn cure(&self) -> String {
        format!(
            "this robot's own SLAM connects to {} as a client, with scouting off; zenoh.input_listen chooses the \
             endpoint, zenoh.input_interfaces lets input in here, too",
            self.endpoints.join(" or ")
        )
    }
}

/// The first port from [`DOOR_PORT`] that nobody has now. If all are taken, the first: opening it tells so.
fn free_port() -> u16 {
    let free = |port: &u16| TcpListener::bind((Ipv4Addr::LOCALHOST, *port)).is_ok();
    (DOOR_PORT..DOOR_PORT + PORTS_MAX).find(free).unwrap_or(DOOR_PORT)
}

/// Warns once of a Zenoh router or peer at the door: it passes on what others send it, clients do not.
pub(super) async fn watch(session: Session, config: ZenohConfig) {
    if config.input_users_file.is_some() {
        return; // whoever comes has shown a password
    }
    loop {
        tokio::time::sleep(LOOK_EVERY).await;
        let (routers, peers) = (session.info().routers_zid().await.count(), session.info().peers_zid().await.count());
        if routers + peers > 0 {
            tracing::warn!(
                routers,
                peers,
                "a Zenoh router or peer is connected where the robot's own SLAM comes in, and passes on what others \
                 send it: connect the SLAM with mode = \"client\""
            );
            return;
        }
    }
}

//! An ordinary Zenoh subscriber beside each robot: a process in the robot's namespace that asks the agent for its views
//! over the loopback of that namespace, which no fault touches, and writes down each answer as a line of JSON. It is
//! this test program, started anew.

use super::common::name;
use merganser::config::ZenohConfig;
use merganser::keys;
use merganser::link::session::{self, Role};
use serde_json::{Value, json};
use std::time::Duration;
use zenoh::Session;

/// Names the robot to look at; without it there is nothing to do.
pub const ROBOT: &str = "MERGANSER_TEST_SPECTATOR_OF";
/// The port that all agents of these tests listen on.
pub const PORT: u16 = 7447;
/// Where each takes its own robot's input and shows its views, without a certificate: its host's loopback alone.
const DOOR: u16 = merganser::config::DOOR_PORT;

/// Time between two looks.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Longest wait for an answer.
const ANSWER_WAIT: Duration = Duration::from_secs(2);

pub fn main() {
    let Ok(robot) = std::env::var(ROBOT) else { return };
    std::thread::spawn(|| {
        let _ = std::io::copy(&mut std::io::stdin(), &mut std::io::sink());
        std::process::exit(0); // whoever started us is gone
    });
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    runtime.block_on(look(&robot));
}

async fn look(robot: &str) {
    let connect = vec![format!("tcp/127.0.0.1:{DOOR}")];
    let zenoh = ZenohConfig { connect, multicast: false, gossip: false, ..ZenohConfig::default() };
    let session = session::open(&zenoh, Role::Onlooker).await.unwrap();
    loop {
        let mut seen = json!({});
        for view in ["status", "frames", "stats"] {
            seen[view] = ask(&session, robot, view).await.unwrap_or_default();
        }
        println!("{seen}");
        tokio::time::sleep(LOOK_EVERY).await;
    }
}

async fn ask(session: &Session, robot: &str, view: &str) -> Option<Value> {
    let key = keys::of(&name("test"), &name(robot), &format!("view/{view}"));
    let replies = session.get(key).timeout(ANSWER_WAIT).await.unwrap();
    let reply = replies.recv_async().await.ok()?;
    serde_json::from_slice(&reply.result().ok()?.payload().to_bytes()).ok()
}

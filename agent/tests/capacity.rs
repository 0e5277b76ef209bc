//! That one agent holds the facts of a hundred robots, and what it costs.
//!
//! ```sh
//! cargo test --release -p merganser --test capacity -- --ignored --nocapture
//! ```
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "a test that prints what it measures")]

mod common;

use common::{PATIENCE, name, until};
use core::num::NonZero;
use ed25519_dalek::SigningKey;
use merganser::config::FileConfig;
use merganser::link::session::{self, Role};
use merganser::trust::SecretKey;
use merganser::{keys, store};
use merganser_protocol::agent::io::Record;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::{EntryId, FrameId, Hash, RobotId};
use merganser_protocol::submap::Summary;
use merganser_protocol::time::Stamp;
use merganser_protocol::wire::fact::{ScaleKind, SubmapFact};
use merganser_protocol::wire::{Entry, EntryContent, Fact, SwarmTag};
use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

const ROBOTS: u8 = 100;
const FACTS: u32 = 360;
/// How long the agent is left alone, and then watched.
const WATCHED: Duration = Duration::from_secs(20);

/// Stops the process whatever happens.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "night: a measurement of half a minute"]
async fn an_agent_holds_the_facts_of_a_hundred_robots() {
    let dir = tempfile::tempdir().unwrap();
    let config = alone_among(dir.path());
    fill(&config);
    let megabytes = std::fs::metadata(&config.store.path).unwrap().len() as f64 / 1e6;

    let began = Instant::now();
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser"));
    command.args(["run", "--config", "a0.toml"]).current_dir(dir.path()).stdout(Stdio::null()).stderr(Stdio::piped());
    let mut agent = Running(command.spawn().unwrap());
    let mut log = BufReader::new(agent.0.stderr.take().unwrap()).lines();
    assert!(log.any(|line| line.unwrap().contains("agent runs")));
    let started = began.elapsed();
    let mut onlooker = None;
    until("the agent listens", async || {
        onlooker = session::open(&onlookers(&config), Role::Onlooker).await.ok();
        onlooker.is_some()
    })
    .await;
    let session = onlooker.unwrap();
    let key = keys::of(&config.swarm, &config.robot, "view/status");
    let mut held = 0;
    until("the agent holds all", async || {
        let Ok(replies) = session.get(&key).timeout(Duration::from_secs(2)).await else { return false };
        let Some(Ok(sample)) = replies.recv_async().await.ok().map(|reply| reply.into_result()) else { return false };
        let status: serde_json::Value = serde_json::from_slice(&sample.payload().to_bytes()).unwrap();
        held = status["entries"].as_u64().unwrap();
        held == u64::from(ROBOTS) * u64::from(FACTS)
    })
    .await;

    tokio::time::sleep(WATCHED / 2).await;
    let before = cpu_seconds(agent.0.id());
    tokio::time::sleep(WATCHED).await;
    let busy = (cpu_seconds(agent.0.id()) - before) / WATCHED.as_secs_f64();
    let (resident, peak) = (status_kb(agent.0.id(), "VmRSS:") / 1e3, status_kb(agent.0.id(), "VmHWM:") / 1e3);
    println!(
        "{held} facts of {ROBOTS} robots, store {megabytes:.0} MB: ready after {:.2} s, {resident:.1} MB resident \
         ({peak:.1} at most), {:.2} % of a core at rest",
        started.as_secs_f64(),
        100.0 * busy
    );
    session::close(&session, PATIENCE).await;
}

/// The first of a hundred robots, with nobody in reach.
fn alone_among(folder: &Path) -> FileConfig {
    let secret = |k: u8| SecretKey::from_bytes([k + 1; 32]);
    let roster = (0..ROBOTS).map(|k| (name(&format!("a{k}")), secret(k).public())).collect();
    let file = folder.join("a0.key");
    secret(0).save(&file).unwrap();
    let mut config = FileConfig::new(name("test"), name("a0"), file, roster);
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    config.zenoh.listen = vec![format!("tcp/127.0.0.1:{port}")];
    config.zenoh.multicast = false;
    config.store.path = folder.join("a0.redb");
    config.save(&folder.join("a0.toml")).unwrap();
    config
}

fn onlookers(config: &FileConfig) -> merganser::config::ZenohConfig {
    let mut zenoh = config.zenoh.clone();
    zenoh.connect = core::mem::take(&mut zenoh.listen);
    zenoh
}

fn fill(config: &FileConfig) {
    let mut store = store::open(config).unwrap().store;
    for robot in 0..ROBOTS {
        let records = log(robot);
        store.commit(records.iter()).unwrap();
    }
}

/// Submaps as a robot would state them, every metre or so.
fn log(robot: u8) -> Vec<Record> {
    let key = SigningKey::from_bytes(&[robot + 1; 32]);
    let frame = FrameId { robot: RobotId::of_key(key.verifying_key().as_bytes()), epoch: 200_000_000 };
    let swarm = SwarmTag::of(&name("test"));
    let mut previous = Hash::default();
    let record = |seq| {
        let fact = submap(seq);
        let (kind, payload) = (fact.kind(), fact.to_payload().unwrap());
        let id = EntryId { frame, seq };
        let content = EntryContent { swarm, id, kind, floor: 0, previous, payload };
        let entry = Entry::sign(&key, content).unwrap();
        previous = entry.hash();
        Record::Entry { id, bytes: entry.encode() }
    };
    (0..FACTS).map(record).collect()
}

fn submap(index: u32) -> Fact {
    let covariance = Covariance::from_sigmas([0.02, 0.02, 0.02, 0.002, 0.002, 0.002]).unwrap();
    let pose = Se3::new(So3::exp(&[0.0, 0.0, 0.02].into()), [1.0, 0.0, 0.0].into());
    Fact::Submap(SubmapFact {
        index,
        stamps: [Stamp(i64::from(index) * 2_000_000_000), Stamp(i64::from(index + 1) * 2_000_000_000)],
        odometry: PoseWithCovariance { pose, covariance },
        extent: [4.0, 3.0, 1.5],
        summary: summary(index),
        keypoint_count: 384,
        blob: Hash::of(&index.to_le_bytes()),
        scale: ScaleKind::Metric,
        keyframes: NonZero::new(4),
    })
}

/// Histograms without meaning, each of its own; the largest bin is 255.
fn summary(index: u32) -> Vec<u8> {
    let drawn = Hash::of(&index.to_le_bytes());
    let mut bytes = vec![2, 16];
    bytes.extend(0.2_f32.to_le_bytes());
    let header = bytes.len();
    bytes.extend((0..128).map(|k| drawn.0[k % 32].wrapping_add((k / 32) as u8)));
    bytes[header] = 255;
    Summary::decode(&bytes).unwrap();
    bytes
}

fn status_kb(process: u32, field: &str) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with(field)).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

/// Processor time used so far: the 14th and 15th fields, in hundredths of a second.
fn cpu_seconds(process: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    let after_name = stat.rsplit(") ").next().unwrap();
    let ticks = |field: usize| after_name.split(' ').nth(field).unwrap().parse::<f64>().unwrap();
    (ticks(11) + ticks(12)) / 100.0
}

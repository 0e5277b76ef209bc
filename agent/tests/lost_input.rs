//! Keyframes that never reach the core, sent as a SLAM sends them, by the agent's own door: what is too large, and what
//! finds the queue full, is counted, and the motion across counts as known to `gap_sigma_per_m` only. And what an agent
//! says when it starts while nobody else is there.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{PATIENCE, free_endpoint, name, start, swarm, until};
use merganser::config::FileConfig;
use merganser::driver::Clock;
use merganser::host::Host;
use merganser::keys;
use merganser::link::session;
use merganser::observation::KeyframeMessage;
use merganser::store;
use merganser_protocol::agent::io::{Input, Output};
use merganser_protocol::agent::{Agent, Core};
use merganser_protocol::geometry::{Covariance, Se3, So3};
use merganser_protocol::ids::Hash;
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::time::{Instant, Stamp};
use nalgebra::Vector3;
use serde_json::json;
use std::fs;
use std::process::{Command, Stdio};
use std::time::Duration;
use zenoh::Session;
use zenoh::qos::CongestionControl;

/// The `index`-th keyframe of a way straight ahead, a metre and a second each.
fn ahead(index: i64, points: usize) -> KeyframeMessage {
    let mut keyframe = common::keyframe(0, 0);
    keyframe.stamp = Stamp(1_000_000_000_000 + index * 1_000_000_000);
    keyframe.pose.pose = Se3::new(So3::identity(), Vector3::new(index as f64, 0.0, 0.0));
    keyframe.pose.covariance = Covariance::from_sigmas([0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3]).unwrap();
    keyframe.points = keyframe.points.iter().copied().cycle().take(points).collect();
    KeyframeMessage::from(&keyframe)
}

/// An agent whose door is open, its configuration changed.
fn configured(folder: &std::path::Path, change: impl FnOnce(&mut FileConfig)) -> FileConfig {
    let mut config = swarm(folder, &["alpha"]).remove(0);
    config.core.submap.distance_m = 10.0; // the way across the gap: more would be a jump
    config.zenoh.input_listen = Some(vec![free_endpoint()]);
    change(&mut config);
    config
}

/// A SLAM at the door.
async fn slam(config: &FileConfig) -> Session {
    let mut client = zenoh::Config::default();
    for (key, value) in [
        ("mode", json!("client")),
        ("connect/endpoints", json!(config.zenoh.input_listen)),
        ("scouting/multicast/enabled", json!(false)),
    ] {
        client.insert_json5(key, &value.to_string()).unwrap();
    }
    tokio::time::timeout(PATIENCE, zenoh::open(client)).await.unwrap().unwrap()
}

async fn send(slam: &Session, message: &KeyframeMessage) {
    let bytes = postcard::to_stdvec(message).unwrap();
    let put = slam.put(keys::of(&name("test"), &name("alpha"), "in/keyframe"), bytes);
    put.encoding("application/octet-stream").congestion_control(CongestionControl::Block).await.unwrap();
}

/// Keyframes taken, those lost by this cause, and gaps; how uncertain the body is along its way, m.
async fn seen(host: &Host, cause: &str) -> ([u64; 3], f64) {
    let seen = host.snapshots().overview().await.unwrap();
    let lost = seen.status.keyframes_lost.get(cause).copied().unwrap_or_default();
    let own = seen.poses.robots.first().and_then(|robot| robot.t_own_body.as_ref());
    ([seen.status.keyframes, lost, seen.status.gaps], own.map_or(0.0, |pose| pose.sigmas[0]))
}

#[tokio::test(flavor = "multi_thread")]
async fn keyframes_that_are_too_large_leave_a_gap_that_is_counted_and_not_known() {
    let dir = tempfile::tempdir().unwrap();
    let config = configured(dir.path(), |config| config.zenoh.input_bytes_max = 65_536);
    let alpha = start(&config, None).await;
    let slam = slam(&config).await;
    // A message before the way is known may be lost: the first is repeated, which is no loss.
    until("the first keyframe", async || {
        send(&slam, &ahead(0, 400)).await;
        seen(&alpha, "too_large").await.0[0] == 1
    })
    .await;
    for index in 1..12 {
        send(&slam, &ahead(index, 400)).await;
    }
    // Where the body is, is known once the first submap is.
    let knows = |(counts, sigma): ([u64; 3], f64), taken: u64| counts[0] == taken && sigma > 0.0;
    until("what was sent", async || knows(seen(&alpha, "too_large").await, 12)).await;
    let before = seen(&alpha, "too_large").await;
    assert!(before.0 == [12, 0, 0] && before.1 < 0.1, "{before:?}");
    for index in 12..32 {
        send(&slam, &ahead(index, if index < 21 { 6_000 } else { 400 })).await;
    }
    until("what was sent", async || knows(seen(&alpha, "too_large").await, 23)).await;
    let (counts, sigma) = seen(&alpha, "too_large").await;
    // A tenth of the ten metres.
    assert!(counts == [23, 9, 1] && (0.7..1.5).contains(&sigma), "{counts:?}, {sigma} m");
    session::close(&slam, PATIENCE).await;
    alpha.stop().await.unwrap();
}

/// An agent that takes its time.
struct Slow(Agent, Duration);

impl Core for Slow {
    fn handle(&mut self, now: Instant, input: Input) {
        if matches!(input, Input::Keyframe(_)) {
            std::thread::sleep(self.1);
        }
        self.0.handle(now, input);
    }
    fn poll_output(&mut self) -> Option<Output> {
        self.0.poll_output()
    }
    fn poll_timeout(&self) -> Option<Instant> {
        self.0.poll_timeout()
    }
    fn digest(&self) -> Hash {
        self.0.digest()
    }
    fn is_saving(&self) -> bool {
        self.0.is_saving()
    }
    fn snapshot(&self, now: Instant) -> Option<Snapshot> {
        Some(self.0.overview(now))
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn keyframes_that_find_the_queue_full_are_counted_to_the_last_and_leave_gaps() {
    let dir = tempfile::tempdir().unwrap();
    let config = configured(dir.path(), |config| {
        config.driver.queue = 16; // of which the SLAM has a quarter
        config.core.submap.distance_m = 100.0;
        config.core.submap.keyframes_max = 4;
    });
    let opened = store::open(&config).unwrap();
    let clock = Clock::start();
    let core = Agent::new(config.core.clone(), config.identity().unwrap(), 7, opened.restored, clock.now()).unwrap();
    let slow = Slow(core, Duration::from_millis(10));
    let alpha = Host::assemble(&config, slow, opened.store, None, clock).await.unwrap();
    let slam = slam(&config).await;
    until("the first keyframe", async || {
        send(&slam, &ahead(0, 64)).await;
        seen(&alpha, "queue_full").await.0[0] == 1
    })
    .await;
    // Many at once, then one by one, so that the last ones are taken and the core hears of all that were lost.
    for index in 1..60 {
        send(&slam, &ahead(index, 64)).await;
    }
    let mut last = 60;
    until("all that were sent to be taken or counted", async || {
        send(&slam, &ahead(last, 64)).await;
        last += 1;
        tokio::time::sleep(Duration::from_millis(50)).await;
        let [taken, lost, _] = seen(&alpha, "queue_full").await.0;
        lost > 0 && taken + lost == last as u64 && seen(&alpha, "queue_full").await.1 > 0.0
    })
    .await;
    let ([_, _, gaps], sigma) = seen(&alpha, "queue_full").await;
    assert!(gaps > 0 && sigma > 0.1, "{gaps} gaps, {sigma} m");
    session::close(&slam, PATIENCE).await;
    alpha.stop().await.unwrap();
}

/// Zenoh warns "Scouting delay elapsed before start conditions are met" where it waits for peers that are not there yet. A
/// robot waits for nobody.
#[test]
fn an_agent_that_starts_first_warns_of_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let mut config = configured(dir.path(), |_| {});
    config.zenoh.connect = vec![free_endpoint()];
    config.save(&dir.path().join("alpha.toml")).unwrap();
    let log = dir.path().join("log");
    let mut agent = Command::new(env!("CARGO_BIN_EXE_merganser"))
        .args(["run", "-c", "alpha.toml"])
        .current_dir(dir.path())
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(fs::File::create(&log).unwrap())
        .spawn()
        .unwrap();
    let begun = std::time::Instant::now();
    let text = || fs::read_to_string(&log).unwrap();
    while !text().contains("agent runs") && begun.elapsed() < PATIENCE {
        std::thread::sleep(Duration::from_millis(20));
    }
    // Zenoh would wait for half a second.
    std::thread::sleep(Duration::from_secs(1));
    assert!(Command::new("kill").arg(agent.id().to_string()).status().unwrap().success());
    assert_eq!(agent.wait().unwrap().code(), Some(0));
    assert!(text().contains("agent runs") && !text().contains("WARN") && !text().contains("Scouting"), "{}", text());
}

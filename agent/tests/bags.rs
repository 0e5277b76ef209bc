//! ROS bags by the program: what `doctor`, `run` and `demo` make of them, and what they say of those that are not
//! clear.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;
#[path = "../ros/src/join/drive.rs"]
mod drive;
#[path = "../ros/src/bag/write_ros1.rs"]
mod write;

use common::swarm;
use drive::{ROBOT, Robot};
use merganser_protocol::geometry;
use merganser_ros as ros;
use ros::wire::Serialization;
use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Output, Stdio};

const PROGRAM: &str = env!("CARGO_BIN_EXE_merganser");
const DRIVER: Robot<'static> = Robot { serialization: Serialization::Ros1, ..ROBOT };

fn merganser(arguments: &[&str], folder: &Path) -> Output {
    Command::new(PROGRAM).args(arguments).current_dir(folder).output().unwrap()
}

/// Exit code 2, and the one line.
fn refused(arguments: &[&str], folder: &Path) -> String {
    let output = merganser(arguments, folder);
    let told = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(2), "{told}");
    told
}

fn save(folder: &Path, name: &str, robots: &[Robot<'_>]) {
    let mut messages: Vec<_> = robots.iter().flat_map(|robot| robot.drive(24.0)).collect();
    messages.sort_by_key(|message| message.received_ns);
    std::fs::write(folder.join(name), write::bag(&messages, "none", <[u8]>::to_vec)).unwrap();
}

#[test]
fn the_doctor_looks_at_a_bag_and_says_what_is_not_clear() {
    let dir = tempfile::tempdir().unwrap();
    save(dir.path(), "drive.bag", &[DRIVER]);
    let output = merganser(&["doctor", "drive.bag", "--json"], dir.path());
    let seen: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!((&seen[0]["robot"], &seen[0]["keyframes"]), (&"drive".into(), &60.into()), "{seen:#}");
    let told = String::from_utf8_lossy(&output.stderr);
    assert!(told.contains("drive.bag: /odom states no usable covariance at 60 of 60 keyframes"), "{told}");
    let told = refused(&["doctor", "drive.bag", "--cloud", "/points"], dir.path());
    assert!(told.contains("--cloud /points: there is no such topic") && told.contains("/scan"), "{told}");
    std::fs::write(dir.path().join("cut.bag"), "#ROSBAG V2.0\n\x07\0").unwrap();
    let told = refused(&["doctor", "cut.bag"], dir.path());
    assert!(told.contains("cut.bag") && told.contains("rosbag reindex"), "{told}");
    let told = refused(&["demo", "--odometry", "/odom"], dir.path());
    assert!(told.contains("name the bag by --data"), "{told}");
    let recording = std::path::absolute("recordings/alpha").unwrap();
    let told = refused(&["doctor", recording.to_str().unwrap(), "--odometry", "/odom"], dir.path());
    assert!(told.contains("this is no ROS bag"), "{told}");
}

#[test]
fn an_agent_is_fed_what_a_bag_holds_of_its_robot() {
    let dir = tempfile::tempdir().unwrap();
    let robot = |namespace, phase| Robot { namespace, phase, ..DRIVER };
    save(dir.path(), "swarm.bag", &[robot("/alpha", 0.0), robot("/beta", 2.0)]);
    for config in swarm(dir.path(), &["alpha", "carol"]) {
        config.save(&dir.path().join(format!("{}.toml", config.robot))).unwrap();
    }
    let told = refused(&["run", "-c", "carol.toml", "--recording", "swarm.bag"], dir.path());
    assert!(told.contains("holds the robots alpha, beta, none of which is carol"), "{told}");
    let arguments = ["run", "-c", "alpha.toml", "--recording", "swarm.bag", "--speed", "1000"];
    let mut command = Command::new(PROGRAM);
    let mut agent =
        command.args(arguments).current_dir(dir.path()).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap();
    let lines = BufReader::new(agent.stderr.take().unwrap()).lines().map_while(Result::ok);
    let mut seen = Vec::new();
    let fed = lines.inspect(|line| seen.push(line.clone())).find(|line| line.contains("recording fed"));
    let _ = agent.kill();
    let _ = agent.wait();
    assert!(fed.is_some_and(|line| line.contains("keyframes=60")), "{seen:#?}");
}

/// The submaps of a bag, as those of a recording; of several robots one is chosen by its topics.
#[test]
fn submaps_of_bags_are_read_as_those_of_recordings() {
    let dir = tempfile::tempdir().unwrap();
    save(dir.path(), "drive.bag", &[DRIVER]);
    let output = merganser(&["align", "drive.bag:1", "drive.bag:1", "--json"], dir.path());
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"));
    // The world of these drives looks like itself, turned.
    let seen = (&told["a"]["name"], &told["refused"]["reason"], output.status.code());
    assert_eq!(seen, (&"drive.bag:1".into(), &"ambiguous".into(), Some(1)), "{told:#}");
    assert!(told["a"]["keypoints"].as_u64().unwrap() > 100, "{told:#}");
    let why = refused(&["align", "drive.bag:99", "drive.bag"], dir.path());
    assert!(why.contains("drive.bag:99: there is no submap 99"), "{why}");
    let why = refused(&["align", "drive.bag", "drive.bag", "--cloud", "/nothing"], dir.path());
    assert!(why.contains("/nothing"), "{why}");
}

//! The program itself: `run` with a recording and a journal, ended by SIGTERM; `replay` of what it wrote; `watch`
//! beside it.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{PATIENCE, swarm};
use merganser::config::FileConfig;
use merganser::store;
use merganser_protocol::agent::io::Record;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::Instant;

const PROGRAM: &str = env!("CARGO_BIN_EXE_merganser");

/// A recording of eight keyframes, written by hand.
fn recording(folder: &Path) {
    std::fs::create_dir_all(folder).unwrap();
    let keyframes: Vec<_> = (0..8).map(|index| common::keyframe(0, index)).collect();
    let mut table = format!("{}\n", merganser_recording::manifest::KEYFRAMES_HEADER);
    for (index, keyframe) in keyframes.iter().enumerate() {
        let cloud = format!("{index}.bin");
        let bytes: Vec<u8> = keyframe.points.iter().flatten().flat_map(|x| x.to_le_bytes()).collect();
        std::fs::write(folder.join(&cloud), bytes).unwrap();
        let message = merganser::observation::KeyframeMessage::from(keyframe);
        let numbers = message.translation.iter().chain(&message.rotation).chain(&message.covariance);
        let numbers: Vec<String> = numbers.map(ToString::to_string).collect();
        table += &format!("{},{},{cloud}\n", message.stamp_ns, numbers.join(","));
    }
    std::fs::write(folder.join("keyframes.csv"), table).unwrap();
    let manifest = "format = \"merganser-recording\"\nversion = 1\nrobot = \"alpha\"\nsensor = \"test\"\n\
                    clouds = \"xyz-bin\"\nkeyframes = 8\n[config.submap]\nkeyframes_max = 4\n";
    std::fs::write(folder.join("recording.toml"), manifest).unwrap();
}

fn spawn(arguments: &[&str], folder: &Path) -> Child {
    let mut command = Command::new(PROGRAM);
    command.args(arguments).current_dir(folder).stdout(Stdio::piped()).stderr(Stdio::piped());
    command.spawn().unwrap()
}

fn terminate(child: Child) -> Output {
    let sent = Command::new("kill").args(["-TERM", &child.id().to_string()]).status().unwrap();
    assert!(sent.success());
    child.wait_with_output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Configuration files of a swarm of the core's defaults; returns their endpoints.
fn write_configs(folder: &Path, names: &[&str]) -> Vec<String> {
    let save = |config: FileConfig| {
        let endpoint = config.zenoh.listen[0].clone();
        let config = FileConfig { core: Default::default(), ..config };
        config.save(&folder.join(format!("{}.toml", config.robot))).unwrap();
        endpoint
    };
    swarm(folder, names).into_iter().map(save).collect()
}

#[test]
fn run_is_fed_watched_ended_and_replayed() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    recording(&folder.join("walk"));
    let endpoints = write_configs(folder, &["alpha", "beta"]);
    let other = spawn(&["run", "-c", "beta.toml"], folder); // a robot alone has nobody to send a beacon to
    let arguments = [
        "run",
        "-c",
        "alpha.toml",
        "--recording",
        "walk",
        "--speed",
        "10",
        "--journal",
        "alpha.journal",
        "--seed",
        "3",
    ];
    let agent = spawn(&arguments, folder);

    let watch = ["watch", "--swarm", "test", "--no-multicast", "--connect", &endpoints[0], "--for", "3"];
    let deadline = Instant::now() + PATIENCE;
    let table = loop {
        let table = spawn(&watch, folder).wait_with_output().unwrap();
        let shown = text(&table.stdout);
        let robot = shown.lines().rfind(|line| line.starts_with("alpha ")).unwrap_or_default().to_string();
        if robot.split_whitespace().nth(4).is_some_and(|submaps| submaps == "2") {
            break table;
        }
        assert!(Instant::now() < deadline, "{shown}\n{}", text(&table.stderr));
    };
    assert_eq!(table.status.code(), Some(0));
    let json = spawn(&[&watch[..], &["--json"]].concat(), folder).wait_with_output().unwrap();
    assert_eq!(json.status.code(), Some(0), "{}", text(&json.stderr));
    let lines: Vec<serde_json::Value> =
        text(&json.stdout).lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    for channel in ["pose", "have", "view/status"] {
        let of = |line: &&serde_json::Value| line["channel"] == channel && line["robot"] == "alpha";
        let line = lines.iter().find(of).unwrap_or_else(|| panic!("no {channel} in {}", text(&json.stdout)));
        assert!(line["message"].is_object(), "{line:#}");
    }

    assert_eq!(terminate(other).status.code(), Some(0));
    let ended = terminate(agent);
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    let digest = text(&ended.stdout);
    assert!(digest.starts_with("digest ") && digest.trim().len() == 71, "{digest}");
    let replayed = spawn(&["replay", "alpha.journal", "-c", "alpha.toml"], folder).wait_with_output().unwrap();
    assert_eq!(replayed.status.code(), Some(0), "{}", text(&replayed.stderr));
    let said = text(&replayed.stdout);
    assert!(said.starts_with(&digest) && said.contains("the same digest"), "{said}");
}

#[test]
fn an_agent_that_is_ended_in_mid_drive_keeps_the_submap_it_was_in() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    recording(&folder.join("walk"));
    let endpoints = write_configs(folder, &["alpha"]);
    // The second keyframe would come in eight minutes.
    let agent = spawn(&["run", "-c", "alpha.toml", "--recording", "walk", "--speed", "0.001"], folder);
    let watch = ["watch", "--swarm", "test", "--no-multicast", "--connect", &endpoints[0], "--for", "1", "--json"];
    let deadline = Instant::now() + PATIENCE;
    loop {
        let seen = text(&spawn(&watch, folder).wait_with_output().unwrap().stdout);
        let lines = seen.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
        if lines.filter(|line| line["channel"] == "view/status").any(|line| line["message"]["keyframes"] == 1) {
            break;
        }
        assert!(Instant::now() < deadline, "{seen}");
    }
    let ended = terminate(agent);
    assert_eq!(ended.status.code(), Some(0), "{}", text(&ended.stderr));
    let config = FileConfig::load(&folder.join("alpha.toml")).unwrap();
    let records = store::open(&config).unwrap().restored.records;
    assert!(records.iter().any(|record| matches!(record, Record::Entry { .. })), "{records:?}");
}

#[test]
fn a_bad_cloud_ends_the_agent_with_an_error() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path();
    recording(&folder.join("walk"));
    let cloud = folder.join("walk/2.bin");
    let bytes = std::fs::read(&cloud).unwrap();
    std::fs::write(&cloud, &bytes[..bytes.len() - 1]).unwrap();
    write_configs(folder, &["alpha"]);
    let ended = spawn(&["run", "-c", "alpha.toml", "--recording", "walk", "--speed", "100"], folder);
    let ended = ended.wait_with_output().unwrap();
    assert_eq!(ended.status.code(), Some(2));
    assert!(text(&ended.stderr).contains("2.bin"), "{}", text(&ended.stderr));
}

#[test]
fn an_agent_on_a_leash_ends_with_its_parent() {
    let dir = tempfile::tempdir().unwrap();
    write_configs(dir.path(), &["alpha"]);
    let mut agent = Command::new(PROGRAM)
        .args(["run", "-c", "alpha.toml", "--leash"])
        .current_dir(dir.path())
        .stdin(Stdio::piped())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    std::thread::sleep(std::time::Duration::from_millis(300));
    assert!(agent.try_wait().unwrap().is_none(), "it runs as long as the pipe is open");
    drop(agent.stdin.take());
    let deadline = Instant::now() + PATIENCE;
    let status = loop {
        if let Some(status) = agent.try_wait().unwrap() {
            break status;
        }
        assert!(Instant::now() < deadline);
        std::thread::sleep(std::time::Duration::from_millis(20));
    };
    assert_eq!(status.code(), Some(0));
}

#[test]
fn a_stopped_watch_without_robots_says_so_with_its_exit_code() {
    let dir = tempfile::tempdir().unwrap();
    let watch = ["watch", "--no-multicast", "--for", "1.5"];
    let nobody = spawn(&watch, dir.path()).wait_with_output().unwrap();
    assert_eq!(nobody.status.code(), Some(1), "{}", text(&nobody.stderr));
    assert!(text(&nobody.stdout).contains("no robot answers"));
}

#[test]
fn a_busy_port_and_a_bad_recording_get_one_error_each() {
    let dir = tempfile::tempdir().unwrap();
    let endpoints = write_configs(dir.path(), &["alpha"]);
    let port = endpoints[0].rsplit(':').next().unwrap();
    let busy = std::net::TcpListener::bind(format!("127.0.0.1:{port}")).unwrap();
    let refused = spawn(&["run", "-c", "alpha.toml"], dir.path()).wait_with_output().unwrap();
    drop(busy);
    assert_eq!(refused.status.code(), Some(1));
    let said = text(&refused.stderr);
    assert!(said.lines().last().unwrap().contains("is another program listening on"), "{said}");
    let none: PathBuf = dir.path().join("none");
    let refused = spawn(&["run", "-c", "alpha.toml", "--recording", none.to_str().unwrap()], dir.path());
    let refused = refused.wait_with_output().unwrap();
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused.stderr).contains("none"), "{}", text(&refused.stderr));
}

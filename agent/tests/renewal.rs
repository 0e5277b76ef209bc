//! An agent whose store was cut starts all the same: it serves, writes a new epoch, gets back from a peer what it had
//! said, and tells of it; unless it was told to stop.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{keyframe, start, swarm, until};
use merganser::config::{FileConfig, OnDamage};
use merganser::host::Host;
use merganser::store;
use merganser_protocol::agent::io::{Command, Input, Record};
use merganser_protocol::snapshot::StatusView;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command as Process, Output, Stdio};

async fn status(host: &Host) -> StatusView {
    host.snapshots().overview().await.unwrap().status
}

/// Drives a submap of four keyframes.
async fn drive(host: &Host, from: u64) {
    for index in from..from + 4 {
        host.inbox().feed(Input::Keyframe(keyframe(0, index))).await;
    }
    host.inbox().feed(Input::Command(Command::Flush)).await;
}

async fn agree(what: &str, a: &Host, b: &Host) {
    until(what, async || {
        let (a, b) = (status(a).await, status(b).await);
        a.digest == b.digest && a.entries > 0 && a.unsaved == 0
    })
    .await;
}

/// Entries of a store, of `config`'s own robot alone, by epoch.
fn own_entries(config: &FileConfig) -> BTreeMap<u32, usize> {
    let own = store::owner(config).id;
    let mut epochs = BTreeMap::new();
    for record in store::open(config).unwrap().restored.records {
        if let Record::Entry { id, .. } = record
            && id.frame.robot == own
        {
            *epochs.entry(id.frame.epoch).or_default() += 1;
        }
    }
    epochs
}

#[tokio::test(flavor = "multi_thread")]
async fn an_agent_with_a_cut_store_begins_a_new_epoch_and_gets_its_past_back() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha", "beta"]);
    let beta = start(&configs[1], None).await;
    let mut epochs = Vec::new();
    for (life, cut) in [None, Some(0), Some(4096), Some(70_000)].into_iter().enumerate() {
        if let Some(len) = cut {
            let store = std::fs::read(&configs[0].store.path).unwrap();
            std::fs::write(&configs[0].store.path, &store[..len]).unwrap();
        }
        let alpha = start(&configs[0], None).await;
        let epoch = status(&alpha).await.epoch;
        assert!(epochs.iter().all(|before| *before < epoch), "{epoch} after {epochs:?}");
        epochs.push(epoch);
        let told = alpha.inbox().drops.counts().get("store: damaged beyond mending, begun anew").copied();
        assert_eq!(told, cut.map(|_| 1), "view/stats shows it");
        drive(&alpha, 4 * life as u64).await;
        // A submap of this life is stated, and those of all lives before have come back.
        let mut frames = Vec::new();
        until("the frames of all lives", async || {
            frames = alpha.snapshots().overview().await.unwrap().frames.frames;
            frames.iter().filter(|frame| frame.robot == "alpha" && frame.submaps > 0).count() == life + 1
        })
        .await;
        agree("alpha and beta to hold the same", &alpha, &beta).await;
        assert_eq!(status(&alpha).await.epoch, epoch, "nothing that came back was of this epoch or above: {frames:?}");
        alpha.stop().await.unwrap();
    }
    beta.stop().await.unwrap();
    let own = own_entries(&configs[0]);
    assert_eq!(own.keys().copied().collect::<Vec<_>>(), epochs, "each life came back, and no two share an epoch");
}

/// Runs the program until it has answered or ended by itself.
fn run(folder: &Path, secs: u64) -> Output {
    let mut command = Process::new(env!("CARGO_BIN_EXE_merganser"));
    command.args(["run", "-c", "alpha.toml", "--leash"]).current_dir(folder);
    let mut agent = command.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let leash = agent.stdin.take();
    std::thread::sleep(std::time::Duration::from_secs(secs));
    drop(leash);
    agent.wait_with_output().unwrap()
}

/// A store of alpha's that was cut, and its configuration in a file.
fn cut(folder: &Path, on_damage: OnDamage) -> PathBuf {
    let mut config = swarm(folder, &["alpha"]).remove(0);
    drop(store::open(&config).unwrap());
    let whole = std::fs::read(&config.store.path).unwrap();
    std::fs::write(&config.store.path, &whole[..whole.len() / 2]).unwrap();
    config.store.on_damage = on_damage;
    config.save(&folder.join("alpha.toml")).unwrap();
    config.store.path
}

#[test]
fn the_operator_is_told_what_was_damaged_and_where_it_lies() {
    let dir = tempfile::tempdir().unwrap();
    let path = cut(dir.path(), OnDamage::Renew);
    let damaged = std::fs::read(&path).unwrap();
    let ended = run(dir.path(), 2);
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(0), "{said}");
    let line = said.lines().find(|line| line.contains("ERROR")).unwrap_or_else(|| panic!("{said}"));
    for part in
        ["damaged beyond mending", "alpha.redb.damaged-1", "epoch=", "truncated", "What it published comes back"]
    {
        assert!(line.contains(part), "no {part:?} in {line}");
    }
    assert_eq!(std::fs::read(dir.path().join("alpha.redb.damaged-1")).unwrap(), damaged);
    let again = run(dir.path(), 1);
    assert!(!String::from_utf8_lossy(&again.stderr).contains("ERROR"), "it is over");
}

#[test]
fn an_agent_that_is_to_stop_ends_with_one_clear_error_and_changes_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = cut(dir.path(), OnDamage::Stop);
    let damaged = std::fs::read(&path).unwrap();
    let ended = run(dir.path(), 0);
    let said = String::from_utf8_lossy(&ended.stderr).into_owned();
    assert_eq!(ended.status.code(), Some(1), "{said}");
    assert!(said.contains("is damaged beyond mending") && said.contains("on_damage = \"renew\""), "{said}");
    assert_eq!(said.lines().count(), 1, "{said}");
    assert_eq!(std::fs::read(&path).unwrap(), damaged);
    assert!(!dir.path().join("alpha.redb.damaged-1").exists());
}

#[test]
fn the_service_does_not_try_for_ever() {
    let unit = include_str!("../dist/merganser.service");
    let number = |key: &str| -> f64 {
        let line = unit.lines().find_map(|line| line.strip_prefix(key)).unwrap_or_else(|| panic!("no {key}"));
        line.trim_start_matches('=').parse().unwrap()
    };
    let (starts, within, pause) = (number("StartLimitBurst"), number("StartLimitIntervalSec"), number("RestartSec"));
    assert!(starts * (pause + 5.0) < within, "an agent that ends within 5 s reaches the limit");
}

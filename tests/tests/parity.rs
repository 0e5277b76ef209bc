//! Real cores on real Zenoh: two robots come to the same set of facts, a restart goes on from disk where it ended, and
//! the journal of a live run, replayed into a core alone, gives the same digest and the same estimate.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "../../agent/tests/common/mod.rs"]
mod common;

use common::{keyframe, start, swarm, until};
use merganser::commands::replay::replay;
use merganser::host::Host;
use merganser::journal::{Frame, Reader, StoredInput};
use merganser::store;
use merganser_protocol::agent::Agent;
use merganser_protocol::agent::io::{Command, Input};
use merganser_protocol::snapshot::StatusView;
use merganser_protocol::time::Instant;
use std::io::Write;

async fn status(host: &Host) -> StatusView {
    host.snapshots().take().await.unwrap().status
}

async fn walk(host: &Host, robot: u64, keyframes: std::ops::Range<u64>) {
    for index in keyframes {
        assert!(host.inbox().feed(Input::Keyframe(keyframe(robot, index))).await);
    }
    assert!(host.inbox().feed(Input::Command(Command::Flush)).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn two_robots_come_to_the_same_facts_and_their_journals_replay_to_the_same_digest() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha", "beta"]);
    let journals = [dir.path().join("alpha.journal"), dir.path().join("beta.journal")];
    let alpha = start(&configs[0], Some(&journals[0])).await;
    let beta = start(&configs[1], Some(&journals[1])).await;
    tokio::join!(walk(&alpha, 0, 0..12), walk(&beta, 1, 0..12));
    until("the same facts of both", async || {
        let (a, b) = (status(&alpha).await, status(&beta).await);
        a.digest == b.digest && a.submaps >= 2 && b.submaps >= 2 && a.entries >= 4 && a.idle && b.idle
    })
    .await;
    let digest = status(&alpha).await.digest;
    let shown = [alpha.snapshots().take().await.unwrap(), beta.snapshots().take().await.unwrap()];
    let finished = [alpha.stop().await.unwrap(), beta.stop().await.unwrap()];
    assert_eq!(finished[0].digest.to_string(), digest);

    for (((journal, config), live), shown) in journals.iter().zip(&configs).zip(finished).zip(shown) {
        let again = replay(journal, &config.identity().unwrap()).unwrap();
        assert_eq!(again.finished, live);
        let replayed = again.agent.snapshot(again.now);
        assert_eq!((replayed.frames, replayed.map, replayed.graph), (shown.frames, shown.map, shown.graph));
        assert_eq!(again.recorded, Some(live.digest));
        let once_more = replay(journal, &config.identity().unwrap()).unwrap();
        assert_eq!(once_more.agent.snapshot(once_more.now), again.agent.snapshot(again.now));
    }
    // The comparison bites: without one of its keyframes the run comes to something else.
    let (start, mut frames) = Reader::open(&journals[0]).unwrap();
    let cut = dir.path().join("cut.journal");
    let mut writer = merganser::journal::Writer::create(&cut, start).unwrap();
    let mut left_out = false;
    while let Some(frame) = frames.next_frame().unwrap() {
        match frame {
            Frame::Input(_, input) if !left_out && matches!(*input, StoredInput::Keyframe(_)) => left_out = true,
            frame => writer.write(&frame).unwrap(),
        }
    }
    drop(writer);
    // Either a job is missing that the live run had done, or the digest differs.
    let noticed = replay(&cut, &configs[0].identity().unwrap())
        .map_or(true, |again| Some(again.finished.digest) != again.recorded);
    assert!(left_out && noticed);
    assert!(replay(&journals[0], &configs[1].identity().unwrap()).is_err(), "beta's key, alpha's journal");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_restart_goes_on_with_the_same_log() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha"]);
    let alpha = start(&configs[0], None).await;
    walk(&alpha, 0, 0..6).await;
    until("a fact", async || status(&alpha).await.entries >= 1 && status(&alpha).await.idle).await;
    let before = status(&alpha).await;
    let ended = alpha.stop().await.unwrap();

    // What lies on the disk is enough for a core without any shell.
    let restored = store::open(&configs[0]).unwrap().restored;
    let identity = configs[0].identity().unwrap();
    let core = Agent::new(configs[0].core.clone(), identity, 1, restored, Instant::ZERO).unwrap();
    assert_eq!((core.digest(), core.status().entries), (ended.digest, before.entries));

    let journal = dir.path().join("second.journal");
    let alpha = start(&configs[0], Some(&journal)).await;
    let after = status(&alpha).await;
    assert_eq!((after.digest, after.entries, after.epoch), (ended.digest.to_string(), before.entries, before.epoch));
    walk(&alpha, 0, 6..12).await;
    until("another fact", async || status(&alpha).await.entries > before.entries).await;
    let ended = alpha.stop().await.unwrap();
    let again = replay(&journal, &configs[0].identity().unwrap()).unwrap();
    assert_eq!(again.finished, ended, "a journal holds what the store held at its start");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_journal_that_a_crash_cut_short_replays_as_far_as_it_goes() {
    let dir = tempfile::tempdir().unwrap();
    let configs = swarm(dir.path(), &["alpha"]);
    let journal = dir.path().join("alpha.journal");
    let alpha = start(&configs[0], Some(&journal)).await;
    walk(&alpha, 0, 0..3).await;
    until("the keyframes", async || status(&alpha).await.keyframes == 3).await;
    alpha.stop().await.unwrap();
    let whole = std::fs::read(&journal).unwrap();
    let identity = configs[0].identity().unwrap();
    for length in [whole.len() - 1, whole.len() / 2, whole.len() / 3] {
        std::fs::write(&journal, &whole[..length]).unwrap();
        let again = replay(&journal, &identity).unwrap();
        assert_eq!(again.recorded, None);
    }
    std::fs::write(&journal, &whole[..10]).unwrap();
    assert!(replay(&journal, &identity).is_err());
    std::fs::write(&journal, &whole).unwrap();
    let mut file = std::fs::OpenOptions::new().append(true).open(&journal).unwrap();
    file.write_all(&[0xff; 64]).unwrap(); // claims 4 GiB
    let told = replay(&journal, &identity).err().unwrap();
    assert!(format!("{told:#}").contains("claims"), "{told:#}");
}

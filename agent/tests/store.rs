//! The store's thread: batches share commits and are told in order; a disk that refuses is told once, tried again, and
//! when it takes them everything is there.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use merganser::store::Writer;
use merganser_protocol::agent::io::{Input, Record};
use merganser_protocol::ids::{EntryId, FrameId, Name, RobotId};
use merganser_store::simulated::Disk;
use merganser_store::{Medium, Owner, Store};
use std::sync::mpsc::{self, Receiver};
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(60);

fn entry(seq: u32, bytes: &[u8]) -> Record {
    Record::Entry { id: EntryId { frame: FrameId { robot: RobotId([3; 8]), epoch: 9 }, seq }, bytes: bytes.to_vec() }
}

fn open(medium: impl Medium + 'static) -> (Store, Vec<Record>) {
    let name = |text| Name::new(text).unwrap();
    let owner = Owner { swarm: name("demo"), robot: name("alpha"), id: RobotId([3; 8]) };
    let opened = Store::open(medium, owner, 1).unwrap();
    (opened.store, opened.restored.records)
}

fn writer(disk: &Disk, wait: Duration) -> (Writer, Receiver<Input>) {
    let (sender, told) = mpsc::channel();
    (Writer::spawn(open(disk.clone()).0, wait, move |input| sender.send(input).unwrap()).unwrap(), told)
}

#[test]
fn batches_share_commits_and_are_told_in_order() {
    let disk = Disk::default();
    let (writer, told) = writer(&disk, Duration::from_millis(20));
    for number in 1..=200 {
        writer.persist(number, vec![entry(number as u32, b"x")]);
    }
    drop(writer); // waits for the disk
    let up_to: Vec<u64> = told
        .iter()
        .map(|input| match input {
            Input::Persisted { up_to } => up_to,
            other => panic!("{other:?}"),
        })
        .collect();
    assert!(up_to.is_sorted() && up_to.last() == Some(&200), "{up_to:?}");
    assert!(up_to.len() < 100, "{} commits for 200 batches", up_to.len());
    disk.cut(1);
    assert_eq!(open(disk).1.len(), 200);
}

#[test]
fn a_full_disk_is_told_once_and_heals_without_loss() {
    let disk = Disk::default();
    let (writer, told) = writer(&disk, Duration::ZERO);
    writer.persist(1, vec![entry(0, b"before")]);
    assert!(matches!(told.recv_timeout(PATIENCE).unwrap(), Input::Persisted { up_to: 1 }));
    disk.with_faults(|faults| faults.full = true);
    writer.persist(2, vec![entry(1, &[1; 1000])]);
    let failed = told.recv_timeout(PATIENCE).unwrap();
    assert!(matches!(&failed, Input::PersistFailed { batch: 2, reason } if reason.contains("full")), "{failed:?}");
    writer.persist(3, vec![entry(2, b"while it is full")]);
    while disk.with_faults(|faults| faults.refused_full) < 3 {
        std::thread::sleep(Duration::from_millis(10)); // it tries again by itself
    }
    assert!(told.try_recv().is_err(), "told once");
    disk.with_faults(|faults| faults.full = false);
    let mut up_to = 0;
    while up_to < 3 {
        match told.recv_timeout(PATIENCE).unwrap() {
            Input::Persisted { up_to: to } => up_to = to,
            other => panic!("{other:?}"),
        }
    }
    drop(writer);
    disk.cut(2);
    assert_eq!(open(disk).1, [entry(0, b"before"), entry(1, &[1; 1000]), entry(2, b"while it is full")]);
}

#[test]
fn an_end_does_not_wait_for_a_disk_that_refuses() {
    let disk = Disk::default();
    let (writer, told) = writer(&disk, Duration::ZERO);
    disk.with_faults(|faults| faults.full = true);
    writer.persist(1, vec![entry(0, b"never")]);
    assert!(matches!(told.recv_timeout(PATIENCE).unwrap(), Input::PersistFailed { batch: 1, .. }));
    drop(writer);
    assert!(told.recv().is_err(), "nothing was reported durable");
    disk.with_faults(|faults| faults.full = false);
    assert!(open(disk).1.is_empty());
}

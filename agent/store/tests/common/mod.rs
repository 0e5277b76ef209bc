//! What the store's tests share.
#![allow(dead_code, reason = "each test file uses its part")]

use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId};
use merganser_protocol::wire::{Entry, EntryContent, SwarmTag};
use merganser_store::simulated::Disk;
use merganser_store::{FileMedium, Opened, Owner, Store, StoreError};
use std::path::Path;

pub const ROBOT: RobotId = RobotId([3; 8]);

pub fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

pub fn owner() -> Owner {
    Owner { swarm: name("demo"), robot: name("alpha"), id: ROBOT }
}

pub fn entry(seq: u32, bytes: &[u8]) -> Record {
    Record::Entry { id: EntryId { frame: FrameId { robot: ROBOT, epoch: 9 }, seq }, bytes: bytes.to_vec() }
}

/// A real entry, for what decodes it.
pub fn signed(seq: u32) -> (EntryId, Vec<u8>) {
    let key = ed25519_dalek::SigningKey::from_bytes(&[7; 32]);
    let robot = RobotId::of_key(key.verifying_key().as_bytes());
    let id = EntryId { frame: FrameId { robot, epoch: 9 }, seq };
    let (swarm, previous) = (SwarmTag::of(&name("demo")), Hash::default());
    let content = EntryContent { swarm, id, kind: 99, floor: 0, previous, payload: vec![1; 40] };
    (id, Entry::sign(&key, content).unwrap().encode())
}

pub fn open(path: &Path, fresh_epoch: u32) -> Result<Opened, StoreError> {
    Store::open(FileMedium::new(path), owner(), fresh_epoch)
}

pub fn on(disk: &Disk) -> Opened {
    Store::open(disk.clone(), owner(), 1).unwrap()
}

pub fn sorted(records: Vec<Record>) -> Vec<String> {
    let mut text: Vec<String> = records.iter().map(|record| format!("{record:?}")).collect();
    text.sort();
    text
}

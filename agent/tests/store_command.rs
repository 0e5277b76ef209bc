//! `merganser store`: what is sound, what is not and why, on stores that were written as agents write them.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use ed25519_dalek::SigningKey;
use merganser::config::{FileConfig, Security};
use merganser::store;
use merganser::trust::SecretKey;
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId};
use merganser_protocol::wire::{Entry, EntryContent, SwarmTag};
use std::path::Path;
use std::process::{Command, Output};

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// `len` entries of the robot with this key, chained.
fn log(key: u8, epoch: u32, len: u32, swarm: &str) -> Vec<Record> {
    let key = SigningKey::from_bytes(&[key; 32]);
    let frame = FrameId { robot: RobotId::of_key(key.verifying_key().as_bytes()), epoch };
    let mut previous = Hash::default();
    let entry = |seq| {
        let (id, swarm) = (EntryId { frame, seq }, SwarmTag::of(&name(swarm)));
        let content = EntryContent { swarm, id, kind: 99, floor: 0, previous, payload: vec![seq as u8; 50] };
        let entry = Entry::sign(&key, content).unwrap();
        previous = entry.hash();
        Record::Entry { id, bytes: entry.encode() }
    };
    (0..len).map(entry).collect()
}

/// A configuration `a.toml` of alpha, whose store holds these records.
fn write(folder: &Path, records: &[Record]) -> FileConfig {
    let key = |k: u8| SecretKey::from_bytes([k; 32]).public();
    let roster = [(name("alpha"), key(1)), (name("beta"), key(2))].into();
    let mut plain = FileConfig::new(name("test"), name("alpha"), "alpha.key".into(), roster);
    plain.zenoh.security = Some(Security::None);
    plain.zenoh.listen = vec!["tcp/127.0.0.1:0".into()];
    plain.save(&folder.join("a.toml")).unwrap();
    let config = FileConfig::load(&folder.join("a.toml")).unwrap();
    store::open(&config).unwrap().store.commit(records.iter()).unwrap();
    config
}

fn merganser(folder: &Path, arguments: &[&str]) -> (Option<i32>, String, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_merganser"));
    let Output { status, stdout, stderr } = command.args(arguments).current_dir(folder).output().unwrap();
    (status.code(), String::from_utf8(stdout).unwrap(), String::from_utf8(stderr).unwrap())
}

#[test]
fn a_sound_store_is_verified_counted_and_exported() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), &[log(1, 7, 3, "test"), log(2, 8, 4, "test")].concat());
    let (code, said, _) = merganser(dir.path(), &["store", "verify", "-c", "a.toml"]);
    assert_eq!(code, Some(0), "{said}");
    assert!(said.ends_with("7 entries, 0 blobs, 0 private records, 0 forks: sound\n"), "{said}");
    let (code, said, _) = merganser(dir.path(), &["store", "stats", "-c", "a.toml"]);
    assert_eq!(code, Some(0));
    for part in ["schema 4, of test/alpha", "0 damaged", "alpha/7 ", "beta/8 ", "2 logs"] {
        assert!(said.contains(part), "no {part:?} in {said}");
    }
    let (code, said, _) = merganser(dir.path(), &["store", "export", "-c", "a.toml", "--out", "facts.jsonl"]);
    assert_eq!((code, said.starts_with("7 entries")), (Some(0), true), "{said}");
    let lines = std::fs::read_to_string(dir.path().join("facts.jsonl")).unwrap();
    let ids: Vec<_> =
        lines.lines().map(|l| serde_json::from_str::<serde_json::Value>(l).unwrap()["id"].clone()).collect();
    assert_eq!(ids.len(), 7);
    assert!(ids.iter().all(serde_json::Value::is_string), "{ids:?}");

    let again = ["store", "export", "-c", "a.toml", "--out", "facts.raw", "--format", "raw"];
    assert_eq!(merganser(dir.path(), &again).0, Some(0));
    let (code, _, said) = merganser(dir.path(), &again);
    assert_eq!((code, said.contains("facts.raw")), (Some(1), true), "nothing is overwritten: {said}");
    let mut raw = &std::fs::read(dir.path().join("facts.raw")).unwrap()[..];
    let mut entries = 0;
    while let Some((length, rest)) = raw.split_first_chunk() {
        let (bytes, rest) = rest.split_at(u32::from_le_bytes(*length) as usize);
        assert!(Entry::decode(bytes).is_ok());
        (raw, entries) = (rest, entries + 1);
    }
    assert_eq!(entries, 7);
}

#[test]
fn what_is_wrong_is_listed_one_by_one() {
    let dir = tempfile::tempdir().unwrap();
    let mut records = log(1, 7, 3, "test");
    records.extend(log(2, 8, 6, "test").into_iter().filter(|r| !matches!(r, Record::Entry { id, .. } if id.seq == 2)));
    records.extend(log(3, 9, 1, "test")); // not in the roster
    records.extend(log(2, 10, 1, "other"));
    let Some(Record::Entry { bytes, .. }) = records.get_mut(2) else { panic!() };
    *bytes.last_mut().unwrap() ^= 1;
    records.push(Record::Blob { hash: Hash::of(b"x"), bytes: b"x".to_vec() });
    write(dir.path(), &records);
    let (code, said, _) = merganser(dir.path(), &["store", "verify", "-c", "a.toml"]);
    assert_eq!(code, Some(1), "{said}");
    for part in [
        "7:2: entry is not signed by its origin",
        "its origin is not in the roster",
        "8:3: an entry before it is missing or damaged",
        "8:5: an entry before it is missing",
        "belongs to another swarm",
        "blobs: ",
    ] {
        assert!(said.contains(part), "no {part:?} in {said}");
    }
    assert!(said.lines().last().unwrap().ends_with("wrong"), "{said}");
}

#[test]
fn flipped_bits_are_listed_and_nothing_is_changed_by_looking() {
    let dir = tempfile::tempdir().unwrap();
    let config = write(dir.path(), &log(2, 8, 6, "test"));
    let mut bytes = std::fs::read(&config.store.path).unwrap();
    let at = bytes.windows(50).position(|window| window == [3; 50]).unwrap();
    bytes[at] ^= 64;
    std::fs::write(&config.store.path, &bytes).unwrap();
    for command in ["verify", "verify"] {
        let (code, said, _) = merganser(dir.path(), &["store", command, "-c", "a.toml"]);
        assert_eq!(code, Some(1));
        assert!(said.contains("8:3: its bytes have changed") && said.contains("8:4: an entry before"), "{said}");
    }
    let (_, said, _) = merganser(dir.path(), &["store", "stats", "-c", "a.toml"]);
    assert!(said.contains(" damaged") && !said.contains(" 0 damaged"), "{said}");
    assert_eq!(
        merganser(dir.path(), &["store", "export", "-c", "a.toml", "--out", "x"]).0,
        Some(1),
        "a part is missing"
    );
}

#[test]
fn stores_that_cannot_be_looked_at_say_why() {
    let dir = tempfile::tempdir().unwrap();
    let config = write(dir.path(), &[]);
    let refused = |wanted: &str| {
        let (code, _, said) = merganser(dir.path(), &["store", "verify", "-c", "a.toml"]);
        assert!(code == Some(1) && said.contains(wanted) && said.lines().count() == 1, "{code:?} {said}");
    };
    let running = store::open(&config).unwrap();
    refused("another agent uses it");
    drop(running);
    std::fs::rename(&config.store.path, dir.path().join("away")).unwrap();
    refused("there is none yet");
    assert!(!config.store.path.exists(), "looking makes none");
    std::fs::write(&config.store.path, [1; 5000]).unwrap();
    refused("is no store of facts");
    let (code, _, said) = merganser(dir.path(), &["store", "verify"]);
    assert_eq!(code, Some(2), "{said}");
    assert_eq!(merganser(dir.path(), &["store", "verify", "-c", "none.toml"]).0, Some(2));
    assert_eq!(merganser(dir.path(), &["store", "mend", "-c", "a.toml"]).0, Some(2));
}

//! A robot tells which of its own submaps fit at another place as well, once of each, up to a limit.

use super::common::{Wires, World, config, drive, identity, robot, secret};
use merganser_protocol::agent::io::{Input, Record};
use merganser_protocol::agent::job::NotAligned;
use merganser_protocol::agent::{Agent, LOOKALIKES_MAX, Restored};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name};
use merganser_protocol::time::Instant;
use merganser_protocol::wire::entry::{Entry, EntryContent, SwarmTag};
use merganser_protocol::wire::fact::{Fact, LookalikeFact, RefusalReason};
use std::collections::BTreeSet;
use std::time::Duration;

const FRAME_EPOCH: u32 = 7;

/// What the robot tells of pairs after a drive whose loops all end so, of which it told so many before.
fn told(before: usize, elsewhere: bool) -> Vec<(u32, u32)> {
    let restored = Restored { records: log(before), fresh_epoch: FRAME_EPOCH };
    let mut wires = Wires::new(vec![Agent::new(config(), identity(0), 42, restored, Instant::ZERO).unwrap()]);
    let why = NotAligned { reason: RefusalReason::Ambiguous, elsewhere };
    wires.answers = Box::new(move |job| job.back.is_some().then_some(Err(why)));
    for keyframe in drive(&World::new(1), 0, 60).0 {
        wires.input(0, Input::Keyframe(keyframe));
        wires.run(Duration::from_secs(1));
    }
    let facts = wires.disks[0].iter().filter_map(|record| match record {
        Record::Entry { bytes, .. } => Entry::decode(bytes).unwrap().fact().ok(),
        _ => None,
    });
    let alike =
        facts.filter_map(|fact| if let Fact::Lookalike(LookalikeFact { i, j }) = fact { Some((i, j)) } else { None });
    alike.collect()
}

/// A log that tells of so many pairs of submaps that are not there any more.
fn log(count: usize) -> Vec<Record> {
    let key = ed25519_dalek::SigningKey::from_bytes(&secret(0));
    let (swarm, frame) = (SwarmTag::of(&Name::new("test").unwrap()), FrameId { robot: robot(0), epoch: FRAME_EPOCH });
    let mut previous = Hash::default();
    let entry = |seq: usize| {
        let at = 1000 + 2 * seq as u32;
        let fact = Fact::Lookalike(LookalikeFact { i: at, j: at + 1 });
        let id = EntryId { frame, seq: seq as u32 };
        let content =
            EntryContent { swarm, id, kind: fact.kind(), floor: 0, previous, payload: fact.to_payload().unwrap() };
        let bytes = Entry::sign(&key, content).unwrap().encode();
        previous = Hash::of(&bytes);
        Record::Entry { id, bytes }
    };
    (0..count).map(entry).collect()
}

#[test]
fn what_fits_elsewhere_is_told_once_of_each_submap() {
    let pairs = told(0, true);
    let submaps: BTreeSet<u32> = pairs.iter().flat_map(|&(i, j)| [i, j]).collect();
    assert!(pairs.len() >= 2 && submaps.len() == 2 * pairs.len(), "{pairs:?}");
    assert!(told(0, false).is_empty(), "the same place, turned or slid, is no other");
}

#[test]
fn so_many_are_told_and_no_more() {
    assert_eq!(told(LOOKALIKES_MAX - 1, true).len(), 1);
    assert_eq!(told(LOOKALIKES_MAX, true).len(), 0);
}

//! What a third party says of two robots keeps these from nothing.

use super::common::{Wires, World, config, drive, identity, robot, secret};
use merganser_protocol::agent::io::{Input, Record};
use merganser_protocol::agent::{Agent, Restored};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, SubmapId};
use merganser_protocol::time::Instant;
use merganser_protocol::wire::entry::{Entry, EntryContent, SwarmTag};
use merganser_protocol::wire::fact::{AlignmentFact, Fact};
use std::time::Duration;

const EPOCH: u32 = 7;
/// Submaps of either robot that the liar speaks of.
const SUBMAPS: u32 = 16;

fn frame(k: usize) -> FrameId {
    FrameId { robot: robot(k), epoch: EPOCH }
}

/// The log of robot 2: an alignment of every pair of submaps of the two others.
fn lies() -> Vec<Record> {
    let (a, b) = (frame(0).min(frame(1)), frame(0).max(frame(1)));
    let key = ed25519_dalek::SigningKey::from_bytes(&secret(2));
    let covariance = Covariance::from_sigmas([0.01; 6]).unwrap();
    let t_i_j = Relative::Metric(PoseWithCovariance { pose: Se3::identity(), covariance });
    let mut previous = Hash::default();
    let mut log = Vec::new();
    for (i, j) in (0..SUBMAPS).flat_map(|i| (0..SUBMAPS).map(move |j| (i, j))) {
        let fact = Fact::Alignment(AlignmentFact {
            i: SubmapId { frame: a, index: i },
            j: SubmapId { frame: b, index: j },
            t_i_j,
            sigma: 0.01,
            support: 100,
            log10_nfa: -30.0,
            blobs: [Hash::of(b"i"), Hash::of(b"j")],
        });
        let id = EntryId { frame: frame(2), seq: log.len() as u32 };
        let (swarm, kind) = (SwarmTag::of(&Name::new("test").unwrap()), fact.kind());
        let content = EntryContent { swarm, id, kind, floor: 0, previous, payload: fact.to_payload().unwrap() };
        let bytes = Entry::sign(&key, content).unwrap().encode();
        previous = Hash::of(&bytes);
        log.push(Record::Entry { id, bytes });
    }
    log
}

#[test]
fn a_liar_who_aligns_all_submaps_of_two_others_does_not_keep_them_apart() {
    let world = World::new(1);
    let agent = |k: usize| {
        let records = if k == 2 { lies() } else { Vec::new() };
        let restored = Restored { records, fresh_epoch: EPOCH };
        Agent::new(config(), identity(k), 42, restored, Instant::ZERO).unwrap()
    };
    let mut wires = Wires::new((0..3).map(agent).collect());
    // The lies spread first.
    wires.run(Duration::from_secs(30));
    let runs: Vec<_> = (0..2).map(|k| drive(&world, k, 40).0).collect();
    for n in 0..60 {
        for (k, keyframe) in runs.iter().enumerate().filter_map(|(k, keyframes)| Some((k, keyframes.get(n)?))) {
            wires.input(k, Input::Keyframe(keyframe.clone()));
        }
        wires.run(Duration::from_secs(1));
    }
    let snapshot = wires.agents[0].snapshot(wires.now);
    assert!(snapshot.map.submaps.len() > 4 && snapshot.map.submaps.len() <= 2 * SUBMAPS as usize);
    for k in 0..2 {
        assert_eq!(wires.agents[k].status().merged_with.len(), 1, "robot {k}");
    }
}

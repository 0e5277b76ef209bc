//! Somebody without a key answers first, in everyone's name: with nonsense, with nothing, with what looks right and is
//! not. It costs useless answers, and changes nothing else; nobody is blamed for what nobody signed.

use super::common::{Wires, World, agent, agent_of, config, drive};
use merganser_protocol::agent::Restored;
use merganser_protocol::agent::io::{Input, QueryKind};
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::time::Instant;
use merganser_protocol::wire::limits::{BLOB_LEN_MAX, BLOB_PIECE_LEN};
use merganser_protocol::wire::messages::{AlignStatus, Delta, Message};
use std::time::Duration;

/// What an outsider can say to a question, whatever the true answer is.
fn lies(kind: QueryKind, question: &[u8]) -> Vec<Vec<u8>> {
    let mut lies = vec![b"nonsense".to_vec(), Vec::new(), Message::AlignReply { status: AlignStatus::Done }.encode()];
    match (kind, Message::decode(question)) {
        (QueryKind::Sync, _) => {
            lies.push(Message::SyncReply(Delta { more: true, ..Delta::default() }).encode());
            lies.push(Message::SyncReply(Delta::default()).encode());
        }
        (QueryKind::Blob, Ok(Message::BlobRequest { hash, offset, .. })) => {
            for (total, len) in [(0, 0), (BLOB_LEN_MAX, 0), (6_000, 6_000), (BLOB_LEN_MAX, BLOB_PIECE_LEN)] {
                let (total, bytes) = (total as u32, vec![7; len.min(total.saturating_sub(offset as usize))]);
                lies.push(Message::BlobReply { hash, offset, total, bytes, proof: vec![[7; 32]; 2] }.encode());
            }
        }
        _ => {}
    }
    lies
}

/// Robot 0 comes back with what it drove yesterday; robot 1 drives there today. When their facts were equal first, when
/// they were merged, and what was refused, by whom it was signed.
fn tomorrow(lies: impl Fn(QueryKind, &[u8]) -> Vec<Vec<u8>> + 'static) -> (Instant, Instant, Vec<String>) {
    let world = World::new(1);
    let mut yesterday = Wires::new(vec![agent_of(0, &config())]);
    for keyframe in drive(&world, 0, 40).0 {
        yesterday.input(0, Input::Keyframe(keyframe));
    }
    let records = yesterday.disks.remove(0);
    let mut wires = Wires::new(vec![agent(0, Restored { records, fresh_epoch: 3 }), agent(1, Restored::default())]);
    wires.forged = Box::new(move |_, kind, question| lies(kind, question));
    let mut keyframes = drive(&world, 1, 40).0.into_iter();
    let (mut equal, mut merged) = (None, None);
    for _ in 0..200 {
        wires.run(Duration::from_secs(1));
        let is_equal = wires.agents[0].digest() == wires.agents[1].digest();
        equal = equal.or(is_equal.then_some(wires.now));
        let pairs = wires.agents[1].snapshot(wires.now).frames.pairs;
        let is_merged = pairs.iter().any(|pair| pair.status == PairStatus::Merged);
        merged = merged.or(is_merged.then_some(wires.now));
        if let (Some(_), Some(keyframe)) = (equal, keyframes.next()) {
            wires.input(1, Input::Keyframe(keyframe));
        }
    }
    let blamed = (0..2).flat_map(|k| wires.agents[k].snapshot(wires.now).stats.rejected_by_peer.into_keys());
    (equal.unwrap(), merged.unwrap(), blamed.collect())
}

#[test]
fn who_answers_first_and_falsely_changes_nothing() {
    let quiet = tomorrow(|_, _| Vec::new());
    let (equal, merged, blamed) = tomorrow(lies);
    assert_eq!(quiet.2, Vec::<String>::new());
    assert_eq!(blamed, ["unknown", "unknown"], "nobody signed any of it");
    assert_eq!((equal, merged), (quiet.0, quiet.1), "and nothing takes longer");
}

//! What a frame claims is checked before it is believed: lengths, kinds, versions, limits on both sides.

use super::fact::*;
use super::frame::{FrameKind, WireError};
use super::limits::*;
use super::messages::AlignStatus;
use super::tests::{entry, framed, varint};
use super::*;
use crate::ids::Hash;

#[test]
fn claims_of_a_gigabyte_are_refused() {
    let huge = varint(1 << 30);
    let hash = [0; 32];
    for (kind, parts) in [
        (FrameKind::Facts, vec![&huge[..]]),
        (FrameKind::Facts, vec![&[1], &huge]),
        (FrameKind::SyncRequest, vec![&[0, 0], &huge]),
        (FrameKind::SyncReply, vec![&huge]),
        (FrameKind::SyncReply, vec![&[0], &huge]),
        (FrameKind::SyncReply, vec![&[0, 1], &huge]),
        (FrameKind::BlobReply, vec![&hash, &[0, 0], &huge]),
        (FrameKind::BlobSlice, vec![&hash, &[0, 0, 0], &huge]),
    ] {
        let error = Message::decode(&framed(kind, &parts)).unwrap_err();
        assert_eq!(error.reason(), "malformed", "{kind:?}: {error}");
    }
    // The same inside an entry and inside a payload.
    let (mut bytes, payload_len) = (entry().encode(), entry().payload().len());
    let at = bytes.len() - 64 - payload_len - varint(payload_len as u64).len();
    bytes.splice(at..at + varint(payload_len as u64).len(), huge.clone());
    assert_eq!(Entry::decode(&bytes).unwrap_err().reason(), "entry_malformed");
    let mut payload = entry().payload().to_vec();
    payload.splice(payload.len() - 121.., huge);
    assert_eq!(Fact::from_payload(payload::KIND_SUBMAP, &payload).unwrap_err().reason(), "fact_malformed");
}

#[test]
fn the_frame_is_checked_before_its_body() {
    let good = Message::AlignReply { status: AlignStatus::Busy }.encode();
    assert!(Message::decode(&good).is_ok());
    let with = |at: usize, value: u8| {
        let mut bytes = good.clone();
        bytes[at] = value;
        Message::decode(&bytes).unwrap_err()
    };
    assert_eq!(Message::decode(b"mg"), Err(WireError::TooShort { len: 2 }));
    assert_eq!(with(0, b'x'), WireError::Magic { got: *b"xg" });
    for got in [0, 2, 255] {
        assert_eq!(with(2, got), WireError::Version { got });
        assert_eq!(with(3, got | 128), WireError::Kind { got: got | 128 });
    }
    assert_eq!(with(4, 5).reason(), "malformed", "an unknown status");
}

#[test]
fn every_kind_has_a_limit_that_is_checked_on_both_sides() {
    for kind in FrameKind::ALL {
        let len = kind.len_max();
        let error = |len: usize| Message::decode(&framed(kind, &[&vec![0; len - HEADER_LEN]])).unwrap_err();
        assert_ne!(error(len).reason(), "too_long");
        assert_eq!(error(len + 1), WireError::TooLong { kind, len: len + 1, max: len });
    }
    let blob = |len: usize, total: u32| {
        let (hash, bytes) = (Hash::default(), vec![7; len]);
        Message::decode(&Message::BlobReply { hash, offset: 0, total, bytes, proof: vec![] }.encode())
    };
    let proved = |values: usize| {
        let proof = vec![[7; 32]; values];
        Message::decode(
            &Message::BlobReply { hash: Hash::default(), offset: 0, total: 9, bytes: vec![], proof }.encode(),
        )
    };
    assert!(proved(PROOF_MAX).is_ok() && proved(PROOF_MAX + 1).is_err());
    assert!(blob(BLOB_LEN_MAX, BLOB_LEN_MAX as u32).is_ok());
    assert!(blob(BLOB_LEN_MAX + 1, BLOB_LEN_MAX as u32 + 1).is_err());
    assert!(blob(0, BLOB_LEN_MAX as u32 + 1).is_err());
    assert!(blob(2, 1).is_err(), "a piece beyond its blob");
    let facts = |n: usize| Message::decode(&Message::Facts(vec![EntryBytes(vec![7; 10]); n]).encode());
    assert!(facts(ENTRIES_PER_DELTA_MAX).is_ok());
    assert!(facts(ENTRIES_PER_DELTA_MAX + 1).is_err());
    let one = |len: usize| Message::decode(&Message::Facts(vec![EntryBytes(vec![7; len])]).encode());
    assert!(one(ENTRY_LEN_MAX).is_ok());
    assert!(one(ENTRY_LEN_MAX + 1).is_err());
    let heads = |n: u32| {
        let head = |epoch| (0, epoch, Head::Log { len: 1, tag: None });
        let have = HaveVector { heads: (0..n).map(head).collect(), ..samples::have(|_| None) };
        Message::decode(&Message::SyncRequest(have).encode())
    };
    assert!(heads(HEADS_MAX as u32).is_ok());
    assert!(heads(HEADS_MAX as u32 + 1).is_err());
    let listed = |n: u16| {
        let robot = |k: u16| crate::ids::RobotId((u64::from(k)).to_be_bytes());
        let members = Members::Listed((0..n).map(robot).collect());
        let have = HaveVector { members, asker: 0, heads: Vec::new(), ..samples::have(|_| None) };
        Message::decode(&Message::SyncRequest(have).encode())
    };
    assert!(listed(MEMBERS_MAX as u16).is_ok());
    assert!(listed(MEMBERS_MAX as u16 + 1).is_err());
}

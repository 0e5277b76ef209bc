//! Hostile bytes: every truncation, every flipped bit, false lengths, other encodings of the same content.

use super::fact::*;
use super::frame::{FrameKind, MAGIC, VERSION, WireError};
use super::limits::*;
use super::samples::{self, entry_of, key};
use super::*;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance, So3};
use crate::ids::Hash;
use crate::time::Stamp;
use core::num::NonZero;
use nalgebra::{SMatrix, Vector3};
use proptest::prelude::*;

pub(super) fn entry() -> Entry {
    entry_of(0, 3, &samples::facts()[0].1)
}

/// A LEB128 varint.
pub(super) fn varint(mut value: u64) -> Vec<u8> {
    let mut out = Vec::new();
    while value >= 128 {
        out.push(value as u8 | 128);
        value >>= 7;
    }
    out.push(value as u8);
    out
}

pub(super) fn framed(kind: FrameKind, parts: &[&[u8]]) -> Vec<u8> {
    let mut bytes = vec![MAGIC[0], MAGIC[1], VERSION, kind as u8];
    parts.iter().for_each(|part| bytes.extend_from_slice(part));
    bytes
}

#[test]
fn messages_are_refused_when_cut_or_continued_at_any_byte() {
    for (name, message) in samples::messages() {
        let bytes = message.encode();
        for len in 0..bytes.len() {
            assert!(Message::decode(&bytes[..len]).is_err(), "{name} cut to {len}");
        }
        let mut longer = bytes.clone();
        longer.push(0);
        assert!(Message::decode(&longer).is_err(), "{name} continued");
    }
}

#[test]
fn entries_are_refused_when_cut_or_continued_at_any_byte() {
    let key = key(0).verifying_key();
    let sound = |bytes: &[u8]| Entry::decode(bytes).is_ok_and(|entry| entry.verify(&key).is_ok());
    for (_, fact) in samples::facts() {
        let mut bytes = entry_of(0, 3, &fact).encode();
        assert!(sound(&bytes));
        for len in 0..bytes.len() {
            assert!(!sound(&bytes[..len]), "cut to {len}");
        }
        bytes.push(0);
        assert!(!sound(&bytes));
    }
}

#[test]
fn every_flipped_bit_of_an_entry_or_beacon_is_noticed() {
    let public = key(0).verifying_key();
    let bytes = entry().encode();
    for bit in 0..8 * bytes.len() {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        assert!(!Entry::decode(&flipped).is_ok_and(|entry| entry.verify(&public).is_ok()), "bit {bit}");
    }
    let bytes = Message::Pose(samples::beacon()).encode();
    for bit in 0..8 * bytes.len() {
        let mut flipped = bytes.clone();
        flipped[bit / 8] ^= 1 << (bit % 8);
        if let Ok(Message::Pose(beacon)) = Message::decode(&flipped) {
            assert!(!beacon.verify(&public, SwarmTag::of(&samples::swarm())), "bit {bit}");
        }
    }
}

#[test]
fn the_largest_contents_fit_their_frames() {
    let far = crate::ids::FrameId { robot: crate::ids::RobotId([255; 8]), epoch: u32::MAX };
    // Epochs that jump up and down make the longest steps.
    let robot = |k: usize| crate::ids::RobotId((u64::MAX - (MEMBERS_MAX - k) as u64).to_be_bytes());
    let head = |k: usize| {
        (k as u16, if k.is_multiple_of(2) { u32::MAX } else { 0 }, Head::Log { len: u32::MAX, tag: Some([255; 4]) })
    };
    let have = HaveVector {
        members: Members::Listed((0..MEMBERS_MAX).map(robot).collect()),
        asker: HEADS_MAX as u16,
        named: true,
        after: Some(far),
        until: Some(far),
        heads: (0..HEADS_MAX).map(head).collect(),
    };
    let bytes = Message::SyncRequest(have).encode();
    assert!(Message::decode(&bytes).is_ok(), "{} bytes", bytes.len());
    let root = HaveRoot { root: [255; 8], count: u64::MAX };
    assert!(Message::decode(&Message::Have(root).encode()).is_ok());
    let content = BeaconContent {
        anchor: crate::ids::SubmapId {
            frame: crate::ids::FrameId { epoch: u32::MAX, ..samples::frame(0, 0) },
            index: u32::MAX,
        },
        stamp: Stamp(i64::MIN),
        counter: u64::MAX,
        t_anchor_body: samples::estimate(),
    };
    let beacon = Beacon::sign(&key(0), SwarmTag::of(&samples::swarm()), &content).unwrap();
    let bytes = Message::Pose(beacon).encode();
    assert!(bytes.len() <= BEACON_LEN_MAX, "{} bytes", bytes.len());
    assert!(Message::decode(&bytes).is_ok());
    let content = |len: usize| EntryContent {
        swarm: SwarmTag::of(&samples::swarm()),
        id: crate::ids::EntryId { frame: crate::ids::FrameId { epoch: u32::MAX, ..far }, seq: u32::MAX },
        kind: 255,
        floor: u32::MAX,
        previous: Hash([255; 32]),
        payload: vec![0; len],
    };
    let bytes = Entry::sign(&key(0), content(PAYLOAD_LEN_MAX)).unwrap().encode();
    assert!(bytes.len() <= ENTRY_LEN_MAX && Entry::decode(&bytes).is_ok());
    assert!(Entry::sign(&key(0), content(PAYLOAD_LEN_MAX + 1)).is_err());
}

#[test]
fn other_encodings_of_the_same_content_are_refused() {
    // count = 360 as a three-byte varint.
    let mut bytes = samples::messages().into_iter().find(|(name, _)| *name == "have").unwrap().1.encode();
    assert_eq!(bytes.pop(), Some(2));
    bytes.extend([2 | 128, 0]);
    assert_eq!(Message::decode(&bytes), Err(WireError::NonCanonical { kind: FrameKind::Have }));

    // seq = 3, the byte before the kind and the floor, likewise; even if its origin signs that encoding.
    let bytes = entry().encode();
    let at = 1 + 8 + 8 + varint(203_000_000).len();
    assert_eq!(bytes[at], 3);
    let mut body = bytes[..bytes.len() - 64].to_vec();
    body.splice(at..=at, [3 | 128, 0]);
    body.extend([0; 64]);
    assert_eq!(Entry::decode(&body), Err(EntryError::NonCanonical));

    // A quaternion (0.8, 0, 0, 0.6) stated as if its last component were the largest.
    let Fact::Submap(mut fact) = samples::submap_fact(ScaleKind::Metric) else { unreachable!() };
    fact.odometry.pose.rotation = So3::identity();
    let mut payload = Fact::Submap(fact).to_payload().unwrap();
    let at = 1 + 9 + varint(2_000_000_000).len() + 24;
    assert_eq!(payload[at..at + 4], [3, 0, 0, 0]);
    payload.splice(at + 1..at + 2, varint(2 * (0.8 * f64::from(1 << 27)) as u64));
    assert_eq!(Fact::from_payload(payload::KIND_SUBMAP, &payload), Err(FactError::NonCanonical));
}

#[test]
fn heads_must_rise_and_have_robots_and_all_their_tags() {
    let decode = |change: &dyn Fn(&mut HaveVector)| {
        let mut have = samples::have(|k| Some([k; 4]));
        change(&mut have);
        Message::decode(&Message::SyncRequest(have).encode()).map(|_| ()).map_err(|e| e.reason())
    };
    let listed = |n: u8| Members::Listed((0..n).map(samples::listed).collect());
    let log = |len, tag| Head::Log { len, tag };
    assert_eq!(decode(&|_| {}), Ok(()));
    assert_eq!(decode(&|have| have.heads.reverse()), Err("value"));
    assert_eq!(decode(&|have| have.heads.push(*have.heads.last().unwrap())), Err("value"));
    assert_eq!(decode(&|have| have.heads[1].1 = 0), Err("value"), "falling epoch");
    assert_eq!(decode(&|have| have.members = listed(3)), Err("value"), "place 700 of 3");
    assert_eq!(decode(&|have| have.heads.truncate(3)), Ok(()));
    let short = |have: &mut HaveVector, members| {
        have.heads.truncate(3);
        have.members = members;
    };
    assert_eq!(decode(&|have| short(have, listed(3))), Ok(()));
    assert_eq!(decode(&|have| short(have, listed(2))), Err("value"), "place 2 and asker 2 of 2");
    let fourth = |have: &mut HaveVector| {
        short(have, listed(3));
        have.asker = 3;
    };
    assert_eq!(decode(&fourth), Err("value"), "asker 3 of 3");
    let unsorted = Members::Listed((0..3).rev().map(samples::listed).collect());
    assert_eq!(decode(&|have| short(have, unsorted.clone())), Err("value"));
    assert_eq!(decode(&|have| have.heads[0].2 = log(1, None)), Err("value"), "a tag is missing");
    assert_eq!(decode(&|have| have.heads[0].2 = log(0, Some([0; 4]))), Err("value"), "nothing held, but not named");
    let named = |have: &mut HaveVector| {
        have.named = true;
        have.heads[0].2 = log(0, Some([0; 4]));
    };
    assert_eq!(decode(&named), Ok(()));
}

#[test]
fn foreign_entries_are_named_as_such() {
    let entry = entry();
    assert!(entry.verify(&key(0).verifying_key()).is_ok());
    assert_eq!(entry.verify(&key(1).verifying_key()), Err(EntryError::Signature));
    let mut unsigned = entry.encode();
    let len = unsigned.len();
    unsigned[len - 64..].fill(0);
    let unsigned = Entry::decode(&unsigned).unwrap();
    assert_eq!(unsigned.verify(&key(0).verifying_key()), Err(EntryError::Signature));
    let mut newer = entry.encode();
    newer[0] = 2;
    assert_eq!(Entry::decode(&newer), Err(EntryError::Version(2)));
}

#[test]
fn kinds_of_a_newer_version_are_carried() {
    let content = EntryContent {
        swarm: SwarmTag::of(&samples::swarm()),
        id: crate::ids::EntryId { frame: samples::frame(0, 1), seq: 0 },
        kind: 77,
        floor: 0,
        previous: Hash::default(),
        payload: b"from the future".to_vec(),
    };
    let entry = Entry::sign(&key(0), content).unwrap();
    let back = Entry::decode(&entry.encode()).unwrap();
    assert_eq!(back, entry);
    assert_eq!(back.payload(), b"from the future");
    assert_eq!(back.fact(), Err(FactError::UnknownKind(77)));
}

#[test]
fn facts_with_unacceptable_values_are_refused_both_ways() {
    let Fact::Submap(good) = samples::submap_fact(ScaleKind::Metric) else { unreachable!() };
    let refused = |change: &dyn Fn(&mut SubmapFact)| {
        let mut fact = good.clone();
        change(&mut fact);
        Fact::Submap(fact).to_payload().is_err()
    };
    assert!(!refused(&|_| {}));
    assert!(!refused(&|f| f.summary = vec![0; SUMMARY_LEN_MAX]));
    assert!(refused(&|f| f.summary = vec![0; SUMMARY_LEN_MAX + 1]));
    assert!(!refused(&|f| f.stamps = [Stamp(i64::MIN), Stamp(-1)]));
    assert!(refused(&|f| f.stamps.reverse()));
    assert!(refused(&|f| f.extent[1] = f32::NAN));
    assert!(refused(&|f| f.extent[1] = -1.0));
    assert!(refused(&|f| f.odometry.pose.translation.x = f64::NAN));
    assert!(!refused(&|f| f.odometry.pose.translation.x = TRANSLATION_MAX));
    assert!(refused(&|f| f.odometry.pose.translation.x = 1.001 * TRANSLATION_MAX));

    // The same on the way in: NaN for the first coordinate, which follows index, stamp and duration.
    let mut payload = Fact::Submap(good).to_payload().unwrap();
    let at = 1 + 9 + varint(2_000_000_000).len();
    payload[at..at + 8].copy_from_slice(&f64::NAN.to_le_bytes());
    assert_eq!(Fact::from_payload(payload::KIND_SUBMAP, &payload).unwrap_err().reason(), "fact_estimate");

    let alignment = |change: &dyn Fn(&mut AlignmentFact)| {
        let sample = samples::facts().into_iter().find(|(name, _)| *name == "alignment_similarity").unwrap().1;
        let Fact::Alignment(mut fact) = sample else { unreachable!() };
        change(&mut fact);
        Fact::Alignment(fact).to_payload().is_err()
    };
    assert!(!alignment(&|_| {}));
    assert!(alignment(&|f| f.j = f.i));
    assert!(alignment(&|f| f.sigma = f32::INFINITY));
    assert!(alignment(&|f| f.log10_nfa = f32::NEG_INFINITY));
    for scale in [0.0, -1.0, f64::NAN, 1e7] {
        assert!(alignment(&|f| f.t_i_j = Relative::Similarity(SimWithCovariance {
            sim: Sim3 { scale, ..samples::similarity().sim },
            ..samples::similarity()
        })));
    }
}

#[test]
fn entries_are_batched_within_the_limits() {
    let entries: Vec<Vec<u8>> = (0..3000).map(|k| vec![k as u8; 20 + 9 * (k % 220)]).collect();
    let messages = Message::facts(entries.clone());
    let mut back = Vec::new();
    for message in &messages {
        let Message::Facts(batch) = Message::decode(&message.encode()).unwrap() else { panic!("not facts") };
        back.extend(batch.into_iter().map(|entry| entry.0));
    }
    assert_eq!(back, entries);
    let total: usize = entries.iter().map(Vec::len).sum();
    assert!(messages.len() <= total / (MESSAGE_LEN_MAX - ENTRY_LEN_MAX) + 1);
    assert!(Message::facts([]).is_empty());
    assert!(Message::facts([vec![0; ENTRY_LEN_MAX + 1]]).is_empty());
}

#[test]
fn messages_read_as_json() {
    for (name, message) in samples::messages() {
        let text = serde_json::to_string(&message).unwrap();
        assert!(!text.contains("error"), "{name}: {text}");
    }
    let (_, message) = samples::messages().swap_remove(1);
    let value = serde_json::to_value(&message).unwrap();
    assert_eq!(value["message"], "facts");
    assert_eq!(value["body"][0]["kind"], "submap");
    assert_eq!(value["body"][0]["fact"]["keypoint_count"], 256);
}

fn pose() -> impl Strategy<Value = Se3> {
    let t = proptest::array::uniform3(-1e3..1e3f64);
    (t, proptest::array::uniform4(-1.0..1.0f64))
        .prop_filter_map("no rotation", |(t, q)| Some(Se3::new(So3::from_xyzw(q)?, Vector3::from(t))))
}

fn covariance<const N: usize>() -> impl Strategy<Value = Covariance<N>> {
    (proptest::collection::vec(-1.0..1.0f64, N * N), -4.0..1.0f64).prop_filter_map("singular", |(v, decade)| {
        let b = SMatrix::<f64, N, N>::from_vec(v) * 10f64.powf(decade);
        Covariance::new(b * b.transpose()).ok()
    })
}

fn rigid() -> impl Strategy<Value = PoseWithCovariance> {
    (pose(), covariance()).prop_map(|(pose, covariance)| PoseWithCovariance { pose, covariance })
}

fn relative() -> impl Strategy<Value = Relative> {
    let similarity = (pose(), 0.01..100.0f64, covariance()).prop_map(|(pose, scale, covariance)| SimWithCovariance {
        sim: Sim3::new(pose.rotation, pose.translation, scale),
        covariance,
    });
    prop_oneof![rigid().prop_map(Relative::Metric), similarity.prop_map(Relative::Similarity)]
}

fn fact() -> impl Strategy<Value = Fact> {
    let submap =
        (rigid(), any::<(u32, i64, u32, u16, u16)>(), proptest::collection::vec(any::<u8>(), 0..=SUMMARY_LEN_MAX))
            .prop_map(|(odometry, (index, first, lasting, keypoint_count, keyframes), summary)| {
                let first = first >> 1;
                Fact::Submap(SubmapFact {
                    index,
                    stamps: [Stamp(first), Stamp(first + i64::from(lasting))],
                    odometry,
                    extent: [1.0, 2.0, 3.0],
                    blob: Hash::of(&summary),
                    summary,
                    keypoint_count,
                    scale: ScaleKind::Unknown,
                    keyframes: NonZero::new(keyframes),
                })
            });
    let alignment =
        (relative(), 0.0..10.0f32, any::<u16>(), -300.0..0.0f32).prop_map(|(t_i_j, sigma, support, nfa)| {
            let blobs = [Hash::of(b"i"), Hash::of(b"j")];
            let (i, j) = (samples::submap(0, 7), samples::submap(1, 4));
            Fact::Alignment(AlignmentFact { i, j, t_i_j, sigma, support, log10_nfa: nfa, blobs })
        });
    let verdict = (relative(), 0.0..10.0f32, any::<(u16, u32)>()).prop_map(|(t_i_j, sigma, (support, seq))| {
        let outcome = VerdictOutcome::Measured { t_i_j, sigma, support };
        Fact::Verdict(VerdictFact { alignment: crate::ids::EntryId { frame: samples::frame(2, seq), seq }, outcome })
    });
    let sighting = (rigid(), any::<i64>()).prop_map(|(t_i_j, stamp)| {
        let (i, j) = (samples::submap(0, 7), samples::submap(1, 4));
        Fact::Sighting(SightingFact { stamp: Stamp(stamp), i, j, t_i_j })
    });
    let position = (rigid(), any::<i64>()).prop_map(|(t, stamp)| {
        let (i, j) = (samples::submap(0, 7), samples::submap(1, 4));
        let p_i = t.pose.translation.map(|x| (x as f32).clamp(-1e6, 1e6)).into();
        let p_j = t.covariance.sigmas().fixed_rows::<3>(0).map(|x| x as f32).into();
        let covariance = Covariance::new_or_wider(t.covariance.matrix().fixed_view::<3, 3>(3, 3).into_owned());
        Fact::Position(PositionFact { stamp: Stamp(stamp), i, j, p_i, p_j, covariance })
    });
    let lookalike = (0..u32::MAX).prop_flat_map(|i| (Just(i), i + 1..=u32::MAX));
    let lookalike = lookalike.prop_map(|(i, j)| Fact::Lookalike(LookalikeFact { i, j }));
    let retired = any::<NonZero<u32>>().prop_map(|below| Fact::Retired(RetiredFact { below }));
    prop_oneof![submap, alignment, verdict, sighting, position, lookalike, retired]
}

proptest! {
    #[test]
    fn a_fact_read_once_never_changes_again(fact in fact()) {
        let payload = fact.to_payload().unwrap();
        let read = Fact::from_payload(fact.kind(), &payload).unwrap();
        prop_assert_eq!(read.to_payload().unwrap(), payload, "encode is not the inverse of parse");
        if let (Fact::Submap(a), Fact::Submap(b)) = (&fact, &read) {
            prop_assert_eq!(a.odometry.pose.translation, b.odometry.pose.translation);
            prop_assert!((a.odometry.pose.rotation.inverse() * b.odometry.pose.rotation).angle() < 1e-7);
            prop_assert_eq!((a.index, a.stamps, &a.summary), (b.index, b.stamps, &b.summary));
        }
    }

    #[test]
    fn a_beacon_read_once_never_changes_again(t_anchor_body in rigid(), counter in any::<u64>(), stamp in any::<i64>()) {
        let content = BeaconContent { anchor: samples::submap(0, 9), stamp: Stamp(stamp), counter, t_anchor_body };
        let swarm = SwarmTag::of(&samples::swarm());
        let beacon = Beacon::sign(&key(0), swarm, &content).unwrap();
        let Message::Pose(read) = Message::decode(&Message::Pose(beacon).encode()).unwrap() else { panic!() };
        prop_assert_eq!(read, beacon);
        prop_assert!(read.verify(&key(0).verifying_key(), swarm));
        prop_assert!(!read.verify(&key(1).verifying_key(), swarm));
        prop_assert!(!read.verify(&key(0).verifying_key(), SwarmTag::of(&crate::ids::Name::new("other").unwrap())));
        prop_assert!((read.t_anchor_body.pose.translation - t_anchor_body.pose.translation).norm() < 1e-3);
    }

    #[test]
    fn any_bytes_decode_to_something_that_encodes_to_them_or_not_at_all(
        kind in 0u8..12, body in proptest::collection::vec(any::<u8>(), 0..200)
    ) {
        let bytes = [&[MAGIC[0], MAGIC[1], VERSION, kind][..], &body].concat();
        if let Ok(message) = Message::decode(&bytes) {
            prop_assert_eq!(message.encode(), bytes);
        }
        let _ = Entry::decode(&body);
        let _ = Fact::from_payload(kind, &body);
    }

    #[test]
    fn damaged_messages_decode_canonically_or_not_at_all(which in 0usize..14, at in any::<prop::sample::Index>(), value in any::<u8>()) {
        let samples = samples::messages();
        let mut bytes = samples[which % samples.len()].1.encode();
        let at = at.index(bytes.len());
        bytes[at] = value;
        if let Ok(message) = Message::decode(&bytes) {
            prop_assert_eq!(message.encode(), bytes);
        }
    }

    #[test]
    fn damaged_payloads_parse_canonically_or_not_at_all(which in 0..samples::facts().len(), at in any::<prop::sample::Index>(), value in any::<u8>()) {
        let (_, fact) = samples::facts().swap_remove(which);
        let mut payload = fact.to_payload().unwrap();
        let at = at.index(payload.len());
        payload[at] = value;
        if let Ok(read) = Fact::from_payload(fact.kind(), &payload) {
            prop_assert_eq!(read.to_payload().unwrap(), payload);
        }
    }
}

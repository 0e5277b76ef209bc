//! Bytes through every public decoder. What decodes must encode to the very same bytes, lie within its limits and be
//! finite; all else must be refused.

use super::Meter;
use super::people::{config, key, robot, roster, swarm};
use merganser_protocol::geometry::Relative;
use merganser_protocol::ids::{EntryId, FrameId};
use merganser_protocol::replica::Replica;
use merganser_protocol::submap::{Features, Keypoints, Summary, Surfel};
use merganser_protocol::wire::fact::{Fact, RefusalReason, VerdictFact, VerdictOutcome};
use merganser_protocol::wire::limits::{
    BLOB_LEN_MAX, CARRIED_MAX, ENTRY_LEN_MAX, MESSAGE_LEN_MAX, MESSAGE_OVERHEAD_MAX, PAYLOAD_LEN_MAX, ROSTER_LEN_MAX,
    SUMMARY_LEN_MAX,
};
use merganser_protocol::wire::{Delta, Entry, HaveVector, Message, Roster, SwarmTag};

/// Fact kinds 1 to 7 and one on either side.
const KINDS: core::ops::RangeInclusive<u8> = 0..=8;

/// Panics if a decoder does anything but refuse or give back what it was given.
pub fn decode(bytes: &[u8], meter: &impl Meter) {
    meter.begin();
    let message = Message::decode(bytes);
    meter.end("a message");
    if let Ok(message) = message {
        check_message(bytes, &message, meter);
    }
    check_entry(bytes, meter);
    for kind in KINDS {
        check_fact(kind, bytes, meter);
    }
    check_blobs(bytes, meter);
    meter.begin();
    let roster = Roster::decode(bytes);
    meter.end("a roster");
    if let Ok(roster) = roster {
        check_roster(bytes, &roster);
    }
}

/// What is read says the same again, and names nobody twice.
fn check_roster(bytes: &[u8], roster: &Roster) {
    assert_eq!(roster.encode(), bytes, "a roster has one form");
    assert!(bytes.len() <= ROSTER_LEN_MAX);
    let listed: std::collections::BTreeSet<_> = roster.listed().map(|listed| listed.robot).collect();
    assert_eq!(listed.len(), roster.listed().count());
    assert!(!roster.supersedes(roster) && !roster.is_fork_of(roster));
}

fn check_message(bytes: &[u8], message: &Message, meter: &impl Meter) {
    assert_eq!(message.encode(), bytes, "a message has one form");
    assert!(bytes.len() <= MESSAGE_LEN_MAX + MESSAGE_OVERHEAD_MAX);
    serde_json::to_string(message).unwrap();
    match message {
        Message::Pose(beacon) => {
            assert_finite(&Relative::Metric(beacon.t_anchor_body));
            let _ = beacon.verify(&key(0).verifying_key(), SwarmTag::of(&swarm()));
        }
        Message::Facts(entries) => entries.iter().for_each(|entry| check_entry(&entry.0, meter)),
        Message::SyncReply(delta) => {
            delta.entries.iter().chain(delta.forks.iter().flatten()).for_each(|entry| check_entry(&entry.0, meter));
        }
        Message::SyncRequest(have) => check_have(have, meter),
        _ => {}
    }
}

/// A vector from anybody is read and answered within the budget.
fn check_have(have: &HaveVector, meter: &impl Meter) {
    let limits = config().gossip;
    let mut replica = Replica::new(&swarm(), roster(), &limits).unwrap();
    let verdict = |seq| VerdictFact {
        alignment: EntryId { frame: FrameId { robot: robot(0), epoch: 1 }, seq },
        outcome: VerdictOutcome::Refused(RefusalReason::TooFew),
    };
    for seq in 0..3 {
        let entry = replica.append(key(2), 1, &Fact::Verdict(verdict(seq))).unwrap();
        replica.mark_durable(entry.id());
    }
    meter.begin();
    let read = replica.read_have(have);
    let delta = read.as_ref().map(|have| replica.delta_for(have, limits.delta_bytes_max));
    let ahead = read.as_ref().map(|have| replica.ahead_of_us(have));
    meter.end("a have-vector");
    let len = |delta: &Delta| delta.entries.iter().map(|entry| entry.0.len()).sum::<usize>();
    assert!(delta.is_none_or(|delta| len(&delta) <= limits.delta_bytes_max && delta.entries.len() <= 3));
    assert!(ahead.is_none_or(|ahead| ahead.len() <= have.heads.len()));
}

fn check_entry(bytes: &[u8], meter: &impl Meter) {
    meter.begin();
    let entry = Entry::decode(bytes);
    meter.end("an entry");
    let Ok(entry) = entry else { return };
    assert_eq!(entry.encode(), bytes, "an entry has one form");
    assert!(bytes.len() <= ENTRY_LEN_MAX && entry.payload().len() <= PAYLOAD_LEN_MAX);
    check_fact(entry.kind(), entry.payload(), meter);
}

fn check_fact(kind: u8, payload: &[u8], meter: &impl Meter) {
    meter.begin();
    let fact = Fact::from_payload(kind, payload);
    meter.end("a fact");
    let Ok(fact) = fact else { return };
    assert_eq!(fact.kind(), kind);
    assert_eq!(fact.to_payload().as_deref(), Ok(payload), "a fact has one form");
    match fact {
        Fact::Submap(f) => {
            assert!(f.stamps[0] <= f.stamps[1] && f.extent.iter().all(|x| x.is_finite() && *x >= 0.0));
            assert!(f.summary.len() <= SUMMARY_LEN_MAX);
            assert_finite(&Relative::Metric(f.odometry));
        }
        Fact::Alignment(f) => {
            assert!(f.i != f.j && f.sigma.is_finite() && f.log10_nfa.is_finite());
            assert_finite(&f.t_i_j);
        }
        Fact::Verdict(f) => {
            if let VerdictOutcome::Measured { t_i_j, sigma, .. } = f.outcome {
                assert!(sigma.is_finite());
                assert_finite(&t_i_j);
            }
        }
        Fact::Sighting(f) => {
            assert!(f.i != f.j);
            assert_finite(&Relative::Metric(f.t_i_j));
        }
        Fact::Position(f) => {
            assert!(f.i != f.j && f.p_i.iter().chain(&f.p_j).all(|x| x.is_finite()));
            assert!(f.covariance.matrix().symmetric_eigenvalues().min() > 0.0);
        }
        Fact::Lookalike(f) => assert!(f.i < f.j),
        Fact::Retired(f) => assert!(f.below.get() > 0),
        Fact::Condensed(f) => {
            assert!((1..=CARRIED_MAX).contains(&f.carried.len()) && f.carried.is_sorted_by(|a, b| a.seq < b.seq));
            for one in f.carried {
                assert_ne!(one.fact.kind(), kind, "no facts within facts within facts");
                check_fact(one.fact.kind(), &one.fact.to_payload().unwrap(), meter);
            }
        }
    }
}

/// Finite, of unit norm, of positive scale, with positive variances (DESIGN §8.9).
fn assert_finite(t: &Relative) {
    let sim = t.sim();
    assert!(sim.translation.iter().all(|x| x.is_finite()) && sim.scale.is_finite() && sim.scale > 0.0);
    let norm: f64 = sim.rotation.xyzw().iter().map(|q| q * q).sum();
    assert!((norm - 1.0).abs() < 1e-9, "a quaternion of norm² {norm}");
    let lifted = t.lifted();
    assert!(lifted.covariance.matrix().iter().all(|x| x.is_finite()));
    let metric = t.metric().map(|p| p.covariance.sigmas());
    assert!(metric.is_none_or(|sigmas| sigmas.iter().all(|s| *s > 0.0)));
}

fn check_blobs(bytes: &[u8], meter: &impl Meter) {
    meter.begin();
    let (keypoints, features, summary) = (Keypoints::decode(bytes), Features::decode(bytes), Summary::decode(bytes));
    meter.end("a blob, a private record, a summary");
    if let Ok(keypoints) = keypoints {
        assert_eq!(keypoints.encode(), bytes, "a blob has one form");
        assert!(bytes.len() <= BLOB_LEN_MAX);
        let finite = |s: &Surfel| s.position.iter().all(|x| x.is_finite());
        assert!(keypoints.surfels().iter().all(finite));
    }
    if let Ok(features) = features {
        assert_eq!(features.encode(), bytes, "a private record has one form");
    }
    if let Ok(summary) = summary {
        assert_eq!(summary.encode(), bytes, "a summary has one form");
        assert!((0.0..=1.0).contains(&summary.similarity(&summary)));
    }
}

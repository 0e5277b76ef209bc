//! Samples for tests: at least one of every message, fact, and variant inside them. A new variant without a sample does
//! not compile.

use super::fact::*;
use super::*;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance, So3};
use crate::ids::{EntryId, FrameId, Hash, Name, RobotId, SubmapId};
use crate::time::Stamp;
use core::num::NonZero;
use ed25519_dalek::SigningKey;
use nalgebra::{SMatrix, Vector3};

/// The `n`-th test robot's key.
pub fn key(n: u8) -> SigningKey {
    SigningKey::from_bytes(&[n + 1; 32])
}

/// The `n`-th test robot.
pub fn robot(n: u8) -> RobotId {
    RobotId::of_key(key(n).verifying_key().as_bytes())
}

pub fn frame(n: u8, epoch: u32) -> FrameId {
    FrameId { robot: robot(n), epoch }
}

pub fn submap(n: u8, index: u32) -> SubmapId {
    SubmapId { frame: frame(n, 203_000_000), index }
}

pub fn swarm() -> Name {
    Name::new("test").unwrap()
}

/// A pose with correlated covariance.
pub fn estimate() -> PoseWithCovariance {
    let rotation = So3::exp(&Vector3::new(0.3, -0.2, 1.1));
    let pose = Se3::new(rotation, Vector3::new(1.25, -3.5, 0.125));
    PoseWithCovariance { pose, covariance: covariance() }
}

pub fn similarity() -> SimWithCovariance {
    let e = estimate().pose;
    SimWithCovariance { sim: Sim3::new(e.rotation, e.translation, 1.75), covariance: covariance() }
}

fn covariance<const N: usize>() -> Covariance<N> {
    let l = SMatrix::<f64, N, N>::from_fn(|r, c| match r.cmp(&c) {
        core::cmp::Ordering::Less => 0.0,
        core::cmp::Ordering::Equal => 0.01 * (1.0 + r as f64),
        core::cmp::Ordering::Greater => 0.002 * (r as f64 - 2.0 * c as f64),
    });
    Covariance::new(l * l.transpose()).unwrap()
}

macro_rules! samples {
    ($(#[$doc:meta])* $name:ident: $type:ty { $($pattern:pat => { $($label:literal => $value:expr),+ $(,)? })+ }) => {
        $(#[$doc])*
        pub fn $name() -> Vec<(&'static str, $type)> {
            // Fails to compile for a variant that has no line below.
            let _exhaustive = |value: &$type| match value { $($pattern => {})+ };
            vec![$($(($label, $value)),+),+]
        }
    };
}

samples! {
    /// Facts, by the name of their golden file.
    facts: Fact {
        Fact::Submap(SubmapFact { scale: ScaleKind::Metric, keyframes: None, .. }) => {
            "submap" => submap_fact(ScaleKind::Metric)
        }
        Fact::Submap(SubmapFact { scale: ScaleKind::Unknown, .. }) => {
            "submap_unknown_scale" => submap_fact(ScaleKind::Unknown)
        }
        Fact::Alignment(AlignmentFact { t_i_j: Relative::Metric(_), .. }) => {
            "alignment" => alignment_fact(Relative::Metric(estimate()))
        }
        Fact::Alignment(AlignmentFact { t_i_j: Relative::Similarity(_), .. }) => {
            "alignment_similarity" => alignment_fact(Relative::Similarity(similarity()))
        }
        Fact::Verdict(VerdictFact { outcome: VerdictOutcome::Measured { .. }, .. }) => {
            "verdict" => verdict_fact(VerdictOutcome::Measured {
                t_i_j: Relative::Metric(estimate()),
                sigma: 0.03125,
                support: 57,
            })
        }
        Fact::Verdict(VerdictFact { outcome: VerdictOutcome::Refused(RefusalReason::TooFew), .. }) => {
            "verdict_too_few" => verdict_fact(VerdictOutcome::Refused(RefusalReason::TooFew))
        }
        Fact::Verdict(VerdictFact { outcome: VerdictOutcome::Refused(RefusalReason::NoConsensus), .. }) => {
            "verdict_no_consensus" => verdict_fact(VerdictOutcome::Refused(RefusalReason::NoConsensus))
        }
        Fact::Verdict(VerdictFact { outcome: VerdictOutcome::Refused(RefusalReason::Ambiguous), .. }) => {
            "verdict_ambiguous" => verdict_fact(VerdictOutcome::Refused(RefusalReason::Ambiguous))
        }
        Fact::Verdict(VerdictFact { outcome: VerdictOutcome::Refused(RefusalReason::Degenerate), .. }) => {
            "verdict_degenerate" => verdict_fact(VerdictOutcome::Refused(RefusalReason::Degenerate))
        }
        Fact::Verdict(VerdictFact { outcome: VerdictOutcome::Refused(RefusalReason::PoorFit), .. }) => {
            "verdict_poor_fit" => verdict_fact(VerdictOutcome::Refused(RefusalReason::PoorFit))
        }
        Fact::Verdict(VerdictFact { outcome: VerdictOutcome::Refused(RefusalReason::BadInput), .. }) => {
            "verdict_bad_input" => verdict_fact(VerdictOutcome::Refused(RefusalReason::BadInput))
        }
        Fact::Sighting(_) => {
            "sighting" => Fact::Sighting(SightingFact {
                stamp: Stamp(1_700_000_000_123_456_789),
                i: submap(0, 7),
                j: submap(1, 4),
                t_i_j: estimate(),
            })
        }
        Fact::Condensed(_) => { "condensed" => condensed_fact() }
        Fact::Position(_) => {
            "position" => Fact::Position(PositionFact {
                stamp: Stamp(1_700_000_000_123_456_789),
                i: submap(0, 7),
                j: submap(1, 4),
                p_i: [2.5, -0.75, 0.125],
                p_j: [0.5, 0.25, 0.0],
                covariance: Covariance::from_sigmas([0.25, 0.125, 0.5]).unwrap(),
            })
        }
        Fact::Lookalike(_) => { "lookalike" => Fact::Lookalike(LookalikeFact { i: 7, j: 300 }) }
        Fact::Retired(_) => { "retired" => Fact::Retired(RetiredFact { below: NonZero::new(300).unwrap() }) }
        Fact::Submap(SubmapFact { scale: ScaleKind::Metric, keyframes: Some(_), .. }) => {
            "submap_counted" => counted(submap_fact(ScaleKind::Metric))
        }
    }
}

samples! {
    /// Messages, by the name of their golden file.
    messages: Message {
        Message::Pose(_) => { "pose" => Message::Pose(beacon()) }
        Message::Facts(_) => { "facts" => Message::Facts(entries(3)) }
        Message::Have(_) => {
            "have" => Message::Have(HaveRoot { root: *b"rootroot", count: 360 })
        }
        Message::SyncRequest(_) => {
            "sync_request" => Message::SyncRequest(have(|_| None)),
            "sync_request_tagged" => Message::SyncRequest(have(|k| Some([k, 2, 3, 4]))),
            "sync_request_named" => Message::SyncRequest(HaveVector {
                members: Members::Listed((0..3).map(listed).collect()),
                asker: 2,
                named: true,
                after: None,
                until: None,
                heads: vec![(0, 5, Head::Log { len: 0, tag: None }), (1, 4, Head::Forked)],
            }),
            "sync_request_window" => Message::SyncRequest(HaveVector {
                after: Some(frame(2, 0)),
                until: Some(FrameId { robot: RobotId([255; 8]), epoch: 1 }),
                heads: Vec::new(),
                ..have(|_| None)
            }),
        }
        Message::SyncReply(_) => {
            "sync_reply" => Message::SyncReply(Delta {
                entries: entries(2),
                forks: vec![[entry(1, 0, 9), entry(1, 0, 8)]],
                more: true,
            })
        }
        Message::BlobRequest { .. } => {
            "blob_request" => Message::BlobRequest { hash: Hash::of(b"blob"), offset: 16_384, len: 16_384 }
        }
        Message::BlobReply { .. } => {
            "blob_reply" => Message::BlobReply {
                hash: Hash::of(b"blob"), offset: 3, total: 9, bytes: vec![1, 2, 3], proof: vec![]
            },
            "blob_slice" => Message::BlobReply {
                hash: Hash::of(b"blob"), offset: 1024, total: 2049, bytes: vec![9; 1024], proof: vec![[5; 32], [6; 32]]
            }
        }
        Message::AlignRequest { .. } => {
            "align_request" => Message::AlignRequest { i: submap(0, 7), j: submap(1, 4) }
        }
        Message::AlignReply { status: AlignStatus::Accepted } => {
            "align_reply_accepted" => Message::AlignReply { status: AlignStatus::Accepted }
        }
        Message::AlignReply { status: AlignStatus::Busy } => {
            "align_reply_busy" => Message::AlignReply { status: AlignStatus::Busy }
        }
        Message::AlignReply { status: AlignStatus::Unknown } => {
            "align_reply_unknown" => Message::AlignReply { status: AlignStatus::Unknown }
        }
        Message::AlignReply { status: AlignStatus::Done } => {
            "align_reply_done" => Message::AlignReply { status: AlignStatus::Done }
        }
        Message::AlignReply { status: AlignStatus::NotMine } => {
            "align_reply_not_mine" => Message::AlignReply { status: AlignStatus::NotMine }
        }
        Message::LifeRequest { .. } => { "life_request" => Message::LifeRequest { nonce: *b"drawn this time!" } }
        Message::LifeReply(_) => {
            "life_reply" => Message::LifeReply(life()),
            "life_reply_silent" => Message::LifeReply(Life::sign(
                &key(1),
                SwarmTag::of(&swarm()),
                LifeContent { robot: robot(1), nonce: *b"drawn this time!", latest: None },
            )),
        }
    }
}

/// An entry around a fact.
pub fn entry_of(n: u8, seq: u32, fact: &Fact) -> Entry {
    let content = EntryContent {
        swarm: SwarmTag::of(&swarm()),
        id: EntryId { frame: frame(n, 203_000_000), seq },
        kind: fact.kind(),
        floor: 0,
        previous: if seq == 0 { Hash::default() } else { Hash::of(b"previous") },
        payload: fact.to_payload().unwrap(),
    };
    Entry::sign(&key(n), content).unwrap()
}

pub fn beacon() -> Beacon {
    let content = BeaconContent {
        anchor: submap(0, 7),
        stamp: Stamp(1_700_000_000_123_456_789),
        counter: 1234,
        t_anchor_body: estimate(),
    };
    Beacon::sign(&key(0), SwarmTag::of(&swarm()), &content).unwrap()
}

pub fn life() -> Life {
    let latest = BeaconAge { epoch: 203_000_000, stamp: Stamp(1_700_000_000_123_456_789), counter: 1234 };
    let content = LifeContent { robot: robot(0), nonce: *b"drawn this time!", latest: Some(latest) };
    Life::sign(&key(0), SwarmTag::of(&swarm()), content)
}

/// A vector by the roster; `tag` gives the n-th log's.
pub fn have(tag: impl Fn(u8) -> Option<[u8; 4]>) -> HaveVector {
    let heads = vec![
        (0, 1, Head::Log { len: 1, tag: tag(0) }),
        (0, 203_000_000, Head::Log { len: 300, tag: tag(1) }),
        (2, 202_999_990, Head::Forked),
        (700, 203_000_100, Head::Log { len: 17, tag: tag(2) }),
    ];
    HaveVector { members: Members::Roster([9, 8, 7, 6]), asker: 2, named: false, after: None, until: None, heads }
}

/// Robots with rising ids.
pub fn listed(n: u8) -> RobotId {
    RobotId([n, 7, 7, 7, 7, 7, 7, 7])
}

pub fn submap_fact(scale: ScaleKind) -> Fact {
    Fact::Submap(SubmapFact {
        index: 7,
        stamps: [Stamp(1_700_000_000_000_000_000), Stamp(1_700_000_002_000_000_000)],
        odometry: estimate(),
        extent: [4.5, 3.25, 1.5],
        summary: (0..120).collect(),
        keypoint_count: 256,
        blob: Hash::of(b"blob"),
        scale,
        keyframes: None,
    })
}

/// With the number of its keyframes.
fn counted(fact: Fact) -> Fact {
    match fact {
        Fact::Submap(submap) => Fact::Submap(SubmapFact { keyframes: NonZero::new(300), ..submap }),
        other => other,
    }
}

fn condensed_fact() -> Fact {
    let carried = |seq, after, fact| CarriedFact { seq, after, fact };
    Fact::Condensed(CondensedFact {
        carried: vec![
            carried(3, Some(4), submap_fact(ScaleKind::Metric)),
            carried(5, None, alignment_fact(Relative::Metric(estimate()))),
            carried(300, None, verdict_fact(VerdictOutcome::Refused(RefusalReason::NoConsensus))),
        ],
    })
}

fn alignment_fact(t_i_j: Relative) -> Fact {
    Fact::Alignment(AlignmentFact {
        i: submap(0, 7),
        j: submap(1, 4),
        t_i_j,
        sigma: 0.0625,
        support: 64,
        log10_nfa: -31.5,
        blobs: [Hash::of(b"i"), Hash::of(b"j")],
    })
}

fn verdict_fact(outcome: VerdictOutcome) -> Fact {
    Fact::Verdict(VerdictFact { alignment: EntryId { frame: frame(0, 203_000_000), seq: 11 }, outcome })
}

fn entries(n: u32) -> Vec<EntryBytes> {
    let all = facts();
    (0..n).map(|seq| EntryBytes(entry_of(0, seq, &all[seq as usize].1).encode())).collect()
}

fn entry(n: u8, seq: u32, fact: usize) -> EntryBytes {
    EntryBytes(entry_of(n, seq, &facts()[fact].1).encode())
}

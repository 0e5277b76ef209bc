//! What the liar and the thief write: entries that are rightly signed and say anything, in logs with holes, two
//! histories, falling floors, of other swarms, of closed and far epochs; and beacons, questions and answers to match.

use super::people::{AGENTS, ROBOTS, described, key, robot, sigmas, swarm};
use super::reader::Reader;
use core::num::NonZero;
use merganser_protocol::agent::io::QueryKind;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance, So3};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId, SubmapId};
use merganser_protocol::time::Stamp;
use merganser_protocol::wire::fact::{
    AlignmentFact, CarriedFact, CondensedFact, Fact, LookalikeFact, PositionFact, RefusalReason, RetiredFact,
    ScaleKind, SightingFact, SubmapFact, VerdictFact, VerdictOutcome,
};
use merganser_protocol::wire::limits::{BLOB_PIECE_LEN, PAYLOAD_LEN_MAX};
use merganser_protocol::wire::slice;
use merganser_protocol::wire::{
    AlignStatus, Beacon, BeaconAge, BeaconContent, Delta, Entry, EntryBytes, EntryContent, HaveRoot, HaveVector, Head,
    Life, LifeContent, Members, Message, SwarmTag,
};
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// Who writes: mostly the liar, in her own name.
const WRITERS: [usize; 8] = [2, 2, 2, 2, 2, 0, 1, 3];

/// The forger, who sees which frames the agents write.
pub struct Forge {
    logs: BTreeMap<FrameId, Vec<Vec<u8>>>,
    pub frames: [FrameId; AGENTS],
}

impl Forge {
    pub fn new(frames: [FrameId; AGENTS]) -> Self {
        Self { logs: BTreeMap::new(), frames }
    }

    /// Whether anything was written in this log's name.
    pub fn knows(&self, frame: FrameId) -> bool {
        self.logs.contains_key(&frame)
    }

    /// An entry and its bytes, mostly the next of its log.
    pub fn entry(&mut self, r: &mut Reader) -> Vec<u8> {
        let who = r.pick(&WRITERS);
        let epoch = match who {
            k if k < AGENTS && r.one_in(2) => self.frames[k].epoch,
            _ => r.pick(&[1, 1, 1, 2, 3, 4, u32::MAX, 0]),
        };
        let frame = FrameId { robot: robot(who), epoch };
        let (kind, payload) = self.fact(r);
        let way = r.below(16);
        let log = self.logs.entry(frame).or_default();
        let (mut seq, mut previous) = (log.len() as u32, log.last().map(|last| Hash::of(last)).unwrap_or_default());
        let before = log.last().and_then(|last| Entry::decode(last).ok()).map_or(0, |last| last.floor());
        let (mut floor, mut signer, mut tag) = (before, who, SwarmTag::of(&swarm()));
        match way {
            0 if !log.is_empty() => return log[r.below(log.len())].clone(),
            1 if !log.is_empty() => {
                seq = r.below(log.len()) as u32;
                previous = seq.checked_sub(1).map(|before| Hash::of(&log[before as usize])).unwrap_or_default();
            }
            2 => {
                (seq, previous) = (seq + 1 + u32::from(r.byte()), Hash::of(b"not yet written"));
                floor = if r.one_in(2) { seq } else { floor };
            }
            3 if seq > 0 => previous = Hash::of(b"another history"),
            4 => floor = seq,
            5 => signer = (who + 1) % ROBOTS,
            6 => tag = SwarmTag::of(&Name::new("other").unwrap()),
            7 => (seq, previous) = (u32::MAX, Hash::of(b"the last of all")),
            _ => {}
        }
        floor = floor.min(seq); // more cannot be signed
        let content = EntryContent { swarm: tag, id: EntryId { frame, seq }, kind, floor, previous, payload };
        let bytes = Entry::sign(key(signer), content).unwrap().encode();
        if way > 7 || way == 4 || way == 0 {
            log.push(bytes.clone());
        }
        bytes
    }

    pub fn submap(&self, r: &mut Reader) -> SubmapId {
        let place = r.byte();
        let frames = [
            self.frames[0],
            self.frames[1],
            FrameId { robot: robot(2), epoch: 1 },
            FrameId { robot: robot(2), epoch: 2 },
        ];
        SubmapId { frame: frames[usize::from(place % 4)], index: u32::from(place / 4 % 4) }
    }

    fn fact(&self, r: &mut Reader) -> (u8, Vec<u8>) {
        let fact = match r.below(8) {
            0..=2 => Fact::Submap(submap_fact(r)),
            3 | 4 => {
                let (a, b) = (self.submap(r), self.submap(r));
                let t_i_j = relative(r);
                let blob = Hash::of(&described().0);
                let blobs = if r.one_in(4) { [Hash::of(b"i"), blob] } else { [blob; 2] };
                let (sigma, support, log10_nfa) = (r.number() as f32, u16::from(r.byte()), r.number() as f32);
                Fact::Alignment(AlignmentFact { i: a.min(b), j: a.max(b), t_i_j, sigma, support, log10_nfa, blobs })
            }
            5 => {
                let place = r.byte();
                let frame = self.submap(r).frame;
                let outcome = if r.one_in(2) {
                    VerdictOutcome::Refused(RefusalReason::NoConsensus)
                } else {
                    VerdictOutcome::Measured { t_i_j: relative(r), sigma: r.number() as f32, support: 9 }
                };
                Fact::Verdict(VerdictFact { alignment: EntryId { frame, seq: u32::from(place % 8) }, outcome })
            }
            6 if r.one_in(2) => {
                let carried = (0..r.below(4) as u32).map(|seq| {
                    let after = if r.one_in(2) { Some(u32::from(r.byte() % 4)) } else { None };
                    let alike = Fact::Lookalike(LookalikeFact { i: seq, j: seq + 5 });
                    let fact = if after.is_none() && r.one_in(4) { alike } else { Fact::Submap(submap_fact(r)) };
                    CarriedFact { seq, after, fact }
                });
                Fact::Condensed(CondensedFact { carried: carried.collect() })
            }
            6 => {
                let (i, j) = (self.submap(r), self.submap(r));
                let stamp = Stamp(r.u64() as i64);
                let seen = pose(r);
                if r.one_in(2) {
                    let p_i = seen.pose.translation.map(|x| x as f32).into();
                    let covariance =
                        Covariance::new_or_wider(seen.covariance.matrix().fixed_view::<3, 3>(0, 0).into_owned());
                    Fact::Position(PositionFact { stamp, i, j, p_i, p_j: [0.5, 0.0, -0.25], covariance })
                } else {
                    Fact::Sighting(SightingFact { stamp, i, j, t_i_j: seen })
                }
            }
            7 if r.one_in(2) => {
                let i = u32::from(r.byte() % 8);
                if r.one_in(4) {
                    let below = NonZero::new(1 + i).unwrap();
                    let fact = Fact::Retired(RetiredFact { below });
                    return (fact.kind(), fact.to_payload().unwrap());
                }
                Fact::Lookalike(LookalikeFact { i, j: i + u32::from(r.byte() % 8) })
            }
            _ => {
                let (kind, len) = (r.byte() % 10, r.below(64));
                return (kind, r.bytes(len).to_vec());
            }
        };
        // What no honest robot can write is written all the same.
        let payload = fact.to_payload().unwrap_or_else(|_| vec![255; r.below(256) * PAYLOAD_LEN_MAX / 255]);
        (fact.kind(), payload)
    }

    pub fn beacon(&self, r: &mut Reader) -> Message {
        let who = r.pick(&WRITERS);
        let frame = match r.byte() {
            n if n < 128 && who < AGENTS => self.frames[who],
            n => FrameId { robot: robot(who), epoch: u32::from(n) % 4 },
        };
        let anchor = SubmapId { frame, index: u32::from(r.byte() % 4) };
        let (stamp, counter) = (Stamp(r.u64() as i64), r.u64());
        let sign = |t_anchor_body| {
            let content = BeaconContent { anchor, stamp, counter, t_anchor_body };
            Beacon::sign(key(who), SwarmTag::of(&swarm()), &content)
        };
        let plain = PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(0.1).unwrap() };
        Message::Pose(sign(pose(r)).unwrap_or_else(|_| sign(plain).unwrap()))
    }

    pub fn root(r: &mut Reader) -> Message {
        Message::Have(HaveRoot { root: [r.byte(); 8], count: r.pick(&[0, 1, 2, 3, 9, 200, u64::MAX]) })
    }

    /// A question of the kind asked for, or of another.
    pub fn question(&self, r: &mut Reader) -> (QueryKind, Message) {
        let way = r.below(5);
        match way {
            4 => (QueryKind::Life, Message::LifeRequest { nonce: [r.byte(); 16] }),
            0 | 1 => (QueryKind::Sync, Message::SyncRequest(self.vector(r))),
            2 => {
                let hash = if r.one_in(4) { Hash::of(b"nobody has it") } else { Hash::of(&described().0) };
                let (offset, len) = (r.pick(&[0, 1, 300, 1 << 30, u32::MAX]), r.pick(&[1, 100, 1 << 14, u32::MAX]));
                (QueryKind::Blob, Message::BlobRequest { hash, offset, len })
            }
            _ => (QueryKind::Align, Message::AlignRequest { i: self.submap(r), j: self.submap(r) }),
        }
    }

    fn vector(&self, r: &mut Reader) -> HaveVector {
        let mut robots: Vec<RobotId> = (0..ROBOTS).map(robot).collect();
        robots.sort_unstable();
        let mut heads = Vec::new();
        for place in 0..robots.len() as u16 {
            for epoch in [1, 2, 3, u32::MAX] {
                let len = match r.below(8) {
                    0..=3 => continue,
                    7 => u32::MAX,
                    n => n as u32,
                };
                let head = Head::Log { len, tag: None };
                heads.push((place, epoch, if r.one_in(8) { Head::Forked } else { head }));
            }
        }
        let frame = |r: &mut Reader| r.one_in(8).then(|| FrameId { robot: robot(r.below(ROBOTS)), epoch: 2 });
        let (after, until) = (frame(r), frame(r));
        let asker = r.below(ROBOTS) as u16;
        HaveVector { members: Members::Listed(robots), asker, named: r.one_in(2), after, until, heads }
    }

    /// An answer of the liar's, to a question of this kind.
    pub fn answer(&mut self, r: &mut Reader, kind: QueryKind, question: &[u8]) -> Vec<u8> {
        let message = match (kind, Message::decode(question)) {
            (QueryKind::Sync, _) => {
                let entries = (0..r.below(6)).map(|_| EntryBytes(self.entry(r))).collect();
                let forks = (0..r.below(3)).map(|_| [EntryBytes(self.entry(r)), EntryBytes(self.entry(r))]).collect();
                Message::SyncReply(Delta { entries, forks, more: r.one_in(2) })
            }
            (QueryKind::Blob, Ok(Message::BlobRequest { hash, offset, len })) => {
                let blob = &described().0;
                let start = (offset as usize).min(blob.len());
                let end = start.saturating_add((len as usize).min(BLOB_PIECE_LEN)).min(blob.len());
                let (total, bytes) = match r.below(4) {
                    0 => (0, Vec::new()),
                    1 => (65_536 - u32::from(r.byte()), vec![7; BLOB_PIECE_LEN]),
                    _ => (blob.len() as u32, blob[start..end].to_vec()),
                };
                let proof = if r.one_in(4) { vec![[7; 32]; r.below(4)] } else { slice::proof(blob, start..end) };
                Message::BlobReply { hash, offset, total, bytes, proof }
            }
            (QueryKind::Life, Ok(Message::LifeRequest { nonce })) => {
                let who = r.pick(&WRITERS);
                let latest =
                    BeaconAge { epoch: u32::from(r.byte() % 4), stamp: Stamp(r.u64() as i64), counter: r.u64() };
                let nonce = if r.one_in(4) { [7; 16] } else { nonce };
                let content = LifeContent { robot: robot(who), nonce, latest: r.one_in(2).then_some(latest) };
                Message::LifeReply(Life::sign(key(if r.one_in(4) { 0 } else { who }), SwarmTag::of(&swarm()), content))
            }
            _ => Message::AlignReply { status: r.pick(&[AlignStatus::Accepted, AlignStatus::Busy, AlignStatus::Done]) },
        };
        r.mangled(message.encode())
    }
}

fn submap_fact(r: &mut Reader) -> SubmapFact {
    let (blob, summary) = described();
    let look = r.byte();
    SubmapFact {
        index: u32::from(look % 4),
        stamps: [Stamp(0), Stamp(r.number() as i64)],
        odometry: pose(r),
        extent: [r.number().abs() as f32; 3],
        summary: if look < 32 { vec![look; 134] } else { summary.clone() },
        keypoint_count: u16::from(look),
        blob: if (32..64).contains(&look) { Hash::of(&[look]) } else { Hash::of(blob) },
        scale: if look > 200 { ScaleKind::Unknown } else { ScaleKind::Metric },
        keyframes: NonZero::new(u16::from(look / 8)),
    }
}

/// A pose whose numbers may be anything that its types can hold.
pub fn pose(r: &mut Reader) -> PoseWithCovariance {
    if r.byte() < 128 {
        return PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(0.02).unwrap() };
    }
    let (translation, rotation) = (Vector3::from(r.numbers::<3>()), r.numbers::<4>());
    let pose = Se3::new(So3::from_xyzw(rotation).unwrap_or_else(So3::identity), translation);
    PoseWithCovariance { pose, covariance: sigmas(r.number()).unwrap_or_else(|| sigmas(0.1).unwrap()) }
}

pub fn relative(r: &mut Reader) -> Relative {
    let p = pose(r);
    if r.byte() < 200 {
        return Relative::Metric(p);
    }
    let lifted = SimWithCovariance::from_metric(&p);
    let sim = Sim3::new(p.pose.rotation, p.pose.translation, r.number());
    Relative::Similarity(SimWithCovariance { sim, ..lifted })
}

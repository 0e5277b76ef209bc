//! The list of bad input, one test each: what an agent does with it is refuse, count and go on.

use crate::Limit;
use crate::fuzzing::people::{agent, described, key, robot, sigmas, swarm};
use crate::fuzzing::{Meter, decode};
use merganser_protocol::agent::io::{AskToken, Channel, Command, Input, Output, QueryKind, Record};
use merganser_protocol::agent::{Agent, Restored};
use merganser_protocol::geometry::{PoseWithCovariance, Se3};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, SubmapId};
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::fact::{Fact, RefusalReason, VerdictFact, VerdictOutcome};
use merganser_protocol::wire::{Beacon, BeaconContent, Entry, EntryBytes, EntryContent, HaveRoot, Message, SwarmTag};

const CHANNELS: [Channel; 3] = [Channel::Pose, Channel::Facts, Channel::Have];
const KINDS: [QueryKind; 4] = [QueryKind::Sync, QueryKind::Blob, QueryKind::Align, QueryKind::Life];

/// Every frozen message and entry of version 1.
fn golden() -> Vec<Vec<u8>> {
    let folder = "golden/v1";
    let mut paths: Vec<_> = std::fs::read_dir(folder).unwrap().map(|file| file.unwrap().path()).collect();
    paths.retain(|path| path.extension().is_some_and(|extension| extension == "bin"));
    paths.sort();
    assert!(paths.len() > 20);
    paths.into_iter().map(|path| std::fs::read(path).unwrap()).collect()
}

/// An agent that hears things.
struct Victim(Agent);

impl Victim {
    fn new() -> Self {
        Self(agent(0, Restored { records: Vec::new(), fresh_epoch: 1 }, Instant::ZERO))
    }

    fn give(&mut self, input: Input) -> Vec<Output> {
        let limit = Limit::new();
        limit.begin();
        self.0.handle(Instant::ZERO, input);
        limit.end("bad input");
        std::iter::from_fn(|| self.0.poll_output()).collect()
    }

    fn hear(&mut self, channel: Channel, bytes: Vec<u8>) -> Vec<Output> {
        self.give(Input::Received { from: robot(2), channel, bytes })
    }

    fn hear_entry(&mut self, entry: Vec<u8>) -> Vec<Output> {
        self.hear(Channel::Facts, Message::Facts(vec![EntryBytes(entry)]).encode())
    }

    /// Hears an entry and makes it durable.
    fn keep(&mut self, entry: Vec<u8>) {
        let outputs = self.hear_entry(entry);
        assert!(stored(&outputs), "{outputs:?}");
        self.give(Input::Persisted { up_to: u64::MAX });
    }

    fn refused(&self, reason: &str) -> u64 {
        self.0.snapshot(Instant::ZERO).stats.rejected.get(reason).copied().unwrap_or_default()
    }
}

fn stored(outputs: &[Output]) -> bool {
    outputs.iter().any(|output| matches!(output, Output::Persist { .. }))
}

/// The `seq`-th entry of a member's log, all of which say the same.
fn content(member: usize, epoch: u32, seq: u32, previous: Hash) -> EntryContent {
    let frame = FrameId { robot: robot(member), epoch };
    let outcome = VerdictOutcome::Refused(RefusalReason::TooFew);
    let fact = Fact::Verdict(VerdictFact { alignment: EntryId { frame, seq: 0 }, outcome });
    let (swarm, id, kind, payload) =
        (SwarmTag::of(&swarm()), EntryId { frame, seq }, fact.kind(), fact.to_payload().unwrap());
    EntryContent { swarm, id, kind, floor: 0, previous, payload }
}

fn first(member: usize, epoch: u32) -> Vec<u8> {
    sign(member, content(member, epoch, 0, Hash::default()))
}

fn sign(signer: usize, content: EntryContent) -> Vec<u8> {
    Entry::sign(key(signer), content).unwrap().encode()
}

fn beacon(signer: usize, named: &str, counter: u64) -> Vec<u8> {
    let content = BeaconContent {
        anchor: SubmapId { frame: FrameId { robot: robot(2), epoch: 1 }, index: 0 },
        stamp: Stamp(counter as i64 * 1_000_000_000),
        counter,
        t_anchor_body: PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(0.1).unwrap() },
    };
    let swarm = SwarmTag::of(&Name::new(named).unwrap());
    Message::Pose(Beacon::sign(key(signer), swarm, &content).unwrap()).encode()
}

#[test]
fn frames_cut_at_any_byte_are_refused_at_every_door() {
    let mut victim = Victim::new();
    let mut given = 0;
    for bytes in golden() {
        // Of long messages every byte of the head and some of the rest: the decoders' own tests take all.
        for len in (0..bytes.len()).filter(|len| *len < 64 || len % 61 == 0) {
            for channel in CHANNELS {
                let outputs = victim.hear(channel, bytes[..len].to_vec());
                assert!(outputs.iter().all(|o| matches!(o, Output::Event(_) | Output::Run { .. })), "{outputs:?}");
            }
            for kind in KINDS {
                let asked = Input::Asked { token: AskToken(9), kind, bytes: bytes[..len].to_vec() };
                let outputs = victim.give(asked);
                let refusals =
                    |o: &&Output| matches!(o, Output::Answer { token: AskToken(9), bytes } if bytes.is_empty());
                assert_eq!(outputs.iter().filter(refusals).count(), 1);
            }
            given += (CHANNELS.len() + KINDS.len()) as u64;
        }
    }
    assert_eq!(victim.0.snapshot(Instant::ZERO).stats.rejected.values().sum::<u64>(), given);
    assert_eq!(victim.0.status().entries, 0);
}

#[test]
fn false_lengths_and_long_varints_anywhere_cost_no_memory() {
    let gigabyte = &[128, 128, 128, 128, 4][..];
    let all = &[255, 255, 255, 255, 255, 255, 255, 255, 255, 1][..];
    for bytes in golden() {
        for at in 0..bytes.len() {
            for claim in [gigabyte, all, &[bytes[at] | 128, 0]] {
                let mut bytes = bytes.clone();
                bytes.splice(at..=at, claim.iter().copied());
                decode(&bytes, &Limit::new());
            }
        }
    }
}

#[test]
fn other_versions_are_refused() {
    let mut victim = Victim::new();
    let good = Message::Facts(vec![EntryBytes(first(2, 1))]).encode();
    for version in [0, 2, 255] {
        let mut frame = good.clone();
        frame[2] = version;
        assert!(!stored(&victim.hear(Channel::Facts, frame)));
        let mut entry = first(2, 1);
        entry[0] = version;
        assert!(!stored(&victim.hear_entry(entry)));
    }
    assert_eq!((victim.refused("version"), victim.refused("entry_version")), (3, 3));
    assert!(stored(&victim.hear(Channel::Facts, good)));
}

#[test]
fn other_swarms_are_refused() {
    let mut victim = Victim::new();
    let other = SwarmTag::of(&Name::new("other").unwrap());
    let entry = sign(2, EntryContent { swarm: other, ..content(2, 1, 0, Hash::default()) });
    assert!(!stored(&victim.hear_entry(entry)));
    assert!(
        victim
            .hear(Channel::Pose, beacon(2, "other", 1))
            .iter()
            .all(|o| matches!(o, Output::Event(_) | Output::Run { .. }))
    );
    assert_eq!((victim.refused("swarm"), victim.refused("pose: signature")), (1, 1));
}

#[test]
fn what_is_not_or_badly_signed_is_refused() {
    let mut victim = Victim::new();
    let good = first(2, 1);
    let unsigned = [&good[..good.len() - 64], &[0; 64]].concat();
    let mut flipped = good.clone();
    let last = flipped.len() - 1;
    flipped[last] ^= 1;
    let cut = good[..good.len() - 64].to_vec();
    // Signed by another member; by the victim itself; by a stranger in a member's name.
    let forged = [0, 1, 3].map(|signer| sign(signer, content(2, 1, 0, Hash::default())));
    for entry in [unsigned, flipped].into_iter().chain(forged) {
        assert!(!stored(&victim.hear_entry(entry)));
    }
    assert_eq!(victim.refused("entry_signature"), 5);
    assert!(!stored(&victim.hear_entry(cut)), "its payload ends where the signature begins");
    victim.hear(Channel::Pose, beacon(1, "test", 1));
    assert_eq!(victim.refused("pose: signature"), 1);
    assert!(victim.0.snapshot(Instant::ZERO).poses.robots.iter().all(|robot| robot.robot != "gamma"));
    assert!(stored(&victim.hear_entry(good)));
}

#[test]
fn replays_change_nothing() {
    let mut victim = Victim::new();
    victim.keep(first(2, 1));
    let digest = victim.0.digest();
    for _ in 0..100 {
        let outputs = victim.hear_entry(first(2, 1));
        assert!(outputs.is_empty(), "{outputs:?}");
    }
    assert_eq!(victim.0.digest(), digest);
    let seen = |victim: &Victim| {
        let poses = victim.0.snapshot(Instant::ZERO).poses;
        poses.robots.iter().find(|robot| robot.robot == "gamma").map(|robot| robot.stamp_secs)
    };
    victim.hear(Channel::Pose, beacon(2, "test", 7));
    assert_eq!(seen(&victim), Some(7.0));
    victim.hear(Channel::Pose, beacon(2, "test", 6));
    assert_eq!(seen(&victim), Some(7.0), "an old pose does not come back");
}

#[test]
fn the_future_waits_or_is_carried() {
    let mut victim = Victim::new();
    // Of entries far ahead nothing is stored, shown or answered for; only a bounded number waits.
    let last = EntryId { frame: FrameId { robot: robot(2), epoch: 1 }, seq: 11 };
    let far = EntryContent { id: last, ..content(2, 1, 0, Hash::of(b"unknown")) };
    assert!(!stored(&victim.hear_entry(sign(2, far.clone()))));
    let beyond = EntryContent { id: EntryId { seq: 12, ..last }, ..far };
    assert!(!stored(&victim.hear_entry(sign(2, beyond))));
    assert_eq!((victim.refused("seq_limit"), victim.0.heads().count()), (1, 0));
    // A kind that only newer robots know is kept for them.
    let newer = EntryContent { kind: 200, payload: vec![1, 2, 3], ..content(2, 2, 0, Hash::default()) };
    victim.keep(sign(2, newer));
    assert_eq!((victim.0.status().entries, victim.refused("unknown_fact")), (1, 1));
    // The last epoch but one may begin; the last of all may not. Of more epochs than are held the oldest goes.
    assert!(!stored(&victim.hear_entry(first(2, u32::MAX))));
    victim.keep(first(2, u32::MAX - 1));
    let oldest = victim.0.heads().map(|(frame, _)| frame).find(|frame| frame.robot == robot(2));
    victim.keep(first(2, 9));
    victim.keep(first(2, 10));
    assert!(oldest.is_some() && victim.0.heads().all(|(frame, _)| Some(frame) != oldest));
    assert_eq!((victim.0.heads().count(), victim.refused("epoch_limit")), (3, 1));
}

#[test]
fn a_closed_epoch_stays_closed() {
    let mut victim = Victim::new();
    victim.keep(first(0, 1)); // Its own past, which its store lost.
    assert_eq!(victim.0.frame().epoch, 2);
    victim.give(Input::Command(Command::NewEpoch));
    assert_eq!(victim.0.frame().epoch, 3);
    // More of the closed epochs comes: history, which is not gone on with.
    victim.keep(sign(0, content(0, 1, 1, Hash::of(&first(0, 1)))));
    victim.keep(first(0, 2));
    assert_eq!(victim.0.frame().epoch, 3);
    // Another story of a closed epoch takes that epoch away, and no other.
    let other = EntryContent { kind: 99, ..content(0, 1, 1, Hash::of(&first(0, 1))) };
    let _ = victim.hear_entry(sign(0, other));
    assert_eq!(victim.refused("fork"), 1);
    assert_eq!((victim.0.frame().epoch, victim.0.status().entries), (3, 1));
    assert!(!stored(&victim.hear_entry(sign(0, content(0, 1, 2, Hash::of(b"more"))))));
    assert_eq!(victim.refused("quarantined"), 1);
}

#[test]
fn a_piece_beyond_the_end_of_a_blob_is_not_to_be_had() {
    let blob = described().0.clone();
    let (hash, len) = (Hash::of(&blob), blob.len() as u32);
    let records = vec![Record::Blob { hash, bytes: blob }];
    let mut victim = Victim(agent(0, Restored { records, fresh_epoch: 1 }, Instant::ZERO));
    let mut piece = |offset, wanted| {
        let bytes = Message::BlobRequest { hash, offset, len: wanted }.encode();
        let outputs = victim.give(Input::Asked { token: AskToken(1), kind: QueryKind::Blob, bytes });
        let answer = outputs.into_iter().find_map(|output| match output {
            Output::Answer { bytes, .. } => Some(bytes),
            _ => None,
        });
        // "I cannot" is empty; all else must be readable.
        let answer = answer.filter(|bytes| !bytes.is_empty())?;
        let Message::BlobReply { bytes, .. } = Message::decode(&answer).unwrap() else { panic!("no piece") };
        Some(bytes.len() as u32)
    };
    assert_eq!(piece(0, u32::MAX), Some(len));
    // What begins or ends between two steps cannot be proved.
    assert_eq!((piece(1, u32::MAX), piece(0, len - 1), piece(len, 9)), (None, None, None));
    assert_eq!((piece(len + 1, 9), piece(u32::MAX, u32::MAX)), (None, None));
}

#[test]
fn a_clock_at_the_end_of_time_starts_no_storm() {
    let mut victim = Victim::new();
    victim.give(Input::Neighbour { robot: robot(1), up: true });
    let root = HaveRoot { root: [7; 8], count: 9 };
    let have = || Input::Received { from: robot(1), channel: Channel::Have, bytes: Message::Have(root).encode() };
    let mut said = 0;
    for now in [u64::MAX - 1, u64::MAX, 0].into_iter().cycle().take(300) {
        victim.0.handle(Instant::from_nanos(now), have());
        let outputs = std::iter::from_fn(|| victim.0.poll_output()).take(1000);
        said += outputs.filter(|o| matches!(o, Output::Publish { .. } | Output::Ask { .. })).count();
    }
    assert!((1..=4).contains(&said), "{said} messages in one moment");
}

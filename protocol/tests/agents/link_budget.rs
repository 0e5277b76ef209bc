//! A slow link (DESIGN §4): whatever two robots have to tell each other, no second carries more than the budget allows,
//! poses keep their pace, facts come before blobs, and in the end all has come.

use super::common::{Wires, World, drive};
use ed25519_dalek::SigningKey;
use merganser_protocol::agent::io::{AskToken, Command, Input, Output, QueryKind, Record};
use merganser_protocol::agent::{Agent, Restored};
use merganser_protocol::config::Config;
use merganser_protocol::gossip::{PIECE_BYTES_MIN, burst_bytes};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name};
use merganser_protocol::snapshot::StatsView;
use merganser_protocol::time::Instant;
use merganser_protocol::wire::messages::Message;
use merganser_protocol::wire::{Entry, EntryContent, SwarmTag};
use std::time::Duration;

const RATE: f64 = 4_000.0;
/// Entries that alpha holds and beta lacks, and the payload of each.
const HISTORY: u32 = 300;
const PAYLOAD: usize = 300;
/// An overdraft: the largest message that goes as a whole.
const MESSAGE_MAX: f64 = 4_096.0;

fn slow() -> Config {
    let mut config = super::common::config();
    config.submap.keypoints = 1024;
    config.gossip.link_bytes_per_sec = RATE;
    config
}

/// A log of alpha's, of a kind that nobody knows.
fn history(len: u32) -> Vec<Record> {
    let frame = FrameId { robot: super::common::robot(0), epoch: 3 };
    let swarm = SwarmTag::of(&Name::new("test").unwrap());
    let mut previous = Hash::default();
    let entry = |seq| {
        let id = EntryId { frame, seq };
        let payload = vec![seq as u8; PAYLOAD];
        let content = EntryContent { swarm, id, kind: 99, floor: 0, previous, payload };
        let entry = Entry::sign(&SigningKey::from_bytes(&super::common::secret(0)), content).unwrap();
        previous = entry.hash();
        Record::Entry { id, bytes: entry.encode() }
    };
    (0..len).map(entry).collect()
}

/// Alpha with a history and beta without one; both have driven, and want each other's blobs.
fn two(config: &Config) -> Wires {
    let agent = |k, records| {
        let restored = Restored { records, fresh_epoch: 3 };
        Agent::new(config.clone(), super::common::identity(k), 42, restored, Instant::ZERO).unwrap()
    };
    let mut wires = Wires::new(vec![agent(0, history(HISTORY)), agent(1, Vec::new())]);
    let world = World::new(1);
    for k in 0..2 {
        drive(&world, k, 12).0.into_iter().for_each(|keyframe| wires.input(k, Input::Keyframe(keyframe)));
        wires.input(k, Input::Command(Command::Flush));
    }
    wires
}

fn stats(wires: &Wires, k: usize) -> StatsView {
    wires.agents[k].snapshot(wires.now).stats
}

fn total(stats: &StatsView) -> f64 {
    stats.sent_bytes.values().sum::<u64>() as f64
}

#[test]
fn on_a_slow_link_poses_keep_their_pace_facts_come_first_and_no_second_carries_too_much() {
    let mut wires = two(&slow());
    let mut seen = vec![[stats(&wires, 0), stats(&wires, 1)]];
    let mut equal_at = None;
    for second in 1..=240 {
        wires.run(Duration::from_secs(1));
        seen.push([stats(&wires, 0), stats(&wires, 1)]);
        if equal_at.is_none() && wires.agents[0].digest() == wires.agents[1].digest() {
            equal_at = Some(second);
        }
    }
    // The history, entries with their signatures, takes 35 s of the link.
    let equal_at: usize = equal_at.unwrap();
    assert!((20..90).contains(&equal_at), "facts were equal after {equal_at} s");
    let sent = |k: usize, second: usize, kind: &str| seen[second][k].sent_bytes.get(kind).copied().unwrap_or(0);
    let (repair, blobs) = (sent(0, equal_at, "sync"), sent(0, equal_at, "blob"));
    assert!(10 * blobs < repair, "{blobs} B of blobs went before {repair} B of facts");
    assert!(wires.agents.iter().all(|agent| agent.status().idle), "the blobs came in the end");
    for k in 0..2 {
        for from in 0..seen.len() {
            for to in from + 1..seen.len() {
                let bytes = total(&seen[to][k]) - total(&seen[from][k]);
                let allowed = RATE * (to - from) as f64 + burst_bytes(RATE) + MESSAGE_MAX;
                assert!(bytes <= allowed, "robot {k} sent {bytes} B from {from} to {to} s: {allowed} are allowed");
            }
        }
        let poses = |second: usize| seen[second][k].sent_messages.get("pose").copied().unwrap_or(0);
        for second in 0..seen.len() - 10 {
            let ten = poses(second + 10) - poses(second);
            // They stand: what is no news is told every 1.25 s.
            assert!((7..=9).contains(&ten), "robot {k}: {ten} poses in ten seconds from {second}");
        }
    }
    let held = stats(&wires, 0).held_back;
    assert!(held.contains_key("repair") && held.contains_key("blob"), "{held:?}");
}

#[test]
fn on_a_usual_link_nothing_is_held_back() {
    let mut config = slow();
    config.gossip.link_bytes_per_sec = Config::default().gossip.link_bytes_per_sec;
    let mut wires = two(&config);
    wires.run(Duration::from_secs(20));
    assert_eq!(wires.agents[0].digest(), wires.agents[1].digest());
    for k in 0..2 {
        assert!(stats(&wires, k).held_back.is_empty(), "{:?}", stats(&wires, k).held_back);
    }
}

/// All that is asked of an agent at one moment.
fn ask(agent: &mut Agent, now: Instant, kind: QueryKind, message: &Message) -> Option<Message> {
    agent.handle(now, Input::Asked { token: AskToken(1), kind, bytes: message.encode() });
    let mut answer = None;
    while let Some(output) = agent.poll_output() {
        if let Output::Answer { bytes, .. } = output {
            answer = Some(bytes);
        }
    }
    let bytes = answer.unwrap();
    (!bytes.is_empty()).then(|| Message::decode(&bytes).unwrap())
}

#[test]
fn whoever_asks_without_end_gets_no_more_than_there_is_room_for_and_silences_nothing_above() {
    let mut first = Wires::new(vec![
        Agent::new(slow(), super::common::identity(0), 42, Restored::default(), Instant::ZERO).unwrap(),
    ]);
    drive(&World::new(1), 0, 12).0.into_iter().for_each(|keyframe| first.input(0, Input::Keyframe(keyframe)));
    let records = first.disks.remove(0);
    let blobs = records.iter().filter_map(|record| match record {
        Record::Blob { bytes, .. } => Some(bytes.clone()),
        _ => None,
    });
    let blob = blobs.max_by_key(Vec::len).unwrap();
    assert!(blob.len() as f64 > burst_bytes(RATE));
    let restored = Restored { records, fresh_epoch: 3 };
    let mut agent = Agent::new(slow(), super::common::identity(0), 42, restored, Instant::ZERO).unwrap();
    agent.handle(Instant::ZERO, Input::Neighbour { robot: super::common::robot(1), up: true });
    let request = Message::BlobRequest { hash: Hash::of(&blob), offset: 0, len: 16_384 };
    let mut lens = Vec::new();
    for _ in 0..100 {
        match ask(&mut agent, Instant::ZERO, QueryKind::Blob, &request) {
            Some(Message::BlobReply { bytes, total, .. }) => {
                assert_eq!(total as usize, blob.len());
                lens.push(bytes.len());
            }
            other => panic!("{other:?}"),
        }
    }
    assert!(lens[0] >= PIECE_BYTES_MIN && lens[1..].iter().all(|len| *len == 0), "{lens:?}");
    assert!(lens[0] as f64 <= burst_bytes(RATE));
    assert_eq!(agent.snapshot(Instant::ZERO).stats.held_back["blob"], 99);
    let soon = Instant::ZERO.after(Duration::from_secs(1));
    let Some(Message::BlobReply { bytes, .. }) = ask(&mut agent, soon, QueryKind::Blob, &request) else { panic!() };
    assert!(bytes.len() >= PIECE_BYTES_MIN && bytes.len() as f64 <= RATE, "{}", bytes.len());
}

#[test]
fn a_budget_that_poses_alone_would_use_up_is_refused() {
    let good = |rate, pose_secs| {
        let mut config = Config::default();
        (config.gossip.link_bytes_per_sec, config.gossip.pose_secs) = (rate, pose_secs);
        config.validate().is_ok()
    };
    assert!(good(2_000.0, 0.5) && !good(1_999.0, 0.5));
    assert!(good(32_000.0, 0.01) && !good(31_999.0, 0.01));
    assert!(good(1e9, 0.5) && !good(1.1e9, 0.5) && !good(f64::NAN, 0.5));
}

//! A long log is replaced by what still counts of it, and nobody notices but by the bytes.

use super::common::{Wires, World, config, drive, identity, robot};
use merganser_protocol::agent::io::{Command, Event, Input, Record};
use merganser_protocol::agent::{Agent, Restored};
use merganser_protocol::ids::Hash;
use merganser_protocol::submap::Keypoints;
use merganser_protocol::time::Instant;
use std::collections::BTreeSet;
use std::time::Duration;

/// Keyframes that one robot drives.
const KEYFRAMES: usize = 54;
/// Those of the first robot in fog: what it sees there, nothing can be aligned with.
const FOG: core::ops::Range<usize> = 9..30;

fn agent(k: usize, condense_entries: u32, records: Vec<Record>) -> Agent {
    let mut config = config();
    config.submap.distance_m = 1.0;
    config.gossip.condense_entries = condense_entries;
    Agent::new(config, identity(k), 42 + k as u64, Restored { records, fresh_epoch: 3 }, Instant::ZERO).unwrap()
}

fn swarm(condense_entries: u32) -> Wires {
    let world = World::new(1);
    let mut wires = Wires::new((0..2).map(|k| agent(k, condense_entries, vec![])).collect());
    for k in 0..2 {
        for (n, mut keyframe) in drive(&world, k, KEYFRAMES).0.into_iter().enumerate() {
            if k == 0 && FOG.contains(&n) {
                keyframe.points.truncate(20);
            }
            wires.input(k, Input::Keyframe(keyframe));
            wires.run(Duration::from_millis(300));
        }
        wires.input(k, Input::Command(Command::Flush));
    }
    wires.run(Duration::from_secs(20));
    wires
}

fn condensed(wires: &Wires) -> Vec<[usize; 2]> {
    let bytes = |(_, event): &(usize, Event)| match event {
        Event::Condensed { bytes, .. } => Some(*bytes),
        _ => None,
    };
    wires.events.iter().filter_map(bytes).collect()
}

#[test]
fn the_map_stays_and_the_bytes_go() {
    let (whole, short) = (swarm(0), swarm(12));
    assert!(condensed(&whole).is_empty());
    let bytes = condensed(&short);
    assert!(!bytes.is_empty() && bytes.iter().all(|[before, after]| 4 * after <= 3 * before), "{bytes:?}");
    assert_eq!(short.agents[0].digest(), short.agents[1].digest());
    let merged = |wires: &Wires| wires.agents.iter().all(|agent| agent.status().merged_with.len() == 1);
    assert!(merged(&whole) && merged(&short));
    // Other keyframes were aligned at other times, so the two maps are not equal: they agree as far as they say.
    let map = |wires: &Wires| wires.agents[0].snapshot(wires.now).map.submaps;
    let (whole_map, short_map) = (map(&whole), map(&short));
    assert!(short_map.len() < whole_map.len(), "{} of {}", short_map.len(), whole_map.len());
    for submap in &short_map {
        let same = whole_map.iter().find(|s| (&s.frame, s.index) == (&submap.frame, submap.index)).unwrap();
        let (x, y) = (same.t_own_anchor.as_ref().unwrap(), submap.t_own_anchor.as_ref().unwrap());
        let apart = |k: usize| (x.pose.translation[k] - y.pose.translation[k]).abs();
        for k in 0..3 {
            assert!(apart(k) <= 4.0 * (x.sigmas[k] + y.sigmas[k]), "{}#{}: {}", submap.frame, submap.index, apart(k));
        }
    }
    for (k, agent) in short.agents.iter().enumerate() {
        let snapshot = agent.snapshot(short.now);
        let own = short.events.iter().filter(|(of, _)| *of == k);
        let bytes =
            own.filter_map(|(_, event)| if let Event::Condensed { bytes, .. } = event { Some(*bytes) } else { None });
        let sums = bytes.fold([0, 0], |sum, [before, after]| [sum[0] + before as u64, sum[1] + after as u64]);
        let told = snapshot.stats.condensed_bytes;
        assert_eq!([told.before, told.after], sums);
        // The other robot by this one, as each sees it.
        let [own, other] = &snapshot.poses.robots[..] else { panic!("{:?}", snapshot.poses.robots) };
        let [pair] = &snapshot.poses.pairs[..] else { panic!("{:?}", snapshot.poses) };
        assert_eq!((&pair.a, &pair.b), (&own.robot, &other.robot));
        assert!(pair.t_a_b.sigmas.iter().all(|sigma| (1e-4..1.0).contains(sigma)), "{:?}", pair.t_a_b);
        assert!(snapshot.graph.converged && snapshot.graph.failed.is_empty());
        let silent =
            |edge: &&merganser_protocol::snapshot::EdgeView| edge.weight < 1.0 - 1e-9 && edge.reason.is_empty();
        assert_eq!(snapshot.graph.edges.iter().find(silent), None);
    }
    for disk in &short.disks {
        // Of every submap that is left its keypoints and, where these go on, the further ones; of what is gone nothing.
        let own = disk.iter().filter(|record| matches!(record, Record::Private { .. })).count();
        let blob = |record: &Record| if let Record::Blob { bytes, .. } = record { Some(bytes.clone()) } else { None };
        let blobs: Vec<Vec<u8>> = disk.iter().filter_map(blob).collect();
        let named: BTreeSet<Hash> = blobs.iter().filter_map(|bytes| Keypoints::address_in(bytes)).collect();
        let (further, first): (Vec<Hash>, Vec<Hash>) =
            blobs.iter().map(|bytes| Hash::of(bytes)).partition(|hash| named.contains(hash));
        assert_eq!((first.len(), further.len()), (own, named.len()));
        assert!(!named.is_empty());
    }
    // What a late joiner fetches, what a restart reads.
    let entries = |wires: &Wires| {
        let len = |record: &Record| if let Record::Entry { bytes, .. } = record { bytes.len() } else { 0 };
        wires.disks[0].iter().map(len).sum::<usize>()
    };
    println!("entries on disk: {} bytes whole, {} condensed", entries(&whole), entries(&short));
    assert!(entries(&short) < entries(&whole), "what was written since the last time comes on top");
}

#[test]
fn a_restart_and_a_late_joiner_find_the_same() {
    let wires = swarm(12);
    let again = agent(0, 12, wires.disks[0].clone());
    assert_eq!(again.digest(), wires.agents[0].digest());
    assert_eq!(again.frame(), wires.agents[0].frame());
    let submaps = |agent: &Agent| agent.snapshot(Instant::ZERO).map.submaps.len();
    assert_eq!(submaps(&again), submaps(&wires.agents[0]));

    // The second life writes on in the same log; the third robot has nothing, and was never there.
    let other = agent(1, 12, wires.disks[1].clone());
    let mut wires = Wires::new(vec![again, other, agent(2, 12, vec![])]);
    wires.run(Duration::from_secs(20));
    let digest = wires.agents[0].digest();
    assert_eq!(wires.agents[2].digest(), digest);
    let extra = drive(&World::new(1), 0, KEYFRAMES + 6).0.split_off(KEYFRAMES);
    extra.into_iter().for_each(|keyframe| wires.input(0, Input::Keyframe(keyframe)));
    wires.input(0, Input::Command(Command::Flush));
    wires.run(Duration::from_secs(20));
    assert_ne!(wires.agents[0].digest(), digest);
    assert!(wires.agents.iter().all(|agent| agent.digest() == wires.agents[0].digest()));
    let rejected: Vec<_> = wires.events.iter().filter(|(_, e)| matches!(e, Event::Rejected { .. })).collect();
    assert!(rejected.is_empty(), "{rejected:?}");
    assert_eq!(wires.agents[2].status().merged_with.len(), 0, "it has driven nowhere");
    assert!(wires.agents[1].snapshot(wires.now).map.submaps.iter().any(|s| s.robot == robot_name(&robot(0))));
}

fn robot_name(robot: &merganser_protocol::ids::RobotId) -> String {
    (0..3).find(|k| super::common::robot(*k) == *robot).map(|k| super::common::NAMES[k].to_owned()).unwrap()
}

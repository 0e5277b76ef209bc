//! What a robot remembers over a restart besides its facts: which run of the front end its epoch is of, and which pairs
//! it tried in vain.

use super::common::{Wires, World, config, drive, identity};
use merganser_protocol::agent::io::{Command, EpochReason, Event, Input, Record};
use merganser_protocol::agent::{Agent, REFUSED_WAITING_MAX, Restored};
use merganser_protocol::config::Config;
use merganser_protocol::ids::SubmapId;
use merganser_protocol::submap::Keyframe;
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::Entry;
use merganser_protocol::wire::fact::Fact;
use std::collections::BTreeSet;
use std::time::Duration;

const FIRST_EPOCH: u32 = 2;

fn started(k: usize, config: &Config, records: Vec<Record>) -> Agent {
    let restored = Restored { records, fresh_epoch: FIRST_EPOCH };
    Agent::new(config.clone(), identity(k), 42 + k as u64, restored, Instant::ZERO).unwrap()
}

/// A run of alpha alone.
fn alone(records: Vec<Record>, keyframes: &[Keyframe]) -> Wires {
    let mut wires = Wires::new(vec![started(0, &config(), records.clone())]);
    wires.disks[0] = records;
    for keyframe in keyframes {
        wires.input(0, Input::Keyframe(keyframe.clone()));
        wires.run(Duration::from_secs(1));
    }
    wires.input(0, Input::Command(Command::Flush));
    wires
}

/// A drive from its frame's origin, by a run of the front end, that begins in that second.
fn told_by(session: Option<u64>, from: i64) -> Vec<Keyframe> {
    let keyframes = drive(&World::new(1), 0, 12).0.into_iter();
    keyframes
        .map(|keyframe| Keyframe { session, stamp: Stamp(keyframe.stamp.0 + from * 1_000_000_000), ..keyframe })
        .collect()
}

/// The epoch, why it and others began, and how many keyframes were refused.
fn became(wires: &Wires) -> (u32, Vec<EpochReason>, u64) {
    let reason = |(_, event): &(usize, Event)| match event {
        Event::EpochBegan { reason, .. } => Some(*reason),
        _ => None,
    };
    let rejected = wires.agents[0].snapshot(wires.now).stats.rejected;
    let begun = wires.events.iter().filter_map(reason).collect();
    (wires.agents[0].status().epoch, begun, rejected.get("keyframe").copied().unwrap_or(0))
}

/// Standard deviations of the odometry of all submaps that are not the first of their epochs.
fn sigmas(disk: &[Record]) -> Vec<f64> {
    let sigma = |record: &Record| match record {
        Record::Entry { bytes, .. } => match Entry::decode(bytes).unwrap().fact() {
            Ok(Fact::Submap(fact)) if fact.index > 0 => Some(fact.odometry.covariance.sigmas()[0]),
            _ => None,
        },
        _ => None,
    };
    disk.iter().filter_map(sigma).collect()
}

fn sessions(disk: &[Record]) -> Vec<Record> {
    disk.iter().filter(|record| matches!(record, Record::Session { .. })).cloned().collect()
}

#[test]
fn a_slam_that_starts_again_with_the_agent_begins_an_epoch() {
    for (before, after) in [(1, 2), (2, 1)] {
        let first = alone(vec![], &told_by(Some(before), 0));
        assert_eq!(became(&first), (FIRST_EPOCH, vec![], 0));
        let second = alone(first.disks[0].clone(), &told_by(Some(after), 60));
        assert_eq!(became(&second), (FIRST_EPOCH + 1, vec![EpochReason::Session], 0));
        // No motion is claimed from the old frame to the new one.
        let sigmas = sigmas(&second.disks[0]);
        assert!(sigmas.len() > 2 && sigmas.iter().all(|sigma| *sigma < 0.05), "{sigmas:?}");
        // It is known as well that the run before is over, at once and after another restart.
        let old = &told_by(Some(before), 120)[..1];
        let third = alone(second.disks[0].clone(), &[old, &told_by(Some(after), 180)].concat());
        assert_eq!(became(&third), (FIRST_EPOCH + 1, vec![], 1));
        let kept = |epoch, session, over: &[u64]| Record::Session { epoch, session, over: over.to_vec() };
        let records = [kept(FIRST_EPOCH, before, &[]), kept(FIRST_EPOCH + 1, after, &[before])];
        assert_eq!(sessions(&third.disks[0]), records, "once an epoch");
    }
}

#[test]
fn a_slam_that_goes_on_while_the_agent_starts_again_goes_on() {
    for session in [Some(7), None] {
        let mut keyframes = told_by(session, 0);
        let rest = keyframes.split_off(6);
        let first = alone(vec![], &keyframes);
        let second = alone(first.disks[0].clone(), &rest);
        assert_eq!(became(&second), (FIRST_EPOCH, vec![], 0));
        assert_eq!(sessions(&second.disks[0]).len(), usize::from(session.is_some()));
        assert!(second.agents[0].status().submaps > first.agents[0].status().submaps);
    }
}

#[test]
fn a_session_that_is_named_only_on_one_side_of_a_restart_goes_on() {
    for (before, after) in [(Some(7), None), (None, Some(7))] {
        let first = alone(vec![], &told_by(before, 0)[..6]);
        let second = alone(first.disks[0].clone(), &told_by(after, 0)[6..]);
        assert_eq!(became(&second), (FIRST_EPOCH, vec![], 0));
    }
}

#[test]
fn an_epoch_that_began_otherwise_may_be_of_the_same_run() {
    let mut first = alone(vec![], &told_by(Some(7), 0));
    first.input(0, Input::Command(Command::NewEpoch));
    let second = alone(first.disks[0].clone(), &told_by(Some(7), 60));
    let (epoch, begun, refused) = became(&second);
    assert_eq!((begun, refused), (vec![EpochReason::Log], 0), "the start of the one that was begun before");
    let third = alone(second.disks[0].clone(), &told_by(Some(8), 120));
    assert_eq!(became(&third), (epoch + 1, vec![EpochReason::Session], 0));
}

#[test]
fn a_session_whose_first_keyframe_is_refused_is_not_kept() {
    let mut bad = told_by(Some(7), 0).remove(0);
    bad.points[0][0] = f32::NAN;
    let wires = alone(vec![], &[bad]);
    assert_eq!((became(&wires).2, sessions(&wires.disks[0]).len()), (1, 0));
}

type Pair = (SubmapId, SubmapId);

/// Alpha and beta, who drive in different worlds: no pair can be aligned.
fn strangers(config: &Config) -> Wires {
    let mut wires = Wires::new((0..2).map(|k| started(k, config, vec![])).collect());
    for k in 0..2 {
        drive(&World::new(1 + k as u64), k, 36).0.into_iter().for_each(|it| wires.input(k, Input::Keyframe(it)));
    }
    wires.input(0, Input::Command(Command::Flush));
    wires.input(1, Input::Command(Command::Flush));
    wires.run(Duration::from_secs(60));
    wires
}

/// What was tried in vain is told by frame, count and reason.
fn tells_why(wires: &Wires) {
    let seen = wires.agents[0].snapshot(wires.now);
    let [tries] = &seen.frames.tries[..] else { panic!("{:?}", seen.frames.tries) };
    assert_eq!((tries.found, tries.tried() as usize), (0, tried(wires).len()), "{tries:?}");
    let told = tries.told().unwrap();
    assert!(tries.other.starts_with("beta/") && told.contains("tried and none aligned"), "{told}");
    assert!(seen.frames.pairs.is_empty());
}

/// The two start again.
fn again(config: &Config, disks: &[Vec<Record>]) -> Wires {
    let mut wires = Wires::new((0..2).map(|k| started(k, config, disks[k].clone())).collect());
    wires.disks = disks.to_vec();
    wires.run(Duration::from_secs(60));
    wires
}

/// What alpha tried in vain, each time it did.
fn tried(wires: &Wires) -> Vec<Pair> {
    let tried = |(k, event): &(usize, Event)| match event {
        Event::AlignmentTried { i, j, found: false, .. } if *k == 0 => Some((*i, *j)),
        _ => None,
    };
    wires.events.iter().filter_map(tried).collect()
}

fn refused(disk: &[Record]) -> BTreeSet<Pair> {
    let pair = |record: &Record| match record {
        Record::Refused { i, j, evidence: Some(_) } => Some((*i, *j)),
        _ => None,
    };
    disk.iter().filter_map(pair).collect()
}

fn in_common(a: &[Pair], b: &[Pair]) -> usize {
    a.iter().filter(|pair| b.contains(pair)).count()
}

#[test]
fn a_refused_pair_is_not_tried_again_after_a_restart() {
    let mut first = strangers(&config());
    tells_why(&first);
    let before = tried(&first);
    assert!(before.len() > REFUSED_WAITING_MAX, "{}", before.len());
    // A kill now loses a few of them, but no more.
    let second = again(&config(), &first.disks);
    assert!(in_common(&before, &tried(&second)) < REFUSED_WAITING_MAX);
    // An agent that ends in order keeps all.
    first.input(0, Input::Command(Command::Flush));
    assert_eq!(refused(&first.disks[0]), before.iter().copied().collect());
    let second = again(&config(), &first.disks);
    assert_eq!(in_common(&before, &tried(&second)), 0);
    assert!(second.batches.iter().all(|(k, _, refused)| *k != 0 || *refused == 0), "{:?}", second.batches);
}

#[test]
fn refusals_take_one_record_each_and_few_commits() {
    let wires = strangers(&config());
    let of_alpha: Vec<_> = wires.batches.iter().filter(|(k, ..)| *k == 0).collect();
    let written: usize = of_alpha.iter().map(|(.., refused)| refused).sum();
    let tries = tried(&wires).len();
    assert!(written <= tries && written + REFUSED_WAITING_MAX > tries, "{written} of {tries}");
    let by_themselves = of_alpha.iter().filter(|(_, all, refused)| all == refused);
    assert!(by_themselves.map(|(.., refused)| *refused).all(|refused| refused >= REFUSED_WAITING_MAX), "{of_alpha:?}");
}

#[test]
fn a_refused_pair_is_tried_again_on_new_evidence() {
    let mut first = strangers(&config());
    first.input(0, Input::Command(Command::Flush));
    let before = tried(&first);
    // Other thresholds.
    let mut other = config();
    other.align.fit_min = 0.21;
    assert!(in_common(&before, &tried(&again(&other, &first.disks))) > before.len() / 2);
    // Other submaps under the same ids. What was refused of the old ones leaves the disk.
    let mut disks = first.disks.clone();
    let stale = refused(&disks[0]);
    for record in &mut disks[0] {
        if let Record::Refused { evidence, .. } = record {
            *evidence = evidence.map(|evidence| !evidence);
        }
    }
    let mut second = again(&config(), &disks);
    second.input(0, Input::Command(Command::Flush));
    let after = tried(&second);
    assert!(in_common(&before, &after) > before.len() / 2);
    let held =
        second.disks[0].iter().filter(|record| matches!(record, Record::Refused { .. }) && disks[0].contains(record));
    assert_eq!((held.count(), refused(&second.disks[0])), (0, after.into_iter().collect()), "of {}", stale.len());
}

/// Alpha drives in fog: what it sees is aligned with nothing, and most of it goes when its log is condensed.
#[test]
fn refusals_go_with_the_submaps_that_are_gone() {
    let mut config = config();
    config.submap.distance_m = 0.7;
    config.gossip.condense_entries = 20;
    let mut wires = Wires::new(vec![started(0, &config, vec![])]);
    for mut keyframe in drive(&World::new(1), 0, 54).0 {
        keyframe.points.truncate(40);
        wires.input(0, Input::Keyframe(keyframe));
        wires.run(Duration::from_millis(300));
    }
    wires.input(0, Input::Command(Command::Flush));
    let private = |record: &Record| if let Record::Private { submap, .. } = record { Some(*submap) } else { None };
    let there: BTreeSet<SubmapId> = wires.disks[0].iter().filter_map(private).collect();
    let is_gone = |pair: &Pair| !there.contains(&pair.0) || !there.contains(&pair.1);
    let (tried, refused) = (tried(&wires), refused(&wires.disks[0]));
    assert!(tried.iter().any(is_gone) && !refused.is_empty(), "{tried:?} of {there:?}");
    assert!(!refused.iter().any(is_gone), "{refused:?} of {there:?}");
}

#[test]
fn refusals_of_nobody_known_leave_the_disk_at_a_start() {
    let frame = merganser_protocol::ids::FrameId { robot: super::common::robot(1), epoch: 1 };
    let [i, j] = [0, 1].map(|index| SubmapId { frame, index });
    let records = vec![Record::Refused { i, j, evidence: Some(1) }, Record::Refused { i: j, j: i, evidence: Some(1) }];
    let wires = alone(records, &[]);
    assert_eq!(wires.disks[0], []);
}

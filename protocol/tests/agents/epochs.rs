//! Epochs: what this robot wrote before its store was lost is never written on, and there is an end to them.

use super::common::{Wires, World, agent, drive, name, robot};
use merganser_protocol::agent::io::{Channel, Command, Event, Input, JobId, Output, Record};
use merganser_protocol::agent::job::Job;
use merganser_protocol::agent::{Agent, CLOCK_BACK_KEYFRAMES, Restored};
use merganser_protocol::config::MEMBER_BYTES_MIN;
use merganser_protocol::ids::{EntryId, FrameId, Hash};
use merganser_protocol::replica::{EARLY_PER_ROBOT_MAX, Replica};
use merganser_protocol::submap::Keyframe;
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::fact::{Fact, RefusalReason, VerdictFact, VerdictOutcome};
use merganser_protocol::wire::messages::Message;
use merganser_protocol::wire::{Entry, EntryBytes, EntryContent, SwarmTag};
use std::time::Duration;

fn drain(agent: &mut Agent) -> Vec<Output> {
    std::iter::from_fn(|| agent.poll_output()).collect()
}

/// A fact, one for each number.
fn verdict(seq: u32) -> Fact {
    Fact::Verdict(VerdictFact {
        alignment: EntryId { frame: FrameId { robot: robot(1), epoch: 1 }, seq },
        outcome: VerdictOutcome::Refused(RefusalReason::NoConsensus),
    })
}

/// What alpha wrote into an epoch, and where this begins to differ.
fn past(epoch: u32, facts: impl IntoIterator<Item = u32>) -> Vec<Vec<u8>> {
    let key = ed25519_dalek::SigningKey::from_bytes(&super::common::secret(0));
    let members = [(name(0), super::common::public(0))];
    let mut past = Replica::new(&super::common::identity(0).swarm, members, &super::common::config().gossip).unwrap();
    facts.into_iter().map(|seq| past.append(&key, epoch, &verdict(seq)).unwrap().encode()).collect()
}

/// So many bytes that alpha wrote into an epoch, of a kind that only newer robots know.
fn large_past(epoch: u32, bytes: usize) -> Vec<Vec<u8>> {
    let key = ed25519_dalek::SigningKey::from_bytes(&super::common::secret(0));
    let (swarm, mut previous) = (SwarmTag::of(&super::common::identity(0).swarm), Hash::default());
    let entry = |seq| {
        let id = EntryId { frame: FrameId { robot: robot(0), epoch }, seq };
        let content = EntryContent { swarm, id, kind: 200, floor: 0, previous, payload: vec![7; 1_800] };
        let entry = Entry::sign(&key, content).unwrap();
        previous = entry.hash();
        entry.encode()
    };
    (0..u32::try_from(bytes / 2_000).unwrap()).map(entry).collect()
}

fn hear(wires: &mut Wires, entries: &[Vec<u8>]) {
    let bytes = Message::Facts(entries.iter().cloned().map(EntryBytes).collect()).encode();
    wires.input(0, Input::Received { from: robot(1), channel: Channel::Facts, bytes });
}

/// Alpha's store was lost, and the clock went back.
fn lost() -> Wires {
    Wires::new(vec![agent(0, Restored { records: vec![], fresh_epoch: 2 })])
}

fn is_told(wires: &Wires) -> bool {
    wires.events.iter().any(|(_, event)| matches!(event, Event::ReceiveOnly { .. }))
}

/// Nothing that alpha writes is refused.
fn writes(wires: &mut Wires) {
    let (keyframes, _) = drive(&World::new(1), 0, 8);
    keyframes.into_iter().for_each(|keyframe| wires.input(0, Input::Keyframe(keyframe)));
    wires.input(0, Input::Command(Command::Flush));
    let rejected = wires.agents[0].snapshot(wires.now).stats.rejected;
    assert!(wires.agents[0].status().submaps > 1 && !rejected.contains_key("own fact"), "{rejected:?}");
}

/// Each start of a SLAM is like the second: the oldest epoch goes, here and where it was heard, off the disks too.
#[test]
fn a_robot_that_begins_ever_new_epochs_goes_on_and_gives_up_its_oldest() {
    let (keyframes, _) = drive(&World::new(1), 0, 8);
    let mut config = super::common::config();
    config.gossip.epochs_per_robot_max = 2;
    let pair = [0, 1].map(|n| super::common::agent_of(n, &config));
    let mut wires = Wires::new(pair.into());
    for round in 1..=5_usize {
        keyframes.iter().for_each(|keyframe| wires.input(0, Input::Keyframe(keyframe.clone())));
        wires.input(0, Input::Command(Command::NewEpoch));
        wires.run(Duration::from_secs(5));
        let status = wires.agents[0].status();
        assert_eq!((status.receive_only, status.keyframes), (false, 8 * round as u64));
        for robot in 0..2 {
            assert_eq!(wires.agents[robot].heads().count(), round.min(2), "round {round}, robot {robot}");
            let frames: std::collections::BTreeSet<FrameId> = wires.disks[robot].iter().filter_map(frame_of).collect();
            assert_eq!(frames.len(), round.min(2), "on the disk of {robot}: {frames:?}");
        }
    }
    assert!(!is_told(&wires));
    let gone = |k: usize| {
        let of = |(agent, event): &(usize, Event)| match event {
            Event::EpochsRetired { robot, count, .. } => (*agent == k && robot == "alpha").then_some(*count),
            _ => None,
        };
        wires.events.iter().filter_map(of).collect::<Vec<_>>()
    };
    // The last alignments of the fifth are stated in the sixth.
    assert_eq!((gone(0), gone(1)), (vec![1; 4], vec![1; 4]));
    assert_eq!(wires.agents[0].digest(), wires.agents[1].digest());
    // A restart finds what was left.
    let records = wires.disks[1].clone();
    let beta = Agent::new(config, super::common::identity(1), 0, Restored { records, fresh_epoch: 2 }, wires.now);
    assert_eq!(beta.unwrap().digest(), wires.agents[0].digest());
}

/// The frame that a record belongs to.
fn frame_of(record: &Record) -> Option<FrameId> {
    match record {
        Record::Entry { id, .. } => Some(id.frame),
        Record::Private { submap, .. } => Some(submap.frame),
        Record::Fork { frame, .. } => Some(*frame),
        _ => None,
    }
}

/// What was given up stays so when the log that says it is replaced.
#[test]
fn a_log_that_is_condensed_says_again_what_was_given_up() {
    let (mut keyframes, _) = drive(&World::new(1), 0, 54);
    keyframes.iter_mut().for_each(|keyframe| keyframe.points.truncate(20)); // fog: nothing ties submaps to one another
    let mut config = super::common::config();
    config.submap.distance_m = 1.0;
    config.gossip.condense_entries = 12;
    config.gossip.facts_bytes_max = MEMBER_BYTES_MIN * super::common::identity(0).roster.len();
    let mut wires = Wires::new(vec![super::common::agent_of(0, &config)]);
    hear(&mut wires, &large_past(0, MEMBER_BYTES_MIN / 5 * 4));
    for keyframe in &keyframes {
        wires.input(0, Input::Keyframe(keyframe.clone()));
        wires.run(Duration::from_secs(1));
    }
    assert!(wires.events.iter().any(|(_, event)| matches!(event, Event::Condensed { .. })), "{:?}", wires.events);
    let retired = |record: &Record| match record {
        Record::Entry { bytes, .. } => matches!(Entry::decode(bytes).unwrap().fact(), Ok(Fact::Retired(_))),
        _ => false,
    };
    assert_eq!(wires.disks[0].iter().filter(|record| retired(record)).count(), 1);
}

#[test]
fn no_epoch_comes_after_the_last() {
    let mut agent = agent(0, Restored { records: vec![], fresh_epoch: u32::MAX - 2 });
    let mut status = || {
        agent.handle(Instant::ZERO, Input::Command(Command::NewEpoch));
        let is_told = drain(&mut agent).iter().any(|output| matches!(output, Output::Event(Event::ReceiveOnly { .. })));
        (agent.frame().epoch, agent.status().receive_only, is_told)
    };
    assert_eq!(status(), (u32::MAX - 1, false, false));
    assert_eq!(status(), (u32::MAX, true, true));
}

#[test]
fn the_end_of_an_own_past_whose_beginning_is_yet_to_come_closes_it() {
    let mut wires = lost();
    hear(&mut wires, &past(9, 0..3)[2..]);
    assert_eq!(wires.agents[0].frame().epoch, 10);
    writes(&mut wires);
}

#[test]
fn an_own_past_of_which_too_much_waits_for_its_beginning_closes_it() {
    let mut wires = lost();
    // As many as may wait, of an epoch that is closed by now.
    let waiting = EARLY_PER_ROBOT_MAX as u32;
    hear(&mut wires, &past(1, 0..=waiting)[1..]);
    assert_eq!(wires.agents[0].frame().epoch, 2, "an older one concerns nobody");
    hear(&mut wires, &past(9, 0..=waiting + 1)[waiting as usize + 1..]);
    assert!(wires.agents[0].snapshot(wires.now).stats.rejected.contains_key("too_early"));
    assert_eq!(wires.agents[0].frame().epoch, 10);
    writes(&mut wires);
}

#[test]
fn an_own_past_with_two_histories_is_closed_whoever_proves_it() {
    let frame = FrameId { robot: robot(0), epoch: 9 };
    let proof = [past(9, [0]), past(9, [1])].map(|story| story[0].clone());
    let fork = Record::Fork { frame, proof: proof.clone() };
    // A peer, in the answer to a question.
    let beta = agent(1, Restored { records: vec![fork.clone()], fresh_epoch: 0 });
    let mut wires = Wires::new(vec![lost().agents.remove(0), beta]);
    wires.run(Duration::from_secs(5));
    assert_eq!(wires.agents[0].frame().epoch, 10);
    writes(&mut wires);
    // Our own store.
    wires = Wires::new(vec![agent(0, Restored { records: vec![fork], fresh_epoch: 2 })]);
    assert_eq!(wires.agents[0].frame().epoch, 10);
    writes(&mut wires);
    // Older ones concern nobody.
    wires = Wires::new(vec![agent(0, Restored { records: vec![], fresh_epoch: 12 })]);
    hear(&mut wires, &proof);
    assert_eq!(wires.agents[0].frame().epoch, 12);
}

/// A store was lost, and more of the past comes back than there is room for: what is written is taken by others all the
/// same.
#[test]
fn own_epochs_that_come_back_in_any_number_hinder_nobody() {
    let mut config = super::common::config();
    config.gossip.epochs_per_robot_max = 2;
    let restored = Restored { records: vec![], fresh_epoch: 12 };
    let alpha = Agent::new(config.clone(), super::common::identity(0), 0, restored, Instant::ZERO).unwrap();
    let mut wires = Wires::new(vec![alpha]);
    writes(&mut wires);
    for epoch in 3..8 {
        hear(&mut wires, &past(epoch, 0..2));
    }
    let epoch = wires.agents[0].frame().epoch;
    assert!(epoch == 12 && !is_told(&wires), "{epoch}");
    writes(&mut wires);
    // Who holds as much of the past as there is room for, and nothing of what alpha wrote since.
    let mut records = Vec::new();
    for epoch in [6, 7] {
        let entry =
            |(seq, bytes)| Record::Entry { id: EntryId { frame: FrameId { robot: robot(0), epoch }, seq }, bytes };
        records.extend((0..).zip(past(epoch, 0..2)).map(entry));
    }
    let restored = Restored { records, fresh_epoch: 2 };
    let beta = Agent::new(config, super::common::identity(1), 0, restored, Instant::ZERO).unwrap();
    wires = Wires::new(vec![wires.agents.remove(0), beta]);
    wires.run(Duration::from_secs(20));
    assert_eq!(wires.agents[0].digest(), wires.agents[1].digest());
    assert!(wires.agents[1].heads().any(|(frame, _)| frame.epoch == epoch), "what alpha wrote last");
}

/// Somebody without a key sends what looks like a later past of ours: nobody but we can make us leave our epoch.
#[test]
fn a_past_that_we_did_not_sign_begins_no_epoch() {
    for signed in [false, true] {
        let mut config = super::common::config();
        config.gossip.epochs_per_robot_max = 1;
        let restored = Restored { records: vec![], fresh_epoch: 12 };
        let alpha = Agent::new(config, super::common::identity(0), 0, restored, Instant::ZERO).unwrap();
        let mut wires = Wires::new(vec![alpha]);
        writes(&mut wires);
        let (before, digest) = (wires.agents[0].frame().epoch, wires.agents[0].digest());
        hear(&mut wires, &past(3, 0..1));
        assert_eq!(wires.agents[0].frame().epoch, before, "an older one has no room, and concerns nobody");
        let mut entries = past(30, 0..1);
        if !signed {
            *entries[0].last_mut().unwrap() ^= 1;
        }
        hear(&mut wires, &entries);
        assert_eq!(wires.agents[0].frame().epoch > before, signed);
        assert_eq!(wires.agents[0].digest() == digest, !signed);
    }
}

#[test]
fn of_a_submap_that_cannot_be_stated_nothing_is_kept() {
    let mut alpha = agent(0, Restored { records: vec![], fresh_epoch: 2 });
    let (keyframes, _) = drive(&World::new(1), 0, 8);
    keyframes.into_iter().for_each(|keyframe| alpha.handle(Instant::ZERO, Input::Keyframe(keyframe)));
    let run = drain(&mut alpha).into_iter().find_map(|output| match output {
        Output::Run { id, job } if job.kind() == "describe" => Some((id, job)),
        _ => None,
    });
    let (job, run) = run.unwrap();
    // While it is described, a later epoch of ours comes back.
    let bytes = Message::Facts(past(9, 0..1).into_iter().map(EntryBytes).collect()).encode();
    alpha.handle(Instant::ZERO, Input::Received { from: robot(1), channel: Channel::Facts, bytes });
    drain(&mut alpha);
    alpha.handle(Instant::ZERO, Input::JobDone { job, result: run.run() });
    let outputs = drain(&mut alpha);
    let keeps =
        |output: &Output| matches!(output, Output::Persist { .. } | Output::Event(Event::SubmapFinished { .. }));
    assert!(!outputs.iter().any(keeps), "{outputs:?}");
    assert_eq!(alpha.status().submaps, 0);
    assert!(alpha.snapshot(Instant::ZERO).stats.rejected.contains_key("own fact"));
}

/// A SLAM that starts again and again does so while the last submaps of the run before are still described: what is
/// measured meanwhile does not cut them off.
#[test]
fn what_is_stated_while_the_last_epoch_is_described_closes_it_not() {
    let world = World::new(1);
    let mut wires = Wires::new([0, 1].map(|n| agent(n, Restored { records: vec![], fresh_epoch: 2 })).into());
    drive(&world, 1, 16).0.into_iter().for_each(|keyframe| wires.input(1, Input::Keyframe(keyframe)));
    wires.input(1, Input::Command(Command::Flush));
    drive(&world, 0, 20).0.into_iter().for_each(|keyframe| wires.input(0, Input::Keyframe(keyframe)));
    wires.hold = &["align", "describe"];
    wires.run(Duration::from_secs(30));
    wires.input(0, Input::Command(Command::NewEpoch));
    let jobs = ["align", "describe"].map(|kind| {
        let of_alpha = |(k, _, job): &(usize, JobId, Job)| *k == 0 && job.kind() == kind;
        let place = wires.held.iter().position(of_alpha).expect(kind);
        wires.held.remove(place)
    });
    let entries = wires.agents[0].status().entries;
    for (_, job, run) in jobs {
        wires.input(0, Input::JobDone { job, result: run.run() });
    }
    let heads: Vec<FrameId> = wires.agents[0].heads().map(|(frame, _)| frame).filter(|f| f.robot == robot(0)).collect();
    let rejected = wires.agents[0].snapshot(wires.now).stats.rejected;
    assert_eq!((heads, rejected.contains_key("own fact")), (vec![FrameId { robot: robot(0), epoch: 2 }], false));
    assert_eq!(wires.agents[0].frame().epoch, 3);
    assert_eq!(wires.agents[0].status().entries, entries + 2, "the alignment, and the submap after it");
}

/// Alpha, after a drive and a step of its clock by so many seconds, drives on. Keyframes come so far apart.
fn after_a_step(secs: i64, apart: Duration) -> Wires {
    let (keyframes, _) = drive(&World::new(1), 0, 19);
    let mut wires = Wires::new(vec![agent(0, Restored { records: vec![], fresh_epoch: 2 })]);
    for (k, keyframe) in keyframes.into_iter().enumerate() {
        let stamp = Stamp(keyframe.stamp.0 + i64::from(k >= 4) * secs * 1_000_000_000);
        wires.input(0, Input::Keyframe(Keyframe { stamp, ..keyframe }));
        wires.run(apart);
    }
    wires
}

#[test]
fn a_clock_that_goes_back_for_good_begins_a_new_epoch() {
    let status = |secs, apart| {
        let status = after_a_step(secs, apart).agents[0].status();
        (status.epoch, status.keyframes)
    };
    let (slow, fast) = (Duration::from_secs(2), Duration::from_millis(100));
    let refused = u64::from(CLOCK_BACK_KEYFRAMES);
    assert_eq!(status(-3600, slow), (3, 19 - refused));
    assert_eq!(status(3600, slow), (2, 19), "forth is no matter");
    assert_eq!(status(-3600, fast), (2, 4), "what is late comes all at once");
    let late = Duration::from_secs_f64(10.0 / f64::from(CLOCK_BACK_KEYFRAMES));
    assert_eq!(status(-3600, late), (3, 19 - refused - 1), "ten seconds are asked for, too");
}

#[test]
fn keyframes_that_come_late_between_others_begin_no_epoch() {
    let (keyframes, _) = drive(&World::new(1), 0, 19);
    let mut wires = Wires::new(vec![agent(0, Restored { records: vec![], fresh_epoch: 2 })]);
    for (k, keyframe) in keyframes.iter().enumerate() {
        wires.input(0, Input::Keyframe(keyframe.clone()));
        wires.input(0, Input::Keyframe(keyframes[k.saturating_sub(3)].clone()));
        wires.run(Duration::from_secs(2));
    }
    let status = wires.agents[0].status();
    assert_eq!((status.epoch, status.keyframes), (2, 19));
}

//! A pair that was refused although the map has it overlap is looked at once more with further keypoints, by both ends;
//! what contradicts the map, or joins what the map does not, is no alignment.

use super::common::{Wires, World, agent_of, config, drive, robot};
use merganser_protocol::agent::Restored;
use merganser_protocol::agent::io::{AskToken, Event, Input, Output, QueryKind, Record};
use merganser_protocol::agent::job::{AlignJob, Job, JobResult, Measured, NotAligned};
use merganser_protocol::geometry::{Relative, Se3};
use merganser_protocol::ids::{EntryId, Hash, SubmapId};
use merganser_protocol::submap::Keypoints;
use merganser_protocol::wire::Message;
use merganser_protocol::wire::entry::Entry;
use merganser_protocol::wire::fact::{AlignmentFact, Fact, RefusalReason, VerdictFact, VerdictOutcome};
use nalgebra::Vector3;
use std::collections::{BTreeMap, BTreeSet};
use std::time::Duration;

/// Two robots on a circle, of whom the second saw what the first did; every look is answered so.
fn driven(answers: impl Fn(&AlignJob) -> Option<Result<Box<Measured>, NotAligned>> + 'static) -> Wires {
    driven_without(answers, |_, _| false)
}

/// The same, where answers are lost.
fn driven_without(
    answers: impl Fn(&AlignJob) -> Option<Result<Box<Measured>, NotAligned>> + 'static,
    lost: impl Fn(usize, &[u8]) -> bool + 'static,
) -> Wires {
    let world = World::new(1);
    let mut wires = Wires::new((0..2).map(|k| agent_of(k, &config())).collect());
    wires.answers = Box::new(answers);
    wires.lost = Box::new(lost);
    let runs: Vec<_> = (0..2).map(|k| drive(&world, k, 50).0).collect();
    for n in 0..50 {
        for (k, keyframes) in runs.iter().enumerate() {
            wires.input(k, Input::Keyframe(keyframes[n].clone()));
        }
        wires.run(Duration::from_secs(2));
    }
    wires.run(Duration::from_secs(60));
    wires
}

/// A first look, at keypoints that say where they go on.
fn is_first(job: &AlignJob) -> bool {
    job.theirs.further().is_some()
}

/// Every fourth pair is refused at first sight, by whom it may concern.
fn some_refused(job: &AlignJob) -> Option<Result<Box<Measured>, NotAligned>> {
    (is_first(job) && job.seed.is_multiple_of(4)).then_some(Err(RefusalReason::NoConsensus.into()))
}

fn run(job: &AlignJob) -> Result<Box<Measured>, NotAligned> {
    match Job::Align(Box::new(job.clone())).run() {
        JobResult::Aligned(answer) => answer,
        other => panic!("{other:?}"),
    }
}

fn facts(wires: &Wires) -> BTreeMap<EntryId, Fact> {
    let fact = |record: &Record| match record {
        Record::Entry { id, bytes } => Some((*id, Entry::decode(bytes).unwrap().fact().unwrap())),
        _ => None,
    };
    wires.disks[0].iter().filter_map(fact).collect()
}

/// Where the keypoints of each submap are, and where they go on.
fn blobs(wires: &Wires, facts: &BTreeMap<EntryId, Fact>) -> BTreeMap<SubmapId, [Hash; 2]> {
    let held: BTreeMap<Hash, &Vec<u8>> = wires
        .disks
        .iter()
        .flatten()
        .filter_map(|record| if let Record::Blob { hash, bytes } = record { Some((*hash, bytes)) } else { None })
        .collect();
    let of = |(id, fact): (&EntryId, &Fact)| {
        let Fact::Submap(fact) = fact else { return None };
        let further = Keypoints::address_in(held[&fact.blob]).unwrap();
        assert!(held.contains_key(&further), "it is on the disk as well");
        Some((SubmapId { frame: id.frame, index: fact.index }, [fact.blob, further]))
    };
    facts.iter().filter_map(of).collect()
}

/// Alignments that say that further keypoints were used.
fn further_used(wires: &Wires) -> Vec<(EntryId, AlignmentFact)> {
    let facts = facts(wires);
    let blobs = blobs(wires, &facts);
    let alignments =
        facts.iter().filter_map(|(id, fact)| if let Fact::Alignment(fact) = fact { Some((*id, fact)) } else { None });
    let used = alignments.filter(|(id, fact)| {
        let kinds = [(fact.i, fact.blobs[0]), (fact.j, fact.blobs[1])]
            .map(|(submap, blob)| blobs[&submap].iter().position(|one| *one == blob).unwrap());
        // Never those of the writer's own submap, of which it has all points.
        let own = usize::from(fact.j.frame.robot == id.frame.robot);
        assert!(fact.i.frame == fact.j.frame || kinds[own] == 0, "{kinds:?}");
        kinds.contains(&1)
    });
    used.map(|(id, fact)| (id, fact.clone())).collect()
}

fn looked_again(wires: &Wires) -> Vec<(SubmapId, SubmapId, bool)> {
    let look = |(_, event): &(usize, Event)| match event {
        Event::LookedAgain { i, j, found } => Some((*i, *j, *found)),
        _ => None,
    };
    wires.events.iter().filter_map(look).collect()
}

#[test]
fn what_should_have_been_found_is_looked_at_again_by_both_ends() {
    let wires = driven(some_refused);
    let looks = looked_again(&wires);
    let pairs: BTreeSet<_> = looks.iter().map(|(i, j, _)| (*i, *j)).collect();
    assert_eq!(pairs.len(), looks.len(), "once each");
    let between = looks.iter().filter(|(i, j, found)| i.frame != j.frame && *found).count();
    let within = looks.iter().filter(|(i, j, found)| i.frame == j.frame && *found).count();
    assert!(between > 0 && within > 0, "{looks:?}");
    let used = further_used(&wires);
    assert_eq!(used.len(), between + within);
    let facts = facts(&wires);
    let agreed = |alignment: EntryId| {
        facts.values().any(|fact| {
            let measured = |verdict: &VerdictFact| matches!(verdict.outcome, VerdictOutcome::Measured { .. });
            matches!(fact, Fact::Verdict(verdict) if verdict.alignment == alignment && measured(verdict))
        })
    };
    let foreign: Vec<_> = used.iter().filter(|(_, fact)| fact.i.frame != fact.j.frame).collect();
    // Without further keypoints the other end would have refused every fourth of them.
    assert!(foreign.iter().all(|(id, _)| agreed(*id)), "{foreign:?}");
    // Further keypoints were fetched of those alone.
    let further: BTreeSet<Hash> = blobs(&wires, &facts).into_values().map(|[_, further]| further).collect();
    let fetched = wires.pieces.iter().filter_map(|(.., answer)| match Message::decode(answer.as_ref()?) {
        Ok(Message::BlobReply { hash, .. }) => further.contains(&hash).then_some(hash),
        _ => None,
    });
    let fetched: BTreeSet<Hash> = fetched.collect();
    assert!(
        !fetched.is_empty() && fetched.len() <= 2 * looks.len() && fetched.len() < further.len(),
        "{}",
        fetched.len()
    );
    assert!(wires.agents.iter().all(|agent| agent.status().idle && agent.status().merged_with.len() == 1));
}

/// The second robot gets no further keypoints: it leaves open what it cannot look at, and answers once it can.
#[test]
fn what_cannot_be_looked_at_again_yet_is_not_refused() {
    let is_further = |bytes: &[u8]| match Message::decode(bytes) {
        Ok(Message::BlobReply { bytes, .. }) => Keypoints::address_in(&bytes).is_none(),
        _ => false,
    };
    let mut wires = driven_without(some_refused, move |to, bytes| to == 1 && is_further(bytes));
    let answers = |wires: &Wires| {
        let facts = facts(wires);
        let verdicts = |alignment: EntryId| {
            facts.values().find_map(move |fact| match fact {
                Fact::Verdict(verdict) if verdict.alignment == alignment => Some(verdict.outcome.clone()),
                _ => None,
            })
        };
        let between = further_used(wires).into_iter().filter(|(_, fact)| fact.i.frame != fact.j.frame);
        between.map(|(id, _)| (id.frame.robot, verdicts(id))).collect::<Vec<_>>()
    };
    let stated = answers(&wires);
    assert!(!stated.is_empty() && stated.iter().all(|(by, answer)| *by == robot(0) && answer.is_none()), "{stated:?}");
    assert!(wires.agents.iter().all(|agent| agent.status().idle), "what waits is no work");
    wires.lost = Box::new(|_, _| false);
    for up in [false, true] {
        wires.input(1, Input::Neighbour { robot: robot(0), up });
    }
    wires.run(Duration::from_secs(60));
    let answered = answers(&wires);
    assert!(answered.len() >= stated.len());
    assert!(answered.iter().all(|(_, a)| matches!(a, Some(VerdictOutcome::Measured { .. }))), "{answered:?}");
}

#[test]
fn who_is_in_no_map_with_another_does_not_look_again() {
    let wires = driven(|job| (is_first(job) && job.back.is_none()).then_some(Err(RefusalReason::NoConsensus.into())));
    assert!(wires.agents.iter().all(|agent| agent.status().idle && agent.status().merged_with.is_empty()));
    assert!(looked_again(&wires).iter().all(|(i, j, _)| i.frame == j.frame));
    assert!(further_used(&wires).iter().all(|(_, fact)| fact.i.frame == fact.j.frame));
}

#[test]
fn of_a_refusal_that_is_not_for_want_of_keypoints_nothing_is_looked_at_again() {
    for reason in [RefusalReason::Ambiguous, RefusalReason::Degenerate, RefusalReason::BadInput] {
        let wires = driven(move |job| some_refused(job).map(|_| Err(reason.into())));
        assert_eq!((looked_again(&wires), further_used(&wires)), (vec![], vec![]), "{reason:?}");
    }
}

#[test]
fn what_contradicts_the_map_is_no_alignment() {
    let wires = driven(|job| {
        some_refused(job).or_else(|| {
            let mut answer = (!is_first(job)).then(|| run(job))?;
            if let Ok(measured) = &mut answer
                && let Relative::Metric(found) = &mut measured.t_mine_theirs
            {
                found.pose = found.pose * Se3::new(found.pose.rotation, Vector3::new(3.0, 0.0, 0.0));
            }
            Some(answer)
        })
    });
    let looks = looked_again(&wires);
    assert!(!looks.is_empty() && looks.iter().all(|(.., found)| !found), "{looks:?}");
    assert_eq!(further_used(&wires), []);
}

#[test]
fn further_keypoints_are_served_after_a_restart() {
    let wires = driven(some_refused);
    let all = blobs(&wires, &facts(&wires));
    let mut again = super::common::agent(0, Restored { records: wires.disks[0].clone(), fresh_epoch: 9 });
    while again.poll_output().is_some() {}
    let own = all.into_iter().filter(|(submap, _)| submap.frame.robot == robot(0));
    for (token, (_, [_, hash])) in own.enumerate() {
        let bytes = Message::BlobRequest { hash, offset: 0, len: 16_384 }.encode();
        let token = AskToken(token as u64);
        again.handle(wires.now, Input::Asked { token, kind: QueryKind::Blob, bytes });
        let answer = core::iter::from_fn(|| again.poll_output())
            .find_map(|output| if let Output::Answer { bytes, .. } = output { Some(bytes) } else { None });
        let answer = Message::decode(&answer.unwrap()).unwrap();
        assert!(matches!(answer, Message::BlobReply { hash: of, .. } if of == hash), "{answer:?}");
    }
}

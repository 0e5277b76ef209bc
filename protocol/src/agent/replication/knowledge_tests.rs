use super::*;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use crate::ids::Hash;
use crate::time::Stamp;
use crate::wire::fact::{CondensedFact, RefusalReason, ScaleKind};
use nalgebra::Vector3;

fn frame(robot: u8) -> FrameId {
    FrameId { robot: RobotId([robot; 8]), epoch: 1 }
}

fn entry(robot: u8, seq: u32) -> EntryId {
    EntryId { frame: frame(robot), seq }
}

fn anchor(robot: u8) -> SubmapId {
    SubmapId { frame: frame(robot), index: 0 }
}

fn pose(x: f64, sigma: f64) -> PoseWithCovariance {
    let covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
    PoseWithCovariance { pose: Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0)), covariance }
}

fn submap() -> Fact {
    Fact::Submap(SubmapFact {
        index: 0,
        stamps: [Stamp(0), Stamp(1)],
        odometry: pose(0.0, 1e-4),
        extent: [1.0; 3],
        summary: vec![],
        keypoint_count: 1,
        blob: Hash::default(),
        scale: ScaleKind::Metric,
        keyframes: None,
    })
}

fn alignment(i: u8, j: u8, x: f64, sigma: f64) -> Fact {
    let t_i_j = Relative::Metric(pose(x, sigma));
    let (i, j) = (anchor(i), anchor(j));
    let blobs = [Hash::default(); 2];
    Fact::Alignment(AlignmentFact { i, j, t_i_j, sigma: 0.01, support: 20, log10_nfa: -9.0, blobs })
}

fn verdict(alignment: EntryId, x: f64, sigma: f64) -> Fact {
    let t_i_j = Relative::Metric(pose(x, sigma));
    Fact::Verdict(VerdictFact { alignment, outcome: VerdictOutcome::Measured { t_i_j, sigma: 0.01, support: 20 } })
}

/// The problem of a robot that no fact is about.
fn problem(knowledge: &Knowledge) -> MapProblem {
    knowledge.question(frame(9), |_| Some(pose(0.0, 1e-4))).problem
}

/// Robots 1 and 2, one submap each, and what else they say.
fn knowledge(facts: &[(EntryId, Fact)]) -> Knowledge {
    let mut knowledge = Knowledge::default();
    for (id, fact) in [(entry(1, 0), submap()), (entry(2, 0), submap())].iter().chain(facts) {
        knowledge.absorb(*id, fact.clone());
    }
    knowledge
}

/// A submap's fact names the blob that a first look is at.
#[test]
fn an_alignment_from_other_keypoints_is_a_second_look() {
    let stated = (entry(1, 1), alignment(1, 2, 3.0, 0.02));
    let verdict = (entry(2, 1), verdict(stated.0, 3.03, 0.02));
    let second_looks = |blobs: [Hash; 2]| {
        let Fact::Alignment(fact) = stated.1.clone() else { panic!("{stated:?}") };
        let stated = (stated.0, Fact::Alignment(AlignmentFact { blobs, ..fact }));
        problem(&knowledge(&[stated, verdict.clone()])).second_looks
    };
    let (first, further) = (Hash::default(), Hash([1; 32]));
    assert_eq!(second_looks([first; 2]), BTreeSet::new());
    for blobs in [[first, further], [further, first], [further; 2]] {
        assert_eq!(second_looks(blobs), BTreeSet::from([stated.0]));
    }
}

/// What a second look is answered speaks for no merge and against none, and it stands for no first look.
#[test]
fn first_looks_come_before_second_ones() {
    let Fact::Alignment(first) = alignment(1, 2, 3.0, 0.02) else { panic!() };
    let again = AlignmentFact { blobs: [Hash([1; 32]), Hash::default()], ..first.clone() };
    let refused = |alignment| {
        let outcome = VerdictOutcome::Refused(RefusalReason::Ambiguous);
        Fact::Verdict(VerdictFact { alignment, outcome })
    };
    let stated = |fact: &AlignmentFact| (entry(1, 1), Fact::Alignment(fact.clone()));
    let ambiguous = |fact| problem(&knowledge(&[stated(fact), (entry(2, 1), refused(entry(1, 1)))])).ambiguous.len();
    assert_eq!((ambiguous(&first), ambiguous(&again)), (1, 0));
    let later = [(entry(1, 2), Fact::Alignment(first.clone())), (entry(2, 2), verdict(entry(1, 2), 3.03, 0.02))];
    let both = [vec![stated(&again), (entry(2, 1), verdict(entry(1, 1), 3.03, 0.02))], later.to_vec()].concat();
    let counts = |facts: &[(EntryId, Fact)]| knowledge(facts).counted((anchor(1), anchor(2)));
    assert_eq!((counts(&both[..2]), counts(&both)), (Some(entry(1, 1)), Some(entry(1, 2))));
}

#[test]
fn an_alignment_moves_nothing_until_the_other_endpoint_measured_the_same() {
    let stated = (entry(1, 1), alignment(1, 2, 3.0, 0.02));
    let alone = knowledge(std::slice::from_ref(&stated));
    assert_eq!(alone.agreement(stated.0), Agreement::Waiting);
    assert!(problem(&alone).alignments.is_empty());
    let agreed = knowledge(&[stated.clone(), (entry(2, 1), verdict(stated.0, 3.03, 0.02))]);
    assert_eq!(agreed.agreement(stated.0), Agreement::Agreed);
    assert_eq!(problem(&agreed).alignments.len(), 1);
}

#[test]
fn a_frame_that_nothing_ties_is_no_part_of_the_problem() {
    let stated = (entry(1, 1), alignment(1, 2, 3.0, 0.02));
    let lone = (entry(3, 0), submap());
    let agreed = knowledge(&[stated.clone(), (entry(2, 1), verdict(stated.0, 3.0, 0.02)), lone]);
    let frames = |own| agreed.question(frame(own), |_| Some(pose(0.0, 1e-4)));
    let asked = frames(9);
    assert!(asked.problem.frames.keys().eq([frame(1), frame(2)].iter()));
    assert_eq!(asked.alone, BTreeMap::from([(frame(3), 1)]));
    let asked = frames(3);
    assert_eq!(asked.problem.frames.len(), 3, "unless it is our own");
    assert!(asked.alone.is_empty());
}

#[test]
fn a_liar_moves_nothing() {
    let lie = (entry(1, 1), alignment(1, 2, 30.0, 0.02));
    let honest = (entry(2, 1), verdict(lie.0, 3.0, 0.02));
    // The other endpoint measured something else, or found nothing.
    assert_eq!(knowledge(&[lie.clone(), honest]).agreement(lie.0), Agreement::Disputed);
    let refusal = VerdictOutcome::Refused(RefusalReason::NoConsensus);
    let refused = (entry(2, 1), Fact::Verdict(VerdictFact { alignment: lie.0, outcome: refusal }));
    assert_eq!(knowledge(&[lie.clone(), refused]).agreement(lie.0), Agreement::Disputed);
    // The liar's own verdict, and a third party's, count for nothing.
    let own = (entry(1, 2), verdict(lie.0, 30.0, 0.02));
    let third = (entry(3, 0), verdict(lie.0, 30.0, 0.02));
    let known = knowledge(&[lie.clone(), own, third]);
    assert_eq!(known.agreement(lie.0), Agreement::Waiting);
    assert!(problem(&known).alignments.is_empty());
    // A third party cannot state an alignment of others.
    let foreign = (entry(3, 0), alignment(1, 2, 3.0, 0.02));
    assert!(knowledge(&[foreign]).alignments().next().is_none());
}

#[test]
fn an_endpoint_that_sees_two_ways_tells_of_its_two_frames() {
    let stated = (entry(1, 1), alignment(1, 2, 3.0, 0.02));
    let refused = |robot: u8, reason| {
        let outcome = VerdictOutcome::Refused(reason);
        (entry(robot, 2), Fact::Verdict(VerdictFact { alignment: stated.0, outcome }))
    };
    let count = |facts: &[(EntryId, Fact)]| problem(&knowledge(facts)).ambiguous;
    let both = BTreeMap::from([((frame(1), frame(2)), 1)]);
    assert_eq!(count(&[stated.clone(), refused(2, RefusalReason::Ambiguous)]), both);
    assert!(count(&[stated.clone(), refused(2, RefusalReason::NoConsensus)]).is_empty());
    // Neither the writer nor anybody else can say so in its place.
    assert!(count(&[stated.clone(), refused(1, RefusalReason::Ambiguous)]).is_empty());
    assert!(count(&[stated.clone(), refused(3, RefusalReason::Ambiguous)]).is_empty());
    // The same two submaps once more: agreed after all, or no more than one pair.
    let again = (entry(2, 3), alignment(1, 2, 3.0, 0.02));
    let answer = |outcome| (entry(1, 3), Fact::Verdict(VerdictFact { alignment: again.0, outcome }));
    let twice = answer(VerdictOutcome::Refused(RefusalReason::Ambiguous));
    assert_eq!(count(&[stated.clone(), refused(2, RefusalReason::Ambiguous), again.clone(), twice]), both);
    let agreed = (entry(1, 3), verdict(again.0, 3.0, 0.02));
    assert!(count(&[stated.clone(), refused(2, RefusalReason::Ambiguous), again.clone(), agreed]).is_empty());
}

#[test]
fn who_takes_its_own_places_for_others_tells_of_its_frame_alone() {
    let alike = |robot, seq, i, j| (entry(robot, seq), Fact::Lookalike(LookalikeFact { i, j }));
    let told = [alike(1, 1, 0, 7), alike(1, 2, 0, 8), alike(1, 3, 0, 7), alike(2, 1, 0, 7)];
    let mut known = knowledge(&told);
    let counts = BTreeMap::from([((frame(1), frame(1)), 2), ((frame(2), frame(2)), 1)]);
    assert_eq!(problem(&known).ambiguous, counts, "twice told is told once");
    let of = |known: &Knowledge, robot| known.lookalikes_of(frame(robot)).len();
    assert_eq!((of(&known, 1), of(&known, 3)), (2, 0));
    known.forget_below(frame(1), 2);
    assert_eq!(of(&known, 1), 2);
    let carried = [(1, 0, 7), (2, 0, 8)].map(|(seq, i, j)| CarriedFact {
        seq,
        after: None,
        fact: Fact::Lookalike(LookalikeFact { i, j }),
    });
    known.forget_below(frame(1), 9);
    known.absorb(entry(1, 9), Fact::Condensed(CondensedFact { carried: carried.into() }));
    assert_eq!(problem(&known).ambiguous, counts, "carried on");
}

#[test]
fn nobody_can_overstate_a_shared_measurement() {
    let bold = (entry(1, 1), alignment(1, 2, 3.0, 0.001));
    let sober = (entry(2, 1), verdict(bold.0, 3.01, 0.05));
    let problem = problem(&knowledge(&[bold, sober]));
    let Relative::Metric(used) = problem.alignments[0].t_i_j else { panic!("metric") };
    assert!(used.covariance.sigmas()[0] >= 0.05);
}

#[test]
fn the_order_of_facts_changes_nothing() {
    let stated = (entry(1, 1), alignment(1, 2, 3.0, 0.02));
    let facts = [stated.clone(), (entry(2, 1), verdict(stated.0, 3.0, 0.02)), (entry(2, 2), submap())];
    let forward = knowledge(&facts);
    let mut backward = Knowledge::default();
    for (id, fact) in facts.iter().rev().chain(&[(entry(2, 0), submap()), (entry(1, 0), submap())]) {
        backward.absorb(*id, fact.clone());
    }
    assert_eq!(forward.agreement(stated.0), backward.agreement(stated.0));
    assert_eq!(problem(&forward), problem(&backward));
}

#[test]
fn of_two_agreed_alignments_of_a_pair_the_first_counts() {
    let pair = (anchor(1), anchor(2));
    let facts = [
        (entry(1, 1), alignment(1, 2, 1.0, 0.1)),
        (entry(1, 2), alignment(1, 2, 1.01, 0.1)),
        (entry(2, 1), verdict(entry(1, 2), 1.0, 0.1)),
    ];
    assert_eq!(knowledge(&facts[..2]).counted(pair), None);
    assert_eq!(knowledge(&facts).counted(pair), Some(entry(1, 2)));
    let both: Vec<_> = facts.into_iter().chain([(entry(2, 2), verdict(entry(1, 1), 1.0, 0.1))]).collect();
    assert_eq!(knowledge(&both).counted(pair), Some(entry(1, 1)));
    assert_eq!(problem(&knowledge(&both)).alignments[0].entry, entry(1, 1));
}

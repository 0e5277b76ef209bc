use super::*;
use crate::agent::replication::knowledge::Knowledge;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, So3};
use crate::ids::{EntryId, FrameId};
use crate::wire::fact::{AlignmentFact, Fact, ScaleKind, SubmapFact, VerdictFact, VerdictOutcome};
use nalgebra::Vector3;
use proptest::prelude::*;

/// A robot's submap `index`, whose blob is `blob` and that holds so many keypoints.
fn stated(robot: u8, index: u32, blob: u8, keypoint_count: u16) -> (EntryId, Fact) {
    let fact = SubmapFact {
        index,
        stamps: [Stamp(0), Stamp(i64::from(index))],
        odometry: pose(1.0),
        extent: [1.0; 3],
        summary: Vec::new(),
        keypoint_count,
        blob: Hash([blob; 32]),
        scale: ScaleKind::Metric,
        keyframes: None,
    };
    (EntryId { frame: frame(robot), seq: index }, Fact::Submap(fact))
}

fn frame(robot: u8) -> FrameId {
    FrameId { robot: RobotId([robot; 8]), epoch: 1 }
}

fn id(robot: u8, index: u32) -> SubmapId {
    SubmapId { frame: frame(robot), index }
}

fn pose(x: f64) -> PoseWithCovariance {
    let covariance = Covariance::from_sigmas([0.01; 6]).unwrap();
    PoseWithCovariance { pose: Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0)), covariance }
}

/// An alignment that both ends agree on.
fn agreed(i: SubmapId, j: SubmapId, seq: u32) -> [(EntryId, Fact); 2] {
    let t_i_j = Relative::Metric(pose(0.0));
    let [by_i, by_j] = [i, j].map(|end| EntryId { frame: end.frame, seq });
    let blobs = [Hash([0; 32]); 2];
    let stated = AlignmentFact { i, j, t_i_j, sigma: 0.01, support: 20, log10_nfa: -9.0, blobs };
    let outcome = VerdictOutcome::Measured { t_i_j, sigma: 0.01, support: 20 };
    [(by_i, Fact::Alignment(stated)), (by_j, Fact::Verdict(VerdictFact { alignment: by_i, outcome }))]
}

fn knowing(facts: impl IntoIterator<Item = (EntryId, Fact)>) -> Knowledge {
    let mut knowledge = Knowledge::default();
    facts.into_iter().for_each(|(id, fact)| knowledge.absorb(id, fact));
    knowledge
}

/// Robots that are tied to one another in the map's problem.
fn ties(knowledge: &Knowledge) -> BTreeSet<[u8; 2]> {
    let problem = knowledge.question(frame(9), |_| Some(pose(1.0))).problem;
    problem.alignments.iter().map(|tie| [tie.i, tie.j].map(|end| end.frame.robot.0[0])).collect()
}

/// Robots 1 and 2 measured one another; 3 copied a cloud of each, and both agreed with it before they knew.
fn mirror(keypoints: u16) -> Vec<(EntryId, Fact)> {
    let honest = [stated(1, 0, 10, 50), stated(2, 0, 20, 50), stated(3, 0, 10, keypoints), stated(3, 1, 20, keypoints)];
    let pairs = [
        agreed(id(1, 0), id(2, 0), 100),
        agreed(id(1, 0), id(3, 0), 101),
        agreed(id(2, 0), id(3, 1), 102),
        agreed(id(2, 0), id(3, 0), 103),
    ];
    honest.into_iter().chain(pairs.into_iter().flatten()).collect()
}

proptest! {
    /// Whatever a copier says of how much its cloud holds, and in whatever order all comes, it unties itself from those
    /// whom it copied, and them not from one another.
    #[test]
    fn who_copies_unties_itself_alone(keypoints in 0..60u16, order in Just((0..12).collect::<Vec<usize>>()).prop_shuffle()) {
        let facts = mirror(keypoints);
        let knowledge = knowing(order.iter().map(|k| facts[*k].clone()));
        prop_assert_eq!(ties(&knowledge), BTreeSet::from([[1, 2]]));
    }
}

#[test]
fn clouds_that_are_not_alike_are_no_copies() {
    let honest = [stated(1, 0, 10, 50), stated(2, 0, 20, 50), stated(3, 0, 30, 50)];
    let pairs = [agreed(id(1, 0), id(2, 0), 100), agreed(id(1, 0), id(3, 0), 101)];
    let knowledge = knowing(honest.into_iter().chain(pairs.into_iter().flatten()));
    assert_eq!(ties(&knowledge), BTreeSet::from([[1, 2], [1, 3]]));
    assert_eq!(knowledge.copied().count(), 0);
}

/// On both sides of the limit; one robot's own clouds may be alike.
#[test]
fn nearly_empty_clouds_are_alike_by_chance() {
    for (keypoints, copied) in [(KEYPOINTS_OF_BLOB_MIN - 1, 0), (KEYPOINTS_OF_BLOB_MIN, 1)] {
        let facts = [stated(1, 0, 10, keypoints), stated(1, 7, 10, keypoints), stated(2, 0, 10, keypoints)];
        assert_eq!(knowing(facts).copied().count(), copied, "{keypoints} keypoints");
    }
}

#[test]
fn who_was_heard_first_is_believed_and_from_the_disk_oneself_then_the_earlier_date() {
    let facts = [stated(2, 5, 10, 50), stated(1, 9, 10, 50), stated(3, 7, 10, 50)];
    let mut knowledge = knowing(facts);
    let copies = |knowledge: &Knowledge| [id(1, 9), id(2, 5), id(3, 7)].map(|id| knowledge.copied_from(id).is_some());
    assert_eq!(copies(&knowledge), [true, false, true]);
    let [one, three] = [1, 3].map(|by| CopiedFrom { by: RobotId([by; 8]), of: RobotId([2; 8]) });
    assert!(knowledge.copied().eq([(one, 1), (three, 1)]));
    knowledge.order_by_stamp(RobotId([9; 8]));
    assert_eq!(copies(&knowledge), [true, false, true]);
    knowledge.order_by_stamp(RobotId([1; 8]));
    assert_eq!(copies(&knowledge), [false, true, true]);
}

#[test]
fn looks_that_nobody_states_any_more_are_forgotten() {
    let known = |blob: u32| {
        let mut hash = [0; 32];
        hash[..4].copy_from_slice(&blob.to_le_bytes());
        let mut knowledge = knowing([stated(1, 0, 0, 50)]);
        let (_, first) = knowledge.submaps().next().map(|(id, known)| (id, known.clone())).unwrap();
        knowledge.forget_below(frame(1), 9);
        Known { blob: Hash(hash), ..first }
    };
    let mut first = FirstHeard::default();
    (0..REMEMBERED_MIN as u32).for_each(|blob| first.hear(RobotId([1; 8]), &known(blob)));
    first.prune(0, std::iter::empty());
    assert_eq!(first.by.len(), REMEMBERED_MIN);
    first.hear(RobotId([1; 8]), &known(u32::MAX));
    first.prune(0, [&known(3)].into_iter());
    assert_eq!(first.by.len(), 1);
}

//! Which frames merge: what speaks for it, what against, and what for neither.

use super::admission::Admission;
use super::joint::*;
use super::pairs;
use super::test_graphs::*;
use super::test_world::*;
use super::verdicts::Verdicts;
use crate::config::EstimateConfig;
use crate::geometry::{PoseWithCovariance, Relative, Se3};
use crate::ids::EntryId;
use crate::kinds::PairStatus;
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// However often one submap is asked, it is one place, and may be another that looks the same.
#[test]
fn what_one_submap_says_merges_no_frames() {
    let rng = &mut rng(43);
    let mut world = World::new(rng, 2, 12, false);
    for k in [1, 4, 7, 10] {
        let t = world.measure(Some(&mut *rng), submap(0, 3), submap(1, k));
        world.state(submap(0, 3), submap(1, k), t);
    }
    assert_eq!(world.solve().pairs()[0].status, PairStatus::Provisional);
    let t = world.measure(Some(rng), submap(0, 8), submap(1, 4));
    world.state(submap(0, 8), submap(1, 4), t);
    let map = world.solve();
    assert_eq!((map.pairs()[0].status, map.pairs()[0].used), (PairStatus::Merged, 5));
}

/// Five alignments agree, and so many pairs of submaps could lie here or there.
#[test]
fn frames_of_places_that_repeat_themselves_are_ambiguous() {
    let rng = &mut rng(41);
    let mut world = World::new(rng, 3, 12, false);
    world.align_all(rng, 5, false);
    let status = |ambiguous: &[((u8, u8), usize)]| {
        let ambiguous = ambiguous.iter().map(|&((a, b), n)| ((frame(a), frame(b)), n)).collect();
        let map = solve_map(&MapProblem { ambiguous, ..world.problem.clone() }, &EstimateConfig::default());
        map.pairs().iter().map(|pair| (pair.status, pair.used)).collect::<Vec<_>>()
    };
    let (merged, ambiguous) = ((PairStatus::Merged, 5), (PairStatus::Ambiguous, 0));
    assert_eq!(status(&[]), [merged; 3]);
    assert_eq!(status(&[((0, 1), 3)]), [merged; 3]);
    // Nobody else's business.
    assert_eq!(status(&[((0, 1), 4), ((0, 2), 3)]), [ambiguous, merged, merged]);
}

/// Whoever takes two places of its own for one cannot tell those of others.
#[test]
fn a_frame_that_takes_its_places_for_others_merges_with_none() {
    let rng = &mut rng(43);
    let mut world = World::new(rng, 3, 12, false);
    world.align_all(rng, 5, false);
    let (merged, ambiguous) = ((PairStatus::Merged, 5), (PairStatus::Ambiguous, 0));
    // Closures of the first frame: as found at the same place, though the way between is long; true; and off by a share
    // of the way, as where odometry is worse than it says.
    let status_of = |told: usize, elsewhere: usize, held: usize, drifted: usize, again: bool| {
        let ambiguous = BTreeMap::from([((frame(0), frame(0)), told)]);
        let mut problem = MapProblem { ambiguous, ..world.problem.clone() };
        let mut close = |k: usize, t_i_j: Se3| {
            let t_i_j = Relative::Metric(PoseWithCovariance { pose: t_i_j, covariance: sigmas(0.02, 0.005) });
            let entry = EntryId { frame: frame(0), seq: 1000 + problem.alignments.len() as u32 };
            problem.alignments.push(AgreedAlignment { entry, i: submap(0, k), j: submap(0, k + 6), t_i_j });
            entry
        };
        let truth = |k: usize| world.truth[&submap(0, k)].inverse() * world.truth[&submap(0, k + 6)];
        (0..elsewhere).for_each(|k| _ = close(k, Se3::identity()));
        let true_ones: Vec<EntryId> = (elsewhere..elsewhere + held).map(|k| close(k, truth(k))).collect();
        let off = |k| truth(k) * Se3::new(Se3::identity().rotation, Vector3::new(0.5, 0.0, 0.0));
        (elsewhere + held..elsewhere + held + drifted).for_each(|k| _ = close(k, off(k)));
        problem.second_looks = true_ones.into_iter().filter(|_| again).collect();
        let map = solve_map(&problem, &EstimateConfig::default());
        let refused = map.edges().iter().filter(|e| matches!(e.unused, Some(Unused::Odometry(_)))).count();
        assert_eq!(refused, elsewhere + drifted);
        map.pairs().iter().map(|pair| (pair.status, pair.used)).collect::<Vec<_>>()
    };
    let status_told = |told, elsewhere, held, drifted| status_of(told, elsewhere, held, drifted, false);
    let status = |elsewhere, held, drifted| status_told(0, elsewhere, held, drifted);
    assert_eq!(status(0, 0, 0), [merged; 3]);
    assert_eq!(status(1, 0, 0), [merged; 3], "one may be chance");
    // Places that fit in several ways, by the owner's word, are as good as those that its odometry refutes.
    assert_eq!(status_told(1, 0, 0, 0), [merged; 3], "one may be chance");
    assert_eq!(status_told(2, 0, 0, 0), [ambiguous, ambiguous, merged]);
    assert_eq!(status_told(1, 1, 2, 0), [ambiguous, ambiguous, merged]);
    assert_eq!(status_told(1, 1, 3, 0), [merged; 3], "most were right");
    assert_eq!(status_told(usize::MAX, 2, 0, 0), [ambiguous, ambiguous, merged]);
    assert_eq!(status(2, 0, 0), [ambiguous, ambiguous, merged]);
    assert_eq!(status(2, 3, 0), [merged; 3], "most were right");
    assert_eq!(status(0, 0, 3), [merged; 3], "no place is taken for another");
    assert_eq!(status_of(0, 2, 3, 0, true), [ambiguous, ambiguous, merged], "looked for where the odometry had them");
}

/// What was found where a map expected it is no witness for that map. It makes one surer that others vouch for.
#[test]
fn second_looks_merge_nothing_and_count_once_others_have() {
    let solved = |world: &World, second: &dyn Fn(&AgreedAlignment) -> bool| {
        let stated = &world.problem.alignments;
        let second_looks = stated.iter().filter(|one| second(one)).map(|one| one.entry).collect();
        solve_map(&MapProblem { second_looks, ..world.problem.clone() }, &EstimateConfig::default())
    };
    let pairs = |map: &JointEstimate| map.pairs().iter().map(|p| (p.status, p.agreed, p.used)).collect::<Vec<_>>();
    let between = |one: &AgreedAlignment, a, b| {
        let (i, j) = (one.i.frame, one.j.frame);
        (i.min(j), i.max(j)) == (frame(a), frame(b))
    };
    let used =
        |map: &JointEstimate, a, b| map.edges().iter().filter(|e| e.is_used() && between(&e.measurement, a, b)).count();
    let rng = &mut rng(47);
    let mut two = World::new(rng, 2, 12, false);
    two.align(rng, frame(0), frame(1), 5, false);
    let entries: Vec<EntryId> = two.problem.alignments.iter().map(|one| one.entry).collect();
    let first = |count: usize| {
        let first: Vec<EntryId> = entries[..count].to_vec();
        move |one: &AgreedAlignment| !first.contains(&one.entry)
    };
    for (count, expected) in
        [(5, (PairStatus::Merged, 5, 5)), (3, (PairStatus::Merged, 5, 5)), (2, (PairStatus::Provisional, 5, 0))]
    {
        assert_eq!(pairs(&solved(&two, &first(count))), [expected], "{count} at first sight");
    }
    let none = solved(&two, &first(0));
    assert!(none.pairs().is_empty() && none.edges().iter().all(|e| e.unused == Some(Unused::Waiting)));
    // Through a third frame they count, and go with what ties that.
    let mut three = World::new(rng, 3, 12, false);
    three.align_all(rng, 4, false);
    let of_one_pair = solved(&three, &|one| between(one, 0, 1));
    assert_eq!((used(&of_one_pair, 0, 1), of_one_pair.pairs().len()), (4, 2));
    let of_two = solved(&three, &|one| between(one, 0, 1) || between(one, 0, 2));
    assert_eq!((used(&of_two, 0, 1), used(&of_two, 0, 2), used(&of_two, 1, 2)), (0, 0, 4));
}

/// A map that let in what merges nothing, second looks and too few first ones, falls apart as if there were none of
/// these.
#[test]
fn what_merges_nothing_does_not_hold_together_what_falls_apart() {
    let rng = &mut rng(48);
    let mut world = World::new(rng, 3, 12, false);
    let (a, b, c) = (frame(0), frame(1), frame(2));
    [(a, c, 3), (b, c, 3), (a, b, 4)].into_iter().for_each(|(x, y, count)| world.align(rng, x, y, count, false));
    let of_ends = |one: &AgreedAlignment| (one.i.frame.min(one.j.frame), one.i.frame.max(one.j.frame));
    let between: Vec<EntryId> =
        world.problem.alignments.iter().filter(|one| of_ends(one) == (a, b)).map(|one| one.entry).collect();
    let second_looks = between[2..].iter().copied().collect();
    let problem = MapProblem { second_looks, ..world.problem.clone() };
    let mut admission = Admission::new(&problem);
    let mut pairs = pairs::consensus(&mut admission, &EstimateConfig::default(), &mut Verdicts::default());
    admission.edges.iter_mut().for_each(|edge| edge.unused = None);
    admission.edges.iter_mut().find(|e| of_ends(&e.measurement) == (a, c)).unwrap().refuse(Unused::Contradicts(1e3));
    pairs::demote(&mut admission, &mut pairs, 3);
    admission.drop_strays();
    let of = |x, y| {
        let of_pair = admission.edges.iter().filter(move |e| of_ends(&e.measurement) == (x, y));
        of_pair.map(|e| e.unused).collect::<Vec<_>>()
    };
    assert_eq!(of(a, c), [Some(Unused::Contradicts(1e3)), Some(Unused::TooFew), Some(Unused::TooFew)]);
    assert_eq!((of(b, c), of(a, b)), (vec![None; 3], vec![Some(Unused::Waiting); 4]));
}

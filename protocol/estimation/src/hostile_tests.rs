//! Hostile and broken sets of facts: listed, harmless, never a panic.

use super::admission::{SIGMA_ROTATION_MAX, SIGMA_TRANSLATION_MAX};
use super::joint::*;
use super::position::{SeenPoint, StatedPoint};
use super::solve::{ComponentError, SolveError};
use super::test_graphs::*;
use super::test_world::*;
use crate::config::EstimateConfig;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, SimWithCovariance};
use crate::ids::EntryId;
use crate::kinds::ScaleKind;
use core::num::NonZero;
use nalgebra::Vector3;
use proptest::prelude::*;
use rand::RngExt;
use rand::seq::SliceRandom;

#[test]
fn hostile_facts_are_listed_and_do_no_harm() {
    let rng = &mut rng(12);
    let mut world = World::new(rng, 3, 10, false);
    world.align_all(rng, 4, false);
    let want = world.solve();
    let good = rigid(&world.measure(None, submap(0, 1), submap(1, 1)));
    let nan = PoseWithCovariance { pose: Se3::new(good.pose.rotation, Vector3::new(f64::NAN, 0.0, 0.0)), ..good };
    let huge = PoseWithCovariance { pose: Se3::new(good.pose.rotation, Vector3::new(1e300, 0.0, 0.0)), ..good };
    let sim = SimWithCovariance::from_metric(&good);
    let cases = [
        (submap(0, 1), submap(1, 1), Relative::Metric(nan)),
        (submap(0, 1), submap(1, 99), Relative::Metric(good)),
        (submap(7, 1), submap(1, 1), Relative::Metric(good)),
        (submap(0, 1), submap(0, 1), Relative::Metric(good)),
        (submap(0, 2), submap(1, 9), Relative::Similarity(sim)),
        (submap(0, 9), submap(1, 0), Relative::Metric(huge)),
    ];
    let entries: Vec<EntryId> = cases.into_iter().map(|(i, j, t)| world.state(i, j, t)).collect();
    let again = world.problem.alignments[0];
    let [copy, flipped] = [10_000, 10_001].map(|seq| EntryId { frame: frame(2), seq });
    world.problem.alignments.push(AgreedAlignment { entry: copy, ..again });
    let turned = AgreedAlignment { entry: flipped, i: again.j, j: again.i, t_i_j: again.t_i_j.inverse() };
    world.problem.alignments.push(turned);
    let map = world.solve();
    let reason = |entry| map.edges().iter().find(|e| e.measurement.entry == entry).unwrap().unused;
    let reasons: Vec<_> = entries.iter().map(|&e| reason(e)).collect();
    use Unused::{NotFinite, SelfLoop, Units, UnknownSubmap};
    assert_eq!(reasons[..5], [Some(NotFinite), Some(UnknownSubmap), Some(UnknownSubmap), Some(SelfLoop), Some(Units)]);
    assert!(reasons[5].is_some());
    assert_eq!(reason(copy), Some(Unused::RepeatsPair(again.entry)));
    assert_eq!(reason(flipped), Some(Unused::RepeatsPair(again.entry)));
    // A pair's number of false alarms grows with what was told of it; so the spanning forest, hence the start, may
    // differ.
    assert!((map.chi2 / want.chi2 - 1.0).abs() < 1e-12, "{} {}", map.chi2, want.chi2);
    assert!(map.edges().iter().filter_map(|e| e.unused).all(|u| !u.to_string().is_empty()));
}

#[test]
fn a_broken_chain_ends_where_it_breaks() {
    let rng = &mut rng(13);
    let mut world = World::new(rng, 2, 10, false);
    world.align_all(rng, 4, false);
    let chain = world.problem.frames.get_mut(&frame(1)).unwrap();
    chain.odometry[6].pose.translation.x = f64::INFINITY;
    let map = world.solve();
    assert_eq!(map.nodes, 16);
    assert!(map.anchor(frame(1), submap(1, 5)).is_some() && map.anchor(frame(1), submap(1, 6)).is_none());
    world.problem.frames.get_mut(&frame(1)).unwrap().odometry[0].pose.translation.x = f64::NAN;
    assert_eq!(world.solve().component_of(frame(1)), None);
    let empty = solve_map(&MapProblem::default(), &EstimateConfig::default());
    assert!(empty.converged && empty.nodes == 0 && empty.pairs().is_empty());
}

/// Any pose and covariance that the types admit, the unreasonable ones included.
fn any_measurement() -> impl Strategy<Value = PoseWithCovariance> + Clone {
    let number = prop_oneof![
        20 => -10.0..10.0f64,
        1 => Just(f64::NAN),
        1 => Just(f64::INFINITY),
        1 => Just(1e300),
        1 => Just(-1e12),
    ];
    let sigma = (-8.9..5.9f64).prop_map(|e| libm::pow(10.0, e));
    (prop::array::uniform6(number), prop::array::uniform6(sigma)).prop_map(|(x, s)| PoseWithCovariance {
        pose: Se3::exp(&x.into()),
        covariance: Covariance::from_sigmas(s).unwrap(),
    })
}

fn any_problem() -> impl Strategy<Value = MapProblem> {
    let id = || (0..4u8, 0..6usize).prop_map(|(robot, index)| submap(robot, index));
    let relative = (any_measurement(), any::<bool>()).prop_map(|(p, metric)| {
        if metric { Relative::Metric(p) } else { Relative::Similarity(SimWithCovariance::from_metric(&p)) }
    });
    let stated = (0..4u8, 0..30u32, id(), id(), relative).prop_map(|(robot, seq, i, j, t_i_j)| AgreedAlignment {
        entry: EntryId { frame: frame(robot), seq },
        i,
        j,
        t_i_j,
    });
    let chain = (any::<bool>(), prop::collection::vec(any_measurement(), 0..6)).prop_map(|(metric, odometry)| {
        FrameChain { scale: if metric { ScaleKind::Metric } else { ScaleKind::Unknown }, odometry }
    });
    let frames = prop::collection::btree_map((0..4u8).prop_map(frame), chain, 0..4);
    let lists = (prop::collection::vec(stated.clone(), 0..30), prop::collection::vec(stated, 0..5));
    let entry = (0..4u8, 0..30u32).prop_map(|(robot, seq)| EntryId { frame: frame(robot), seq });
    let seen = (entry.clone(), id(), id(), any_measurement(), any_measurement()).prop_map(|(entry, i, j, a, b)| {
        let covariance = Covariance::new_or_wider(a.covariance.matrix().fixed_view::<3, 3>(0, 0).into_owned());
        let point = SeenPoint { p_i: a.pose.translation, p_j: b.pose.translation, covariance };
        StatedPoint { entry, i, j, point }
    });
    let positions = prop::collection::vec(seen, 0..5);
    let share = prop_oneof![4 => 0.0..1.0, 1 => any::<f64>()];
    let common = prop::collection::btree_map(entry.clone(), share, 0..10);
    let second_looks = prop::collection::btree_set(entry, 0..10);
    let two = (0..4u8, 0..4u8).prop_map(|(a, b)| (frame(a.min(b)), frame(a.max(b))));
    let ambiguous = prop::collection::btree_map(two, prop_oneof![0..9usize, Just(usize::MAX)], 0..4);
    let keyframes = prop::collection::btree_map(id(), (1..9u16).prop_filter_map("none", NonZero::new), 0..10);
    let gone = prop::collection::btree_map(id(), prop_oneof![0..9u32, Just(u32::MAX)], 0..10);
    let problem = (frames, lists, positions, (common, keyframes, gone), (ambiguous, second_looks));
    problem.prop_map(|(frames, (alignments, sightings), positions, (common, keyframes, gone), told)| MapProblem {
        ambiguous: told.0,
        frames,
        alignments,
        sightings,
        positions,
        common,
        keyframes,
        gone,
        second_looks: told.1,
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    #[test]
    fn no_set_of_facts_panics_or_yields_a_number_that_is_none(problem in any_problem(), seed in any::<u64>()) {
        // A bar this low merges on nearly anything, so that the solver sees it.
        let config = EstimateConfig { alignments_min: 1, log10_nfa_max: 0.0, ..EstimateConfig::default() };
        let map = solve_map(&problem, &config);
        prop_assert_eq!(map.edges().len(), problem.alignments.len() + problem.sightings.len() + problem.positions.len());
        prop_assert!(map.edges().iter().all(|e| e.is_used() == (e.weight > 0.0)));
        prop_assert!(map.chi2.is_finite());
        for &a in problem.frames.keys() {
            for (_, t) in map.anchors(a) {
                prop_assert!(t.sim().translation.iter().all(|x| x.is_finite()) && t.sim().scale > 0.0);
            }
            for &b in problem.frames.keys() {
                let t = map.frame(a, b);
                prop_assert!(t.is_none_or(|t| t.sim().translation.iter().all(|x| x.is_finite())));
            }
        }
        let mut shuffled = problem;
        shuffled.alignments.shuffle(&mut rng(seed));
        shuffled.sightings.shuffle(&mut rng(seed));
        shuffled.positions.shuffle(&mut rng(seed));
        prop_assert_eq!(bits(&solve_map(&shuffled, &config)), bits(&map));
    }
}

#[test]
fn extreme_covariances_of_one_robot_do_not_part_the_others() {
    let sizes = [1e-9, 2.9, 3.1, 9e3, 1.1e4, 9e5];
    for (rho, phi) in sizes.iter().flat_map(|&rho| sizes.iter().map(move |&phi| (rho, phi))) {
        for at in [vec![5], vec![1, 2, 3, 4, 5], vec![11]] {
            let rng = &mut rng(31);
            let mut world = World::new(rng, 3, 12, false);
            world.align_all(rng, 4, false);
            let chain = world.problem.frames.get_mut(&frame(0)).unwrap();
            // Beside the loosest steps, the tightest.
            chain.odometry[6].covariance = sigmas(1e-9, 1e-9);
            at.iter().for_each(|&k| chain.odometry[k].covariance = sigmas(rho, phi));
            let map = world.solve();
            let t = rigid(&map.frame(frame(1), frame(2)).expect("frames 1 and 2 are honest"));
            let truth = world.frame_truth(frame(1), frame(2)).to_se3();
            let d = t.covariance.mahalanobis_squared(&t.pose.local(&truth));
            assert!(d < 22.46, "{rho} {phi} {at:?}: {d}");
            let kept = if rho > SIGMA_TRANSLATION_MAX || phi > SIGMA_ROTATION_MAX { at[0] } else { 12 };
            assert_eq!(map.nodes, 24 + kept, "{rho} {phi}");
        }
    }
}

/// A robot that ties everything of its own to everything costs the swarm its own loops and merges, and nothing else.
#[test]
fn a_robot_that_is_tied_all_over_is_left_out_and_it_is_said_why() {
    const ANCHORS: usize = 4_000;
    let rng = &mut rng(77);
    let mut world = World::new(rng, 3, ANCHORS, true);
    for other in [frame(0), frame(2)] {
        world.problem.frames.get_mut(&other).unwrap().odometry.truncate(20);
    }
    world.align(rng, frame(0), frame(2), 5, true);
    world.align(rng, frame(0), frame(1), 5, true);
    for _ in 0..5 * ANCHORS {
        let (i, j) = (rng.random_range(0..ANCHORS), rng.random_range(0..ANCHORS));
        if i != j {
            let t = world.measure(None, submap(1, i), submap(1, j));
            world.state(submap(1, i), submap(1, j), t);
        }
    }
    let map = world.solve();
    let mut reasons = std::collections::BTreeMap::new();
    for edge in map.edges() {
        let of_one = [edge.measurement.i.frame, edge.measurement.j.frame].contains(&frame(1));
        let why = match edge.unused {
            None => "used",
            Some(Unused::Failed(ComponentError::Solve(SolveError::TooDense { .. }))) => "too dense",
            Some(Unused::RepeatsPair(_)) => "repeats",
            Some(_) => "otherwise",
        };
        *reasons.entry((of_one, why)).or_insert(0) += 1;
    }
    println!("{reasons:?}");
    let dense = map.edges().iter().filter_map(|e| e.unused).find(|why| matches!(why, Unused::Failed(_))).unwrap();
    assert!(dense.to_string().contains("too densely tied"), "{dense}");
    assert!(
        matches!(dense, Unused::Failed(ComponentError::Solve(SolveError::TooDense { bytes, limit: MAP_BYTES_MAX })) if bytes > MAP_BYTES_MAX)
    );
    assert_eq!(reasons.get(&(true, "used")), None);
    assert_eq!(reasons.get(&(false, "too dense")), None);
    assert!(reasons[&(true, "too dense")] > 19_000 && reasons[&(false, "used")] > 3, "{reasons:?}");
    assert!(map.frame(frame(0), frame(2)).is_some() && map.frame(frame(0), frame(1)).is_none());
    assert!(map.converged && map.anchor(frame(1), submap(1, ANCHORS - 1)).is_some());
}

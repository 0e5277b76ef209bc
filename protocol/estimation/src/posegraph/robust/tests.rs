//! Robust solving of graphs in files: what is used, what is left out, and how frames begin.

use super::super::solve::Start;
use super::super::*;
use super::{Verdict, robot_of};
use crate::Unused;
use crate::config::EstimateConfig;
use crate::geometry::{So3, se3};
use nalgebra::{Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

const POSES: u64 = 24;
const SIGMA: (f64, f64) = (0.02, 0.005);

fn id(robot: u8, k: u64) -> u64 {
    (u64::from(robot) << 56) | k
}

/// Two robots that walk about the same place, with true closures between them and then as many false ones.
fn walk(seed: u64, closures: u64) -> PoseGraph {
    noisy_walk(seed, closures, 1.0)
}

/// The same with `scale` times the noise that it states.
fn noisy_walk(seed: u64, closures: u64, scale: f64) -> PoseGraph {
    let rng = &mut ChaCha8Rng::seed_from_u64(seed);
    let mut draw = |size: f64| Vector3::from_fn(|_, _| rng.random_range(-size..size));
    let mut truth = BTreeMap::new();
    for robot in [b'a', b'b'] {
        let mut at = Se3::exp(&se3::join(&draw(3.0), &draw(1.0)));
        for k in 0..POSES {
            at = at * Se3::exp(&se3::join(&(draw(0.3) + Vector3::new(0.8, 0.0, 0.0)), &draw(0.3)));
            truth.insert(id(robot, k), at);
        }
    }
    let mut graph = PoseGraph { poses: truth.keys().map(|&k| (k, None)).collect(), ..PoseGraph::default() };
    let (tau, kappa) = (SIGMA.0.powi(-2), 0.5 * SIGMA.1.powi(-2));
    // Uniform noise of the same variance.
    let error = 3.0_f64.sqrt() * scale;
    let mut add = |i: u64, j: u64, off: Vector6<f64>| {
        let t_i_j = (truth[&i].inverse() * truth[&j]).retract(&off);
        let printed = t_i_j.rotation.matrix();
        let information = isotropic_information(kappa, tau);
        graph.measurements.push(Measurement { i, j, t_i_j, printed, information, kappa, tau, line: 1 });
    };
    let mut noise = || se3::join(&(draw(SIGMA.0 * error)), &draw(SIGMA.1 * error));
    for robot in [b'a', b'b'] {
        (1..POSES).for_each(|k| add(id(robot, k - 1), id(robot, k), noise()));
    }
    (0..closures).for_each(|k| add(id(b'a', 2 * k + 1), id(b'b', 23 - 2 * k), noise()));
    (0..closures).for_each(|k| {
        let lie = noise() * (300.0 / scale) + Vector6::new(2.0, 0.0, 0.0, 0.0, 0.0, 0.5);
        add(id(b'a', 2 * k), id(b'b', 2 * k), lie);
    });
    graph
}

fn is_used(verdict: &Verdict) -> bool {
    matches!(verdict, Verdict::Used(_))
}

#[test]
fn true_closures_are_used_and_false_ones_left_out() {
    for seed in 0..10 {
        let graph = walk(seed, 10);
        let solved = graph.solve_robustly(&EstimateConfig::default());
        let odometry = 2 * (POSES as usize - 1);
        assert!(solved.verdicts[..odometry].iter().all(|v| *v == Verdict::Odometry));
        let (truths, lies) = solved.verdicts[odometry..].split_at(10);
        let used = truths.iter().filter(|v| is_used(v)).count();
        assert!(used >= 9 && !lies.iter().any(is_used), "seed {seed}: {used} {lies:?}");
        assert_eq!(solved.components.len(), 1);
        assert_eq!(solved.components[0].len(), 2 * POSES as usize);
    }
}

#[test]
fn a_gap_in_the_odometry_begins_a_new_frame() {
    let mut graph = walk(1, 0);
    graph.measurements.retain(|m| (m.i, m.j) != (id(b'a', 7), id(b'a', 8)));
    let solved = graph.solve_robustly(&EstimateConfig::default());
    let mut sizes: Vec<usize> = solved.components.iter().map(BTreeMap::len).collect();
    sizes.sort_unstable();
    assert_eq!(sizes, [8, 16, 24]);
    assert_eq!(solved.anchors[&id(b'a', 8)].frame.epoch, 1);
    assert!(solved.components.iter().all(|c| c.keys().all(|&k| robot_of(k) == robot_of(*c.keys().next().unwrap()))));
}

#[test]
fn of_more_closures_than_a_pair_weighs_the_map_admits_the_true_ones() {
    // Odometry as in `walk`; 40 true and 40 false closures between all kinds of poses.
    let mut graph = walk(5, 10);
    let odometry = 2 * (POSES as usize - 1);
    let truth = walk_truth(&graph, odometry);
    let (sample, n) = (graph.measurements[odometry].clone(), 40);
    graph.measurements.truncate(odometry);
    for (k, lie) in (0..n).map(|k| (k, false)).chain((0..n).map(|k| (k, true))) {
        let (i, j) = (id(b'a', k % POSES), id(b'b', (5 * k + k / POSES + if lie { 11 } else { 0 }) % POSES));
        let off = if lie {
            Vector6::new(2.0, k as f64 * 0.2 - 4.0, 1.0, 0.0, 0.0, 0.1 * k as f64 - 2.0)
        } else {
            Vector6::zeros()
        };
        let t_i_j = (truth[&i].inverse() * truth[&j]).retract(&off);
        graph.measurements.push(Measurement { i, j, t_i_j, ..sample.clone() });
    }
    let solved = graph.solve_robustly(&EstimateConfig::default());
    let (truths, lies) = solved.verdicts[odometry..].split_at(n as usize);
    assert!(truths.iter().filter(|v| is_used(v)).count() >= 38, "{truths:?}");
    assert!(!lies.iter().any(is_used), "{lies:?}");
}

/// Poses that the odometry and the first true closures give, as good as true.
fn walk_truth(graph: &PoseGraph, odometry: usize) -> BTreeMap<u64, Se3> {
    let measurements = graph.measurements[..odometry + 10].to_vec();
    let told = PoseGraph { measurements, ..graph.clone() };
    let values = told.minimise(&told.start(Start::Relaxed, 50).unwrap(), 50).unwrap().values;
    told.poses.keys().copied().zip(values).collect()
}

/// A graph may state its noise three times too small, or ten times too large: its closures tell.
#[test]
fn noise_that_is_not_as_stated_is_found_out() {
    for (scale, tolerance) in [(3.5, 0.4), (0.1, 0.1)] {
        for seed in 20..26 {
            let graph = noisy_walk(seed, 11, scale);
            let solved = graph.solve_robustly(&EstimateConfig::default());
            let odometry = 2 * (POSES as usize - 1);
            let (truths, lies) = solved.verdicts[odometry..].split_at(11);
            let used = truths.iter().filter(|v| is_used(v)).count();
            assert!(used >= 10 && !lies.iter().any(is_used), "{scale}, seed {seed}: {used} {lies:?}");
            assert!((solved.sigma_scale / scale - 1.0).abs() < 0.5 + tolerance, "{scale}: {}", solved.sigma_scale);
        }
    }
}

/// Three robots: the third has two closures with each of the others, too few for either pair.
#[test]
fn closures_with_robots_that_are_merged_count_together() {
    let mut graph = walk(7, 10);
    let odometry = 2 * (POSES as usize - 1);
    let truth = walk_truth(&graph, odometry);
    let sample = graph.measurements[0].clone();
    let third = |k: u64| truth[&id(b'a', k)] * Se3::exp(&Vector6::new(0.4, 1.0, 0.2, 0.0, 0.1, 0.9));
    let mut add = |i: u64, j: u64, t_i_j: Se3| graph.measurements.push(Measurement { i, j, t_i_j, ..sample.clone() });
    (1..POSES).for_each(|k| add(id(b'c', k - 1), id(b'c', k), third(k - 1).inverse() * third(k)));
    for (robot, k, with) in [(b'a', 3, 1), (b'a', 19, 20), (b'b', 6, 9), (b'b', 15, 14)] {
        add(id(robot, k), id(b'c', with), truth[&id(robot, k)].inverse() * third(with));
    }
    // And as many that lie, each by itself.
    for (robot, k, with) in [(b'a', 2, 17), (b'a', 11, 4), (b'b', 1, 22), (b'b', 18, 7)] {
        let lie = Se3::exp(&Vector6::new(2.0 - 0.3 * k as f64, 1.0, 0.5, 0.1, 0.0, 0.2 * with as f64 - 2.0));
        add(id(robot, k), id(b'c', with), truth[&id(robot, k)].inverse() * third(with) * lie);
    }
    graph.poses.extend((0..POSES).map(|k| (id(b'c', k), None)));
    let solved = graph.solve_robustly(&EstimateConfig::default());
    assert_eq!(solved.components.len(), 1, "all three in one frame");
    let (truths, lies) = solved.verdicts[solved.verdicts.len() - 8..].split_at(4);
    assert!(truths.iter().all(is_used) && !lies.iter().any(is_used), "{truths:?} {lies:?}");
}

/// `robots` of which each stays in sight of the next, the last of the first: two true closures and two lies of each
/// pair.
fn ring(robots: u8, pairs: u8) -> (PoseGraph, usize) {
    let walked = walk(7, 10);
    let odometry = 2 * (POSES as usize - 1);
    let truth = walk_truth(&walked, odometry);
    let sample = walked.measurements[0].clone();
    let mut graph = PoseGraph::default();
    let place = |r: u8, k: u64| {
        truth[&id(b'a', k)] * Se3::exp(&Vector6::new(0.4, f64::from(r), 0.2, 0.0, 0.1, 0.9 * f64::from(r)))
    };
    let mut add = |i: u64, j: u64, t_i_j: Se3| graph.measurements.push(Measurement { i, j, t_i_j, ..sample.clone() });
    for r in 0..robots {
        for k in 1..POSES {
            add(id(b'a' + r, k - 1), id(b'a' + r, k), place(r, k - 1).inverse() * place(r, k));
        }
    }
    for r in 0..pairs {
        let s = (r + 1) % robots;
        for (k, with) in [(3, 2), (19, 20)] {
            add(id(b'a' + r, k), id(b'a' + s, with), place(r, k).inverse() * place(s, with));
            let lie =
                Se3::exp(&Vector6::new(3.0 - 0.4 * k as f64, 1.5, 0.5 * f64::from(r), 0.1, 0.0, 1.0 + f64::from(r)));
            add(id(b'a' + r, k + 2), id(b'a' + s, with), place(r, k + 2).inverse() * place(s, with) * lie);
        }
    }
    graph.poses = (0..robots).flat_map(|r| (0..POSES).map(move |k| (id(b'a' + r, k), None))).collect();
    (graph, usize::from(robots) * (POSES as usize - 1))
}

/// No pair of four robots has the three closures that a merge asks, but every way to divide them cuts four.
#[test]
fn robots_that_no_pair_can_tell_merge_together() {
    let (graph, odometry) = ring(4, 4);
    let solved = graph.solve_robustly(&EstimateConfig::default());
    assert_eq!(solved.components.len(), 1, "{:?}", &solved.verdicts[odometry..]);
    for (k, verdict) in solved.verdicts[odometry..].iter().enumerate() {
        assert_eq!(is_used(verdict), k % 2 == 0, "{k}: {verdict:?}");
    }
}

/// In a row, two closures are all that holds each to the rest: too few.
#[test]
fn two_closures_across_a_cut_merge_nothing() {
    let (graph, odometry) = ring(4, 3);
    let solved = graph.solve_robustly(&EstimateConfig::default());
    assert_eq!(solved.components.len(), 4);
    assert!(!solved.verdicts[odometry..].iter().any(is_used));
}

/// Odometry may drift by more than it says between two places where robots meet: closures at the second that agree
/// with each other count, though each contradicts what drift was believed.
#[test]
fn closures_that_agree_with_each_other_outweigh_the_drift_between() {
    for seed in 0..6 {
        let mut graph = walk(seed, 10);
        let odometry = 2 * (POSES as usize - 1);
        let truth = walk_truth(&graph, odometry);
        let sample = graph.measurements[odometry].clone();
        graph.measurements.truncate(odometry);
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let mut draw = |size: f64| Vector3::from_fn(|_, _| 3.0_f64.sqrt() * rng.random_range(-size..size));
        let first = (0..8).flat_map(|a| (0..8).map(move |b| (a, b)));
        for (a, b) in first.chain((0..4).map(|k| (20 + k, 23 - k))) {
            let t_i_j = truth[&id(b'a', a)].inverse() * truth[&id(b'b', b)];
            let t_i_j = t_i_j.retract(&se3::join(&draw(SIGMA.0), &draw(SIGMA.1)));
            graph.measurements.push(Measurement { i: id(b'a', a), j: id(b'b', b), t_i_j, ..sample.clone() });
        }
        // Between the two places, robot b slips.
        let step = graph.measurements.iter_mut().find(|m| (m.i, m.j) == (id(b'b', 12), id(b'b', 13))).unwrap();
        step.t_i_j = step.t_i_j.retract(&Vector6::new(0.65, 0.65, 0.65, 0.0, 0.0, 0.0));
        let solved = graph.solve_robustly(&EstimateConfig::default());
        let left_out = solved.verdicts[odometry..].iter().filter(|v| !is_used(v));
        assert_eq!(left_out.clone().count(), 0, "seed {seed}: {:?}", left_out.collect::<Vec<_>>());
    }
}

/// False closures may fall anywhere that closures lie, but a few far out do not tell where.
#[test]
fn the_spread_of_closures_is_that_of_the_many() {
    let rng = &mut ChaCha8Rng::seed_from_u64(3);
    let frame = |robot: u8| crate::ids::FrameId { robot: crate::ids::RobotId([robot; 8]), epoch: 0 };
    let anchor = |robot: u8| crate::ids::SubmapId { frame: frame(robot), index: 0 };
    let covariance = covariance_of(&isotropic_information(1.0, 1.0)).unwrap();
    let mut closure = |k: usize, size: f64| {
        let place = Vector3::from_fn(|_, _| rng.random_range(-size..size));
        let t = crate::geometry::PoseWithCovariance { pose: Se3::new(So3::identity(), place), covariance };
        super::Closure { k, i: anchor(1), j: anchor(2), stated: t, t_i_j: t, unused: None, drops: 0 }
    };
    let mut closures: Vec<_> = (0..500).map(|k| closure(k, 10.0)).collect();
    let told = super::world::spread(&closures);
    // Never much more; a box that happens to hold a few tells less.
    assert!((0.3..1.1).contains(&(told / 8000.0)), "{told}");
    closures.extend((500..540).map(|k| closure(k, 1e5)));
    let with_few_far = super::world::spread(&closures);
    assert!(with_few_far < 2.0 * told, "{with_few_far} {told}");
    assert_eq!(super::world::spread(&[]), 0.0);
}

/// A robot whose poses are numbered along rows of a grid: its own measurements hold them together, not their order.
#[test]
fn poses_in_no_order_of_time_are_one_frame() {
    let graph = walk(3, 0);
    let sample = graph.measurements[0].clone();
    let (width, at) = (6, |k: u64| Se3::new(So3::identity(), Vector3::new((k % 6) as f64, (k / 6) as f64, 0.0)));
    let mut grid = PoseGraph { poses: (0..POSES).map(|k| (id(b'g', k), None)).collect(), ..PoseGraph::default() };
    for k in 0..POSES {
        let far =
            [(k % 2 == 0 && k % width + 1 < width, k + 1), (k + width < POSES, k + width), (k + 2 < POSES, k + 2)];
        for (_, other) in far.into_iter().filter(|(there, _)| *there) {
            let t_i_j = at(k).inverse() * at(other);
            grid.measurements.push(Measurement { i: id(b'g', k), j: id(b'g', other), t_i_j, ..sample.clone() });
        }
    }
    let solved = grid.solve_robustly(&EstimateConfig::default());
    assert_eq!(solved.components.len(), 1);
    assert!(solved.anchors.values().all(|a| a.frame.epoch == 0));
    let trusted = solved.verdicts.iter().filter(|v| **v == Verdict::Odometry).count();
    assert_eq!(trusted, POSES as usize - 1, "a tree of the robot's own measurements");
    assert!(solved.verdicts.iter().all(|v| !matches!(v, Verdict::Unused(_))), "{:?}", solved.verdicts);
}

#[test]
fn a_closure_left_out_says_by_how_much_it_contradicts_the_map() {
    let solved = walk(2, 10).solve_robustly(&EstimateConfig::default());
    let left_out = solved.verdicts.iter().filter(|v| matches!(v, Verdict::Unused(_)));
    let says = |v: &&Verdict| matches!(v, Verdict::Unused(Unused::Contradicts(chi2)) if *chi2 > 20.0);
    assert!(left_out.clone().count() >= 10 && left_out.clone().all(|v| says(&v)), "{:?}", left_out.collect::<Vec<_>>());
}

//! Robust solving of graphs in files: what is used, what is left out, and how frames begin.

use super::robust::{Verdict, robot_of};
use super::solve::Start;
use super::*;
use crate::config::EstimateConfig;
use crate::geometry::se3;
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
    let error = 3.0_f64.sqrt();
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
        let lie = noise() * 300.0 + Vector6::new(2.0, 0.0, 0.0, 0.0, 0.0, 0.5);
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

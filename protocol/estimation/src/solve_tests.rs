//! The solver against truth, its own covariances, published optima, and hostile input.

use super::graph::{Factor, Graph, GraphError, Source};
use super::reweight::{LeftOut, leave_one_out};
use super::solve::{ComponentError, FACTOR_BYTES_MAX, Solution, SolveError, minimum, solve};
use super::test_graphs::*;
use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, SimWithCovariance};
use crate::ids::SubmapId;
use nalgebra::{SMatrix, Vector3};
use rand::RngExt;
use rand::seq::SliceRandom;
use std::collections::{BTreeMap, BTreeSet};

/// A closed walk with loop closures: truth and noisy (or exact) factors.
fn walk(seed: u64, anchors: usize, exact: bool) -> (BTreeMap<SubmapId, Se3>, Vec<Factor<SubmapId>>) {
    let rng = &mut rng(seed);
    let mut poses = vec![any_pose(rng, 5.0)];
    for _ in 1..anchors {
        let step = any_step(rng);
        poses.push(poses[poses.len() - 1] * step);
    }
    let mut factors = Vec::new();
    let mut add = |i: usize, j: usize, covariance: Covariance<6>| {
        let truth = poses[i].inverse() * poses[j];
        let t = if exact { PoseWithCovariance { pose: truth, covariance } } else { measured(rng, &truth, covariance) };
        let t_i_j = Relative::Metric(t);
        factors.push(Factor { label: Source::Odometry, i: submap(0, i), j: submap(0, j), t_i_j, weight: 1.0 });
    };
    for k in 1..anchors {
        add(k - 1, k, sigmas(0.03, 0.01));
    }
    for k in 0..anchors / 4 {
        add(k, anchors - 1 - k, sigmas(0.05, 0.01));
    }
    (poses.into_iter().enumerate().map(|(k, t)| (submap(0, k), t)).collect(), factors)
}

fn one_component(truth: &BTreeMap<SubmapId, Se3>, factors: Vec<Factor<SubmapId>>) -> Graph<SubmapId> {
    let nodes = truth.keys().copied().collect();
    Graph::components(&nodes, &BTreeSet::new(), factors).unwrap().remove(0)
}

fn perturbed(seed: u64, truth: &BTreeMap<SubmapId, Se3>, rho: f64, phi: f64) -> Vec<Sim3> {
    let rng = &mut rng(seed);
    truth.values().map(|t| Sim3::from_se3(&measured(rng, t, sigmas(rho, phi)).pose)).collect()
}

fn bits(solution: &Solution<SubmapId>) -> Vec<u64> {
    let numbers =
        |s: &Sim3| s.translation.iter().copied().chain(s.rotation.xyzw()).map(f64::to_bits).collect::<Vec<_>>();
    solution.values().iter().flat_map(numbers).chain([solution.chi2.to_bits()]).collect()
}

#[test]
fn noiseless_graph_gives_back_the_truth() {
    for seed in 0..20 {
        let (truth, factors) = walk(seed, 30, true);
        let graph = one_component(&truth, factors);
        let solution = solve(graph, perturbed(seed, &truth, 0.3, 0.2), 50).unwrap();
        assert!(solution.converged && solution.chi2 < 1e-15, "seed {seed}: χ² {}", solution.chi2);
        let first = truth[&submap(0, 0)];
        for (k, value) in solution.values().iter().enumerate() {
            let t_0_k = solution.values()[0].inverse() * *value;
            let error = (first.inverse() * truth[&submap(0, k)]).local(&t_0_k.to_se3());
            assert!(error.norm() < 1e-9, "seed {seed}, anchor {k}: {error}");
        }
    }
}

#[test]
fn any_order_of_factors_gives_the_same_bits() {
    let (truth, factors) = walk(3, 40, false);
    let start = perturbed(3, &truth, 0.1, 0.05);
    let want = bits(&solve(one_component(&truth, factors.clone()), start.clone(), 50).unwrap());
    for seed in 0..20 {
        let mut shuffled = factors.clone();
        shuffled.shuffle(&mut rng(seed));
        let got = bits(&solve(one_component(&truth, shuffled), start.clone(), 50).unwrap());
        assert_eq!(got, want, "order {seed}");
    }
}

#[test]
fn jacobians_match_finite_differences() {
    let rng = &mut rng(11);
    for scaled in [false, true] {
        for _ in 0..200 {
            let scale = |rng: &mut _| if scaled { libm::exp(0.5 * normal(rng)) } else { 1.0 };
            let (a, b) = (any_pose(rng, 3.0), any_pose(rng, 3.0));
            let values = [a, b].map(|t| Sim3::new(t.rotation, t.translation, scale(rng)));
            let t = (values[0].inverse() * values[1]).retract(&SMatrix::<f64, 7, 1>::from_fn(|k, _| {
                if k == 6 && !scaled { 0.0 } else { 0.2 * normal(rng) }
            }));
            let (i, j) = (submap(0, 0), submap(u8::from(scaled), 1));
            let t_i_j = if scaled {
                Relative::Similarity(SimWithCovariance {
                    sim: t,
                    covariance: Covariance::from_sigmas([0.1; 7]).unwrap(),
                })
            } else {
                Relative::Metric(PoseWithCovariance { pose: t.to_se3(), covariance: sigmas(0.1, 0.1) })
            };
            let unknown = if scaled { BTreeSet::from([frame(1)]) } else { BTreeSet::new() };
            let factor = Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 };
            let graph = Graph::components(&BTreeSet::from([i, j]), &unknown, vec![factor]).unwrap().remove(0);
            let edge = &graph.edges()[0];
            let exact = edge.linearise(&values);
            let h = 1e-6;
            for k in 0..if scaled { 7 } else { 6 } {
                let mut step = SMatrix::<f64, 7, 1>::zeros();
                step[k] = h;
                for (node, jacobian) in [(0, &exact.by_i), (1, &exact.by_j)] {
                    let moved = |s: f64| {
                        let mut v = values;
                        v[node] = v[node].retract(&(step * s));
                        edge.residual(&v)
                    };
                    let numeric = (moved(1.0) - moved(-1.0)) / (2.0 * h);
                    let error = (numeric - jacobian.column(k)).amax();
                    assert!(error < 1e-6 * (1.0 + jacobian.amax()), "node {node} direction {k}: {error}");
                }
            }
        }
    }
}

/// Dense `H⁻¹` gauge-fixed at the first anchor, by numeric Jacobians of stacked whitened residuals.
#[test]
fn relative_covariances_match_a_dense_inverse() {
    let (truth, factors) = walk(5, 12, false);
    let solution = solve(one_component(&truth, factors), perturbed(5, &truth, 0.1, 0.05), 50).unwrap();
    let n = truth.len() - 1;
    let mut h = nalgebra::DMatrix::<f64>::zeros(6 * n, 6 * n);
    for edge in solution.graph().edges() {
        let at = edge.linearise(solution.values());
        for (a, ja) in [(edge.i, at.by_i), (edge.j, at.by_j)] {
            for (b, jb) in [(edge.i, at.by_i), (edge.j, at.by_j)] {
                if a > 0 && b > 0 {
                    let block = ja.transpose() * edge.information() * jb;
                    let mut view = h.view_mut((6 * (a - 1), 6 * (b - 1)), (6, 6));
                    view += block.fixed_view::<6, 6>(0, 0);
                }
            }
        }
    }
    let inverse = h.cholesky().unwrap().inverse();
    let block = |a: usize, b: usize| -> SMatrix<f64, 6, 6> {
        if a == 0 || b == 0 {
            SMatrix::zeros()
        } else {
            inverse.fixed_view::<6, 6>(6 * (a - 1), 6 * (b - 1)).into_owned()
        }
    };
    for reference in [0, 4, 11] {
        let all = solution.relatives_to(submap(0, reference), &BTreeSet::new());
        assert_eq!(all.len(), truth.len());
        for (id, from_all) in all {
            let k = id.index as usize;
            if k == reference {
                continue;
            }
            let t = (solution.values()[reference].inverse() * solution.values()[k]).to_se3();
            let a = t.inverse().adjoint();
            let want = block(k, k) - a * block(reference, k) - block(k, reference) * a.transpose()
                + a * block(reference, reference) * a.transpose();
            for got in [from_all, solution.relative(submap(0, reference), id, &BTreeSet::new()).unwrap()] {
                let Relative::Metric(got) = got else { panic!("rigid expected") };
                let error = (got.covariance.matrix() - want).amax() / want.amax();
                assert!(error < 1e-9, "{reference} -> {k}: {error}");
                assert!(got.pose.local(&t).norm() < 1e-12);
            }
        }
    }
}

#[test]
fn anees_of_anchors_lies_in_the_band() {
    let (runs, mut sum, mut count) = (200, 0.0, 0.0);
    for seed in 0..runs {
        let (truth, factors) = walk(1000 + seed, 20, false);
        let solution = solve(one_component(&truth, factors), perturbed(seed, &truth, 0.05, 0.02), 50).unwrap();
        let first = truth[&submap(0, 0)];
        for (id, relative) in solution.relatives_to(submap(0, 0), &BTreeSet::new()).into_iter().skip(1) {
            let Relative::Metric(p) = relative else { panic!("rigid expected") };
            sum += p.covariance.mahalanobis_squared(&p.pose.local(&(first.inverse() * truth[&id])));
            count += 1.0;
        }
    }
    let anees = sum / count / 6.0;
    eprintln!("ANEES / 6 of anchors over {runs} runs: {anees:.3}");
    assert!((0.9..=1.1).contains(&anees), "{anees}");
}

#[test]
fn scale_of_a_frame_of_unknown_unit_is_recovered() {
    let rng = &mut rng(21);
    for run in 0..20 {
        let scale = libm::exp(0.8 * normal(rng));
        let unknown = BTreeSet::from([frame(1)]);
        let mut truth = BTreeMap::new();
        let mut factors = Vec::new();
        for robot in 0..2 {
            let s = if robot == 1 { scale } else { 1.0 };
            let mut pose = any_pose(rng, 5.0);
            for k in 0..8 {
                let step = any_step(rng);
                if k > 0 {
                    pose = pose * step;
                    // A step of the frame is stated in the frame's own unit.
                    let own = Se3::new(step.rotation, step.translation / s);
                    let t_i_j = Relative::Metric(PoseWithCovariance { pose: own, covariance: sigmas(0.02 / s, 0.01) });
                    let (i, j) = (submap(robot, k - 1), submap(robot, k));
                    factors.push(Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 });
                }
                truth.insert(submap(robot, k), Sim3::new(pose.rotation, pose.translation, s));
            }
        }
        for (i, j) in [(submap(0, 1), submap(1, 2)), (submap(1, 6), submap(0, 5))] {
            let sim = truth[&i].inverse() * truth[&j];
            let covariance = Covariance::from_sigmas([0.05, 0.05, 0.05, 0.01, 0.01, 0.01, 0.02]).unwrap();
            let t_i_j = Relative::Similarity(SimWithCovariance { sim, covariance });
            factors.push(Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 });
        }
        let nodes = truth.keys().copied().collect();
        let graph = Graph::components(&nodes, &unknown, factors).unwrap().remove(0);
        assert_eq!(graph.scale_count(), 1);
        let start = truth.iter().map(|(id, t)| {
            let off = measured(rng, &t.to_se3(), sigmas(0.1, 0.05)).pose;
            Sim3::new(off.rotation, off.translation, if id.frame == frame(1) { t.scale * 1.2 } else { 1.0 })
        });
        let start = start.collect();
        let solution = solve(graph, start, 50).unwrap();
        assert!(solution.converged && solution.chi2 < 1e-12, "run {run}: χ² {}", solution.chi2);
        for (a, b) in [(submap(0, 0), submap(1, 7)), (submap(1, 0), submap(1, 7)), (submap(1, 3), submap(0, 7))] {
            let relative = solution.relative(a, b, &unknown).unwrap();
            let want = truth[&a].inverse() * truth[&b];
            assert!(relative.sim().local(&want).norm() < 1e-7, "run {run} {a} {b}");
            assert_eq!(matches!(relative, Relative::Metric(_)), a.frame == b.frame);
        }
        for (id, relative) in solution.relatives_to(submap(0, 3), &unknown) {
            if let Relative::Similarity(s) = relative {
                let Some(Relative::Similarity(direct)) = solution.relative(submap(0, 3), id, &unknown) else {
                    panic!()
                };
                let error = (s.covariance.matrix() - direct.covariance.matrix()).amax();
                assert!(error < 1e-9 * direct.covariance.matrix().amax(), "{id}: {error}");
            }
        }
    }
}

#[test]
fn components_stay_apart() {
    let (truth, factors) = walk(7, 10, false);
    let cut = |f: &Factor<SubmapId>| (f.i.index < 5) == (f.j.index < 5);
    let factors: Vec<_> = factors.into_iter().filter(cut).collect();
    let nodes = truth.keys().copied().collect();
    let graphs = Graph::components(&nodes, &BTreeSet::new(), factors).unwrap();
    assert_eq!(graphs.iter().map(|g| g.nodes().len()).collect::<Vec<_>>(), [5, 5]);
    assert_eq!(graphs[1].nodes()[0], submap(0, 5));
    let start = graphs[1].nodes().iter().map(|id| Sim3::from_se3(&truth[id])).collect();
    let solution = solve(graphs[1].clone(), start, 50).unwrap();
    assert!(solution.relative(submap(0, 5), submap(0, 4), &BTreeSet::new()).is_none());
}

#[test]
fn a_lone_anchor_is_a_solved_component() {
    let nodes = BTreeSet::from([submap(0, 0)]);
    let graph = Graph::components(&nodes, &BTreeSet::new(), Vec::new()).unwrap().remove(0);
    let solution = solve(graph, vec![Sim3::identity()], 10).unwrap();
    assert!(solution.converged && solution.chi2 == 0.0 && solution.dof == 0);
    assert_eq!(solution.relatives_to(submap(0, 0), &BTreeSet::new()).len(), 1);
}

#[test]
fn bad_factors_are_named() {
    let (truth, factors) = walk(9, 4, true);
    let nodes: BTreeSet<_> = truth.keys().copied().collect();
    let with = |change: &dyn Fn(&mut Factor<SubmapId>)| {
        let mut bad = factors.clone();
        change(&mut bad[1]);
        Graph::components(&nodes, &BTreeSet::new(), bad).map(|_| ()).unwrap_err()
    };
    let (i, j) = (submap(0, 1), submap(0, 2));
    let pose = |t: Vector3<f64>| {
        let pose = Se3::new(Se3::identity().rotation, t);
        Relative::Metric(PoseWithCovariance { pose, covariance: sigmas(0.1, 0.1) })
    };
    assert_eq!(with(&|f| f.t_i_j = pose(Vector3::new(0.0, f64::NAN, 0.0))), GraphError::NotFinite { i, j });
    assert_eq!(with(&|f| f.t_i_j = pose(Vector3::new(f64::INFINITY, 0.0, 0.0))), GraphError::NotFinite { i, j });
    assert_eq!(with(&|f| f.weight = 0.0), GraphError::NotFinite { i, j });
    assert_eq!(with(&|f| f.j = f.i), GraphError::SelfLoop { i });
    assert_eq!(with(&|f| f.j = submap(0, 4)), GraphError::UnknownNode { i, j: submap(0, 4) });
    let units = Graph::components(
        &BTreeSet::from([i, submap(1, 0)]),
        &BTreeSet::from([frame(1)]),
        vec![Factor { j: submap(1, 0), ..factors[1] }],
    );
    assert_eq!(units.unwrap_err(), GraphError::Units { i, j: submap(1, 0) });
    let graph = one_component(&truth, factors);
    assert_eq!(solve(graph, Vec::new(), 5).unwrap_err(), SolveError::Start { want: 4, got: 0 }.into());
}

/// χ² at GTSAM's Levenberg–Marquardt optimum of the same geodesic cost.
#[test]
fn published_graphs_reach_their_optimum() {
    for (name, optimum) in [("parking-garage", 1.2684), ("sphere2500", 1351.40)] {
        let Some(text) = shared(&format!("data/graphs/single/{name}.g2o")) else { return };
        let (nodes, factors) = read_g2o(&text);
        let ids = nodes.iter().map(|n| n.0).collect();
        let graph = Graph::components(&ids, &BTreeSet::new(), factors).unwrap().remove(0);
        let start = nodes.iter().map(|n| Sim3::from_se3(&n.1)).collect();
        let solution = solve(graph, start, 100).unwrap();
        eprintln!("{name}: χ² {:.4} after {} iterations", solution.chi2, solution.iterations);
        assert!(solution.converged && (solution.chi2 / optimum - 1.0).abs() < 1e-4, "{name}: {}", solution.chi2);
    }
}

/// The leave-one-out statistic needs no second solve; here is the second solve.
#[test]
fn leave_one_out_equals_the_innovation_against_the_map_without_the_factor() {
    let (truth, mut factors) = walk(17, 16, false);
    factors.last_mut().unwrap().label = Source::Measurement(0);
    let tested = *factors.last().unwrap();
    let start = perturbed(17, &truth, 0.02, 0.01);
    let with = solve(one_component(&truth, factors.clone()), start.clone(), 50).unwrap();
    factors.pop();
    let without = solve(one_component(&truth, factors), start, 50).unwrap();
    let predicted = without.relative(tested.i, tested.j, &BTreeSet::new()).unwrap();
    let want = predicted.disagreement(&tested.t_i_j).distance_squared;
    let edge = with.graph().edges().iter().find(|e| e.label == tested.label).unwrap();
    let LeftOut { chi2: got, dof, .. } = leave_one_out(&with, &with.selected_inverse(), edge).unwrap();
    assert!(dof == 6 && (got / want - 1.0).abs() < 0.02, "{got} {want}");
}

/// Three measurements a pose, at random, leave nothing sparse: dense, the factor of 5,000 poses takes 7 GB.
#[test]
fn a_graph_that_is_tied_all_over_is_refused_before_it_takes_memory() {
    let (rng, poses) = (&mut rng(1), 5_000);
    let t_i_j = Relative::Metric(PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(0.1, 0.1) });
    let factor = |(i, j): (usize, usize)| {
        let (i, j) = (submap(0, i), submap(0, j));
        Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 }
    };
    let chain = (1..poses).map(|k| (k - 1, k)).collect::<Vec<_>>();
    let random = (0..3 * poses).map(|_| (rng.random_range(0..poses), rng.random_range(0..poses)));
    let factors = chain.into_iter().chain(random).filter(|(i, j)| i != j).map(factor).collect();
    let nodes = (0..poses).map(|k| submap(0, k)).collect();
    let graph = Graph::components(&nodes, &BTreeSet::new(), factors).unwrap().remove(0);
    let start = vec![Sim3::identity(); poses];
    let error = solve(graph.clone(), start.clone(), 5).unwrap_err();
    assert!(matches!(error, ComponentError::Solve(SolveError::TooDense { limit: FACTOR_BYTES_MAX, .. })), "{error}");
    assert_eq!(minimum(&graph, start, 5).unwrap_err(), error);
    assert!(error.to_string().contains("4096 are allowed"), "{error}");
}

#[test]
fn what_is_not_determined_is_named_by_its_submap_or_frame() {
    let graph = {
        let sim = SimWithCovariance { sim: Sim3::identity(), covariance: Covariance::from_sigmas([0.1; 7]).unwrap() };
        let rigid = PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(0.1, 0.1) };
        let factor = |i, j, t_i_j| Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 };
        let factors = vec![
            factor(submap(0, 0), submap(1, 0), Relative::Similarity(sim)),
            factor(submap(1, 0), submap(1, 1), Relative::Metric(rigid)),
        ];
        let nodes = [submap(0, 0), submap(1, 0), submap(1, 1)].into();
        Graph::components(&nodes, &[frame(1)].into(), factors).unwrap().remove(0)
    };
    let of = |variable| ComponentError::of(SolveError::Underconstrained { variable }, &graph);
    assert_eq!(of(0), ComponentError::UnderconstrainedNode(submap(1, 0)));
    assert_eq!(of(1), ComponentError::UnderconstrainedNode(submap(1, 1)));
    assert_eq!(of(2), ComponentError::UnderconstrainedScale(frame(1)));
    assert_eq!(of(3), ComponentError::Solve(SolveError::Underconstrained { variable: 3 }));
    assert_eq!(ComponentError::of(SolveError::NotFinite, &graph), SolveError::NotFinite.into());
}

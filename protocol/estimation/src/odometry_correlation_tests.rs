use super::*;
use crate::geometry::{Relative, Se3, Sim3};
use crate::graph::Factor;
use crate::solve::solve;
use crate::test_graphs::{any_pose, any_step, frame, measured, rng, sigmas, submap};
use core::num::NonZero;
use nalgebra::{DMatrix, SMatrix, Vector6};
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeSet;

/// The anchor that has a cloud.
const MIDDLE: usize = 1;

fn walk() -> DriftModel {
    DriftModel { whole: sigmas(0.1, 0.03), keyframes: NonZero::new(4) }
}

fn any_measured(rng: &mut ChaCha8Rng) -> PoseWithCovariance {
    let step = any_step(rng);
    measured(rng, &step, sigmas(0.1, 0.03))
}

/// Three anchors, the cloud of the middle one, and a measurement that ties the cloud to the first.
fn chain(rng: &mut ChaCha8Rng) -> (Graph<Node>, Vec<Sim3>) {
    let anchor = |index| Node::Anchor(submap(0, index));
    let cloud = Node::Cloud(submap(0, MIDDLE));
    let steps: [PoseWithCovariance; 2] = core::array::from_fn(|_| any_measured(rng));
    let (left, gains) = conditional_covariance(&sigmas(0.02, 0.01), &walk(), [Some(&steps[0]), Some(&steps[1])]);
    let factor = |label, i, j, t: PoseWithCovariance| Factor { label, i, j, t_i_j: Relative::Metric(t), weight: 1.0 };
    let at = PoseWithCovariance { pose: Se3::identity(), covariance: left };
    let seen = measured(rng, &steps[0].pose, sigmas(0.05, 0.02));
    let factors = vec![
        factor(Label::Odometry, anchor(0), anchor(1), steps[0]),
        factor(Label::Odometry, anchor(1), anchor(2), steps[1]),
        factor(Label::Cloud, anchor(MIDDLE), cloud, at),
        factor(Label::Alignment(crate::ids::EntryId { frame: frame(0), seq: 0 }), anchor(0), cloud, seen),
    ];
    let nodes = BTreeSet::from([anchor(0), anchor(1), anchor(2), cloud]);
    let mut graph = Graph::components(&nodes, &BTreeSet::new(), factors).unwrap().remove(0);
    graph.correlate(&BTreeMap::from([(submap(0, 1), gains)]));
    let first = any_pose(rng, 5.0);
    let second = first * steps[0].pose;
    let near = |pose: Se3, rng: &mut ChaCha8Rng| Sim3::from_se3(&measured(rng, &pose, sigmas(0.1, 0.05)).pose);
    let values = [first, second, second * steps[1].pose, second].map(|pose| near(pose, rng));
    (graph, values.to_vec())
}

fn cloud_of(graph: &Graph<Node>) -> (&Edge<Node>, &Correlation) {
    let (place, edge) = graph.cloud_of(MIDDLE).unwrap();
    (edge, &graph.correlations[&place])
}

fn moved(values: &[Sim3], node: usize, direction: usize, by: f64) -> Vec<Sim3> {
    let mut out = values.to_vec();
    let mut step = SMatrix::<f64, 7, 1>::zeros();
    step[direction] = by;
    out[node] = out[node].retract(&step);
    out
}

#[test]
fn jacobians_by_all_four_nodes_match_finite_differences() {
    for seed in 0..20 {
        let (graph, values) = chain(&mut rng(seed));
        let (edge, correlation) = cloud_of(&graph);
        let exact = correlation.linearise(&graph, edge, &values);
        assert_eq!(exact.by.iter().map(|(node, _)| *node).collect::<Vec<_>>(), [0, 1, 2, 3]);
        assert_eq!(graph.nodes_of(correlation, edge), [0, 1, 2, 3]);
        assert!((exact.residual - correlation.residual(&graph, edge, &values)).amax() < 1e-12);
        for (node, jacobian) in &exact.by {
            for k in 0..6 {
                let at = |by| correlation.residual(&graph, edge, &moved(&values, *node, k, by));
                let numeric: Vector6<f64> = (at(1e-6) - at(-1e-6)) / 2e-6;
                let error = (numeric - jacobian.column(k)).amax();
                assert!(error < 1e-6 * (1.0 + jacobian.amax()), "seed {seed} node {node} direction {k}: {error}");
            }
        }
    }
}

/// The solver's covariances are those of the inverse of a dense Hessian, by finite differences of what χ² is made of.
#[test]
fn the_solver_takes_the_factor_for_what_it_is() {
    let (graph, start) = chain(&mut rng(3));
    let before = graph.chi2(&start);
    let solution = solve(graph, start, 50).unwrap();
    assert!(solution.converged && solution.chi2 < before);
    let (graph, values) = (solution.graph(), solution.values());
    let gradient_of = |k: usize| {
        let at = |by| graph.chi2(&moved(values, 1 + k / 6, k % 6, by));
        (at(1e-5) - at(-1e-5)) / 2e-5
    };
    assert!((0..18).all(|k| gradient_of(k).abs() < 1e-4), "not at the minimum");
    // Whitened residuals, cloud and all.
    let rows = |values: &[Sim3]| -> Vec<f64> {
        let one = |(k, edge): (usize, &Edge<Node>)| {
            let plain = edge.residual(values).fixed_rows::<6>(0).into_owned();
            let r = graph.correlations.get(&k).map_or(plain, |correlation| correlation.residual(graph, edge, values));
            let whitened: Vector6<f64> = edge.information_rigid().cholesky().unwrap().l().transpose() * r;
            whitened.iter().copied().collect::<Vec<f64>>()
        };
        graph.edges().iter().enumerate().flat_map(one).collect()
    };
    let column = |k: usize| {
        let [up, down] = [1e-6, -1e-6].map(|by| rows(&moved(values, 1 + k / 6, k % 6, by)));
        up.iter().zip(down).map(|(a, b)| (a - b) / 2e-6).collect::<Vec<f64>>()
    };
    let jacobian = DMatrix::from_columns(&(0..18).map(|k| column(k).into()).collect::<Vec<_>>());
    let inverse = (jacobian.transpose() * jacobian).try_inverse().unwrap();
    for node in 1..4 {
        let own: Matrix6<f64> = inverse.fixed_view::<6, 6>(6 * (node - 1), 6 * (node - 1)).into_owned();
        let Some(Relative::Metric(t)) = solution.relative(graph.nodes()[0], graph.nodes()[node], &BTreeSet::new())
        else {
            panic!("node {node}")
        };
        assert!((t.covariance.matrix() - own).amax() < 1e-5 * own.amax(), "node {node}");
    }
    // The same of all at once, by the selected inverse.
    for (id, t) in solution.relatives_to(graph.nodes()[0], &BTreeSet::new()) {
        let Some(Relative::Metric(alone)) = solution.relative(graph.nodes()[0], id, &BTreeSet::new()) else { panic!() };
        let Relative::Metric(t) = t else { panic!() };
        assert!((t.covariance.matrix() - alone.covariance.matrix()).amax() < 1e-12);
    }
}

#[test]
fn what_is_left_of_a_cloud_is_less_and_positive() {
    let mut rng = rng(5);
    let common = sigmas(0.02, 0.01);
    for keyframes in (1..12).map(NonZero::new).chain([None]) {
        let walk = DriftModel { keyframes, ..walk() };
        let [to, from]: [PoseWithCovariance; 2] = core::array::from_fn(|_| any_measured(&mut rng));
        let volume = |steps| conditional_covariance(&common, &walk, steps).0.matrix().determinant();
        let alone = volume([None, None]);
        let least = (1.0 - 1e-9) * common.matrix().determinant();
        assert_eq!(volume([Some(&to), None]) < alone, walk.before_anchor().is_some(), "{keyframes:?}");
        assert_eq!(volume([None, Some(&from)]) < alone, walk.after_anchor().is_some(), "{keyframes:?}");
        assert!(volume([Some(&to), Some(&from)]) > least);
        // A step over a gap tells little of what was lost beside the anchor.
        let gap = PoseWithCovariance { covariance: sigmas(10.0, 1.0), ..from };
        assert!(volume([None, Some(&gap)]) > 0.99 * alone);
        // One that is surer than the walk (nobody's odometry is) takes away no more than there is.
        let sure = PoseWithCovariance { covariance: sigmas(1e-5, 1e-5), ..from };
        assert!(volume([None, Some(&sure)]) > least);
    }
}

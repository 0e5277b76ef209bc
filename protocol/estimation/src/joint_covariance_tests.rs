//! Joint covariances against dense algebra and against the truth.

use super::super::graph::{Factor, Graph, Source};
use super::super::solve::solve;
use super::super::test_graphs::*;
use super::super::test_world::World;
use super::*;
use crate::geometry::Covariance;
use crate::ids::FrameId;
use crate::kinds::ScaleKind;

/// The world's measurements, all taken, as one component.
fn solved(world: &World) -> (Solution<SubmapId>, BTreeSet<FrameId>) {
    let unknown = world.problem.frames.iter().filter(|(_, chain)| chain.scale == ScaleKind::Unknown);
    let unknown: BTreeSet<FrameId> = unknown.map(|(frame, _)| *frame).collect();
    let mut factors = Vec::new();
    for (&frame, chain) in &world.problem.frames {
        let id = |index: usize| SubmapId { frame, index: index as u32 };
        let step = |k: usize| (id(k - 1), id(k), Relative::Metric(chain.odometry[k]));
        let steps = (1..chain.odometry.len()).map(step);
        factors.extend(steps.map(|(i, j, t_i_j)| Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 }));
    }
    let stated = world.problem.alignments.iter();
    factors.extend(stated.enumerate().map(|(k, m)| Factor {
        label: Source::Measurement(k),
        i: m.i,
        j: m.j,
        t_i_j: m.t_i_j,
        weight: 1.0,
    }));
    let nodes = world.truth.keys().copied().collect();
    let graph = Graph::components(&nodes, &unknown, factors).unwrap().remove(0);
    let start = graph.nodes().iter().map(|&id| world.anchor(id)).collect();
    (solve(graph, start, 50).unwrap(), unknown)
}

fn world(seed: u64, scales: &[Option<f64>], anchors: usize) -> World {
    let rng = &mut rng(seed);
    let mut world = World::scaled(rng, scales, anchors, false);
    world.align_all(rng, 4, false);
    world
}

/// The row block of `δ_node` over all scalars.
fn row_block(solution: &Solution<SubmapId>, node: usize) -> DMatrix<f64> {
    let mut out = DMatrix::zeros(7, solution.pattern.scalars());
    for (scalar, column) in solution.row_block(node, &Matrix7::identity()) {
        out.column_mut(scalar).copy_from(&column);
    }
    out
}

fn dense_inverse(solution: &Solution<SubmapId>) -> DMatrix<f64> {
    let n = solution.pattern.scalars();
    let mut h = DMatrix::zeros(n, n);
    for edge in solution.graph.edges() {
        let at = edge.linearise(&solution.values);
        let jacobian = at.by_i * row_block(solution, edge.i) + at.by_j * row_block(solution, edge.j);
        h += jacobian.transpose() * edge.information() * &jacobian;
    }
    h.cholesky().unwrap().inverse()
}

#[test]
fn joint_covariances_match_a_dense_inverse() {
    for (seed, scales) in
        [(1, [None, None, None]), (2, [None, Some(0.4), None]), (3, [Some(2.0), Some(0.4), Some(1.5)])]
    {
        let world = world(seed, &scales, 9);
        let (solution, unknown) = solved(&world);
        let inverse = dense_inverse(&solution);
        let chosen = [submap(0, 8), submap(2, 3), submap(1, 5), submap(0, 0), submap(1, 0), submap(2, 8)];
        for reference in [submap(0, 0), submap(1, 5), submap(2, 1)] {
            let r = solution.graph.position(reference).unwrap();
            let joint = solution.joint(reference, &chosen, &unknown).unwrap();
            assert_eq!((joint.anchors(), joint.reference()), (&chosen[..], reference));
            let mut blocks = Vec::new();
            for (k, &id) in chosen.iter().enumerate() {
                let node = solution.graph.position(id).unwrap();
                let t = solution.values[node].inverse() * solution.values[r];
                let block = row_block(&solution, node) - t.adjoint() * row_block(&solution, r);
                blocks.extend(block.row_iter().take(joint.rows(k).unwrap().len()).map(|row| row.into_owned()));
            }
            let a = DMatrix::from_rows(&blocks);
            let want = &a * &inverse * a.transpose();
            let got = joint.covariance();
            assert_eq!(got.shape(), want.shape());
            assert_eq!(got, &got.transpose());
            // By the standard deviations of either row; those of what is certain by definition are zero.
            let sigma = |k: usize| want[(k, k)].max(1e-12).sqrt();
            for (x, y) in (0..got.nrows()).flat_map(|x| (0..got.ncols()).map(move |y| (x, y))) {
                let off = (got[(x, y)] - want[(x, y)]).abs() / (sigma(x) * sigma(y));
                assert!(off < 1e-8, "seed {seed}, {reference:?}, ({x}, {y}): {off}");
            }
            let largest_cross = want.view((0, 6), (6, 6)).amax();
            assert!(largest_cross > 1e-6 && joint.rows(99).is_none());
        }
    }
}

#[test]
fn pairs_of_a_joint_covariance_are_the_pairs_of_the_map() {
    for (seed, scales) in
        [(4, [None, None, None]), (5, [None, Some(0.4), None]), (6, [Some(2.0), Some(0.4), Some(1.5)])]
    {
        let world = world(seed, &scales, 9);
        let (solution, unknown) = solved(&world);
        let chosen: Vec<SubmapId> = solution.graph.nodes().to_vec();
        let joint = solution.joint(submap(1, 4), &chosen, &unknown).unwrap();
        let pairs: Vec<_> = chosen.iter().flat_map(|&a| chosen.iter().map(move |&b| (a, b))).collect();
        for (&(a, b), together) in pairs.iter().zip(solution.relatives(pairs.iter().copied(), &unknown)) {
            let want = solution.relative(a, b, &unknown).unwrap();
            for got in [joint.relative(a, b).unwrap(), together.unwrap()] {
                assert_eq!(got.metric().is_some(), want.metric().is_some());
                assert!(got.sim().local(&want.sim()).norm() < 1e-9);
                let (got, want) = (covariance(&got), covariance(&want));
                let off = (&got - &want).amax() / want.amax();
                assert!(off < 1e-8, "seed {seed}, {a:?} {b:?}: {off}");
            }
        }
        assert!(joint.relative(submap(1, 4), submap(1, 99)).is_none());
        let pairs = [(submap(1, 4), submap(1, 99)), (submap(0, 1), submap(0, 2))];
        let found = solution.relatives(pairs, &unknown);
        assert!(found[0].is_none() && found[1].is_some());
    }
}

fn covariance(t: &Relative) -> DMatrix<f64> {
    fn dense<const N: usize>(c: &Covariance<N>) -> DMatrix<f64> {
        DMatrix::from_iterator(N, N, c.matrix().iter().copied())
    }
    match t {
        Relative::Metric(p) => dense(&p.covariance),
        Relative::Similarity(s) => dense(&s.covariance),
    }
}

/// Four anchors of three robots by a fourth: 24 numbers whose error the joint covariance claims to know.
#[test]
fn anees_of_a_joint_estimate_lies_in_the_band() {
    let (runs, mut sum, mut alone) = (150, 0.0, 0.0);
    let chosen = [submap(0, 11), submap(1, 3), submap(1, 4), submap(2, 11)];
    for seed in 0..runs {
        let world = world(9_000 + seed, &[None, None, None], 12);
        let (solution, unknown) = solved(&world);
        let joint = solution.joint(submap(0, 2), &chosen, &unknown).unwrap();
        let mut error = Vec::new();
        for (&id, pose) in chosen.iter().zip(joint.poses()) {
            let truth = world.truth[&submap(0, 2)].inverse() * world.truth[&id];
            error.extend(pose.to_se3().local(&truth).iter().copied());
        }
        let error = nalgebra::DVector::from_vec(error);
        let by_all = joint.covariance().clone().cholesky().unwrap();
        sum += error.dot(&by_all.solve(&error)) / 24.0;
        // As if the anchors had nothing to do with one another.
        let blocks = DMatrix::from_fn(24, 24, |r, c| if r / 6 == c / 6 { joint.covariance()[(r, c)] } else { 0.0 });
        alone += blocks.cholesky().unwrap().determinant().ln() - by_all.determinant().ln();
    }
    let anees = sum / runs as f64;
    println!(
        "{runs} runs: ANEES/24 {anees:.3}; ln det of the marginals exceeds the joint's by {:.1}",
        alone / runs as f64
    );
    assert!((0.93..=1.07).contains(&anees), "{anees}");
    assert!(alone / runs as f64 > 1.0, "neighbours must be correlated");
}

#[test]
fn joint_covariances_are_bounded_and_name_what_is_wrong() {
    let world = world(7, &[None, None, None], 50);
    let (solution, unknown) = solved(&world);
    let nodes = solution.graph.nodes();
    let most = solution.joint(nodes[0], &nodes[1..=JOINT_ANCHORS_MAX], &unknown).unwrap();
    assert_eq!(most.covariance().nrows(), 6 * JOINT_ANCHORS_MAX);
    let error = |anchors: &[SubmapId]| solution.joint(nodes[0], anchors, &unknown).unwrap_err();
    assert_eq!(error(&nodes[..=JOINT_ANCHORS_MAX]), JointError::TooMany { got: JOINT_ANCHORS_MAX + 1 });
    assert_eq!(error(&[nodes[1], nodes[2], nodes[1]]), JointError::Twice(nodes[1]));
    assert_eq!(error(&[nodes[1], submap(9, 1)]), JointError::Apart(submap(9, 1)));
    assert_eq!(solution.joint(submap(9, 1), &[], &unknown).unwrap_err(), JointError::Apart(submap(9, 1)));
    assert_eq!(solution.joint(nodes[0], &[], &unknown).unwrap().covariance().len(), 0);
}

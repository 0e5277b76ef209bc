use super::*;
use crate::drift_model::DriftModel;
use crate::geometry::{Se3, SimWithCovariance};
use crate::ids::EntryId;
use crate::joint::{AgreedAlignment, JointEstimate};
use crate::test_graphs::{frame, normal, rng, submap};
use crate::test_walks::{Walked, walked};
use crate::test_world::{ALIGNMENT, World, bits, rigid};
use nalgebra::{DMatrix, Vector6};
use rand_chacha::ChaCha8Rng;

const WORLDS: u64 = 100;

fn sigmas() -> Vector6<f64> {
    Vector6::from([ALIGNMENT.0, ALIGNMENT.0, ALIGNMENT.0, ALIGNMENT.1, ALIGNMENT.1, ALIGNMENT.1])
}

/// Three robots side by side, many submaps of any two of them aligned, with errors that come from the submaps to twice
/// the share `common`, stated as large as they are, and of clouds that their odometry bent.
fn bent_world(rng: &mut ChaCha8Rng, common: f64) -> World {
    const ANCHORS: u32 = 8;
    let Walked { mut world, clouds, .. } = walked(rng, 3, ANCHORS as usize, 5);
    let noise =
        |rng: &mut ChaCha8Rng, share: f64| Se3::exp(&Vector6::from_fn(|k, _| sigmas()[k] * share.sqrt() * normal(rng)));
    let bent: BTreeMap<SubmapId, Se3> =
        clouds.into_iter().map(|(id, cloud)| (id, cloud * noise(rng, common))).collect();
    let variance = Matrix6::from_diagonal(&sigmas().component_mul(&sigmas()));
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        for (k, l) in (0..ANCHORS).flat_map(|k| [0, 1, 3].map(|gap| (k, (k + gap) % ANCHORS))) {
            let (i, j) = (submap(a, k as usize), submap(b, l as usize));
            let truth = world.truth[&i].inverse() * world.truth[&j];
            let pose = bent[&i].inverse() * bent[&j] * noise(rng, 1.0 - 2.0 * common);
            let lever = truth.inverse().adjoint();
            let covariance = lever * variance * lever.transpose() * common + variance * (1.0 - common);
            let covariance = Covariance::new(covariance).unwrap();
            world.state(i, j, Relative::Metric(PoseWithCovariance { pose, covariance }));
        }
    }
    world.problem.common = world.problem.alignments.iter().map(|a| (a.entry, common)).collect();
    world
}

/// Mean NEES of frames and of anchors, seen from the first anchor of the first frame.
fn nees(worlds: &mut dyn Iterator<Item = World>) -> [f64; 2] {
    let (mut frames, mut anchors, mut counts) = (0.0, 0.0, [0.0; 2]);
    for world in worlds {
        let map = world.solve();
        for other in [1, 2] {
            let t = rigid(&map.frame(frame(0), frame(other)).unwrap());
            frames +=
                t.covariance.mahalanobis_squared(&world.frame_truth(frame(0), frame(other)).to_se3().local(&t.pose));
            counts[0] += 1.0;
        }
        let t_world_frame = world.frames[&frame(0)].to_se3();
        for (id, t) in map.anchors(frame(0)).iter().filter(|(id, _)| *id != submap(0, 0)) {
            let t = rigid(t);
            let truth = t_world_frame.inverse() * world.truth[id];
            anchors += t.covariance.mahalanobis_squared(&truth.local(&t.pose));
            counts[1] += 1.0;
        }
    }
    assert_eq!(counts, [2.0 * WORLDS as f64, 23.0 * WORLDS as f64], "clouds are no submaps");
    [frames / counts[0], anchors / counts[1]]
}

#[test]
fn maps_of_bent_clouds_are_as_sure_as_they_say_and_not_if_nobody_knows() {
    for common in [COMMON_LIDAR, COMMON_BENT] {
        let worlds = || (0..WORLDS).map(|seed| bent_world(&mut rng(seed), common));
        let [frames, anchors] = nees(&mut worlds());
        println!("common {common}: NEES of frames {frames:.2}, of anchors {anchors:.2}");
        // A world is one sample of χ²₆, of variance 12: what its frames and anchors err by is much alike. 99 %.
        let off = 2.576 * (12.0 / WORLDS as f64).sqrt();
        assert!((frames - 6.0).abs() < off && (anchors - 6.0).abs() < off, "{common}: {frames} {anchors}");
        let unaware = |mut world: World| {
            world.problem.common.clear();
            world
        };
        let [frames, anchors] = nees(&mut worlds().map(unaware));
        println!("as if independent: {frames:.2}, {anchors:.2}");
        assert!(anchors > 6.0 + off, "{common}: {frames} {anchors}");
    }
}

fn edge(seq: u32, i: SubmapId, j: SubmapId, t_i_j: Relative, common: f64) -> EdgeEstimate {
    let entry = EntryId { frame: i.frame, seq };
    let new = EdgeEstimate::new(Kind::Alignment, AgreedAlignment { entry, i, j, t_i_j });
    EdgeEstimate { common, weight: 1.0, ..new }
}

fn pose(rng: &mut ChaCha8Rng, sigma: f64) -> Relative {
    let pose = Se3::exp(&Vector6::from_fn(|_, _| normal(rng)));
    let spread = Matrix6::from_fn(|_, _| normal(rng));
    let covariance = (spread * spread.transpose() + Matrix6::identity()) * (sigma * sigma);
    Relative::Metric(PoseWithCovariance { pose, covariance: Covariance::new(covariance).unwrap() })
}

fn covariance(factor: &Factor<Node>) -> Matrix6<f64> {
    *factor.t_i_j.metric().unwrap().covariance.matrix()
}

#[test]
fn a_single_alignment_of_a_submap_is_left_as_it_is() {
    let rng = &mut rng(1);
    let all: Vec<EdgeEstimate> =
        (0..3).map(|k| edge(k, submap(1, k as usize), submap(2, k as usize), pose(rng, 0.01), 0.4)).collect();
    let all: Vec<&EdgeEstimate> = all.iter().collect();
    assert_eq!(factors(&all, |_| None).0, all.iter().map(|edge| edge.factor()).collect::<Vec<_>>());
}

/// What its clouds are uncertain by and what is left of it, together, are never less than an alignment's covariance,
/// and no more where all are alike.
#[test]
fn no_alignment_claims_more_than_it_did() {
    let rng = &mut rng(2);
    let alike = pose(rng, 0.01);
    for same in [true, false] {
        let mut t = |k: u32| if same { alike } else { pose(rng, 0.01 * f64::from(1 + k)) };
        let all: Vec<EdgeEstimate> = (0..9)
            .map(|k| {
                let (i, j) = (submap(1, k as usize / 3), submap(2, k as usize % 3));
                EdgeEstimate { weight: if k == 4 { 0.25 } else { 1.0 }, ..edge(k, i, j, t(k), COMMON_MAX) }
            })
            .collect();
        let (graph, _) = factors(&all.iter().collect::<Vec<_>>(), |_| None);
        let cloud = |node: Node| covariance(graph.iter().find(|f| f.label == Label::Cloud && f.j == node).unwrap());
        assert_eq!(graph.iter().filter(|f| f.label == Label::Cloud).count(), 6);
        for (edge, factor) in all.iter().zip(&graph[6..]) {
            let AgreedAlignment { i, j, .. } = edge.measurement;
            assert!((factor.i, factor.j) == (Node::Cloud(i), Node::Cloud(j)) && factor.weight == 1.0);
            let Some(PoseWithCovariance { pose, covariance: claimed }) = edge.measurement.t_i_j.metric() else {
                panic!()
            };
            let lever = pose.inverse().adjoint();
            let sum = covariance(factor) + cloud(factor.j) + lever * cloud(factor.i) * lever.transpose();
            let stated = claimed.matrix() / edge.weight;
            let more = stated.cholesky().unwrap().l().solve_lower_triangular(&(sum - stated)).unwrap();
            let more = stated.cholesky().unwrap().l().solve_lower_triangular(&more.transpose()).unwrap();
            let least = DMatrix::from_iterator(6, 6, more.iter().copied()).symmetric_eigen().eigenvalues.min();
            assert!(least > -1e-9, "{least}");
            let left = DMatrix::from_iterator(6, 6, covariance(factor).iter().copied()).symmetric_eigen();
            assert!(left.eigenvalues.min() > 0.0);
        }
    }
}

#[test]
fn a_cloud_lies_off_its_anchor_by_a_twelfth_of_the_walk() {
    let all = [0, 1].map(|k| edge(k, submap(1, 0), submap(2, k as usize), pose(&mut rng(8), 0.01), 0.2));
    let all: Vec<&EdgeEstimate> = all.iter().collect();
    let walk = DriftModel { whole: Covariance::from_sigmas([0.6; 6]).unwrap(), keyframes: None };
    let around = |walk: &DriftModel| Around { walk: *walk, steps: [None; 2] };
    let [none, some] = [None, Some(walk)].map(|walk| covariance(&factors(&all, |_| walk.as_ref().map(around)).0[0]));
    assert!((some - none - Matrix6::from_diagonal_element(0.03)).amax() < 1e-12);
}

#[test]
fn charges_count_the_others_of_both_submaps() {
    let t = pose(&mut rng(4), 0.01);
    // Submap 1#3 is aligned with five of robot 2 and one of robot 3.
    let mut all: Vec<EdgeEstimate> = (0..5).map(|n| edge(n, submap(1, 3), submap(2, n as usize), t, 0.25)).collect();
    all.push(edge(5, submap(3, 0), submap(1, 3), t, 0.25));
    charge(&mut all);
    assert_eq!(all[0].charges, Charges { between: 2.0, in_all: 2.25 });
    assert_eq!(all[5].charges, Charges { between: 1.0, in_all: 2.25 });
    assert!(
        (all[0].among_others().metric().unwrap().covariance.matrix() / 2.0 - t.metric().unwrap().covariance.matrix())
            .amax()
            < 1e-12
    );
    // The graph knows of it, but for similarities.
    assert_eq!(all[0].weight_at(2.0), 0.25);
    let sim = SimWithCovariance { sim: t.sim(), covariance: Covariance::from_sigmas([0.01; 7]).unwrap() };
    all[0].measurement.t_i_j = Relative::Similarity(sim);
    assert_eq!(all[0].weight_at(2.0), 0.25 / 2.25);
    assert_eq!(factors(&[&all[0]], |_| None).0[0].weight, all[0].weight);
}

#[test]
fn shares_are_bounded() {
    let given = [-1.0, 0.0, 0.3, COMMON_MAX, 0.46, f64::INFINITY, f64::NAN];
    assert_eq!(given.map(bounded), [0.0, 0.0, 0.3, COMMON_MAX, COMMON_MAX, COMMON_MAX, 0.0]);
}

#[test]
fn the_order_of_facts_makes_no_difference_to_clouds() {
    let world = bent_world(&mut rng(5), 0.4);
    let mut turned = bent_world(&mut rng(5), 0.4);
    turned.problem.alignments.reverse();
    let map: JointEstimate = world.solve();
    assert!(bits(&map) == bits(&turned.solve()) && map.edges().iter().all(EdgeEstimate::is_used));
}

/// A submap that lies in the wrong place by two alignments of five is found out.
#[test]
fn a_cloud_is_no_excuse_for_a_lie() {
    let rng = &mut rng(6);
    let mut world = bent_world(rng, COMMON_BENT);
    let lies: Vec<EntryId> = world.problem.alignments.iter().filter(|a| a.i == submap(0, 2)).map(|a| a.entry).collect();
    for alignment in world.problem.alignments.iter_mut().filter(|a| lies[..2].contains(&a.entry)) {
        let Relative::Metric(t) = &mut alignment.t_i_j else { continue };
        t.pose = Se3::new(t.pose.rotation, t.pose.translation + nalgebra::Vector3::new(0.8, 0.0, 0.0));
    }
    let map = world.solve();
    let used = |entry: &EntryId| map.edges().iter().any(|e| e.measurement.entry == *entry && e.is_used());
    assert_eq!(
        lies.iter().map(used).collect::<Vec<_>>(),
        [[false; 2].as_slice(), &vec![true; lies.len() - 2]].concat()
    );
}

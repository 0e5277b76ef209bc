use super::super::joint::*;
use super::super::test_graphs::*;
use super::super::test_world::*;
use super::*;
use crate::ids::FrameId;
use crate::kinds::PairStatus;
use proptest::prelude::*;
use rand::RngExt;
use rand::seq::SliceRandom;
use rand_chacha::ChaCha8Rng;

/// Standard deviations along the three axes of `i`, m: ranges and bearings of a robot on a floor.
const SIGMAS: [f64; 3] = [0.03, 0.02, 0.05];

fn covariance() -> Covariance<3> {
    Covariance::from_sigmas(SIGMAS).unwrap()
}

/// A robot at `p_j` in the frame of `j`'s anchor, as it is seen from `i`, with noise if there is any to draw from.
fn seen(world: &World, rng: Option<&mut ChaCha8Rng>, i: SubmapId, j: SubmapId, p_j: Vector3<f64>) -> SeenPoint {
    let noise = rng.map_or_else(Vector3::zeros, |rng| Vector3::from(SIGMAS.map(|sigma| sigma * normal(rng))));
    SeenPoint { p_i: world.truth[&i].inverse() * (world.truth[&j] * p_j) + noise, p_j, covariance: covariance() }
}

fn state(world: &mut World, i: SubmapId, j: SubmapId, point: SeenPoint) -> EntryId {
    let entry = EntryId { frame: i.frame, seq: 1000 + world.next };
    world.next += 1;
    world.problem.positions.push(StatedPoint { entry, i, j, point });
    entry
}

proptest! {
    /// A pose that has the point where it was seen has no residual, however it is turned; and the information along the
    /// three axes is that of the measurement.
    #[test]
    fn the_completed_pose_says_where_the_point_is_and_nothing_else(seed in any::<u64>()) {
        let rng = &mut rng(seed);
        let t_i_j = any_pose(rng, 10.0);
        let p_j = any_pose(rng, 5.0).translation;
        let point = SeenPoint { p_i: t_i_j * p_j, p_j, covariance: covariance() };
        let off = So3::exp(&(Vector3::from_fn(|_, _| 0.01 * normal(rng))));
        let completed = rigid(&point.completed(&(off * t_i_j.rotation)));
        prop_assert!((completed.pose * p_j - point.p_i).norm() < 1e-9);
        // Of the truth nothing is missing but what the rotation is off by.
        let r = completed.pose.local(&t_i_j);
        prop_assert!(completed.covariance.mahalanobis_squared(&r) < 0.02, "{r}");
        // Of a pose beside it, what the point is off by.
        let beside = t_i_j * Se3::new(So3::identity(), Vector3::from_fn(|_, _| 0.1 * normal(rng)));
        let e = point.p_i - beside * p_j;
        let want = covariance().mahalanobis_squared(&e);
        let got = completed.covariance.mahalanobis_squared(&completed.pose.local(&beside));
        prop_assert!((got - want).abs() < 0.05 * want + 0.05, "{got} {want}");
    }
}

#[test]
fn positions_make_the_map_better_and_as_sure_as_it_says() {
    let (runs, mut nees, mut errors) = (200, Vec::new(), [0.0; 2]);
    for seed in 0..runs {
        let rng = &mut rng(90_000 + seed);
        let mut world = World::new(rng, 2, 15, false);
        world.align_all(rng, 4, false);
        let truth = world.frame_truth(frame(0), frame(1)).to_se3();
        let before = world.solve().frame(frame(0), frame(1)).map(|t| rigid(&t));
        for k in 0..15 {
            let p_j = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0));
            let (i, j) = (submap(0, k), submap(1, rng.random_range(0..15)));
            let point = seen(&world, Some(rng), i, j, p_j);
            state(&mut world, i, j, point);
        }
        let after = world.solve().frame(frame(0), frame(1)).map(|t| rigid(&t));
        let (Some(before), Some(after)) = (before, after) else { continue };
        errors[0] += before.pose.local(&truth).fixed_rows::<3>(0).norm_squared();
        errors[1] += after.pose.local(&truth).fixed_rows::<3>(0).norm_squared();
        nees.push(after.covariance.mahalanobis_squared(&after.pose.local(&truth)));
    }
    let anees = nees.iter().sum::<f64>() / nees.len() as f64 / 6.0;
    let gain = (errors[1] / errors[0]).sqrt();
    println!("{} runs: ANEES/6 {anees:.3}; error {gain:.2} of that without", nees.len());
    assert!(nees.len() > 190 && (0.9..=1.1).contains(&anees) && gain < 0.9);
}

#[test]
fn positions_join_merged_frames_only_and_only_if_they_fit() {
    let rng = &mut rng(8);
    let mut world = World::new(rng, 3, 10, false);
    world.align(rng, frame(0), frame(1), 4, false);
    let p_j = Vector3::new(0.5, -0.2, 0.0);
    let mut sight = |world: &mut World, i: SubmapId, j: SubmapId, off: f64| {
        let point = seen(world, Some(rng), i, j, p_j);
        state(world, i, j, SeenPoint { p_i: point.p_i + Vector3::new(off, 0.0, 0.0), ..point })
    };
    let good = sight(&mut world, submap(0, 2), submap(1, 3), 0.0);
    let back = sight(&mut world, submap(1, 2), submap(0, 3), 0.0);
    let bad = sight(&mut world, submap(0, 4), submap(1, 5), 3.0);
    let stray = sight(&mut world, submap(0, 4), submap(2, 5), 0.0);
    let own = sight(&mut world, submap(0, 4), submap(0, 5), 0.0);
    let map = world.solve();
    let reason = |entry| map.edges().iter().find(|e| e.measurement.entry == entry).unwrap().unused;
    assert_eq!((reason(good), reason(back)), (None, None));
    assert!(matches!(reason(bad), Some(Unused::Contradicts(_))));
    assert_eq!(reason(stray), Some(Unused::Unmerged(PairStatus::Provisional)));
    assert_eq!(reason(own), Some(Unused::SameFrame));
    assert_ne!(map.component_of(frame(0)), map.component_of(frame(2)));
    let pairs =
        |map: &JointEstimate| map.pairs().iter().map(|pair| (pair.a, pair.b)).collect::<Vec<(FrameId, FrameId)>>();
    assert_eq!(pairs(&map), [(frame(0), frame(1))]);
    // Each counts for the three directions that it speaks of.
    let fewer = MapProblem { positions: world.problem.positions[2..].to_vec(), ..world.problem.clone() };
    let fewer = solve_map(&fewer, &crate::config::EstimateConfig::default());
    assert_eq!(map.dof, fewer.dof + 2 * DIMENSION);
}

/// The limit is that of three degrees of freedom (4.03 σ along one axis), not that of six (4.74 σ).
#[test]
fn what_three_directions_refuse_six_do_not_excuse() {
    let rng = &mut rng(12);
    let mut world = World::new(rng, 2, 10, true);
    world.align(rng, frame(0), frame(1), 6, true);
    let (i, j) = (submap(0, 4), submap(1, 5));
    let known = rigid(&world.solve().relative(i, j).unwrap());
    let r = known.pose.rotation.matrix();
    let spread = r * known.covariance.matrix().fixed_view::<3, 3>(0, 0) * r.transpose() + covariance().matrix();
    let mut is_used = |sigmas: f64| {
        let point = seen(&world, None, i, j, Vector3::zeros());
        let off = spread.cholesky().unwrap().l() * Vector3::new(sigmas, 0.0, 0.0);
        let entry = state(&mut world, i, j, SeenPoint { p_i: point.p_i + off, ..point });
        let used = world.solve().edges().iter().find(|e| e.measurement.entry == entry).unwrap().is_used();
        world.problem.positions.clear();
        used
    };
    assert!(is_used(3.9) && !is_used(4.2) && !is_used(4.6));
}

#[test]
fn any_order_of_positions_gives_the_same_bits() {
    let rng = &mut rng(5);
    let mut world = World::new(rng, 3, 12, false);
    world.align_all(rng, 4, false);
    for k in 0..12 {
        let point = seen(&world, Some(rng), submap(0, k), submap(1, 11 - k), Vector3::new(0.1, 0.2, 0.3));
        state(&mut world, submap(0, k), submap(1, 11 - k), point);
    }
    let want = bits(&world.solve());
    for seed in 0..5 {
        world.problem.positions.shuffle(&mut super::super::test_graphs::rng(seed));
        assert_eq!(bits(&world.solve()), want, "order {seed}");
    }
}

use super::*;
use crate::agent::job::{Job, JobResult, SolveJob, Solved};
use crate::config::EstimateConfig;
use crate::estimate::test_graphs::{frame, measured, normal, rng, sigmas, submap};
use crate::estimate::test_world::World;
use crate::estimate::verdicts::Verdicts;
use crate::geometry::{Covariance, Se3};

fn robots(count: u8) -> Vec<Vec<SubmapId>> {
    (0..count).map(|robot| vec![submap(robot, 3), submap(robot, 4)]).collect()
}

#[test]
fn all_pairs_of_a_small_swarm_and_our_own_of_a_large_one() {
    let most = u8::try_from(ROBOTS_ALL_PAIRS_MAX).unwrap();
    let all = pairs_among(&robots(most), true);
    assert_eq!(all.len(), 4 * 120);
    assert!(all.iter().all(|(a, b)| a.frame < b.frame));
    let own = pairs_among(&robots(most + 1), true);
    assert_eq!(own.len(), 4 * ROBOTS_ALL_PAIRS_MAX);
    assert!(own.iter().all(|(a, _)| a.frame == frame(0)));
    assert!(pairs_among(&robots(most + 1), false).is_empty() && pairs_among(&[], true).is_empty());
    assert!(pairs_among(&[vec![], vec![submap(1, 0)]], true).is_empty());
}

#[test]
fn a_chain_with_gaps_is_counted_by_its_places() {
    let gaps = Gaps::from([(frame(1), vec![0, 4, 9])]);
    assert_eq!([0, 4, 9, 5].map(|index| place(&gaps, submap(1, index))), [Some(0), Some(1), Some(2), None]);
    assert_eq!(place(&gaps, submap(2, 5)), Some(5));
    let t = Relative::Metric(PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(0.1, 0.1) });
    let solved = Solved { live: [((submap(1, 1), submap(2, 5)), t)].into(), ..Solved::default() };
    assert_eq!(solved.with_indices(&gaps).live.into_keys().next(), Some((submap(1, 4), submap(2, 5))));
}

/// Of two robots that are far from ours and see one another, the relation is known far better than two poses in our
/// frame tell, and its covariance is true.
#[test]
fn anees_of_live_pairs_lies_in_the_band() {
    let (runs, mut sum, mut surer) = (150, 0.0, 0.0);
    for seed in 0..runs {
        let rng = &mut rng(31_000 + seed);
        let mut world = World::new(rng, 3, 16, false);
        world.align(rng, frame(0), frame(1), 4, false);
        world.align(rng, frame(1), frame(2), 8, false);
        let (a, b) = (submap(1, 15), submap(2, 15));
        let job = SolveJob {
            problem: world.problem.clone(),
            config: EstimateConfig::default(),
            own: frame(0),
            live: vec![(a, b), (submap(0, 15), a), (a, submap(9, 0))],
            verdicts: Verdicts::default(),
        };
        let JobResult::Solved(solved) = Job::Solve(Box::new(job)).run() else { panic!("another job's result") };
        assert!(solved.converged && solved.failed.is_empty());
        let Some(t_a_b) = solved.live.get(&(a, b)) else { continue };
        assert!(!solved.live.contains_key(&(a, submap(9, 0))));
        // Where the bodies truly are by their anchors, and what their beacons say.
        let bodies = [0.5, 1.5].map(|x| Se3::exp(&[x, 0.1 * normal(rng), 0.0, 0.0, 0.0, 0.3].into()));
        let beacons = bodies.map(|body| measured(rng, &body, sigmas(0.05, 0.02)));
        let live = between_bodies(&beacons[0], t_a_b, &beacons[1]);
        let live = live.metric().unwrap();
        let truth = (world.truth[&a] * bodies[0]).inverse() * (world.truth[&b] * bodies[1]);
        sum += live.covariance.mahalanobis_squared(&live.pose.local(&truth)) / 6.0;
        // As somebody would compose it who has the two poses in our frame alone.
        let in_ours = [(a, 0), (b, 1)].map(|(id, k)| solved.anchors[&id].compose(&Relative::Metric(beacons[k])));
        let composed = in_ours[0].inverse().compose(&in_ours[1]);
        let of_translation = |c: &Covariance<6>| c.matrix().diagonal().rows(0, 3).sum();
        surer += of_translation(&composed.metric().unwrap().covariance) / of_translation(&live.covariance);
    }
    println!(
        "{runs} runs: ANEES/6 of live pairs {:.3}; without cross-correlations the variance would be {:.1} times as large",
        sum / runs as f64,
        surer / runs as f64
    );
    assert!((0.9..=1.1).contains(&(sum / runs as f64)), "{}", sum / runs as f64);
    assert!(surer / runs as f64 > 1.5);
}

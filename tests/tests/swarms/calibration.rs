//! The uncertainty of merged frames does not lie: over seeded runs of a simulated swarm the squared Mahalanobis
//! distance of every frame's error is compared with the χ² distribution of six degrees of freedom. The night runs
//! enough of them to judge coverage; the gate runs a few, which tell standard deviations half as large as they should
//! be.
//!
//! That band is one-sided. What alignments of one submap have in common is charged in the consensus of two frames, and
//! their own covariances are cautious (see the core's `distortion`): estimates may be more certain than they say, never
//! less.

use merganser_sim::bench::calibration::{Mean, World, measure};
use merganser_sim::report::Report;
use merganser_tests::simulate;

const SCENARIO: &str = include_str!("../scenarios/calibration.toml");
/// Seeds of the night, and of the gate.
const MANY: u64 = 120;
const FEW: u64 = 8;
/// 95 % quantile of χ²₆.
const CHI2_6_95: f64 = 12.591_587;
/// MATH §6: ANEES at most 6.4, times 1.1 for what linearisation leaves out.
const ANEES_MAX: f64 = 6.4 * 1.1;
const COVERAGE_MIN: f64 = 0.92;

#[derive(Clone, Copy, Debug, PartialEq)]
struct Calibration {
    anees: f64,
    coverage: f64,
}

impl Calibration {
    fn of(d2: &[f64]) -> Self {
        let inside = d2.iter().filter(|&&d2| d2 <= CHI2_6_95).count();
        Self { anees: d2.iter().sum::<f64>() / d2.len() as f64, coverage: inside as f64 / d2.len() as f64 }
    }

    fn is_honest(self) -> bool {
        self.anees <= ANEES_MAX && self.coverage >= COVERAGE_MIN
    }
}

fn run_all(seeds: u64) -> Vec<Report> {
    let half = |first: u64| {
        move || (first..=seeds).step_by(2).map(|seed| simulate(SCENARIO, seed).unwrap()).collect::<Vec<_>>()
    };
    std::thread::scope(|scope| {
        let halves = [1, 2].map(|first| scope.spawn(half(first)));
        halves.into_iter().flat_map(|half| half.join().unwrap()).collect()
    })
}

/// The two robots each place the other's frame, but they hold one map: a run is one sample.
fn one_sample(report: &Report) -> Option<f64> {
    Some(report.frame_errors.iter().min_by(|a, b| a.own.cmp(&b.own))?.d2)
}

/// The squared distance of each merged pair.
fn merged(seeds: u64) -> Vec<f64> {
    let reports = run_all(seeds);
    for report in &reports {
        assert!(report.violation.is_none(), "seed {}: {:?}", report.seed, report.violation);
    }
    let d2: Vec<f64> = reports.iter().filter_map(one_sample).collect();
    let found = Calibration::of(&d2);
    println!(
        "{} of {} pairs merged, ANEES {:.2} of 6, {:.1} % inside the 95 % ellipsoid",
        d2.len(),
        reports.len(),
        found.anees,
        100.0 * found.coverage
    );
    assert!(d2.len() * 10 >= reports.len() * 9, "only {} of {} pairs merged", d2.len(), reports.len());
    d2
}

#[test]
fn few_frames_are_merged_rightly_and_not_claimed_much_better_than_known() {
    let mean = Calibration::of(&merged(FEW)).anees;
    assert!(mean <= ANEES_MAX, "{mean}");
    // The check bites: standard deviations half as large are not honest.
    assert!(4.0 * mean > ANEES_MAX, "{mean}");
}

#[test]
#[ignore = "night: 120 swarms"]
fn frames_are_never_merged_wrongly_nor_claimed_better_than_known() {
    let d2 = merged(MANY);
    let found = Calibration::of(&d2);
    assert!(found.is_honest(), "{found:?}");
    // The check bites: the same errors under standard deviations a third too small are not honest.
    let claimed_better: Vec<f64> = d2.iter().map(|d2| d2 * 1.5 * 1.5).collect();
    assert!(!Calibration::of(&claimed_better).is_honest());
}

/// Where alignments err as they say, the whole estimate does, through losses, a split and condensed logs; sixty swarms
/// tell it within some percent (`merganser-sim bench calibration` runs hundreds; of two dozen, whose few numbers are
/// skewed, neither the mean nor its error says much).
#[test]
#[ignore = "night: 60 swarms"]
fn frames_submaps_and_live_poses_are_as_uncertain_as_they_say() {
    let means = measure(World::Lidar, None, 1..61, || {}).unwrap();
    println!("frames, submaps, live poses: {:?}", means.of);
    assert_eq!((means.swarms, means.condensed), (60, 60));
    for mean in means.of {
        assert!(mean.may_be_honest(), "{mean:?}");
        // The check bites: standard deviations half as large are not honest.
        let boast = Mean { mean: 4.0 * mean.mean, error: 4.0 * mean.error };
        assert!(!boast.may_be_honest(), "{boast:?}");
    }
}

/// Of five swarms only a lie is told: by degrees of freedom the mean stays below 2, and standard deviations half as
/// large would raise it above.
#[test]
fn frames_submaps_and_live_poses_of_few_swarms_are_no_lie() {
    let means = measure(World::Lidar, None, 1..6, || {}).unwrap();
    println!("frames, submaps, live poses: {:?}", means.of);
    assert_eq!((means.swarms, means.condensed), (5, 5));
    for Mean { mean, .. } in means.of {
        assert!(mean <= 2.0 && 4.0 * mean > 2.0, "{mean}");
    }
}

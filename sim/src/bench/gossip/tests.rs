//! The bench itself: a run is a function of its seed, sets do become equal, and a gossip that never asks is found out.

use super::bound::bound;
use super::case::{Case, World};
use super::measure;
use super::policy::Policy;
use crate::field::Layout;

fn small(case: Case) -> World {
    World { robots: 16, ..case.world() }
}

#[test]
fn the_same_seed_gives_the_same_figures() {
    let world = small(Case::SplitLossy);
    let figures = |seed| measure(&world, Policy::Ours, seed).unwrap().to_string();
    assert_eq!(figures(3), figures(3));
    assert_ne!(figures(3), figures(4));
}

#[test]
fn every_case_converges_with_either_gossip_and_moves_at_least_what_is_needed() {
    for case in [Case::Split, Case::SplitLossy, Case::Mesh, Case::Ferry] {
        for policy in [Policy::Ours, Policy::Plain] {
            let outcome = measure(&small(case), policy, 1).unwrap();
            assert!(outcome.converged(), "{outcome}");
            assert!(outcome.data_ratio.is_some_and(|ratio| ratio >= 1.0), "{outcome}");
            assert!(outcome.control.is_some_and(|bytes| bytes > 0.0), "{outcome}");
        }
    }
}

#[test]
fn halves_that_stay_cut_do_not_converge() {
    let world = World { heal_at: 1e9, fact_every_secs: 0.0, until: 200.0, ..small(Case::Split) };
    assert!(!measure(&world, Policy::Ours, 1).unwrap().converged());
}

#[test]
fn a_quiet_swarm_is_measured_after_it_settled() {
    let world = World { until: 200.0, ..small(Case::Steady) };
    let outcome = measure(&world, Policy::Ours, 1).unwrap();
    assert!(outcome.steady.is_some_and(|rate| rate > 0.0 && rate < 50.0), "{outcome}");
}

#[test]
fn nothing_beats_the_bound_and_ours_comes_near_it() {
    assert!(bound(&small(Case::Split), 1).is_none(), "nobody moves");
    for case in [Case::Ferry, Case::Mobile] {
        let mut world = small(case);
        if let Layout::Waypoints { side_m, .. } = &mut world.layout {
            *side_m = 250.0;
        }
        let least = bound(&world, 1).and_then(|outcome| outcome.equal_after).unwrap();
        let ours = measure(&world, Policy::Ours, 1).unwrap().equal_after.unwrap();
        assert!(least > 0.0 && least <= ours + 0.5 && ours < 1.25 * least + 10.0, "{least} {ours}");
    }
}

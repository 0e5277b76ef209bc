//! A map that grows fact by fact is the map of all facts, however much of it was remembered.

use super::*;
use crate::geometry::{PoseWithCovariance, Se3, So3};
use crate::ids::SubmapId;
use crate::joint::{AgreedAlignment, MapProblem, solve_map, solve_map_recalling};
use crate::test_graphs::*;
use crate::test_world::*;
use nalgebra::Vector3;
use rand::seq::SliceRandom;

/// Chains that grow, alignments in any order, and now and then one that goes again.
#[test]
fn a_map_that_grows_is_the_map_from_nothing_to_the_bit() {
    let config = EstimateConfig::default();
    let mut recalled = 0;
    for seed in 0..4 {
        let rng = &mut rng(2600 + seed);
        let mut world = World::new(rng, 4, 12, false);
        world.align_all(rng, 5, false);
        world.problem.common = world.problem.alignments.iter().map(|a| (a.entry, 0.2)).collect();
        let mut facts = world.problem.alignments.clone();
        facts.shuffle(rng);
        let (mut verdicts, mut known): (_, Vec<AgreedAlignment>) = (Verdicts::default(), Vec::new());
        for (k, fact) in facts.into_iter().enumerate() {
            known.push(fact);
            if k % 7 == 6 {
                known.remove(k % known.len());
            }
            let mut problem = MapProblem { alignments: known.clone(), ..world.problem.clone() };
            problem.frames.values_mut().for_each(|chain| chain.odometry.truncate(6 + k / 4));
            let (grown, anew) = (solve_map_recalling(&problem, &config, &mut verdicts), solve_map(&problem, &config));
            assert_eq!(bits(&grown), bits(&anew), "seed {seed}, fact {k}");
            assert_eq!(grown.pairs(), anew.pairs(), "seed {seed}, fact {k}");
            recalled += verdicts.recalled();
        }
    }
    assert!(recalled > 100, "{recalled}");
}

/// Whatever a verdict follows from makes it another one.
#[test]
fn nothing_is_recalled_that_follows_from_something_else() {
    let rng = &mut rng(2700);
    let mut world = World::new(rng, 2, 12, false);
    world.align_all(rng, 5, false);
    world.problem.alignments.truncate(5);
    // Another of the first one's submap, so that what they have in common counts.
    let i = world.problem.alignments[0].i;
    let other = if i.frame == frame(0) { frame(1) } else { frame(0) };
    let ends = |a: &AgreedAlignment| [(a.i, a.j), (a.j, a.i)];
    let free = |j: &SubmapId| !world.problem.alignments.iter().flat_map(ends).any(|pair| pair == (i, *j));
    let j = (0..12).map(|index| SubmapId { frame: other, index }).find(free).unwrap();
    let t_i_j = world.measure(Some(rng), i, j);
    world.state(i, j, t_i_j);
    let (problem, config) = (world.problem.clone(), EstimateConfig::default());
    let recalled = |problem: &MapProblem, config: &EstimateConfig| {
        let mut verdicts = Verdicts::default();
        solve_map_recalling(&world.problem, &EstimateConfig::default(), &mut verdicts);
        solve_map_recalling(problem, config, &mut verdicts);
        verdicts.recalled()
    };
    assert_eq!(recalled(&problem, &config), 1);
    let changed = |change: &dyn Fn(&mut MapProblem)| {
        let mut problem = problem.clone();
        change(&mut problem);
        recalled(&problem, &config)
    };
    let a = problem.alignments[0];
    assert_eq!(changed(&|p| p.alignments.truncate(4)), 0);
    assert_eq!(changed(&|p| p.alignments[0].t_i_j = a.t_i_j.widened(1.0 + 1e-9)), 0);
    assert_eq!(changed(&|p| p.frames.get_mut(&frame(0)).unwrap().odometry[1].pose.translation[0] += 1e-9), 0);
    let first = |p: &mut MapProblem, change: &dyn Fn(&mut PoseWithCovariance)| {
        change(&mut p.frames.get_mut(&frame(0)).unwrap().odometry[0]);
    };
    // The box stays.
    assert_eq!(changed(&|p| first(p, &|step| step.covariance = step.covariance.scaled(1.0 + 1e-9))), 0);
    assert_eq!(changed(&|p| p.common = [(a.entry, 0.1)].into()), 0);
    // A way that goes on fills a larger box; a robot that stands does not.
    let onward = |metres: f64| {
        let t = Se3::new(So3::identity(), Vector3::new(metres, 0.0, 0.0));
        let step = PoseWithCovariance { pose: t, covariance: sigmas(0.03, 0.008) };
        changed(&|p| p.frames.get_mut(&frame(0)).unwrap().odometry.push(step))
    };
    assert_eq!((onward(100.0), onward(0.0)), (0, 1));
    assert_eq!(recalled(&problem, &EstimateConfig { alignments_min: 4, ..config.clone() }), 0);
    assert_eq!(recalled(&problem, &EstimateConfig { log10_nfa_max: -3.0, ..config.clone() }), 0);
    assert_eq!(recalled(&problem, &EstimateConfig { covariance_scale_max: 2.0, ..config.clone() }), 0);
    // What the pair does not hang on.
    assert_eq!(recalled(&problem, &EstimateConfig { iterations_max: 31, ..config.clone() }), 1);
}

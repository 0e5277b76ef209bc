//! A component that grows against batch solves, at each step; what a step touches; bad additions.

use super::super::graph::{Graph, Source};
use super::super::solve::solve;
use super::super::test_graphs::*;
use super::*;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, SimWithCovariance};
use crate::ids::{FrameId, SubmapId};
use proptest::prelude::*;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

/// How far an estimate may lie from a batch solve's, in standard deviations, after an addition; after settling.
const APART_MAX: f64 = 0.05;
const SETTLED_APART_MAX: f64 = 1e-5;

/// Robots that take turns to drive a step; one of them may not know its unit.
struct Growth {
    rng: ChaCha8Rng,
    truth: BTreeMap<SubmapId, Sim3>,
    unknown: BTreeSet<FrameId>,
    nodes: BTreeSet<SubmapId>,
    factors: Vec<Factor<SubmapId>>,
}

impl Growth {
    fn new(seed: u64, robots: u8, unknown: bool) -> Self {
        let unknown = if unknown { BTreeSet::from([frame(robots - 1)]) } else { BTreeSet::new() };
        let (truth, nodes) = (BTreeMap::new(), BTreeSet::new());
        Self { rng: rng(seed), truth, unknown, nodes, factors: Vec::new() }
    }

    /// `count` more anchors of a robot, in one addition; loops with probability `loops` each.
    fn drive(&mut self, robot: u8, count: usize, loops: f64) -> Addition<SubmapId> {
        let mut addition = Addition { unknown_scale: self.unknown.clone(), ..Addition::default() };
        for _ in 0..count {
            let index = self.truth.keys().filter(|id| id.frame == frame(robot)).count();
            let id = submap(robot, index);
            let scale = if self.unknown.contains(&frame(robot)) { 1.7 } else { 1.0 };
            if index == 0 {
                let origin = any_pose(&mut self.rng, 8.0);
                self.truth.insert(id, Sim3::new(origin.rotation, origin.translation, scale));
                if self.truth.len() > 1 {
                    addition.factors.extend(self.tie(id));
                }
            } else {
                let last = submap(robot, index - 1);
                let step = any_step(&mut self.rng);
                let moved = self.truth[&last] * Sim3::new(step.rotation, step.translation / scale, 1.0);
                self.truth.insert(id, moved);
                addition.factors.push(self.measure(last, id));
            }
            if self.truth.len() > 2 && self.rng.random_bool(loops) {
                addition.factors.extend(self.tie(id));
            }
            addition.nodes.insert(id);
        }
        self.nodes.extend(&addition.nodes);
        self.factors.extend(&addition.factors);
        addition
    }

    /// A measurement of `id` from another anchor.
    fn tie(&mut self, id: SubmapId) -> Option<Factor<SubmapId>> {
        let others: Vec<SubmapId> = self.truth.keys().copied().filter(|&other| other != id).collect();
        let other = others[self.rng.random_range(0..others.len())];
        let is_new = |(i, j)| !self.factors.iter().any(|f| (f.i, f.j) == (i, j));
        is_new((other, id)).then(|| self.measure(other, id))
    }

    fn measure(&mut self, i: SubmapId, j: SubmapId) -> Factor<SubmapId> {
        let truth = self.truth[&i].inverse() * self.truth[&j];
        let rigid = is_rigid(i.frame, j.frame, &self.unknown);
        let t_i_j = if rigid {
            Relative::Metric(measured(&mut self.rng, &truth.to_se3(), sigmas(0.03, 0.01)))
        } else {
            let sigmas = [0.05, 0.05, 0.05, 0.01, 0.01, 0.01, 0.02];
            let delta = nalgebra::SVector::<f64, 7>::from_fn(|k, _| sigmas[k] * normal(&mut self.rng));
            let covariance = Covariance::from_sigmas(sigmas).unwrap();
            Relative::Similarity(SimWithCovariance { sim: truth.retract(&delta), covariance })
        };
        Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 }
    }

    fn batch(&self, values: &BTreeMap<SubmapId, Sim3>) -> Solution<SubmapId> {
        let mut graphs = Graph::components(&self.nodes, &self.unknown, self.factors.clone()).unwrap();
        assert_eq!(graphs.len(), 1);
        let start = self.nodes.iter().map(|id| values[id]).collect();
        let solution = solve(graphs.remove(0), start, 50).unwrap();
        assert!(solution.converged);
        solution
    }

    /// How far the grown estimate lies from a batch solve from the truth, in standard deviations.
    fn apart(&self, grown: &Incremental<SubmapId>) -> f64 {
        let batch = self.batch(&self.truth);
        let first = batch.graph().nodes()[0];
        let origin = grown.value(first).unwrap().inverse();
        let one = |(id, relative): (SubmapId, Relative)| {
            let got = origin * *grown.value(id).unwrap();
            match relative {
                Relative::Metric(p) => p.covariance.mahalanobis_squared(&p.pose.local(&got.to_se3())).sqrt(),
                Relative::Similarity(s) => s.covariance.mahalanobis_squared(&s.sim.local(&got)).sqrt(),
            }
        };
        batch.relatives_to(first, &self.unknown).into_iter().skip(1).map(one).fold(0.0, f64::max)
    }
}

fn started(growth: &mut Growth, anchors: usize) -> Incremental<SubmapId> {
    growth.drive(0, anchors, 0.3);
    Incremental::new(growth.batch(&growth.truth), &growth.unknown).unwrap()
}

fn bits(grown: &Incremental<SubmapId>) -> Vec<u64> {
    let of = |(_, s): (SubmapId, &Sim3)| {
        let numbers = s.translation.iter().copied().chain(s.rotation.xyzw()).chain([s.scale]);
        numbers.map(f64::to_bits).collect::<Vec<_>>()
    };
    grown.values().flat_map(of).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]
    #[test]
    fn every_addition_ends_where_a_batch_solve_does(seed: u64, robots in 1u8..4, unknown: bool, loops in 0.0f64..0.7) {
        let mut growth = Growth::new(seed, robots, unknown && robots > 1);
        let mut grown = started(&mut growth, 4);
        for step in 0..24 {
            let count = growth.rng.random_range(1..4);
            let addition = growth.drive(step % robots, count, loops);
            let update = grown.add(addition).unwrap();
            prop_assert!(update.settled, "step {step}: {update:?}");
            let apart = growth.apart(&grown);
            prop_assert!(apart < APART_MAX, "step {step}: {apart} σ");
        }
        grown.settle().unwrap();
        let apart = growth.apart(&grown);
        prop_assert!(apart < SETTLED_APART_MAX, "settled: {apart} σ");
        let batch = growth.batch(&growth.truth);
        prop_assert!((grown.chi2() - batch.chi2).abs() < 1e-9 * (1.0 + batch.chi2));
    }

    #[test]
    fn the_same_additions_give_the_same_bits_whatever_was_refused_between(seed: u64) {
        let mut growth = Growth::new(seed, 2, true);
        let mut grown = started(&mut growth, 4);
        let mut twin = Incremental::new(growth.batch(&growth.truth), &growth.unknown).unwrap();
        for step in 0..12 {
            let addition = growth.drive(step % 2, 2, 0.4);
            for bad in spoiled(&addition) {
                let old = bits(&grown);
                let refused = grown.add(bad);
                prop_assert!(refused.is_err(), "{refused:?}");
                prop_assert_eq!(&bits(&grown), &old);
            }
            prop_assert_eq!(grown.add(addition.clone()), twin.add(addition));
            prop_assert_eq!(bits(&grown), bits(&twin));
        }
    }
}

/// The addition with something wrong each time; the last two come out only once it is solved for.
fn spoiled(addition: &Addition<SubmapId>) -> Vec<Addition<SubmapId>> {
    let stray = SubmapId { index: 1000, ..*addition.nodes.first().unwrap() };
    let last = *addition.factors.last().unwrap();
    let with = |change: &dyn Fn(&mut Addition<SubmapId>)| {
        let mut bad = addition.clone();
        change(&mut bad);
        bad
    };
    let more = |factor: Factor<SubmapId>| with(&|a| a.factors.push(factor));
    vec![
        more(Factor { j: stray, ..last }),
        more(Factor { j: last.i, ..last }),
        more(Factor { weight: f64::NAN, ..last }),
        with(&|a| {
            a.nodes.insert(stray);
        }),
        with(&|a| {
            a.nodes.insert(submap(0, 0));
        }),
        with(&|a| a.factors[0].weight = f64::MAX),
        more(Factor { weight: f64::MAX, ..last }),
    ]
}

#[test]
fn refusals_say_why() {
    let mut growth = Growth::new(3, 1, false);
    let mut grown = started(&mut growth, 6);
    let addition = growth.drive(0, 1, 0.0);
    let (id, last) = (submap(0, 6), addition.factors[0]);
    let add =
        |grown: &mut Incremental<SubmapId>, nodes: &[SubmapId], factors: &[Factor<SubmapId>], unknown: &[FrameId]| {
            let nodes = nodes.iter().copied().collect();
            grown.add(Addition { nodes, unknown_scale: unknown.iter().copied().collect(), factors: factors.to_vec() })
        };
    let unknown_node = GraphError::UnknownNode { i: last.i, j: id };
    assert_eq!(add(&mut grown, &[], &[last], &[]), Err(IncrementalError::Graph(unknown_node)));
    assert_eq!(add(&mut grown, &[id], &[], &[]), Err(IncrementalError::Loose(id)));
    assert_eq!(add(&mut grown, &[last.i], &[], &[]), Err(IncrementalError::Known(last.i)));
    assert_eq!(add(&mut grown, &[id], &[last], &[frame(0)]), Err(IncrementalError::Unit(frame(0))));
    let nan = Factor { weight: f64::NAN, ..last };
    let refused = Err(IncrementalError::Graph(GraphError::NotFinite { i: last.i, j: id }));
    assert_eq!(add(&mut grown, &[id], &[nan], &[]), refused);
    let too_heavy = Factor { weight: 1e300, ..last };
    let refused = add(&mut grown, &[id], &[too_heavy], &[]).unwrap_err();
    assert!(matches!(refused, IncrementalError::Underconstrained(at) if at == id || at == last.i), "{refused}");
    assert!(add(&mut grown, &[id], &[last], &[]).is_ok());
    assert_eq!(grown.add(Addition::default()).unwrap().eliminated, 0);
}

#[test]
fn a_metric_frame_cannot_join_where_another_gives_the_unit() {
    let mut growth = Growth::new(8, 2, false);
    growth.unknown = BTreeSet::from([frame(0)]);
    let mut grown = started(&mut growth, 4);
    let addition = growth.drive(1, 1, 0.0);
    assert_eq!(grown.add(addition), Err(IncrementalError::Unit(frame(1))));
}

/// Three robots with 300 anchors in one place.
fn large(seed: u64) -> (Growth, Incremental<SubmapId>) {
    let mut growth = Growth::new(seed, 3, false);
    for robot in 0..3 {
        growth.drive(robot, 100, 0.1);
    }
    let grown = Incremental::new(growth.batch(&growth.truth), &growth.unknown).unwrap();
    (growth, grown)
}

#[test]
fn odometry_touches_one_front_and_a_loop_a_small_share() {
    let (mut growth, mut grown) = large(1);
    for robot in [0, 1, 2, 1] {
        let update = grown.add(growth.drive(robot, 1, 0.0)).unwrap();
        assert_eq!((update.eliminated, update.moved, update.relinearised), (1, 1, 0));
    }
    assert_eq!(grown.add(growth.drive(0, 5, 0.0)).unwrap().eliminated, 5);
    // A loop within the last anchors of one robot.
    let factor = growth.measure(submap(1, 97), submap(1, 101));
    growth.factors.push(factor);
    let update = grown.add(Addition { factors: vec![factor], ..Addition::default() }).unwrap();
    assert!(update.eliminated > 1 && 4 * update.eliminated < update.fronts, "{update:?}");
    assert!(growth.apart(&grown) < APART_MAX);
}

#[test]
fn a_surprise_is_linearised_anew() {
    let (mut growth, mut grown) = large(2);
    // A robot joins far off, with a first tie that is wrong by half a radian but says so.
    let id = submap(3, 0);
    growth.truth.insert(id, Sim3::from_se3(&any_pose(&mut rng(4), 5.0)));
    let mut wrong = growth.measure(submap(0, 50), id);
    let off = nalgebra::Vector6::new(0.5, -0.5, 0.2, 0.3, -0.3, 0.2);
    let pose = wrong.t_i_j.sim().to_se3().retract(&off);
    wrong.t_i_j = Relative::Metric(PoseWithCovariance { pose, covariance: sigmas(1.0, 0.5) });
    let mut addition = Addition { nodes: BTreeSet::from([id]), factors: vec![wrong], ..Addition::default() };
    growth.nodes.insert(id);
    growth.factors.push(wrong);
    grown.add(addition).unwrap();
    grown.add(growth.drive(3, 20, 0.0)).unwrap();
    addition = Addition { factors: vec![growth.measure(submap(1, 10), submap(3, 12))], ..Addition::default() };
    growth.factors.extend(&addition.factors);
    let update = grown.add(addition).unwrap();
    assert!(update.relinearised > 20 && update.settled, "{update:?}");
    let apart = growth.apart(&grown);
    assert!(apart < APART_MAX, "{apart}");
}

#[test]
fn covariances_are_those_of_a_batch_solve() {
    for unknown in [false, true] {
        let mut growth = Growth::new(11, 3, unknown);
        let mut grown = started(&mut growth, 4);
        for step in 0..20 {
            grown.add(growth.drive(step % 3, 2, 0.4)).unwrap();
        }
        for (tolerance, settle) in [(0.05, false), (1e-6, true)] {
            if settle {
                grown.settle().unwrap();
            }
            let batch = growth.batch(&growth.truth);
            for (i, j) in [((0, 0), (2, 7)), ((1, 3), (2, 9)), ((1, 9), (1, 2)), ((2, 1), (2, 8)), ((0, 3), (1, 1))] {
                let (i, j) = (submap(i.0, i.1), submap(j.0, j.1));
                let want = batch.relative(i, j, &growth.unknown).unwrap().lifted();
                let got = grown.relative(i, j, &growth.unknown).unwrap().lifted();
                let error = (got.covariance.matrix() - want.covariance.matrix()).amax();
                assert!(error < tolerance * want.covariance.matrix().amax(), "{i} {j}: {error}");
            }
        }
        assert!(grown.relative(submap(0, 0), submap(7, 7), &growth.unknown).is_none());
        let itself = grown.relative(submap(0, 2), submap(0, 2), &growth.unknown).unwrap();
        assert_eq!(itself.sim().to_se3(), Se3::identity());
    }
}

/// Two anchors and one factor, solved; then a much surer factor says that the second is turned and moved by `delta`.
fn pushed(delta: [f64; 6]) -> (Incremental<SubmapId>, Update) {
    let (i, j) = (submap(0, 0), submap(0, 1));
    let factor = |pose: Se3, sigma: f64| {
        let t_i_j = Relative::Metric(PoseWithCovariance { pose, covariance: sigmas(sigma, sigma) });
        Factor { label: Source::Odometry, i, j, t_i_j, weight: 1.0 }
    };
    let nodes = BTreeSet::from([i, j]);
    let graph = Graph::components(&nodes, &BTreeSet::new(), vec![factor(Se3::identity(), 0.1)]).unwrap().remove(0);
    let solution = solve(graph, vec![Sim3::identity(); 2], 10).unwrap();
    let mut grown = Incremental::new(solution, &BTreeSet::new()).unwrap();
    let factors = vec![factor(Se3::exp(&delta.into()), 1e-4)];
    let update = grown.add(Addition { factors, ..Addition::default() }).unwrap();
    (grown, update)
}

#[test]
fn an_anchor_is_linearised_anew_once_it_has_turned_enough_or_the_linear_model_is_off() {
    // Pure turns about one axis are linear in the residual: only the turn itself counts.
    for (turn, anew) in [(0.99 * model::ROTATION_MAX, false), (1.01 * model::ROTATION_MAX, true)] {
        let (_, update) = pushed([0.0, 0.0, 0.0, 0.0, 0.0, turn]);
        assert_eq!(update.relinearised > 0, anew, "{turn}");
    }
    // Pure shifts are linear.
    let (_, update) = pushed([50.0, -20.0, 10.0, 0.0, 0.0, 0.0]);
    assert_eq!(update.relinearised, 0);
    // A turn with a shift bends the residual by about half their product, here in units of 1e-4.
    for (shift, anew) in [(1e-4, false), (4e-3, true)] {
        let (_, update) = pushed([shift, 0.0, 0.0, 0.0, 0.0, 0.005]);
        assert_eq!(update.relinearised > 0, anew, "{shift}");
    }
}

#[test]
fn the_bound_on_defects_holds() {
    let mut largest: f64 = 0.0;
    for seed in 0..4 {
        let mut growth = Growth::new(seed, 3, false);
        let mut grown = started(&mut growth, 4);
        for step in 0..60 {
            grown.add(growth.drive(step % 3, 1, 0.3)).unwrap();
            for edge in &grown.model.edges {
                let defect = grown.model.defect(&grown.tree, edge);
                let bound = grown.model.defect_bound(&grown.tree, edge).unwrap();
                assert!(defect <= bound + 1e-9, "{defect} {bound}");
                assert!(defect <= model::DEFECT_MAX);
                largest = largest.max(defect);
            }
        }
    }
    assert!(largest > 0.1 * model::DEFECT_MAX, "{largest}: nothing was tested");
}

#[test]
fn a_factor_that_fills_up_is_ordered_afresh() {
    let mut growth = Growth::new(6, 1, false);
    growth.drive(0, 40, 0.0);
    let mut grown = Incremental::new(growth.batch(&growth.truth), &growth.unknown).unwrap();
    let (mut reordered, mut loops) = (0, 0);
    // A chain that becomes a thicket: the factor must grow.
    for i in (0..40).step_by(3) {
        for j in (i + 2..40).step_by(5) {
            let factor = growth.measure(submap(0, i), submap(0, j));
            growth.factors.push(factor);
            let update = grown.add(Addition { factors: vec![factor], ..Addition::default() }).unwrap();
            (reordered, loops) = (reordered + usize::from(update.reordered), loops + 1);
            assert!(grown.fill_now() <= FILL_GROWTH_MAX * grown.fill, "loop {loops}");
        }
    }
    assert!((1..loops / 4).contains(&reordered), "{reordered} of {loops}");
    assert!(growth.apart(&grown) < APART_MAX);
}

#[test]
fn far_from_the_minimum_settling_gives_up_and_leaves_all_as_it_was() {
    let mut growth = Growth::new(9, 2, false);
    growth.drive(0, 12, 0.5);
    growth.drive(1, 12, 0.8);
    let graph = Graph::components(&growth.nodes, &growth.unknown, growth.factors.clone()).unwrap().remove(0);
    let mut refused = 0;
    for seed in 0..10 {
        let rng = &mut rng(seed);
        let start = growth.nodes.iter().map(|_| Sim3::from_se3(&any_pose(rng, 20.0))).collect();
        let mut grown = Incremental::new(solve(graph.clone(), start, 0).unwrap(), &growth.unknown).unwrap();
        let old = bits(&grown);
        match grown.settle() {
            Ok(_) => continue,
            Err(error) => assert_eq!(error, IncrementalError::Diverged),
        }
        refused += 1;
        assert_eq!(bits(&grown), old);
    }
    assert!(refused > 0);
}

//! What a condensed log says is what it said before, never surer.

use super::condensing::{GONE_IN_A_ROW_MAX, Shorter, shorten};
use super::knowledge::{Knowledge, Known};
use crate::config::EstimateConfig;
use crate::estimate::test_graphs::rng;
use crate::estimate::test_world::{ODOMETRY, World};
use crate::estimate::{JointEstimate, MapProblem, solve_map};
use crate::geometry::{PoseWithCovariance, Relative, Se3};
use crate::ids::{EntryId, FrameId, Hash, SubmapId};
use crate::replica::testing::signed;
use crate::time::Stamp;
use crate::wire::Entry;
use crate::wire::fact::{
    AlignmentFact, CondensedFact, Fact, RefusalReason, ScaleKind, SubmapFact, VerdictFact, VerdictOutcome,
};
use std::collections::BTreeMap;

const ANCHORS: usize = 40;
const ALIGNMENTS: usize = 5;
const RUNS: u64 = 600;

/// What the robots of a world wrote, by frame.
struct Logs {
    facts: BTreeMap<FrameId, Vec<Fact>>,
    /// Whether alignments have anything in common, so that clouds are bent.
    bent: bool,
}

impl Logs {
    fn of(world: &World) -> Self {
        let mut logs = BTreeMap::new();
        for (frame, chain) in &world.problem.frames {
            let submap = |(index, odometry): (usize, &PoseWithCovariance)| submap(index as u32, *odometry);
            logs.insert(*frame, chain.odometry.iter().enumerate().map(submap).collect::<Vec<_>>());
        }
        let mut verdicts = Vec::new();
        for stated in &world.problem.alignments {
            let (i, j, t_i_j) = match stated.i < stated.j {
                true => (stated.i, stated.j, stated.t_i_j),
                false => (stated.j, stated.i, stated.t_i_j.inverse()),
            };
            let log = logs.get_mut(&i.frame).unwrap();
            let alignment = EntryId { frame: i.frame, seq: log.len() as u32 };
            let blobs = [blob_of(i.index), blob_of(j.index)];
            log.push(Fact::Alignment(AlignmentFact { i, j, t_i_j, sigma: 0.1, support: 20, log10_nfa: -9.0, blobs }));
            let outcome = VerdictOutcome::Measured { t_i_j, sigma: 0.1, support: 20 };
            verdicts.push((j.frame, Fact::Verdict(VerdictFact { alignment, outcome })));
        }
        verdicts.into_iter().for_each(|(frame, verdict)| logs.get_mut(&frame).unwrap().push(verdict));
        // As everybody reads them, so that what condensing changes is told from what the wire does.
        logs.values_mut().flatten().for_each(|fact| *fact = as_read(fact));
        Self { facts: logs, bent: true }
    }

    fn entries(&self, frame: FrameId) -> Vec<Entry> {
        let facts = self.facts[&frame].iter();
        (0..).zip(facts).map(|(seq, fact)| entry(seq, 0, fact)).collect()
    }

    fn knowledge(&self) -> Knowledge {
        let mut knowledge = Knowledge::default();
        for (frame, facts) in &self.facts {
            for (seq, fact) in (0..).zip(facts) {
                knowledge.absorb(EntryId { frame: *frame, seq }, fact.clone());
            }
        }
        knowledge
    }

    /// The submaps that stay.
    fn kept(&self, frame: FrameId, knowledge: &Knowledge) -> Vec<u32> {
        let gone = self.shorter(frame, knowledge).gone;
        (0..ANCHORS as u32).filter(|&index| gone.iter().all(|(id, _)| id.index != index)).collect()
    }

    fn shorter(&self, frame: FrameId, knowledge: &Knowledge) -> Shorter {
        shorten(frame, &self.entries(frame), knowledge).unwrap()
    }

    fn condensed(&self, knowledge: &Knowledge) -> (Knowledge, BTreeMap<EntryId, Fact>) {
        let (mut condensed, mut held) = (Knowledge::default(), BTreeMap::new());
        for (frame, facts) in &self.facts {
            for (seq, part) in (facts.len() as u32..).zip(self.shorter(*frame, knowledge).parts) {
                let fact = as_read(&Fact::Condensed(part));
                condensed.absorb(EntryId { frame: *frame, seq }, fact.clone());
                held.insert(EntryId { frame: *frame, seq }, fact);
            }
        }
        (condensed, held)
    }

    fn solve(&self, knowledge: &Knowledge, own: FrameId, condensed: &BTreeMap<EntryId, Fact>) -> (JointEstimate, Gaps) {
        let odometry = |known: &Known| {
            let held_at = EntryId { seq: known.held_at, ..known.entry };
            let fact = match condensed.get(&held_at) {
                Some(Fact::Condensed(fact)) => {
                    &fact.carried.iter().find(|one| one.seq == known.entry.seq).unwrap().fact
                }
                _ => &self.facts[&known.entry.frame][known.entry.seq as usize],
            };
            if let Fact::Submap(fact) = fact { Some(fact.odometry) } else { None }
        };
        let mut question = knowledge.question(own, odometry);
        if !self.bent {
            question.problem.common.clear();
        }
        (solve_map(&question.problem, &EstimateConfig::default()), question.gaps)
    }
}

type Gaps = BTreeMap<FrameId, Vec<u32>>;

/// A fact after a journey.
fn as_read(fact: &Fact) -> Fact {
    Fact::from_payload(fact.kind(), &fact.to_payload().unwrap()).unwrap()
}

/// The least and the largest variance of a second estimate by that of the first, over all directions.
fn variances(first: &Relative, second: &Relative) -> [f64; 2] {
    let [first, second] = [first, second].map(|t| *t.metric().unwrap().covariance.matrix());
    let l = first.cholesky().unwrap().l();
    let half = l.solve_lower_triangular(&second).unwrap();
    let whitened = l.solve_lower_triangular(&half.transpose()).unwrap();
    let dense = nalgebra::DMatrix::from_iterator(6, 6, whitened.iter().copied());
    let eigenvalues = ((&dense + dense.transpose()) * 0.5).symmetric_eigenvalues();
    [eigenvalues.min(), eigenvalues.max()]
}

fn entry(seq: u32, floor: u32, fact: &Fact) -> Entry {
    signed(1, 4, seq, floor, if seq == 0 { Hash::default() } else { Hash::of(b"before") }, fact)
}

fn blob_of(index: u32) -> Hash {
    Hash::of(&index.to_le_bytes())
}

fn submap(index: u32, odometry: PoseWithCovariance) -> Fact {
    Fact::Submap(SubmapFact {
        index,
        stamps: [Stamp(i64::from(index)), Stamp(i64::from(index) + 1)],
        odometry,
        extent: [1.0; 3],
        summary: vec![],
        keypoint_count: 1,
        blob: blob_of(index),
        scale: ScaleKind::Metric,
        keyframes: None,
    })
}

fn world(seed: u64) -> (World, [FrameId; 2]) {
    world_with_noise(seed, true)
}

fn world_with_noise(seed: u64, noise: bool) -> (World, [FrameId; 2]) {
    let mut rng = rng(seed);
    let mut world = World::new(&mut rng, 2, ANCHORS, !noise);
    world.align_all(&mut rng, ALIGNMENTS, !noise);
    let frames: Vec<FrameId> = world.frames.keys().copied().collect();
    (world, [frames[0], frames[1]])
}

fn nees(estimate: &Relative, truth: &Se3) -> f64 {
    let estimate = estimate.metric().unwrap();
    estimate.covariance.mahalanobis_squared(&estimate.pose.local(truth))
}

#[test]
fn the_estimate_of_a_condensed_log_is_honest() {
    let (mut sums, mut count, mut anchors, mut anchor_count) = ([0.0; 2], 0, [0.0; 2], 0);
    let (mut ratios, mut shifts, mut least) = (Vec::new(), Vec::new(), f64::INFINITY);
    for seed in 0..RUNS {
        let (world, [a, b]) = world(seed);
        let logs = Logs::of(&world);
        let knowledge = logs.knowledge();
        let (condensed, held) = logs.condensed(&knowledge);
        let (full, _) = logs.solve(&knowledge, a, &BTreeMap::new());
        let (short, gaps) = logs.solve(&condensed, a, &held);
        let (Some(x), Some(y)) = (full.frame(a, b), short.frame(a, b)) else { continue };
        let truth = world.frame_truth(a, b).to_se3();
        (sums[0], sums[1], count) = (sums[0] + nees(&x, &truth), sums[1] + nees(&y, &truth), count + 1);
        // The last anchor of the other robot, wherever it is in the chain now.
        let last = SubmapId { frame: b, index: ANCHORS as u32 - 1 };
        let place = gaps[&b].binary_search(&last.index).unwrap() as u32;
        let truth = (world.frames[&a].inverse() * world.anchor(last)).to_se3();
        let (x, y) = (full.anchor(a, last).unwrap(), short.anchor(a, SubmapId { index: place, ..last }).unwrap());
        (anchors[0], anchors[1]) = (anchors[0] + nees(&x, &truth), anchors[1] + nees(&y, &truth));
        anchor_count += 1;
        least = least.min(variances(&x, &y)[0]);
        let (x, y) = (*x.metric().unwrap(), *y.metric().unwrap());
        ratios.push(y.covariance.matrix().trace() / x.covariance.matrix().trace());
        shifts.push(x.covariance.mahalanobis_squared(&x.pose.local(&y.pose)).sqrt());
    }
    ratios.sort_by(f64::total_cmp);
    shifts.sort_by(f64::total_cmp);
    let anees = [sums[0], sums[1], anchors[0], anchors[1]].map(|sum| sum / f64::from(count) / 6.0);
    println!(
        "{count} runs, ANEES/dof of frames {:.3} whole, {:.3} condensed; of anchors {:.3} whole, {:.3} condensed; \
         covariance trace {:.4} to {:.4}, median {:.4}, least of any direction {least:.4}; shift median {:.3}, largest {:.3} sigma",
        anees[0],
        anees[1],
        anees[2],
        anees[3],
        ratios[0],
        ratios[ratios.len() - 1],
        ratios[ratios.len() / 2],
        shifts[shifts.len() / 2],
        shifts[shifts.len() - 1]
    );
    assert!(count >= 300 && count == anchor_count, "{count}");
    for anees in anees {
        assert!((0.93..=1.07).contains(&anees), "{anees}");
    }
    // Compounding itself is exact (the next test). Here the odometry is linearised where it was measured, and in the
    // whole graph where the loops move it to; and by how much the odometry of one submap bent its cloud is told by its
    // share of a compounded step, whose rotations have longer levers: by so much the two differ, to either side.
    assert!(ratios[0] > 0.999 && least > 0.98, "surer than before: {}, {least}", ratios[0]);
    assert!(shifts[shifts.len() - 1] < 0.3, "{}", shifts[shifts.len() - 1]);
}

/// Where the measurements agree, so that whole and condensed graph are linearised at one place, no direction of any
/// relation is surer than before, where no cloud is bent, but for the floor that the graph puts below every factor
/// (1.2e-8), and for rounding.
#[test]
fn a_condensed_log_is_never_surer_than_what_it_replaces() {
    let (mut compounded, mut written) = ([f64::INFINITY, 0.0], [f64::INFINITY, 0.0f64]);
    let widen = |range: &mut [f64; 2], [least, most]: [f64; 2]| *range = [range[0].min(least), range[1].max(most)];
    for seed in 0..20 {
        let (world, [a, b]) = world_with_noise(seed, false);
        let logs = Logs { bent: false, ..Logs::of(&world) };
        let knowledge = logs.knowledge();
        let kept: Gaps = [a, b].map(|frame| (frame, logs.kept(frame, &knowledge))).into();
        assert!(kept.values().all(|kept| kept.len() < ANCHORS - 5));
        let place = |id: SubmapId| SubmapId { index: kept[&id.frame].binary_search(&id.index).unwrap() as u32, ..id };
        let whole = world.solve();
        let exact = solve_map(&compound(&world.problem, &kept), &EstimateConfig::default());
        let (read, _) = logs.solve(&knowledge, a, &BTreeMap::new());
        let (condensed, held) = logs.condensed(&knowledge);
        let (condensed, _) = logs.solve(&condensed, a, &held);
        for (i, j) in [(0, ANCHORS - 1), (ANCHORS - 1, ANCHORS - 1), (ANCHORS - 1, 0)] {
            let (i, j) = (SubmapId { frame: a, index: i as u32 }, SubmapId { frame: b, index: j as u32 });
            let (Some(x), Some(y)) = (whole.relative(i, j), exact.relative(place(i), place(j))) else { continue };
            widen(&mut compounded, variances(&x, &y));
            let (x, y) = (read.relative(i, j).unwrap(), condensed.relative(place(i), place(j)).unwrap());
            widen(&mut written, variances(&x, &y));
        }
    }
    println!("variance of the condensed by that of the whole: compounded {compounded:?}, written and read {written:?}");
    // The graph adds 1e-12 to every variance of every factor. One in place of four is so much surer, and no more: the
    // smallest variance of a step is that of its rotation.
    let floors = f64::from(GONE_IN_A_ROW_MAX) / f64::from(GONE_IN_A_ROW_MAX + 1) * 1e-12 / ODOMETRY.1.powi(2);
    assert!(compounded[0] > 1.0 - floors - 1e-9 && compounded[1] < 1.0 + 1e-9, "{compounded:?}");
    // Means are rounded to 24 bits, by which the two are linearised at places that far apart; covariances upwards.
    assert!(written[0] > 1.0 - 1e-7 && written[1] < 1.05, "{written:?}");
}

/// The problem without the submaps that are not kept, their steps compounded, nothing rounded.
fn compound(problem: &MapProblem, kept: &Gaps) -> MapProblem {
    let mut out = problem.clone();
    for (frame, chain) in &mut out.frames {
        let mut way: Option<PoseWithCovariance> = None;
        let mut odometry = Vec::new();
        for (index, step) in (0..).zip(&chain.odometry) {
            let step = way.take().map_or(*step, |way| way.compose(step));
            if kept[frame].contains(&index) { odometry.push(step) } else { way = Some(step) }
        }
        chain.odometry = odometry;
    }
    for id in out.alignments.iter_mut().flat_map(|m| [&mut m.i, &mut m.j]) {
        id.index = kept[&id.frame].binary_search(&id.index).unwrap() as u32;
    }
    out
}

#[test]
fn what_stays_is_what_is_tied_and_enough_of_the_rest() {
    let (world, frames) = world(7);
    let logs = Logs::of(&world);
    let knowledge = logs.knowledge();
    let tied = knowledge.tied_submaps();
    for frame in frames {
        let Shorter { parts, gone } = logs.shorter(frame, &knowledge);
        let carried: Vec<_> = parts.iter().flat_map(|part| &part.carried).collect();
        let kept: Vec<u32> = carried
            .iter()
            .filter_map(|one| if let Fact::Submap(submap) = &one.fact { Some(submap.index) } else { None })
            .collect();
        assert_eq!(kept.len() + gone.len(), ANCHORS);
        assert!(gone.len() >= ANCHORS / 3, "{} gone", gone.len());
        assert!(kept[0] == 0 && kept.contains(&(ANCHORS as u32 - 1)));
        assert!(tied.iter().filter(|id| id.frame == frame).all(|id| kept.contains(&id.index)));
        assert!(kept.windows(2).all(|two| two[1] - two[0] <= GONE_IN_A_ROW_MAX + 1), "{kept:?}");
        let others = logs.facts[&frame].len() - ANCHORS;
        assert_eq!(carried.len() - kept.len(), others, "every other fact is carried");
        // Each submap says which one it follows now.
        let after: Vec<_> = carried.iter().filter(|one| one.fact.kind() == 1).map(|one| one.after).collect();
        let expected: Vec<_> = std::iter::once(None).chain(kept.iter().copied().map(Some)).take(kept.len()).collect();
        assert_eq!(after, expected);
    }
}

#[test]
fn condensing_again_thins_no_further_where_nothing_is_left_to_go() {
    let (world, [a, _]) = world(9);
    let logs = Logs::of(&world);
    let knowledge = logs.knowledge();
    let first = logs.shorter(a, &knowledge);
    let again = |parts: &[CondensedFact]| {
        let entries: Vec<Entry> =
            (100..).zip(parts).map(|(seq, part)| entry(seq, 100, &Fact::Condensed(part.clone()))).collect();
        shorten(a, &entries, &knowledge).unwrap()
    };
    let second = again(&first.parts);
    assert!(second.gone.is_empty(), "{:?}", second.gone);
    let facts = |shorter: &Shorter| shorter.parts.iter().flat_map(|part| part.carried.clone()).count();
    assert_eq!(facts(&second), facts(&first));
}

#[test]
fn what_cannot_be_read_is_not_condensed_and_idle_answers_go() {
    let (world, [a, b]) = world(11);
    let logs = Logs::of(&world);
    let knowledge = logs.knowledge();
    let mut entries = logs.entries(b);
    let idle = |seq| VerdictFact {
        alignment: EntryId { frame: a, seq },
        outcome: VerdictOutcome::Refused(RefusalReason::TooFew),
    };
    let seq = entries.len() as u32;
    entries.push(entry(seq, 0, &Fact::Verdict(idle(9_999))));
    let shorter = shorten(b, &entries, &knowledge).unwrap();
    let carried =
        |shorter: &Shorter, seq| shorter.parts.iter().any(|part| part.carried.iter().any(|one| one.seq == seq));
    assert!(!carried(&shorter, seq) && carried(&shorter, seq - 1));
    // A gap in the chain of submaps.
    let mut broken = entries.clone();
    broken.remove(5);
    assert!(shorten(b, &broken, &knowledge).is_none());
}

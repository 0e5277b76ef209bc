//! Loop closures within one frame: decides which of them odometry and the other closures support.
//!
//! A closure must agree with the odometry between its ends (χ², 99.9 %), and pairs of closures with each other through
//! the odometry that joins their ends (pairwise consistency, Mangelson et al. 2018, with odometry segments taken as
//! independent; of many, each with a fixed number of others, so that the cost grows with their number). Of closures
//! that contradict each other, the one with the most contradictions goes first.

use super::admission::{Admission, Kind};
use super::joint::Unused;
use super::relative_odometry::{OdometryStep, RelativeOdometry, compose, inverse};
use super::trajectory::Trajectory;
use crate::geometry::{Covariance, PoseWithCovariance, Se3, chi2};
use crate::ids::FrameId;
use std::collections::BTreeMap;

/// Closures of one frame compared with one another; beyond, only odometry and the joint estimate test them.
const CLOSURES_COMPARED_MAX: usize = 256;
/// Others that one of them is compared with at most: a false one contradicts most of these as it does most of all.
const COMPARISONS_MAX: usize = 32;

/// Drift is less than this share of the way, even of odometry that is worse than it says...
const ELSEWHERE_SHARE: f64 = 0.25;
/// ...or than this, m: who turns on the spot drifts, too.
const ELSEWHERE_MIN_M: f64 = 2.0;

/// One closure with `i < j`.
struct Closure {
    edge: usize,
    i: usize,
    j: usize,
    t_i_j: PoseWithCovariance,
}

impl Closure {
    /// Whether it is off from the odometry by so much of the way between its ends that it closes no loop: it took one
    /// place for another. `driven` are the distances to each anchor, m.
    fn is_elsewhere(&self, t_i_j: &Se3, driven: &[f64]) -> bool {
        let way = driven.get(self.i).zip(driven.get(self.j)).map_or(f64::INFINITY, |(from, to)| to - from);
        let off = (self.t_i_j.pose.translation - t_i_j.translation).norm();
        off > ELSEWHERE_MIN_M.max(ELSEWHERE_SHARE * way)
    }
}

/// The distance driven to each anchor, straight from one to the next.
fn driven_to(trajectory: &Trajectory) -> Vec<f64> {
    let (mut way, mut last) = (0.0, None);
    let places = (0..trajectory.len()).filter_map(|k| trajectory.pose(k)).map(|pose| pose.translation);
    let ways = places.map(|at| {
        way += last.replace(at).map_or(0.0, |before| (at - before).norm());
        way
    });
    ways.collect()
}

/// What became of the loop closures of one frame.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Loops {
    /// The odometry between their ends agrees, and the others do.
    pub(super) held: usize,
    /// It refutes them, by more than drift could be (never where the unit is unknown).
    pub(super) refuted: usize,
}

/// Sets aside the loop closures that do not hold, and tells of each frame what became of them.
pub(super) fn gate(admission: &mut Admission) -> BTreeMap<FrameId, Loops> {
    let mut loops = BTreeMap::new();
    let mut by_frame: BTreeMap<FrameId, Vec<Closure>> = BTreeMap::new();
    for (edge, e) in admission.edges.iter().enumerate() {
        let m = &e.measurement;
        if e.kind != Kind::Alignment || e.unused.is_some() || m.i.frame != m.j.frame {
            continue;
        }
        let among_others = e.among_others();
        let Some(t) = among_others.metric() else { continue };
        let (i, j) = (m.i.index as usize, m.j.index as usize);
        let closure =
            if i < j { Closure { edge, i, j, t_i_j: *t } } else { Closure { edge, i: j, j: i, t_i_j: t.inverse() } };
        by_frame.entry(m.i.frame).or_default().push(closure);
    }
    for (frame, mut closures) in by_frame {
        let chain = &admission.chains[&frame];
        let is_metric = !admission.unknown_scale.contains(&frame);
        let (mut refused, mut refuted, driven) = (Vec::new(), 0, driven_to(&chain.trajectory));
        closures.retain(|c| {
            let odometry = chain.trajectory.relative(c.i, c.j);
            let distance = odometry.as_ref().map_or(f64::INFINITY, |t| t.distance_squared(&c.t_i_j));
            let good = distance <= chi2::P999[5];
            if !good {
                refused.push((c.edge, Unused::Odometry(distance)));
                refuted += usize::from(is_metric && odometry.is_some_and(|t| c.is_elsewhere(&t.pose, &driven)));
            }
            good
        });
        let outvoted = outvoted(&chain.trajectory, &closures);
        loops.insert(frame, Loops { held: closures.len() - outvoted.len(), refuted });
        refused.extend(outvoted.into_iter().map(|edge| (edge, Unused::OtherLoops)));
        for (edge, reason) in refused {
            admission.edges[edge].refuse(reason);
        }
    }
    loops
}

/// Edges of the closures to be left out so that the rest agree with those that they are compared with.
fn outvoted(trajectory: &Trajectory, closures: &[Closure]) -> Vec<usize> {
    let n = closures.len().min(CLOSURES_COMPARED_MAX);
    let mut conflicts = vec![Vec::new(); n];
    let ways = RelativeOdometry::new(trajectory, closures[..n].iter().flat_map(|c| [c.i, c.j]));
    for (l, closure) in closures[..n].iter().enumerate() {
        let around = Around::of(closure, &ways);
        for m in compared(n, l) {
            if !around.agrees_with(&closures[m], &ways) {
                conflicts[l].push(m);
                conflicts[m].push(l);
            }
        }
    }
    let mut out = Vec::new();
    // Ties go against the later entry.
    while let Some(worst) = (0..n).rev().max_by_key(|&k| (conflicts[k].len(), k)).filter(|&k| !conflicts[k].is_empty())
    {
        out.push(closures[worst].edge);
        for k in core::mem::take(&mut conflicts[worst]) {
            conflicts[k].retain(|&other| other != worst);
        }
    }
    out
}

/// The others of n closures in a ring that the `l`-th begins a comparison with: all that are nearer to it one way round
/// than the other, or as many of them as there may be, evenly.
fn compared(n: usize, l: usize) -> impl Iterator<Item = usize> {
    let half = n.saturating_sub(1) / 2;
    let kept = half.min(COMPARISONS_MAX / 2);
    let steps = (0..kept).map(move |k| (k + 1) * half / kept);
    let opposite = (n.is_multiple_of(2) && l < n / 2 && n <= COMPARISONS_MAX).then_some(n / 2);
    steps.chain(opposite).map(move |step| (l + step) % n)
}

/// A closure, and the odometry from its ends to where others stand.
struct Around<'a> {
    closure: &'a Closure,
    from_i: Vec<OdometryStep>,
    from_j: Vec<OdometryStep>,
}

impl<'a> Around<'a> {
    fn of(closure: &'a Closure, ways: &RelativeOdometry) -> Self {
        let from = |anchor| ways.from(ways.slot(anchor));
        Self { closure, from_i: from(closure.i), from_j: from(closure.j) }
    }

    fn agrees_with(&self, other: &Closure, ways: &RelativeOdometry) -> bool {
        let there = self.from_i.get(ways.slot(other.i)).zip(self.from_j.get(ways.slot(other.j)));
        there.is_some_and(|(out, back)| {
            let along = (other.t_i_j.pose, *other.t_i_j.covariance.matrix());
            let (pose, sigma) = compose(&compose(out, &along), &inverse(back));
            let through_other = PoseWithCovariance { pose, covariance: Covariance::new_or_wider(sigma) };
            through_other.distance_squared(&self.closure.t_i_j) <= chi2::P999[5]
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Se3;
    use crate::geometry::sampling::rng;
    use nalgebra::Vector6;
    use rand::Rng;
    use std::collections::BTreeSet;

    /// Far more closures than are compared with one another, every tenth false, each in its own way, by no more than
    /// the odometry allows.
    #[test]
    fn the_false_ones_of_many_are_left_out_and_no_others() {
        let mut rng = rng(77);
        let mut noise = |sigma: f64| Se3::exp(&Vector6::from_fn(|_, _| sigma * (rng.next_u32() as f64 / 2e9 - 1.0)));
        let step = Se3::exp(&Vector6::new(1.0, 0.0, 0.0, 0.0, 0.0, 0.3));
        let of = |pose, sigma| PoseWithCovariance { pose, covariance: Covariance::from_sigmas([sigma; 6]).unwrap() };
        let drift = 0.02;
        let odometry = Trajectory::new((0..120).map(|_| of(step, drift)));
        let mut truth = vec![step];
        (1..120).for_each(|k| truth.push(truth[k - 1] * step * noise(drift)));
        let closure = |edge: usize| {
            let (i, j) = (edge % 50, 60 + (edge * 7) % 60);
            let exact = truth[i].inverse() * truth[j] * noise(0.005);
            let pose = if edge % 10 == 3 { exact * noise(0.4) } else { exact };
            Closure { edge, i, j, t_i_j: of(pose, 0.01) }
        };
        let closures: Vec<Closure> = (0..200).map(closure).collect();
        let mut found = outvoted(&odometry, &closures);
        found.sort_unstable();
        assert_eq!(found, (0..200).filter(|edge| edge % 10 == 3).collect::<Vec<_>>());
    }

    #[test]
    fn few_are_all_compared_once_and_each_of_many_with_as_many_others() {
        for n in 0..=300 {
            let pairs: Vec<(usize, usize)> =
                (0..n).flat_map(|l| compared(n, l).map(move |m| (l.min(m), l.max(m)))).collect();
            let distinct: BTreeSet<(usize, usize)> = pairs.iter().copied().collect();
            assert!(distinct.len() == pairs.len() && pairs.iter().all(|(l, m)| l != m && *m < n), "{n}");
            let of = |k: usize| pairs.iter().filter(|(l, m)| *l == k || *m == k).count();
            let each = (0..n).map(of).collect::<BTreeSet<_>>();
            let expected = if n <= COMPARISONS_MAX + 1 { n.saturating_sub(1) } else { COMPARISONS_MAX };
            assert!(each.iter().all(|&count| count == expected), "{n}: {each:?}");
        }
    }
}

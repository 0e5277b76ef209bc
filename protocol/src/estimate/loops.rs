//! Loop closures within one frame: decides which of them odometry and the other closures support.
//!
//! A closure must agree with the odometry between its ends (χ², 99.9 %), and pairs of closures with each other through
//! the odometry that joins their ends (pairwise consistency, Mangelson et al. 2018, with odometry segments taken as
//! independent). Of closures that contradict each other, the one with the most contradictions goes first.

use super::intake::{Chain, Intake, Kind};
use super::joint::Unused;
use super::reweight::CHI2_999;
use crate::geometry::PoseWithCovariance;
use crate::ids::FrameId;
use std::collections::BTreeMap;

/// Closures of one frame compared with one another; beyond, only odometry and the joint estimate test them.
const CLOSURES_COMPARED_MAX: usize = 256;

/// One closure with `i < j`.
struct Closure {
    edge: usize,
    i: usize,
    j: usize,
    t_i_j: PoseWithCovariance,
}

/// Sets aside the loop closures that do not hold.
pub(super) fn gate(intake: &mut Intake) {
    let mut by_frame: BTreeMap<FrameId, Vec<Closure>> = BTreeMap::new();
    for (edge, e) in intake.edges.iter().enumerate() {
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
        let chain = &intake.chains[&frame];
        let mut refused = Vec::new();
        closures.retain(|c| {
            let odometry = chain.trajectory.relative(c.i, c.j);
            let distance = odometry.map_or(f64::INFINITY, |t| t.distance_squared(&c.t_i_j));
            let good = distance <= CHI2_999[5];
            if !good {
                refused.push((c.edge, Unused::Odometry(distance)));
            }
            good
        });
        refused.extend(outvoted(chain, &closures).into_iter().map(|edge| (edge, Unused::OtherLoops)));
        for (edge, reason) in refused {
            intake.edges[edge].refuse(reason);
        }
    }
}

/// Edges of the closures to be left out so that the rest agree pairwise.
fn outvoted(chain: &Chain, closures: &[Closure]) -> Vec<usize> {
    let n = closures.len().min(CLOSURES_COMPARED_MAX);
    let mut conflicts = vec![Vec::new(); n];
    for l in 0..n {
        for m in 0..l {
            if !consistent(chain, &closures[l], &closures[m]) {
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

fn consistent(chain: &Chain, l: &Closure, m: &Closure) -> bool {
    let (out, back) = (chain.trajectory.relative(l.i, m.i), chain.trajectory.relative(m.j, l.j));
    let through_m = out.zip(back).map(|(out, back)| out.compose(&m.t_i_j).compose(&back));
    through_m.is_some_and(|t| t.distance_squared(&l.t_i_j) <= CHI2_999[5])
}

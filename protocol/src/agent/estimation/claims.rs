//! What was said of pairs of frames, held against what is said now: nobody who relied on a claim may miss that it was
//! withdrawn, or that it was wrong.

use crate::agent::context::Context;
use crate::agent::io::Event;
use crate::estimate::PairEstimate;
use crate::estimate::blame::Blame;
use crate::estimate::misfits::misfits;
use crate::geometry::{Relative, chi2};
use crate::ids::{FrameId, RobotId};
use crate::kinds::PairStatus;
use std::collections::BTreeMap;

/// A claim is replaced by one whose standard deviations are, in the mean, smaller by this factor. Until then it stands,
/// so that what moves little by little is noticed as well.
const TIGHTER: f64 = 0.7;

/// What was claimed of merged pairs, and whom contradictions were said to be due to.
#[derive(Debug, Default)]
pub(super) struct Claims {
    merged: BTreeMap<(FrameId, FrameId), Relative>,
    blames: Vec<Blame>,
    misfits: BTreeMap<RobotId, usize>,
}

/// What became of a claim.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Change {
    /// A pair lies elsewhere than was claimed at 99.9 %, by so many m or units of the first frame.
    Moved(FrameId, FrameId, f64),
    /// A pair is no longer merged.
    Unmerged(FrameId, FrameId, Option<PairStatus>),
    /// Pairs contradict one another that did not, or others may be to blame.
    Contradict(Blame),
    /// What a robot states does not fit together as so many others see it.
    Misfit(RobotId, usize),
}

impl Claims {
    /// Takes what a new estimate says: what became of what was said before.
    pub(super) fn renew(&mut self, pairs: &[PairEstimate]) -> Vec<Change> {
        let before = core::mem::take(&mut self.merged);
        let mut changes = Vec::new();
        for pair in pairs.iter().filter(|pair| pair.status == PairStatus::Merged) {
            let Some(now) = pair.t_a_b else { continue };
            let claim = before.get(&(pair.a, pair.b));
            let moved = claim.and_then(|claim| moved(claim, &now));
            changes.extend(moved.map(|by| Change::Moved(pair.a, pair.b, by)));
            let stands = claim.filter(|claim| moved.is_none() && !is_tighter(&now, claim));
            self.merged.insert((pair.a, pair.b), stands.copied().unwrap_or(now));
        }
        for (a, b) in before.into_keys().filter(|pair| !self.merged.contains_key(pair)) {
            let now = pairs.iter().find(|pair| (pair.a, pair.b) == (a, b));
            changes.push(Change::Unmerged(a, b, now.map(|pair| pair.status)));
        }
        let mut blames: Vec<Blame> = pairs.iter().filter_map(|pair| pair.blame.clone()).collect();
        blames.sort();
        blames.dedup();
        changes.extend(blames.iter().filter(|blame| !self.blames.contains(blame)).cloned().map(Change::Contradict));
        self.blames = blames;
        let misfits = misfits(pairs);
        let new = misfits.iter().filter(|(robot, _)| !self.misfits.contains_key(robot));
        changes.extend(new.map(|(robot, others)| Change::Misfit(*robot, *others)));
        self.misfits = misfits;
        changes
    }
}

impl Change {
    /// What people are told.
    pub(super) fn event(self, context: &Context) -> Event {
        match self {
            Self::Moved(a, b, by) => Event::PairMoved { a: context.frame_name(a), b: context.frame_name(b), by },
            Self::Unmerged(a, b, status) => {
                Event::PairUnmerged { a: context.frame_name(a), b: context.frame_name(b), status }
            }
            Self::Misfit(robot, others) => Event::RobotDoesNotFit { robot: context.robot_name(robot), others },
            Self::Contradict(blame) => Event::PairsContradict {
                robots: blame.robots.iter().map(|robot| context.robot_name(*robot)).collect(),
                certain: blame.certain,
            },
        }
    }
}

/// How far a claim was off, m or units of the first frame, if it was by more than it said at 99.9 %. `None` also where
/// one of the two is a similarity and the other is not.
fn moved(claim: &Relative, now: &Relative) -> Option<f64> {
    let (distance_squared, limit) = match (claim, now) {
        (Relative::Metric(claim), Relative::Metric(now)) => {
            (claim.covariance.mahalanobis_squared(&claim.pose.local(&now.pose)), chi2::P999[5])
        }
        (Relative::Similarity(claim), Relative::Similarity(now)) => {
            (claim.covariance.mahalanobis_squared(&claim.sim.local(&now.sim)), chi2::P999[6])
        }
        _ => return None,
    };
    let metres = (claim.sim().translation - now.sim().translation).norm();
    (distance_squared > limit).then_some(metres)
}

fn is_tighter(now: &Relative, claim: &Relative) -> bool {
    now.translation_variance() < TIGHTER * TIGHTER * claim.translation_variance()
}

#[cfg(test)]
#[path = "claims_tests.rs"]
mod tests;

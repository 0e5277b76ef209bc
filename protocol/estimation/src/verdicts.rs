//! What the consensus of pairs of frames came to, remembered from one solve of the map to the next: most of a growing
//! map is what it was, and a consensus costs the cube of its alignments.
//!
//! A verdict is a pure function of the pair's alignments, of the odometry up to the anchors that they name, of the boxes
//! that both ways fill, and of the options. It is kept under the digest of all these, so that a remembered one is what
//! would be found again, to the bit; the map does not depend on what is remembered.

use super::admission::{Admission, Chain};
use super::graph::{is_rigid, numbers_of};
use super::pairs::Outcome;
use crate::config::EstimateConfig;
use crate::ids::{FrameId, Hash};
use std::collections::BTreeMap;

/// Verdicts by pair of frames, of the last map alone: no more than there are pairs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdicts {
    of: BTreeMap<(FrameId, FrameId), (Hash, Verdict)>,
    recalled: usize,
}

/// What came of a pair's alignments.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Verdict {
    /// Which of the alignments were weighed.
    pub(super) weighed: Vec<usize>,
    /// What these amount to.
    pub(super) outcome: Outcome,
}

impl Verdicts {
    /// How many pairs of the last map were not weighed again.
    pub fn recalled(&self) -> usize {
        self.recalled
    }

    /// Verdicts on the pairs, each with its alignments among the admission's edges, in their order; `judge` finds those
    /// that are not known.
    pub(super) fn on(
        &mut self,
        pairs: &BTreeMap<(FrameId, FrameId), Vec<usize>>,
        admission: &Admission,
        config: &EstimateConfig,
        judge: impl Fn((FrameId, FrameId), &[usize]) -> Verdict,
    ) -> Vec<Verdict> {
        let mut before = core::mem::take(self).of;
        let ways: BTreeMap<FrameId, Way> =
            pairs.keys().flat_map(|&(a, b)| [a, b]).map(|f| (f, Way::of(&admission.chains[&f]))).collect();
        let verdict = |(&pair, members): (&(FrameId, FrameId), &Vec<usize>)| {
            let digest = digest(pair, members, admission, &ways, config);
            let known = before.remove(&pair).filter(|(of, _)| *of == digest).map(|(_, verdict)| verdict);
            self.recalled += usize::from(known.is_some());
            let verdict = known.unwrap_or_else(|| judge(pair, members));
            self.of.insert(pair, (digest, verdict.clone()));
            verdict
        };
        pairs.iter().map(verdict).collect()
    }
}

/// A frame's odometry.
struct Way {
    /// By anchor, the digest of the odometry up to it.
    to: Vec<Hash>,
    extent: [f64; 3],
}

impl Way {
    fn of(chain: &Chain) -> Self {
        let mut last = Hash::of(&[]);
        let to = core::iter::once(&chain.origin).chain(&chain.steps).map(|step| {
            let mut bytes = last.0.to_vec();
            push(&mut bytes, step.pose.translation.iter().copied().chain(step.pose.rotation.xyzw()));
            push(&mut bytes, step.covariance.packed());
            last = Hash::of(&bytes);
            last
        });
        Self { to: to.collect(), extent: chain.trajectory.extent().into() }
    }
}

fn digest(
    (a, b): (FrameId, FrameId),
    members: &[usize],
    admission: &Admission,
    ways: &BTreeMap<FrameId, Way>,
    config: &EstimateConfig,
) -> Hash {
    let EstimateConfig { alignments_min, log10_nfa_max, covariance_scale_max, iterations_max: _, interval_secs: _ } =
        config;
    let mut bytes = vec![u8::from(is_rigid(a, b, &admission.unknown_scale))];
    bytes.extend((*alignments_min as u64).to_le_bytes());
    push(&mut bytes, [*log10_nfa_max, *covariance_scale_max]);
    let mut farthest = [0; 2];
    for edge in members.iter().map(|&k| &admission.edges[k]) {
        let ends = [edge.measurement.i, edge.measurement.j];
        for end in ends {
            bytes.push(u8::from(end.frame == a));
            bytes.extend(end.index.to_le_bytes());
            let farthest = &mut farthest[usize::from(end.frame == b)];
            *farthest = (*farthest).max(end.index as usize);
        }
        push(&mut bytes, numbers_of(&edge.measurement.t_i_j));
        push(&mut bytes, [edge.charges.between]);
    }
    for (frame, farthest) in [(a, farthest[0]), (b, farthest[1])] {
        let way = &ways[&frame];
        bytes.extend(way.to.get(farthest).map_or([0; 32], |hash| hash.0));
        push(&mut bytes, way.extent);
    }
    Hash::of(&bytes)
}

fn push(bytes: &mut Vec<u8>, numbers: impl IntoIterator<Item = f64>) {
    bytes.extend(numbers.into_iter().flat_map(|number| number.to_bits().to_le_bytes()));
}

#[cfg(test)]
#[path = "verdicts_tests.rs"]
mod tests;

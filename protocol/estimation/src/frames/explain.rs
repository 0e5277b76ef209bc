//! The explanation of all alignments that has the most evidence: one set that speaks of one transform, or two that
//! speak of two (a truth and a lie, whichever is which), the rest being chance.
//!
//! Evidence cannot tell which of two sets is the truth, since an explanation has them both; only their sizes can. It
//! does tell a blend of both from the two apart, whose a member is where both would have it, and whether an alignment
//! just outside a gate is a member: where the prediction is sharp, chance seldom comes near and a wide gate is right;
//! where it is loose, a narrow one.

use super::clique::{self, Set, bit};
use super::doubt::odds_of_false;
use super::evidence::Evidence;
use super::gate;
use super::measured::Measured;
use super::pairs::Pairs;
use super::scaled::Scaled;

/// What an alignment must add to a set's evidence to be one of it, as a logarithm: a hundredfold.
const MEMBER_MIN: f64 = 4.6;
/// What it must add to be used, more: near misses are more frequent than chance spread evenly...
const USED_MIN: f64 = 6.5;
/// ...unless so few contradict that the odds of its being false are no more than this all the same: what [`USED_MIN`]
/// amounts to where as many do as agree.
const FALSE_MAX: f64 = 0.1;
/// A member of one set that adds as much to the other, to a hundredth, may be either's.
const CONTESTED: f64 = 4.6;
/// An alignment is tried for a set if it agrees with a member at this many times the widest gate.
const NEAR: f64 = 2.0;
/// Sweeps over all alignments at most; two or three suffice.
const SWEEPS_MAX: usize = 6;

/// At most two disjoint sets, the larger first.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Explanation {
    pub(super) first: Set,
    pub(super) second: Set,
    /// Members of the first that may be the second's.
    pub(super) contested: Set,
}

impl Explanation {
    /// The best over `candidates`: one of them, or one and what another has besides, both significant.
    pub(super) fn best<const N: usize, G: Scaled<N>>(
        measured: &Measured<'_, N, G>,
        pairs: &Pairs,
        evidence: &mut Evidence<'_, N, G>,
        candidates: &[Set],
    ) -> Option<Self> {
        let significant = |set: Set| pairs.log10_nfa(measured, set).0 <= measured.config.log10_nfa_max;
        let mut worth = |set: Set| evidence.of(set) - MEMBER_MIN * f64::from(set.count_ones().saturating_sub(1));
        let mut best: Option<(f64, Self)> = None;
        let mut offer = |worth: f64, first: Set, second: Set| {
            if best.is_none_or(|(so_far, _)| worth > so_far) {
                best = Some((worth, Self { first, second, contested: 0 }));
            }
        };
        for &first in candidates {
            let of_first = worth(first);
            offer(of_first, first, 0);
            if significant(first) {
                let rests = candidates.iter().map(|other| other & !first);
                for second in rests.filter(|&rest| rest.count_ones() >= 2 && significant(rest)) {
                    offer(of_first + worth(second), first, second);
                }
            }
        }
        best.map(|(_, explanation)| explanation.refined(measured, pairs, evidence))
    }

    /// With each alignment where it adds most, if anywhere; the larger set first.
    fn refined<const N: usize, G: Scaled<N>>(
        mut self,
        measured: &Measured<'_, N, G>,
        pairs: &Pairs,
        evidence: &mut Evidence<'_, N, G>,
    ) -> Self {
        let scale_max = measured.scales().into_iter().fold(1.0, f64::max);
        let near = pairs.graph(gate(N, NEAR * scale_max));
        for _ in 0..SWEEPS_MAX {
            let before = self;
            for (l, &near) in near.iter().enumerate() {
                let of_first = gain(evidence, self.first, l, near);
                let of_second = gain(evidence, self.second, l, near);
                // Two alone stay together: there is nothing better to merge on.
                let two = self.first.count_ones() <= 2 && self.first & bit(l) != 0;
                let (mut first, mut second) = (self.first & !bit(l), self.second & !bit(l));
                if of_second > of_first && of_second >= MEMBER_MIN {
                    second |= bit(l);
                } else if of_first >= MEMBER_MIN || two {
                    first |= bit(l);
                }
                self = Self { first, second, contested: 0 };
            }
            if self == before {
                break;
            }
        }
        if self.second.count_ones() > self.first.count_ones() {
            core::mem::swap(&mut self.first, &mut self.second);
        }
        let mut contested = |l: &usize| {
            let of_second = gain(evidence, self.second, *l, near[*l]);
            of_second >= MEMBER_MIN && of_second + CONTESTED > gain(evidence, self.first, *l, near[*l])
        };
        self.contested = clique::vertices(self.first).filter(|l| contested(l)).map(bit).sum();
        self
    }

    /// The first set of `n` alignments without members that may well be false, the weakest first. What a member must add
    /// depends on how many contradict: where all agree, alignments of a small room, each too vague to prove much, are
    /// used together, while among as many others as members the same are not.
    pub(super) fn used<const N: usize, G: Scaled<N>>(&self, evidence: &mut Evidence<'_, N, G>, n: usize) -> Set {
        let mut set = self.first;
        while set.count_ones() > 2 {
            let gains = clique::vertices(set).map(|l| (evidence.of_member(set, l), l));
            match gains.min_by(|a, b| a.0.total_cmp(&b.0)) {
                Some((gain, l)) if gain < USED_MIN && odds_of_false(n, set, gain) > FALSE_MAX => set &= !bit(l),
                _ => break,
            }
        }
        set
    }
}

/// What `l`, that agrees with the alignments `near` by a wide gate, adds or would add to `set`.
fn gain<const N: usize, G: Scaled<N>>(evidence: &mut Evidence<'_, N, G>, set: Set, l: usize, near: Set) -> f64 {
    if set & bit(l) != 0 {
        evidence.of_member(set, l)
    } else if set.count_ones() >= 2 && near & set != 0 {
        evidence.of(set | bit(l)) - evidence.of(set)
    } else {
        f64::NEG_INFINITY
    }
}

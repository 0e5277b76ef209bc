//! The explanation of all alignments that has the most evidence: one set that speaks of one transform, or two that
//! speak of two (a truth and a lie, whichever is which), the rest being chance.
//!
//! Evidence cannot tell which of two sets is the truth, since an explanation has them both; only their sizes can. It
//! does tell a blend of both from the two apart, whose a member is where both would have it, and whether an alignment
//! just outside a gate is a member: where the prediction is sharp, chance seldom comes near and a wide gate is right;
//! where it is loose, a narrow one.

use super::clique::{self, Set, bit};
use super::doubt::{Odds, relief};
use super::evidence::Evidence;
use super::measured::Measured;
use super::pairs::Pairs;
use super::scaled::Scaled;

/// What an alignment must add to a set's evidence to be one of it, as a logarithm: a hundredfold in space, and in the
/// plane less by the [`relief`].
const MEMBER_MIN: f64 = 4.6;
/// What it must add to be used, more: near misses are more frequent than chance spread evenly...
const USED_MIN: f64 = 6.5;
/// ...unless so few contradict that the odds of its being false are no more than this all the same: what [`USED_MIN`]
/// amounts to where as many do as agree.
const FALSE_MAX: f64 = 0.1;
/// A member of one set that adds as much to the other, to a hundredth, may be either's.
const CONTESTED: f64 = 4.6;
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
        let member_min = MEMBER_MIN - relief(N);
        let mut worth = |set: Set| evidence.of(set) - member_min * f64::from(set.count_ones().saturating_sub(1));
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
        best.map(|(_, explanation)| explanation.refined(measured.alignments.len(), evidence))
    }

    /// With each alignment where it adds most, if anywhere; the larger set first.
    fn refined<const N: usize, G: Scaled<N>>(mut self, n: usize, evidence: &mut Evidence<'_, N, G>) -> Self {
        let member_min = MEMBER_MIN - relief(N);
        for _ in 0..SWEEPS_MAX {
            let before = self;
            for l in 0..n {
                let (of_first, of_second) = (evidence.gain(self.first, l), evidence.gain(self.second, l));
                // Two alone stay together: there is nothing better to merge on.
                let two = self.first.count_ones() <= 2 && self.first & bit(l) != 0;
                let (mut first, mut second) = (self.first & !bit(l), self.second & !bit(l));
                if of_second > of_first && of_second >= member_min {
                    second |= bit(l);
                } else if of_first >= member_min || two {
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
            let of_second = evidence.gain(self.second, *l);
            of_second >= member_min && of_second + CONTESTED > evidence.gain(self.first, *l)
        };
        self.contested = clique::vertices(self.first).filter(|l| contested(l)).map(bit).sum();
        self
    }

    /// The first set of `n` alignments without members that may well be false, the weakest first, and with others that
    /// hardly are, too vague to belong to it by themselves, the strongest first. Either depends on how many contradict:
    /// where all agree, alignments of a small room, each too vague to prove much, are used together, while among as
    /// many others as members the same are not.
    pub(super) fn used<const N: usize, G: Scaled<N>>(&self, evidence: &mut Evidence<'_, N, G>, n: usize) -> Set {
        let mut set = self.first;
        // Each is dropped or taken once; what is dropped stays so.
        let mut dropped = 0;
        while set.count_ones() > 2 {
            let odds = Odds::of(evidence, n, set);
            let gains = clique::vertices(set).map(|l| (evidence.gain(set, l), l));
            match gains.min_by(|a, b| a.0.total_cmp(&b.0)) {
                Some((gain, l)) if gain < USED_MIN - relief(N) && odds.of_false(gain) > FALSE_MAX => {
                    set &= !bit(l);
                    dropped |= bit(l);
                    continue;
                }
                _ => {}
            }
            let others = (0..n).filter(|&l| (set | self.second | dropped) & bit(l) == 0);
            let gains: Vec<(f64, usize)> = others.map(|l| (evidence.gain(set, l), l)).collect();
            match gains.into_iter().max_by(|a, b| a.0.total_cmp(&b.0)) {
                Some((gain, l)) if odds.of_false(gain) <= FALSE_MAX => set |= bit(l),
                _ => break,
            }
        }
        set
    }
}

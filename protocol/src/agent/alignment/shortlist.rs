//! The most alike pairs of submaps, up to a limit: in whatever order pairs are offered, the same ones are kept.

use crate::agent::replication::knowledge::{Pair, pair_of};
use crate::ids::SubmapId;
use crate::submap::Similarity;
use std::collections::{BTreeMap, BTreeSet};

/// A pair worth trying.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Candidate {
    /// Our submap.
    pub mine: SubmapId,
    /// The other one (a peer's, or ours for a loop).
    pub theirs: SubmapId,
    /// Of the summaries.
    pub similarity: Similarity,
    /// The other endpoint asked for it.
    pub wished: bool,
    /// It was refused, and is to be looked at again with further keypoints.
    pub further: bool,
}

/// See the module.
#[derive(Debug, Default)]
pub struct Shortlist {
    pairs: BTreeMap<Pair, Candidate>,
    /// The same pairs, the least alike first: to make room must not cost a look at all.
    ranks: BTreeSet<(u64, Pair)>,
}

impl Shortlist {
    /// Takes a pair, unless it is there already; the least alike beyond `limit` goes.
    pub fn offer(&mut self, candidate: Candidate, limit: usize) {
        let pair = pair_of(candidate.mine, candidate.theirs);
        if self.pairs.contains_key(&pair) {
            return;
        }
        self.pairs.insert(pair, candidate);
        self.ranks.insert((rank(&candidate), pair));
        if self.pairs.len() > limit {
            let worst = self.ranks.pop_first();
            worst.map(|(_, pair)| self.pairs.remove(&pair));
        }
    }

    /// Takes a pair off the list.
    pub fn remove(&mut self, pair: Pair) -> Option<Candidate> {
        let candidate = self.pairs.remove(&pair)?;
        self.ranks.remove(&(rank(&candidate), pair));
        Some(candidate)
    }

    /// Takes off the list what is not to stay.
    pub fn retain(&mut self, stays: impl Fn(&Candidate) -> bool) {
        self.pairs.retain(|_, candidate| stays(candidate));
        self.ranks.retain(|(_, pair)| self.pairs.contains_key(pair));
    }

    /// Notes that the other endpoint asked for a pair. False if it is not on the list.
    pub fn wish(&mut self, pair: Pair) -> bool {
        self.pairs.get_mut(&pair).map(|candidate| candidate.wished = true).is_some()
    }

    /// A pair less alike than this would not be kept.
    pub fn least(&self, limit: usize) -> f64 {
        match self.ranks.first() {
            Some((rank, _)) if self.pairs.len() >= limit => f64::from_bits(*rank),
            _ => 0.0,
        }
    }

    /// The pairs, in canonical order.
    pub fn iter(&self) -> impl Iterator<Item = (Pair, &Candidate)> {
        self.pairs.iter().map(|(pair, candidate)| (*pair, candidate))
    }

    /// Forgets all.
    pub fn clear(&mut self) {
        self.pairs.clear();
        self.ranks.clear();
    }
}

/// Sorts as the similarity does, which is not negative.
fn rank(candidate: &Candidate) -> u64 {
    candidate.similarity.value.max(0.0).to_bits()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::{FrameId, RobotId};
    use crate::submap::Looks;

    fn candidate(index: u32, similarity: f64) -> Candidate {
        let submap = |robot, index| SubmapId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 1 }, index };
        let similarity = Similarity { value: similarity, by: Looks::Summary };
        Candidate { mine: submap(1, 0), theirs: submap(2, index), similarity, wished: false, further: false }
    }

    fn kept(list: &Shortlist) -> Vec<u32> {
        list.iter().map(|(_, candidate)| candidate.theirs.index).collect()
    }

    #[test]
    fn the_order_of_offers_changes_nothing() {
        let offers: Vec<Candidate> = (0..40).map(|k| candidate(k, f64::from(k * 7 % 10) / 10.0)).collect();
        let (mut forward, mut backward) = (Shortlist::default(), Shortlist::default());
        offers.iter().for_each(|offer| forward.offer(*offer, 5));
        offers.iter().rev().for_each(|offer| backward.offer(*offer, 5));
        assert_eq!(kept(&forward), kept(&backward));
        assert!(forward.iter().all(|(_, candidate)| candidate.similarity.value >= 0.8));
        assert_eq!(forward.least(5), 0.8);
        assert_eq!(forward.least(6), 0.0, "there is room");
    }

    #[test]
    fn what_is_removed_leaves_room() {
        let mut list = Shortlist::default();
        (0..4).for_each(|k| list.offer(candidate(k, f64::from(k)), 3));
        assert_eq!(kept(&list), [1, 2, 3]);
        let pair = pair_of(candidate(1, 0.0).mine, candidate(1, 0.0).theirs);
        assert!(list.wish(pair));
        assert!(list.remove(pair).is_some_and(|candidate| candidate.wished));
        assert!(!list.wish(pair) && list.remove(pair).is_none());
        list.offer(candidate(0, 0.0), 3);
        assert_eq!(kept(&list), [0, 2, 3]);
    }
}

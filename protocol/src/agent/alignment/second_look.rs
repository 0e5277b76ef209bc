//! A second look, with further keypoints, at a pair that was refused although the joint estimate says that it overlaps.
//!
//! A submap's blob names the address of another one that goes on with it. That one is fetched (of our own submaps,
//! read) only then: too few matches held, and by the map the two overlap by most of what they saw. What a second look
//! finds counts only if it is where the map that called for it has it, and the estimate lets it speak for no merge
//! ([`MapProblem::second_looks`](crate::estimate::joint::MapProblem::second_looks)): what was looked for where it was
//! expected is no witness that it lies there. So it makes surer what is known, and joins nothing. (Where nothing
//! connects two frames, more keypoints find hardly a true pair more, and sooner a false one.) After a restart what was
//! refused stays refused.

use super::Prospects;
use super::negotiation::Work;
use super::overlap_model::Prediction;
use super::ranking::DRIFT_SIGMAS;
use super::shortlist::Candidate;
use crate::agent::replication::knowledge::pair_of;
use crate::agent::two_sided;
use crate::geometry::Relative;
use crate::ids::{Hash, SubmapId};
use crate::submap::Keypoints;
use crate::wire::fact::{AlignmentFact, RefusalReason};

/// Pairs that wait for a second look at most; of more, the least alike go.
pub const SECOND_LOOKS_MAX: usize = 1_024;
/// A pair gets a second look if its anchors are no farther apart than this, at the most that is likely and in units of
/// what both reach: then the two overlap by most of what either saw.
const APART_MAX: f64 = 0.3;
/// What a second look finds may be off by so much from where the map has it, in units of what both reach. The map's
/// covariances may allow more, and places that repeat themselves do so at larger steps, or within one view.
const OFF_MAX: f64 = 0.1;
/// What a second look is worth of a first one that promises as much: it is had when there is nothing better to do.
pub(super) const WORTH: f64 = 0.1;

impl Prospects<'_> {
    /// A first look at a pair found too little. More keypoints may help, if there are any: then it may be looked at
    /// again.
    pub(super) fn second_look(&self, work: &Work, prediction: Prediction, reason: RefusalReason) -> Option<Candidate> {
        let too_little = match reason {
            RefusalReason::TooFew | RefusalReason::NoConsensus | RefusalReason::PoorFit => true,
            RefusalReason::Ambiguous | RefusalReason::Degenerate | RefusalReason::BadInput => false,
        };
        let may_help = too_little && work.further.is_none() && self.address_of(work.theirs).is_some();
        let (mine, theirs, similarity) = (work.mine, work.theirs, prediction.features.similarity);
        may_help.then_some(Candidate { mine, theirs, similarity, wished: false, further: true })
    }

    /// Whether a pair that was refused is to be found all the same, by a map that holds both.
    pub(super) fn calls_for_second_look(&self, candidate: &Candidate) -> bool {
        let (mine, theirs) = (candidate.mine, candidate.theirs);
        let goes_on = self.address_of(theirs).is_some();
        let is_near = self.expected(mine, theirs).is_some_and(|(t_mine_theirs, reach)| is_near(&t_mine_theirs, reach));
        let is_lost = |id| self.is_further_out_of_reach(id);
        goes_on && is_near && !is_lost(theirs) && !is_lost(mine)
    }

    /// `t_mine_theirs` by the map, as if its anchors' errors had nothing in common, and what both submaps reach.
    fn expected(&self, mine: SubmapId, theirs: SubmapId) -> Option<(Relative, f64)> {
        let t_mine_theirs = self.anchor(mine)?.inverse().compose(self.anchor(theirs)?);
        let reach = self.reach(mine) + t_mine_theirs.sim().scale * self.reach(theirs);
        Some((t_mine_theirs, reach))
    }

    /// Nobody in reach has the submap's further keypoints.
    fn is_further_out_of_reach(&self, id: SubmapId) -> bool {
        self.address_of(id).is_some_and(|address| self.fetches.is_out_of_reach(address))
    }

    /// Whether what was found may stand: what a second look found is where the map has it. `None` if the map does not
    /// hold both.
    pub(super) fn agrees_with_map(&self, work: &Work, t_mine_theirs: &Relative) -> Option<bool> {
        if work.further.is_none() {
            return Some(true);
        }
        let (expected, reach) = self.expected(work.mine, work.theirs)?;
        Some(is_where_expected(&expected, t_mine_theirs, reach))
    }

    /// The blobs that an alignment of ours was computed from, of which one tells that further keypoints were looked at.
    pub(super) fn blobs_used(&self, work: &Work) -> Option<[Hash; 2]> {
        let blob = |id| self.knowledge.submap(id).map(|fact| fact.blob);
        let (mine, theirs) = (blob(work.mine)?, work.further.or(blob(work.theirs))?);
        Some(if pair_of(work.mine, work.theirs).0 == work.mine { [mine, theirs] } else { [theirs, mine] })
    }

    /// Whether another's alignment of our submap was computed from its further keypoints too, so that we look with
    /// theirs; `None` if it names other blobs than those that the owners stated.
    pub(super) fn is_second_look(&self, fact: &AlignmentFact) -> Option<bool> {
        let (mine, theirs) = self.ours_first(fact);
        let blob = |id| self.knowledge.submap(id).map(|submap| submap.blob);
        let [used_i, used_j] = fact.blobs;
        let (of_mine, of_theirs) = if fact.i == mine { (used_i, used_j) } else { (used_j, used_i) };
        if blob(theirs) != Some(of_theirs) {
            return None;
        }
        let is_further = self.address_of(mine) == Some(of_mine);
        (is_further || blob(mine) == Some(of_mine)).then_some(is_further)
    }

    /// Whether another's alignment can be judged now: once their submap is known here; a second look, once our map
    /// holds both submaps, and unless nobody in reach has their further keypoints. What cannot be looked at is not
    /// refused.
    pub(super) fn may_be_judged(&self, fact: &AlignmentFact) -> bool {
        let (mine, theirs) = self.ours_first(fact);
        let is_known = self.knowledge.submap(theirs).is_some();
        let is_second = self.is_second_look(fact) == Some(true);
        let may_look_again = self.are_connected(mine, theirs) && !self.is_further_out_of_reach(theirs);
        is_known && (!is_second || may_look_again)
    }

    /// The two submaps of another's alignment of one of ours.
    pub(super) fn ours_first(&self, fact: &AlignmentFact) -> (SubmapId, SubmapId) {
        if fact.i.frame.robot == self.context.robot() { (fact.i, fact.j) } else { (fact.j, fact.i) }
    }

    /// Where a submap's keypoints go on, if they do and those that say so are here.
    pub(super) fn address_of(&self, id: SubmapId) -> Option<Hash> {
        let blob = self.knowledge.submap(id)?.blob;
        match self.negotiation.keypoints(blob) {
            Some(keypoints) => keypoints.further(),
            None => self.blobs.get(blob).and_then(Keypoints::address_in),
        }
    }
}

/// Whether two submaps overlap by most of what either saw, for all that the map leaves open.
fn is_near(t_mine_theirs: &Relative, reach: f64) -> bool {
    let sim = t_mine_theirs.sim();
    let sigma = sim.scale * t_mine_theirs.translation_variance().sqrt();
    sim.translation.norm() + DRIFT_SIGMAS * sigma <= APART_MAX * reach
}

/// Whether a relative pose is the one expected, within what the two leave open (χ², 99.9 %) and within [`OFF_MAX`].
/// What the anchors' errors have in common is not taken off, so that nothing true is refused for it.
fn is_where_expected(expected: &Relative, found: &Relative, reach: f64) -> bool {
    let off = (expected.sim().translation - found.sim().translation).norm();
    off <= OFF_MAX * reach && two_sided::agree(expected, found)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
    use nalgebra::Vector3;

    #[test]
    fn what_may_lie_elsewhere_by_the_map_is_not_looked_at_again() {
        let at = |x: f64, sigma: f64| {
            let pose = Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0));
            let covariance = Covariance::from_sigmas([sigma, 1e-4, 1e-4, 0.02, 0.02, 0.02]).unwrap();
            Relative::Metric(PoseWithCovariance { pose, covariance })
        };
        for (x, sigma) in [(11.0, 0.5), (0.0, 6.0), (6.0, 3.0)] {
            let is = |more: f64| is_near(&at(x, sigma + more), 40.0);
            assert_eq!((is(-1e-3), is(1e-3)), (true, false), "{x} {sigma}");
        }
    }

    /// A map that is sure of little lets a repetition of the place pass by its covariance, and not by its distance.
    #[test]
    fn what_is_found_lies_where_it_was_expected() {
        let at = |x: f64, sigma: f64| {
            let pose = Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0));
            let covariance = Covariance::from_sigmas([sigma, sigma, sigma, 0.02, 0.02, 0.02]).unwrap();
            Relative::Metric(PoseWithCovariance { pose, covariance })
        };
        let is = |sigma: f64, off: f64| is_where_expected(&at(2.0, sigma), &at(2.0 + off, 0.05), 40.0);
        assert!(is(8.0, 0.0) && is(8.0, 3.99) && !is(8.0, 4.01) && !is(8.0, 10.0));
        assert!(is(0.1, 0.5) && !is(0.1, 0.6), "χ², 99.9 %, of 0.11 m");
    }
}

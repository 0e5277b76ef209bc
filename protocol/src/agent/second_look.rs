//! A second look, with further keypoints, at a pair that was refused although the joint estimate says that it overlaps.
//!
//! A submap's blob names the address of another one that goes on with it. That one is fetched (of our own submaps, read) only
//! then: too few matches held, and by the map the two overlap by most of what they saw. What a second look finds counts only
//! if it agrees with the map that called for it: it makes surer what is known, and joins nothing. (Where nothing connects two
//! frames, more keypoints find hardly a true pair more, and sooner a false one.)

use super::Agent;
use super::knowledge::pair_of;
use super::negotiation::Work;
use super::promise::{Guess, Signs};
use super::shortlist::Candidate;
use super::two_sided;
use crate::geometry::Relative;
use crate::ids::{Hash, SubmapId};
use crate::submap::Keypoints;
use crate::wire::fact::{AlignmentFact, RefusalReason};
use std::collections::BTreeSet;
use std::sync::Arc;

/// Pairs that wait for a second look at most; of more, the least alike go.
pub const SECOND_LOOKS_MAX: usize = 1_024;
/// A pair gets a second look if its anchors are no farther apart than this, in units of what both reach: then the two overlap
/// by most of what either saw.
const APART_MAX: f64 = 0.3;
/// What a second look is worth of a first one that promises as much: it is had when there is nothing better to do.
pub(super) const WORTH: f64 = 0.1;

impl Agent {
    /// A first look at a pair found too little. More keypoints may help, if there are any.
    pub(super) fn note_second_look(&mut self, work: &Work, guess: Guess, reason: RefusalReason) {
        let too_little = match reason {
            RefusalReason::TooFew | RefusalReason::NoConsensus | RefusalReason::PoorFit => true,
            RefusalReason::Ambiguous | RefusalReason::Degenerate | RefusalReason::BadInput => false,
        };
        if too_little && !work.further && self.address_of(work.theirs).is_some() {
            let (mine, theirs, similarity) = (work.mine, work.theirs, guess.signs.similarity);
            let candidate = Candidate { mine, theirs, similarity, wished: false, further: true };
            self.negotiation.add_second_look(candidate);
        }
    }

    /// Whether a pair that was refused is to be found all the same, by a map that holds both.
    pub(super) fn calls_for_second_look(&self, candidate: &Candidate, signs: &Signs) -> bool {
        let is_in_reach = |address: &Hash| !self.negotiation.out_of_reach.contains(address);
        signs.apart.is_some_and(|apart| apart <= APART_MAX)
            && self.address_of(candidate.theirs).as_ref().is_some_and(is_in_reach)
    }

    /// What a second look found is what the map has it to be, within what the two leave open (χ², 99.9 %). What the anchors'
    /// errors have in common is not taken off, so that nothing true is refused for it.
    pub(super) fn agrees_with_map(&self, work: &Work, t_mine_theirs: &Relative) -> bool {
        let anchors = self.anchor(work.mine).zip(self.anchor(work.theirs));
        anchors.is_some_and(|(mine, theirs)| two_sided::agree(&mine.inverse().compose(theirs), t_mine_theirs))
    }

    /// The blobs that an alignment of ours was computed from, of which one tells that further keypoints were looked at.
    pub(super) fn blobs_used(&self, work: &Work) -> Option<[Hash; 2]> {
        let blob = |id| self.knowledge.submap(id).map(|fact| fact.blob);
        let further = self.address_of(work.theirs).filter(|_| work.further);
        let (mine, theirs) = (blob(work.mine)?, further.or(blob(work.theirs))?);
        Some(if pair_of(work.mine, work.theirs).0 == work.mine { [mine, theirs] } else { [theirs, mine] })
    }

    /// Whether another's alignment of our submap was computed from its further keypoints too, so that we look with theirs;
    /// `None` if it names other blobs than those that the owners stated. Where our map does not connect the two, what we say
    /// is what a first look says.
    pub(super) fn is_second_look(&self, fact: &AlignmentFact, mine: SubmapId, theirs: SubmapId) -> Option<bool> {
        let blob = |id| self.knowledge.submap(id).map(|submap| submap.blob);
        let [used_i, used_j] = fact.blobs;
        let (of_mine, of_theirs) = if fact.i == mine { (used_i, used_j) } else { (used_j, used_i) };
        if blob(theirs) != Some(of_theirs) {
            return None;
        }
        let is_further = self.address_of(mine) == Some(of_mine);
        (is_further || blob(mine) == Some(of_mine)).then(|| is_further && self.are_connected(mine, theirs))
    }

    /// Where a submap's keypoints go on, if they do and those that say so are here.
    pub(super) fn address_of(&self, id: SubmapId) -> Option<Hash> {
        let blob = self.knowledge.submap(id)?.blob;
        match self.negotiation.keypoints(blob) {
            Some(keypoints) => keypoints.further(),
            None => self.gossip.blob(blob).and_then(Keypoints::address_in),
        }
    }

    /// The addresses of our own blobs: those that facts name, and those that these name.
    pub(super) fn own_blobs(&self) -> BTreeSet<Hash> {
        self.with_further(self.knowledge.blobs_of(self.me.robot))
    }

    /// These blobs, and those that go on with them as far as they are here to say so.
    pub(super) fn with_further(&self, blobs: impl IntoIterator<Item = Hash>) -> BTreeSet<Hash> {
        let further = |blob| self.gossip.blob(blob).and_then(Keypoints::address_in);
        blobs.into_iter().flat_map(|blob| [Some(blob), further(blob)]).flatten().collect()
    }

    /// The keypoints of a submap, with the further ones if these are wanted and to be had. `None` until they are here.
    pub(super) fn keypoints_of(&mut self, submap: SubmapId, further: bool) -> Option<Arc<Keypoints>> {
        let blob = self.knowledge.submap(submap)?.blob;
        let first = self.keypoints_at(blob, submap)?;
        let address = first.further().filter(|address| further && !self.negotiation.out_of_reach.contains(address));
        let Some(address) = address else { return Some(first) };
        let more = self.keypoints_at(address, submap)?;
        // Whoever names what does not fit is looked at as if he had named nothing.
        Some(first.with_further(&more).map_or(first, Arc::new))
    }
}

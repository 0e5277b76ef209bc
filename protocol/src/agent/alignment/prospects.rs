//! What pairs of submaps promise and whether they can be worked on, by all that is known at one moment. It decides
//! nothing and changes nothing: [`ranking`](super::ranking) and [`second_look`](super::second_look) go on with it.

use super::allowance::Allowance;
use super::fetches::Fetches;
use super::negotiation::Negotiation;
use super::ranking::Proposal;
use crate::agent::context::Context;
use crate::agent::estimation::Estimation;
use crate::agent::replication::blobs::Blobs;
use crate::agent::replication::knowledge::{Knowledge, pair_of};
use crate::ids::{EntryId, Hash, SubmapId};
use crate::submap::Verticals;
use std::collections::BTreeSet;

/// See the module.
#[derive(Clone, Copy)]
pub(super) struct Prospects<'a> {
    pub(super) context: &'a Context,
    pub(super) negotiation: &'a Negotiation,
    pub(super) allowance: &'a Allowance,
    pub(super) fetches: &'a Fetches,
    pub(super) knowledge: &'a Knowledge,
    pub(super) blobs: &'a Blobs,
    pub(super) estimation: &'a Estimation,
}

impl Prospects<'_> {
    /// Nobody in reach has the submap's keypoints.
    pub(super) fn is_out_of_reach(&self, id: SubmapId) -> bool {
        self.knowledge.submap(id).is_some_and(|fact| self.fetches.is_out_of_reach(fact.blob))
    }

    /// Alignments that wait for our answer and can be worked on now.
    pub(super) fn answers_owed(&self) -> Vec<EntryId> {
        let reachable = |id: &&EntryId| {
            let fact = self.knowledge.alignment(**id);
            fact.is_none_or(|fact| {
                !self.is_out_of_reach(fact.i) && !self.is_out_of_reach(fact.j) && self.may_be_judged(fact)
            })
        };
        self.negotiation.verify.iter().filter(reachable).copied().collect()
    }

    /// Which way is up, as both submaps' summaries have it: what everyone who aligns the pair reckons with.
    pub(super) fn verticals(&self, mine: SubmapId, theirs: SubmapId) -> Option<Verticals> {
        let up = |id| self.knowledge.submap(id)?.summary.as_ref()?.up();
        Verticals::of(up(theirs), up(mine))
    }

    /// The keypoints that pairs still need: of active ones those that have not begun, and of answers owed.
    pub(super) fn blobs_needed(&self, active: &[Proposal]) -> BTreeSet<Hash> {
        let waits = |c: &&Proposal| c.further || !self.negotiation.is_tried(pair_of(c.mine, c.theirs));
        let mut wanted: BTreeSet<SubmapId> = active.iter().filter(waits).flat_map(|c| [c.mine, c.theirs]).collect();
        for id in self.answers_owed() {
            wanted.extend(self.knowledge.alignment(id).into_iter().flat_map(|fact| [fact.i, fact.j]));
        }
        let first = |id| self.knowledge.submap(id).map(|fact| fact.blob);
        wanted.into_iter().flat_map(|id| [first(id), self.address_of(id)]).flatten().collect()
    }
}

/// Both submaps are one robot's: nobody else will look at the pair.
pub(super) fn is_loop(mine: SubmapId, theirs: SubmapId) -> bool {
    mine.frame.robot == theirs.frame.robot
}

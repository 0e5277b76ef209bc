//! Which submaps may overlap, by what they look like: pairs are noted as submaps become known.

use super::Alignment;
use super::negotiation::{LOOP_GAP, Negotiation};
use super::shortlist::Candidate;
use crate::agent::context::Context;
use crate::agent::replication::knowledge::{Knowledge, Known, pair_of};
use crate::config::AlignConfig;
use crate::ids::{RobotId, SubmapId};
use crate::submap::Summary;

impl Alignment {
    /// Pairs a submap that became known with all that it may overlap: one of ours with all, one of another's with ours.
    pub(super) fn note_candidates(&mut self, context: &Context, knowledge: &Knowledge, new: SubmapId) {
        let Some(known) = knowledge.submap(new) else { return };
        let looks = Looks { me: context.robot(), knowledge, config: &context.config().align };
        if new.frame.robot != context.robot() {
            looks.pair_up(&mut self.negotiation, &looks.ours(), [(new, known)].into_iter());
        } else if let Some(summary) = &known.summary {
            looks.pair_up(&mut self.negotiation, &[(new, summary)], knowledge.submaps());
        }
    }

    /// Pairs all of our submaps with all that they may overlap.
    pub(super) fn note_all_candidates(&mut self, context: &Context, knowledge: &Knowledge) {
        let looks = Looks { me: context.robot(), knowledge, config: &context.config().align };
        looks.pair_up(&mut self.negotiation, &looks.ours(), knowledge.submaps());
        self.negotiation.mark_dirty();
    }
}

/// What the summaries of submaps say of which may overlap.
struct Looks<'a> {
    me: RobotId,
    knowledge: &'a Knowledge,
    config: &'a AlignConfig,
}

impl Looks<'_> {
    fn ours(&self) -> Vec<(SubmapId, &Summary)> {
        let ours = self.knowledge.submaps_of(self.me);
        ours.filter_map(|(id, known)| Some((id, known.summary.as_ref()?))).collect()
    }

    /// Notes each of `ours` with each of `all` that may overlap it: as a candidate if we are to begin, else as a wish.
    /// Millions of pairs at a start: each of `all` is looked at once, and few are alike enough for more than a glance.
    fn pair_up<'k>(
        &self,
        negotiation: &mut Negotiation,
        ours: &[(SubmapId, &Summary)],
        all: impl Iterator<Item = (SubmapId, &'k Known)>,
    ) {
        let limit = self.config.candidates_max;
        let wanted = |negotiation: &Negotiation| self.config.similarity_min.max(negotiation.least_similarity(limit));
        let mut least = wanted(negotiation);
        for (theirs, known) in all {
            let Some(looks) = &known.summary else { continue };
            if self.knowledge.copied_from(theirs).is_some() {
                continue;
            }
            for &(mine, summary) in ours {
                let Some(similarity) = summary.similarity_from(looks, least) else { continue };
                let pair = pair_of(mine, theirs);
                if !self.may_pair(mine, theirs) || negotiation.is_tried(pair) {
                    continue;
                }
                let candidate = Candidate { mine, theirs, similarity, wished: false, further: false };
                if Negotiation::responsible(pair) == self.me || mine.frame.robot == theirs.frame.robot {
                    negotiation.add_candidate(candidate, limit);
                } else {
                    negotiation.peer_requests.offer(candidate, limit);
                }
                least = wanted(negotiation);
            }
        }
    }

    fn may_pair(&self, mine: SubmapId, theirs: SubmapId) -> bool {
        let far = mine.frame != theirs.frame || mine.index.abs_diff(theirs.index) >= LOOP_GAP;
        far && !self.knowledge.is_stated(pair_of(mine, theirs))
    }
}

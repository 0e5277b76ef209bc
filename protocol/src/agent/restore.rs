//! The start: what the shell kept comes back, part by part.

use super::io::{EpochReason, Record};
use super::{Agent, Restored};
use crate::ids::SubmapId;
use crate::submap::runs::Runs;

impl Agent {
    /// Loads what is sound. A damaged log of our own must not be continued, since others may hold what is missing here:
    /// a new epoch begins. Damage elsewhere is fetched again from neighbours.
    pub(super) fn restore(&mut self, restored: Restored) {
        let mut entries = Vec::new();
        let (mut private, mut blobs) = (Vec::new(), Vec::new());
        let (mut forks, mut refused) = (Vec::new(), Vec::new());
        let (mut closed, mut session) = (None, None);
        for record in restored.records {
            match record {
                Record::Entry { bytes, .. } => entries.push(bytes),
                Record::Blob { bytes, .. } => blobs.push(bytes),
                Record::Private { submap, bytes } => private.push((submap, bytes)),
                Record::Fork { proof, .. } => forks.push(proof),
                Record::EpochClosed { epoch } => closed = closed.max(Some(epoch)),
                Record::Session { epoch, session: now, over } => session = session.max(Some((epoch, now, over))),
                Record::Refused { i, j, evidence: Some(evidence) } => refused.push(((i, j), evidence)),
                // A store gives back what is there.
                Record::Replaced { .. } | Record::Retired { .. } | Record::Refused { evidence: None, .. } => {}
            }
        }
        let closed = closed.max(self.replication.restore(&mut self.context, entries, forks));
        if let Some(closed) = closed.filter(|closed| *closed >= self.context.frame().epoch) {
            self.begin_epoch(closed.saturating_add(1).max(restored.fresh_epoch), EpochReason::Log);
        }
        self.alignment.restore_refusals(refused);
        let stored: Vec<SubmapId> = private.iter().map(|(submap, _)| *submap).collect();
        let gone = self.replication.drop_retired(&mut self.context, &stored).unwrap_or_default();
        private.retain(|(submap, _)| !gone.contains(submap));
        self.relearn();
        // Only now it is known which are ours.
        let blobs = self.replication.own_first(&self.context, blobs);
        blobs.into_iter().for_each(|bytes| self.keep_blob(bytes));
        for (submap, bytes) in private {
            self.alignment.restore_features(&mut self.context, submap, &bytes);
        }
        let runs = self.runs_of(session);
        self.mapping.resume(&self.context, self.replication.knowledge(), runs);
    }

    /// What is known of the front end's runs, by what was last kept of them: the epoch, its run, and those that are
    /// over.
    fn runs_of(&self, kept: Option<(u32, u64, Vec<u64>)>) -> Runs {
        let Some((epoch, session, over)) = kept else { return Runs::default() };
        // An epoch that began since may be of any run that is not over.
        Runs::remembered((epoch == self.context.frame().epoch).then_some(session), over)
    }
}

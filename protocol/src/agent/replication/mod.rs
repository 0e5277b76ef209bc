//! The facts: the signed logs that are held, what they say, how they reach the disk and the other robots, and what
//! travels beside them, as blobs and beacons do. Its timers are those of the gossip.
//!
//! What an entry or an answer calls for elsewhere in the agent is handed back to who called; nothing else is reached
//! from here.

mod answers;
pub(super) mod beacons;
pub(super) mod blobs;
mod condensing;
#[cfg(test)]
mod condensing_tests;
pub(super) mod copies;
mod gossip;
pub(super) mod knowledge;
mod ledger;
mod lives;
mod retiring;
mod traffic;

pub use blobs::BLOBS_MAX;
pub use condensing::GONE_IN_A_ROW_MAX;
pub(super) use gossip::{Body, Lacking, Reply};
pub(super) use ledger::{BATCHES_WAITING_MAX, Heard, Written};
pub use lives::PROOFS_PER_SEC;
pub use traffic::UNSENT_MAX;

use super::context::Context;
use crate::ids::{EntryId, FrameId, Hash, RobotId};
use crate::replica::{AppendError, Replica};
use crate::wire::fact::{Fact, SubmapFact};
use beacons::Beacons;
use blobs::Blobs;
use condensing::Condensing;
use gossip::Gossip;
use knowledge::{Knowledge, Known};
use ledger::Ledger;
use lives::Lives;
use std::collections::BTreeSet;

/// See the module.
pub(super) struct Replication {
    replica: Replica,
    /// What the entries say that are durable.
    knowledge: Knowledge,
    ledger: Ledger,
    gossip: Gossip,
    beacons: Beacons,
    lives: Lives,
    blobs: Blobs,
    condensing: Condensing,
}

impl Replication {
    pub(super) fn new(context: &Context, replica: Replica) -> Self {
        Self {
            replica,
            knowledge: Knowledge::default(),
            ledger: Ledger::default(),
            gossip: Gossip::new(context.robot(), &context.config().gossip, context.now()),
            beacons: Beacons::new(context.now()),
            lives: Lives::new(context),
            blobs: Blobs::default(),
            condensing: Condensing::default(),
        }
    }

    /// Loads what is sound of logs and proofs. The last of our own epochs that must not be continued, if there is one:
    /// of a log of ours that is damaged others may hold what is missing here.
    pub(super) fn restore(
        &mut self,
        context: &mut Context,
        entries: Vec<Vec<u8>>,
        forks: Vec<[Vec<u8>; 2]>,
    ) -> Option<u32> {
        let loaded = self.replica.restore(entries);
        for [a, b] in forks {
            if let Err(error) = self.replica.ingest_fork(&a, &b) {
                context.reject(None, "store: fork", &error.to_string());
            }
        }
        if let Some(epoch) = self.replica.epochs_of(context.robot()).next_back() {
            context.set_epoch(epoch);
        }
        let frame = context.frame();
        let mut closed = self.replica.is_quarantined(frame).then_some(frame.epoch);
        if let Err(damage) = loaded {
            context.reject(None, "store", &damage.to_string());
            closed = closed.max(damage.concerns(frame).then_some(frame.epoch));
        }
        closed
    }

    /// Of blobs that come back from the disk, our own and as many others as there is room for.
    pub(super) fn own_first(&self, context: &Context, blobs: Vec<Vec<u8>>) -> Vec<Vec<u8>> {
        let named = self.knowledge.blobs_of(context.robot());
        blobs::ours_first(&named, blobs)
    }

    /// What the facts say that are durable.
    pub(super) fn knowledge(&self) -> &Knowledge {
        &self.knowledge
    }

    /// Keypoints as they are sent.
    pub(super) fn blobs(&self) -> &Blobs {
        &self.blobs
    }

    /// Where other robots were last heard to be.
    pub(super) fn beacons(&self) -> &Beacons {
        &self.beacons
    }

    /// The lengths of the logs held, `None` for those that have two histories.
    pub(super) fn lengths(&self) -> impl Iterator<Item = (FrameId, Option<u32>)> {
        self.replica.lengths()
    }

    /// Digest of the set of durable entries.
    pub(super) fn digest(&self) -> Hash {
        self.replica.digest()
    }

    /// How many entries are held.
    pub(super) fn held(&self) -> u64 {
        self.replica.held()
    }

    /// A submap's fact, from the entry that holds it now.
    pub(super) fn submap_fact(&self, known: &Known) -> Option<SubmapFact> {
        let held_at = EntryId { seq: known.held_at, ..known.entry };
        match self.replica.entry(held_at)?.fact().ok()? {
            Fact::Submap(fact) => Some(fact),
            Fact::Condensed(condensed) => {
                let carried = condensed.carried.into_iter().find(|one| one.seq == known.entry.seq)?;
                if let Fact::Submap(fact) = carried.fact { Some(fact) } else { None }
            }
            _ => None,
        }
    }

    /// Forgets what a log's writer has replaced by this durable entry. Whether it has.
    pub(super) fn forget_below(&mut self, id: EntryId) -> bool {
        let is_held = self.replica.entry_bytes(id).is_some() && !self.replica.is_quarantined(id.frame);
        let is_floor = is_held && self.replica.is_floor(id);
        if is_floor {
            self.knowledge.forget_below(id.frame, id.seq);
        }
        is_floor
    }

    /// A durable entry takes effect. What it says, if that counts.
    pub(super) fn learn(&mut self, context: &mut Context, id: EntryId) -> Option<Fact> {
        let entry = self.replica.entry(id).filter(|entry| !self.replica.is_quarantined(entry.id().frame))?;
        match entry.fact() {
            Ok(fact) => {
                self.knowledge.absorb(id, fact.clone());
                Some(fact)
            }
            Err(error) => {
                context.reject(Some(id.frame.robot), error.reason(), &format!("{id}: {error}"));
                None
            }
        }
    }

    /// Forgets and learns everything again. Facts that call for something: of submaps ours call for all pairs, verdicts
    /// for nothing but news, and these are old.
    pub(super) fn relearn(&mut self, me: RobotId) -> Vec<(EntryId, Fact)> {
        self.knowledge = Knowledge::default();
        let mut calling = Vec::new();
        for (id, fact) in self.replica.facts() {
            if matches!(fact, Fact::Alignment(_) | Fact::Condensed(_)) {
                calling.push((id, fact.clone()));
            }
            self.knowledge.absorb(id, fact);
        }
        self.knowledge.order_by_stamp(me);
        calling
    }

    /// Keeps a keypoint blob for whoever asks.
    pub(super) fn add_blob(&mut self, context: &Context, hash: Hash, bytes: Vec<u8>) {
        let ours = self.blobs.is_full().then(|| self.own_blobs(context));
        self.blobs.add(hash, bytes, ours);
    }

    /// The addresses of our own blobs: those that facts name, and those that these name.
    fn own_blobs(&self, context: &Context) -> BTreeSet<Hash> {
        self.blobs.with_further(self.knowledge.blobs_of(context.robot()))
    }

    /// Nothing of our own can be written now. What others write is heard, kept if the disk takes it, and served.
    pub(super) fn is_receive_only(&self, context: &Context) -> bool {
        self.store_fails() || self.epoch_limit(context).is_some()
    }

    /// Why others would refuse a fact of our epoch, if they would: none can follow the last epoch of all.
    pub(super) fn epoch_limit(&self, context: &Context) -> Option<AppendError> {
        (context.frame().epoch == u32::MAX).then(|| AppendError::EpochLimit(context.robot()))
    }

    /// Robots that are reachable now.
    pub(super) fn neighbours(&self) -> impl Iterator<Item = RobotId> {
        self.gossip.neighbours()
    }

    /// Whether a robot is reachable now.
    pub(super) fn is_neighbour(&self, robot: RobotId) -> bool {
        self.gossip.is_neighbour(robot)
    }
}

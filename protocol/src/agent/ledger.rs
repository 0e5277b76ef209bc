//! What this robot keeps: facts of its own and of others on their way to the disk, where they take effect, and the
//! epochs that its own are written in. While it cannot write, it is receive-only.

use super::Agent;
use super::io::{EpochReason, Event, Output, Record};
use crate::ids::{EntryId, FrameId, Hash, RobotId};
use crate::replica::{AppendError, IngestError, Ingested};
use crate::wire::EntryBytes;
use crate::wire::fact::Fact;
use std::collections::BTreeMap;

/// Batches on their way to the disk beyond which facts of others and sightings are refused: the disk is too slow for
/// them. What must be kept is bounded by itself: submaps by their queue, answers by their list.
pub const BATCHES_WAITING_MAX: usize = 1_024;

/// Records on their way to the disk.
#[derive(Default)]
pub(super) struct Ledger {
    last_batch: u64,
    pub(super) waiting: BTreeMap<u64, Batch>,
    /// The disk refused, and has not taken anything since.
    pub(super) fails: bool,
    /// Whether people were told that others would refuse facts of our epoch.
    limit_told: bool,
}

/// What takes effect once it is durable.
#[derive(Default)]
pub(super) struct Batch {
    entries: Vec<EntryId>,
    /// Keypoints of our own. A twin with our key may have told others of them: they wait for our disk all the same.
    blobs: Vec<(Hash, Vec<u8>)>,
}

impl Agent {
    /// Writes a fact of our own; it takes effect once it is durable. While the store fails, no work is begun that ends
    /// here; what was under way waits for the disk with the rest. False if the fact cannot be written.
    pub(super) fn write(&mut self, epoch: u32, fact: &Fact) -> bool {
        match self.replica.append(&self.context.me().key, epoch, fact) {
            Ok(entry) => self.context.keep(Record::Entry { id: entry.id(), bytes: entry.encode() }),
            Err(error) => {
                self.context.reject(Some(self.context.robot()), "own fact", &error.to_string());
                if matches!(error, AppendError::NewEpochNeeded(frame, _) if frame == self.context.frame()) {
                    self.begin_epoch(self.context.frame().epoch.saturating_add(1), EpochReason::Log);
                }
                return false;
            }
        }
        true
    }

    /// Takes an entry from a peer; it takes effect once it is durable. Whether it changed anything.
    pub(super) fn ingest(&mut self, from: Option<RobotId>, bytes: &[u8]) -> bool {
        match self.replica.ingest(bytes) {
            Ok(Ingested::New(ids)) => {
                for id in ids {
                    let Some(bytes) = self.replica.entry_bytes(id) else { continue };
                    self.context.keep(Record::Entry { id, bytes: bytes.to_vec() });
                    if self.replica.is_floor(id) {
                        self.context.keep(Record::Replaced { below: id, submaps: vec![], blobs: vec![] });
                    }
                    self.meet_own_past(id.frame);
                }
                return true;
            }
            Ok(Ingested::Early(id)) => self.meet_own_end(id.frame),
            Ok(Ingested::Known) => {}
            Err(error @ IngestError::Fork(frame)) => {
                self.context.reject(Some(frame.robot), error.reason(), &error.to_string());
                self.keep_proof(frame);
                self.relearn();
                return true;
            }
            Err(error) => {
                self.context.reject(from, error.reason(), &error.to_string());
                if let IngestError::TooEarly(id) = error {
                    self.meet_own_end(id.frame);
                }
            }
        }
        false
    }

    /// Takes the proof that a log has two histories. Whether it was news.
    pub(super) fn ingest_fork(&mut self, from: RobotId, [a, b]: &[EntryBytes; 2]) -> bool {
        match self.replica.ingest_fork(&a.0, &b.0) {
            Ok((frame, true)) => {
                self.context.reject(
                    Some(frame.robot),
                    "fork",
                    &format!("log {frame} has two histories; it is quarantined"),
                );
                self.keep_proof(frame);
                self.relearn();
                return true;
            }
            Ok((_, false)) => {}
            Err(error) => self.context.reject(Some(from), error.reason(), &error.to_string()),
        }
        false
    }

    /// A log that is in quarantine stays there over restarts.
    fn keep_proof(&mut self, frame: FrameId) {
        self.gossip.spread.on_news(self.context.now(), 1);
        let proof = self.replica.forks().find(|(forked, _)| *forked == frame);
        let proof = proof.map(|(_, proof)| [proof.a.clone(), proof.b.clone()]);
        if let Some(proof) = proof {
            self.context.keep(Record::Fork { frame, proof });
        }
        self.meet_own_end(frame);
    }

    /// A peer holds entries that we signed but no longer have: our store was lost. What we write must not collide, and
    /// no later run may take this log for one to go on with: what we hold of it may be less than others do.
    fn meet_own_past(&mut self, FrameId { robot, epoch }: FrameId) {
        if robot != self.context.robot() {
            return;
        }
        if epoch >= self.context.frame().epoch {
            self.begin_epoch(epoch.saturating_add(1), EpochReason::Log);
        } else {
            self.context.keep(Record::EpochClosed { epoch });
            self.tell_of_limit();
        }
    }

    /// The same of a past that we cannot hold, because it has two histories or its beginning is yet to come: what we
    /// write before the end of it would be refused.
    fn meet_own_end(&mut self, frame: FrameId) {
        if frame.epoch >= self.context.frame().epoch {
            self.meet_own_past(frame);
        }
    }

    /// A new local frame begins: the trajectory so far is closed, for later runs as well, even if this one ends before
    /// the new epoch has an entry.
    pub(super) fn begin_epoch(&mut self, epoch: u32, reason: EpochReason) {
        self.close_submap();
        self.context.set_epoch(epoch);
        self.context.keep(Record::EpochClosed { epoch: epoch.saturating_sub(1) });
        self.mapper.restart(reason == EpochReason::Session);
        self.context.event(Event::EpochBegan { frame: self.context.frame(), reason });
        self.tell_of_limit();
    }

    /// Epochs become too many because a new one begins, or because old ones of ours come back.
    fn tell_of_limit(&mut self) {
        if let Some(error) = self.epoch_limit()
            && !core::mem::replace(&mut self.ledger.limit_told, true)
        {
            self.context.event(Event::ReceiveOnly { reason: error.to_string() });
        }
    }

    /// No more may wait for the disk than already does.
    pub(super) fn is_overloaded(&self) -> bool {
        self.ledger.waiting.len() >= BATCHES_WAITING_MAX
    }

    /// Nothing of our own can be written now. What others write is heard, kept if the disk takes it, and served.
    pub(super) fn is_receive_only(&self) -> bool {
        self.ledger.fails || self.epoch_limit().is_some()
    }

    /// Something is on its way to the disk, and the disk takes it: an end now would lose what a moment would save.
    pub fn is_saving(&self) -> bool {
        self.unsaved() > 0 && !self.ledger.fails
    }

    /// Why others would refuse a fact of our epoch, if they would.
    pub(super) fn epoch_limit(&self) -> Option<AppendError> {
        self.replica.check_epoch(self.context.frame()).err().map(|_| AppendError::EpochLimit(self.context.robot()))
    }

    pub(super) fn close_batch(&mut self) {
        if self.context.kept() == 0 && !self.refusals.are_many() {
            return;
        }
        self.save_refusals();
        let records = self.context.take_records();
        self.ledger.last_batch += 1;
        let mut batch = Batch::default();
        for record in &records {
            match record {
                Record::Entry { id, .. } => batch.entries.push(*id),
                Record::Blob { hash, bytes } => batch.blobs.push((*hash, bytes.clone())),
                _ => {}
            }
        }
        self.ledger.waiting.insert(self.ledger.last_batch, batch);
        self.context.put(Output::Persist { batch: self.ledger.last_batch, records });
    }

    pub(super) fn on_persisted(&mut self, up_to: u64) {
        let later = self.ledger.waiting.split_off(&up_to.saturating_add(1));
        let durable = core::mem::replace(&mut self.ledger.waiting, later);
        if core::mem::take(&mut self.ledger.fails) {
            self.negotiation.mark_dirty();
            self.context.event(Event::StoreHealed);
        }
        let mut own = Vec::new();
        let (mut entries, mut blobs) = (Vec::new(), Vec::new());
        for batch in durable.into_values() {
            entries.extend(batch.entries);
            blobs.extend(batch.blobs);
        }
        self.gossip.spread.on_news(self.context.now(), entries.len());
        for id in entries {
            self.replica.mark_durable(id);
            self.learn(id);
            if id.frame.robot == self.context.robot() {
                own.push(id);
            }
        }
        // Only now it is known that they are ours.
        for (hash, bytes) in blobs {
            let ours = self.gossip.is_full().then(|| self.own_blobs());
            self.gossip.add_blob(hash, bytes, ours);
        }
        self.publish_entries(&own);
    }

    pub(super) fn on_persist_failed(&mut self, reason: String) {
        if !core::mem::replace(&mut self.ledger.fails, true) {
            self.context.event(Event::ReceiveOnly { reason: format!("the store fails: {reason}") });
        }
    }
}

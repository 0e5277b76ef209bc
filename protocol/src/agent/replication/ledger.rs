//! What this robot keeps: facts of its own and of others on their way to the disk, where they take effect, and the
//! epochs that its own are written in. While it cannot write, it is receive-only.

use super::Replication;
use crate::agent::context::Context;
use crate::agent::io::{Event, Output, Record};
use crate::ids::{EntryId, FrameId, Hash, RobotId};
use crate::replica::{AppendError, IngestError, Ingested};
use crate::wire::EntryBytes;
use crate::wire::fact::Fact;
use std::collections::BTreeMap;

/// Batches on their way to the disk beyond which facts of others and sightings are refused: the disk is too slow for
/// them. What must be kept is bounded by itself: submaps by their queue, answers by their list.
pub(in crate::agent) const BATCHES_WAITING_MAX: usize = 1_024;

/// Records on their way to the disk.
#[derive(Default)]
pub(super) struct Ledger {
    last_batch: u64,
    waiting: BTreeMap<u64, Batch>,
    /// The disk refused, and has not taken anything since.
    fails: bool,
    /// Whether people were told that others would refuse facts of our epoch.
    limit_told: bool,
}

/// What takes effect once it is durable.
#[derive(Default)]
pub(in crate::agent) struct Batch {
    pub(in crate::agent) entries: Vec<EntryId>,
    /// Keypoints of our own. A twin with our key may have told others of them: they wait for our disk all the same.
    blobs: Vec<(Hash, Vec<u8>)>,
}

/// What became of a fact of our own that was to be written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::agent) enum Written {
    /// It takes effect once it is durable.
    Yes,
    /// It cannot be.
    No,
    /// Nothing can be, before a new epoch begins.
    InNewEpochOnly,
}

/// What became of an entry or a proof of another's.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::agent) enum Heard {
    /// These entries are new, and are to be kept one by one.
    New(Vec<EntryId>),
    /// It is of the log's future.
    Early(FrameId),
    /// It proves that the log has two histories.
    Forked(FrameId),
    /// Nothing changed.
    Nothing,
}

/// Blames whoever signed what is refused; `from` is whose name it came in.
fn refuse(context: &mut Context, from: RobotId, error: &IngestError) {
    match error.culprit() {
        Some(culprit) => context.reject(Some(culprit), error.reason(), &error.to_string()),
        None => context.reject_unsigned(from, error.reason(), &error.to_string()),
    }
}

impl Replication {
    /// Writes a fact of our own; it takes effect once it is durable. While the store fails, no work is begun that ends
    /// here; what was under way waits for the disk with the rest.
    pub(in crate::agent) fn write(&mut self, context: &mut Context, epoch: u32, fact: &Fact) -> Written {
        if let Some(retired) = self.to_retire(context, epoch) {
            match self.write_one(context, epoch, &retired) {
                Written::Yes => {}
                hindered => return hindered,
            }
        }
        self.write_one(context, epoch, fact)
    }

    fn write_one(&mut self, context: &mut Context, epoch: u32, fact: &Fact) -> Written {
        match self.replica.append(&context.me().key, epoch, fact) {
            Ok(entry) => {
                context.keep(Record::Entry { id: entry.id(), bytes: entry.encode() });
                Written::Yes
            }
            Err(error) => {
                context.reject(Some(context.robot()), "own fact", &error.to_string());
                match error {
                    AppendError::NewEpochNeeded(frame, _) if frame == context.frame() => Written::InNewEpochOnly,
                    _ => Written::No,
                }
            }
        }
    }

    /// Takes an entry from a peer; it takes effect once it is durable.
    pub(in crate::agent) fn ingest(&mut self, context: &mut Context, from: RobotId, bytes: &[u8]) -> Heard {
        match self.replica.ingest(bytes) {
            Ok(Ingested::New(ids)) => Heard::New(ids),
            Ok(Ingested::Early(id)) => Heard::Early(id.frame),
            Ok(Ingested::Known) => Heard::Nothing,
            Err(error @ IngestError::Fork(frame)) => {
                context.reject(Some(frame.robot), error.reason(), &error.to_string());
                self.keep_proof(context, frame);
                Heard::Forked(frame)
            }
            Err(error) => {
                refuse(context, from, &error);
                if let IngestError::TooEarly(id) = error { Heard::Early(id.frame) } else { Heard::Nothing }
            }
        }
    }

    /// Has a new entry of a peer made durable. Whether it is here.
    pub(in crate::agent) fn keep(&self, context: &mut Context, id: EntryId) -> bool {
        let Some(bytes) = self.replica.entry_bytes(id) else { return false };
        context.keep(Record::Entry { id, bytes: bytes.to_vec() });
        if self.replica.is_floor(id) {
            context.keep(Record::Replaced { below: id, submaps: vec![], blobs: vec![] });
        }
        true
    }

    /// Takes the proof that a log has two histories.
    pub(in crate::agent) fn ingest_fork(
        &mut self,
        context: &mut Context,
        from: RobotId,
        [a, b]: &[EntryBytes; 2],
    ) -> Heard {
        match self.replica.ingest_fork(&a.0, &b.0) {
            Ok((frame, true)) => {
                let detail = format!("log {frame} has two histories; it is quarantined");
                context.reject(Some(frame.robot), "fork", &detail);
                self.keep_proof(context, frame);
                return Heard::Forked(frame);
            }
            Ok((_, false)) => {}
            Err(error) => refuse(context, from, &error),
        }
        Heard::Nothing
    }

    /// A log that is in quarantine stays there over restarts.
    fn keep_proof(&mut self, context: &mut Context, frame: FrameId) {
        self.gossip.on_news(context.now(), 1);
        let proof = self.replica.forks().find(|(forked, _)| *forked == frame);
        if let Some(proof) = proof.map(|(_, proof)| [proof.a.clone(), proof.b.clone()]) {
            context.keep(Record::Fork { frame, proof });
        }
    }

    /// Epochs become too many because a new one begins, or because old ones of ours come back: people are told, once.
    pub(in crate::agent) fn tell_of_limit(&mut self, context: &mut Context) {
        if let Some(error) = self.epoch_limit(context)
            && !core::mem::replace(&mut self.ledger.limit_told, true)
        {
            context.event(Event::ReceiveOnly { reason: error.to_string() });
        }
    }

    /// No more may wait for the disk than already does.
    pub(in crate::agent) fn is_overloaded(&self) -> bool {
        self.waiting() >= BATCHES_WAITING_MAX
    }

    /// Batches on their way to the disk.
    pub(in crate::agent) fn waiting(&self) -> usize {
        self.ledger.waiting.len()
    }

    /// The disk refuses what must be kept: nothing that waits for it will be durable soon.
    pub(in crate::agent) fn store_fails(&self) -> bool {
        self.ledger.fails
    }

    /// Hands the records of this call to the disk.
    pub(in crate::agent) fn close_batch(&mut self, context: &mut Context) {
        let records = context.take_records();
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
        context.put(Output::Persist { batch: self.ledger.last_batch, records });
    }

    /// Batches are durable: what takes effect now, entry by entry, before it is [published](Self::publish_durable).
    pub(in crate::agent) fn on_persisted(&mut self, context: &mut Context, up_to: u64) -> Batch {
        let later = self.ledger.waiting.split_off(&up_to.saturating_add(1));
        let durable = core::mem::replace(&mut self.ledger.waiting, later);
        if core::mem::take(&mut self.ledger.fails) {
            context.event(Event::StoreHealed);
        }
        let mut all = Batch::default();
        for batch in durable.into_values() {
            all.entries.extend(batch.entries);
            all.blobs.extend(batch.blobs);
        }
        self.gossip.on_news(context.now(), all.entries.len());
        all
    }

    /// An entry is durable.
    pub(in crate::agent) fn mark_durable(&mut self, id: EntryId) {
        self.replica.mark_durable(id);
    }

    /// Serves and publishes what is ours of what has become durable and was learned.
    pub(in crate::agent) fn publish_durable(&mut self, context: &mut Context, durable: Batch) {
        // Only now it is known that the blobs are ours.
        for (hash, bytes) in durable.blobs {
            self.add_blob(context, hash, bytes);
        }
        let own: Vec<EntryId> = durable.entries.into_iter().filter(|id| id.frame.robot == context.robot()).collect();
        self.publish_entries(context, &own);
    }

    /// The store cannot write.
    pub(in crate::agent) fn on_persist_failed(&mut self, context: &mut Context, reason: &str) {
        if !core::mem::replace(&mut self.ledger.fails, true) {
            context.event(Event::ReceiveOnly { reason: format!("the store fails: {reason}") });
        }
    }
}

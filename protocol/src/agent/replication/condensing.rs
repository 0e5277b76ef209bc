//! A long log is replaced by what still counts of it (DESIGN §3, §7): every fact but submaps that nothing ties to
//! anything, whose steps of odometry are compounded. Compounding is exact, as nothing else was known of the poses in
//! between, and what is written is never surer than what it replaces. Signatures, hashes and headers go as well.
//!
//! Submaps go only where their neighbours stay: what a peer recognises there, it finds a few submaps on.

use super::Replication;
use super::knowledge::Knowledge;
use crate::agent::context::Context;
use crate::agent::io::{Event, Record};
use crate::ids::{EntryId, FrameId, Hash, SubmapId};
use crate::wire::Entry;
use crate::wire::fact::{CarriedFact, CondensedFact, Fact, SubmapFact};
use crate::wire::limits::{CARRIED_MAX, PAYLOAD_LEN_MAX};
use std::collections::{BTreeMap, BTreeSet};

/// Submaps in a row that may go.
pub const GONE_IN_A_ROW_MAX: u32 = 3;
/// The last submaps stay: they are being aligned, and the robot's pose is told from the last.
const LATEST_KEPT: usize = 8;
/// Bytes that carrying a fact takes beyond its payload, at most.
const CARRYING_LEN: usize = 16;
/// What is carried may be this share of what it replaces at most, else the log is left as it is until it has doubled.
const WORTHWHILE: f64 = 0.75;

/// When to look at the log again.
#[derive(Default)]
pub(super) struct Condensing {
    /// Not before so many entries are held; 0 for as many as the configuration says.
    again_at: u32,
}

/// A log, shortened.
pub(super) struct Shorter {
    pub(super) parts: Vec<CondensedFact>,
    /// Submaps that go, and their keypoint blobs.
    pub(super) gone: Vec<(SubmapId, Hash)>,
}

impl Replication {
    /// Shortens our log, if it is long and all of it is durable. The submaps that are gone.
    pub(in crate::agent) fn condense(&mut self, context: &mut Context) -> BTreeSet<SubmapId> {
        self.condensed(context).unwrap_or_default()
    }

    fn condensed(&mut self, context: &mut Context) -> Option<BTreeSet<SubmapId>> {
        let frame = context.frame();
        let wanted = context.config().gossip.condense_entries;
        let held = self.replica.settled(frame)?;
        let count = held.end - held.start;
        let is_crowded = self.replica.bytes_of(frame.robot) > self.replica.member_bytes_max() / 4 * 3;
        let due = self.condensing.again_at.max(if is_crowded { 0 } else { wanted });
        if wanted == 0 || self.is_receive_only(context) || count < due {
            return None;
        }
        self.condensing.again_at = count.saturating_mul(2);
        let entries: Vec<Entry> = held.filter_map(|seq| self.replica.entry(EntryId { frame, seq })).collect();
        let before: usize = entries.iter().map(|entry| entry.encode().len()).sum();
        let shorter = shorten(frame, &entries, &self.knowledge)?;
        let overhead = entries.first().map_or(0, |entry| entry.encode().len() - entry.payload().len());
        let payloads = shorter.parts.iter().filter_map(|part| Fact::Condensed(part.clone()).to_payload().ok());
        let after: usize = payloads.map(|payload| payload.len() + overhead).sum();
        if after as f64 > WORTHWHILE * before as f64 {
            return None;
        }
        match self.replica.append_floor(&context.me().key, frame.epoch, &shorter.parts) {
            Ok(mut new) => {
                // What was given up stays so, also for those who hear of the log from here on only.
                let retired = self.retired(frame.robot);
                let said = retired.map(|fact| self.replica.append(&context.me().key, frame.epoch, &fact));
                new.extend(said.and_then(Result::ok));
                self.replace(context, &new, &shorter.gone, [before, after])
            }
            Err(error) => {
                context.reject(Some(context.robot()), "own fact: condensed", &error.to_string());
                None
            }
        }
    }

    fn replace(
        &mut self,
        context: &mut Context,
        new: &[Entry],
        gone: &[(SubmapId, Hash)],
        bytes: [usize; 2],
    ) -> Option<BTreeSet<SubmapId>> {
        self.condensing.again_at = u32::try_from(2 * new.len()).unwrap_or(u32::MAX);
        let below = new.first().map(Entry::id)?;
        for entry in new {
            context.keep(Record::Entry { id: entry.id(), bytes: entry.encode() });
        }
        let submaps: BTreeSet<SubmapId> = gone.iter().map(|(submap, _)| *submap).collect();
        // Two submaps can share a blob: equal bytes have one address.
        let all = self.knowledge.submaps().filter(|(id, _)| !submaps.contains(id));
        let kept = self.blobs.with_further(all.map(|(_, known)| known.blob));
        let of_gone = self.blobs.with_further(gone.iter().map(|(_, blob)| *blob));
        let blobs = of_gone.difference(&kept).copied().collect();
        context.keep(Record::Replaced { below, submaps: submaps.iter().copied().collect(), blobs });
        context.count().condensed(bytes);
        context.event(Event::Condensed { frame: below.frame, parts: new.len(), submaps_gone: gone.len(), bytes });
        Some(submaps)
    }
}

/// A submap in the chain of its frame.
struct Step {
    seq: u32,
    after: Option<u32>,
    submap: SubmapFact,
}

/// `None` if the log holds what this version cannot read, or its submaps do not form one chain.
pub(super) fn shorten(frame: FrameId, entries: &[Entry], knowledge: &Knowledge) -> Option<Shorter> {
    let facts = facts(entries)?;
    let mut chain: BTreeMap<u32, Step> = BTreeMap::new();
    let mut carried = Vec::new();
    for CarriedFact { seq, after, fact } in facts {
        match fact {
            Fact::Submap(submap) => {
                // Of two that claim one index, the one written first counts.
                chain.entry(submap.index).or_insert(Step { seq, after, submap });
            }
            // Said again, in an entry of its own.
            Fact::Retired(_) => {}
            // To whom it was an answer, it is one no more.
            Fact::Verdict(verdict) if knowledge.alignment(verdict.alignment).is_none() => {}
            fact => carried.push(CarriedFact { seq, after: None, fact }),
        }
    }
    let stay = staying(frame, &chain, knowledge);
    let mut gone = Vec::new();
    let (mut before, mut last_kept, mut on_the_way) = (None, None, None);
    for (index, Step { seq, after, mut submap }) in chain {
        if after != before {
            return None;
        }
        before = Some(index);
        let step = submap.odometry;
        let step = on_the_way.take().map_or(step, |way: crate::geometry::PoseWithCovariance| way.compose(&step));
        if stay.contains(&index) {
            submap.odometry = step;
            carried.push(CarriedFact { seq, after: last_kept, fact: Fact::Submap(submap) });
            last_kept = Some(index);
        } else {
            on_the_way = Some(step);
            gone.push((SubmapId { frame, index }, submap.blob));
        }
    }
    carried.sort_by_key(|one| one.seq);
    Some(Shorter { parts: parts(carried)?, gone })
}

/// What the log says, condensed facts unpacked. `None` if an entry is no fact that this version knows.
fn facts(entries: &[Entry]) -> Option<Vec<CarriedFact>> {
    let mut facts = Vec::new();
    for entry in entries {
        match entry.fact().ok()? {
            Fact::Condensed(condensed) => facts.extend(condensed.carried),
            fact => {
                let after = if let Fact::Submap(submap) = &fact { submap.index.checked_sub(1) } else { None };
                facts.push(CarriedFact { seq: entry.id().seq, after, fact });
            }
        }
    }
    Some(facts)
}

/// The submaps that stay: the first, the latest, all that anything is tied to, and enough of the others.
fn staying(frame: FrameId, chain: &BTreeMap<u32, Step>, knowledge: &Knowledge) -> BTreeSet<u32> {
    let tied = knowledge.tied_submaps();
    let latest = chain.len().saturating_sub(LATEST_KEPT);
    let mut in_a_row = 0;
    let mut kept = BTreeSet::new();
    for (place, (&index, step)) in chain.iter().enumerate() {
        let tied = tied.contains(&SubmapId { frame, index });
        // A step that was compounded before stands for submaps that are gone already.
        let gone_before = step.after.map_or(0, |after| index - after - 1);
        let full = in_a_row + gone_before >= GONE_IN_A_ROW_MAX;
        if place == 0 || place >= latest || tied || full {
            in_a_row = 0;
            kept.insert(index);
        } else {
            in_a_row += gone_before + 1;
        }
    }
    kept
}

/// As few condensed facts as hold them all.
fn parts(carried: Vec<CarriedFact>) -> Option<Vec<CondensedFact>> {
    let mut parts: Vec<CondensedFact> = Vec::new();
    let mut room = 0;
    for one in carried {
        let len = one.fact.to_payload().ok()?.len() + CARRYING_LEN;
        match parts.last_mut().filter(|part| len <= room && part.carried.len() < CARRIED_MAX) {
            Some(part) => part.carried.push(one),
            None => {
                room = PAYLOAD_LEN_MAX - CARRYING_LEN;
                parts.push(CondensedFact { carried: vec![one] });
            }
        }
        room = room.saturating_sub(len);
    }
    Some(parts)
}

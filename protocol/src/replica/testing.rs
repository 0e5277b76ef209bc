//! A small swarm for tests.

use super::*;
use crate::config::GossipConfig;
use crate::ids::{EntryId, FrameId, Hash, RobotId};
use crate::wire::fact::{CarriedFact, CondensedFact, ScaleKind};
use crate::wire::samples::{self, key};
use crate::wire::{Entry, EntryContent, Fact, HaveVector, SwarmTag};

/// Members of the test swarm: keys 0 to 7.
pub const MEMBERS: u8 = 8;

pub fn replica() -> Replica {
    replica_with(&GossipConfig::default())
}

pub fn replica_with(limits: &GossipConfig) -> Replica {
    let name = |n: u8| crate::ids::Name::new(format!("r{n}")).unwrap();
    let roster = (0..MEMBERS).map(|n| (name(n), key(n).verifying_key().to_bytes()));
    Replica::new(&samples::swarm(), roster, limits).unwrap()
}

/// A fact that differs with `k`.
pub fn fact(k: u32) -> Fact {
    let Fact::Submap(mut fact) = samples::submap_fact(ScaleKind::Metric) else { unreachable!() };
    fact.index = k;
    fact.summary = vec![k as u8; (k * 37 % 300) as usize];
    Fact::Submap(fact)
}

/// `len` chained entries by robot `n`; another `story` has other content from its first entry on.
pub fn chain(n: u8, epoch: u32, len: u32, story: u32) -> Vec<Vec<u8>> {
    let mut previous = Hash::default();
    let entry = |seq| {
        let entry = signed(n, epoch, seq, 0, previous, &fact(seq + 1000 * story));
        previous = entry.hash();
        entry.encode()
    };
    (0..len).map(entry).collect()
}

pub fn signed(n: u8, epoch: u32, seq: u32, floor: u32, previous: Hash, fact: &Fact) -> Entry {
    let id = EntryId { frame: samples::frame(n, epoch), seq };
    let (kind, payload) = (fact.kind(), fact.to_payload().unwrap());
    let swarm = SwarmTag::of(&samples::swarm());
    Entry::sign(&key(n), EntryContent { swarm, id, kind, floor, previous, payload }).unwrap()
}

/// [`chain`] of `len` entries, then one that replaces them in two parts, then `more`.
pub fn condensed_chain(n: u8, epoch: u32, len: u32, more: u32) -> Vec<Vec<u8>> {
    let mut writer = replica();
    for seq in 0..len {
        writer.append(&key(n), epoch, &fact(seq)).unwrap();
    }
    let mut all: Vec<Vec<u8>> = (0..len).map(|seq| bytes_of(&writer, n, epoch, seq)).collect();
    let part = |seqs: [u32; 2]| CondensedFact {
        carried: seqs.map(|seq| CarriedFact { seq, after: None, fact: fact(seq) }).to_vec(),
    };
    let parts = writer.append_floor(&key(n), epoch, &[part([0, 1]), part([2, 3])]).unwrap();
    all.extend(parts.iter().map(Entry::encode));
    all.extend((0..more).map(|k| writer.append(&key(n), epoch, &fact(len + k)).unwrap().encode()));
    all
}

fn bytes_of(replica: &Replica, n: u8, epoch: u32, seq: u32) -> Vec<u8> {
    replica.entry_bytes(EntryId { frame: frame(n, epoch), seq }).unwrap().to_vec()
}

/// Makes all that is held durable.
pub fn settle(replica: &mut Replica) {
    let ids: Vec<EntryId> =
        replica.logs().flat_map(|(frame, log)| (0..log.next_seq()).map(move |seq| EntryId { frame, seq })).collect();
    ids.into_iter().for_each(|id| replica.mark_durable(id));
}

/// Ingests and settles; refusals are ignored.
pub fn feed<'a>(replica: &mut Replica, entries: impl IntoIterator<Item = &'a Vec<u8>>) {
    for bytes in entries {
        let _ = replica.ingest(bytes);
    }
    settle(replica);
}

/// What two replicas must have in common to be called equal.
pub fn view(replica: &Replica) -> (Hash, [u8; 8], HaveVector, u64) {
    (replica.digest(), replica.root(), replica.have(asker(), TAGGED), replica.count())
}

/// One exchange: `to` asks `from`. Returns the bytes of entries and proofs that came.
pub fn pull(to: &mut Replica, from: &Replica, budget: usize) -> usize {
    let delta = from.delta_for(&have_of(from, to), budget);
    let mut bytes = 0;
    for [a, b] in &delta.forks {
        bytes += a.0.len() + b.0.len();
        to.ingest_fork(&a.0, &b.0).unwrap();
    }
    for entry in &delta.entries {
        bytes += entry.0.len();
        let _ = to.ingest(&entry.0);
    }
    assert!(bytes <= budget, "{bytes} of {budget}");
    settle(to);
    bytes
}

pub fn frame(n: u8, epoch: u32) -> FrameId {
    samples::frame(n, epoch)
}

/// A vector with hashes.
pub const TAGGED: VectorForm = VectorForm { tagged: true, listed: false, after: None };

/// Some member.
pub fn asker() -> RobotId {
    frame(0, 0).robot
}

/// What `of` holds, as `reader` understands it.
pub fn have_of(reader: &Replica, of: &Replica) -> Have {
    reader.read_have(&of.have(asker(), TAGGED)).unwrap()
}

//! One place in a log, one content (DESIGN §8.5): never two entries for one (origin, epoch, seq) anywhere in the swarm,
//! and never two contents under one blob address.

use super::{Check, Seen};
use merganser_protocol::agent::io::{Output, Record};
use merganser_protocol::ids::{EntryId, Hash};
use std::collections::BTreeMap;

/// See the module.
#[derive(Debug, Default)]
pub struct UniqueEntries {
    entries: BTreeMap<EntryId, Hash>,
}

impl Check for UniqueEntries {
    fn name(&self) -> &'static str {
        "unique entries"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        let Seen::Output(Output::Persist { records, .. }) = seen else { return Ok(()) };
        for record in records {
            match record {
                Record::Entry { id, bytes } => {
                    let hash = Hash::of(bytes);
                    if *self.entries.entry(*id).or_insert(hash) != hash {
                        return Err(format!("robot {robot}: a second content for entry {id}"));
                    }
                }
                Record::Blob { hash, bytes } if Hash::of(bytes) != *hash => {
                    return Err(format!("robot {robot}: blob {hash} holds something else"));
                }
                _ => {}
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::ids::{FrameId, RobotId};

    fn entry(seq: u32, byte: u8) -> Output {
        let id = EntryId { frame: FrameId { robot: RobotId([1; 8]), epoch: 1 }, seq };
        Output::Persist { batch: 1, records: vec![Record::Entry { id, bytes: vec![byte] }] }
    }

    #[test]
    fn it_bites_on_a_reused_sequence_number() {
        let mut check = UniqueEntries::default();
        assert!(check.see(0, &Seen::Output(&entry(0, 1))).is_ok());
        assert!(check.see(1, &Seen::Output(&entry(0, 1))).is_ok());
        assert!(check.see(0, &Seen::Output(&entry(1, 2))).is_ok());
        assert!(check.see(0, &Seen::Output(&entry(0, 2))).is_err());
    }

    #[test]
    fn it_bites_on_a_wrong_blob() {
        let record = Record::Blob { hash: Hash::of(b"a"), bytes: b"b".to_vec() };
        let output = Output::Persist { batch: 1, records: vec![record] };
        assert!(UniqueEntries::default().see(0, &Seen::Output(&output)).is_err());
    }
}

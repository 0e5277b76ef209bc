//! One place in a log, one content (DESIGN §8.5): never two entries for one (origin, epoch, seq) on the swarm's disks,
//! and never two contents under one blob address. An entry that died with its writer before it was durable does not
//! count: if it got out all the same, another robot's disk shows it.

use super::pending::Pending;
use super::{Check, Seen};
use merganser_protocol::agent::io::{Output, Record};
use merganser_protocol::ids::{EntryId, Hash, RobotId};
use std::collections::{BTreeMap, BTreeSet};

/// See the module.
#[derive(Debug, Default)]
pub struct UniqueEntries {
    entries: BTreeMap<EntryId, Hash>,
    waiting: BTreeMap<usize, Pending<(EntryId, Hash)>>,
    /// Robots whose keys or disks tell two stories through no fault of the core's. What becomes of these is the
    /// business of convergence: a log with two histories is quarantined on all robots alike.
    doubted: BTreeSet<RobotId>,
}

impl Check for UniqueEntries {
    fn name(&self) -> &'static str {
        "unique entries"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        let waiting = self.waiting.entry(robot).or_default();
        match seen {
            Seen::Output(Output::Persist { batch, records }) => {
                for record in records {
                    match record {
                        Record::Entry { id, bytes } => waiting.hand_over(*batch, [(*id, Hash::of(bytes))]),
                        Record::Blob { hash, bytes } if Hash::of(bytes) != *hash => {
                            return Err(format!("robot {robot}: blob {hash} holds something else"));
                        }
                        _ => {}
                    }
                }
            }
            Seen::Durable(batch) => {
                for (id, hash) in waiting.durable(*batch) {
                    let doubted = self.doubted.contains(&id.frame.robot);
                    if *self.entries.entry(id).or_insert(hash) != hash && !doubted {
                        return Err(format!("robot {robot}: a second content for entry {id}"));
                    }
                }
            }
            Seen::Died => waiting.lose(),
            Seen::MayFork(origin) => {
                self.doubted.insert(*origin);
            }
            _ => {}
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

    fn store(check: &mut UniqueEntries, robot: usize, output: &Output) -> Result<(), String> {
        check.see(robot, &Seen::Output(output))?;
        check.see(robot, &Seen::Durable(1))
    }

    #[test]
    fn it_bites_on_a_reused_sequence_number() {
        let mut check = UniqueEntries::default();
        assert!(store(&mut check, 0, &entry(0, 1)).is_ok());
        assert!(store(&mut check, 1, &entry(0, 1)).is_ok());
        assert!(store(&mut check, 0, &entry(1, 2)).is_ok());
        assert!(store(&mut check, 0, &entry(0, 2)).is_err());
    }

    #[test]
    fn what_died_unseen_may_be_written_anew() {
        let mut check = UniqueEntries::default();
        assert!(check.see(0, &Seen::Output(&entry(0, 1))).is_ok());
        assert!(check.see(0, &Seen::Died).is_ok());
        assert!(store(&mut check, 0, &entry(0, 2)).is_ok());
        assert!(store(&mut check, 1, &entry(0, 1)).is_err(), "unless somebody else holds it");
    }

    #[test]
    fn whose_disk_was_put_back_is_excused_and_nobody_else() {
        let mut check = UniqueEntries::default();
        assert!(store(&mut check, 0, &entry(0, 1)).is_ok());
        assert!(check.see(0, &Seen::MayFork(RobotId([2; 8]))).is_ok());
        assert!(store(&mut check, 1, &entry(0, 2)).is_err());
        assert!(check.see(0, &Seen::MayFork(RobotId([1; 8]))).is_ok());
        assert!(store(&mut check, 1, &entry(0, 2)).is_ok());
    }

    #[test]
    fn it_bites_on_a_wrong_blob() {
        let record = Record::Blob { hash: Hash::of(b"a"), bytes: b"b".to_vec() };
        let output = Output::Persist { batch: 1, records: vec![record] };
        assert!(UniqueEntries::default().see(0, &Seen::Output(&output)).is_err());
    }
}

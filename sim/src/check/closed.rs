//! A closed epoch stays closed (DESIGN §8.4): once a robot has written an entry of an epoch, it never writes one of an
//! earlier epoch of its own again, in no later run. What it merely gets back from others is no writing: somebody's disk
//! held it before.

use super::{Check, Seen};
use merganser_protocol::agent::io::{Output, Record};
use merganser_protocol::ids::{EntryId, Hash, RobotId};
use std::collections::{BTreeMap, BTreeSet};

/// See the module.
#[derive(Debug, Default)]
pub struct Closed {
    /// The latest epoch that anybody handed an entry of to a disk, by origin.
    latest: BTreeMap<RobotId, u32>,
    /// Every entry that was handed to a disk.
    known: BTreeSet<(EntryId, Hash)>,
    doubted: BTreeSet<RobotId>,
}

impl Check for Closed {
    fn name(&self) -> &'static str {
        "closed epochs stay closed"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        match seen {
            // A disk that lost what its writer knew cannot know which epochs were closed.
            Seen::MayFork(origin) => {
                self.doubted.insert(*origin);
            }
            Seen::Output(Output::Persist { records, .. }) => {
                for record in records {
                    let Record::Entry { id, bytes } = record else { continue };
                    if !self.known.insert((*id, Hash::of(bytes))) {
                        continue;
                    }
                    let origin = id.frame.robot;
                    let latest = self.latest.entry(origin).or_insert(id.frame.epoch);
                    if id.frame.epoch < *latest && !self.doubted.contains(&origin) {
                        return Err(format!("robot {robot}: new entry {id}, after epoch {latest} was begun"));
                    }
                    *latest = id.frame.epoch.max(*latest);
                }
            }
            _ => {}
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::ids::FrameId;

    fn persist(check: &mut Closed, epoch: u32, seq: u32) -> Result<(), String> {
        let id = EntryId { frame: FrameId { robot: RobotId([1; 8]), epoch }, seq };
        let records = vec![Record::Entry { id, bytes: vec![epoch as u8, seq as u8] }];
        check.see(0, &Seen::Output(&Output::Persist { batch: 1, records }))
    }

    #[test]
    fn it_bites_on_a_new_entry_of_an_earlier_epoch() {
        let mut check = Closed::default();
        assert!(persist(&mut check, 3, 0).is_ok() && persist(&mut check, 5, 0).is_ok());
        assert!(persist(&mut check, 3, 0).is_ok(), "an old one comes back");
        assert!(persist(&mut check, 3, 1).is_err());
    }

    #[test]
    fn whose_disk_forgot_is_excused() {
        let mut check = Closed::default();
        assert!(persist(&mut check, 5, 0).is_ok());
        assert!(check.see(0, &Seen::MayFork(RobotId([1; 8]))).is_ok());
        assert!(persist(&mut check, 3, 0).is_ok());
    }
}

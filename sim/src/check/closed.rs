//! A closed epoch stays closed (DESIGN §8.4). Once a robot has written an entry of an epoch, it never writes one of an
//! earlier epoch of its own again, in no later run. What it merely gets back from others is no writing: somebody's disk
//! held it before. But what came back closes its epoch as well: others may hold more of it than came, so a robot that
//! writes on there may tell a second story, and neither this run nor one that finds on disk what came back may do so.

use super::pending::Pending;
use super::{Check, Seen};
use merganser_protocol::agent::io::{Output, Record};
use merganser_protocol::ids::{EntryId, Hash, RobotId};
use std::collections::{BTreeMap, BTreeSet};

/// See the module.
#[derive(Debug, Default)]
pub struct Closed {
    /// The latest epoch that anybody handed an entry of to a disk, by origin.
    latest: BTreeMap<RobotId, u32>,
    /// Every entry that was handed to a disk, and whether to one of another than its writer: only such a one can come
    /// back, and it does in a message. A process that died before its entry was on disk, or whose disk was replaced by
    /// an old image of it, may well write the very same again.
    known: BTreeMap<(EntryId, Hash), bool>,
    doubted: BTreeSet<RobotId>,
    forgers: BTreeSet<RobotId>,
    returned: BTreeMap<usize, Returned>,
}

/// What came back to one robot.
#[derive(Debug, Default)]
struct Returned {
    robot: Option<RobotId>,
    /// The message that it handles.
    heard: Vec<u8>,
    /// The latest epoch that it knows in this run...
    epoch: Option<u32>,
    /// ...and in every run.
    on_disk: Option<u32>,
    waiting: Pending<u32>,
}

impl Closed {
    fn persist(&mut self, robot: usize, batch: u64, id: EntryId, bytes: &[u8]) -> Result<(), String> {
        let (origin, epoch) = (id.frame.robot, id.frame.epoch);
        let returned = self.returned.entry(robot).or_default();
        let is_own = returned.robot == Some(origin);
        let key = (id, Hash::of(bytes));
        let is_new = !self.known.contains_key(&key);
        let with_others = self.known.entry(key).or_default();
        *with_others |= !is_own;
        if !is_new {
            if is_own && *with_others && contains(&returned.heard, bytes) {
                returned.epoch = returned.epoch.max(Some(epoch));
                returned.waiting.hand_over(batch, [epoch]);
            }
            return Ok(());
        }
        if is_own && returned.epoch >= Some(epoch) && !self.forgers.contains(&origin) {
            return Err(format!("robot {robot}: new entry {id} of an epoch that came back from others"));
        }
        let latest = self.latest.entry(origin).or_insert(epoch);
        if epoch < *latest && !self.doubted.contains(&origin) {
            return Err(format!("robot {robot}: new entry {id}, after epoch {latest} was begun"));
        }
        *latest = epoch.max(*latest);
        Ok(())
    }
}

impl Check for Closed {
    fn name(&self) -> &'static str {
        "closed epochs stay closed"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        match seen {
            Seen::Heard(bytes) => {
                let heard = &mut self.returned.entry(robot).or_default().heard;
                heard.clear();
                heard.extend_from_slice(bytes);
            }
            Seen::Started(id) => self.returned.entry(robot).or_default().robot = Some(*id),
            // A disk that lost what its writer knew cannot know which epochs were closed.
            Seen::MayFork(origin) => {
                self.doubted.insert(*origin);
            }
            Seen::Forges(origin) => {
                self.forgers.insert(*origin);
            }
            Seen::Output(Output::Persist { batch, records }) => {
                for record in records {
                    let Record::Entry { id, bytes } = record else { continue };
                    self.persist(robot, *batch, *id, bytes)?;
                }
            }
            Seen::Durable(batch) => {
                let returned = self.returned.entry(robot).or_default();
                returned.on_disk = returned.waiting.durable(*batch).into_iter().max().max(returned.on_disk);
            }
            Seen::Died => {
                let returned = self.returned.entry(robot).or_default();
                returned.waiting.lose();
                returned.epoch = returned.on_disk;
            }
            Seen::Wiped | Seen::Damaged => {
                let returned = self.returned.entry(robot).or_default();
                *returned = Returned { robot: returned.robot, ..Returned::default() };
            }
            _ => {}
        }
        Ok(())
    }
}

fn contains(message: &[u8], entry: &[u8]) -> bool {
    !entry.is_empty() && message.windows(entry.len()).any(|part| part == entry)
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::ids::FrameId;

    const ME: RobotId = RobotId([1; 8]);

    fn persist(check: &mut Closed, epoch: u32, seq: u32) -> Result<(), String> {
        persist_at(0, check, epoch, seq)
    }

    fn persist_at(robot: usize, check: &mut Closed, epoch: u32, seq: u32) -> Result<(), String> {
        let id = EntryId { frame: FrameId { robot: ME, epoch }, seq };
        let records = vec![Record::Entry { id, bytes: vec![epoch as u8, seq as u8] }];
        check.see(robot, &Seen::Output(&Output::Persist { batch: 1, records }))
    }

    /// An own entry comes back, in the midst of a message.
    fn comes_back(check: &mut Closed, epoch: u32, seq: u32) -> Result<(), String> {
        check.see(0, &Seen::Heard(&[0, epoch as u8, seq as u8, 0]))?;
        persist(check, epoch, seq)?;
        check.see(0, &Seen::Heard(&[]))
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
        assert!(check.see(0, &Seen::MayFork(ME)).is_ok());
        assert!(persist(&mut check, 3, 0).is_ok());
    }

    #[test]
    fn it_bites_on_a_new_entry_of_an_epoch_that_came_back_even_from_a_disk_that_forgot() {
        for (excused, forges) in [(Seen::MayFork(ME), false), (Seen::Forges(ME), true)] {
            let mut check = Closed::default();
            check.see(0, &Seen::Started(ME)).unwrap();
            assert!(persist(&mut check, 5, 0).is_ok() && persist(&mut check, 5, 1).is_ok());
            assert!(persist_at(1, &mut check, 5, 0).is_ok(), "a peer has it");
            check.see(0, &excused).unwrap();
            check.see(0, &Seen::Wiped).unwrap();
            assert!(comes_back(&mut check, 5, 0).is_ok());
            assert_eq!(persist(&mut check, 5, 2).is_ok(), forges);
            assert!(persist(&mut check, 6, 0).is_ok());
        }
    }

    #[test]
    fn what_came_back_binds_later_runs_once_it_is_on_disk() {
        for durable in [false, true] {
            let mut check = Closed::default();
            check.see(0, &Seen::Started(ME)).unwrap();
            assert!(persist(&mut check, 5, 0).is_ok() && persist_at(1, &mut check, 5, 0).is_ok());
            check.see(0, &Seen::Wiped).unwrap();
            assert!(comes_back(&mut check, 5, 0).is_ok());
            if durable {
                check.see(0, &Seen::Durable(1)).unwrap();
            }
            check.see(0, &Seen::Died).unwrap();
            check.see(0, &Seen::Started(ME)).unwrap();
            assert_eq!(persist(&mut check, 5, 1).is_err(), durable);
        }
    }

    /// A cut within a commit takes an entry with it that nobody else can have; then it is written once more.
    #[test]
    fn what_nobody_else_has_does_not_come_back() {
        let mut check = Closed::default();
        check.see(0, &Seen::Started(ME)).unwrap();
        assert!(persist(&mut check, 5, 0).is_ok() && persist_at(1, &mut check, 5, 0).is_ok());
        assert!(persist(&mut check, 5, 1).is_ok());
        check.see(0, &Seen::Died).unwrap();
        check.see(0, &Seen::Started(ME)).unwrap();
        assert!(persist(&mut check, 5, 1).is_ok() && persist(&mut check, 5, 2).is_ok());
    }

    /// The same alignment is refused once more in the same words, of a peer's disk the first time.
    #[test]
    fn what_is_written_once_more_after_an_old_image_does_not_come_back() {
        let mut check = Closed::default();
        check.see(0, &Seen::Started(ME)).unwrap();
        assert!(persist(&mut check, 5, 0).is_ok() && persist_at(1, &mut check, 5, 0).is_ok());
        check.see(0, &Seen::MayFork(ME)).unwrap();
        check.see(0, &Seen::Damaged).unwrap();
        assert!(check.see(0, &Seen::Heard(&[9, 9, 9])).is_ok() && persist(&mut check, 5, 0).is_ok());
        assert!(persist(&mut check, 5, 1).is_ok());
    }

    #[test]
    fn what_comes_back_to_others_closes_nothing() {
        let mut check = Closed::default();
        check.see(0, &Seen::Started(RobotId([2; 8]))).unwrap();
        assert!(persist(&mut check, 5, 0).is_ok() && persist(&mut check, 5, 0).is_ok());
        assert!(persist(&mut check, 5, 1).is_ok());
    }
}

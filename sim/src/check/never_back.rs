//! What a robot holds never shrinks (DESIGN §8.3, §8.4, and no acknowledged fact is lost): a log that was durable on a
//! robot's disk up to some place is so at every later moment and after every restart, a log in quarantine stays there,
//! and the robot's own epoch does not fall, nor does it return to one that its disk knows as closed. A disk that was
//! wiped, or that lost what it had confirmed, is excused, and so are logs that their writer gave up by an entry that is
//! durable, and those that are older than as many epochs of their writer as are held.

use super::pending::Pending;
use super::{Check, RobotSample, Sample, Seen};
use merganser_protocol::agent::io::{Output, Record};
use merganser_protocol::ids::{EntryId, FrameId, RobotId};
use merganser_protocol::wire::{Entry, Fact};
use std::collections::{BTreeMap, BTreeSet};

/// See the module.
#[derive(Debug)]
pub struct NeverBack {
    epochs_per_robot_max: usize,
    robots: BTreeMap<usize, Held>,
}

#[derive(Debug, Default)]
struct Held {
    logs: BTreeMap<FrameId, Log>,
    epoch: u32,
    /// The first epoch that the disk does not know as closed.
    open: u32,
    /// With the first epoch that the writer keeps, if the entry says so.
    entries: Pending<(EntryId, Option<u32>)>,
    closing: Pending<u32>,
    /// The last batch handed to the disk, and the last that is on it.
    batches: [u64; 2],
    /// Logs seen in quarantine, by the batch that was then the last: once it is on disk, so must be the proof.
    quarantined: BTreeMap<FrameId, u64>,
}

#[derive(Debug, Default)]
struct Log {
    /// Its quarantine is on disk, and seen.
    forked: bool,
    /// Entries `0..len` were durable.
    len: u32,
    /// Durable ones beyond a hole.
    beyond: BTreeSet<u32>,
}

impl Log {
    fn add(&mut self, seq: u32) {
        self.beyond.insert(seq);
        while self.beyond.remove(&self.len) {
            self.len += 1;
        }
        self.beyond.retain(|seq| *seq > self.len);
    }
}

impl NeverBack {
    /// For robots that hold so many epochs of each.
    pub fn new(epochs_per_robot_max: usize) -> Self {
        Self { epochs_per_robot_max, robots: BTreeMap::new() }
    }
}

impl Held {
    fn forget(&mut self) {
        self.logs.clear();
        self.quarantined.clear();
        self.closing.lose();
        (self.epoch, self.open) = (0, 0);
    }

    /// The writer keeps no epoch below this one, nor does anybody else have to.
    fn retire(&mut self, robot: RobotId, first: u32) {
        let stays = |frame: &FrameId| frame.robot != robot || frame.epoch >= first;
        self.logs.retain(|frame, _| stays(frame));
        self.quarantined.retain(|frame, _| stays(frame));
    }

    /// Where as many epochs of a writer are held as may be, older ones need not be.
    fn crowd_out(&mut self, held: &BTreeMap<FrameId, Option<u32>>, max: usize) {
        let mut counts = BTreeMap::<RobotId, usize>::new();
        for frame in held.keys().rev() {
            let count = counts.entry(frame.robot).or_default();
            *count += 1;
            if *count == max {
                self.retire(frame.robot, frame.epoch);
            }
        }
    }

    fn compare(&mut self, robot: &RobotSample, epochs_max: usize) -> Result<(), String> {
        let name = &robot.name;
        self.crowd_out(&robot.logs, epochs_max);
        for (frame, log) in &mut self.logs {
            match robot.logs.get(frame) {
                Some(None) => log.len = 0,
                Some(Some(_)) | None if log.forked => {
                    return Err(format!("{name}: the quarantine of log {frame} was lifted"));
                }
                Some(Some(len)) if *len >= log.len => log.len = *len,
                _ if log.len == 0 => {}
                now => {
                    let now = now.copied().flatten().unwrap_or(0);
                    return Err(format!("{name}: log {frame} had {} durable entries and has {now}", log.len));
                }
            }
        }
        for (frame, len) in &robot.logs {
            let log = self.logs.entry(*frame).or_default();
            log.len = len.unwrap_or(0);
            if len.is_none() {
                let [last, durable] = self.batches;
                log.forked |= *self.quarantined.entry(*frame).or_insert(last) <= durable;
            }
        }
        let Some(snapshot) = &robot.snapshot else { return Ok(()) };
        let epoch = snapshot.status.epoch;
        if epoch < self.epoch {
            return Err(format!("{name}: its epoch fell from {} to {epoch}", self.epoch));
        }
        self.epoch = epoch;
        Ok(())
    }
}

impl Check for NeverBack {
    fn name(&self) -> &'static str {
        "never back"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        let held = self.robots.entry(robot).or_default();
        match seen {
            Seen::Output(Output::Persist { batch, records }) => {
                held.batches[0] = *batch;
                for record in records {
                    match record {
                        Record::Entry { id, bytes } => held.entries.hand_over(*batch, [(*id, kept_from(bytes))]),
                        Record::EpochClosed { epoch } => held.closing.hand_over(*batch, [*epoch]),
                        _ => {}
                    }
                }
            }
            Seen::Durable(batch) => {
                held.batches[1] = *batch;
                for (id, first) in held.entries.durable(*batch) {
                    held.logs.entry(id.frame).or_default().add(id.seq);
                    if let Some(first) = first {
                        held.retire(id.frame.robot, first.min(id.frame.epoch));
                    }
                }
                for epoch in held.closing.durable(*batch) {
                    held.open = held.open.max(epoch.saturating_add(1));
                }
            }
            // An epoch that was begun may die with its process, unless the disk knows that the one before was closed.
            Seen::Died => {
                (held.epoch, held.batches) = (held.open, [0, 0]);
                held.entries.lose();
                held.closing.lose();
                held.quarantined.clear();
            }
            Seen::Wiped | Seen::Damaged => held.forget(),
            _ => {}
        }
        Ok(())
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        let epochs_max = self.epochs_per_robot_max;
        sample
            .robots
            .iter()
            .try_for_each(|robot| self.robots.entry(robot.index).or_default().compare(robot, epochs_max))
    }
}

/// The first epoch that an entry's writer keeps, if it says so.
fn kept_from(entry: &[u8]) -> Option<u32> {
    match Entry::decode(entry).ok()?.fact().ok()? {
        Fact::Retired(fact) => Some(fact.below.get()),
        _ => None,
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use merganser_protocol::ids::{Hash, Name};
    use merganser_protocol::wire::fact::RetiredFact;
    use merganser_protocol::wire::{EntryContent, SwarmTag};

    const FRAME: FrameId = FrameId { robot: RobotId([1; 8]), epoch: 4 };

    fn look(check: &mut NeverBack, len: Option<u32>) -> Result<(), String> {
        let mut one = robot("alpha", 1, &[]);
        one.logs.insert(FRAME, len);
        check.sample(&sample(vec![one], &BTreeMap::new(), &Expect::default()))
    }

    fn store(check: &mut NeverBack, seqs: core::ops::Range<u32>) {
        let record = |seq| Record::Entry { id: EntryId { frame: FRAME, seq }, bytes: vec![] };
        let output = Output::Persist { batch: 1, records: seqs.map(record).collect() };
        check.see(0, &Seen::Output(&output)).unwrap();
        check.see(0, &Seen::Durable(1)).unwrap();
    }

    #[test]
    fn it_bites_on_a_log_that_shrinks_even_across_a_restart() {
        let mut check = NeverBack::new(2);
        store(&mut check, 0..3);
        assert!(look(&mut check, Some(3)).is_ok());
        check.see(0, &Seen::Died).unwrap();
        assert!(look(&mut check, Some(4)).is_ok());
        assert!(look(&mut check, Some(3)).is_err());
        let mut check = NeverBack::new(2);
        store(&mut check, 0..3);
        assert!(look(&mut check, Some(2)).is_err(), "what the disk confirmed counts, seen or not");
    }

    /// Of the log of this epoch, an entry that gives up those below `below`.
    fn retires(check: &mut NeverBack, epoch: u32, below: u32) {
        let key = ed25519_dalek::SigningKey::from_bytes(&[1; 32]);
        let id = EntryId { frame: FrameId { epoch, ..FRAME }, seq: 0 };
        let fact = Fact::Retired(RetiredFact { below: below.try_into().unwrap() });
        let content = EntryContent {
            swarm: SwarmTag::of(&Name::new("test").unwrap()),
            id,
            kind: fact.kind(),
            floor: 0,
            previous: Hash::default(),
            payload: fact.to_payload().unwrap(),
        };
        let record = Record::Entry { id, bytes: Entry::sign(&key, content).unwrap().encode() };
        check.see(0, &Seen::Output(&Output::Persist { batch: 2, records: vec![record] })).unwrap();
    }

    #[test]
    fn a_log_may_go_once_its_writer_has_durably_given_it_up_and_no_sooner() {
        for (epoch, below, durable, may) in
            [(9, 9, true, true), (9, 5, true, true), (9, 4, true, false), (9, 9, false, false), (4, 9, true, false)]
        {
            let mut check = NeverBack::new(2);
            store(&mut check, 0..3);
            retires(&mut check, epoch, below);
            if durable {
                check.see(0, &Seen::Durable(2)).unwrap();
            }
            let mut one = robot("alpha", 1, &[]);
            if epoch > FRAME.epoch && durable {
                one.logs.insert(FrameId { epoch, ..FRAME }, Some(1));
            }
            let gone = check.sample(&sample(vec![one], &BTreeMap::new(), &Expect::default()));
            assert_eq!(gone.is_ok(), may, "{epoch} {below} {durable}");
        }
    }

    #[test]
    fn the_oldest_log_may_go_once_as_many_newer_ones_are_held_and_no_sooner() {
        for (newer, may) in [(vec![5, 9], true), (vec![9], false), (vec![2, 9], false)] {
            let mut check = NeverBack::new(2);
            store(&mut check, 0..3);
            let mut one = robot("alpha", 1, &[]);
            one.logs.extend(newer.iter().map(|epoch| (FrameId { epoch: *epoch, ..FRAME }, Some(1))));
            let gone = check.sample(&sample(vec![one], &BTreeMap::new(), &Expect::default()));
            assert_eq!(gone.is_ok(), may, "{newer:?}");
        }
    }

    #[test]
    fn it_bites_on_a_quarantine_that_is_lifted() {
        for durable in [false, true] {
            let mut check = NeverBack::new(2);
            assert!(look(&mut check, Some(3)).is_ok());
            check.see(0, &Seen::Output(&Output::Persist { batch: 1, records: vec![] })).unwrap();
            assert!(look(&mut check, None).is_ok());
            if durable {
                check.see(0, &Seen::Durable(1)).unwrap();
                assert!(look(&mut check, None).is_ok());
            }
            check.see(0, &Seen::Died).unwrap();
            assert_eq!(look(&mut check, Some(3)).is_err(), durable, "until it is on disk, a proof may die");
        }
        let mut check = NeverBack::new(2);
        assert!(look(&mut check, None).is_ok(), "read from the disk");
        assert!(look(&mut check, Some(3)).is_err());
    }

    #[test]
    fn it_bites_on_an_epoch_that_falls() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let mut check = NeverBack::new(2);
        let mut at = |epoch| {
            let mut one = robot("alpha", 1, &[]);
            one.snapshot.as_mut().unwrap().status.epoch = epoch;
            check.sample(&sample(vec![one], &truth, &expect))
        };
        assert!(at(5).is_ok() && at(6).is_ok() && at(5).is_err());
    }

    #[test]
    fn it_bites_on_a_closed_epoch_that_is_taken_up_again_after_a_restart() {
        for durable in [false, true] {
            let (truth, expect) = (BTreeMap::new(), Expect::default());
            let mut check = NeverBack::new(2);
            let output = Output::Persist { batch: 1, records: vec![Record::EpochClosed { epoch: 5 }] };
            check.see(0, &Seen::Output(&output)).unwrap();
            if durable {
                check.see(0, &Seen::Durable(1)).unwrap();
            }
            check.see(0, &Seen::Died).unwrap();
            let mut at = |epoch| {
                let mut one = robot("alpha", 1, &[]);
                one.snapshot.as_mut().unwrap().status.epoch = epoch;
                check.sample(&sample(vec![one], &truth, &expect))
            };
            assert_eq!(at(5).is_err(), durable);
            assert!(at(6).is_ok());
        }
    }

    #[test]
    fn a_lost_disk_is_excused_and_entries_beyond_a_hole_are_no_promise() {
        for seen in [Seen::Wiped, Seen::Damaged] {
            let mut check = NeverBack::new(2);
            assert!(look(&mut check, Some(3)).is_ok());
            check.see(0, &seen).unwrap();
            assert!(look(&mut check, Some(1)).is_ok());
        }
        let mut check = NeverBack::new(2);
        store(&mut check, 5..7);
        assert!(look(&mut check, Some(0)).is_ok());
    }
}

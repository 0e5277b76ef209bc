//! Memory and disk are bounded by roster × window, whatever arrives (DESIGN §8.7): no log of a stranger is held, no
//! more epochs of a robot than configured, no more batches wait for the disk than named, no table grows with what
//! shouts, and the store's file stays within a bound.

use super::{Check, RobotSample, Sample, Seen};
use merganser_protocol::ids::RobotId;
use std::collections::{BTreeMap, BTreeSet};

/// Work that may wait for the disk or to be described, by the core's own limits.
const UNSAVED_MAX: u64 = 1_024 + 64 + 16;
/// Reasons and kinds in the core's statistics: named in its code, so few.
const STATS_ROWS_MAX: usize = 128;
/// A store's file, bytes: runs of minutes fill a fraction of it.
const DISK_BYTES_MAX: u64 = 64 << 20;

/// See the module.
#[derive(Debug)]
pub struct Bounded {
    epochs_per_robot_max: usize,
    /// Members that ever ran.
    members: BTreeSet<RobotId>,
}

impl Check for Bounded {
    fn name(&self) -> &'static str {
        "bounded"
    }

    fn see(&mut self, _: usize, seen: &Seen<'_>) -> Result<(), String> {
        if let Seen::Started(robot) = seen {
            self.members.insert(*robot);
        }
        Ok(())
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        sample.robots.iter().try_for_each(|robot| self.check(robot).map_err(|why| format!("{}: {why}", robot.name)))
    }
}

impl Bounded {
    /// For robots that hold so many epochs of each.
    pub fn new(epochs_per_robot_max: usize) -> Self {
        Self { epochs_per_robot_max, members: BTreeSet::new() }
    }

    fn check(&self, robot: &RobotSample) -> Result<(), String> {
        let mut epochs: BTreeMap<RobotId, usize> = BTreeMap::new();
        robot.logs.keys().for_each(|frame| *epochs.entry(frame.robot).or_default() += 1);
        if let Some((origin, count)) = epochs.iter().find(|(_, count)| **count > self.epochs_per_robot_max) {
            return Err(format!("{count} epochs of {origin}"));
        }
        if robot.disk_bytes > DISK_BYTES_MAX {
            return Err(format!("its store has {} bytes", robot.disk_bytes));
        }
        let Some(snapshot) = &robot.snapshot else { return Ok(()) };
        if let Some(stranger) = epochs.keys().find(|origin| !self.members.contains(origin)) {
            return Err(format!("it holds a log of {stranger}, whom no roster has"));
        }
        let unsaved = snapshot.status.unsaved;
        if unsaved > UNSAVED_MAX {
            return Err(format!("{unsaved} batches and submaps wait for the disk"));
        }
        let rows = snapshot.stats.rejected.len();
        if rows > STATS_ROWS_MAX {
            return Err(format!("{rows} kinds of refusals are told apart"));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use merganser_protocol::ids::FrameId;

    fn verdict(spoil: impl Fn(&mut RobotSample)) -> Result<(), String> {
        let id = RobotId([1; 8]);
        let mut one = robot("alpha", 1, &[]);
        one.logs.insert(FrameId { robot: id, epoch: 0 }, Some(3));
        spoil(&mut one);
        let mut check = Bounded::new(3);
        check.see(0, &Seen::Started(id))?;
        check.sample(&sample(vec![one], &BTreeMap::new(), &Expect::default()))
    }

    #[test]
    fn it_bites_just_beyond_each_bound() {
        assert!(verdict(|_| {}).is_ok());
        let epochs = |count| {
            move |one: &mut RobotSample| {
                one.logs.extend((0..count).map(|epoch| (FrameId { robot: RobotId([1; 8]), epoch }, Some(1))));
            }
        };
        assert!(verdict(epochs(3)).is_ok() && verdict(epochs(4)).is_err());
        let disk = |bytes| move |one: &mut RobotSample| one.disk_bytes = bytes;
        assert!(verdict(disk(DISK_BYTES_MAX)).is_ok() && verdict(disk(DISK_BYTES_MAX + 1)).is_err());
        let unsaved = |count| move |one: &mut RobotSample| one.snapshot.as_mut().unwrap().status.unsaved = count;
        assert!(verdict(unsaved(UNSAVED_MAX)).is_ok() && verdict(unsaved(UNSAVED_MAX + 1)).is_err());
        let rows = |count: usize| {
            move |one: &mut RobotSample| {
                let rejected = &mut one.snapshot.as_mut().unwrap().stats.rejected;
                rejected.extend((0..count).map(|k| (format!("reason {k}"), 1)));
            }
        };
        assert!(verdict(rows(STATS_ROWS_MAX)).is_ok() && verdict(rows(STATS_ROWS_MAX + 1)).is_err());
        let stranger = |one: &mut RobotSample| {
            one.logs.insert(FrameId { robot: RobotId([2; 8]), epoch: 0 }, Some(1));
        };
        assert!(verdict(stranger).is_err());
    }
}

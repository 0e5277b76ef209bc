//! Whether files that are read as one graph name the same poses by accident: two robots that both number theirs from 0
//! are not one robot, and their graph would be nonsense that converges.
//!
//! Sure is only what two files state differently: a pose's value, or a measurement between two poses of one robot, which
//! only that robot makes. The rest (robots that number in different strides) can only be suspected of
//! poses that no letter gives to a robot ([`Owners::shared`]).

use super::g2o::NUMBER_MAX;
use super::robust::robot_of;
use std::collections::{BTreeMap, BTreeSet};

/// Which file named what first.
#[derive(Clone, Debug, Default)]
pub(super) struct Owners {
    /// This file, counted from 0.
    file: usize,
    /// The first file that names a pose.
    poses: BTreeMap<u64, usize>,
    /// Poses of which an earlier file says something and a later one something new.
    shared: BTreeSet<u64>,
    /// File and line of what is stated first, by its ends; a pose's value has its pose for both.
    stated: BTreeMap<[u64; 2], (usize, usize)>,
}

/// Poses of one robot of which several files say something.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Shared {
    /// The smallest.
    pub first: u64,
    /// The largest.
    pub last: u64,
    /// How many.
    pub count: usize,
}

impl Owners {
    /// The next lines are of the next file.
    pub(super) fn begin(&mut self) {
        self.file += 1;
    }

    /// Notes that this file has something to say of these poses.
    pub(super) fn name(&mut self, ids: &[u64]) {
        for &id in ids {
            if *self.poses.entry(id).or_insert(self.file) < self.file {
                self.shared.insert(id);
            }
        }
    }

    /// The line of an earlier file that states the value of this pose; else it is noted that this one does.
    pub(super) fn value(&mut self, id: u64, line: usize) -> Option<usize> {
        self.state([id, id], line)
    }

    /// The line of an earlier file that measures the same two poses, if they are of one robot.
    pub(super) fn measurement(&mut self, [i, j]: [u64; 2], line: usize) -> Option<usize> {
        let is_own = robot_of(i) == robot_of(j);
        if is_own { self.state([i.min(j), i.max(j)], line) } else { None }
    }

    fn state(&mut self, ends: [u64; 2], line: usize) -> Option<usize> {
        let (file, first) = *self.stated.entry(ends).or_insert((self.file, line));
        (file < self.file).then_some(first)
    }

    /// Of a robot, the poses of which several files say something.
    pub(super) fn shared(&self, robot: u8) -> Option<Shared> {
        let first = u64::from(robot) << 56;
        let mut ids = self.shared.range(first..=first | NUMBER_MAX);
        let first = *ids.clone().next()?;
        let last = *ids.next_back()?;
        Some(Shared { first, last, count: self.shared.range(first..=last).count() })
    }
}

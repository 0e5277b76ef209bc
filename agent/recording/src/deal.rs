//! One robot's way becomes that of several, as if each had driven a stretch of it. The stretches overlap, and two
//! robots never hold the same scan: of a way with many scans to a metre each robot is given every third (of three
//! robots), of any other all of its stretch, alternately where another robot drives, too.

use core::ops::Range;
use merganser_protocol::geometry::Se3;

/// Share of the way by which a robot's stretch reaches into each neighbour's.
const REACH: f64 = 0.1;
/// Every third scan is enough for a robot where they lie so far apart at most, in the mean, m.
const APART_MAX_M: f64 = 0.5;

/// How scans are dealt out to the robots.
pub(super) struct Deal {
    /// To so many.
    robots: usize,
    /// Of scans, in all.
    count: usize,
    /// Every robot has only its turn's scans of its stretch, not all that no other robot's stretch holds.
    in_turn: bool,
}

/// As close together as the scans lie: the way by odometry tells.
pub(super) fn deal<'a>(poses: impl Iterator<Item = &'a Se3>, robots: usize) -> Deal {
    let (mut way, mut count, mut last) = (0.0, 0, None);
    for pose in poses {
        way += last.replace(pose).map_or(0.0, |last: &Se3| (pose.translation - last.translation).norm());
        count += 1;
    }
    Deal { robots, count, in_turn: way * robots as f64 <= APART_MAX_M * count as f64 }
}

impl Deal {
    /// The scans of a robot's stretch, with those that others are given.
    fn stretch(&self, robot: usize) -> Range<usize> {
        let share = |k: f64| ((k.clamp(0.0, 1.0) * self.count as f64) as usize).min(self.count);
        let all = self.robots as f64;
        share(robot as f64 / all - REACH)..share((robot + 1) as f64 / all + REACH)
    }

    /// The scans that a robot is given.
    pub fn of(&self, robot: usize) -> impl Iterator<Item = usize> {
        self.stretch(robot).filter(move |&k| {
            let drive_here = |other: &usize| self.in_turn || self.stretch(*other).contains(&k);
            let robots: Vec<usize> = (0..self.robots).filter(drive_here).collect();
            robots[k % robots.len()] == robot
        })
    }

    /// In words.
    pub fn how(&self, robot: usize) -> String {
        let Range { start, end } = self.stretch(robot);
        let which = if self.in_turn {
            format!("one of {} scans", self.robots)
        } else {
            "the scans, alternately where another robot drives,".into()
        };
        format!("{which} from {start} to {end} (counted from 0)")
    }
}

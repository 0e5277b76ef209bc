//! When other robots were where, and how they move, by their pose beacons.
//!
//! A beacon states the stamp of its keyframe on its sender's own clock. The beacon of a robot that took the least time
//! from its keyframe to us tells how the two clocks differ, up to that least time; how late the others were follows.

use crate::agent::motion::Twist;
use crate::ids::RobotId;
use crate::time::Instant;
use crate::wire::BeaconContent;
use core::time::Duration;
use std::collections::BTreeMap;

/// What even the fastest beacon takes from the sensor through SLAM, agent and radio, s, and its standard deviation.
const LATE_SECS: f64 = 0.1;
/// Standard deviation of when a keyframe was, s.
pub(in crate::agent) const LATE_SIGMA_SECS: f64 = 0.15;
/// What looks later than this, s, tells that the other's clock was set.
const LATE_SECS_MAX: f64 = 5.0;
/// Clocks run away from one another by so much of the time at most.
const CLOCK_DRIFT: f64 = 1e-4;

/// The latest beacon of a robot.
#[derive(Clone, Copy, Debug)]
pub(in crate::agent) struct SeenBeacon {
    pub(in crate::agent) content: BeaconContent,
    pub(in crate::agent) at: Instant,
    /// When the keyframe was that it tells of: the robot may have moved since, and had no other.
    pub(in crate::agent) since: Instant,
    /// How the body moves, as far as this one and those before it tell.
    pub(in crate::agent) twist: Option<Twist>,
    /// The least by which our clock was ahead of the stamp when a keyframe was first heard of, ns.
    ahead: i64,
}

/// The latest beacon of every robot that was heard.
#[derive(Default)]
pub(in crate::agent) struct Beacons(BTreeMap<RobotId, SeenBeacon>);

impl Beacons {
    /// Takes a beacon of another robot, if it is newer than the one at hand.
    pub(super) fn hear(&mut self, content: BeaconContent, now: Instant) {
        let robot = content.anchor.frame.robot;
        let before = self.0.get(&robot);
        // The counter begins anew with the process, the stamps of one epoch do not.
        let age = |content: &BeaconContent| (content.anchor.frame.epoch, content.stamp, content.counter);
        if before.is_none_or(|seen| age(&content) > age(&seen.content)) {
            let seen = SeenBeacon::after(before, content, now);
            self.0.insert(robot, seen);
        }
    }

    /// The latest of one robot.
    pub(in crate::agent) fn of(&self, robot: RobotId) -> Option<&SeenBeacon> {
        self.0.get(&robot)
    }

    /// The latest of each, by robot.
    pub(in crate::agent) fn iter(&self) -> impl Iterator<Item = (RobotId, &SeenBeacon)> {
        self.0.iter().map(|(robot, seen)| (*robot, seen))
    }
}

impl SeenBeacon {
    /// `content`, heard at `at`, after what was heard before.
    fn after(before: Option<&Self>, content: BeaconContent, at: Instant) -> Self {
        let ahead = at.as_nanos().cast_signed().saturating_sub(content.stamp.0);
        let new = Self { content, at, since: earlier(at, LATE_SECS), twist: None, ahead };
        let Some(old) = before.filter(|old| old.content.anchor.frame == content.anchor.frame) else { return new };
        if old.content.stamp == content.stamp {
            return Self { content, at, ..*old };
        }
        // A body is told relative to its anchor, and what lies between two anchors is not asked here.
        let secs = content.stamp.secs_since(old.content.stamp);
        let told = Twist::between(&old.content.t_anchor_body.pose, &content.t_anchor_body.pose, secs);
        let twist = told.filter(|_| old.content.anchor == content.anchor).or(old.twist);
        let drifted = (CLOCK_DRIFT * at.since(old.at).as_nanos() as f64) as i64;
        let least = old.ahead.saturating_add(drifted).min(ahead);
        let late = 1e-9 * ahead.saturating_sub(least) as f64;
        if late > LATE_SECS_MAX {
            return Self { twist, ..new };
        }
        Self { since: earlier(at, LATE_SECS + late), twist, ahead: least, ..new }
    }
}

fn earlier(at: Instant, secs: f64) -> Instant {
    let nanos = Duration::from_secs_f64(secs).as_nanos();
    Instant::from_nanos(at.as_nanos().saturating_sub(u64::try_from(nanos).unwrap_or(u64::MAX)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Covariance, PoseWithCovariance, Se3};
    use crate::ids::{FrameId, RobotId, SubmapId};
    use crate::time::Stamp;

    fn content(stamp: f64, counter: u64) -> BeaconContent {
        let anchor = SubmapId { frame: FrameId { robot: RobotId([7; 8]), epoch: 1 }, index: 3 };
        let pose = Se3::new(crate::geometry::So3::identity(), [0.5 * stamp, 0.0, 0.0].into());
        let covariance = Covariance::from_sigmas([0.1; 6]).unwrap();
        let t_anchor_body = PoseWithCovariance { pose, covariance };
        BeaconContent { anchor, stamp: Stamp((stamp * 1e9) as i64), counter, t_anchor_body }
    }

    fn heard(all: &[(f64, f64)]) -> Vec<f64> {
        let mut last: Option<SeenBeacon> = None;
        let mut since = Vec::new();
        for (counter, (stamp, at)) in (0..).zip(all) {
            let at = Instant::from_nanos((at * 1e9) as u64);
            let seen = SeenBeacon::after(last.as_ref(), content(*stamp, counter), at);
            since.push(seen.since.as_secs_f64());
            last = Some(seen);
        }
        since
    }

    /// Their clock is 900 s ahead of ours.
    #[test]
    fn what_was_long_under_way_is_known_to_be_old() {
        let since = heard(&[(1000.0, 100.2), (1001.0, 101.05), (1002.0, 103.05), (1002.0, 103.5), (1004.0, 104.05)]);
        let want = [100.1, 100.95, 101.95, 101.95, 103.95];
        assert!(since.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-3), "{since:?}");
    }

    #[test]
    fn a_clock_that_was_set_is_believed_and_one_that_drifts_is_followed() {
        // Set back by a minute: later than anything can be. Set ahead: the fastest ever.
        let since = heard(&[(1000.0, 100.0), (941.0, 101.0), (942.0, 102.0), (2000.0, 103.0), (2001.0, 104.0)]);
        let want = [99.9, 100.9, 101.9, 102.9, 103.9];
        assert!(since.iter().zip(want).all(|(got, want)| (got - want).abs() < 1e-3), "{since:?}");
        // Slow by 50 ppm, for three hours.
        let slow: Vec<(f64, f64)> = (0..10_000).map(|k| (f64::from(k), f64::from(k) * 1.000_05)).collect();
        let off = heard(&slow).iter().zip(&slow).map(|(got, (_, at))| at - LATE_SECS - got).fold(0.0, f64::max);
        assert!(off < 1e-3, "{off}");
    }

    #[test]
    fn no_stamp_breaks_the_arithmetic() {
        let mut last = None;
        for (stamp, at) in [(i64::MIN, u64::MAX), (i64::MAX, 0), (i64::MIN, 1), (0, u64::MAX), (i64::MAX, u64::MAX)] {
            let content = BeaconContent { stamp: Stamp(stamp), ..content(0.0, 0) };
            let seen = SeenBeacon::after(last.as_ref(), content, Instant::from_nanos(at));
            assert!(seen.since <= seen.at);
            last = Some(seen);
        }
    }
}

//! When other robots were where, and how they move, by their pose beacons.
//!
//! A beacon states the stamp of its keyframe on its sender's own clock. The beacon of a robot that took the least time
//! from its keyframe to us tells how the two clocks differ, up to that least time; how late the others were follows.
//!
//! Beacons are signed, but anyone can record one and play it later. A robot that goes on hearing sees that it is old;
//! one that has just started, or was out of reach, does not. So a robot counts as there once it has signed a number that
//! we drew ([`crate::wire::life`]); until then its beacon tells where it was last known to be.

use crate::agent::motion::Twist;
use crate::ids::RobotId;
use crate::time::Instant;
use crate::wire::{BeaconAge, BeaconContent};
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

/// After so long without a beacon a robot must prove anew that it is there, s.
const SILENCE_SECS: f64 = 10.0;
/// Time between two questions to a robot that does not prove that it is there.
const ASK_EVERY: Duration = Duration::from_secs(2);

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

/// A robot that was heard.
struct Heard {
    seen: SeenBeacon,
    /// Its latest beacon when it last [proved](crate::wire::life) that it is there.
    proved: Option<BeaconAge>,
    /// When it was last known to be there.
    lived: Instant,
    /// When it may be asked (again) to prove it.
    ask_at: Instant,
}

impl Heard {
    /// Whether the beacon at hand is of a robot that was there since we listen.
    fn is_live(&self) -> bool {
        self.proved.is_some_and(|proved| self.seen.content.age() >= proved)
    }
}

/// The latest beacon of every robot that was heard.
pub(in crate::agent) struct Beacons {
    heard: BTreeMap<RobotId, Heard>,
    /// Since when we listen.
    begun: Instant,
}

/// What is known of where a robot is.
#[derive(Clone, Copy, Debug)]
pub(in crate::agent) struct LastKnown {
    pub(in crate::agent) content: BeaconContent,
    /// Whether it is known to be there now, by its word on a question of ours.
    pub(in crate::agent) is_live: bool,
    /// How long ago the beacon was heard; of a robot that is not known to be there, how long that was not known.
    pub(in crate::agent) age_secs: f64,
}

impl Beacons {
    pub(super) fn new(now: Instant) -> Self {
        Self { heard: BTreeMap::new(), begun: now }
    }

    /// Takes a beacon of another robot, if it is newer than the one at hand. Whether the robot is to be asked to prove
    /// that it is there.
    pub(super) fn hear(&mut self, content: BeaconContent, now: Instant) -> bool {
        let robot = content.anchor.frame.robot;
        let before = self.heard.get(&robot);
        if before.is_some_and(|heard| content.age() <= heard.seen.content.age()) {
            return false;
        }
        let seen = SeenBeacon::after(before.map(|heard| &heard.seen), content, now);
        let heard = self.heard.entry(robot).or_insert(Heard { seen, proved: None, lived: self.begun, ask_at: now });
        if now.since(heard.seen.at).as_secs_f64() > SILENCE_SECS {
            heard.proved = None; // what was recorded meanwhile could be played now
        }
        heard.seen = seen;
        if heard.is_live() {
            heard.lived = now;
        }
        heard.proved.is_none() && now >= heard.ask_at
    }

    /// The robot is asked whether it is there.
    pub(super) fn asked(&mut self, robot: RobotId, now: Instant) {
        if let Some(heard) = self.heard.get_mut(&robot) {
            heard.ask_at = now.after(ASK_EVERY);
        }
    }

    /// The robot is there, and this is its latest beacon.
    pub(super) fn prove(&mut self, robot: RobotId, latest: BeaconAge, now: Instant) {
        if let Some(heard) = self.heard.get_mut(&robot) {
            heard.proved = heard.proved.max(Some(latest));
            if heard.is_live() {
                heard.lived = now;
            }
        }
    }

    /// The latest of one robot that is known to be there.
    pub(in crate::agent) fn of(&self, robot: RobotId) -> Option<&SeenBeacon> {
        self.heard.get(&robot).filter(|heard| heard.is_live()).map(|heard| &heard.seen)
    }

    /// The latest of each, by robot.
    pub(in crate::agent) fn last_known(&self, now: Instant) -> impl Iterator<Item = (RobotId, LastKnown)> {
        self.heard.iter().map(move |(robot, heard)| {
            let is_live = heard.is_live();
            let since = if is_live { heard.seen.at } else { heard.lived };
            let age_secs = now.since(since).as_secs_f64();
            (*robot, LastKnown { content: heard.seen.content, is_live, age_secs })
        })
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

    const SECOND: Duration = Duration::from_secs(1);

    /// What is known after a beacon at each of these times, in s, of a robot that proves at once that it is there if
    /// it is asked and `answers`.
    fn known(times: &[u64], answers: impl Fn(u64) -> bool) -> (Vec<bool>, Vec<u64>) {
        let mut beacons = Beacons::new(Instant::ZERO);
        let robot = RobotId([7; 8]);
        let (mut live, mut asked) = (Vec::new(), Vec::new());
        for (counter, at) in times.iter().enumerate() {
            let now = Instant::ZERO.after(u32::try_from(*at).unwrap() * SECOND);
            let content = content(*at as f64, counter as u64);
            if beacons.hear(content, now) {
                asked.push(*at);
                beacons.asked(robot, now);
                if answers(*at) {
                    beacons.prove(robot, content.age(), now);
                }
            }
            assert_eq!(beacons.of(robot).is_some(), beacons.last_known(now).next().unwrap().1.is_live);
            live.push(beacons.of(robot).is_some());
        }
        (live, asked)
    }

    #[test]
    fn a_robot_is_there_once_it_has_said_so_and_until_it_is_silent() {
        let times = [5, 6, 7, 8, 18, 29, 30];
        assert_eq!(known(&times, |_| true), (vec![true; 7], vec![5, 29]));
        let silent = known(&times, |_| false);
        assert_eq!(silent, (vec![false; 7], vec![5, 7, 18, 29]), "asked again, but not each time");
        let (live, _) = known(&times, |at| at >= 18);
        assert_eq!(live, [false, false, false, false, true, true, true]);
        let (live, _) = known(&times, |at| at < 18);
        assert_eq!(live, [true, true, true, true, true, false, false]);
    }

    #[test]
    fn what_was_recorded_before_the_proof_is_not_where_the_robot_is() {
        let mut beacons = Beacons::new(Instant::ZERO);
        let (robot, at) = (RobotId([7; 8]), |secs: u32| Instant::ZERO.after(secs * SECOND));
        let (old, new) = (content(100.0, 3), content(200.0, 9));
        assert!(beacons.hear(old, at(50)));
        beacons.prove(robot, new.age(), at(51));
        let known = beacons.last_known(at(55)).next().unwrap().1;
        assert!(beacons.of(robot).is_none() && !known.is_live);
        assert!((known.age_secs - 55.0).abs() < 1e-9, "not known to be there since we listen: {}", known.age_secs);
        assert!(!beacons.hear(new, at(56)));
        let known = beacons.last_known(at(57)).next().unwrap().1;
        assert!(known.is_live && (known.age_secs - 1.0).abs() < 1e-9);
        // Played again it is no news.
        assert!(!beacons.hear(old, at(63)) && beacons.of(robot).unwrap().content == new);
    }
}

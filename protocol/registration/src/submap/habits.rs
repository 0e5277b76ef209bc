//! What is odd about what a front end sends, as far as it shows beside the keyframes themselves: stamps that are not in
//! nanoseconds, by when they come, and submaps without keypoints. The rest is found by the
//! [builder](super::SubmapBuilder::take_oddities). All that was found in an epoch is kept, for people who look later.

use super::stated::Oddity;
use crate::time::{Instant, Stamp};

/// Stamps that rise so many times slower than time passes are not in nanoseconds: microseconds rise a thousand times
/// slower. Simulations and replays that run slower than the clock, or faster, stay within.
const SLOW: f64 = 200.0;
/// Keyframes that are looked at together, and how many such windows in a row must be so: a SLAM that was paused makes one.
const KEYFRAMES: u32 = 5;
const WINDOWS: u32 = 2;
/// Submaps whose median of keypoints counts.
const SUBMAPS: usize = 5;
/// Fewer keypoints than this are too few: a motion takes three, and chance finds as many again.
pub const KEYPOINTS_MIN: usize = 6;

/// What shows over many keyframes of one epoch.
#[derive(Clone, Debug, Default)]
pub struct Habits {
    /// Where the window began.
    first: Option<(Instant, Stamp)>,
    keyframes: u32,
    slow_windows: u32,
    keypoints: Vec<usize>,
    found: Vec<Oddity>,
}

impl Habits {
    /// A keyframe was taken at this time.
    pub fn take(&mut self, now: Instant, stamp: Stamp) -> Option<Oddity> {
        let (since, first) = *self.first.get_or_insert((now, stamp));
        self.keyframes = self.keyframes.saturating_add(1);
        if self.slow_windows >= WINDOWS || self.keyframes <= KEYFRAMES {
            return None;
        }
        (self.first, self.keyframes) = (Some((now, stamp)), 1);
        let (passed, stated) = (now.since(since).as_secs_f64(), stamp.secs_since(first));
        self.slow_windows = if stated * SLOW > passed { 0 } else { self.slow_windows + 1 };
        if self.slow_windows < WINDOWS {
            return None;
        }
        let orders = libm::log10(passed / stated.max(1e-9));
        let power = [3, 6, 9].into_iter().min_by(|a, b| {
            let off = |power: &u32| (orders - f64::from(*power)).abs();
            off(a).total_cmp(&off(b))
        })?;
        Some(Oddity::Stamps { power })
    }

    /// A submap was described.
    pub fn described(&mut self, keypoints: usize) -> Option<Oddity> {
        if self.keypoints.len() >= SUBMAPS {
            return None;
        }
        self.keypoints.push(keypoints);
        if self.keypoints.len() < SUBMAPS {
            return None;
        }
        let mut sorted = self.keypoints.clone();
        sorted.sort_unstable();
        let median = sorted[SUBMAPS / 2];
        (median < KEYPOINTS_MIN).then_some(Oddity::Bare { keypoints: u32::try_from(median).unwrap_or(u32::MAX) })
    }

    /// Keeps what was found.
    pub fn keep(&mut self, oddity: Oddity) {
        self.found.push(oddity);
    }

    /// All that was found in this epoch.
    pub fn found(&self) -> impl Iterator<Item = &Oddity> {
        self.found.iter()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::time::Duration;

    /// What is told of stamps that rise by so much in a second.
    fn told(per_sec: i64) -> Vec<Oddity> {
        let mut habits = Habits::default();
        let at = |k: u32| Instant::ZERO.after(Duration::from_millis(500) * k);
        (0..40).filter_map(|k| habits.take(at(k), Stamp(i64::from(k) * per_sec / 2))).collect()
    }

    #[test]
    fn stamps_that_are_not_in_nanoseconds_are_told_once_with_their_unit() {
        assert_eq!(told(2), [Oddity::Stamps { power: 9 }]);
        assert_eq!(told(1_000), [Oddity::Stamps { power: 6 }]);
        assert_eq!(told(1_000_000), [Oddity::Stamps { power: 3 }]);
        // A replay at a hundred times the speed, and a simulation at a hundredth.
        for per_sec in [100_000_000_000, 1_000_000_000, 10_000_000] {
            assert_eq!(told(per_sec), [], "{per_sec}");
        }
        // One that was paused for an hour.
        let mut habits = Habits::default();
        for k in 0..40_u32 {
            let now =
                Instant::ZERO.after(Duration::from_secs(u64::from(k / 20) * 3_600) + Duration::from_millis(500) * k);
            assert_eq!(habits.take(now, Stamp(i64::from(k) * 500_000_000)), None);
        }
    }

    #[test]
    fn submaps_without_keypoints_are_told_once_by_their_median() {
        let told = |counts: &[usize]| {
            let mut habits = Habits::default();
            counts.iter().filter_map(|count| habits.described(*count)).collect::<Vec<_>>()
        };
        assert_eq!(
            told(&[0, 90, 0, KEYPOINTS_MIN - 1, 90, 0, 0]),
            [Oddity::Bare { keypoints: KEYPOINTS_MIN as u32 - 1 }]
        );
        assert_eq!(told(&[0, 90, 0, KEYPOINTS_MIN, 90, 0, 0]), []);
        assert_eq!(told(&[0; SUBMAPS - 1]), []);
    }
}

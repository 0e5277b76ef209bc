//! What a robot may put on a link, by class: pose > facts > repair > have > blobs (DESIGN §4). One token bucket of
//! bytes; a class may spend only what the bucket holds beyond the reserve of the classes above it, so that on a slow
//! link poses keep their pace, then new facts go, then repair, and blobs take what is left.
//!
//! All that a robot sends comes out of one bucket, broadcasts once: questions do not say who asks, and on a radio all
//! links share the air. So no link of the robot carries more than the rate and, after a pause, one burst
//! ([`burst_bytes`]), but for the few bytes of "not now" to whoever asks beyond that; single announcements, questions
//! and new facts may overdraw it and are paid back before anything follows them.

use super::token_bucket::Bucket;
use crate::time::Instant;

/// Shortest burst: the largest reserve and then a sync answer of useful size ([`REPAIR_BYTES_MIN`]) must fit.
const BURST_BYTES_MIN: f64 = 16_384.0;
/// Smallest budget for the entries of a sync answer: from here on every answer brings progress. With less, the asker is
/// told to come again.
pub const REPAIR_BYTES_MIN: usize = 4_096;
/// Smallest piece of a blob, but for its last.
pub const PIECE_BYTES_MIN: usize = 1_024;

/// Classes of traffic, from the most to the least urgent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Class {
    /// Live poses: they always go, and are counted.
    Pose,
    /// New facts of one's own.
    Facts,
    /// Facts that another robot lacks, in answer to its question.
    Repair,
    /// Announcements of the root, questions, negotiation.
    Have,
    /// Pieces of keypoint blobs, asked for and answered.
    Blob,
}

impl Class {
    /// Its name in statistics.
    pub fn name(self) -> &'static str {
        match self {
            Self::Pose => "pose",
            Self::Facts => "facts",
            Self::Repair => "repair",
            Self::Have => "have",
            Self::Blob => "blob",
        }
    }

    /// Share of a full bucket that belongs to the classes above. Repair comes in lumps of [`REPAIR_BYTES_MIN`] and
    /// more, so the small messages of the class below it find room between two of them.
    fn reserve(self) -> f64 {
        match self {
            Self::Pose => 0.0,
            Self::Facts => 1.0 / 8.0,
            Self::Repair => 2.0 / 8.0,
            Self::Have => 3.0 / 8.0,
            Self::Blob => 5.0 / 8.0,
        }
    }
}

/// Most that goes at once after a pause at this rate, bytes: what a second brings, or enough for one answer.
pub fn burst_bytes(bytes_per_sec: f64) -> f64 {
    bytes_per_sec.max(BURST_BYTES_MIN)
}

/// The bytes that one robot may send.
#[derive(Clone, Debug)]
pub struct Budget(Bucket);

impl Budget {
    /// So many bytes a second; a burst is saved up.
    pub fn new(bytes_per_sec: f64, now: Instant) -> Self {
        Self(Bucket::new(bytes_per_sec, burst_bytes(bytes_per_sec), now))
    }

    /// Bytes left to this class, 0 if it must wait. Poses are not asked.
    pub fn left(&self, now: Instant, class: Class) -> usize {
        (self.0.level(now) - self.reserve(class)).max(0.0) as usize
    }

    /// Whether a message of this class may go.
    pub fn may(&self, now: Instant, class: Class) -> bool {
        class == Class::Pose || self.left(now, class) > 0
    }

    /// When a message of this class may go, from `now` on.
    pub fn due(&self, now: Instant, class: Class) -> Instant {
        if class == Class::Pose { now } else { self.0.due(now, self.reserve(class) + 1.5) }
    }

    /// These bytes go out. Debts are limited to one burst, so that no class is silent for long.
    pub fn pay(&mut self, now: Instant, bytes: usize) {
        self.0.set(now, (self.0.level(now) - bytes as f64).max(-self.0.full()));
    }

    /// An answer goes out that was cut to what was left, or says "not now" in a few bytes. It never takes what belongs
    /// to the classes above: whoever asks without end must not silence them.
    pub fn pay_answer(&mut self, now: Instant, class: Class, bytes: usize) {
        self.pay(now, bytes.min(self.left(now, class)));
    }

    fn reserve(&self, class: Class) -> f64 {
        class.reserve() * self.0.full()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::time::Duration;

    const ALL: [Class; 5] = [Class::Pose, Class::Facts, Class::Repair, Class::Have, Class::Blob];

    fn secs(secs: f64) -> Instant {
        Instant::ZERO.after(Duration::from_secs_f64(secs))
    }

    #[test]
    fn a_class_stops_at_the_reserve_of_those_above_it_and_not_before() {
        let now = Instant::ZERO;
        for pair in ALL.windows(2) {
            let mut budget = Budget::new(80_000.0, now);
            let left = budget.left(now, pair[1]);
            assert!(left < budget.left(now, pair[0]));
            budget.pay(now, left - 1);
            assert!(budget.may(now, pair[1]) && budget.may(now, pair[0]), "{pair:?}");
            budget.pay(now, 1);
            assert!(!budget.may(now, pair[1]) && budget.may(now, pair[0]), "{pair:?}");
        }
    }

    #[test]
    fn a_class_goes_on_when_it_was_told_to_and_not_before() {
        let mut budget = Budget::new(10_000.0, Instant::ZERO);
        budget.pay(Instant::ZERO, 20_000);
        for class in &ALL[1..] {
            let due = budget.due(Instant::ZERO, *class);
            assert!(budget.may(due, *class));
            assert!(
                !budget.may(Instant::ZERO.after(due.since(Instant::ZERO) - Duration::from_millis(1)), *class),
                "{class:?}"
            );
            assert_eq!(budget.due(due, *class), due);
        }
        assert!(budget.may(Instant::ZERO, Class::Pose), "poses go on even in debt");
    }

    #[test]
    fn a_full_bucket_serves_every_class_at_any_rate() {
        for rate in [2_000.0, 16_384.0, 16_385.0, 1e9] {
            let budget = Budget::new(rate, Instant::ZERO);
            assert!(budget.left(Instant::ZERO, Class::Repair) >= REPAIR_BYTES_MIN);
            assert!(budget.left(Instant::ZERO, Class::Blob) >= PIECE_BYTES_MIN);
        }
    }

    #[test]
    fn what_is_spent_stays_within_the_rate_and_one_burst() {
        let rate = 3_000.0;
        let mut budget = Budget::new(rate, Instant::ZERO);
        let mut spent = 0;
        for tick in 0..1_000 {
            let now = secs(0.1 * f64::from(tick));
            for class in [Class::Blob, Class::Have, Class::Repair, Class::Facts] {
                let bytes = budget.left(now, class);
                budget.pay(now, bytes);
                spent += bytes;
            }
        }
        let allowed = rate * 99.9 + burst_bytes(rate);
        assert!(spent as f64 <= allowed, "{spent} of {allowed}");
        assert!(spent as f64 > 0.9 * rate * 99.9, "{spent}: nothing is wasted either");
    }

    #[test]
    fn debts_end_and_refusals_take_nothing_from_those_above() {
        let mut budget = Budget::new(20_000.0, Instant::ZERO);
        budget.pay(Instant::ZERO, usize::MAX);
        assert!(!budget.may(secs(1.0), Class::Facts));
        assert!(budget.may(secs(1.2), Class::Facts), "one burst of debt, and the reserve");
        let mut budget = Budget::new(20_000.0, Instant::ZERO);
        for _ in 0..100_000 {
            budget.pay_answer(Instant::ZERO, Class::Repair, 30);
        }
        assert!(!budget.may(Instant::ZERO, Class::Repair) && budget.may(Instant::ZERO, Class::Facts));
    }
}

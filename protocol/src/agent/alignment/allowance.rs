//! What may be spent on knowing better what is known already: frames that have merged are aligned further at a steady
//! cost in bytes, whatever the gain, so that a robot that drives for hours does not fill its radio. Merging itself need
//! not wait, but is paid for out of the same budget. Whoever proposes a pair pays, before anything moves, for what both
//! ends will send.

use crate::gossip::Bucket;
use crate::time::Instant;

/// Seconds of income that are saved up at most, and owed at most.
pub const SAVED_SECS_MAX: f64 = 60.0;
/// About what a stated alignment, or the answer to one, takes as a fact on its way to the others, bytes.
pub(super) const FACT_BYTES: usize = 320;

/// See the module.
pub(super) struct Allowance {
    bucket: Bucket,
    /// Something was put off.
    is_awaited: bool,
}

impl Allowance {
    pub fn new(bytes_per_sec: f64, now: Instant) -> Self {
        Self { bucket: Bucket::new(bytes_per_sec, SAVED_SECS_MAX * bytes_per_sec, now), is_awaited: false }
    }

    /// Whether more may be spent. If not, [`Allowance::timeout`] tells when.
    pub fn may_spend(&mut self, now: Instant) -> bool {
        let may = self.has_some(now);
        self.is_awaited |= !may;
        may
    }

    /// The same, to ask only.
    pub fn has_some(&self, now: Instant) -> bool {
        self.bucket.due(now, 0.0) <= now
    }

    /// So many bytes were spent, as [`Allowance::may_spend`] allowed. They are owed in full: one pair may cost more
    /// than is ever saved up.
    pub fn spend(&mut self, now: Instant, bytes: usize) {
        self.bucket.set(now, self.bucket.level(now) - bytes as f64);
    }

    /// So many bytes were spent on what need not wait. Of such debts no more than [`SAVED_SECS_MAX`] are kept.
    pub fn owe(&mut self, now: Instant, bytes: usize) {
        let level = self.bucket.level(now);
        let bound = level.min(-self.bucket.full());
        self.bucket.set(now, (level - bytes as f64).max(bound));
    }

    /// When what was put off may be done.
    pub fn timeout(&self, now: Instant) -> Option<Instant> {
        self.is_awaited.then(|| self.bucket.due(now, 0.0))
    }

    /// Whether what was put off may be done from now on; true once.
    pub fn take_due(&mut self, now: Instant) -> bool {
        let due = self.timeout(now).is_some_and(|due| due <= now);
        self.is_awaited &= !due;
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use core::time::Duration;

    #[test]
    fn what_is_spent_comes_back_at_the_stated_pace_and_debts_are_bounded() {
        let start = Instant::ZERO;
        let mut allowance = Allowance::new(100.0, start);
        assert!(allowance.may_spend(start) && allowance.timeout(start).is_none());
        allowance.spend(start, 6_000);
        assert!(allowance.may_spend(start), "all of it");
        allowance.spend(start, 500);
        assert!(!allowance.may_spend(start) && !allowance.take_due(start));
        let due = start.after(Duration::from_secs(5));
        assert_eq!(allowance.timeout(start), Some(due));
        assert!(allowance.take_due(due) && !allowance.take_due(due) && allowance.may_spend(due));
        allowance.spend(due, 20_000);
        let owed = |secs| Some(due.after(Duration::from_secs(secs)));
        assert!(!allowance.may_spend(due));
        assert_eq!(allowance.timeout(due), owed(200), "in full");
        allowance.owe(due, 1_000);
        assert_eq!(allowance.timeout(due), owed(200), "nothing more, and nothing less");
        let later = due.after(Duration::from_secs(200));
        allowance.owe(later, 5_000);
        assert_eq!(allowance.timeout(later), owed(250));
        allowance.owe(later, usize::MAX);
        assert_eq!(allowance.timeout(later), owed(260), "a minute's debt");
    }
}

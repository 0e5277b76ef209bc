//! How soon a message may go out: a bucket of tokens that fills slowly lets a few go at once and holds back a stream of
//! them, and a message that moves much pays for itself.

use crate::time::Instant;
use core::time::Duration;

/// Facts that pay for a message by themselves.
const FACTS_PER_COIN: f64 = 8.0;
/// Shortest wait: news seldom come alone.
const WAIT_MIN: Duration = Duration::from_millis(50);

/// A token bucket: it fills steadily up to a limit, and may be in debt.
#[derive(Clone, Debug)]
pub(crate) struct Bucket {
    level: f64,
    at: Instant,
    per_sec: f64,
    full: f64,
}

impl Bucket {
    /// A full one.
    pub fn new(per_sec: f64, full: f64, now: Instant) -> Self {
        Self { level: full, at: now, per_sec, full }
    }

    /// What it holds when it is full.
    pub fn full(&self) -> f64 {
        self.full
    }

    pub fn level(&self, now: Instant) -> f64 {
        let earned = self.per_sec * now.since(self.at).as_secs_f64();
        (self.level + earned).min(self.level.max(self.full))
    }

    /// When it holds so much, from `now` on.
    pub fn due(&self, now: Instant, level: f64) -> Instant {
        let now = now.max(self.at);
        let lacking = level - self.level(now);
        if lacking <= 0.0 { now } else { now.after(Duration::from_secs_f64(lacking / self.per_sec)) }
    }

    pub fn set(&mut self, now: Instant, level: f64) {
        (self.level, self.at) = (level, now);
    }
}

/// A bucket of coins.
#[derive(Clone, Debug)]
pub(super) struct TokenBucket(Bucket);

impl TokenBucket {
    pub fn new(coins_per_sec: f64, coins_max: f64, now: Instant) -> Self {
        Self(Bucket::new(coins_per_sec, coins_max, now))
    }

    /// When a message about `facts` facts may go out that costs this many times the usual.
    pub fn due(&self, now: Instant, facts: f64, copies: f64) -> Instant {
        self.0.due(now, copies * price(facts))
    }

    /// The same; a little later at least.
    pub fn due_soon(&self, now: Instant, facts: f64, copies: f64) -> Instant {
        self.0.due(now, copies * price(facts)).max(now.after(WAIT_MIN))
    }

    /// A message about `facts` facts goes out; one that could not wait makes debts.
    pub fn pay(&mut self, now: Instant, facts: f64, copies: f64) {
        let left = (self.0.level(now) - copies * price(facts)).max(-self.0.full() - copies);
        self.0.set(now, left);
    }

    /// A message about `facts` facts was lost that cost this many times the usual: the next costs nothing more.
    pub fn give_back(&mut self, now: Instant, facts: f64, copies: f64) {
        let level = self.0.level(now);
        self.0.set(now, (level + copies * price(facts)).min(level.max(self.0.full())));
    }

    /// Much was moved at once: now the bucket holds twice what fills it otherwise.
    pub fn refill(&mut self, now: Instant) {
        self.0.set(now, 2.0 * self.0.full());
    }
}

/// A message costs a coin, and less if it moves much.
fn price(facts: f64) -> f64 {
    (FACTS_PER_COIN / facts.max(1.0)).min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_was_lost_is_given_back_and_not_more() {
        let now = Instant::ZERO;
        let mut bucket = TokenBucket::new(1.0, 2.0, now);
        bucket.give_back(now, 1.0, 1.0);
        assert_eq!(bucket.0.level(now), 2.0, "a full bucket stays full");
        bucket.pay(now, 1.0, 1.0);
        bucket.pay(now, 1.0, 1.0);
        assert!(bucket.due(now, 1.0, 1.0) > now);
        bucket.give_back(now, 1.0, 1.0);
        assert_eq!(bucket.due(now, 1.0, 1.0), now);
        assert_eq!(bucket.0.level(now), 1.0);
    }

    #[test]
    fn what_follows_a_large_gain_need_not_wait() {
        let now = Instant::ZERO;
        let mut bucket = TokenBucket::new(1.0, 2.0, now);
        let at_once = |bucket: &mut TokenBucket| {
            let mut count = 0;
            while bucket.due(now, 1.0, 1.0) <= now {
                bucket.pay(now, 1.0, 1.0);
                count += 1;
            }
            count
        };
        assert_eq!(at_once(&mut bucket), 2);
        bucket.refill(now);
        assert_eq!(at_once(&mut bucket), 4);
        bucket.refill(now);
        let later = now.after(Duration::from_secs(100));
        assert!(bucket.0.level(later) <= 4.0, "what it holds beyond its fill does not grow");
        bucket.pay(later, 1.0, 4.0);
        assert!(bucket.0.level(later.after(Duration::from_secs(100))) <= 2.0);
    }
}

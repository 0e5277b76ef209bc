//! How soon a message may go out: a purse that fills slowly lets a few go at once and holds back a stream of them, and
//! a message that moves much pays for itself.

use crate::time::Instant;
use core::time::Duration;

/// Facts that pay for a message by themselves.
const FACTS_PER_COIN: f64 = 8.0;
/// Shortest wait: news seldom come alone.
const WAIT_MIN: Duration = Duration::from_millis(50);

/// A token bucket.
#[derive(Clone, Debug)]
pub(super) struct Purse {
    coins: f64,
    at: Instant,
    coins_per_sec: f64,
    coins_max: f64,
}

impl Purse {
    pub fn new(coins_per_sec: f64, coins_max: f64, now: Instant) -> Self {
        Self { coins: coins_max, at: now, coins_per_sec, coins_max }
    }

    /// When a message about `facts` facts may go out.
    pub fn due(&self, now: Instant, facts: f64) -> Instant {
        self.due_to(now, facts, 1.0)
    }

    fn due_to(&self, now: Instant, facts: f64, copies: f64) -> Instant {
        let lacking = copies * price(facts) - self.coins_at(now);
        if lacking <= 0.0 { now } else { now.after(Duration::from_secs_f64(lacking / self.coins_per_sec)) }
    }

    /// When a message may go out that costs this many times the usual; a little later at least.
    pub fn due_soon(&self, now: Instant, facts: f64, copies: f64) -> Instant {
        self.due_to(now, facts, copies).max(now.after(WAIT_MIN))
    }

    /// A message about `facts` facts goes out; one that could not wait makes debts.
    pub fn pay(&mut self, now: Instant, facts: f64, copies: f64) {
        self.coins = (self.coins_at(now) - copies * price(facts)).max(-self.coins_max - copies);
        self.at = now;
    }

    /// Much was moved at once: now the purse holds twice what fills it otherwise.
    pub fn refill(&mut self, now: Instant) {
        self.coins = 2.0 * self.coins_max;
        self.at = now;
    }

    fn coins_at(&self, now: Instant) -> f64 {
        let earned = self.coins_per_sec * now.since(self.at).as_secs_f64();
        (self.coins + earned).min(self.coins.max(self.coins_max))
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
    fn what_follows_a_large_gain_need_not_wait() {
        let now = Instant::ZERO;
        let mut purse = Purse::new(1.0, 2.0, now);
        let at_once = |purse: &mut Purse| {
            let mut count = 0;
            while purse.due(now, 1.0) <= now {
                purse.pay(now, 1.0, 1.0);
                count += 1;
            }
            count
        };
        assert_eq!(at_once(&mut purse), 2);
        purse.refill(now);
        assert_eq!(at_once(&mut purse), 4);
        purse.refill(now);
        let later = now.after(Duration::from_secs(100));
        assert!(purse.coins_at(later) <= 4.0, "what it holds beyond its fill does not grow");
        purse.pay(later, 1.0, 4.0);
        assert!(purse.coins_at(later.after(Duration::from_secs(100))) <= 2.0);
    }
}

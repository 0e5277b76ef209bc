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

    fn coins_at(&self, now: Instant) -> f64 {
        (self.coins + self.coins_per_sec * now.since(self.at).as_secs_f64()).min(self.coins_max)
    }
}

/// A message costs a coin, and less if it moves much.
fn price(facts: f64) -> f64 {
    (FACTS_PER_COIN / facts.max(1.0)).min(1.0)
}

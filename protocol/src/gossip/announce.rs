//! When to announce the root: Trickle timers (RFC 6206) for a quiet swarm, and an early turn for news.

use super::token_bucket::TokenBucket;
use crate::time::Instant;
use core::time::Duration;
use rand::{Rng, RngExt};

/// First pause after something changed.
const PAUSE_MIN: Duration = Duration::from_secs(1);
/// Equal roots heard in one interval that make our own announcement superfluous.
const ENOUGH: u32 = 3;
/// So many neighbours are usual.
const FEW: f64 = 8.0;
/// Announcements of little news a second...
const NEWS_PER_SEC: f64 = 0.8;
/// ...and how many of them may follow a pause at once.
const NEWS_AT_ONCE: f64 = 4.0;
/// A root is not repeated to neighbours that differ within this time.
const REPEAT: Duration = Duration::from_secs(1);

/// The timer of announcements.
#[derive(Clone, Debug)]
pub(super) struct Announce {
    next: Instant,
    pause: Duration,
    pause_max: Duration,
    agreeing: u32,
    news: usize,
    hearers: usize,
    bucket: TokenBucket,
    said: Option<([u8; 8], Instant)>,
}

impl Announce {
    pub fn new(have_secs: f64, now: Instant) -> Self {
        let pause_max = Duration::from_secs_f64(have_secs);
        let pause = PAUSE_MIN.min(pause_max);
        Self {
            next: now.after(pause),
            pause,
            pause_max,
            agreeing: 0,
            news: 0,
            hearers: 0,
            bucket: TokenBucket::new(NEWS_PER_SEC, NEWS_AT_ONCE, now),
            said: None,
        }
    }

    /// When the next announcement is due.
    pub fn next(&self) -> Instant {
        self.next
    }

    /// Somebody new must hear our root within `secs`.
    pub fn hurry(&mut self, now: Instant, secs: f64) {
        self.said = None;
        self.restart(now.after(Duration::from_secs_f64(secs)));
    }

    /// Somebody announced our very root.
    pub fn agrees(&mut self) {
        self.agreeing = self.agreeing.saturating_add(1);
    }

    /// Somebody who may lack something announced another root than ours, which is `root`.
    pub fn differs(&mut self, now: Instant, root: [u8; 8]) {
        let said = self.said.is_some_and(|(said, at)| said == root && now.since(at) < REPEAT);
        if !said {
            self.news = self.news.max(1);
            self.next = self.next.min(self.bucket.due_soon(now, self.news as f64, self.copies()));
        }
    }

    /// We hold something new, and so many neighbours would hear of it.
    pub fn news(&mut self, now: Instant, new: usize, neighbours: usize) {
        if new > 0 {
            self.news = self.news.saturating_add(new);
            self.hearers = neighbours;
            self.restart(self.bucket.due_soon(now, self.news as f64, self.copies()));
        }
    }

    /// Whether to announce now. Every call that says so counts as an announcement of `root`.
    pub fn is_due(&mut self, now: Instant, root: [u8; 8], rng: &mut impl Rng) -> bool {
        if now < self.next {
            return false;
        }
        let known = self.said.is_some_and(|(said, _)| said == root);
        let silent = known && self.agreeing >= ENOUGH;
        if !silent {
            self.said = Some((root, now));
            self.bucket.pay(now, self.news as f64, self.copies());
        }
        let again = now.after(self.pause.mul_f64(rng.random_range(0.75..1.25)));
        self.next = again.max(self.bucket.due_soon(now, 1.0, self.copies()));
        self.pause = (2 * self.pause).min(self.pause_max);
        (self.agreeing, self.news) = (0, 0);
        !silent
    }

    /// The cost of an announcement, in copies: one that many hear costs more, and most of them hear the news from
    /// others.
    fn copies(&self) -> f64 {
        (self.hearers as f64 / FEW).max(1.0)
    }

    /// See [`TokenBucket::refill`].
    pub fn refill(&mut self, now: Instant) {
        self.bucket.refill(now);
    }

    fn restart(&mut self, at: Instant) {
        self.next = self.next.min(at);
        self.pause = PAUSE_MIN.min(self.pause_max);
    }
}

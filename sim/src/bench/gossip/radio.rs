//! A poor radio: every message goes to one neighbour, takes its turn in the sender's queue, and may be lost.

use crate::dice::Dice;
use core::time::Duration;
use merganser_protocol::time::Instant;

/// Bytes per second that one robot can send.
const BYTES_PER_SEC: f64 = 1_000_000.0;
/// Mean delay beyond the queue, s.
const DELAY_SECS: f64 = 0.02;

pub struct Radio {
    free: Vec<Instant>,
    loss: f64,
    dice: Dice,
}

impl Radio {
    pub fn new(robots: usize, loss: f64, seed: u64) -> Self {
        Self { free: vec![Instant::ZERO; robots], loss, dice: Dice::new(seed, "radio") }
    }

    /// When a message arrives; `None` if it is lost. It takes its time on the air either way.
    pub fn send(&mut self, now: Instant, from: usize, bytes: usize) -> Option<Instant> {
        let sent = self.free[from].max(now).after(Duration::from_secs_f64(bytes as f64 / BYTES_PER_SEC));
        self.free[from] = sent;
        let delay = self.dice.exponential(DELAY_SECS);
        (!self.dice.chance(self.loss)).then(|| sent.after(Duration::from_secs_f64(delay)))
    }
}

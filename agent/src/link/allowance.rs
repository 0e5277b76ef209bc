//! An allowance of bytes that fills with time, for what may wait.

use std::time::Duration;
use tokio::time::Instant;

/// An allowance keeps what it gets in this time.
const KEPT_SECS: f64 = 2.0;

/// A token bucket. Whoever comes while anything is left is served in full, however large his wish: the debt is worked
/// off before the next is served, so that over a long time no more than the rate goes out.
#[derive(Clone, Copy, Debug)]
pub(super) struct Allowance {
    bytes_per_sec: f64,
    left: f64,
    filled: Instant,
}

impl Allowance {
    /// One that is full.
    pub fn new(bytes_per_sec: f64) -> Self {
        Self { bytes_per_sec, left: KEPT_SECS * bytes_per_sec, filled: Instant::now() }
    }

    /// Takes `bytes`.
    ///
    /// # Errors
    /// How long nothing will be left, and takes nothing.
    pub fn take(&mut self, now: Instant, bytes: usize) -> Result<(), Duration> {
        let gained = now.saturating_duration_since(self.filled).as_secs_f64() * self.bytes_per_sec;
        (self.left, self.filled) = ((self.left + gained).min(KEPT_SECS * self.bytes_per_sec), now);
        if self.left <= 0.0 {
            return Err(Duration::from_secs_f64(-self.left / self.bytes_per_sec));
        }
        self.left -= bytes as f64;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn over_a_long_time_the_rate_goes_out_and_no_more() {
        let begins = Instant::now();
        for bytes in [1, 300, 5_000] {
            let mut allowance = Allowance { filled: begins, ..Allowance::new(1000.0) };
            let mut gone = 0;
            for ms in 0..100_000 {
                gone += usize::from(allowance.take(begins + Duration::from_millis(ms), bytes).is_ok()) * bytes;
            }
            let most = 100_000 + 2_000 + bytes;
            let least = if bytes == 1 { 100_000 } else { most - 2_000 - 2 * bytes }; // one byte each ms is all that is asked
            assert!((least..=most).contains(&gone), "{bytes}: {gone}");
        }
    }

    #[tokio::test]
    async fn a_wish_beyond_all_that_is_kept_is_served_and_makes_the_next_wait() {
        let begins = Instant::now();
        let mut allowance = Allowance { filled: begins, ..Allowance::new(1000.0) };
        assert_eq!(allowance.take(begins, 12_000), Ok(()));
        assert_eq!(allowance.take(begins, 1), Err(Duration::from_secs(10)));
        assert_eq!(allowance.take(begins + Duration::from_millis(10_001), 1), Ok(()));
    }
}

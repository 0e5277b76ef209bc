//! Where the wall time of a run goes. It is printed for people; nothing in a run depends on it.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

/// Calls and wall time by kind of work.
#[derive(Clone, Debug, Default)]
pub struct Stopwatch(BTreeMap<&'static str, (u64, Duration)>);

impl Stopwatch {
    /// Does `work` and notes how long it took.
    pub fn time<T>(&mut self, kind: &'static str, work: impl FnOnce() -> T) -> T {
        let began = Instant::now();
        let result = work();
        let (calls, spent) = self.0.entry(kind).or_default();
        *calls += 1;
        *spent += began.elapsed();
        result
    }

    /// (kind, calls, seconds), the costliest first.
    pub fn laps(&self) -> Vec<(&'static str, u64, f64)> {
        let mut laps: Vec<_> =
            self.0.iter().map(|(kind, (calls, spent))| (*kind, *calls, spent.as_secs_f64())).collect();
        laps.sort_by(|a, b| b.2.total_cmp(&a.2));
        laps
    }
}

//! Counters, and refusals reported without letting a noisy peer flood the log: every refusal is counted, but a peer is
//! named in an event at most once per reason and [`REPORT_EVERY`], so that one reason hides no other.

use crate::gossip::Class;
use crate::ids::RobotId;
use crate::time::Instant;
use core::time::Duration;
use std::collections::BTreeMap;

/// Shortest time between two reports about one peer and reason.
pub const REPORT_EVERY: Duration = Duration::from_secs(10);
/// Peers told apart in the counters; the rest count as one unknown peer. Bounds memory against invented names.
pub const PEERS_MAX: usize = 1024;

/// Counters since start.
#[derive(Clone, Debug, Default)]
pub struct Stats {
    /// Payload bytes and messages sent, by kind.
    pub sent: BTreeMap<&'static str, (u64, u64)>,
    /// Payload bytes and messages received, by kind.
    pub received: BTreeMap<&'static str, (u64, u64)>,
    /// Refusals by reason.
    pub rejected: BTreeMap<&'static str, u64>,
    /// Refusals of what a peer signed, by peer, and of what nobody signed.
    pub rejected_by_peer: BTreeMap<Option<RobotId>, u64>,
    /// What was reported of them.
    reports: BTreeMap<(Option<RobotId>, &'static str), Report>,
    /// Work done, by kind.
    pub work: BTreeMap<&'static str, u64>,
    /// What the link's budget held back, by class.
    pub held_back: BTreeMap<&'static str, u64>,
    /// Bytes of logs of our own that were condensed, before and after.
    pub condensed_bytes: [u64; 2],
}

/// Refusals of one peer's input for one reason.
#[derive(Clone, Copy, Debug, Default)]
struct Report {
    suppressed: u64,
    at: Option<Instant>,
}

impl Stats {
    /// Counts a message sent.
    pub fn sent(&mut self, kind: &'static str, bytes: usize) {
        count_message(&mut self.sent, kind, bytes);
    }

    /// Counts a message received.
    pub fn received(&mut self, kind: &'static str, bytes: usize) {
        count_message(&mut self.received, kind, bytes);
    }

    /// Counts a piece of work.
    pub fn worked(&mut self, kind: &'static str) {
        *self.work.entry(kind).or_default() += 1;
    }

    /// Counts what the link's budget held back.
    pub fn held_back(&mut self, class: Class, count: usize) {
        *self.held_back.entry(class.name()).or_default() += count as u64;
    }

    /// Counts what a log was, and is now that it is condensed.
    pub fn condensed(&mut self, bytes: [usize; 2]) {
        for (total, bytes) in self.condensed_bytes.iter_mut().zip(bytes) {
            *total = total.saturating_add(bytes as u64);
        }
    }

    /// Counts a refusal. `Some(suppressed)` if it should be reported now, with the number of refusals of this peer
    /// that were counted silently for this reason since the last report.
    pub fn rejected(&mut self, now: Instant, peer: Option<RobotId>, reason: &'static str) -> Option<u64> {
        *self.rejected.entry(reason).or_default() += 1;
        let known = self.rejected_by_peer.contains_key(&peer) || self.rejected_by_peer.len() < PEERS_MAX;
        let peer = if known { peer } else { None };
        *self.rejected_by_peer.entry(peer).or_default() += 1;
        let report = self.reports.entry((peer, reason)).or_default();
        if report.at.is_some_and(|at| now.since(at) < REPORT_EVERY) {
            report.suppressed += 1;
            return None;
        }
        report.at = Some(now);
        Some(core::mem::take(&mut report.suppressed))
    }
}

fn count_message(table: &mut BTreeMap<&'static str, (u64, u64)>, kind: &'static str, bytes: usize) {
    let row = table.entry(kind).or_default();
    row.0 += bytes as u64;
    row.1 += 1;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_noisy_peer_is_reported_once_per_interval_and_fully_counted() {
        let mut stats = Stats::default();
        let peer = Some(RobotId([1; 8]));
        let t = |secs| Instant::ZERO.after(Duration::from_secs(secs));
        assert_eq!(stats.rejected(t(0), peer, "bad"), Some(0));
        for _ in 0..99 {
            assert_eq!(stats.rejected(t(5), peer, "bad"), None);
        }
        assert_eq!(stats.rejected(t(10), peer, "bad"), Some(99));
        assert_eq!(stats.rejected_by_peer[&peer], 101);
        assert_eq!(stats.rejected["bad"], 101);
        assert_eq!(stats.rejected(t(11), peer, "worse"), Some(0), "one reason hides no other");
    }

    #[test]
    fn invented_peers_do_not_grow_memory() {
        let mut stats = Stats::default();
        for n in 0..10_000u64 {
            let _ = stats.rejected(Instant::ZERO, Some(RobotId(n.to_le_bytes())), "unknown robot");
        }
        assert!(stats.rejected_by_peer.len() <= PEERS_MAX + 1);
        assert_eq!(stats.rejected["unknown robot"], 10_000);
    }
}

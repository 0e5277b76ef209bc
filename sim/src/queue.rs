//! The event queue of virtual time. Events leave it in order of (time, sequence): two events of one moment leave in the
//! order in which they were put in, so a run has exactly one history.

use core::cmp::Ordering;
use merganser_protocol::time::Instant;
use std::collections::BinaryHeap;

/// Events to come.
#[derive(Debug)]
pub struct Queue<E> {
    heap: BinaryHeap<Entry<E>>,
    sequence: u64,
    now: Instant,
}

#[derive(Debug)]
struct Entry<E> {
    at: Instant,
    sequence: u64,
    event: E,
}

impl<E> Queue<E> {
    /// An empty queue at time zero.
    pub fn new() -> Self {
        Self { heap: BinaryHeap::new(), sequence: 0, now: Instant::ZERO }
    }

    /// Puts an event in. One for the past happens now: time never goes back.
    pub fn push(&mut self, at: Instant, event: E) {
        let at = at.max(self.now);
        self.heap.push(Entry { at, sequence: self.sequence, event });
        self.sequence += 1;
    }

    /// Takes the next event out, and moves time to it.
    pub fn pop(&mut self) -> Option<(Instant, E)> {
        let entry = self.heap.pop()?;
        self.now = entry.at;
        Some((entry.at, entry.event))
    }

    /// The time of the last event taken out.
    pub fn now(&self) -> Instant {
        self.now
    }

    /// Number of events to come.
    pub fn len(&self) -> usize {
        self.heap.len()
    }

    /// Whether nothing is to come.
    pub fn is_empty(&self) -> bool {
        self.heap.is_empty()
    }
}

impl<E> Default for Queue<E> {
    fn default() -> Self {
        Self::new()
    }
}

// The heap keeps the largest on top, so the order is turned round.
impl<E> Ord for Entry<E> {
    fn cmp(&self, other: &Self) -> Ordering {
        (other.at, other.sequence).cmp(&(self.at, self.sequence))
    }
}

impl<E> PartialOrd for Entry<E> {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl<E> PartialEq for Entry<E> {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other) == Ordering::Equal
    }
}

impl<E> Eq for Entry<E> {}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn events_leave_by_time_then_by_entry(times in prop::collection::vec(0u64..20, 0..200)) {
            let mut queue = Queue::new();
            for (index, &time) in times.iter().enumerate() {
                queue.push(Instant::from_nanos(time), index);
            }
            let mut expected: Vec<(u64, usize)> = times.iter().copied().zip(0..).collect();
            expected.sort_unstable();
            let got: Vec<(u64, usize)> = core::iter::from_fn(|| queue.pop()).map(|(t, e)| (t.as_nanos(), e)).collect();
            prop_assert_eq!(got, expected);
        }
    }

    #[test]
    fn the_past_happens_now() {
        let mut queue = Queue::new();
        queue.push(Instant::from_nanos(5), "five");
        assert_eq!(queue.pop().map(|(t, _)| t.as_nanos()), Some(5));
        queue.push(Instant::from_nanos(3), "three");
        assert_eq!(queue.pop(), Some((Instant::from_nanos(5), "three")));
        assert!(queue.is_empty());
    }
}

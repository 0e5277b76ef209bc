//! The one queue in front of the core. What the outside sends is bounded in number, in bytes and per source, and what
//! does not fit is dropped and counted: a flooding peer can neither stop the core nor crowd out the others. What the
//! core itself asked for (results, answers, durability) always fits, because the core bounds how much it asks for.

use merganser_protocol::agent::io::Input;
use merganser_protocol::ids::Name;
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc;

/// Bytes of waiting outside input at most.
pub const QUEUED_BYTES_MAX: usize = 32 << 20;
/// A single source may fill this part of the queue: one in so many.
const SHARE: usize = 4;
/// Time between two looks for room in bytes.
const FEED_WAIT: Duration = Duration::from_millis(2);
/// Different reasons counted at most; the rest counts as one.
const REASONS_MAX: usize = 64;

/// Whose input it is, for fairness.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// A robot of the roster, by the name in the key it published on.
    Robot(Name),
    /// Peers' questions: Zenoh does not say who asks.
    Questions,
    /// The robot's own SLAM.
    Own,
}

/// The sending ends; clones share one queue.
#[derive(Clone, Debug)]
pub struct Inbox {
    outside: mpsc::Sender<Queued>,
    inside: mpsc::UnboundedSender<Input>,
    load: Arc<Load>,
    /// What was dropped, and why.
    pub drops: Arc<Drops>,
}

/// The receiving end; the driver's.
#[derive(Debug)]
pub struct Outbox {
    outside: mpsc::Receiver<Queued>,
    inside: mpsc::UnboundedReceiver<Input>,
}

#[derive(Debug)]
struct Load {
    length_max: usize,
    bytes: AtomicUsize,
    by_source: Mutex<BTreeMap<Source, Arc<AtomicUsize>>>,
}

/// An input that gives its room back when it is taken.
#[derive(Debug)]
struct Queued {
    input: Option<Input>,
    bytes: usize,
    load: Arc<Load>,
    of_source: Arc<AtomicUsize>,
}

impl Drop for Queued {
    fn drop(&mut self) {
        self.load.bytes.fetch_sub(self.bytes, Relaxed);
        self.of_source.fetch_sub(1, Relaxed);
    }
}

/// A queue for `length` outside inputs.
pub fn queue(length: usize) -> (Inbox, Outbox) {
    let (outside, outside_end) = mpsc::channel(length.max(1));
    let (inside, inside_end) = mpsc::unbounded_channel();
    let load = Load { length_max: length, bytes: AtomicUsize::new(0), by_source: Mutex::default() };
    let inbox = Inbox { outside, inside, load: Arc::new(load), drops: Arc::default() };
    (inbox, Outbox { outside: outside_end, inside: inside_end })
}

impl Inbox {
    /// Puts an outside input into the queue, or drops and counts it. Returns whether it was taken. Never blocks.
    pub fn offer(&self, source: Source, input: Input) -> bool {
        let bytes = weight(&input);
        let of_source = self.load.of_source(&source);
        let queued = Queued { input: Some(input), bytes, load: self.load.clone(), of_source: of_source.clone() };
        let before = of_source.fetch_add(1, Relaxed);
        let bytes_before = self.load.bytes.fetch_add(bytes, Relaxed);
        let share_max = if source == Source::Own { self.load.length_max } else { self.load.length_max / SHARE };
        let fits = before < share_max.max(1) && bytes_before + bytes <= QUEUED_BYTES_MAX;
        let taken = fits && self.outside.try_send(queued).is_ok();
        if !taken {
            self.drops.count(format!("queue full: {}", source.label()));
        }
        taken
    }

    /// Waits for room, then puts an input of the robot's own into the queue. Returns false if the driver has ended.
    pub async fn feed(&self, input: Input) -> bool {
        let bytes = weight(&input);
        while self.load.bytes.load(Relaxed) > QUEUED_BYTES_MAX / 2 {
            tokio::time::sleep(FEED_WAIT).await; // what is large leaves room for others
        }
        let of_source = self.load.of_source(&Source::Own);
        of_source.fetch_add(1, Relaxed);
        self.load.bytes.fetch_add(bytes, Relaxed);
        let queued = Queued { input: Some(input), bytes, load: self.load.clone(), of_source };
        self.outside.send(queued).await.is_ok()
    }

    /// Puts in what the core waits for: the result of something it asked for.
    pub fn deliver(&self, input: Input) {
        let _ = self.inside.send(input); // fails only when the driver has ended
    }
}

impl Outbox {
    /// The next input, what the core waits for first; `None` when all senders are gone.
    pub async fn next(&mut self) -> Option<Input> {
        tokio::select! {
            biased;
            Some(input) = self.inside.recv() => Some(input),
            Some(mut queued) = self.outside.recv() => queued.input.take(),
            else => None,
        }
    }
}

impl Load {
    fn of_source(&self, source: &Source) -> Arc<AtomicUsize> {
        let mut by_source = self.by_source.lock().unwrap_or_else(PoisonError::into_inner);
        match by_source.get(source) {
            Some(count) => count.clone(),
            None => by_source.entry(source.clone()).or_default().clone(),
        }
    }
}

impl Source {
    fn label(&self) -> &str {
        match self {
            Self::Robot(name) => name.as_str(),
            Self::Questions => "questions",
            Self::Own => "own SLAM",
        }
    }
}

/// Memory that an input holds while it waits, roughly.
fn weight(input: &Input) -> usize {
    match input {
        Input::Keyframe(keyframe) => keyframe.points.len() * 12 + 512,
        Input::Received { bytes, .. } | Input::Asked { bytes, .. } => bytes.len() + 128,
        Input::Answered { bytes, .. } => bytes.as_ref().map_or(0, Vec::len) + 128,
        _ => 512,
    }
}

/// Counters of what was dropped or refused at the edge, by reason. Reasons name robots of the roster or fixed texts, so
/// there are few; a bound holds all the same.
#[derive(Debug, Default)]
pub struct Drops(Mutex<BTreeMap<String, Arc<AtomicU64>>>);

impl Drops {
    /// Counts one.
    pub fn count(&self, reason: impl Into<String>) {
        self.count_first(reason);
    }

    /// Counts one; whether it is the first that is counted for this reason.
    pub fn count_first(&self, reason: impl Into<String>) -> bool {
        let mut counters = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let mut reason = reason.into();
        if counters.len() >= REASONS_MAX && !counters.contains_key(&reason) {
            reason = "other".into();
        }
        counters.entry(reason).or_default().fetch_add(1, Relaxed) == 0
    }

    /// All counters.
    pub fn counts(&self) -> BTreeMap<String, u64> {
        let counters = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        counters.iter().map(|(reason, count)| (reason.clone(), count.load(Relaxed))).collect()
    }

    /// One line for each reason that was counted since the last call with the same `seen`.
    pub fn news(&self, seen: &mut BTreeMap<String, u64>) -> Vec<String> {
        let counts = self.counts();
        let grown = |(reason, count): (&String, &u64)| {
            let before = seen.get(reason).copied().unwrap_or(0);
            (*count > before).then(|| format!("{reason}: {} dropped, {count} in all", count - before))
        };
        let news = counts.iter().filter_map(grown).collect();
        *seen = counts;
        news
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::agent::io::{Channel, Command, QueryId};
    use merganser_protocol::ids::RobotId;

    fn robot(name: &str) -> Source {
        Source::Robot(Name::new(name).unwrap())
    }

    fn received(length: usize) -> Input {
        Input::Received { from: RobotId([1; 8]), channel: Channel::Facts, bytes: vec![0; length] }
    }

    #[tokio::test]
    async fn one_source_fills_its_share_and_no_more() {
        let (inbox, mut outbox) = queue(16);
        let taken = |source: &Source| (0..100).filter(|_| inbox.offer(source.clone(), received(1))).count();
        assert_eq!(taken(&robot("alpha")), 4);
        assert_eq!(taken(&robot("beta")), 4);
        assert_eq!(taken(&Source::Questions), 4);
        assert_eq!(taken(&Source::Own), 4, "what is left of 16");
        let counts = inbox.drops.counts();
        assert_eq!(counts["queue full: alpha"], 96);
        assert_eq!(counts["queue full: own SLAM"], 96);
        outbox.next().await.unwrap();
        assert_eq!(taken(&robot("alpha")), 1, "taking one makes room for one");
        drop(inbox);
        let mut rest = 0;
        while outbox.next().await.is_some() {
            rest += 1;
        }
        assert_eq!(rest, 16);
    }

    #[tokio::test]
    async fn bytes_are_bounded_on_both_sides_of_the_limit() {
        let (inbox, mut outbox) = queue(1024);
        let part = QUEUED_BYTES_MAX / 4 - 128;
        for name in ["a", "b", "c", "d"] {
            assert!(inbox.offer(robot(name), received(part)));
        }
        assert!(!inbox.offer(robot("e"), received(0)));
        outbox.next().await.unwrap();
        assert!(inbox.offer(robot("e"), received(0)));
        assert!(!inbox.offer(robot("f"), received(part)));
    }

    #[tokio::test]
    async fn what_the_core_waits_for_comes_first_and_is_never_dropped() {
        let (inbox, mut outbox) = queue(16);
        while inbox.offer(Source::Own, received(1)) {}
        for number in 0..100 {
            inbox.deliver(Input::Answered { query: QueryId(number), bytes: None });
        }
        for number in 0..100 {
            assert!(matches!(outbox.next().await, Some(Input::Answered { query: QueryId(n), .. }) if n == number));
        }
        assert!(matches!(outbox.next().await, Some(Input::Received { .. })));
    }

    #[tokio::test]
    async fn a_recording_waits_instead_of_dropping() {
        let (inbox, mut outbox) = queue(16);
        let feeding = tokio::spawn(async move {
            for _ in 0..100 {
                assert!(inbox.feed(Input::Command(Command::Flush)).await);
            }
            inbox.drops.counts()
        });
        for _ in 0..100 {
            assert!(outbox.next().await.is_some());
        }
        assert!(feeding.await.unwrap().is_empty());
    }

    #[test]
    fn reasons_are_bounded_and_told_once() {
        let drops = Drops::default();
        for i in 0..1000 {
            drops.count(format!("reason {i}"));
        }
        assert_eq!(drops.counts().len(), REASONS_MAX + 1);
        assert_eq!(drops.counts()["other"], 1000 - REASONS_MAX as u64);
        assert!(!drops.count_first("reason 0") && !drops.count_first("one more, counted as another"));
        assert!(Drops::default().count_first("reason 0"));
        let mut seen = BTreeMap::new();
        assert_eq!(drops.news(&mut seen).len(), REASONS_MAX + 1);
        assert!(drops.news(&mut seen).is_empty());
        drops.count("reason 1");
        assert_eq!(drops.news(&mut seen), ["reason 1: 1 dropped, 2 in all"]);
    }
}

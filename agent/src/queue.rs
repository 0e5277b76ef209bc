//! The one queue in front of the core. What the outside sends is bounded in number, in bytes and per source, and what
//! does not fit is dropped and counted: a flooding peer can neither stop the core nor crowd out the others. What the
//! core itself asked for (results, answers, durability) always fits, because the core bounds how much it asks for.

use merganser_protocol::agent::io::{Input, QueryId};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::Loss;
use std::collections::{BTreeMap, VecDeque};
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;
use tokio::sync::mpsc;

/// Bytes of waiting outside input at most.
pub const QUEUED_BYTES_MAX: usize = 32 << 20;
/// Bytes of waiting answers to questions of ours at most: of the longest that a peer gives, 64 KiB, more than a hundred.
/// Anyone may answer, so they are bounded.
pub const ANSWERS_BYTES_MAX: usize = 8 << 20;
/// A single source may fill this part of the queue: one in so many.
const SHARE: usize = 4;
/// Time between two looks for room in bytes.
const FEED_WAIT: Duration = Duration::from_millis(2);
/// Different reasons counted at most; the rest counts as one.
const REASONS_MAX: usize = 64;
/// Counters that name a robot at most. Whoever invents names cannot fill the counters of other reasons.
const NAMES_MAX: usize = 64;

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
    inside: mpsc::UnboundedSender<(Input, Option<Room>)>,
    load: Arc<Load>,
    /// Bytes of answers that wait.
    answers: Arc<AtomicUsize>,
    /// What was dropped, and why.
    pub drops: Arc<Drops>,
    /// Keyframes that were lost since the last one that was taken and that the core was not told of.
    lost: Arc<Mutex<BTreeMap<Loss, u64>>>,
}

/// The receiving end; the driver's.
#[derive(Debug)]
pub struct Outbox {
    outside: mpsc::Receiver<Queued>,
    inside: mpsc::UnboundedReceiver<(Input, Option<Room>)>,
    /// What comes before the input that was received last, then that input.
    next: VecDeque<Input>,
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
    /// Keyframes that were lost before it.
    lost: BTreeMap<Loss, u64>,
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

/// Room that a waiting answer takes until it is taken.
#[derive(Debug)]
struct Room {
    bytes: usize,
    of: Arc<AtomicUsize>,
}

impl Drop for Room {
    fn drop(&mut self) {
        self.of.fetch_sub(self.bytes, Relaxed);
    }
}

/// A queue for `length` outside inputs.
pub fn queue(length: usize) -> (Inbox, Outbox) {
    let (outside, outside_end) = mpsc::channel(length.max(1));
    let (inside, inside_end) = mpsc::unbounded_channel();
    let load = Load { length_max: length, bytes: AtomicUsize::new(0), by_source: Mutex::default() };
    let (load, answers) = (Arc::new(load), Arc::default());
    let inbox = Inbox { outside, inside, load, answers, drops: Arc::default(), lost: Arc::default() };
    (inbox, Outbox { outside: outside_end, inside: inside_end, next: VecDeque::new() })
}

impl Inbox {
    /// Puts an outside input into the queue, or drops and counts it. Returns whether it was taken. Never blocks. Of
    /// keyframes that are dropped the core hears before the next one.
    pub fn offer(&self, source: Source, input: Input) -> bool {
        let is_keyframe = matches!(input, Input::Keyframe(_));
        let lost = if is_keyframe { self.take_lost() } else { BTreeMap::new() };
        let label = source.label().to_owned();
        let Err(lost) = self.put(source, input, lost) else { return true };
        lost.into_iter().for_each(|(why, count)| self.owe(why, count));
        if is_keyframe {
            self.owe(Loss::QueueFull, 1);
        }
        self.drops.count_named(format!("queue full: {label}"), "queue full: others");
        false
    }

    /// A keyframe of the robot's own was lost before it could become an input: the core hears of it in its place among
    /// the others, at the latest with the next one. Never blocks, never fails.
    pub fn lose(&self, why: Loss) {
        self.owe(why, 1);
        let lost = self.take_lost();
        let mut lost = lost.into_iter();
        while let Some((why, count)) = lost.next() {
            if self.put(Source::Own, Input::KeyframesLost { why, count }, BTreeMap::new()).is_err() {
                return std::iter::once((why, count)).chain(lost).for_each(|(why, count)| self.owe(why, count));
            }
        }
    }

    fn owe(&self, why: Loss, count: u64) {
        *self.lost.lock().unwrap_or_else(PoisonError::into_inner).entry(why).or_default() += count;
    }

    fn take_lost(&self) -> BTreeMap<Loss, u64> {
        std::mem::take(&mut *self.lost.lock().unwrap_or_else(PoisonError::into_inner))
    }

    /// Puts an input behind what was lost before it; gives that back if there is no room.
    fn put(&self, source: Source, input: Input, lost: BTreeMap<Loss, u64>) -> Result<(), BTreeMap<Loss, u64>> {
        let bytes = weight(&input);
        let of_source = self.load.of_source(&source);
        let load = self.load.clone();
        let mut queued = Queued { input: Some(input), lost, bytes, load, of_source: of_source.clone() };
        let before = of_source.fetch_add(1, Relaxed);
        let bytes_before = self.load.bytes.fetch_add(bytes, Relaxed);
        let share_max = if source == Source::Own { self.load.length_max } else { self.load.length_max / SHARE };
        let fits = before < share_max.max(1) && bytes_before + bytes <= QUEUED_BYTES_MAX;
        if !fits {
            return Err(std::mem::take(&mut queued.lost));
        }
        self.outside.try_send(queued).map_err(|refused| std::mem::take(&mut refused.into_inner().lost))
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
        let lost = if matches!(input, Input::Keyframe(_)) { self.take_lost() } else { BTreeMap::new() };
        let queued = Queued { input: Some(input), lost, bytes, load: self.load.clone(), of_source };
        self.outside.send(queued).await.is_ok()
    }

    /// Puts in what the core waits for: the result of something it asked for.
    pub fn deliver(&self, input: Input) {
        let _ = self.inside.send((input, None)); // fails only when the driver has ended
    }

    /// Puts in an answer to a question of ours, in order with [`Inbox::deliver`], or drops and counts it.
    pub fn answer(&self, query: QueryId, bytes: Vec<u8>) {
        let room = Room { bytes: bytes.len() + 128, of: self.answers.clone() };
        if self.answers.fetch_add(room.bytes, Relaxed) + room.bytes > ANSWERS_BYTES_MAX {
            return self.drops.count("queue full: answers");
        }
        let _ = self.inside.send((Input::Answered { query, bytes: Some(bytes) }, Some(room)));
    }
}

impl Outbox {
    /// The next input, what the core waits for first; `None` when all senders are gone.
    pub async fn next(&mut self) -> Option<Input> {
        // Not within `select!`, which takes from every branch before it chooses one: what it took from here would be gone.
        if let Ok((input, _)) = self.inside.try_recv() {
            return Some(input);
        }
        if let Some(input) = self.next.pop_front() {
            return Some(input);
        }
        tokio::select! {
            biased;
            Some((input, _)) = self.inside.recv() => Some(input),
            Some(mut queued) = self.outside.recv() => {
                let lost = std::mem::take(&mut queued.lost).into_iter();
                self.next.extend(lost.map(|(why, count)| Input::KeyframesLost { why, count }));
                self.next.extend(queued.input.take());
                self.next.pop_front()
            }
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
pub struct Drops {
    reasons: Mutex<Counters>,
    named: Mutex<Counters>,
}

type Counters = BTreeMap<String, u64>;

impl Drops {
    /// Counts one.
    pub fn count(&self, reason: impl Into<String>) {
        self.count_first(reason);
    }

    /// Counts one; whether it is the first that is counted for this reason.
    pub fn count_first(&self, reason: impl Into<String>) -> bool {
        count(&self.reasons, reason.into(), 1, REASONS_MAX, "other")
    }

    /// Counts one under a text that names a robot, or, if too many are named already, under `others`.
    pub fn count_named(&self, reason: String, others: &str) {
        self.count_named_times(reason, 1, others);
    }

    /// Counts as many; whether they are the first that are counted there.
    pub fn count_named_times(&self, reason: String, times: u64, others: &str) -> bool {
        count(&self.named, reason, times, NAMES_MAX, others)
    }

    /// All counters.
    pub fn counts(&self) -> BTreeMap<String, u64> {
        let of = |counters: &Mutex<Counters>| counters.lock().unwrap_or_else(PoisonError::into_inner).clone();
        let mut all = of(&self.named);
        all.append(&mut of(&self.reasons));
        all
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

fn count(counters: &Mutex<Counters>, mut reason: String, times: u64, limit: usize, rest: &str) -> bool {
    let mut counters = counters.lock().unwrap_or_else(PoisonError::into_inner);
    if counters.len() >= limit && !counters.contains_key(&reason) {
        reason = rest.into();
    }
    let count = counters.entry(reason).or_default();
    let is_first = *count == 0;
    *count = count.saturating_add(times);
    is_first
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::agent::io::{Channel, Command};
    use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
    use merganser_protocol::ids::RobotId;
    use merganser_protocol::submap::{CovarianceOf, Keyframe};
    use merganser_protocol::time::Stamp;

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
    async fn answers_are_bounded_and_their_end_is_not() {
        let (inbox, mut outbox) = queue(16);
        let half = ANSWERS_BYTES_MAX / 2 - 128;
        let told = |number| Input::Answered { query: QueryId(number), bytes: None };
        for (number, len) in [(1, half), (2, half), (3, 0)] {
            inbox.answer(QueryId(number), vec![0; len]);
            inbox.deliver(told(number));
        }
        assert_eq!(inbox.drops.counts()["queue full: answers"], 1);
        let mut order = Vec::new();
        for _ in 0..5 {
            let Some(Input::Answered { query, bytes }) = outbox.next().await else { panic!() };
            order.push((query.0, bytes.is_some()));
        }
        assert_eq!(order, [(1, true), (1, false), (2, true), (2, false), (3, false)]);
        inbox.answer(QueryId(4), vec![0; ANSWERS_BYTES_MAX - 128]);
        assert!(matches!(outbox.next().await, Some(Input::Answered { bytes: Some(_), .. })), "there is room again");
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

    fn keyframe(stamp: i64) -> Input {
        let covariance = Covariance::from_sigmas([0.01; 6]).unwrap();
        Input::Keyframe(Keyframe {
            stamp: Stamp(stamp),
            session: None,
            pose: PoseWithCovariance { pose: Se3::identity(), covariance },
            covariance_of: CovarianceOf::Motion,
            points: Vec::new(),
            marks: Vec::new(),
            place: None,
            up: None,
        })
    }

    /// A loss and the keyframe behind it come out of the queue together; what the core waits for may come between them.
    #[tokio::test]
    async fn nothing_is_lost_where_the_core_is_answered_between_a_loss_and_its_keyframe() {
        let (inbox, mut outbox) = queue(2);
        assert!(inbox.offer(Source::Own, keyframe(1)) && inbox.offer(Source::Own, keyframe(2)));
        inbox.lose(Loss::Unreadable); // there is no room to say so
        assert!(matches!(outbox.next().await, Some(Input::Keyframe(_))));
        assert!(inbox.offer(Source::Own, keyframe(3)));
        assert!(matches!(outbox.next().await, Some(Input::Keyframe(_))));
        assert!(matches!(outbox.next().await, Some(Input::KeyframesLost { why: Loss::Unreadable, count: 1 })));
        inbox.deliver(Input::Timeout);
        assert!(matches!(outbox.next().await, Some(Input::Timeout)));
        let third = tokio::time::timeout(Duration::from_secs(5), outbox.next()).await;
        assert!(matches!(third, Ok(Some(Input::Keyframe(keyframe))) if keyframe.stamp == Stamp(3)));
    }

    /// A loss is told where it happened, be the queue full or not.
    #[tokio::test]
    async fn a_lost_keyframe_is_told_in_its_place_among_the_others() {
        let (inbox, mut outbox) = queue(2);
        let offered = [1, 2, 3, 4].map(|stamp| inbox.offer(Source::Own, keyframe(stamp)));
        assert_eq!(offered, [true, true, false, false]);
        inbox.lose(Loss::Unreadable); // there is no room to say so
        let mut told = Vec::new();
        let mut next = async |told: &mut Vec<String>| match outbox.next().await.unwrap() {
            Input::Keyframe(keyframe) => told.push(keyframe.stamp.0.to_string()),
            Input::KeyframesLost { why, count } => told.push(format!("{count} {}", why.name())),
            other => panic!("{other:?}"),
        };
        next(&mut told).await;
        assert!(inbox.offer(Source::Own, keyframe(5)));
        next(&mut told).await;
        inbox.lose(Loss::TooLarge);
        for _ in 0..3 {
            next(&mut told).await;
        }
        assert!(inbox.offer(Source::Own, keyframe(6)));
        for _ in 0..2 {
            next(&mut told).await;
        }
        assert_eq!(told, ["1", "2", "1 unreadable", "2 queue_full", "5", "1 too_large", "6"]);
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
        let named = Drops::default();
        (0..1000).for_each(|i| named.count_named(format!("ignored: {i}"), "ignored: others"));
        assert_eq!(named.counts().len(), NAMES_MAX + 1);
        assert_eq!(named.counts()["ignored: others"], 1000 - NAMES_MAX as u64);
        assert!(named.count_first("a reason of its own") && named.counts()["a reason of its own"] == 1);
        let mut seen = BTreeMap::new();
        assert_eq!(drops.news(&mut seen).len(), REASONS_MAX + 1);
        assert!(drops.news(&mut seen).is_empty());
        drops.count("reason 1");
        assert_eq!(drops.news(&mut seen), ["reason 1: 1 dropped, 2 in all"]);
    }
}

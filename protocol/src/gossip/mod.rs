//! How sets of facts become equal, at the lowest cost known (DESIGN §4): who announces when, who asks whom, and for
//! what. Pure decisions over a [`Replica`]; the agent carries them out, and the simulator measures them by the
//! thousand.
//!
//! - **Announce** the root hash: 18 bytes or so. While nothing changes, the pauses double and a robot that has heard
//!   enough equal roots stays silent (Trickle, RFC 6206). News are announced the sooner the more of them there are.
//! - **Pull**: a neighbour with another root is asked for what we lack, by have-vector; one question at a time, to the
//!   neighbour that promises most, so that nothing is fetched twice. Small gains wait for more, large ones do not, nor
//!   what follows a large one: after a partition the last few facts are as welcome as the first many. A question that
//!   is overdue keeps nobody back: others are asked, then the same neighbour again, and what the lost one cost is given
//!   back. Questions that bring nothing, because what they ask for is on its way, become dearer, as long as news keep
//!   coming. When a question is overdue follows from the times of earlier answers (RFC 6298) and
//!   from how many facts are expected: for few the wait is short.
//! - **Answering teaches**: the asker's vector says what it has more than we do; those logs are asked for by name.
//! - An exchange that explained nothing is followed by one with hashes (a fork shows there at the latest), then by a
//!   pause that doubles until either side changes.
//! - **Nobody signs announcements**, and an outsider may make them in anyone's name. So a neighbour whose claims came to
//!   nothing several times in a row waits for the others, and whoever was not asked for a minute is asked in any case,
//!   less often as long as that brings nothing, and of more than eight one after the other. Claims thus delay, and starve
//!   nobody.
//! - What goes out is counted against a [`Budget`] by class; a neighbour whose link has no room says so, and is asked
//!   again later.

mod announce;
mod budget;
mod experience;
mod neighbour;
#[cfg(test)]
mod tests;
mod token_bucket;

use crate::ids::{FrameId, RobotId};
use crate::replica::{Have, Replica};
use crate::time::Instant;
use crate::wire::{HaveRoot, HaveVector};
pub use budget::{Budget, Class, PIECE_BYTES_MIN, REPAIR_BYTES_MIN, burst_bytes};
pub(crate) use token_bucket::Bucket;

use announce::Announce;
use core::time::Duration;
use experience::Experience;
use neighbour::{Neighbour, Stake};
use rand::Rng;
use rand::RngExt;
use std::collections::BTreeMap;
use token_bucket::TokenBucket;

/// Questions a second, as long as each brings little...
const QUESTIONS_PER_SEC: f64 = 0.8;
/// ...and how many of them may follow a pause at once.
const QUESTIONS_AT_ONCE: f64 = 6.0;
/// New facts in one answer that show that the sets were far apart: what is left to say should follow at once.
const FAR_APART: usize = 48;

/// What to do now.
#[derive(Clone, Debug, PartialEq)]
pub enum Step {
    /// Broadcast this.
    Announce(HaveRoot),
    /// Ask this neighbour what we lack; report with [`AntiEntropy::on_answer`], and when this was.
    Ask {
        /// Whom.
        peer: RobotId,
        /// What we hold.
        have: HaveVector,
    },
}

/// What became of a question.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// No answer came.
    Failed,
    /// The neighbour could not read the question.
    Refused,
    /// The neighbour has something for us, and no room on its link now.
    Postponed,
    /// Entries or proofs came.
    Got {
        /// Those that were new.
        new: usize,
        /// There is more to fetch.
        more: bool,
    },
}

/// The state of one robot's gossip about facts.
#[derive(Clone, Debug)]
pub struct AntiEntropy {
    me: RobotId,
    neighbours: BTreeMap<RobotId, Neighbour>,
    announce: Announce,
    bucket: TokenBucket,
    experience: Experience,
    answer_max: Duration,
    /// When a neighbour was last asked whatever it is said to hold.
    checked: Instant,
    wake: Instant,
}

impl AntiEntropy {
    /// Nobody is known. Announcements rest for `have_secs` at most, questions wait `answer_secs` at most.
    pub fn new(me: RobotId, have_secs: f64, answer_secs: f64, now: Instant) -> Self {
        Self {
            me,
            neighbours: BTreeMap::new(),
            announce: Announce::new(have_secs, now),
            bucket: TokenBucket::new(QUESTIONS_PER_SEC, QUESTIONS_AT_ONCE, now),
            experience: Experience::new(),
            answer_max: Duration::from_secs_f64(answer_secs),
            checked: Instant::ZERO,
            wake: now,
        }
    }

    /// The robots in reach.
    pub fn neighbours(&self) -> impl Iterator<Item = RobotId> + '_ {
        self.neighbours.keys().copied()
    }

    /// Whether a robot is in reach.
    pub fn is_neighbour(&self, robot: RobotId) -> bool {
        self.neighbours.contains_key(&robot)
    }

    /// When [`AntiEntropy::step`] wants to be called at the latest. Only `step` and the events below change it.
    pub fn timeout(&self) -> Instant {
        self.wake
    }

    /// A robot came into reach, or left. True if that is news.
    pub fn on_neighbour(&mut self, now: Instant, robot: RobotId, up: bool, rng: &mut impl Rng) -> bool {
        self.wake = now;
        if !up {
            return self.neighbours.remove(&robot).is_some();
        }
        if self.neighbours.contains_key(&robot) {
            return false;
        }
        self.neighbours.insert(robot, Neighbour::new(now));
        self.announce.hurry(now, rng.random_range(0.0..0.1));
        true
    }

    /// A neighbour announced its root.
    pub fn on_have(&mut self, now: Instant, replica: &Replica, from: RobotId, have: HaveRoot) {
        let Some(neighbour) = self.neighbours.get_mut(&from) else { return };
        self.wake = now;
        neighbour.heard(now, have);
        if have.root == replica.root() {
            neighbour.ahead.clear();
            self.announce.agrees();
        } else if have.count <= replica.count() {
            // It may lack something, and may not know.
            self.announce.differs(now, replica.root());
        }
    }

    /// A neighbour asks with this vector.
    pub fn on_asked(&mut self, now: Instant, replica: &Replica, have: &Have) {
        let Some(neighbour) = self.neighbours.get_mut(&have.asker) else { return };
        let ahead = replica.ahead_of_us(have);
        if !ahead.is_empty() {
            self.wake = now;
            neighbour.ahead = ahead;
        }
    }

    /// A question asked at `asked` was answered, or failed; what came was taken in.
    pub fn on_answer(&mut self, now: Instant, replica: &Replica, peer: RobotId, asked: Instant, answer: Answer) {
        let Some(neighbour) = self.neighbours.get_mut(&peer) else { return };
        self.wake = now;
        neighbour.answered(now, replica.root(), asked, answer);
        if let Answer::Got { new, .. } = answer {
            self.experience.answered(new > 0);
        }
        if matches!(answer, Answer::Got { new, .. } if new >= FAR_APART) {
            self.bucket.refill(now);
            self.announce.refill(now);
        }
    }

    /// The set of durable facts grew by `new`.
    pub fn on_news(&mut self, now: Instant, new: usize) {
        self.wake = now;
        self.experience.news(now);
        self.neighbours.values_mut().for_each(Neighbour::check_sooner);
        self.announce.news(now, new, self.neighbours.len());
    }

    /// The next thing to do, if any; call until `None`. While `busy` (entries on their way to the disk) nothing is
    /// asked: our vector is stale, and what it lacks would be fetched twice.
    pub fn step(&mut self, now: Instant, replica: &Replica, busy: bool, rng: &mut impl Rng) -> Option<Step> {
        if self.neighbours.is_empty() {
            self.wake = Instant::MAX; // Whoever comes is told.
            return None;
        }
        let root = replica.have_root();
        if self.announce.is_due(now, root.root, rng) {
            return Some(Step::Announce(root));
        }
        self.wake = self.announce.next();
        if busy {
            return None; // Durable entries are news, and wake us.
        }
        let waits = self.neighbours.values().filter_map(|n| n.keeps_others_until(now, self.answer_max)).min();
        if let Some(ends) = waits {
            self.wake = self.wake.min(ends);
            return None;
        }
        self.pull(now, replica, rng)
    }

    fn pull(&mut self, now: Instant, replica: &Replica, rng: &mut impl Rng) -> Option<Step> {
        let (root, count) = (replica.root(), replica.count());
        let strangers = self.neighbours.values().filter(|neighbour| neighbour.is_stranger()).count();
        let mut best: Vec<(RobotId, f64, u32)> = Vec::new();
        for (robot, neighbour) in &mut self.neighbours {
            if let Some(again) = neighbour.patience_ends(now, self.answer_max) {
                self.wake = self.wake.min(again); // It is not waited for, nor asked once more yet.
                continue;
            }
            if let Some(Stake { gain, copies }) = neighbour.lost() {
                self.bucket.give_back(now, gain, copies);
            }
            match neighbour.promises(now, replica, (root, count), self.me < *robot, strangers) {
                Ok(gain) => best.push((*robot, neighbour.retry_discount() * gain, neighbour.doubt())),
                Err(again) => self.wake = self.wake.min(again),
            }
        }
        if let Some(step) = self.check(now, replica) {
            return Some(step);
        }
        // Whose claims came to nothing may be somebody else: it waits for those that kept theirs.
        let doubt = best.iter().map(|(.., doubt)| *doubt).min().unwrap_or(0);
        best.retain(|(.., of)| *of == doubt);
        let claimed = best.iter().map(|(_, gain, _)| *gain).fold(0.0, f64::max);
        if claimed <= 0.0 {
            return None;
        }
        let most = if doubt > 0 { claimed.min(1.0) } else { claimed };
        let copies = self.experience.copies(now, most);
        let due = self.bucket.due(now, most, copies);
        if now < due {
            self.wake = self.wake.min(due);
            return None;
        }
        best.retain(|(_, gain, _)| 2.0 * gain >= claimed);
        let (peer, ..) = best[rng.random_range(0..best.len())];
        let neighbour = self.neighbours.get_mut(&peer)?;
        self.bucket.pay(now, most, copies);
        self.wake = now;
        let have = neighbour.question(now, self.me, replica, Stake { gain: most, copies });
        Some(Step::Ask { peer, have })
    }

    /// Asks who was not asked for long, whatever it is said to hold: nobody signs that, and who says it in another's
    /// name must not keep us from what that other holds.
    fn check(&mut self, now: Instant, replica: &Replica) -> Option<Step> {
        let waiting = self.neighbours.iter().filter(|(_, neighbour)| neighbour.asked.is_none());
        let due = |neighbour: &Neighbour| (neighbour.check_due(self.checked), neighbour.attended);
        let ((due, _), peer) = waiting.map(|(robot, neighbour)| (due(neighbour), *robot)).min()?;
        let due = due.max(self.bucket.due(now, 1.0, 1.0));
        if now < due {
            self.wake = self.wake.min(due);
            return None;
        }
        let neighbour = self.neighbours.get_mut(&peer)?;
        self.bucket.pay(now, 1.0, 1.0);
        (self.wake, self.checked) = (now, now);
        let have = neighbour.check(now, self.me, replica, Stake { gain: 1.0, copies: 1.0 });
        Some(Step::Ask { peer, have })
    }
}

/// Logs a neighbour is known to have more of, and up to where; `None`: it knows them as forked.
type Ahead = BTreeMap<FrameId, Option<u32>>;

//! What is remembered of one neighbour: its root, what it is known to have more of, and how our questions fared.

use super::{Ahead, Answer};
use crate::ids::{FrameId, RobotId};
use crate::replica::{Replica, VectorForm};
use crate::time::Instant;
use crate::wire::{HaveRoot, HaveVector};
use core::time::Duration;

/// A neighbour that has no more facts than we do is probably about to ask us: it has this long.
const AFTER_YOU: Duration = Duration::from_millis(500);
/// Share of what a neighbour learned from others that we are taken to lack.
const NEW_TO_US: f64 = 0.25;
/// Facts that all neighbours together are taken to have for us with whom we never compared.
const STRANGERS: f64 = 100.0;
/// First pause after an exchange that explained nothing...
const REST_MIN: Duration = Duration::from_secs(1);
/// ...and the longest.
const REST_MAX: Duration = Duration::from_secs(60);
/// First pause after a neighbour had no room on its link...
const LATER_MIN: Duration = Duration::from_millis(500);
/// ...and the longest.
const LATER_MAX: Duration = Duration::from_secs(4);
/// Round trip assumed before the first answer.
const ROUND_TRIP: Duration = Duration::from_millis(100);
/// A neighbour that has not answered in time may be asked again, with so much less hope: others come first.
const HOPE: f64 = 0.4;
/// From so many unanswered questions in a row on, each doubles the patience with the next...
const GIVEN_UP_FREE: u32 = 3;
/// ...so many times at most.
const GIVEN_UP_MAX: u32 = 4;
/// Questions in a row that may bring nothing. From then on a neighbour's claims weigh nothing: others come first, it is
/// asked at the price of a single fact, and waiting for it keeps nobody back for longer than usual.
const VAIN_FREE: u32 = 3;
/// A neighbour that was not asked for so long is asked, whatever it is said to hold: what announces itself in its name
/// may be somebody else...
pub(super) const CHECK_AFTER: Duration = Duration::from_secs(60);
/// ...and after checks that brought nothing after twice as long, up to this, until something new is heard.
pub(super) const CHECK_AFTER_MAX: Duration = Duration::from_secs(480);
/// Of many neighbours that are due to be checked one is, and the next after this share of its pause: what checks cost does
/// not grow with the swarm. Up to so many neighbours are each checked when they are due.
const CHECKED_IN_TURN: u32 = 8;
/// Shortest patience with a question: less, and answers that were only queued are fetched twice.
const PATIENCE_MIN: Duration = Duration::from_millis(300);
/// Patience with a question for each fact that is expected: of few facts little is lost if they are fetched twice.
const PATIENCE_PER_FACT: Duration = Duration::from_millis(10);

/// One neighbour.
#[derive(Clone, Debug)]
pub(super) struct Neighbour {
    announced: Option<(HaveRoot, Instant)>,
    /// Logs it has more of, as its own vector said.
    pub ahead: Ahead,
    pub(super) asked: Option<Question>,
    /// The next vector carries hashes.
    tagged: bool,
    /// It counts by another roster: list the robots.
    listed: bool,
    /// Where the next vector begins.
    window: Option<FrameId>,
    /// Its facts when we last asked it for everything.
    compared: u64,
    /// Its last answer was cut to its budget.
    more: bool,
    /// Smoothed time that answers take, and how much that varies (RFC 6298).
    round_trip: Duration,
    varies: Duration,
    /// Questions in a row that were given up.
    given_up: u32,
    rest: Option<Rest>,
    /// It had no room on its link: not asked before, and the pause that this was.
    later: Option<(Instant, Duration)>,
    /// Questions in a row that brought nothing.
    in_vain: u32,
    /// When it was last asked, or came into reach.
    pub(super) attended: Instant,
    /// How long after that it is asked in any case.
    check_after: Duration,
}

/// A question under way.
#[derive(Clone, Copy, Debug)]
pub(super) struct Question {
    at: Instant,
    named: bool,
    stake: Stake,
    /// Whether it was already taken for lost.
    lost: bool,
    /// Where its vector began.
    window: Option<FrameId>,
}

/// What a question may bring, and what it cost.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Stake {
    /// Facts that it may bring.
    pub gain: f64,
    /// How many times the usual it cost.
    pub copies: f64,
}

/// Nothing is to be gained while both sides stay as they are.
#[derive(Clone, Copy, Debug)]
struct Rest {
    theirs: Option<[u8; 8]>,
    ours: [u8; 8],
    until: Instant,
    pause: Duration,
}

impl Neighbour {
    /// One that came into reach now.
    pub fn new(now: Instant) -> Self {
        Self {
            announced: None,
            ahead: Ahead::new(),
            asked: None,
            tagged: true,
            listed: false,
            window: None,
            compared: 0,
            more: false,
            round_trip: ROUND_TRIP,
            varies: ROUND_TRIP,
            given_up: 0,
            rest: None,
            later: None,
            in_vain: 0,
            attended: now,
            check_after: CHECK_AFTER,
        }
    }

    /// When it is asked in any case, if the last check of anybody was `checked`.
    pub fn check_due(&self, checked: Instant) -> Instant {
        self.attended.after(self.check_after).max(checked.after(self.check_after / CHECKED_IN_TURN))
    }

    /// Something is new here: checks may bring something again.
    pub fn check_sooner(&mut self) {
        self.check_after = CHECK_AFTER;
    }

    /// How much its claims are to be doubted: of two neighbours that promise something the one with less comes first.
    /// 0 for whoever brought something with one of the last questions.
    pub fn doubt(&self) -> u32 {
        self.in_vain.saturating_sub(VAIN_FREE - 1)
    }

    fn brought(&mut self, new: usize) {
        self.in_vain = if new > 0 { 0 } else { self.in_vain.saturating_add(1) };
    }

    /// Whether we never compared all that we hold.
    pub fn is_stranger(&self) -> bool {
        self.compared == 0
    }

    pub fn heard(&mut self, now: Instant, have: HaveRoot) {
        self.announced = Some((have, now));
    }

    /// Until when a question under way keeps others back; `None` if there is none, or it is overdue.
    pub fn keeps_others_until(&self, now: Instant, longest: Duration) -> Option<Instant> {
        if self.doubt() == 0 {
            return self.patience_ends(now, longest);
        }
        let question = self.asked?;
        Some(question.at.after(self.patience(&question, longest))).filter(|ends| now < *ends)
    }

    /// Until when a question under way is not asked again; `None` if there is none, or it is overdue.
    pub fn patience_ends(&self, now: Instant, longest: Duration) -> Option<Instant> {
        let question = self.asked?;
        let backoff = 1 << self.given_up.saturating_sub(GIVEN_UP_FREE).min(GIVEN_UP_MAX);
        let patience = self.patience(&question, longest).saturating_mul(backoff).min(longest.max(PATIENCE_MIN));
        Some(question.at.after(patience)).filter(|ends| now < *ends)
    }

    /// How long an answer may take that is not lost.
    fn patience(&self, question: &Question, longest: Duration) -> Duration {
        let usual = (self.round_trip + 4 * self.varies).max(PATIENCE_MIN);
        let worth = PATIENCE_MIN + PATIENCE_PER_FACT.mul_f64(question.stake.gain.min(1e6));
        usual.min(worth).min(longest.max(PATIENCE_MIN))
    }

    /// Called when no question keeps others back: what was at stake with one that is overdue, once.
    pub fn lost(&mut self) -> Option<Stake> {
        let question = self.asked.as_mut().filter(|question| !question.lost)?;
        question.lost = true;
        self.more = false; // Somebody else may do better.
        Some(question.stake)
    }

    /// Share of what it promises that may be counted on. Called when no question keeps others back: one that is under
    /// way is overdue.
    pub fn retry_discount(&self) -> f64 {
        if self.asked.is_some() { HOPE } else { 1.0 }
    }

    /// How many facts a question may bring; or when to think about it again. Our root and count; `first`: where both
    /// may ask, it is we who do; `strangers`: neighbours we never compared with.
    pub fn promises(
        &mut self,
        now: Instant,
        replica: &Replica,
        (root, count): ([u8; 8], u64),
        first: bool,
        strangers: usize,
    ) -> Result<f64, Instant> {
        if let Some((until, _)) = self.later.filter(|(until, _)| now < *until) {
            return Err(until);
        }
        let theirs = self.announced.map(|(have, _)| have.root);
        match self.rest {
            Some(rest) if rest.theirs != theirs || rest.ours != root => self.rest = None,
            Some(rest) if now < rest.until => return Err(rest.until),
            _ => {}
        }
        let named: u64 = self
            .ahead
            .iter()
            .map(|(frame, len)| len.map_or(1, |len| u64::from(len.saturating_sub(replica.next_seq(*frame)))))
            .sum();
        if self.more {
            return Ok(f64::from(u32::MAX));
        }
        if named > 0 && !self.named(replica).is_empty() {
            return Ok(named as f64);
        }
        let Some((have, at)) = self.announced.filter(|(have, _)| have.root != root) else { return Err(Instant::MAX) };
        if self.is_stranger() {
            return Ok((STRANGERS / strangers as f64).max(1.0)); // Years may lie between us.
        }
        if have.count > count {
            return Ok((have.count - count) as f64);
        }
        // Of two that hold as many facts, one asks, and what it says teaches the other.
        let due = if have.count == count && first { at } else { at.after(AFTER_YOU) };
        if now < due {
            return Err(due);
        }
        // How much of what it learned since we last compared is new to us is not known.
        Ok((have.count.saturating_sub(self.compared) as f64 * NEW_TO_US).max(1.0))
    }

    /// The vector to ask it with, to see whether it has anything: of all logs, without hashes, which cost four times as
    /// much and show forks alone.
    pub fn check(&mut self, now: Instant, me: RobotId, replica: &Replica, stake: Stake) -> HaveVector {
        let tagged = core::mem::replace(&mut self.tagged, false);
        let have = self.question(now, me, replica, stake);
        self.tagged = tagged;
        have
    }

    /// The vector to ask it with: of the logs it is known to have more of, else of all.
    pub fn question(&mut self, now: Instant, me: RobotId, replica: &Replica, stake: Stake) -> HaveVector {
        let named = self.named(replica);
        if self.asked.is_some() {
            self.given_up = self.given_up.saturating_add(1);
            self.brought(0);
        }
        self.attended = now;
        self.asked = Some(Question { at: now, named: !named.is_empty(), stake, lost: false, window: self.window });
        if !named.is_empty() {
            return replica.have_named(me, self.listed, named);
        }
        let form = VectorForm { tagged: self.tagged, listed: self.listed, after: self.window };
        let have = replica.have(me, form);
        self.window = have.until;
        have
    }

    /// A question of ours, asked at `asked`, was answered or failed; `root` is ours now.
    pub fn answered(&mut self, now: Instant, root: [u8; 8], asked: Instant, answer: Answer) {
        if answer != Answer::Failed {
            self.given_up = 0;
        }
        if let Answer::Got { new: 1.., .. } = answer {
            self.brought(1);
            self.check_sooner();
        }
        let Some(question) = self.asked.take_if(|question| question.at == asked) else {
            if matches!(answer, Answer::Got { .. }) {
                self.took(now.since(asked)); // Given up too early: have more patience.
            }
            return;
        };
        if !matches!(answer, Answer::Got { new: 1.., .. } | Answer::Postponed) {
            self.brought(0);
            self.check_after = (2 * self.check_after).min(CHECK_AFTER_MAX);
        }
        let (new, more) = match answer {
            Answer::Failed => {
                self.more = false; // Somebody else may do better. How long answers take, those that come tell.
                return;
            }
            Answer::Refused => {
                let futile = core::mem::replace(&mut self.listed, true);
                return self.rest(now, root, futile);
            }
            Answer::Postponed => {
                // All is as it was before the question: what was to be resumed still is.
                let pause = self.later.map_or(LATER_MIN, |(_, pause)| (2 * pause).min(LATER_MAX));
                self.later = Some((now.after(pause), pause));
                self.window = question.window;
                return;
            }
            Answer::Got { new, more } => (new, more),
        };
        self.later = None;
        self.took(now.since(question.at));
        self.more = more && new > 0;
        if self.more {
            return;
        }
        self.ahead.clear();
        if question.named {
            return self.rest(now, root, new == 0);
        }
        if self.window.is_none() {
            self.compared = self.announced.map_or(0, |(have, _)| have.count);
            // What is still different after this is what they lack, or a fork, which only hashes show.
            let tagged = core::mem::replace(&mut self.tagged, new == 0);
            self.rest(now, root, new == 0 && tagged);
        }
    }

    fn took(&mut self, time: Duration) {
        self.varies = (3 * self.varies + time.abs_diff(self.round_trip)) / 4;
        self.round_trip = (7 * self.round_trip + time) / 8;
    }

    /// Logs worth asking for by name.
    fn named(&self, replica: &Replica) -> Vec<FrameId> {
        let lacking = |(frame, len): (&FrameId, &Option<u32>)| {
            let wanted = !replica.is_quarantined(*frame) && len.is_none_or(|len| replica.next_seq(*frame) < len);
            wanted.then_some(*frame)
        };
        self.ahead.iter().filter_map(lacking).collect()
    }

    fn rest(&mut self, now: Instant, ours: [u8; 8], futile: bool) {
        let theirs = self.announced.map(|(have, _)| have.root);
        let pause = match self.rest {
            Some(rest) if futile => (2 * rest.pause).min(REST_MAX),
            _ => REST_MIN,
        };
        self.rest = Some(Rest { theirs, ours, until: now.after(pause), pause });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::replica::testing::replica;
    use crate::wire::samples;

    fn usual(gain: f64) -> Stake {
        Stake { gain, copies: 1.0 }
    }

    #[test]
    fn patience_follows_the_answers_late_ones_too() {
        let (replica, me) = (replica(), samples::robot(0));
        let mut one = Neighbour::new(Instant::ZERO);
        let longest = Duration::from_secs(10);
        let patience = |one: &mut Neighbour, now: Instant, gain: f64| {
            one.question(now, me, &replica, usual(gain));
            one.patience_ends(now, longest).unwrap().since(now)
        };
        let mut now = Instant::ZERO;
        for _ in 0..50 {
            patience(&mut one, now, 1e3);
            one.answered(now.after(Duration::from_millis(50)), [0; 8], now, Answer::Got { new: 1, more: true });
            now = now.after(Duration::from_secs(1));
        }
        assert_eq!(patience(&mut one, now, 1e3), PATIENCE_MIN, "answers come fast");
        // The link becomes slow: each answer comes after the question was given up, and another was asked.
        let slow = Duration::from_secs(2);
        for _ in 0..50 {
            let asked = now;
            now = now.after(Duration::from_secs(3));
            patience(&mut one, now, 1e3);
            one.answered(asked.after(slow), [0; 8], asked, Answer::Got { new: 1, more: true });
        }
        let patient = patience(&mut one, now, 1e3);
        assert!(patient >= slow && patient < 2 * slow, "{patient:?}");
        assert!(patience(&mut one, now, 2.0) < 2 * PATIENCE_MIN, "nobody waits long for little");
    }

    #[test]
    fn who_never_answers_is_asked_ever_more_rarely() {
        let (replica, me) = (replica(), samples::robot(0));
        let ours = (replica.root(), replica.count());
        let mut one = Neighbour::new(Instant::ZERO);
        one.heard(Instant::ZERO, HaveRoot { root: [1; 8], count: 5_000 });
        let longest = Duration::from_secs(6);
        let mut now = Instant::ZERO;
        let mut pauses = Vec::new();
        for _ in 0..9 {
            let hope = one.promises(now, &replica, ours, true, 1).unwrap();
            one.question(now, me, &replica, usual(hope));
            let ends = one.patience_ends(now, longest).unwrap();
            assert_eq!(one.patience_ends(ends, longest), None);
            assert!(one.lost().is_some() && one.lost().is_none(), "given back once");
            assert!(
                one.promises(ends, &replica, ours, true, 1).is_ok() && one.retry_discount() < 0.5,
                "others come first"
            );
            pauses.push(ends.since(now));
            now = ends;
        }
        assert!(pauses.is_sorted() && pauses[3] == pauses[0], "{pauses:?}");
        assert_eq!(pauses[8], longest);
    }

    #[test]
    fn who_has_no_room_is_asked_the_same_again_after_a_pause() {
        let (replica, me) = (replica(), samples::robot(0));
        let ours = (replica.root(), replica.count());
        let mut one = Neighbour::new(Instant::ZERO);
        one.heard(Instant::ZERO, HaveRoot { root: [1; 8], count: 50 });
        one.question(Instant::ZERO, me, &replica, usual(1.0));
        one.answered(Instant::ZERO, ours.0, Instant::ZERO, Answer::Got { new: 5, more: true });
        one.window = Some(samples::frame(0, 1));
        let mut now = Instant::ZERO;
        let mut pause = LATER_MIN;
        for _ in 0..8 {
            assert_eq!(one.promises(now, &replica, ours, true, 1), Ok(f64::from(u32::MAX)), "a tail to resume");
            let before = one.window;
            one.question(now, me, &replica, usual(1.0));
            one.answered(now, ours.0, now, Answer::Postponed);
            assert_eq!(one.window, before);
            let again = now.after(pause);
            let soon = now.after(pause - Duration::from_millis(1));
            assert_eq!(one.promises(soon, &replica, ours, true, 1), Err(again));
            now = again;
            pause = (2 * pause).min(LATER_MAX);
        }
        one.question(now, me, &replica, usual(1.0));
        one.answered(now, ours.0, now, Answer::Got { new: 1, more: true });
        one.question(now, me, &replica, usual(1.0));
        one.answered(now, ours.0, now, Answer::Postponed);
        assert_eq!(one.promises(now, &replica, ours, true, 1), Err(now.after(LATER_MIN)), "it had room meanwhile");
    }
}

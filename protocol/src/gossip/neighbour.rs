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
/// Shortest patience with a question.
const PATIENCE_MIN: Duration = Duration::from_millis(200);

/// One neighbour.
#[derive(Clone, Debug)]
pub(super) struct Neighbour {
    announced: Option<(HaveRoot, Instant)>,
    /// Logs it has more of, as its own vector said.
    pub ahead: Ahead,
    asked: Option<Question>,
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
    round_trip: Duration,
    rest: Option<Rest>,
    /// It had no room on its link: not asked before, and the pause that this was.
    later: Option<(Instant, Duration)>,
}

/// A question under way.
#[derive(Clone, Copy, Debug)]
struct Question {
    at: Instant,
    named: bool,
    /// Where its vector began.
    window: Option<FrameId>,
}

/// Nothing is to be gained while both sides stay as they are.
#[derive(Clone, Copy, Debug)]
struct Rest {
    theirs: Option<[u8; 8]>,
    ours: [u8; 8],
    until: Instant,
    pause: Duration,
}

impl Default for Neighbour {
    fn default() -> Self {
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
            rest: None,
            later: None,
        }
    }
}

impl Neighbour {
    /// Whether we never compared all that we hold.
    pub fn is_stranger(&self) -> bool {
        self.compared == 0
    }

    pub fn heard(&mut self, now: Instant, have: HaveRoot) {
        self.announced = Some((have, now));
    }

    /// Until when a question under way keeps others back; `None` if there is none, or it is overdue.
    pub fn patience_ends(&self, now: Instant, longest: Duration) -> Option<Instant> {
        let patience = (3 * self.round_trip).clamp(PATIENCE_MIN, longest.max(PATIENCE_MIN));
        self.asked.map(|question| question.at.after(patience)).filter(|ends| now < *ends)
    }

    /// How many facts a question may bring; or when to think about it again. Our root and count; `first`: where both may
    /// ask, it is we who do; `strangers`: neighbours we never compared with.
    pub fn promises(
        &mut self,
        now: Instant,
        replica: &Replica,
        (root, count): ([u8; 8], u64),
        first: bool,
        strangers: usize,
    ) -> Result<f64, Instant> {
        if self.asked.is_some() {
            return Err(Instant::MAX); // Its answer, or its failure, wakes us.
        }
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

    /// The vector to ask it with: of the logs it is known to have more of, else of all.
    pub fn question(&mut self, now: Instant, me: RobotId, replica: &Replica) -> HaveVector {
        let named = self.named(replica);
        self.asked = Some(Question { at: now, named: !named.is_empty(), window: self.window });
        if !named.is_empty() {
            return replica.have_named(me, self.listed, named);
        }
        let form = VectorForm { tagged: self.tagged, listed: self.listed, after: self.window };
        let have = replica.have(me, form);
        self.window = have.until;
        have
    }

    /// The question under way was answered or failed; `root` is ours now.
    pub fn answered(&mut self, now: Instant, root: [u8; 8], answer: Answer) {
        let Some(question) = self.asked.take() else { return };
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
        self.round_trip = (3 * self.round_trip + now.since(question.at)) / 4;
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

    #[test]
    fn who_has_no_room_is_asked_the_same_again_after_a_pause() {
        let (replica, me) = (replica(), samples::robot(0));
        let ours = (replica.root(), replica.count());
        let mut one = Neighbour::default();
        one.heard(Instant::ZERO, HaveRoot { root: [1; 8], count: 50 });
        one.question(Instant::ZERO, me, &replica);
        one.answered(Instant::ZERO, ours.0, Answer::Got { new: 5, more: true });
        one.window = Some(samples::frame(0, 1));
        let mut now = Instant::ZERO;
        let mut pause = LATER_MIN;
        for _ in 0..8 {
            assert_eq!(one.promises(now, &replica, ours, true, 1), Ok(f64::from(u32::MAX)), "a tail to resume");
            let before = one.window;
            one.question(now, me, &replica);
            one.answered(now, ours.0, Answer::Postponed);
            assert_eq!(one.window, before);
            let again = now.after(pause);
            let soon = now.after(pause - Duration::from_millis(1));
            assert_eq!(one.promises(soon, &replica, ours, true, 1), Err(again));
            now = again;
            pause = (2 * pause).min(LATER_MAX);
        }
        one.question(now, me, &replica);
        one.answered(now, ours.0, Answer::Got { new: 1, more: true });
        one.question(now, me, &replica);
        one.answered(now, ours.0, Answer::Postponed);
        assert_eq!(one.promises(now, &replica, ours, true, 1), Err(now.after(LATER_MIN)), "it had room meanwhile");
    }
}

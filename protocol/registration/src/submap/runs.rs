//! Runs of the front end: the one that makes keyframes now, and those that are over.

use super::KeyframeError;
use std::collections::VecDeque;

/// Runs of the front end remembered as over: a keyframe of one is refused and begins no epoch.
pub const SESSIONS_OVER_MAX: usize = 8;

/// What a front end called its runs, as far as it said.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Runs {
    now: Option<u64>,
    over: VecDeque<u64>,
}

impl Runs {
    /// As they were remembered: the run of this frame, and those that are over, the last of them last. More than
    /// [`SESSIONS_OVER_MAX`] are not kept; a run that goes on is not over.
    pub fn remembered(now: Option<u64>, over: impl IntoIterator<Item = u64>) -> Self {
        let mut runs = Self { now, over: VecDeque::new() };
        over.into_iter().filter(|session| Some(*session) != now).for_each(|session| runs.end(session));
        runs
    }

    /// That of this frame, if it is known.
    pub fn now(&self) -> Option<u64> {
        self.now
    }

    /// Those that are over, the last of them last.
    pub fn over(&self) -> impl Iterator<Item = u64> + '_ {
        self.over.iter().copied()
    }

    /// A keyframe of this frame was taken, of this run if it says.
    pub(super) fn take(&mut self, session: Option<u64>) {
        self.now = session.or(self.now);
    }

    /// At the start of a new frame: with `is_over` the run of the one before is over, too.
    pub(super) fn begun_anew(&self, is_over: bool) -> Self {
        let mut runs = Self { now: None, over: self.over.clone() };
        self.now.filter(|_| is_over).into_iter().for_each(|session| runs.end(session));
        runs
    }

    /// Refuses what is of a run that is over.
    pub(super) fn check(&self, session: Option<u64>) -> Result<(), KeyframeError> {
        match session.filter(|session| self.over.contains(session)) {
            Some(session) => Err(KeyframeError::SessionOver { session }),
            None => Ok(()),
        }
    }

    fn end(&mut self, session: u64) {
        self.over.push_back(session);
        if self.over.len() > SESSIONS_OVER_MAX {
            self.over.pop_front();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn as_many_runs_are_remembered_as_over_as_the_limit_says() {
        let max = SESSIONS_OVER_MAX as u64;
        let mut runs = Runs::default();
        for session in 1..=max + 1 {
            runs.take(Some(session));
            runs = runs.begun_anew(true);
        }
        assert!(runs.check(Some(1)).is_ok() && runs.check(Some(max + 2)).is_ok() && runs.check(None).is_ok());
        for session in 2..=max + 1 {
            assert_eq!(runs.check(Some(session)), Err(KeyframeError::SessionOver { session }));
        }
        assert_eq!(Runs::remembered(None, 1..=max).over().count(), SESSIONS_OVER_MAX);
        assert_eq!(Runs::remembered(None, 1..=max + 1), runs, "of a store that holds too many, the last count");
    }

    #[test]
    fn a_run_that_goes_on_is_not_over() {
        let mut runs = Runs::remembered(Some(5), [4, 5]);
        assert!(runs.check(Some(5)).is_ok() && runs.check(Some(4)).is_err());
        runs.take(None);
        assert_eq!((runs.now(), runs.begun_anew(false).now()), (Some(5), None));
        assert!(runs.begun_anew(false).check(Some(5)).is_ok() && runs.begun_anew(true).check(Some(5)).is_err());
    }
}

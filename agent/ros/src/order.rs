//! Stamps in the order in which they were received. They may come a little out of order; a clock that was set back
//! (a step of NTP, a bag that was played in a loop) would mix two ways of one robot, and is told.

use crate::limits::REORDER_NS_MAX;

/// What a stamp says of the clock.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    /// It goes on.
    On,
    /// It was set back, and has not come to where it was before; or it was then.
    Back,
    /// The stamp before was alone far ahead, and is to be left out; the newest but it is this one. The clock goes on.
    Alone(i64),
}

/// The newest stamp so far.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Order {
    newest: Option<i64>,
    /// The newest before the last one, if that lies far ahead of it.
    before: Option<i64>,
    is_back: bool,
}

impl Order {
    /// Takes the next stamp, ns.
    pub(crate) fn take(&mut self, stamp_ns: i64) -> Turn {
        let Some(newest) = self.newest else {
            self.newest = Some(stamp_ns);
            return Turn::On;
        };
        let far = |late: i64, early: i64| late.saturating_sub(early) > REORDER_NS_MAX;
        let jumped = self.before.take();
        if stamp_ns > newest {
            (self.newest, self.is_back) = (Some(stamp_ns), false);
            self.before = far(stamp_ns, newest).then_some(newest);
            return Turn::On;
        }
        if let Some(before) = jumped.filter(|before| far(newest, stamp_ns) && !far(*before, stamp_ns)) {
            self.newest = Some(before.max(stamp_ns));
            self.before = far(stamp_ns, before).then_some(before);
            return Turn::Alone(before);
        }
        self.is_back |= far(newest, stamp_ns);
        if self.is_back { Turn::Back } else { Turn::On }
    }
}

#[cfg(test)]
mod tests;

//! Whether a place repeats itself, as far as our own tries tell. What is ambiguous from one pair of submaps may look certain
//! from the next: of rooms that are all alike, where little of the next one is seen. So a robot vouches for no alignment
//! with a frame, its own or another's, while about as many of its tries with that frame found several poses as found one;
//! nor while its tries to close loops of its own do. The joint estimate asks the same of what both ends said
//! ([`AMBIGUOUS_SHARE`]).

use crate::estimate::AMBIGUOUS_SHARE;
use crate::ids::FrameId;
use std::collections::BTreeMap;

/// Frames that outcomes are kept of; of more, those that come last in order.
pub const FRAMES_MAX: usize = 4_096;

/// What tries found, by the other frame.
#[derive(Debug, Default)]
pub struct Outcomes {
    by_frame: BTreeMap<FrameId, Count>,
}

#[derive(Clone, Copy, Debug, Default)]
struct Count {
    one: u32,
    several: u32,
}

impl Outcomes {
    /// A try with this frame found one pose, or several.
    pub fn note(&mut self, frame: FrameId, found_one: bool) {
        if self.by_frame.len() == FRAMES_MAX && !self.by_frame.contains_key(&frame) {
            self.by_frame.pop_first();
        }
        let count = self.by_frame.entry(frame).or_default();
        let counted = if found_one { &mut count.one } else { &mut count.several };
        *counted = counted.saturating_add(1);
    }

    /// Whether several poses were found with this frame about as often as one.
    pub fn repeats(&self, frame: FrameId) -> bool {
        let Count { one, several } = self.by_frame.get(&frame).copied().unwrap_or_default();
        several > 0 && f64::from(several) >= AMBIGUOUS_SHARE * f64::from(one)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::RobotId;

    fn frame(epoch: u32) -> FrameId {
        FrameId { robot: RobotId([1; 8]), epoch }
    }

    #[test]
    fn several_poses_as_often_as_one_tell_of_a_place_that_repeats_itself() {
        let mut outcomes = Outcomes::default();
        assert!(!outcomes.repeats(frame(1)));
        outcomes.note(frame(1), false);
        outcomes.note(frame(1), true);
        assert!(outcomes.repeats(frame(1)) && !outcomes.repeats(frame(2)));
        outcomes.note(frame(1), true);
        assert!(!outcomes.repeats(frame(1)), "one of three");
        outcomes.note(frame(1), false);
        assert!(outcomes.repeats(frame(1)), "two of four");
    }

    #[test]
    fn outcomes_are_kept_of_so_many_frames() {
        let mut outcomes = Outcomes::default();
        let all = FRAMES_MAX as u32 + 1;
        (0..all).for_each(|epoch| outcomes.note(frame(epoch), false));
        assert_eq!(outcomes.by_frame.len(), FRAMES_MAX);
        assert!(!outcomes.repeats(frame(0)) && outcomes.repeats(frame(all - 1)));
    }
}

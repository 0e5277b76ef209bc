//! What became of pairs of submaps that were tried with others, for people who ask why nothing merges. Nothing is decided
//! by it.

use crate::ids::FrameId;
use crate::kinds::RefusalReason;
use std::collections::BTreeMap;

/// Pairs of frames told apart; further ones are not counted.
pub const TRIES_MAX: usize = 256;

/// What came of all pairs of submaps of two frames.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Outcomes {
    /// Pairs that aligned.
    pub found: u64,
    /// Pairs that did not, by reason.
    pub refused: BTreeMap<RefusalReason, u64>,
}

/// By our own frame and the other's.
#[derive(Clone, Debug, Default)]
pub struct Tries(BTreeMap<(FrameId, FrameId), Outcomes>);

impl Tries {
    /// Counts a try; one within our own frames is none.
    pub fn note(&mut self, own: FrameId, other: FrameId, refused: Option<RefusalReason>) {
        let is_known = self.0.contains_key(&(own, other));
        if own.robot == other.robot || (!is_known && self.0.len() == TRIES_MAX) {
            return;
        }
        let outcomes = self.0.entry((own, other)).or_default();
        match refused {
            Some(reason) => *outcomes.refused.entry(reason).or_default() += 1,
            None => outcomes.found += 1,
        }
    }

    /// All pairs of frames with a try.
    pub fn iter(&self) -> impl Iterator<Item = (FrameId, FrameId, &Outcomes)> {
        self.0.iter().map(|((own, other), outcomes)| (*own, *other, outcomes))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::RobotId;

    fn frame(robot: u8, epoch: u32) -> FrameId {
        FrameId { robot: RobotId([robot; 8]), epoch }
    }

    #[test]
    fn tries_are_counted_by_frame_and_reason_and_loops_are_not() {
        let mut tries = Tries::default();
        tries.note(frame(1, 1), frame(1, 2), Some(RefusalReason::TooFew));
        for _ in 0..3 {
            tries.note(frame(1, 1), frame(2, 1), Some(RefusalReason::NoConsensus));
        }
        tries.note(frame(1, 1), frame(2, 1), None);
        let refused = BTreeMap::from([(RefusalReason::NoConsensus, 3)]);
        let all: Vec<_> = tries.iter().collect();
        assert_eq!(all, [(frame(1, 1), frame(2, 1), &Outcomes { found: 1, refused })]);
    }

    #[test]
    fn as_many_frames_are_told_apart_as_the_limit_says() {
        let mut tries = Tries::default();
        let note = |tries: &mut Tries, epoch: usize| tries.note(frame(1, 1), frame(2, epoch as u32), None);
        for epoch in 0..TRIES_MAX {
            assert_eq!(tries.iter().count(), epoch);
            note(&mut tries, epoch);
        }
        note(&mut tries, TRIES_MAX);
        note(&mut tries, 0);
        assert_eq!(tries.iter().count(), TRIES_MAX);
        assert_eq!(tries.iter().map(|(_, _, outcomes)| outcomes.found).sum::<u64>(), TRIES_MAX as u64 + 1);
    }
}

//! How much has been stated already of two frames and of their submaps: when one alignment more would say too little.

use super::knowledge::Pair;
use super::negotiation::{ALIGNMENTS_PER_FRAME_PAIR, ALIGNMENTS_PER_SUBMAP};
use crate::ids::{FrameId, SubmapId};
use std::collections::BTreeMap;

/// Undisputed alignments.
#[derive(Default)]
pub(super) struct Stated {
    of_frames: BTreeMap<(FrameId, FrameId), usize>,
    /// Of one submap with another frame (or with its own).
    of_submap: BTreeMap<(SubmapId, FrameId), usize>,
}

impl Stated {
    /// Adds an alignment of `i` and `j`, in canonical order.
    pub(super) fn count(&mut self, (i, j): Pair) {
        *self.of_frames.entry((i.frame, j.frame)).or_default() += 1;
        *self.of_submap.entry((i, j.frame)).or_default() += 1;
        *self.of_submap.entry((j, i.frame)).or_default() += 1;
    }

    /// One more of this pair would say too little: the frames are tied well enough, or one of the submaps has said enough,
    /// which is never less than the `alignments_min` that it takes to merge.
    pub(super) fn is_enough(&self, (i, j): Pair, alignments_min: usize) -> bool {
        let of_submap = |id, other| self.of_submap.get(&(id, other)).copied().unwrap_or(0);
        let of_frames = self.of_frames.get(&(i.frame, j.frame)).copied().unwrap_or(0);
        let most = of_submap(i, j.frame).max(of_submap(j, i.frame));
        of_frames >= ALIGNMENTS_PER_FRAME_PAIR || most >= ALIGNMENTS_PER_SUBMAP.max(alignments_min)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ids::RobotId;

    fn submap(robot: u8, index: u32) -> SubmapId {
        SubmapId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 1 }, index }
    }

    #[test]
    fn a_submap_has_said_enough_of_one_frame_at_its_limit_and_not_before() {
        for alignments_min in [1, 3, 5] {
            let limit = ALIGNMENTS_PER_SUBMAP.max(alignments_min) as u32;
            let mut stated = Stated::default();
            for n in 0..limit {
                assert!(!stated.is_enough((submap(1, 0), submap(2, 99)), alignments_min), "{n}");
                stated.count((submap(1, 0), submap(2, n)));
            }
            assert!(stated.is_enough((submap(1, 0), submap(2, 99)), alignments_min));
            assert!(!stated.is_enough((submap(1, 0), submap(3, 0)), alignments_min), "another frame");
            assert!(!stated.is_enough((submap(1, 1), submap(2, 0)), alignments_min), "another submap");
        }
    }

    #[test]
    fn two_frames_are_tied_well_enough_at_their_limit_and_not_before() {
        let mut stated = Stated::default();
        for n in 0..ALIGNMENTS_PER_FRAME_PAIR as u32 {
            assert!(!stated.is_enough((submap(1, 99), submap(2, 99)), 3), "{n}");
            stated.count((submap(1, n), submap(2, n)));
        }
        assert!(stated.is_enough((submap(1, 99), submap(2, 99)), 3));
    }
}

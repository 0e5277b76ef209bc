//! How much has been stated already of two frames and of their submaps: when one alignment more would say too little.

use super::negotiation::ALIGNMENTS_PER_FRAME_PAIR;
use crate::agent::replication::knowledge::Pair;
use crate::geometry::Relative;
use crate::ids::{FrameId, SubmapId};
use std::collections::BTreeMap;

/// Undisputed alignments.
#[derive(Default)]
pub(super) struct Stated {
    of_frames: BTreeMap<(FrameId, FrameId), OfFrames>,
    /// Of one submap with another frame (or with its own).
    of_submap: BTreeMap<(SubmapId, FrameId), usize>,
}

/// Those between two frames.
#[derive(Default)]
struct OfFrames {
    count: usize,
    /// Of the variances of their translations, summed over the axes.
    variance: f64,
}

impl Stated {
    /// Adds an alignment of `i` and `j`, in canonical order.
    pub(super) fn count(&mut self, (i, j): Pair, t_i_j: &Relative) {
        let of_frames = self.of_frames.entry((i.frame, j.frame)).or_default();
        of_frames.count += 1;
        of_frames.variance += t_i_j.translation_variance();
        *self.of_submap.entry((i, j.frame)).or_default() += 1;
        *self.of_submap.entry((j, i.frame)).or_default() += 1;
    }

    /// Alignments that either of two submaps has with the other's frame, of the one that has more.
    pub(super) fn most_of_either(&self, (i, j): Pair) -> usize {
        self.of_submap(i, j.frame).max(self.of_submap(j, i.frame))
    }

    /// Alignments of a submap with a frame.
    pub(super) fn of_submap(&self, id: SubmapId, other: FrameId) -> usize {
        self.of_submap.get(&(id, other)).copied().unwrap_or(0)
    }

    /// Alignments between the frames of two submaps.
    pub(super) fn between(&self, (i, j): Pair) -> usize {
        self.of_frames.get(&(i.frame, j.frame)).map_or(0, |of| of.count)
    }

    /// Whether two frames are tied well enough as such.
    pub(super) fn is_tied(&self, pair: Pair) -> bool {
        self.between(pair) >= ALIGNMENTS_PER_FRAME_PAIR
    }

    /// Standard deviation of the translation of an alignment between the two frames, over all axes, in the mean and in
    /// the unit of the second; `None` without any.
    pub(super) fn sigma(&self, (i, j): Pair) -> Option<f64> {
        let of_frames = self.of_frames.get(&(i.frame, j.frame))?;
        Some((of_frames.variance / of_frames.count as f64).sqrt())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Covariance, PoseWithCovariance, Se3};
    use crate::ids::RobotId;

    fn measured(sigma: f64) -> Relative {
        let covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
        Relative::Metric(PoseWithCovariance { pose: Se3::identity(), covariance })
    }

    fn submap(robot: u8, index: u32) -> SubmapId {
        SubmapId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 1 }, index }
    }

    #[test]
    fn what_a_submap_has_said_of_one_frame_is_counted_from_both_its_ends() {
        let mut stated = Stated::default();
        let most = |stated: &Stated, i, j| stated.most_of_either((i, j));
        for n in 0..4 {
            assert_eq!(most(&stated, submap(1, 0), submap(2, 99)), n);
            stated.count((submap(1, 0), submap(2, n as u32)), &measured(0.1));
        }
        assert_eq!(most(&stated, submap(1, 99), submap(2, 3)), 1);
        assert_eq!(most(&stated, submap(1, 0), submap(3, 0)), 0, "another frame");
        assert_eq!(most(&stated, submap(1, 1), submap(2, 99)), 0, "another submap");
        stated.count((submap(1, 0), submap(1, 9)), &measured(0.1));
        assert_eq!([0, 9].map(|n| most(&stated, submap(1, n), submap(1, 50))), [1, 1], "a loop");
    }

    #[test]
    fn two_frames_are_tied_well_enough_at_their_limit_and_not_before() {
        let mut stated = Stated::default();
        for n in 0..ALIGNMENTS_PER_FRAME_PAIR as u32 {
            let pair = (submap(1, 99), submap(2, 99));
            assert!(!stated.is_tied(pair) && stated.between(pair) == n as usize, "{n}");
            assert_eq!(stated.sigma(pair).is_some(), n > 0);
            stated.count((submap(1, n), submap(2, n)), &measured(if n % 2 == 0 { 0.1 } else { 0.2 }));
        }
        assert!(stated.is_tied((submap(1, 99), submap(2, 99))));
        let sigma = stated.sigma((submap(1, 99), submap(2, 99))).unwrap();
        // Three axes, half of the alignments with either.
        assert!((sigma - (3.0 * 0.5 * (0.01 + 0.04f64)).sqrt()).abs() < 1e-6, "{sigma}");
        assert!(!stated.is_tied((submap(1, 99), submap(3, 99))));
    }
}

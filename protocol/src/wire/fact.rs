//! Facts in domain form: what an entry's payload means once it has been parsed. Every value here is already checked:
//! finite, unit norm, positive definite, bounded.

use crate::geometry::{Covariance, PoseWithCovariance, Relative};
use crate::ids::{EntryId, Hash, SubmapId};
pub use crate::kinds::{RefusalReason, ScaleKind};
use crate::time::Stamp;
use core::num::NonZero;

/// One signed, immutable piece of knowledge.
#[derive(Clone, Debug, PartialEq)]
pub enum Fact {
    /// A finished stretch of the writer's own trajectory.
    Submap(SubmapFact),
    /// One endpoint's alignment of two submaps.
    Alignment(AlignmentFact),
    /// The other endpoint's own, independent answer to an alignment.
    Verdict(VerdictFact),
    /// A direct measurement of another robot.
    Sighting(SightingFact),
    /// What still counts of the writer's entries below its floor.
    Condensed(CondensedFact),
    /// Where another robot was seen, not how it was turned.
    Position(PositionFact),
    /// Two of the writer's own submaps that look alike in more ways than one.
    Lookalike(LookalikeFact),
    /// Which of its epochs the writer gives up.
    Retired(RetiredFact),
}

/// The writer gives up its epochs below one: their logs are gone on every robot that hears of it, as if they had never
/// been. It cannot give up the epoch that it says so in, or one to come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RetiredFact {
    /// The first epoch that stays.
    pub below: NonZero<u32>,
}

/// A submap, as its owner states it.
#[derive(Clone, Debug, PartialEq)]
pub struct SubmapFact {
    /// Position along the writer's trajectory in this epoch, from 0.
    pub index: u32,
    /// Stamps of the first and last keyframe.
    pub stamps: [Stamp; 2],
    /// `t_prev_this`: pose of this anchor in the previous submap's anchor. For index 0, `t_frame_this`.
    pub odometry: PoseWithCovariance,
    /// Half extents of the cloud about the anchor, in frame units.
    pub extent: [f32; 3],
    /// Encoded [`crate::submap::Summary`] (opaque here, bounded by `SUMMARY_LEN_MAX`).
    pub summary: Vec<u8>,
    /// Number of keypoints in the blob.
    pub keypoint_count: u16,
    /// Address of the keypoint blob.
    pub blob: Hash,
    /// Unit of the frame.
    pub scale: ScaleKind,
    /// How many keyframes made it; older robots do not tell. The middle one, of an even number the earlier, is its
    /// anchor.
    pub keyframes: Option<NonZero<u16>>,
}

/// An alignment of two submaps of different frames (or a loop closure within one), by the endpoint that computed it.
#[derive(Clone, Debug, PartialEq)]
pub struct AlignmentFact {
    /// The submap whose anchor frame is the target.
    pub i: SubmapId,
    /// The submap that is mapped into `i`.
    pub j: SubmapId,
    /// `t_i_j` with the covariance of its local perturbation.
    pub t_i_j: Relative,
    /// Estimated noise scale σ̂ of the correspondences, in units of `i`.
    pub sigma: f32,
    /// Σ of inlier probabilities.
    pub support: u16,
    /// log₁₀ of the number of false alarms.
    pub log10_nfa: f32,
    /// Keypoint blobs of `i` and `j` it was computed from. If the writer looked at further keypoints of the other's
    /// submap as well, the blob that holds these stands in the place of that submap's first one, which names it.
    pub blobs: [Hash; 2],
}

/// The other endpoint's answer to one alignment.
#[derive(Clone, Debug, PartialEq)]
pub struct VerdictFact {
    /// The entry that holds the [`AlignmentFact`].
    pub alignment: EntryId,
    /// What the other endpoint found on its own. Whether the two agree is computed by every reader (χ², 99.9 %),
    /// never believed.
    pub outcome: VerdictOutcome,
}

/// What an independent alignment of the same pair gave.
#[expect(clippy::large_enum_variant, reason = "refusals are the exception; a box would cost every measurement")]
#[derive(Clone, Debug, PartialEq)]
pub enum VerdictOutcome {
    /// Its own `t_i_j` (same direction as the alignment's).
    Measured {
        /// The independent `t_i_j`.
        t_i_j: Relative,
        /// σ̂ of its correspondences.
        sigma: f32,
        /// Σ of its inlier probabilities.
        support: u16,
    },
    /// It found none.
    Refused(RefusalReason),
}

/// A direct relative measurement of another robot (marker, UWB with bearing), carried to anchors by the observer.
#[derive(Clone, Debug, PartialEq)]
pub struct SightingFact {
    /// When, on the observer's clock.
    pub stamp: Stamp,
    /// The observer's submap anchor.
    pub i: SubmapId,
    /// The observed robot's submap anchor, as its beacon named it.
    pub j: SubmapId,
    /// `t_i_j`.
    pub t_i_j: PoseWithCovariance,
}

/// Where another robot was seen (range and bearing), carried to anchors by the observer: a point of one submap, seen
/// from another.
#[derive(Clone, Debug, PartialEq)]
pub struct PositionFact {
    /// When, on the observer's clock.
    pub stamp: Stamp,
    /// The observer's submap anchor.
    pub i: SubmapId,
    /// The observed robot's submap anchor, as its beacon named it.
    pub j: SubmapId,
    /// Where the body was seen, in the frame of `i`'s anchor, m.
    pub p_i: [f32; 3],
    /// Where it was by its own beacon, in the frame of `j`'s anchor, m.
    pub p_j: [f32; 3],
    /// Of the one less the other, along the axes of `i`'s anchor, m².
    pub covariance: Covariance<3>,
}

/// Two submaps of the frame that the entry is of, which its owner looked at for a loop, and of which one fits at two
/// places of the other ([`RefusalReason::Ambiguous`], but for what only could be turned, slid or mirrored where it is):
/// a frame that has many of them repeats itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct LookalikeFact {
    /// Index of the earlier one.
    pub i: u32,
    /// Index of the later one.
    pub j: u32,
}

/// A part of what still counts of the entries below the writer's floor (DESIGN §3, §7): facts that are carried on, each
/// with the place it had, so that whatever names it still finds it. The first part states its own place as the floor,
/// and replaces every entry below at once; the other parts follow it.
#[derive(Clone, Debug, PartialEq)]
pub struct CondensedFact {
    /// By their places, rising; one at least.
    pub carried: Vec<CarriedFact>,
}

/// One fact that is carried on.
#[derive(Clone, Debug, PartialEq)]
pub struct CarriedFact {
    /// Its place in the log.
    pub seq: u32,
    /// For a submap, the index of the one that its odometry begins at, `None` for the origin of the frame: the submaps
    /// between them are gone, and their steps are compounded. `None` for other facts.
    pub after: Option<u32>,
    /// As it was stated, but for a submap's odometry. Never condensed itself.
    pub fact: Fact,
}

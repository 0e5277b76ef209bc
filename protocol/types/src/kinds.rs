//! What several layers tell one another in one word each: of a frame's unit, a refused alignment, a pair of frames, an
//! estimate.

use serde::{Deserialize, Serialize};

/// Whether a frame's unit is the metre.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ScaleKind {
    /// Units are metres (LiDAR, depth, stereo, wheel odometry).
    #[default]
    Metric,
    /// Units are the frame's own (monocular SLAM): alignments live in SIM(3).
    Unknown,
}

/// Why no alignment was found.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RefusalReason {
    /// Fewer correspondences than the solver needs.
    TooFew,
    /// Nothing better than chance.
    NoConsensus,
    /// Two different alignments explain the data about equally well.
    Ambiguous,
    /// The geometry leaves a direction undetermined, or a mirror image looks the same.
    Degenerate,
    /// The alignment does not fit the rest of the two submaps.
    PoorFit,
    /// A blob was missing or malformed.
    BadInput,
}

impl RefusalReason {
    /// In words: why, and what may help.
    pub fn explained(self) -> [&'static str; 2] {
        match self {
            Self::TooFew => [
                "too few keypoints match",
                "see in the log how many keypoints submaps have, and that all robots state the same submap.sensor and voxel_m",
            ],
            Self::NoConsensus => [
                "nothing fits better than chance",
                "they may have seen no common place yet; if they have, see that all robots state the same submap.sensor and \
                 voxel_m, and that merganser doctor finds nothing odd about either",
            ],
            Self::Ambiguous => [
                "they fit in several ways",
                "the place repeats itself: let submaps reach farther (submap.distance_m), or drive on",
            ],
            Self::Degenerate => [
                "the geometry leaves a direction open, as in a corridor",
                "let submaps reach farther (submap.distance_m), or drive on",
            ],
            Self::PoorFit => [
                "what would fit contradicts what else the two saw",
                "see by merganser doctor whether poses and points are as they are to be, and whether things moved",
            ],
            Self::BadInput => [
                "there are too few keypoints, or they cannot be read",
                "see in the log how many keypoints submaps have, and that all robots state the same submap.sensor and voxel_m \
                 and run one version",
            ],
        }
    }
}

/// What is known about a pair of frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PairStatus {
    /// Enough consistent alignments: part of the joint estimate.
    Merged,
    /// Agreed alignments, but fewer than needed.
    Provisional,
    /// Two rival groups of alignments; or about as many pairs of submaps that fit in several ways as hold, between the
    /// two or within either, so that the place repeats itself.
    Ambiguous,
    /// Alignments contradict one another, or other pairs.
    Inconsistent,
}

impl PairStatus {
    /// As it is written.
    pub fn name(self) -> &'static str {
        match self {
            Self::Merged => "merged",
            Self::Provisional => "provisional",
            Self::Ambiguous => "ambiguous",
            Self::Inconsistent => "inconsistent",
        }
    }
}

/// What is known about the optimality of an estimate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Optimality {
    /// Proved to lie at the global optimum.
    Certified,
    /// Measurements have weights that no certificate speaks of (direction-dependent, or of unknown scale).
    #[default]
    NotApplicable,
    /// No proof was found: the estimate may be a local optimum.
    NotCertified,
}

//! What is known of a submap's points: [`Keypoints`] are the few that a peer may fetch (a content-addressed blob),
//! [`Features`] are all of them, kept privately by the owner. Both share one bounded layout; keypoints are the prefix
//! of a priority order, so fewer are cut from more by keeping the first.

use super::block::{Block, BlockError, Surfel};
use super::descriptor::{self, DIMENSIONS};

/// Keypoints in a blob at most.
pub const KEYPOINTS_MAX: usize = 1024;
/// Features of a submap at most.
pub const FEATURES_MAX: usize = 1_000_000;

const KEYPOINTS_MAGIC: [u8; 2] = *b"mk";
const FEATURES_MAGIC: [u8; 2] = *b"mf";

/// The described points that a submap's owner offers to others, most important first, in the anchor frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Keypoints(pub(super) Block);

/// All described points of one's own submap, in the anchor frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Features(pub(super) Block);

impl Keypoints {
    /// The blob: at most 18 + 26 × [`KEYPOINTS_MAX`] bytes.
    pub fn encode(&self) -> Vec<u8> {
        self.0.encode(KEYPOINTS_MAGIC)
    }

    /// Parses a blob.
    ///
    /// # Errors
    /// [`BlockError`] if the bytes are not exactly what [`Keypoints::encode`] writes.
    pub fn decode(bytes: &[u8]) -> Result<Self, BlockError> {
        Block::decode(bytes, KEYPOINTS_MAGIC, KEYPOINTS_MAX).map(Self)
    }

    /// The first `count` keypoints: an even cover of the submap by fewer points.
    #[must_use]
    pub fn first(&self, count: usize) -> Self {
        let mut block = self.0.like();
        block.points.extend(self.0.points.iter().take(count));
        Self(block)
    }
}

impl Features {
    /// The features as a private disk record, 26 bytes a point.
    pub fn encode(&self) -> Vec<u8> {
        self.0.encode(FEATURES_MAGIC)
    }

    /// Parses a record.
    ///
    /// # Errors
    /// [`BlockError`] if the bytes are not exactly what [`Features::encode`] writes.
    pub fn decode(bytes: &[u8]) -> Result<Self, BlockError> {
        Block::decode(bytes, FEATURES_MAGIC, FEATURES_MAX).map(Self)
    }
}

macro_rules! described_points {
    ($($kind:ty),*) => {$(
        impl $kind {
            /// Number of points.
            pub fn len(&self) -> usize {
                self.0.points.len()
            }

            /// Whether there are none.
            pub fn is_empty(&self) -> bool {
                self.0.points.is_empty()
            }

            /// Edge of the voxel that the cloud was thinned to, frame units.
            pub fn voxel(&self) -> f64 {
                self.0.voxel()
            }

            /// The points as pieces of surface.
            pub fn surfels(&self) -> Vec<Surfel> {
                self.0.surfels()
            }

            /// The levels (0 to 15) of each point's descriptor.
            pub fn descriptors(&self) -> Vec<[u8; DIMENSIONS]> {
                self.0.points.iter().map(|p| descriptor::unpack(&p.descriptor)).collect()
            }
        }
    )*};
}

described_points!(Keypoints, Features);

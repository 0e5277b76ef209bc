//! What is known of a submap's points: [`Keypoints`] are the few that a peer may fetch (a content-addressed blob),
//! [`Features`] are all of them, kept privately by the owner. Both share one bounded layout; keypoints are the prefix
//! of a priority order, so fewer are cut from more by keeping the first.
//!
//! A blob may be gone on with: it then ends with the address of another one that holds further keypoints, so that
//! whoever trusts the first can trust the second. The spare byte of the header (position 5) tells so.
//!
//! Describing *all* points takes several times as long as everything else about a submap, and most submaps are never
//! compared with a peer's. So keypoints carry their descriptors, and features come by theirs when first asked.

use super::block::{BARE_LEN, Block, BlockError, HEADER_LEN, Surfel};
use super::descriptor::{Code, PACKED_LEN, Projection};
use super::landmarks::{Codec, LANDMARKS_MAX};
use super::local_descriptor;
use crate::ids::Hash;
use nalgebra::Vector3;
use std::sync::OnceLock;

/// Position of the header's byte that is 1 if an address ends the blob, else 0.
const GOES_ON: usize = 5;
/// Bytes of that address.
pub const ADDRESS_LEN: usize = 32;
/// Keypoints in a blob at most.
pub const KEYPOINTS_MAX: usize = 1024;
/// Features of a submap at most.
pub const FEATURES_MAX: usize = 1_000_000;

/// Viewpoints kept with features at most (the first of the submap).
pub const VIEWPOINTS_MAX: usize = 32;
/// Stands for a viewpoint that was not kept.
pub const UNSEEN: u8 = 255;

const KEYPOINTS_MAGIC: [u8; 2] = *b"mk";
const FEATURES_MAGIC: [u8; 2] = *b"mf";
/// The same of landmarks.
const LANDMARK_KEYPOINTS_MAGIC: [u8; 2] = *b"ml";
const LANDMARK_FEATURES_MAGIC: [u8; 2] = *b"mL";
/// Bytes that the descriptor of a keypoint of a surface takes...
pub const DESCRIPTOR_LEN: usize = PACKED_LEN;
/// ...and all of it.
pub const KEYPOINT_LEN: usize = Block::<PACKED_LEN>::POINT_LEN;

/// The described points that a submap's owner offers to others, most important first, in the anchor frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Keypoints {
    pub(super) block: Block<PACKED_LEN>,
    /// In the place of points, if these are landmarks.
    pub(super) landmarks: Option<Codec>,
    /// Address of the blob that holds further ones.
    further: Option<Hash>,
}

/// All described points of one's own submap, in the anchor frame, and from where they were seen.
#[derive(Clone, Debug, PartialEq)]
pub struct Features {
    pub(super) block: Block<0>,
    /// Positions of the keyframes.
    pub(super) viewpoints: Vec<[f32; 3]>,
    /// For each point, the position in `viewpoints` of the keyframe that saw it first, or [`UNSEEN`].
    pub(super) seen_from: Vec<u8>,
    /// Descriptors, once asked for.
    pub(super) codes: Codes,
    /// In the place of points, if these are landmarks.
    pub(super) landmarks: Option<Codec>,
}

/// A function of the points, computed once.
#[derive(Clone, Debug, Default)]
pub(super) struct Codes(OnceLock<Vec<Code>>);

impl PartialEq for Codes {
    /// Computed or not: equal points have equal descriptors.
    fn eq(&self, _: &Self) -> bool {
        true
    }
}

impl Keypoints {
    /// Keypoints on surfaces.
    pub(super) fn of_points(block: Block<PACKED_LEN>) -> Self {
        Self { block, landmarks: None, further: None }
    }

    /// Landmarks.
    pub(super) fn of_landmarks(chart: Codec) -> Self {
        Self { block: Block::new(chart.voxel(), 0.0), landmarks: Some(chart), further: None }
    }

    /// The same, which go on with these, if there are any.
    #[must_use]
    pub(super) fn before(self, further: Option<&Self>) -> Self {
        Self { further: further.map(|further| Hash::of(&further.encode())), ..self }
    }

    /// Address of the blob that holds further keypoints of the submap.
    pub fn further(&self) -> Option<Hash> {
        self.further
    }

    /// These and further ones; `None` if those cannot be of the same submap. (That they are is their owner's word, who
    /// signed the address of the blob that names theirs.)
    pub fn with_further(&self, further: &Self) -> Option<Self> {
        let landmarks = match (&self.landmarks, &further.landmarks) {
            (None, None) => None,
            (Some(first), Some(further)) => Some(first.with(further)?),
            _ => return None,
        };
        Some(Self { block: self.block.with(&further.block)?, landmarks, further: further.further })
    }

    /// The blob: at most 18 + 21 × [`KEYPOINTS_MAX`] + [`ADDRESS_LEN`] bytes.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = match &self.landmarks {
            Some(chart) => chart.encode(LANDMARK_KEYPOINTS_MAGIC),
            None => self.block.encode(KEYPOINTS_MAGIC),
        };
        if let Some(Hash(address)) = self.further {
            bytes[GOES_ON] = 1;
            bytes.extend(address);
        }
        bytes
    }

    /// Parses a blob.
    ///
    /// # Errors
    /// [`BlockError`] if the bytes are not exactly what [`Keypoints::encode`] writes.
    pub fn decode(bytes: &[u8]) -> Result<Self, BlockError> {
        let Some((first, address)) = split_address(bytes) else { return Self::decode_alone(bytes) };
        let mut alone = first.to_vec();
        alone[GOES_ON] = 0;
        Ok(Self { further: Some(address), ..Self::decode_alone(&alone)? })
    }

    /// The address that ends a blob, without a look at the rest of it.
    pub fn address_in(bytes: &[u8]) -> Option<Hash> {
        split_address(bytes).map(|(_, address)| address)
    }

    fn decode_alone(bytes: &[u8]) -> Result<Self, BlockError> {
        if bytes.starts_with(&LANDMARK_KEYPOINTS_MAGIC) {
            return Codec::decode(bytes, LANDMARK_KEYPOINTS_MAGIC, LANDMARKS_MAX).map(Self::of_landmarks);
        }
        Block::decode(bytes, KEYPOINTS_MAGIC, KEYPOINTS_MAX).map(Self::of_points)
    }

    /// The first `count` keypoints: an even cover of the submap by fewer points.
    #[must_use]
    pub fn first(&self, count: usize) -> Self {
        let mut block = self.block.like();
        block.points.extend(self.block.points.iter().take(count));
        Self { block, landmarks: self.landmarks.as_ref().map(|chart| chart.first(count)), further: None }
    }

    /// The descriptors.
    pub(super) fn codes(&self) -> Vec<Code> {
        let projection = Projection::new();
        self.block.points.iter().map(|p| projection.unpack(&p.descriptor)).collect()
    }
}

impl Features {
    /// Landmarks, and from where they were seen.
    pub(super) fn of_landmarks(chart: Codec, viewpoints: Vec<[f32; 3]>) -> Self {
        let block = Block::new(chart.voxel(), 0.0);
        let codes = Codes::default();
        Self { block, viewpoints, seen_from: Vec::new(), codes, landmarks: Some(chart) }
    }

    /// Positions of the keyframes, in the anchor frame.
    pub(super) fn viewpoints(&self) -> Vec<Vector3<f64>> {
        self.viewpoints.iter().map(|p| Vector3::from(p.map(f64::from))).collect()
    }

    /// For each point, the position among the viewpoints of the one that saw it first, or [`UNSEEN`].
    pub(super) fn seen_from(&self) -> &[u8] {
        &self.seen_from
    }

    /// The descriptors of all points. The first time this takes about 3 µs a point.
    pub(super) fn codes(&self) -> &[Code] {
        self.codes.0.get_or_init(|| {
            let (points, normals) = in_voxels(&self.block);
            let all: Vec<u32> = (0..).take(points.len()).collect();
            let projection = Projection::new();
            local_descriptor::describe_points(&points, &normals, &all)
                .iter()
                .map(|numbers| projection.code(numbers))
                .collect()
        })
    }

    /// The features as a private disk record: viewpoints (12 bytes each, one byte for their number), one byte a point
    /// that tells which saw it, then 9 bytes a point.
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = match &self.landmarks {
            Some(chart) => chart.encode(LANDMARK_FEATURES_MAGIC),
            None => self.block.encode(FEATURES_MAGIC),
        };
        bytes.extend(&self.seen_from);
        self.viewpoints.iter().flatten().for_each(|x| bytes.extend(x.to_le_bytes()));
        bytes.push(self.viewpoints.len() as u8);
        bytes
    }

    /// Parses a record.
    ///
    /// # Errors
    /// [`BlockError`] if the bytes are not exactly what [`Features::encode`] writes.
    pub fn decode(bytes: &[u8]) -> Result<Self, BlockError> {
        let cut = || BlockError::NoHeader { len: bytes.len() };
        let (&count, rest) = bytes.split_last().ok_or_else(cut)?;
        let count = usize::from(count);
        let split = rest.len().checked_sub(12 * count).filter(|_| count <= VIEWPOINTS_MAX).ok_or_else(cut)?;
        let (rest, viewpoints) = rest.split_at(split);
        let viewpoints: Vec<[f32; 3]> = viewpoints
            .as_chunks::<12>()
            .0
            .iter()
            .map(|p| core::array::from_fn(|k| f32::from_le_bytes([p[4 * k], p[4 * k + 1], p[4 * k + 2], p[4 * k + 3]])))
            .collect();
        if viewpoints.iter().flatten().any(|x| !x.is_finite()) {
            return Err(BlockError::BadScale);
        }
        if rest.starts_with(&LANDMARK_FEATURES_MAGIC) {
            let chart = Codec::decode(rest, LANDMARK_FEATURES_MAGIC, LANDMARKS_MAX)?;
            return Ok(Self::of_landmarks(chart, viewpoints));
        }
        // What remains is the block and one byte for each of its points.
        let points = rest.len().saturating_sub(HEADER_LEN) / (BARE_LEN + 1);
        let (block, seen_from) = rest.split_at(rest.len() - points);
        let block = Block::decode(block, FEATURES_MAGIC, FEATURES_MAX)?;
        let good = |&&seen: &&u8| seen == UNSEEN || usize::from(seen) < count;
        match seen_from.iter().position(|seen| !good(&seen)) {
            Some(index) => Err(BlockError::NotCanonical { index }),
            None => {
                let seen_from = seen_from.to_vec();
                Ok(Self { block, viewpoints, seen_from, codes: Codes::default(), landmarks: None })
            }
        }
    }
}

/// A blob that is gone on with: what comes before the address, and the address.
fn split_address(bytes: &[u8]) -> Option<(&[u8], Hash)> {
    let goes_on = bytes.get(GOES_ON) == Some(&1);
    let (first, address) =
        bytes.split_last_chunk::<ADDRESS_LEN>().filter(|(first, _)| goes_on && first.len() >= HEADER_LEN)?;
    Some((first, Hash(*address)))
}

/// Positions in voxels, and normals.
pub(super) fn in_voxels<const N: usize>(block: &Block<N>) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let voxel = block.voxel();
    let single = |v: Vector3<f64>| [v.x as f32, v.y as f32, v.z as f32];
    block.surfels().iter().map(|s| (single(s.position / voxel), single(s.normal))).unzip()
}

macro_rules! described_points {
    ($($kind:ty),*) => {$(
        impl $kind {
            /// Number of points.
            pub fn len(&self) -> usize {
                self.landmarks.as_ref().map_or(self.block.points.len(), Codec::len)
            }

            /// Whether there are none.
            pub fn is_empty(&self) -> bool {
                self.len() == 0
            }

            /// Edge of the voxel that the cloud was thinned to, frame units.
            pub fn voxel(&self) -> f64 {
                self.landmarks.as_ref().map_or(self.block.voxel(), Codec::voxel)
            }

            /// The points as pieces of surface; none if these are landmarks.
            pub fn surfels(&self) -> Vec<Surfel> {
                self.block.surfels()
            }
        }
    )*};
}

described_points!(Keypoints, Features);

#[cfg(test)]
mod tests {
    use super::super::testing::{config, keyframe, room};
    use super::super::{SubmapBuilder, describe};
    use super::*;
    use crate::geometry::{Se3, So3};
    use proptest::prelude::*;

    fn small() -> Features {
        let mut builder = SubmapBuilder::new(config());
        for k in 0..3 {
            let pose = Se3::new(So3::identity(), Vector3::new(0.4 * f64::from(k), 0.0, 0.0));
            let points: Vec<_> =
                (0..12).map(|i| Vector3::new(0.1, f64::from(i % 4) * 0.1, f64::from(i / 4) * 0.1)).collect();
            builder.push(keyframe(i64::from(k) + 1, pose, &points)).unwrap();
        }
        describe(&builder.flush().unwrap(), &config()).features
    }

    #[test]
    fn a_record_holds_who_saw_what() {
        let features = small();
        assert_eq!(features.viewpoints.len(), 3);
        assert!((0..3).all(|k| features.seen_from.contains(&k)));
        let decoded = Features::decode(&features.encode()).unwrap();
        assert_eq!(decoded, features);
        assert_eq!(decoded.codes(), features.codes());
        // Features and keypoints are told apart.
        assert!(Keypoints::decode(&features.encode()).is_err());
        assert!(Features::decode(&room(1).keypoints.encode()).is_err());
    }

    #[test]
    fn every_truncation_extension_and_bad_viewpoint_is_refused() {
        let features = small();
        let bytes = features.encode();
        for len in 0..bytes.len() {
            assert!(Features::decode(&bytes[..len]).is_err(), "cut to {len}");
        }
        assert!(Features::decode(&[&bytes[..], &[3]].concat()).is_err());
        let changed = |change: &dyn Fn(&mut Features)| {
            let mut features = features.clone();
            change(&mut features);
            Features::decode(&features.encode())
        };
        assert!(changed(&|f| f.seen_from[1] = UNSEEN).is_ok());
        assert_eq!(changed(&|f| f.seen_from[1] = 3), Err(BlockError::NotCanonical { index: 1 }));
        assert_eq!(changed(&|f| f.viewpoints[0][2] = f32::NAN), Err(BlockError::BadScale));
        assert!(changed(&|f| f.viewpoints.resize(VIEWPOINTS_MAX, [0.0; 3])).is_ok());
        assert!(changed(&|f| f.viewpoints.resize(VIEWPOINTS_MAX + 1, [0.0; 3])).is_err());
    }

    proptest! {
        #[test]
        fn a_flipped_byte_is_refused_or_comes_back_the_same(at in any::<prop::sample::Index>(), with in any::<u8>()) {
            let mut bytes = small().encode();
            let at = at.index(bytes.len());
            bytes[at] = with;
            if let Ok(features) = Features::decode(&bytes) {
                prop_assert_eq!(features.encode(), bytes);
            }
        }
    }
}

//! A submap's summary: what is gossiped to all, so that each robot can guess which pairs of submaps overlap before it
//! asks for keypoints. It holds how often each of 128 *words* occurs among the submap's descriptors; a word is the signs
//! of seven fixed projections of a descriptor (locality-sensitive hashing). Descriptors are blind to rotation, hence so
//! is the summary. Similarity is one minus the Hellinger distance of the two histograms, which are stored as square roots.
//!
//! It ranks candidates, no more. Measured chance that an overlapping pair ranks above one without overlap: 0.92 between
//! two streets (LiDAR), 0.5 to 0.6 between parts of one room or between halls furnished alike.

use super::descriptor::DIMENSIONS;
use super::features::Features;
use super::thinning::hash_of;
use thiserror::Error;

/// Bytes of an encoded summary at most.
pub const SUMMARY_LEN_MAX: usize = 400;

/// Version of the layout.
const VERSION: u8 = 1;
/// Projections per word.
const PROJECTIONS: usize = 7;
/// Words.
const WORDS: usize = 1 << PROJECTIONS;
/// Version, words, voxel.
const HEADER_LEN: usize = 6;
/// Bytes of an encoded summary.
const LEN: usize = HEADER_LEN + WORDS;
/// Accepted voxel edges, frame units.
const VOXEL_RANGE: core::ops::RangeInclusive<f32> = 1e-4..=1e3;
/// Summaries of clouds thinned to voxels that differ by more than this factor describe different things.
const VOXEL_RATIO_MAX: f64 = 1.5;

/// Keeps a pair that is just alike enough from being passed over for a rounding error.
const ROUNDING: f64 = 1.0 - 1e-9;

/// What is gossiped of a submap's looks.
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {
    /// Edge of the voxel the cloud was thinned to, frame units.
    voxel: f32,
    /// Square roots of the words' shares, the largest 255; all zero for an empty submap.
    words: [u8; WORDS],
    /// Sum of the words' squares.
    square: u32,
}

/// Why bytes are no summary.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum SummaryError {
    /// The length is not that of a summary.
    #[error("a summary has {LEN} bytes, not {len}; it was cut or padded")]
    WrongLength {
        /// How many bytes there are.
        len: usize,
    },
    /// A layout this code does not know.
    #[error("summary of version {version} with 2^{projections} words: update the older robot")]
    UnknownLayout {
        /// Layout version.
        version: u8,
        /// Projections per word.
        projections: u8,
    },
    /// The voxel edge is not a usable number, or the histogram is not scaled to its largest word.
    #[error("summary is not in canonical form; its writer is faulty")]
    NotCanonical,
}

impl Summary {
    /// The summary of a submap's features.
    pub fn of(features: &Features) -> Self {
        let projections = projections();
        let mut counts = [0u32; WORDS];
        for descriptor in features.descriptors() {
            counts[word(&descriptor, &projections)] += 1;
        }
        let most = f64::from(counts.iter().copied().max().unwrap_or(0).max(1));
        let words = counts.map(|count| (255.0 * (f64::from(count) / most).sqrt()).round() as u8);
        Self::new(features.voxel() as f32, words)
    }

    fn new(voxel: f32, words: [u8; WORDS]) -> Self {
        Self { voxel, words, square: dot(&words, &words) }
    }

    /// How alike two submaps look: 0 (nothing in common, or thinned to different voxels) to 1 (equal). Symmetric. Real
    /// submaps of one kind of place lie between 0.6 and 0.9.
    pub fn similarity(&self, other: &Self) -> f64 {
        self.similarity_from(other, 0.0).unwrap_or(0.0)
    }

    /// [`Summary::similarity`], unless it is below `least`. Most pairs of a large swarm are, and no root is drawn then.
    pub fn similarity_from(&self, other: &Self, least: f64) -> Option<f64> {
        let dot = f64::from(dot(&self.words, &other.words));
        let squares = f64::from(self.square) * f64::from(other.square);
        // 1 − √(1 − dot/√squares) ≥ least, solved for dot².
        let bound = 1.0 - (1.0 - least) * (1.0 - least);
        let surely_below = dot * dot < bound * bound * squares * ROUNDING;
        let ratio = f64::from(self.voxel) / f64::from(other.voxel);
        if surely_below || squares == 0.0 || !(1.0 / VOXEL_RATIO_MAX..=VOXEL_RATIO_MAX).contains(&ratio) {
            return (least <= 0.0).then_some(0.0);
        }
        let bhattacharyya = (dot / squares.sqrt()).clamp(0.0, 1.0);
        let similarity = 1.0 - (1.0 - bhattacharyya).sqrt();
        (similarity >= least).then_some(similarity)
    }

    /// The summary as bytes, at most [`SUMMARY_LEN_MAX`].
    pub fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![VERSION, PROJECTIONS as u8];
        bytes.extend(self.voxel.to_le_bytes());
        bytes.extend(self.words);
        bytes
    }

    /// Parses a summary. Accepts exactly what [`Summary::encode`] writes.
    ///
    /// # Errors
    /// [`SummaryError`], naming the first check that failed.
    pub fn decode(bytes: &[u8]) -> Result<Self, SummaryError> {
        if let [version, projections, ..] = *bytes
            && (version, usize::from(projections)) != (VERSION, PROJECTIONS)
        {
            return Err(SummaryError::UnknownLayout { version, projections });
        }
        let wrong_length = SummaryError::WrongLength { len: bytes.len() };
        let (header, words) = bytes.split_first_chunk::<HEADER_LEN>().ok_or(wrong_length.clone())?;
        let [_, _, v0, v1, v2, v3] = *header;
        let voxel = f32::from_le_bytes([v0, v1, v2, v3]);
        let words: [u8; WORDS] = words.try_into().map_err(|_| wrong_length)?;
        let scaled = matches!(words.iter().fold(0, |most, &word| word.max(most)), 0 | 255);
        if !VOXEL_RANGE.contains(&voxel) || !scaled {
            return Err(SummaryError::NotCanonical);
        }
        Ok(Self::new(voxel, words))
    }
}

/// Exact in 32 bits, and a loop that vectorises: this runs for every pair of submaps.
fn dot(a: &[u8; WORDS], b: &[u8; WORDS]) -> u32 {
    a.iter().zip(b).map(|(&a, &b)| u32::from(a) * u32::from(b)).sum()
}

/// Fixed projections: in each of the three histograms five bins count 1, five −1 and one 0, so that the sign compares one
/// half of every histogram with the other.
fn projections() -> [[i32; DIMENSIONS]; PROJECTIONS] {
    core::array::from_fn(|p| {
        let mut coefficients = [0; DIMENSIONS];
        for (part, bins) in coefficients.chunks_exact_mut(DIMENSIONS / 3).enumerate() {
            let mut order: Vec<usize> = (0..bins.len()).collect();
            order.sort_by_key(|&bin| hash_of(&[p as i32, part as i32, bin as i32]));
            for (rank, bin) in order.into_iter().enumerate() {
                bins[bin] = match rank {
                    0..=4 => 1,
                    5..=9 => -1,
                    _ => 0,
                };
            }
        }
        coefficients
    })
}

fn word(descriptor: &[u8; DIMENSIONS], projections: &[[i32; DIMENSIONS]; PROJECTIONS]) -> usize {
    let sign =
        |p: &[i32; DIMENSIONS]| p.iter().zip(descriptor).map(|(c, &level)| c * i32::from(level)).sum::<i32>() > 0;
    projections.iter().fold(0, |word, p| 2 * word + usize::from(sign(p)))
}

#[cfg(test)]
#[path = "summary_tests.rs"]
mod tests;

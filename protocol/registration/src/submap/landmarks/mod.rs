//! Sparse landmarks (`submap.sensor = "landmarks"` or `"landmarks_2d"`): what a visual SLAM keeps of the world. There
//! is no surface to look at, so the path from keyframes to alignments is another one.
//!
//! A keyframe's points are sightings of landmarks, each with a [`Mark`]. `gather` tells which sightings are of one
//! landmark (by label, else by place and descriptor), `settle` finds where the landmarks of a submap lie, given its
//! motions. [`describe()`] makes of them features, keypoints (`chart` is the layout) and summary. [`register()`] pairs
//! a peer's landmarks with mine by labels and descriptors, and finds the pose: in space by the σ-consensus, in SE(3)
//! or, where a scale is unknown, SIM(3); in the plane by a consensus of its own (`flat`), with nothing claimed of
//! height and tilt.
//!
//! Without labels and descriptors nothing is paired: a constellation of bare points is not recognised.
//!
//! Lengths are in frame units.

mod bundle_adjustment;
mod codec;
mod describe;
#[cfg(test)]
mod drive_tests;
mod flat;
mod gather;
mod register;
#[cfg(test)]
mod tests;

pub(super) use bundle_adjustment::adjust;
pub(super) use codec::Codec;
pub use describe::describe;
pub(super) use gather::Gatherer;
pub use register::{Aligned, LandmarkConfig, LandmarkError, register};

use crate::geometry::Covariance;

/// Bytes of a descriptor.
pub const DESCRIPTOR_LEN: usize = 32;
/// Landmarks of a submap at most; `submap.points_max` may lower it.
pub const LANDMARKS_MAX: usize = 2_000;
/// Least and largest standard deviation of a landmark along any axis, frame units.
pub const SIGMA_RANGE: core::ops::RangeInclusive<f64> = 1e-6..=1e4;

/// What a landmark looks like: 256 bits, compared by how many differ (ORB and BRIEF as they are, learnt descriptors by
/// their signs).
pub type Descriptor = [u8; DESCRIPTOR_LEN];

/// What is known of a landmark besides where it is.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mark {
    /// Covariance of its place, in the axes in which the place is given, frame units squared. Within a submap: about
    /// the constellation as a whole.
    pub covariance: Covariance<3>,
    /// Who it is, such as a bar code's number: equal labels are one landmark, in all maps of the swarm.
    pub label: Option<u32>,
    /// What it looks like.
    pub descriptor: Option<Descriptor>,
}

/// How many bits of two descriptors differ.
pub(super) fn differing(a: &Descriptor, b: &Descriptor) -> u32 {
    a.iter().zip(b).map(|(a, b)| (a ^ b).count_ones()).sum()
}

/// A landmark of a submap.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Landmark {
    /// In the anchor frame.
    pub at: nalgebra::Vector3<f64>,
    /// What else is known of it, the covariance in the axes of the anchor frame.
    pub mark: Mark,
    /// How often it was seen.
    pub sightings: u32,
}

/// The landmarks of a submap.
#[derive(Clone, Debug, PartialEq)]
pub struct Constellation {
    /// Those seen most often first.
    pub landmarks: Vec<Landmark>,
    /// What the errors of all have in common: by how much the constellation as a whole may be moved and turned about
    /// the anchor. Covariance of the δ = (ρ, φ) by which exp(δ) moves the true places to the stated ones, as far as
    /// they move together.
    pub common: Covariance<6>,
}

/// Stands for no uncertainty, frame units squared and rad².
const NO_VARIANCE: f64 = 1e-12;

impl Default for Constellation {
    fn default() -> Self {
        let common = Covariance::new_or_wider(nalgebra::Matrix6::from_diagonal_element(NO_VARIANCE));
        Self { landmarks: Vec::new(), common }
    }
}

/// Standard deviation (frame units) of the height of landmarks in the plane: next to nothing, but enough to compute
/// with.
const FLAT_SIGMA: f64 = 1e-3;

/// Sightings laid into the plane of the body: heights are left out.
pub(super) fn flattened(points: &[[f32; 3]], marks: &[Mark]) -> (Vec<[f32; 3]>, Vec<Mark>) {
    let mark = |mark: &Mark| {
        let mut m = *mark.covariance.matrix();
        for k in 0..2 {
            (m[(2, k)], m[(k, 2)]) = (0.0, 0.0);
        }
        m[(2, 2)] = FLAT_SIGMA * FLAT_SIGMA;
        Mark { covariance: Covariance::new_or_wider(m), ..*mark }
    };
    (points.iter().map(|p| [p[0], p[1], 0.0]).collect(), marks.iter().map(mark).collect())
}

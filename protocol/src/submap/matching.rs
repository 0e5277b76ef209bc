//! Pairs a peer's few keypoints with *all* own features: asymmetric matching, which on real submaps finds twice as many
//! alignments per byte sent as matching equal numbers (measured). A pair is kept if each is the other's nearest in
//! descriptor space.

use super::cloud::Index;
use super::descriptor::DIMENSIONS;
use super::features::{Features, Keypoints};
use crate::geometry::Sim3;
use nalgebra::Vector3;

/// Descriptor length padded for the processor's vector registers.
const PADDED: usize = 40;

/// Correspondences between a peer's submap and one's own, best first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matches {
    /// Points in the peer's anchor frame.
    pub source: Vec<[f64; 3]>,
    /// Their counterparts in one's own anchor frame.
    pub target: Vec<[f64; 3]>,
    /// How good each match looks, 0 to 1; falling.
    pub scores: Vec<f64>,
}

/// Matches their keypoints against all of mine, mutual nearest neighbours only.
pub fn match_keypoints(theirs: &Keypoints, mine: &Features) -> Matches {
    let (their_codes, my_codes) = (padded(&theirs.descriptors()), padded(&mine.descriptors()));
    let nearest_mine: Vec<Option<(usize, i32)>> = their_codes.iter().map(|code| nearest(code, &my_codes)).collect();
    let mut pairs: Vec<(i32, usize, usize)> = Vec::new();
    for (their, found) in nearest_mine.into_iter().enumerate() {
        let Some((my, distance)) = found else { continue };
        if nearest(&my_codes[my], &their_codes).is_some_and(|(back, _)| back == their) {
            pairs.push((distance, their, my));
        }
    }
    pairs.sort_unstable();
    let (their_points, my_points) = (theirs.surfels(), mine.surfels());
    Matches {
        source: pairs.iter().map(|&(_, their, _)| their_points[their].position.into()).collect(),
        target: pairs.iter().map(|&(_, _, my)| my_points[my].position.into()).collect(),
        scores: pairs.iter().map(|&(distance, ..)| 1.0 / (1.0 + f64::from(distance))).collect(),
    }
}

/// Share of their keypoints that come to lie within `radius` (my frame's units) of a point of mine; 0 without keypoints.
pub fn fit(theirs: &Keypoints, mine: &Features, t_mine_theirs: &Sim3, radius: f64) -> f64 {
    let my_points: Vec<Vector3<f64>> = mine.surfels().iter().map(|s| s.position).collect();
    let index = Index::new(&my_points);
    let hits =
        theirs.surfels().iter().filter(|s| index.nearest(&(*t_mine_theirs * s.position), radius).is_some()).count();
    if theirs.is_empty() { 0.0 } else { hits as f64 / theirs.len() as f64 }
}

fn padded(descriptors: &[[u8; DIMENSIONS]]) -> Vec<[i16; PADDED]> {
    let pad = |d: &[u8; DIMENSIONS]| core::array::from_fn(|k| d.get(k).map_or(0, |&level| i16::from(level)));
    descriptors.iter().map(pad).collect()
}

/// Position and squared distance of the nearest code; the first of equals.
fn nearest(code: &[i16; PADDED], codes: &[[i16; PADDED]]) -> Option<(usize, i32)> {
    let distance = |other: &[i16; PADDED]| -> i32 {
        code.iter().zip(other).map(|(a, b)| i32::from(a - b) * i32::from(a - b)).sum()
    };
    codes.iter().map(distance).enumerate().min_by_key(|&(_, d)| d)
}

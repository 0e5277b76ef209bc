//! Turns a finished submap into what others and its owner need of it. Heavy (about 0.8 µs a point) and pure: it runs as
//! a job.

use super::Submap;
use super::block::Block;
use super::descriptor::{Code, Projection};
use super::features::{Codes, FEATURES_MAX, Features, KEYPOINTS_MAX, Keypoints, UNSEEN, VIEWPOINTS_MAX, in_voxels};
use super::landmarks;
use super::local_descriptor;
use super::modality::Modality;
use super::planar;
use super::sampling::{rest, spread};
use super::summary::Summary;
use super::surface::{Normal, normals};
use crate::config::SubmapConfig;
use nalgebra::Vector3;

/// Neighbours that a keypoint needs at least for its descriptor to mean something.
const KEYPOINT_NEIGHBOURS_MIN: u32 = 8;
/// Candidates described for each keypoint wanted: the half of them that is least like the average becomes keypoints.
/// That keeps the even cover that pays on cluttered scenes and leaves the bare middles of walls out.
const CANDIDATES_PER_KEYPOINT: usize = 2;

/// What [`describe()`] makes of a submap.
#[derive(Clone, Debug, PartialEq)]
pub struct Described {
    /// All points with normals, for matching at home.
    pub features: Features,
    /// The few that peers may fetch.
    pub keypoints: Keypoints,
    /// Further ones, of which `keypoints` names the address.
    pub further: Option<Keypoints>,
    /// What is gossiped.
    pub summary: Summary,
    /// Half extents of the cloud about the anchor, frame units.
    pub extent: [f32; 3],
}

/// Normals, keypoints with descriptors, and summary of a submap.
pub fn describe(submap: &Submap, config: &SubmapConfig) -> Described {
    let described = match Modality::of(config.sensor) {
        Modality { landmarks: true, .. } => landmarks::describe(submap, config),
        Modality { planar: true, .. } => planar::describe(submap, config),
        _ => in_space(submap, config),
    };
    Described { summary: described.summary.at(submap.place.clone()).upright(submap.up), ..described }
}

fn in_space(submap: &Submap, config: &SubmapConfig) -> Described {
    let points: Vec<[f32; 3]> = submap.cloud.iter().take(FEATURES_MAX).copied().collect();
    let extent = [0, 1, 2].map(|axis| points.iter().fold(0.0, |most: f32, p| most.max(p[axis].abs())));
    let mut block = Block::new(config.voxel_m, extent.iter().fold(0.0, |most, &e| most.max(f64::from(e))));
    // Points beyond the block's reach are left out; they are no neighbours of the others.
    let within: Vec<usize> = (0..points.len()).filter(|&k| block.reaches(&points[k])).collect();
    let voxel = block.voxel();
    let at: Vec<[f32; 3]> = within.iter().map(|&k| points[k].map(|x| (f64::from(x) / voxel) as f32)).collect();
    let viewpoint = |k: usize| {
        let keyframe = submap.seen_from.get(within[k]).and_then(|&from| submap.keyframes.get(usize::from(from)));
        keyframe.map_or_else(Vector3::zeros, |t_anchor_body| t_anchor_body.translation / voxel)
    };
    let normals = normals(&at, viewpoint);
    let stored = |(&k, normal): (&usize, &Normal)| block.store(&Vector3::from(points[k].map(f64::from)), normal, []);
    block.points = within.iter().zip(&normals).filter_map(stored).collect();

    let seen_from = |k: &usize| -> u8 {
        let from = submap.seen_from.get(*k).filter(|&&from| usize::from(from) < VIEWPOINTS_MAX);
        from.and_then(|&from| u8::try_from(from).ok()).unwrap_or(UNSEEN)
    };
    let viewpoints = submap.keyframes.iter().take(VIEWPOINTS_MAX);
    let features = Features {
        viewpoints: viewpoints.map(|t_anchor_body| t_anchor_body.translation.map(|x| x as f32).into()).collect(),
        seen_from: within.iter().map(seen_from).collect(),
        codes: Codes::default(),
        landmarks: None,
        block,
    };
    let shaped: Vec<u32> =
        (0..).zip(&normals).filter(|(_, n)| n.neighbours > KEYPOINT_NEIGHBOURS_MIN).map(|(k, _)| k).collect();
    let (keypoints, further, codes) = keypoints(&features.block, &shaped, [config.keypoints, config.keypoints_further]);
    let further = Some(further).filter(|further| !further.is_empty());
    let summary = Summary::of(config.voxel_m, &codes).seen_by(config.sensor);
    Described { keypoints: keypoints.before(further.as_ref()), features, further, summary, extent }
}

/// Keypoints among the `shaped` points, up to so many at first and so many further ones, and the descriptors of all
/// that were considered for the first, which cover the submap evenly. Descriptors are drawn from the block, as those of
/// the features are. The further ones, seldom asked for, cover what was not considered evenly, and change nothing of
/// the first.
fn keypoints(block: &Block<0>, shaped: &[u32], counts: [usize; 2]) -> (Keypoints, Keypoints, Vec<Code>) {
    let (points, normals) = in_voxels(block);
    let [first, further] = counts.map(|count| count.min(KEYPOINTS_MAX));
    let mut considered = spread(&points, shaped, CANDIDATES_PER_KEYPOINT * first);
    let for_first = considered.len();
    considered.extend(spread(&points, &rest(shaped, &considered, points.len()), further));
    let numbers = local_descriptor::describe_points(&points, &normals, &considered);
    let projection = Projection::new();
    let codes: Vec<Code> = numbers[..for_first].iter().map(|n| projection.code(n)).collect();
    let described = |k: usize| block.points[considered[k] as usize].with(projection.pack(&numbers[k]));
    let (mut keypoints, mut others) = (block.like(), block.like());
    keypoints.points.extend(most_distinct(&codes).into_iter().take(first).map(described));
    others.points.extend((for_first..considered.len()).map(described));
    (Keypoints::of_points(keypoints), Keypoints::of_points(others), codes)
}

/// Positions, in their order, of the share of the codes that differ most from the mean one.
fn most_distinct(codes: &[Code]) -> Vec<usize> {
    let mut sums = [0i64; super::descriptor::DIMENSIONS];
    codes.iter().for_each(|code| sums.iter_mut().zip(code).for_each(|(sum, &x)| *sum += i64::from(x)));
    let count = codes.len().max(1) as i64;
    let difference = |code: &Code| {
        code.iter().zip(sums).map(|(&x, sum)| (i64::from(x) * count - sum) / count).map(|d| d * d).sum::<i64>()
    };
    let mut ranked: Vec<(i64, usize)> = codes.iter().enumerate().map(|(k, code)| (-difference(code), k)).collect();
    ranked.sort_unstable();
    ranked.truncate(codes.len().div_ceil(CANDIDATES_PER_KEYPOINT));
    let mut chosen: Vec<usize> = ranked.into_iter().map(|(_, k)| k).collect();
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
#[path = "describe_tests.rs"]
mod tests;

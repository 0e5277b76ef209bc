//! Turns a finished submap into what others and its owner need of it. Heavy (about 15 µs a point) and pure: it runs as
//! a job.

use super::Submap;
use super::block::Block;
use super::cloud::{self, Index, NORMAL_RADIUS_VOXELS, Neighbour, Normal};
use super::descriptor::{self, DIMENSIONS, NEIGHBOURS_MAX, Packed, RADIUS_VOXELS};
use super::features::{FEATURES_MAX, Features, KEYPOINTS_MAX, Keypoints, UNSEEN, VIEWPOINTS_MAX};
use super::sampling::spread;
use super::summary::Summary;
use crate::config::SubmapConfig;
use nalgebra::Vector3;

/// Neighbours that a keypoint needs at least for its descriptor to mean something.
const KEYPOINT_NEIGHBOURS_MIN: usize = 8;
/// Share of the points that may become keypoints: the ones least like the average of their submap. Half keeps the even
/// cover that pays on cluttered scenes and leaves the bare middles of walls out (measured: 7-Scenes unchanged, inlier
/// ratio in a hall of boxes half as high again).
const DISTINCT_SHARE: f64 = 0.5;

/// What [`describe()`] makes of a submap.
#[derive(Clone, Debug, PartialEq)]
pub struct Described {
    /// All points with normals and descriptors, for matching at home.
    pub features: Features,
    /// The few that peers may fetch.
    pub keypoints: Keypoints,
    /// What is gossiped.
    pub summary: Summary,
    /// Half extents of the cloud about the anchor, frame units.
    pub extent: [f32; 3],
}

/// Normals, descriptors, keypoints and summary of a submap.
pub fn describe(submap: &Submap, config: &SubmapConfig) -> Described {
    let points: Vec<Vector3<f64>> =
        submap.cloud.iter().take(FEATURES_MAX).map(|p| Vector3::from(p.map(f64::from))).collect();
    let viewpoint = |k: usize| {
        let keyframe = submap.seen_from.get(k).and_then(|&from| submap.keyframes.get(usize::from(from)));
        keyframe.map_or_else(Vector3::zeros, |t_anchor_body| t_anchor_body.translation)
    };
    let index = Index::new(&points);
    let radius = RADIUS_VOXELS * config.voxel_m;
    let squared_max = (NORMAL_RADIUS_VOXELS * config.voxel_m) * (NORMAL_RADIUS_VOXELS * config.voxel_m);
    let (normals, neighbours): (Vec<Normal>, Vec<Vec<Neighbour>>) = (0..points.len())
        .map(|k| {
            let around = index.within(&points[k], radius);
            let near = &around[..around.partition_point(|n| n.1 <= squared_max)];
            (cloud::normal(&points, near, &points[k], &viewpoint(k)), thinned(around))
        })
        .unzip();
    let descriptors = descriptor::describe_points(&points, &normals, &neighbours);

    let extent = [0, 1, 2].map(|axis| points.iter().fold(0.0, |most: f64, p| most.max(p[axis].abs())));
    let mut features = Block::new(config.voxel_m, extent.iter().fold(0.0, |most: f64, &e| most.max(e)));
    let mut keypoints = features.like();
    let stored: Vec<_> = (0..points.len()).map(|k| features.store(&points[k], &normals[k], descriptors[k])).collect();
    let candidates: Vec<usize> =
        (0..points.len()).filter(|&k| stored[k].is_some() && neighbours[k].len() > KEYPOINT_NEIGHBOURS_MIN).collect();
    let candidates = most_distinct(&candidates, &descriptors);
    let order = spread(&points, &candidates, config.voxel_m, config.keypoints.min(KEYPOINTS_MAX));
    keypoints.points.extend(order.iter().filter_map(|&k| stored[k]));
    let seen_from = |k: usize| -> u8 {
        let from = submap.seen_from.get(k).filter(|&&from| usize::from(from) < VIEWPOINTS_MAX);
        from.and_then(|&from| u8::try_from(from).ok()).unwrap_or(UNSEEN)
    };
    let kept: Vec<usize> = (0..points.len()).filter(|&k| stored[k].is_some()).collect();
    features.points.extend(stored.into_iter().flatten());
    let viewpoints = submap.keyframes.iter().take(VIEWPOINTS_MAX);
    let features = Features {
        block: features,
        viewpoints: viewpoints.map(|t_anchor_body| t_anchor_body.translation.map(|x| x as f32).into()).collect(),
        seen_from: kept.into_iter().map(seen_from).collect(),
    };
    let keypoints = Keypoints(keypoints);
    let summary = Summary::of(&features);
    Described { features, keypoints, summary, extent: extent.map(|e| e as f32) }
}

/// At most [`NEIGHBOURS_MAX`] of the neighbours, evenly over their distances.
fn thinned(neighbours: Vec<Neighbour>) -> Vec<Neighbour> {
    let stride = neighbours.len().div_ceil(NEIGHBOURS_MAX).max(1);
    neighbours.into_iter().step_by(stride).collect()
}

/// The [`DISTINCT_SHARE`] of the candidates whose descriptors differ most from the submap's mean one.
fn most_distinct(candidates: &[usize], descriptors: &[Packed]) -> Vec<usize> {
    let levels: Vec<[u8; DIMENSIONS]> = descriptors.iter().map(descriptor::unpack).collect();
    let count = candidates.len().max(1) as f64;
    let mean: [f64; DIMENSIONS] =
        core::array::from_fn(|b| candidates.iter().map(|&k| f64::from(levels[k][b])).sum::<f64>() / count);
    let difference = |k: usize| -> f64 {
        levels[k].iter().zip(mean).map(|(&level, m)| (f64::from(level) - m) * (f64::from(level) - m)).sum()
    };
    let mut ranked: Vec<(f64, usize)> = candidates.iter().map(|&k| (difference(k), k)).collect();
    ranked.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    ranked.truncate((ranked.len() as f64 * DISTINCT_SHARE).ceil() as usize);
    ranked.into_iter().map(|(_, k)| k).collect()
}

#[cfg(test)]
#[path = "describe_tests.rs"]
mod tests;

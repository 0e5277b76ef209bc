//! Turns a finished submap into what others and its owner need of it. Heavy (about 20 µs a point) and pure: it runs as
//! a job.

use super::block::Block;
use super::cloud::{self, Index, NORMAL_RADIUS_VOXELS, Neighbour, Normal};
use super::descriptor::{self, NEIGHBOURS_MAX, RADIUS_VOXELS};
use super::features::{KEYPOINTS_MAX, FEATURES_MAX, Features, Keypoints};
use super::sampling::spread;
use super::summary::Summary;
use super::Submap;
use crate::config::SubmapConfig;
use nalgebra::Vector3;

/// Neighbours that a keypoint needs at least for its descriptor to mean something.
const KEYPOINT_NEIGHBOURS_MIN: usize = 8;

/// What [`describe`] makes of a submap.
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
    let neighbours: Vec<Vec<Neighbour>> = points
        .iter()
        .map(|p| {
            let mut near = index.within(p, radius);
            near.truncate(NEIGHBOURS_MAX + 1);
            near
        })
        .collect();
    let squared_max = (NORMAL_RADIUS_VOXELS * config.voxel_m) * (NORMAL_RADIUS_VOXELS * config.voxel_m);
    let normals: Vec<Normal> = (0..points.len())
        .map(|k| {
            let near = neighbours[k].partition_point(|n| n.1 <= squared_max);
            cloud::normal(&points, &neighbours[k][..near], &points[k], &viewpoint(k))
        })
        .collect();
    let descriptors = descriptor::describe_points(&points, &normals, &neighbours);

    let extent = [0, 1, 2].map(|axis| points.iter().fold(0.0, |most: f64, p| most.max(p[axis].abs())));
    let mut features = Block::new(config.voxel_m, extent.iter().fold(0.0, |most: f64, &e| most.max(e)));
    let mut keypoints = features.like();
    let stored: Vec<_> = (0..points.len()).map(|k| features.store(&points[k], &normals[k], descriptors[k])).collect();
    let candidates: Vec<usize> =
        (0..points.len()).filter(|&k| stored[k].is_some() && neighbours[k].len() > KEYPOINT_NEIGHBOURS_MIN).collect();
    let order = spread(&points, &candidates, config.voxel_m, config.keypoints.min(KEYPOINTS_MAX));
    keypoints.points.extend(order.iter().filter_map(|&k| stored[k]));
    features.points.extend(stored.into_iter().flatten());

    let (features, keypoints) = (Features(features), Keypoints(keypoints));
    let summary = Summary::of(&features);
    Described { features, keypoints, summary, extent: extent.map(|e| e as f32) }
}

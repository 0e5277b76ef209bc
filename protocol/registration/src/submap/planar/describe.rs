//! Turns a planar submap into what others and its owner need of it: see [`describe`](super::super::describe()).

use super::super::Submap;
use super::super::block::Block;
use super::super::describe::Described;
use super::super::descriptor::PACKED_LEN;
use super::super::features::{Codes, FEATURES_MAX, Features, KEYPOINTS_MAX, Keypoints, UNSEEN, VIEWPOINTS_MAX};
use super::super::sampling::{rest, spread};
use super::super::summary::{Summary, WORDS};
use super::super::surface::Normal;
use super::codec::{Beam, passed};
use super::lines::{Line, lines};
use crate::config::SubmapConfig;
use nalgebra::{Vector2, Vector3};

/// A point in a cell that so many beams passed through was not there all the time.
const TRANSIENT_BEAMS: u8 = 4;
/// Bytes of a packed viewpoint.
const EYE_LEN: usize = 5;
/// Points whose pairs make the summary.
const PAIRED: usize = 160;
/// Edges of the bands of distances that the summary tells apart, voxels.
const BANDS: [f64; 7] = [10.0, 20.0, 35.0, 55.0, 80.0, 120.0, 180.0];
/// Levels of each of its two angles.
const LEVELS: usize = 4;

/// Normals, keypoints and summary of a submap; heights are left out.
pub fn describe(submap: &Submap, config: &SubmapConfig) -> Described {
    let points: Vec<[f32; 3]> = submap.cloud.iter().take(FEATURES_MAX).map(|p| [p[0], p[1], 0.0]).collect();
    let extent = [0, 1, 2].map(|axis| points.iter().fold(0.0, |most: f32, p| most.max(p[axis].abs())));
    let mut block = Block::new(config.voxel_m, extent.iter().fold(0.0, |most, &e| most.max(f64::from(e))));
    let within: Vec<usize> = (0..points.len()).filter(|&k| block.reaches(&points[k])).collect();
    let voxel = block.voxel();
    let flat = |p: &[f32; 3]| Vector2::new(f64::from(p[0]), f64::from(p[1])) / voxel;
    let at: Vec<Vector2<f64>> = within.iter().map(|&k| flat(&points[k])).collect();
    let viewpoint = |k: usize| {
        let keyframe = submap.seen_from.get(within[k]).and_then(|&from| submap.keyframes.get(usize::from(from)));
        keyframe.map_or_else(Vector2::zeros, |t_anchor_body| t_anchor_body.translation.xy() / voxel)
    };
    let mut lines = lines(&at, viewpoint);
    // What beams of the same submap passed through has gone, or came: it is no wall.
    let beam = |k: usize| {
        let normal = lines[k].roughness.map(|_| lines[k].normal);
        Beam { from: viewpoint(k), to: at[k], normal }
    };
    let beams: Vec<Beam> = (0..at.len()).map(beam).collect();
    for (line, beams) in lines.iter_mut().zip(passed(&at, &beams)) {
        if beams >= TRANSIENT_BEAMS {
            line.roughness = None;
        }
    }
    let stored = |(&k, line): (&usize, &Line)| {
        let direction = Vector3::new(line.normal.x, line.normal.y, 0.0);
        let normal = Normal { direction, roughness: line.roughness, neighbours: line.neighbours };
        block.store(&Vector3::from(points[k].map(f64::from)), &normal, [])
    };
    block.points = within.iter().zip(&lines).filter_map(stored).collect();

    let seen_from = |k: &usize| -> u8 {
        let from = submap.seen_from.get(*k).filter(|&&from| usize::from(from) < VIEWPOINTS_MAX);
        from.and_then(|&from| u8::try_from(from).ok()).unwrap_or(UNSEEN)
    };
    let eye = |t_anchor_body: &crate::geometry::Se3| {
        let at = t_anchor_body.translation;
        [at.x as f32, at.y as f32, 0.0]
    };
    let features = Features {
        viewpoints: submap.keyframes.iter().take(VIEWPOINTS_MAX).map(eye).collect(),
        seen_from: within.iter().map(seen_from).collect(),
        codes: Codes::default(),
        landmarks: None,
        block,
    };
    let clear: Vec<u32> = (0..).zip(&lines).filter(|(_, line)| line.roughness.is_some()).map(|(k, _)| k).collect();
    let in_voxels: Vec<[f32; 3]> = at.iter().map(|p| [p.x as f32, p.y as f32, 0.0]).collect();
    let chosen = spread(&in_voxels, &clear, config.keypoints.min(KEYPOINTS_MAX));
    let further =
        spread(&in_voxels, &rest(&clear, &chosen, in_voxels.len()), config.keypoints_further.min(KEYPOINTS_MAX));
    let eyes = |k: u32| {
        let seen = features.viewpoints.get(usize::from(features.seen_from[k as usize]));
        seen.map_or([0; PACKED_LEN], |&[x, y, _]| packed([x, y], features.block.step()))
    };
    let block = |chosen: &[u32]| {
        let mut block = features.block.like();
        block.points.extend(chosen.iter().map(|&k| features.block.points[k as usize].with(eyes(k))));
        Keypoints::of_points(block)
    };
    let further = Some(block(&further)).filter(|further| !further.is_empty());
    let keypoints = block(&chosen).before(further.as_ref());
    let paired: Vec<(Vector2<f64>, Vector2<f64>)> =
        chosen.iter().take(PAIRED).map(|&k| (at[k as usize], lines[k as usize].normal)).collect();
    let summary = Summary::of_shares(config.voxel_m, &shares(&paired));
    Described { features, keypoints, further, summary, extent }
}

/// Where a keypoint was seen from (frame units) in the place of a descriptor, which a point of a floor plan has not: so
/// a peer knows my free space as I do. In position steps; all zero where it is not known.
fn packed(eye: [f32; 2], step: f64) -> [u8; PACKED_LEN] {
    let mut bytes = [0; PACKED_LEN];
    let steps = eye.map(|x| (f64::from(x) / step).round());
    if steps.iter().all(|s| s.abs() <= f64::from(i16::MAX)) {
        let [[x0, x1], [y0, y1]] = steps.map(|s| (s as i16).to_le_bytes());
        bytes[..EYE_LEN].copy_from_slice(&[1, x0, x1, y0, y1]);
    }
    bytes
}

/// What [`packed`] packed.
pub fn unpacked(bytes: &[u8; PACKED_LEN], step: f64) -> Option<Vector2<f64>> {
    let [known, x0, x1, y0, y1, ..] = *bytes;
    let [x, y] = [[x0, x1], [y0, y1]].map(|b| f64::from(i16::from_le_bytes(b)) * step);
    (known == 1).then(|| Vector2::new(x, y))
}

/// How often pairs of oriented points lie so far apart and face one another so: blind to where the submap lies and how
/// it is turned (Wahl et al. 2003, in the plane).
fn shares(points: &[(Vector2<f64>, Vector2<f64>)]) -> [f32; WORDS] {
    let mut shares = [0.0; WORDS];
    let level = |x: f64| ((x * LEVELS as f64) as usize).min(LEVELS - 1);
    for (k, (p, n)) in points.iter().enumerate() {
        for (q, m) in &points[..k] {
            let way = q - p;
            let length = way.norm();
            let band = BANDS.iter().filter(|&&edge| edge <= length).count();
            let towards = (n.dot(&way).abs() + m.dot(&way).abs()) / (2.0 * length.max(1e-9));
            let place = (band * LEVELS + level((1.0 + n.dot(m)) / 2.0)) * LEVELS + level(towards);
            if let Some(share) = shares.get_mut(place) {
                *share += 1.0;
            }
        }
    }
    shares
}

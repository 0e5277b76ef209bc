//! How far off the relations are that the robots' maps give, by relations of the truth: those that were published of
//! the log, else those of each keyframe with the next but some and with the nearest one of every robot.

use super::judge::{Errors, off};
use super::reference::{Reference, mended, moved, nearest};
use super::track::Track;
use merganser_protocol::geometry::Se3;
use merganser_protocol::snapshot::{Snapshot, relation};
use merganser_protocol::time::Stamp;
use std::collections::BTreeMap;

/// A published relation counts if both its ends are as near as this to a keyframe, m and rad together.
const KEYFRAME_NEAR: f64 = 0.1;
/// A relation of the truth to one robot's own way reaches so many keyframes ahead...
const AHEAD: usize = 10;
/// ...and one to another robot's as far as this, m.
const NEAR_M: f64 = 3.0;

/// Errors of relations within one robot by its own map, and between two robots by that of the first named.
pub fn errors(tracks: &[Track], reference: Option<&Reference>, views: &[Snapshot]) -> [Errors; 2] {
    let maps: Vec<Map<'_>> = views.iter().map(|view| Map::new(tracks, view)).collect();
    let mut found = [Errors::new(), Errors::new()];
    let mut take = |a: usize, from: Place, b: usize, to: Place, truth: &Se3| {
        let Some(map) = maps.get(a) else { return };
        if let (Some(from), Some(to)) = (map.at(a, from), map.at(b, to)) {
            found[usize::from(a != b)].push(off(truth, &(from.inverse() * to)));
        }
    };
    match reference.filter(|reference| !reference.relations.is_empty()) {
        Some(reference) => {
            for stated in &reference.relations {
                for (a, b) in (0..tracks.len()).flat_map(|a| (0..tracks.len()).map(move |b| (a, b))) {
                    let place = |robot: usize, stamp| Place::of(&tracks[robot], reference, stamp);
                    if let (Some(from), Some(to)) = (place(a, stated.from), place(b, stated.to)) {
                        take(a, from, b, to, &stated.t_from_to);
                    }
                }
            }
        }
        None => {
            for (a, b) in (0..tracks.len()).flat_map(|a| (0..tracks.len()).map(move |b| (a, b))) {
                for (k, from) in tracks[a].truth.iter().enumerate() {
                    let Some(from) = from else { continue };
                    let other = if a == b { Some(k + AHEAD) } else { near(&tracks[b], from) };
                    let to = other.and_then(|l| Some((l, (*tracks[b].truth.get(l)?)?)));
                    if let Some((l, to)) = to {
                        take(a, Place::keyframe(k), b, Place::keyframe(l), &(from.inverse() * to));
                    }
                }
            }
        }
    }
    found
}

/// The keyframe that truly is nearest, if it is near.
fn near(track: &Track, to: &Se3) -> Option<usize> {
    let apart = |pose: &Se3| (pose.translation - to.translation).norm();
    let all = track.truth.iter().enumerate().filter_map(|(k, pose)| Some((k, apart(pose.as_ref()?))));
    all.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, metres)| *metres <= NEAR_M).map(|(k, _)| k)
}

/// Somewhere on a robot's way: at a keyframe, or between it and the next, where the wheels have it at `raw`.
#[derive(Clone, Copy)]
struct Place {
    keyframe: usize,
    raw: Option<Se3>,
}

impl Place {
    fn keyframe(keyframe: usize) -> Self {
        Self { keyframe, raw: None }
    }

    /// Where a robot was at a scan's stamp; `None` before its first and after its last keyframe.
    fn of(track: &Track, reference: &Reference, stamp: Stamp) -> Option<Self> {
        let next = track.stamps.partition_point(|s| *s <= stamp);
        let keyframe = next.checked_sub(1).filter(|_| next < track.stamps.len())?;
        let (_, raw) = nearest(&reference.odometry, stamp)?;
        // Wheels may be off by a tenth of a radian from one keyframe to the next.
        let near = [keyframe, next].iter().map(|k| moved(&track.raw[*k], &raw)).fold(f64::INFINITY, f64::min);
        if near > KEYFRAME_NEAR {
            return None;
        }
        Some(Self { keyframe, raw: Some(raw) })
    }
}

/// One robot's map.
struct Map<'a> {
    tracks: &'a [Track],
    /// `t_own_anchor` of each robot's anchors.
    anchors: Vec<BTreeMap<u32, Se3>>,
}

impl<'a> Map<'a> {
    fn new(tracks: &'a [Track], view: &Snapshot) -> Self {
        let mut anchors = vec![BTreeMap::new(); tracks.len()];
        for submap in &view.map.submaps {
            let robot = tracks.iter().position(|track| track.robot == submap.robot);
            let stated = submap.t_own_anchor.as_ref().and_then(relation);
            if let (Some(robot), Some(stated)) = (robot, stated) {
                anchors[robot].insert(submap.index, stated.pose);
            }
        }
        Self { tracks, anchors }
    }

    fn at(&self, robot: usize, place: Place) -> Option<Se3> {
        let here = self.keyframe(robot, place.keyframe)?;
        let Some(raw) = place.raw else { return Some(here) };
        let (track, next) = (&self.tracks[robot], place.keyframe + 1);
        let there = self.keyframe(robot, next)?;
        Some(mended([track.raw.get(place.keyframe)?, track.raw.get(next)?], &raw, [&here, &there]))
    }

    fn keyframe(&self, robot: usize, keyframe: usize) -> Option<Se3> {
        let (submap, t_anchor_body) = self.tracks[robot].within.get(keyframe)?;
        Some(*self.anchors[robot].get(submap)? * *t_anchor_body)
    }
}

//! Would I have seen their points? A wrong alignment often lays walls on walls and fits well, but it also puts points
//! of theirs where my sensor looked straight through. This counts such contradictions; it needs my viewpoints, which
//! only I have: the peer judges from its own.

use super::cloud::Index;
use super::features::{Features, Keypoints};
use crate::geometry::Sim3;
use nalgebra::Vector3;

/// Keypoints judged at most: the first are an even cover of the submap.
const JUDGED_MAX: usize = 192;
/// A point of mine this near to a line of sight (voxels) shows that I looked along it...
const BEAM_VOXELS: f64 = 1.0;
/// ...if it lies this far (voxels) behind the judged point...
const BEHIND_VOXELS: f64 = 4.0;
/// ...and no other is this near to the line before that: it may have hidden the rest.
const SHADOW_VOXELS: f64 = 2.0;

/// Share of contradictions among those of their keypoints on which my submap has something to say: `contradicted /
/// (contradicted + confirmed)`, where a keypoint is confirmed by a point of mine within `radius` (my frame's units) and
/// contradicted if I looked through its place. 0 where I have nothing to say.
pub fn contradiction(theirs: &Keypoints, mine: &Features, t_mine_theirs: &Sim3, radius: f64) -> f64 {
    let points: Vec<Vector3<f64>> = mine.surfels().iter().map(|s| s.position).collect();
    let index = Index::new(&points);
    let views = views(mine, &points);
    let (mut confirmed, mut contradicted) = (0.0, 0.0);
    for surfel in theirs.surfels().iter().take(JUDGED_MAX) {
        let at = *t_mine_theirs * surfel.position;
        if index.nearest(&at, radius).is_some() {
            confirmed += 1.0;
        } else if views.iter().any(|view| view.looked_through(&at, mine.voxel())) {
            contradicted += 1.0;
        }
    }
    if contradicted > 0.0 { contradicted / (contradicted + confirmed) } else { 0.0 }
}

/// My points as seen from one of my keyframes.
struct View {
    from: Vector3<f64>,
    /// Offset from the keyframe, and whether that keyframe saw the point.
    points: Vec<(Vector3<f64>, bool)>,
}

fn views(mine: &Features, points: &[Vector3<f64>]) -> Vec<View> {
    let view = |(k, from): (usize, &Vector3<f64>)| {
        let seen = mine.seen_from().iter().map(|&s| usize::from(s) == k);
        View { from: *from, points: points.iter().map(|p| p - from).zip(seen).collect() }
    };
    mine.viewpoints().iter().enumerate().map(view).collect()
}

impl View {
    /// Whether the keyframe saw something well behind `at` and nothing on the way.
    fn looked_through(&self, at: &Vector3<f64>, voxel: f64) -> bool {
        let offset = at - self.from;
        let range = offset.norm();
        let Some(along) = offset.try_normalize(voxel) else { return false };
        let (beam, shadow) = (BEAM_VOXELS * voxel, SHADOW_VOXELS * voxel);
        let behind = range + BEHIND_VOXELS * voxel;
        let mut looked = false;
        for (point, seen) in &self.points {
            let depth = point.dot(&along);
            if depth <= 0.0 {
                continue;
            }
            let aside = point.norm_squared() - depth * depth;
            if aside > shadow * shadow {
                continue;
            }
            if depth < behind {
                return false;
            }
            looked |= *seen && aside <= beam * beam;
        }
        looked
    }
}

#[cfg(test)]
mod tests {
    use super::super::testing::{config, keyframe, room};
    use super::super::{Described, SubmapBuilder, describe};
    use super::*;
    use crate::geometry::Se3;

    fn wall(x: f64) -> impl Iterator<Item = Vector3<f64>> {
        (0..1600).map(move |k| Vector3::new(x, f64::from(k % 40) * 0.1 - 2.0, f64::from(k / 40) * 0.1 - 2.0))
    }

    /// A bumpy board of 1 × 1 m, so that it offers keypoints.
    fn board(x: f64) -> Vec<Vector3<f64>> {
        let at =
            |k: i32| Vector3::new(x + 0.15 * f64::from(k * 7 % 5), f64::from(k % 20) * 0.05, f64::from(k / 20) * 0.05);
        (0..400).map(at).collect()
    }

    fn seen(points: &[Vector3<f64>]) -> Described {
        let mut builder = SubmapBuilder::new(config());
        builder.push(keyframe(1, Se3::identity(), points)).unwrap();
        describe(&builder.flush().unwrap(), &config())
    }

    fn judged(theirs: &[Vector3<f64>], mine: &[Vector3<f64>]) -> f64 {
        contradiction(&seen(theirs).keypoints, &seen(mine).features, &Sim3::identity(), 0.15)
    }

    #[test]
    fn a_board_in_front_of_the_wall_i_saw_is_a_contradiction() {
        let wall: Vec<_> = wall(4.0).collect();
        assert_eq!(judged(&board(2.0), &wall), 1.0);
        // Behind the wall, where I saw nothing, and beside it: I cannot tell.
        assert_eq!(judged(&board(5.0), &wall), 0.0);
        let beside: Vec<_> = board(2.0).iter().map(|p| p + Vector3::new(0.0, 5.0, 0.0)).collect();
        assert_eq!(judged(&beside, &wall), 0.0);
    }

    #[test]
    fn what_i_saw_myself_or_what_was_hidden_is_none() {
        let both: Vec<_> = wall(4.0).chain(board(2.0)).collect();
        assert_eq!(judged(&board(2.0), &both), 0.0);
        // The board hides what stands between it and the wall.
        let small: Vec<_> = board(3.2).iter().map(|p| p - Vector3::new(0.6, 0.0, 0.0)).collect();
        let hidden: Vec<_> = small.iter().map(|p| Vector3::new(p.x + 0.6, 0.3 + p.y * 0.6, 0.3 + p.z * 0.6)).collect();
        assert_eq!(judged(&hidden, &both), 0.0);
    }

    #[test]
    fn points_of_another_keyframe_prove_nothing_and_empty_submaps_are_silent() {
        let wall: Vec<_> = wall(4.0).collect();
        let mut mine = seen(&wall).features;
        mine.seen_from.fill(super::super::features::UNSEEN);
        let theirs = seen(&board(2.0)).keypoints;
        assert_eq!(contradiction(&theirs, &mine, &Sim3::identity(), 0.15), 0.0);
        let (room, nothing) = (room(1), seen(&[]));
        assert_eq!(contradiction(&room.keypoints, &nothing.features, &Sim3::identity(), 0.15), 0.0);
        assert_eq!(contradiction(&nothing.keypoints, &room.features, &Sim3::identity(), 0.15), 0.0);
    }
}

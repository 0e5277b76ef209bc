//! Where a robot's keyframes are. A robot whose scans correct its odometry (`submap.sensor = "laser_2d"`) has two ways:
//! that of the poses its SLAM sent, in the frame *odom*, and that on which its anchors lie, in its frame. Hung from
//! anchors, the first is off by all that was corrected. So [`bodies`] is how a pose in the merged map is to be had.

use super::{MapView, PoseView, pose, relative};
use crate::geometry::Sim3;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// `view/path`: this robot's keyframes in finished submaps of its present frame.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PathView {
    /// The frame, `name/epoch`.
    pub frame: String,
    /// The newest keyframes since this start of the agent, in order; at most
    /// [`PATH_KEYFRAMES_MAX`](crate::agent::PATH_KEYFRAMES_MAX).
    pub keyframes: Vec<KeyframeView>,
    /// Older ones of this start, which are no longer known.
    pub forgotten: u64,
}

/// A keyframe.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct KeyframeView {
    /// Its stamp, s.
    pub stamp_secs: f64,
    /// Index of its submap.
    pub submap: u32,
    /// As the SLAM sent it.
    pub t_odom_body: PoseView,
    /// On the way that anchors lie on; the same where scans do not correct it.
    pub t_frame_body: PoseView,
}

/// `t_own_body` of each keyframe of `path`, in the frame that `map` is given in, by whichever robot:
/// t_own_anchor ∘ t_frame_anchor⁻¹ ∘ t_frame_body with the keyframe's own anchor. If that was condensed away, the last
/// one before it serves, or the first of all. `None` where the map does not know where the frame lies, and of poses
/// that are none.
pub fn bodies(path: &PathView, map: &MapView) -> Vec<Option<Sim3>> {
    let mut moves: BTreeMap<u32, Sim3> = BTreeMap::new();
    for submap in map.submaps.iter().filter(|submap| submap.frame == path.frame) {
        let placed = submap.t_own_anchor.as_ref().and_then(relative).zip(pose(&submap.t_frame_anchor));
        if let Some((t_own_anchor, t_frame_anchor)) = placed {
            moves.insert(submap.index, t_own_anchor.sim() * Sim3::from_se3(&t_frame_anchor.inverse()));
        }
    }
    let body = |keyframe: &KeyframeView| {
        let until = moves.range(..=keyframe.submap).next_back();
        let (_, t_own_frame) = until.or_else(|| moves.iter().next())?;
        Some(*t_own_frame * Sim3::from_se3(&pose(&keyframe.t_frame_body)?))
    };
    path.keyframes.iter().map(body).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Covariance, PoseWithCovariance, Relative, Se3};
    use crate::snapshot::{RelationView, SubmapView};
    use nalgebra::Vector6;

    fn at(x: f64, turn: f64) -> Se3 {
        Se3::exp(&Vector6::new(x, 0.2 * x, 0.0, 0.0, 0.0, turn))
    }

    fn submap(index: u32, t_frame_anchor: Se3, t_own_anchor: Option<Se3>) -> SubmapView {
        let covariance = Covariance::from_sigmas([0.1; 6]).unwrap();
        let t_own_anchor = t_own_anchor.map(|pose| Relative::Metric(PoseWithCovariance { pose, covariance }));
        SubmapView {
            frame: "b/0".into(),
            robot: "b".into(),
            index,
            stamps_secs: [0.0; 2],
            t_frame_anchor: PoseView::from(&t_frame_anchor),
            t_own_anchor: t_own_anchor.as_ref().map(RelationView::from),
        }
    }

    fn keyframe(submap: u32, t_frame_body: Se3) -> KeyframeView {
        let raw = PoseView::from(&at(100.0, 1.0));
        KeyframeView { stamp_secs: 0.0, submap, t_odom_body: raw, t_frame_body: PoseView::from(&t_frame_body) }
    }

    #[test]
    fn a_body_hangs_from_its_own_anchor_or_the_one_before() {
        let anchors = [at(0.0, 0.0), at(4.0, 0.3), at(8.0, 0.5)];
        let placed = [at(1.0, 0.1), at(5.5, 0.2), at(9.0, 0.9)];
        let within = at(0.7, -0.2);
        let path = |submaps: &[u32]| PathView {
            frame: "b/0".into(),
            keyframes: submaps.iter().map(|&k| keyframe(k, anchors[k as usize] * within)).collect(),
            forgotten: 0,
        };
        let map = |which: &[usize]| MapView {
            submaps: which.iter().map(|&k| submap(k as u32, anchors[k], Some(placed[k]))).collect(),
        };
        let near = |a: Option<Sim3>, b: Se3| a.unwrap().to_se3().local(&b).norm() < 1e-9;
        let whole = bodies(&path(&[0, 1, 2]), &map(&[0, 1, 2]));
        assert!((0..3).all(|k| near(whole[k], placed[k] * within)), "{whole:?}");
        // Without the middle anchor its keyframe goes on from the first one, on the way that anchors lie on.
        let condensed = bodies(&path(&[1]), &map(&[0, 2]));
        assert!(near(condensed[0], placed[0] * anchors[0].inverse() * anchors[1] * within));
        let late = bodies(&path(&[0]), &map(&[2]));
        assert!(near(late[0], placed[2] * anchors[2].inverse() * anchors[0] * within));
        let unplaced = MapView { submaps: vec![submap(0, anchors[0], None)] };
        assert_eq!(bodies(&path(&[0]), &unplaced), [None]);
    }
}

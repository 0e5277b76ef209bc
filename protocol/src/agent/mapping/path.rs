//! The way of this robot's keyframes, for its view: where its SLAM put each, and where it lies on the way that the
//! anchors lie on (see [`crate::snapshot::bodies`]).

use crate::geometry::Se3;
use crate::snapshot::{KeyframeView, PoseView};
use crate::submap::Submap;
use crate::time::Stamp;
use std::collections::VecDeque;

/// Keyframes that are remembered: four hours and a half of one a second, 2 MB.
pub const PATH_KEYFRAMES_MAX: usize = 16_384;

/// Keyframes of one epoch since the agent's start.
#[derive(Debug, Default)]
pub(super) struct Path {
    /// Of the open submap.
    open: VecDeque<(Stamp, Se3)>,
    placed: VecDeque<Placed>,
    forgotten: u64,
}

#[derive(Debug)]
struct Placed {
    stamp: Stamp,
    submap: u32,
    t_odom_body: Se3,
    t_frame_body: Se3,
}

impl Path {
    /// A keyframe was taken.
    pub(super) fn take(&mut self, stamp: Stamp, t_odom_body: Se3) {
        self.open.push_back((stamp, t_odom_body));
    }

    /// The submap of the oldest keyframes that are not placed yet.
    pub(super) fn close(&mut self, submap: &Submap) {
        let taken = self.open.drain(..submap.keyframes.len().min(self.open.len()));
        for (t_anchor_body, (stamp, t_odom_body)) in submap.keyframes.iter().zip(taken) {
            let t_frame_body = submap.t_frame_anchor * *t_anchor_body;
            self.placed.push_back(Placed { stamp, submap: submap.index, t_odom_body, t_frame_body });
        }
        while self.placed.len() > PATH_KEYFRAMES_MAX {
            self.placed.pop_front();
            self.forgotten += 1;
        }
    }

    pub(super) fn keyframes(&self) -> Vec<KeyframeView> {
        let view = |placed: &Placed| KeyframeView {
            stamp_secs: placed.stamp.as_secs_f64(),
            submap: placed.submap,
            t_odom_body: PoseView::from(&placed.t_odom_body),
            t_frame_body: PoseView::from(&placed.t_frame_body),
        };
        self.placed.iter().map(view).collect()
    }

    pub(super) fn forgotten(&self) -> u64 {
        self.forgotten
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::SubmapConfig;
    use crate::geometry::{Covariance, PoseWithCovariance};
    use crate::submap::{CovarianceOf, Keyframe, SubmapBuilder};
    use nalgebra::Vector6;

    fn keyframe(k: i32) -> Keyframe {
        let pose = Se3::exp(&Vector6::new(0.6 * f64::from(k), 0.0, 0.0, 0.0, 0.0, 0.05 * f64::from(k)));
        Keyframe {
            stamp: Stamp(i64::from(k) * 500_000_000),
            session: None,
            pose: PoseWithCovariance { pose, covariance: Covariance::from_sigmas([0.01; 6]).unwrap() },
            covariance_of: CovarianceOf::Motion,
            points: vec![[1.0, 0.0, 0.0]],
            marks: Vec::new(),
            place: None,
            up: None,
        }
    }

    /// Every keyframe comes into the submap that holds it, with its stamp; the depth camera's way is the SLAM's.
    #[test]
    fn keyframes_are_where_their_submaps_have_them() {
        let mut builder = SubmapBuilder::new(SubmapConfig::default());
        let (mut path, mut submaps) = (Path::default(), Vec::new());
        for k in 0..40 {
            let closed = builder.push(keyframe(k)).unwrap();
            path.take(keyframe(k).stamp, keyframe(k).pose.pose);
            closed.iter().for_each(|submap| path.close(submap));
            submaps.extend(closed);
        }
        let last = builder.flush();
        last.iter().for_each(|submap| path.close(submap));
        submaps.extend(last);
        assert!(submaps.len() > 3, "{}", submaps.len());
        let seen = path.keyframes();
        assert_eq!((seen.len(), path.forgotten()), (40, 0));
        for (k, view) in (0..).zip(&seen) {
            assert_eq!(view.stamp_secs, keyframe(k).stamp.as_secs_f64());
            let [begin, end] = submaps[view.submap as usize].stamps;
            assert!((begin..=end).contains(&keyframe(k).stamp), "keyframe {k} in submap {}", view.submap);
            let [odom, frame] = [&view.t_odom_body, &view.t_frame_body].map(|t| crate::snapshot::pose(t).unwrap());
            assert!(odom.local(&frame).norm() < 1e-9);
        }
    }

    #[test]
    fn the_oldest_go_and_are_counted() {
        let mut builder = SubmapBuilder::new(SubmapConfig::default());
        builder.push(keyframe(0)).unwrap();
        let one = builder.flush().unwrap();
        let mut path = Path::default();
        for k in 0..=PATH_KEYFRAMES_MAX as u32 {
            path.take(Stamp(i64::from(k)), Se3::identity());
            path.close(&Submap { index: k, ..one.clone() });
            assert_eq!(path.forgotten(), u64::from(k == PATH_KEYFRAMES_MAX as u32));
        }
        assert_eq!((path.placed.len(), path.placed[0].submap), (PATH_KEYFRAMES_MAX, 1));
    }
}

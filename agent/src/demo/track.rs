//! What a recording says of its robot's path: odometry and, where known, truth.

use crate::recording::Recording;
use merganser_protocol::geometry::Se3;

/// One robot's path.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// The robot.
    pub name: String,
    /// Stamps of the keyframes, s, rising.
    pub stamps_secs: Vec<f64>,
    /// `t_frame_body` by odometry alone, one per keyframe, at least one.
    pub odometry: Vec<Se3>,
    /// `t_world_body`, one per keyframe.
    pub truth: Option<Vec<Se3>>,
}

impl Track {
    /// The path in a recording.
    pub fn of(recording: &Recording) -> Self {
        let keyframes = recording.keyframes();
        Self {
            name: recording.manifest().robot.to_string(),
            stamps_secs: keyframes.iter().map(|line| line.stamp.as_secs_f64()).collect(),
            odometry: keyframes.iter().map(|line| line.pose.pose).collect(),
            truth: recording.truth().map(|lines| lines.iter().map(|line| line.pose).collect()),
        }
    }

    /// The way by odometry, m.
    pub fn driven_m(&self) -> f64 {
        self.odometry.windows(2).map(|two| (two[1].translation - two[0].translation).norm()).sum()
    }

    /// `t_world_frame`: where the robot's local frame truly lies. A frame is defined by its first keyframe, where the
    /// odometry has not drifted yet.
    pub fn t_world_frame(&self) -> Option<Se3> {
        Some(*self.truth.as_ref()?.first()? * self.odometry.first()?.inverse())
    }
}

//! What a recording says of its robot's path: odometry and, where known, truth.

use crate::recording::Recording;
use merganser_protocol::geometry::{Se3, Sim3, So3};
use merganser_protocol::wire::fact::ScaleKind;
use nalgebra::Vector3;

/// One robot's path.
#[derive(Clone, Debug, PartialEq)]
pub struct Track {
    /// The robot.
    pub name: String,
    /// Stamps of the keyframes, s, rising.
    pub stamps_secs: Vec<f64>,
    /// `t_frame_body` by odometry alone, one per keyframe, at least one.
    pub odometry: Vec<Se3>,
    /// Whether the robot's SLAM knows the metre.
    pub scale: ScaleKind,
    /// What one is in the odometry, m: 1 where the robot's SLAM knows the metre. `None` where nobody knows.
    pub unit_m: Option<f64>,
    /// `t_world_body`, m, one per keyframe.
    pub truth: Option<Vec<Se3>>,
}

impl Track {
    /// The path in a recording.
    pub fn of(recording: &Recording) -> Self {
        let keyframes = recording.keyframes();
        let manifest = recording.manifest();
        let scale = manifest.config.submap.scale;
        let unit_m = match scale {
            ScaleKind::Metric => Some(1.0),
            ScaleKind::Unknown => manifest.unit_m,
        };
        Self {
            name: manifest.robot.to_string(),
            stamps_secs: keyframes.iter().map(|line| line.stamp.as_secs_f64()).collect(),
            odometry: keyframes.iter().map(|line| line.pose.pose).collect(),
            scale,
            unit_m,
            truth: recording.truth().map(|lines| lines.iter().map(|line| line.pose).collect()),
        }
    }

    /// The way by odometry, m; in its own unit where nobody knows how long that is.
    pub fn driven_m(&self) -> f64 {
        let steps = self.odometry.windows(2).map(|two| (two[1].translation - two[0].translation).norm());
        steps.sum::<f64>() * self.unit_m.unwrap_or(1.0)
    }

    /// `t_world_frame`: where the robot's local frame truly lies, and what its unit is, m. A frame is defined by its
    /// first keyframe, where the odometry has not drifted yet. `None` without truth or unit.
    pub fn t_world_frame(&self) -> Option<Sim3> {
        let unit = Sim3::new(So3::identity(), Vector3::zeros(), self.unit_m?);
        let t_world_body = Sim3::from_se3(self.truth.as_ref()?.first()?);
        Some(t_world_body * unit * Sim3::from_se3(&self.odometry.first()?.inverse()))
    }
}

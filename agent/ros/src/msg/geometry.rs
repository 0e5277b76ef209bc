//! Poses, odometry and transforms.

use super::{Header, message};
use merganser_geometry::Se3;

message! {
    /// `geometry_msgs/Vector3` and `geometry_msgs/Point`, m or m/s or rad/s.
    Vector3 {
        /// Along x.
        x: f64,
        /// Along y.
        y: f64,
        /// Along z.
        z: f64,
    }
}

message! {
    /// `geometry_msgs/Quaternion`.
    Quaternion {
        /// i.
        x: f64,
        /// j.
        y: f64,
        /// k.
        z: f64,
        /// The real part.
        w: f64,
    }
}

message! {
    /// `geometry_msgs/Pose`.
    Pose {
        /// m.
        position: Vector3,
        /// Need not be of length 1.
        orientation: Quaternion,
    }
}

message! {
    /// `geometry_msgs/PoseWithCovariance`.
    PoseWithCovariance {
        /// The pose.
        pose: Pose,
        /// 6×6 row by row: x, y, z, then rotation about the fixed axes x, y, z of the frame; m², rad².
        covariance: [f64; 36],
    }
}

message! {
    /// `geometry_msgs/Twist`.
    Twist {
        /// m/s.
        linear: Vector3,
        /// rad/s.
        angular: Vector3,
    }
}

message! {
    /// `geometry_msgs/TwistWithCovariance`.
    TwistWithCovariance {
        /// The twist.
        twist: Twist,
        /// 6×6 row by row.
        covariance: [f64; 36],
    }
}

message! {
    /// `nav_msgs/Odometry`: the pose of `child_frame_id` in the header's frame.
    Odometry = "nav_msgs/Odometry" {
        /// When, and the odometry's frame.
        header: Header,
        /// The body.
        child_frame_id: String,
        /// `t_odom_body`.
        pose: PoseWithCovariance,
        /// Of the body, in its own frame.
        twist: TwistWithCovariance,
    }
}

message! {
    /// `geometry_msgs/PoseStamped`.
    PoseStamped = "geometry_msgs/PoseStamped" {
        /// When, and the frame of the pose.
        header: Header,
        /// The pose of who publishes it.
        pose: Pose,
    }
}

message! {
    /// `geometry_msgs/PoseWithCovarianceStamped`.
    PoseWithCovarianceStamped = "geometry_msgs/PoseWithCovarianceStamped" {
        /// When, and the frame of the pose.
        header: Header,
        /// The pose of who publishes it.
        pose: PoseWithCovariance,
    }
}

message! {
    /// `geometry_msgs/Transform`.
    Transform {
        /// m.
        translation: Vector3,
        /// Need not be of length 1.
        rotation: Quaternion,
    }
}

message! {
    /// `geometry_msgs/TransformStamped`: `t_parent_child`.
    TransformStamped {
        /// When, and the parent.
        header: Header,
        /// The child.
        child_frame_id: String,
        /// Maps coordinates of the child to those of the parent.
        transform: Transform,
    }
}

message! {
    /// `tf2_msgs/TFMessage`, and `tf/tfMessage` of old.
    TfMessage = "tf2_msgs/TFMessage" {
        /// The transforms.
        transforms: Vec<TransformStamped>,
    }
}

impl Quaternion {
    /// x, y, z, w.
    pub fn xyzw(&self) -> [f64; 4] {
        [self.x, self.y, self.z, self.w]
    }
}

impl Vector3 {
    /// x, y, z.
    pub fn xyz(&self) -> [f64; 3] {
        [self.x, self.y, self.z]
    }
}

impl Pose {
    /// The pose; `None` if the quaternion has no direction, or a number is not finite or beyond
    /// [`crate::limits::COORDINATE_MAX`].
    pub fn se3(&self) -> Option<Se3> {
        se3(&self.position, &self.orientation)
    }
}

impl Transform {
    /// As [`Pose::se3`].
    pub fn se3(&self) -> Option<Se3> {
        se3(&self.translation, &self.rotation)
    }
}

fn se3(translation: &Vector3, rotation: &Quaternion) -> Option<Se3> {
    let near = translation.xyz().iter().all(|x| x.abs() <= crate::limits::COORDINATE_MAX); // false for NaN
    if near { Se3::from_xyzw(rotation.xyzw(), translation.xyz()) } else { None }
}

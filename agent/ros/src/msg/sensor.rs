//! Cameras and inertial sensors.

use super::geometry::{Quaternion, Vector3};
use super::{Header, message};
use crate::wire::Blob;

message! {
    /// `sensor_msgs/RegionOfInterest`.
    RegionOfInterest {
        /// Pixels.
        x_offset: u32,
        /// Pixels.
        y_offset: u32,
        /// Pixels.
        height: u32,
        /// Pixels.
        width: u32,
        /// Whether the region is to be rectified.
        do_rectify: bool,
    }
}

message! {
    /// `sensor_msgs/CameraInfo`.
    CameraInfo = "sensor_msgs/CameraInfo" {
        /// When, and the camera's optical frame: x right, y down, z forward.
        header: Header,
        /// Pixels.
        height: u32,
        /// Pixels.
        width: u32,
        /// Such as `plumb_bob`.
        distortion_model: String,
        /// Of the distortion.
        d: Vec<f64>,
        /// 3×3 row by row: intrinsics of the raw image, pixels.
        k: [f64; 9],
        /// 3×3 row by row: rectification.
        r: [f64; 9],
        /// 3×4 row by row: intrinsics of the rectified image, pixels.
        p: [f64; 12],
        /// Pixels put together along a row; 0 is 1.
        binning_x: u32,
        /// Pixels put together along a column; 0 is 1.
        binning_y: u32,
        /// Part of the image that is sent.
        roi: RegionOfInterest,
    }
}

message! {
    /// `sensor_msgs/Image`; of depth if `encoding` is `16UC1` (mm) or `32FC1` (m).
    Image = "sensor_msgs/Image" {
        /// When, and the camera's optical frame.
        header: Header,
        /// Rows.
        height: u32,
        /// Pixels of a row.
        width: u32,
        /// What a pixel is.
        encoding: String,
        /// Whether numbers are big-endian.
        is_bigendian: u8,
        /// Bytes of a row.
        step: u32,
        /// The pixels, row by row.
        data: Blob,
    }
}

message! {
    /// `sensor_msgs/Imu`.
    Imu = "sensor_msgs/Imu" {
        /// When, and the sensor's frame.
        header: Header,
        /// Of the sensor.
        orientation: Quaternion,
        /// 3×3 row by row, rad²; -1 first if there is no orientation.
        orientation_covariance: [f64; 9],
        /// rad/s.
        angular_velocity: Vector3,
        /// 3×3 row by row.
        angular_velocity_covariance: [f64; 9],
        /// m/s², gravity included.
        linear_acceleration: Vector3,
        /// 3×3 row by row.
        linear_acceleration_covariance: [f64; 9],
    }
}

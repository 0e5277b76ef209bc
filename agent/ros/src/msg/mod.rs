//! Messages of ROS that are read, each declared as its `.msg` file has it. Fields that nothing here needs are read all
//! the same, so that a message of another type does not pass for this one.

mod cloud;
mod geometry;
mod scan;
mod sensor;

pub use cloud::{CloudError, PointCloud2, PointField};
pub use geometry::{
    Odometry, Pose, PoseStamped, PoseWithCovariance, PoseWithCovarianceStamped, Quaternion, TfMessage, Transform,
    TransformStamped, Twist, TwistWithCovariance, Vector3,
};
pub use scan::LaserScan;
pub use sensor::{CameraInfo, Image, Imu, RegionOfInterest};

use crate::wire::{Field, Sink, Source, WireError};

/// Declares a message: its fields in their order.
macro_rules! message {
    ($(#[$doc:meta])* $name:ident $(= $kind:literal)? { $($(#[$field_doc:meta])* $field:ident: $type:ty,)* }) => {
        $(#[$doc])*
        #[derive(Clone, Debug, PartialEq)]
        pub struct $name {
            $($(#[$field_doc])* pub $field: $type,)*
        }

        impl $crate::wire::Field for $name {
            const BYTES_MIN: usize = 0 $(+ <$type as $crate::wire::Field>::BYTES_MIN)*;
            fn read<'a, S: $crate::wire::Source<'a>>(
                source: &mut S,
                _: &'static str,
            ) -> Result<Self, $crate::wire::WireError> {
                Ok(Self { $($field: <$type as $crate::wire::Field>::read(source, stringify!($field))?,)* })
            }
            fn write<S: $crate::wire::Sink>(&self, sink: &mut S) {
                $(self.$field.write(sink);)*
            }
        }

        $(impl $crate::wire::Message for $name {
            const TYPE: &'static str = $kind;
        })?
    };
}
pub(crate) use message;

/// `std_msgs/Header`. The `seq` of ROS 1 is not kept.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Header {
    /// Nanoseconds since 1970.
    pub stamp_ns: i64,
    /// The frame that the message is in; ROS 1 of old may write it with a leading slash.
    pub frame_id: String,
}

const NANOS: i64 = 1_000_000_000;

impl Header {
    /// The frame without the leading slash of old.
    pub fn frame(&self) -> &str {
        plain_frame(&self.frame_id)
    }
}

/// The frame without the leading slash of old.
pub fn plain_frame(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

impl Field for Header {
    const BYTES_MIN: usize = 12;
    fn read<'a, S: Source<'a>>(source: &mut S, _: &'static str) -> Result<Self, WireError> {
        if S::IS_ROS1 {
            source.u32("header.seq")?;
        }
        let secs = source.u32("header.stamp")?;
        let nanos = i64::from(source.u32("header.stamp")?);
        // ROS 1 counts seconds without a sign, until 2106.
        let secs = if S::IS_ROS1 { i64::from(secs) } else { i64::from(secs as i32) };
        Ok(Self { stamp_ns: secs * NANOS + nanos, frame_id: String::read(source, "header.frame_id")? })
    }
    fn write<S: Sink>(&self, sink: &mut S) {
        if S::IS_ROS1 {
            sink.u32(0);
        }
        sink.u32(self.stamp_ns.div_euclid(NANOS) as u32);
        sink.u32(self.stamp_ns.rem_euclid(NANOS) as u32);
        self.frame_id.write(sink);
    }
}

#[cfg(test)]
mod tests;

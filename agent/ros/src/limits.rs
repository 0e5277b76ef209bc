//! What is read at most; `protocol/docs/LIMITS.md` lists them.

/// Bytes of a message at most: a cloud of a million points of 128 bytes.
pub const MESSAGE_BYTES_MAX: usize = 128_000_000;
/// Bytes of a chunk of a bag at most, packed or not; recorders write some megabytes.
pub const CHUNK_BYTES_MAX: usize = 256_000_000;
/// Bytes of the header of a ROS 1 record at most; it holds a message's definition.
pub const RECORD_HEADER_BYTES_MAX: usize = 4_000_000;
/// Topics of a bag at most.
pub const TOPICS_MAX: usize = 10_000;
/// Files of a bag at most.
pub const FILES_MAX: usize = 10_000;
/// Damaged places of a bag that are told; the others are counted.
pub const DAMAGE_TOLD_MAX: usize = 16;
/// Frames of a tree of transforms at most.
pub const FRAMES_MAX: usize = 4_096;
/// Transforms kept of a tree at most; a link that does not move needs two.
pub const TRANSFORMS_MAX: usize = 2_000_000;
/// Transforms of a link by which another may come late.
pub const LATE_MAX: usize = 1_000;
/// How far a stamp may lie before the newest that was received, ns: more is a clock that was set back.
pub const REORDER_NS_MAX: i64 = 1_000_000_000;
/// Bytes of a frame's name at most.
pub const FRAME_BYTES_MAX: usize = 256;
/// Transforms between a cloud and the body at most.
pub const CHAIN_MAX: usize = 64;
/// Poses of one odometry at most: five hours at 50 Hz.
pub const POSES_MAX: usize = 1_000_000;
/// Clouds of one robot at most, of which keyframes are chosen: 27 hours at 10 Hz.
pub const CLOUDS_MAX: usize = 1_000_000;
/// Pairs of frames (of odometry and body) that one topic names and that are told apart, at most.
pub const CLOUD_FRAMES_MAX: usize = 64;
/// Points of a cloud at most, measured or not.
pub const POINTS_MAX: usize = 1_000_000;
/// Points that a keyframe keeps of a cloud, at most; of larger ones every second, third… is taken.
pub const POINTS_KEPT_MAX: usize = 100_000;
/// Time between two poses, s, across which a third is interpolated at most.
pub const GAP_SECS_MAX: f64 = 1.0;
/// Coordinates at most, m.
pub const COORDINATE_MAX: f64 = 1e7;

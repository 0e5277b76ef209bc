//! Everything about the core that can be tuned. Each knob says what it means, how it relates to the others and how to
//! choose it; [`Config::validate`] refuses what cannot work.

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Standard deviation of a vertical that comes without one, about each horizontal axis, rad: what SLAMs with an
/// inertial sensor reach, and to spare.
pub const UP_SIGMA_RAD: f64 = 0.02;
/// Standard deviations of a vertical that may be stated, rad. Below it nothing is mounted so exactly; above it nothing
/// is told.
pub const UP_SIGMA_RANGE_RAD: core::ops::RangeInclusive<f64> = 1e-3..=0.5;
/// A pose on a link, bytes (DESIGN §5).
const POSE_BYTES: f64 = 160.0;

/// The core's configuration. Lengths are in metres, times in seconds, angles in degrees where the name says so.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Config {
    /// Cutting keyframes into submaps and describing them.
    pub submap: SubmapConfig,
    /// Aligning pairs of submaps.
    pub align: AlignConfig,
    /// Merging frames and solving the joint estimate.
    pub estimate: EstimateConfig,
    /// Replication.
    pub gossip: GossipConfig,
}

/// How keyframes become submaps.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SubmapConfig {
    /// What makes the points.
    pub sensor: Sensor,
    /// Edge of the thinning voxel. Choose the sensor's noise times three or so: 0.05 for depth cameras, 0.5 for
    /// spinning LiDAR outdoors. Landmarks are not thinned, but it is the unit of their noise, too.
    pub voxel_m: f64,
    /// A submap ends after the robot moved this far...
    pub distance_m: f64,
    /// ...or turned this much...
    pub rotation_deg: f64,
    /// ...or after this many keyframes...
    pub keyframes_max: u32,
    /// ...or with the first keyframe so long after its first, unless the robot stood all the time: odometry that rests
    /// on inertia drifts by the second.
    pub secs_max: f64,
    /// ...or before a motion with which the position along it would be known only to this standard deviation (the
    /// widest axis): a cloud that is bent by more says little. Choose several times what the odometry gathers in
    /// `distance_m`...
    pub sigma_max_m: f64,
    /// ...or its rotation only to this.
    pub sigma_max_deg: f64,
    /// Points kept per submap after thinning (memory bound).
    pub points_max: usize,
    /// Keypoints offered to others at first, 21 bytes each: 330, and the address of the further ones, are 7.0 kB.
    pub keypoints: usize,
    /// Further ones, for a second look at a pair that was refused where the joint estimate says that it overlaps. None
    /// with 0.
    pub keypoints_further: usize,
    /// Whether frame units are metres.
    pub scale: crate::kinds::ScaleKind,
    /// Odometry standard deviation assumed across a gap in the keyframes, per metre travelled.
    pub gap_sigma_per_m: f64,
    /// The fastest that the robot drives or flies. A keyframe farther than this lets it be is refused, and several that
    /// go on from there begin a new epoch; within `distance_m` of the last one, none is. Twice the robot's top speed is
    /// a good choice. Without effect where the scale is unknown: there, and besides, steps are held against those
    /// before.
    pub speed_max_m_s: f64,
    /// The fastest that it turns, likewise; within `rotation_deg`, none is refused.
    pub turn_max_deg_s: f64,
    /// Who tells which way is up. A pair of submaps that both know it is aligned surer and for less.
    pub gravity: Gravity,
    /// Where the frame tells: standard deviation of its z axis from the vertical, about each horizontal axis. Most
    /// SLAMs with an inertial sensor stay below 0.02; a car's on hilly streets without one below 0.1.
    pub gravity_sigma_rad: f64,
}

impl Default for SubmapConfig {
    fn default() -> Self {
        Self {
            sensor: Sensor::Points3d,
            voxel_m: 0.1,
            distance_m: 2.0,
            rotation_deg: 60.0,
            keyframes_max: 10,
            secs_max: 120.0,
            sigma_max_m: 2.0,
            sigma_max_deg: 30.0,
            points_max: 20_000,
            keypoints: 330,
            keypoints_further: 330,
            scale: crate::kinds::ScaleKind::Metric,
            gap_sigma_per_m: 0.1,
            speed_max_m_s: 50.0,
            turn_max_deg_s: 360.0,
            gravity: Gravity::Keyframes,
            gravity_sigma_rad: UP_SIGMA_RAD,
        }
    }
}

/// What makes the points, hence how submaps are described and aligned. Choose it alike on all robots of a swarm: a
/// planar submap and one in space are not compared.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Sensor {
    /// Surfaces in space as a depth camera or stereo sees them: bent alike in all views of a place, which an alignment
    /// reckons with. The choice for a sensor of which nothing is known.
    #[default]
    #[serde(rename = "points_3d")]
    Points3d,
    /// Surfaces in space as a 3-D LiDAR sees them: noisy and not bent, so that alignments are surer by several times.
    #[serde(rename = "lidar_3d")]
    Lidar3d,
    /// A laser that scans the plane in which the robot drives. Poses are taken as planar, the keyframes' motions are
    /// sharpened by scan matching, and nothing is claimed to be known of height and tilt.
    #[serde(rename = "laser_2d")]
    Laser2d,
    /// Landmarks in space, as a visual SLAM keeps them: few, each with a covariance, and known by a label or a
    /// descriptor.
    #[serde(rename = "landmarks")]
    Landmarks,
    /// Landmarks on the plane in which the robot drives, such as range and bearing give them. Poses are taken as
    /// planar, heights are left out, and nothing is claimed to be known of height and tilt.
    #[serde(rename = "landmarks_2d")]
    Landmarks2d,
}

/// Who tells which way is up.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Gravity {
    /// Each keyframe itself, if it says so (`up`).
    #[default]
    Keyframes,
    /// The frame: its z axis points up, as that of SLAMs with an inertial sensor does. A keyframe's own word goes
    /// before.
    FrameZ,
}

impl Sensor {
    /// Whether poses have three degrees of freedom.
    pub fn is_planar(self) -> bool {
        match self {
            Self::Laser2d | Self::Landmarks2d => true,
            Self::Points3d | Self::Lidar3d | Self::Landmarks => false,
        }
    }

    /// Whether points are landmarks.
    pub fn sees_landmarks(self) -> bool {
        match self {
            Self::Landmarks | Self::Landmarks2d => true,
            Self::Points3d | Self::Lidar3d | Self::Laser2d => false,
        }
    }
}

/// How two submaps are aligned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AlignConfig {
    /// Upper bound of the unknown noise scale of correspondences, in voxels. The estimate of the noise itself is
    /// marginalised below this.
    pub sigma_max_voxels: f64,
    /// An alignment needs log₁₀ NFA below this.
    pub log10_nfa_max: f64,
    /// ...where a scale is unknown, or of landmarks in space, at least this support (sum of inlier probabilities;
    /// elsewhere clouds judge)...
    pub support_min: f64,
    /// ...and at least this share of keypoints with a counterpart in the other cloud.
    pub fit_min: f64,
    /// Pairs worked on at once.
    pub jobs_max: usize,
    /// Candidate pairs remembered.
    pub candidates_max: usize,
    /// Similarity of summaries (0 to 1) from which a pair is a candidate.
    pub similarity_min: f64,
    /// Bytes of keypoints and facts per second, in the mean, for aligning further what has merged already: a longer
    /// drive and a surer map. Until two frames have merged they are aligned as fast as the link lets.
    pub further_bytes_per_sec: f64,
}

impl Default for AlignConfig {
    fn default() -> Self {
        Self {
            sigma_max_voxels: 1.5,
            log10_nfa_max: -4.0,
            support_min: 8.0,
            fit_min: 0.2,
            jobs_max: 2,
            candidates_max: 4096,
            similarity_min: 0.0,
            further_bytes_per_sec: 2_000.0,
        }
    }
}

/// When frames merge and how the joint estimate is solved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct EstimateConfig {
    /// Mutually consistent, agreed alignments that two frames need before they merge. Below 3 a single mistake can
    /// merge wrongly.
    pub alignments_min: usize,
    /// Frame-level log₁₀ NFA bound.
    pub log10_nfa_max: f64,
    /// Largest covariance scale tried when separating true from false alignments.
    pub covariance_scale_max: f64,
    /// Levenberg–Marquardt iterations at most.
    pub iterations_max: usize,
    /// Shortest time between two joint solves.
    pub interval_secs: f64,
}

impl Default for EstimateConfig {
    fn default() -> Self {
        Self {
            alignments_min: 3,
            log10_nfa_max: -4.0,
            covariance_scale_max: 3.0,
            iterations_max: 50,
            interval_secs: 0.25,
        }
    }
}

/// How facts spread.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GossipConfig {
    /// Longest time between two announcements of the root hash. They come this rarely only while nothing changes.
    pub have_secs: f64,
    /// Shortest time between two pose beacons: each tells of a keyframe at once. One that tells nothing new, of a robot
    /// that stands, waits 2.5 times as long.
    pub pose_secs: f64,
    /// Bytes of entries in one sync answer at most.
    pub delta_bytes_max: usize,
    /// Bytes of keypoint blobs asked for per second at most: leave room for poses and facts on the slowest link.
    pub blob_bytes_per_sec: f64,
    /// Bytes that this robot sends per second at most, a broadcast counted once; hence no link carries more from it.
    /// Poses come first, then new facts, then repair, then announcements and questions, and blobs take what is left.
    /// Choose about half of what the slowest link carries; poses (about 160 B each, every `pose_secs`) may take half
    /// of this at most.
    pub link_bytes_per_sec: f64,
    /// How long an unanswered question is waited for.
    pub answer_secs: f64,
    /// Entries of our own log from which on it is replaced by what still counts of it; 0 for never.
    pub condense_entries: u32,
    /// Entries held per robot and epoch at most.
    pub entries_per_frame_max: u32,
    /// Epochs held per robot at most. A robot that begins one more gives up its oldest.
    pub epochs_per_robot_max: usize,
    /// Bytes of entries held at most, in memory and on disk: each robot of the roster may fill an equal share of it, of
    /// [`MEMBER_BYTES_MIN`] at least.
    pub facts_bytes_max: usize,
}

/// Least share of a member in `gossip.facts_bytes_max`, bytes: some thirty entries of the largest size.
pub const MEMBER_BYTES_MIN: usize = 1 << 16;

impl GossipConfig {
    /// What the entries of one of so many members may be counted for, bytes.
    pub fn member_bytes_max(&self, members: usize) -> usize {
        (self.facts_bytes_max / members.max(1)).max(MEMBER_BYTES_MIN)
    }
}

impl Default for GossipConfig {
    fn default() -> Self {
        Self {
            have_secs: 16.0,
            pose_secs: 0.5,
            delta_bytes_max: 64 * 1024,
            blob_bytes_per_sec: 250_000.0,
            link_bytes_per_sec: 1_000_000.0,
            answer_secs: 2.0,
            condense_entries: 1_000,
            entries_per_frame_max: 100_000,
            epochs_per_robot_max: 64,
            facts_bytes_max: 256 << 20,
        }
    }
}

/// A configuration value that cannot work.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("{key} = {value}: {mend}")]
pub struct ConfigError {
    /// Dotted name of the key.
    pub key: &'static str,
    /// The value it has.
    pub value: f64,
    /// What it should be.
    pub mend: &'static str,
}

impl Config {
    /// Checks every knob.
    ///
    /// # Errors
    /// [`ConfigError`] for the first value out of range.
    pub fn validate(&self) -> Result<(), ConfigError> {
        let (s, a, e, g) = (&self.submap, &self.align, &self.estimate, &self.gossip);
        let range = |key, value: f64, low: f64, high: f64, mend| {
            if value.is_finite() && (low..=high).contains(&value) {
                Ok(())
            } else {
                Err(ConfigError { key, value, mend })
            }
        };
        range("submap.voxel_m", s.voxel_m, 1e-3, 10.0, "use 0.001 to 10 m")?;
        range("submap.distance_m", s.distance_m, 0.01, 1e4, "use 0.01 to 10000 m")?;
        range("submap.rotation_deg", s.rotation_deg, 1.0, 1e6, "use at least 1 degree")?;
        range("submap.keyframes_max", f64::from(s.keyframes_max), 1.0, 1e4, "use 1 to 10000")?;
        range("submap.secs_max", s.secs_max, 1.0, 1e6, "use 1 to 1000000 s")?;
        range("submap.sigma_max_m", s.sigma_max_m, 1e-3, 1e4, "use 0.001 to 10000 m")?;
        range("submap.sigma_max_deg", s.sigma_max_deg, 0.01, 1e6, "use at least 0.01 degrees")?;
        range("submap.points_max", s.points_max as f64, 100.0, 1e6, "use 100 to 1000000 points")?;
        range("submap.keypoints", s.keypoints as f64, 16.0, 1024.0, "use 16 to 1024 keypoints")?;
        range("submap.keypoints_further", s.keypoints_further as f64, 0.0, 1024.0, "use 0 (none) to 1024 keypoints")?;
        range("submap.gap_sigma_per_m", s.gap_sigma_per_m, 1e-4, 10.0, "use 0.0001 to 10")?;
        range("submap.speed_max_m_s", s.speed_max_m_s, 0.01, 1e4, "use 0.01 to 10000 m/s")?;
        range("submap.turn_max_deg_s", s.turn_max_deg_s, 1.0, 1e6, "use at least 1 degree per second")?;
        let up = UP_SIGMA_RANGE_RAD;
        range("submap.gravity_sigma_rad", s.gravity_sigma_rad, *up.start(), *up.end(), "use 0.001 to 0.5 rad")?;
        range("align.sigma_max_voxels", a.sigma_max_voxels, 0.1, 10.0, "use 0.1 to 10 voxels")?;
        range("align.log10_nfa_max", a.log10_nfa_max, -300.0, 0.0, "use a value from -300 to 0")?;
        range("align.support_min", a.support_min, 3.0, 1e4, "use at least 3")?;
        range("align.fit_min", a.fit_min, 0.0, 1.0, "use 0 to 1")?;
        range("align.jobs_max", a.jobs_max as f64, 1.0, 64.0, "use 1 to 64")?;
        range("align.candidates_max", a.candidates_max as f64, 1.0, 1e6, "use 1 to 1000000")?;
        range("align.similarity_min", a.similarity_min, 0.0, 1.0, "use 0 to 1")?;
        range("align.further_bytes_per_sec", a.further_bytes_per_sec, 10.0, 1e9, "use 10 to 1e9 bytes per second")?;
        range("estimate.alignments_min", e.alignments_min as f64, 1.0, 1e3, "use 1 to 1000; 3 is safe")?;
        range("estimate.log10_nfa_max", e.log10_nfa_max, -300.0, 0.0, "use a value from -300 to 0")?;
        range("estimate.covariance_scale_max", e.covariance_scale_max, 1.0, 10.0, "use 1 to 10")?;
        range("estimate.iterations_max", e.iterations_max as f64, 1.0, 1e4, "use 1 to 10000")?;
        range("estimate.interval_secs", e.interval_secs, 0.0, 3600.0, "use 0 to 3600 s")?;
        range("gossip.have_secs", g.have_secs, 0.01, 3600.0, "use 0.01 to 3600 s")?;
        range("gossip.pose_secs", g.pose_secs, 0.01, 3600.0, "use 0.01 to 3600 s")?;
        range("gossip.delta_bytes_max", g.delta_bytes_max as f64, 4096.0, 65536.0, "use 4096 to 65536 bytes")?;
        range("gossip.blob_bytes_per_sec", g.blob_bytes_per_sec, 1e3, 1e9, "use 1000 to 1e9 bytes per second")?;
        range("gossip.link_bytes_per_sec", g.link_bytes_per_sec, 2e3, 1e9, "use 2000 to 1e9 bytes per second")?;
        let poses = 2.0 * POSE_BYTES / g.pose_secs;
        let mend = "poses alone would take more than half of it; raise it, or gossip.pose_secs";
        range("gossip.link_bytes_per_sec", g.link_bytes_per_sec, poses, 1e9, mend)?;
        range("gossip.answer_secs", g.answer_secs, 0.01, 600.0, "use 0.01 to 600 s")?;
        range("gossip.condense_entries", f64::from(g.condense_entries), 0.0, 1e7, "use 0 (never) to 10000000")?;
        range("gossip.entries_per_frame_max", f64::from(g.entries_per_frame_max), 1.0, 1e7, "use 1 to 10000000")?;
        range("gossip.epochs_per_robot_max", g.epochs_per_robot_max as f64, 1.0, 1e4, "use 1 to 10000")?;
        range("gossip.facts_bytes_max", g.facts_bytes_max as f64, 65_536.0, 1e11, "use 65536 to 1e11 bytes")
    }
}

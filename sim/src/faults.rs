//! The fault schedule: what happens to links, processes and disks, and when. Faults on messages (loss, delay…) are drawn
//! per message by the network; these are the ones with a beginning and an end.

use serde::{Deserialize, Serialize};

/// One scheduled fault. Times are in seconds since the start of the run; robots go by name.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Fault {
    /// No message passes between different groups. A robot in no group is cut off from all groups.
    Partition {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// The groups.
        groups: Vec<Vec<String>>,
    },
    /// One robot neither hears nor is heard.
    Isolate {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// Messages pass from `to` to `from` only.
    OneWay {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Whose messages are lost.
        from: String,
        /// On the way to whom.
        to: String,
    },
    /// The process is killed, and started again on the same store.
    Kill {
        /// Start, s.
        at: f64,
        /// Time until it runs again, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// The process is killed and its store lost: it comes back in a new epoch.
    Wipe {
        /// Start, s.
        at: f64,
        /// Time until it runs again, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// The process stops and later goes on as if nothing had happened; what arrives meanwhile waits.
    Pause {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// The SLAM restarts in a new local frame.
    NewFrame {
        /// When, s.
        at: f64,
        /// Which robot.
        robot: String,
    },
    /// The disk takes nothing: every batch fails. Ends for good with the next kill of this robot.
    DiskFull {
        /// When, s.
        at: f64,
        /// Which robot.
        robot: String,
    },
    /// The robot is gone for good.
    Leave {
        /// When, s.
        at: f64,
        /// Which robot.
        robot: String,
    },
}

impl Fault {
    /// Whether it keeps messages of the robot `from` from the robot `to`.
    pub fn severs(&self, from: &str, to: &str) -> bool {
        match self {
            Self::Partition { groups, .. } => {
                let group = |name: &str| groups.iter().position(|group| group.iter().any(|member| member == name));
                // Those in no group are cut off from one another as well.
                group(from).is_none() || group(from) != group(to)
            }
            Self::Isolate { robot, .. } => robot == from || robot == to,
            Self::OneWay { from: one, to: other, .. } => one == from && other == to,
            _ => false,
        }
    }

    /// When it begins, s.
    pub fn begins(&self) -> f64 {
        match *self {
            Self::Partition { at, .. }
            | Self::Isolate { at, .. }
            | Self::OneWay { at, .. }
            | Self::Kill { at, .. }
            | Self::Wipe { at, .. }
            | Self::Pause { at, .. }
            | Self::NewFrame { at, .. }
            | Self::DiskFull { at, .. }
            | Self::Leave { at, .. } => at,
        }
    }

    /// When it ends, s; `None` if it has no end of its own.
    pub fn ends(&self) -> Option<f64> {
        match *self {
            Self::Partition { at, lasts, .. }
            | Self::Isolate { at, lasts, .. }
            | Self::OneWay { at, lasts, .. }
            | Self::Kill { at, lasts, .. }
            | Self::Wipe { at, lasts, .. }
            | Self::Pause { at, lasts, .. } => Some(at + lasts),
            Self::NewFrame { .. } | Self::DiskFull { .. } | Self::Leave { .. } => None,
        }
    }

    /// Every robot it names.
    pub fn robots(&self) -> Vec<&str> {
        match self {
            Self::Partition { groups, .. } => groups.iter().flatten().map(String::as_str).collect(),
            Self::OneWay { from, to, .. } => vec![from, to],
            Self::Isolate { robot, .. }
            | Self::Kill { robot, .. }
            | Self::Wipe { robot, .. }
            | Self::Pause { robot, .. }
            | Self::NewFrame { robot, .. }
            | Self::DiskFull { robot, .. }
            | Self::Leave { robot, .. } => vec![robot],
        }
    }
}

/// How often each fault really fired: a run proves what it survived.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct FaultCounts {
    /// Messages lost one by one.
    pub lost: u64,
    /// Messages lost in bursts.
    pub burst_lost: u64,
    /// Messages that arrived twice.
    pub duplicated: u64,
    /// Messages held back so that later ones overtake them.
    pub reordered: u64,
    /// Messages stopped by a partition, an isolation or a one-way link.
    pub blocked: u64,
    /// Messages dropped because a link's queue was full.
    pub over_capacity: u64,
    /// Messages to a process that was not running.
    pub to_the_dead: u64,
    /// Questions that got no answer in time.
    pub unanswered: u64,
    /// Processes killed.
    pub killed: u64,
    /// Processes started again.
    pub restarted: u64,
    /// Stores lost.
    pub wiped: u64,
    /// Records that a kill found not yet durable.
    pub records_lost: u64,
    /// Processes paused.
    pub paused: u64,
    /// Inputs that waited for a paused process.
    pub delayed_by_pause: u64,
    /// New local frames.
    pub new_frames: u64,
    /// Batches that the disk refused.
    pub disk_refused: u64,
    /// Robots gone for good.
    pub left: u64,
    /// Keyframes that came while the process was down.
    pub keyframes_missed: u64,
}

//! The fault schedule: what happens to links, processes and disks, and when. Faults on messages (loss, delay…) are
//! drawn per message by the network; these are the ones with a beginning and an end.

use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

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
    /// The power goes, and comes back: what no sync confirmed is lost, there, or torn.
    PowerCut {
        /// Start, s.
        at: f64,
        /// Time until it runs again, s.
        lasts: f64,
        /// Which robot.
        robot: String,
        /// It goes in the middle of the next commit, after so many writes (if there is one within a second).
        #[serde(default)]
        mid_commit: Option<u64>,
    },
    /// The disk has no room.
    DiskFull {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// So many writes and syncs fail.
    DiskErrors {
        /// When, s.
        at: f64,
        /// Which robot.
        robot: String,
        /// How many.
        errors: u64,
        /// Reads fail, too.
        #[serde(default)]
        reads: bool,
    },
    /// The disk says that it synced, and does not; at the end the power goes.
    LyingDisk {
        /// Start, s.
        at: f64,
        /// Time until the power goes, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// The process is killed, and its disk is what it was at `at`.
    OldImage {
        /// When the image was taken, s.
        at: f64,
        /// Time until it is put back, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// Bits flip at rest; the process is killed to meet them.
    FlipBits {
        /// Start, s.
        at: f64,
        /// Time until it runs again, s.
        lasts: f64,
        /// Which robot.
        robot: String,
        /// How many.
        bits: u64,
    },
    /// A second robot runs on a copy of this one's disk, with its key.
    Twin {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// The robot's wall clock jumps.
    ClockJump {
        /// When, s.
        at: f64,
        /// Which robot.
        robot: String,
        /// By how much, s; a clock never shows less than 1970.
        secs: f64,
    },
    /// A member that holds its key, but tells one half of the swarm another story than the other.
    Equivocate {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// The robot's frames come in another version of the protocol.
    OtherVersion {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Which robot.
        robot: String,
    },
    /// Somebody without a key shouts at a robot, under an id of its own each time.
    Flood {
        /// Start, s.
        at: f64,
        /// Duration, s.
        lasts: f64,
        /// Which robot hears it.
        robot: String,
        /// Messages a second.
        per_sec: f64,
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
    /// The directed links that it severs among robots of these names, as places in `names`.
    pub fn severed(&self, names: &[&str]) -> Vec<(usize, usize)> {
        let links = |cuts: &dyn Fn(usize, usize) -> bool| {
            let from_all = (0..names.len()).flat_map(|from| (0..names.len()).map(move |to| (from, to)));
            from_all.filter(|&(from, to)| from != to && cuts(from, to)).collect()
        };
        match self {
            Self::Partition { groups, .. } => {
                let members =
                    groups.iter().enumerate().flat_map(|(k, group)| group.iter().map(move |name| (&**name, k)));
                // Named twice, a robot is in the first group.
                let group_of: BTreeMap<&str, usize> = members.rev().collect();
                let group: Vec<Option<&usize>> = names.iter().map(|name| group_of.get(name)).collect();
                // Those in no group are cut off from one another as well.
                links(&|from, to| group[from].is_none() || group[from] != group[to])
            }
            Self::Isolate { robot, .. } => links(&|from, to| robot == names[from] || robot == names[to]),
            Self::OneWay { from: one, to: other, .. } => links(&|from, to| one == names[from] && other == names[to]),
            _ => Vec::new(),
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
            | Self::PowerCut { at, .. }
            | Self::DiskFull { at, .. }
            | Self::LyingDisk { at, .. }
            | Self::OldImage { at, .. }
            | Self::FlipBits { at, .. }
            | Self::Twin { at, .. }
            | Self::Equivocate { at, .. }
            | Self::OtherVersion { at, .. }
            | Self::Flood { at, .. }
            | Self::DiskErrors { at, .. }
            | Self::ClockJump { at, .. }
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
            | Self::Pause { at, lasts, .. }
            | Self::PowerCut { at, lasts, .. }
            | Self::DiskFull { at, lasts, .. }
            | Self::LyingDisk { at, lasts, .. }
            | Self::OldImage { at, lasts, .. }
            | Self::FlipBits { at, lasts, .. }
            | Self::Twin { at, lasts, .. }
            | Self::Equivocate { at, lasts, .. }
            | Self::OtherVersion { at, lasts, .. }
            | Self::Flood { at, lasts, .. } => Some(at + lasts),
            Self::NewFrame { .. } | Self::DiskErrors { .. } | Self::ClockJump { .. } | Self::Leave { .. } => None,
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
            | Self::PowerCut { robot, .. }
            | Self::DiskFull { robot, .. }
            | Self::LyingDisk { robot, .. }
            | Self::OldImage { robot, .. }
            | Self::FlipBits { robot, .. }
            | Self::Twin { robot, .. }
            | Self::Equivocate { robot, .. }
            | Self::OtherVersion { robot, .. }
            | Self::Flood { robot, .. }
            | Self::DiskErrors { robot, .. }
            | Self::ClockJump { robot, .. }
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
    /// Messages to a robot that the sender's radio no longer reaches.
    pub out_of_reach: u64,
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
    /// Power cuts.
    pub power_cuts: u64,
    /// Those in the middle of a commit.
    pub cut_in_commit: u64,
    /// Writes that a power cut lost.
    pub writes_lost: u64,
    /// Writes that a power cut tore.
    pub writes_torn: u64,
    /// Commits that the disk refused.
    pub disk_refused: u64,
    /// Writes and syncs that it refused for want of room.
    pub writes_without_room: u64,
    /// Writes and syncs that failed.
    pub writes_failed: u64,
    /// Reads of the disk that failed.
    pub reads_failed: u64,
    /// Commits that it took after it had refused.
    pub disk_healed: u64,
    /// Syncs that lied.
    pub syncs_lied: u64,
    /// Old images put back.
    pub old_images: u64,
    /// Bits flipped at rest.
    pub bits_flipped: u64,
    /// Damaged records found by stores that were opened.
    pub damage_found: u64,
    /// Stores opened that may have lost an entry.
    pub logs_closed: u64,
    /// Logs replaced by what still counts of them.
    pub condensed: u64,
    /// Stores that could not be opened for a while.
    pub store_unusable: u64,
    /// Stores beyond mending, moved away.
    pub store_moved_away: u64,
    /// Second robots with a key in use.
    pub twins: u64,
    /// Jumps of wall clocks.
    pub clock_jumps: u64,
    /// Second stories told.
    pub equivocations: u64,
    /// Frames sent in another version.
    pub other_versions: u64,
    /// Messages from nobody.
    pub floods: u64,
    /// Mangled copies delivered.
    pub mangled: u64,
    /// Old messages delivered once more.
    pub replayed: u64,
    /// False alignments computed by a liar, and submaps of members that lie of themselves.
    pub lies: u64,
    /// Logs found with two histories, over all robots.
    pub forks: u64,
    /// New epochs that robots began by themselves.
    pub epochs_begun: u64,
    /// Robots gone for good.
    pub left: u64,
    /// Keyframes that came while the process was down.
    pub keyframes_missed: u64,
    /// What `gossip.link_bytes_per_sec` held back on robots that ran to the end, since they started.
    pub held_back: u64,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_partition_severs_between_groups_and_those_in_none_from_all() {
        let group = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<Vec<String>>();
        let groups = vec![group(&["a", "b"]), group(&["c", "a"])];
        let fault = Fault::Partition { at: 1.0, lasts: 1.0, groups };
        let names = ["a", "b", "c", "d", "e"];
        let open = |from, to| !fault.severed(&names).contains(&(from, to));
        let together: Vec<(usize, usize)> =
            (0..5).flat_map(|from| (0..5).map(move |to| (from, to))).filter(|&(f, t)| f != t && open(f, t)).collect();
        assert_eq!(together, [(0, 1), (1, 0)]);
    }

    #[test]
    fn others_sever_what_they_name() {
        let names = ["a", "b", "c"];
        let isolate = Fault::Isolate { at: 1.0, lasts: 1.0, robot: "b".into() };
        assert_eq!(isolate.severed(&names), [(0, 1), (1, 0), (1, 2), (2, 1)]);
        let one_way = Fault::OneWay { at: 1.0, lasts: 1.0, from: "c".into(), to: "a".into() };
        assert_eq!(one_way.severed(&names), [(2, 0)]);
        assert!(Fault::Leave { at: 1.0, robot: "a".into() }.severed(&names).is_empty());
    }
}

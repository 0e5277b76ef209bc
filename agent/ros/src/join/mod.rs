//! Clouds joined with poses: which topics are the odometry and the cloud of which robot ([`choose`]), where the body
//! was when a cloud was measured, and the cloud's points in the body's frame. Stamps are those of the headers; poses
//! are interpolated between two stamps, never beyond them.
//!
//! A bag is read once for poses, transforms and stamps ([`gather`]), then once more for the clouds that are wanted
//! ([`Joined::read`]).

mod choose;
mod gather;
mod points;

pub use choose::{Choice, Poses, Wanted, choose};
pub use gather::{Joined, Posed, gather};
pub use points::Placed;

use crate::bag::{BagError, Topic};
use crate::limits::{CLOUD_FRAMES_MAX, CLOUDS_MAX, POSES_MAX};
use std::collections::BTreeMap;
use thiserror::Error;

/// Why clouds and poses of a bag do not come together.
#[derive(Debug, Error)]
pub enum JoinError {
    /// The bag cannot be read.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// There are no poses.
    #[error(
        "no nav_msgs/Odometry and no TF odom → base_link: record one of them, or name a topic of poses by --odometry; \
         the bag has {0}"
    )]
    NoPoses(String),
    /// There are no clouds.
    #[error("no sensor_msgs/PointCloud2 and no sensor_msgs/LaserScan: record one of them; the bag has {0}")]
    NoClouds(String),
    /// It is not clear which.
    #[error("{count} topics are {what}: {list}; name one by {option}{hint}")]
    Several {
        /// How many.
        count: usize,
        /// Of what.
        what: &'static str,
        /// Which.
        list: String,
        /// The option that decides.
        option: &'static str,
        /// What else may be meant.
        hint: String,
    },
    /// The named topic is not in the bag.
    #[error("{option} {name}: there is no such topic; the bag has {list}")]
    Unknown {
        /// The option.
        option: &'static str,
        /// As given.
        name: String,
        /// The topics that there are.
        list: String,
    },
    /// The named topic is of another type.
    #[error("{option} {name}: is {found}; {expected} is wanted")]
    Kind {
        /// The option.
        option: &'static str,
        /// As given.
        name: String,
        /// What it is.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// The named topic has no messages.
    #[error("{option} {name}: the topic is in the bag, but silent: nobody published on it while it was recorded")]
    Silent {
        /// The option.
        option: &'static str,
        /// As given.
        name: String,
    },
    /// No message can be read.
    #[error("{topic}: none of {count} messages can be used: {why}")]
    Unusable {
        /// The topic.
        topic: String,
        /// Messages.
        count: u64,
        /// The commonest reason.
        why: String,
    },
    /// No cloud was measured while there were poses.
    #[error(
        "{cloud}: none of its {count} stamps, {first:.3} to {last:.3} s, lies between poses of {poses}, {from:.3} to \
         {to:.3} s: record both at once, on one clock (use_sim_time of both nodes), or name another by --odometry"
    )]
    Apart {
        /// Topic of the clouds.
        cloud: String,
        /// Clouds.
        count: usize,
        /// First stamp of a cloud, s.
        first: f64,
        /// Last stamp of a cloud, s.
        last: f64,
        /// Where poses come from.
        poses: String,
        /// First stamp of a pose, s.
        from: f64,
        /// Last stamp of a pose, s.
        to: f64,
    },
    /// No cloud can be put into the body's frame.
    #[error(
        "{cloud}: no cloud can be put into the frame of the body, {body:?}: {why}; record /tf_static (and /tf), where \
         robot_state_publisher says how the sensor sits"
    )]
    Unplaced {
        /// Topic of the clouds.
        cloud: String,
        /// The body.
        body: String,
        /// The commonest reason.
        why: String,
    },
    /// Too many poses.
    #[error("{0}: more than {POSES_MAX} poses (POSES_MAX); cut the bag into parts")]
    Poses(String),
    /// Too many clouds.
    #[error("{0}: more than {CLOUDS_MAX} clouds (CLOUDS_MAX); cut the bag into parts")]
    Clouds(String),
    /// Too many frames.
    #[error("{0}: clouds are in more than {CLOUD_FRAMES_MAX} frames (CLOUD_FRAMES_MAX)")]
    Frames(String),
}

/// Topics with type and number of messages, for people; those with no messages are silent.
pub fn listed<'a>(topics: impl IntoIterator<Item = &'a Topic>) -> String {
    const TOLD: usize = 40;
    let told = |topic: &Topic| match (topic.count, topic.serialization) {
        (_, None) => format!("{} ({}, not of ROS)", topic.name, topic.kind),
        (0, _) => format!("{} ({}, silent)", topic.name, topic.kind),
        (count, _) => format!("{} ({} × {count})", topic.name, topic.kind),
    };
    let mut list: Vec<String> = topics.into_iter().map(told).collect();
    list.sort();
    if list.len() > TOLD {
        let more = list.len() - TOLD;
        list.truncate(TOLD);
        list.push(format!("{more} more"));
    }
    if list.is_empty() { "no topics".into() } else { list.join(", ") }
}

/// What was passed over, by the reason.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tally {
    reasons: BTreeMap<String, u64>,
}

impl Tally {
    /// Reasons that are told apart; they may hold what a file says.
    const REASONS_MAX: usize = 12;
    /// Characters of a reason at most.
    const REASON_LEN_MAX: usize = 400;

    /// Takes one down.
    pub fn count(&mut self, reason: impl std::fmt::Display) {
        self.add(reason, 1);
    }

    /// Takes so many down.
    pub fn add(&mut self, reason: impl std::fmt::Display, count: u64) {
        let mut reason = reason.to_string();
        if let Some((end, _)) = reason.char_indices().nth(Self::REASON_LEN_MAX) {
            reason.truncate(end);
        }
        if self.reasons.len() >= Self::REASONS_MAX && !self.reasons.contains_key(&reason) {
            reason = "for other reasons".into();
        }
        *self.reasons.entry(reason).or_default() += count;
    }

    /// The commonest reason.
    pub fn commonest(&self) -> Option<&str> {
        self.reasons.iter().max_by_key(|(_, count)| **count).map(|(reason, _)| reason.as_str())
    }

    /// All reasons with their counts.
    pub fn reasons(&self) -> impl Iterator<Item = (&str, u64)> {
        self.reasons.iter().map(|(reason, count)| (reason.as_str(), *count))
    }

    /// How many in all.
    pub fn sum(&self) -> u64 {
        self.reasons.values().sum()
    }
}

#[cfg(test)]
mod drive;
#[cfg(test)]
mod tests;
#[cfg(test)]
use {crate as ros, crate::bag::write, merganser_geometry as geometry};

//! Keyframes that were lost. Odometry chains from keyframe to keyframe: the covariance of a motion is that of its last
//! step, and where keyframes before it were lost, the motion across the gap is known no better than `gap_sigma_per_m`
//! says. It does not matter who lost them.
//!
//! What never arrived nobody refuses; it shows by a step that is far longer than all before it, in way or turn *and* in
//! time, while the stated covariance is that of a short one. All three: a robot that speeds up makes longer steps in no
//! more time; one whose keyframes come by the way driven, and that waited, takes more time for no longer a step; and a
//! front end that takes no keyframes where it sees nothing states what the motion across is worth.

use super::{CovarianceOf, Keyframe};
use crate::config::SubmapConfig;
use crate::time::Stamp;
use serde::{Deserialize, Serialize};
use std::collections::VecDeque;

/// Stamps of keyframes that are remembered, to know a repeated keyframe from one that is late: 40 s of 100 a second.
pub const STAMPS_MAX: usize = 4096;
/// Steps that tell what is usual.
const STEPS: usize = 16;
/// From so many on it is known.
const STEPS_MIN: usize = 4;
/// A step is far longer than usual if it is so many times the longest; after two lost keyframes it is three times.
const FAR: f64 = 2.5;
/// ...and took so many times as long as half of them.
const LATE: f64 = 2.0;
/// The stated variance accounts for its length if it is this share of what the steps before amount to.
const ACCOUNTED: f64 = 0.5;
/// A motion below so many voxels, or this share of `rotation_deg`, is no step: the noise of a robot that stands.
const STILL: (f64, f64) = (0.1, 0.01);

/// Why a keyframe of the robot's own is missing in its chain.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Loss {
    /// It was refused for what it says; see [`KeyframeError`](super::KeyframeError).
    Refused,
    /// It came after a later one, and not for the second time: out of order, or the clock was set back.
    Late,
    /// Too many submaps wait to be described.
    Overload,
    /// It could not be read: malformed, or with a pose or covariance that is none.
    Unreadable,
    /// It was larger than the agent takes.
    TooLarge,
    /// The queue in front of the core was full.
    QueueFull,
    /// It never arrived.
    Unseen,
}

impl Loss {
    /// For counters.
    pub fn name(self) -> &'static str {
        match self {
            Self::Refused => "refused",
            Self::Late => "late",
            Self::Overload => "overload",
            Self::Unreadable => "unreadable",
            Self::TooLarge => "too_large",
            Self::QueueFull => "queue_full",
            Self::Unseen => "unseen",
        }
    }

    /// For people: what happened, and what to do about it.
    pub fn text(self) -> &'static str {
        match self {
            Self::Refused => "were refused; see what was told of them",
            Self::Late => "came late: send keyframes in order, and do not set their clock back",
            Self::Overload => "found no room: raise submap.distance_m or send them less often",
            Self::Unreadable => "could not be read; see what was told of them",
            Self::TooLarge => "were larger than zenoh.input_bytes_max",
            Self::QueueFull => "found the queue full: send them less often, or raise driver.queue",
            Self::Unseen => "seem never to have arrived: send with congestion control Block",
        }
    }
}

/// What keyframes came, and how far apart.
#[derive(Clone, Debug, Default)]
pub(super) struct Arrivals {
    stamps: VecDeque<Stamp>,
    ways: Steps,
    turns: Steps,
}

/// The last steps of one kind that are no noise.
#[derive(Clone, Debug, Default)]
struct Steps(VecDeque<Step>);

#[derive(Clone, Copy, Debug)]
struct Step {
    size: f64,
    secs: f64,
    /// As it is stated, if it is that of the motion.
    variance: Option<f64>,
}

impl Arrivals {
    /// Whether a keyframe with this stamp was taken before.
    pub fn has(&self, stamp: Stamp) -> bool {
        self.stamps.binary_search(&stamp).is_ok()
    }

    /// Takes a keyframe after `last`, which is the one before it unless some are known to be lost.
    pub fn take(&mut self, last: Option<&Keyframe>, keyframe: &Keyframe, config: &SubmapConfig) {
        self.stamps.push_back(keyframe.stamp);
        if self.stamps.len() > STAMPS_MAX {
            self.stamps.pop_front();
        }
        let Some(last) = last else { return };
        let [way, turn] = steps(last, keyframe);
        if way.size >= STILL.0 * config.voxel_m {
            self.ways.take(way);
        }
        if turn.size >= STILL.1 * config.rotation_deg.to_radians() {
            self.turns.take(turn);
        }
    }

    /// Whether keyframes between the two never arrived, as it seems.
    pub fn lack(&self, last: &Keyframe, keyframe: &Keyframe) -> bool {
        let [way, turn] = steps(last, keyframe);
        self.ways.is_far(&way) || self.turns.is_far(&turn)
    }
}

fn steps(last: &Keyframe, next: &Keyframe) -> [Step; 2] {
    let motion = last.pose.pose.inverse() * next.pose.pose;
    let secs = next.stamp.secs_since(last.stamp);
    let variance = |from: usize| {
        let sum = (from..from + 3).map(|k| next.pose.covariance.matrix()[(k, k)]).sum();
        (next.covariance_of == CovarianceOf::Motion).then_some(sum)
    };
    let step = |size, from| Step { size, secs, variance: variance(from) };
    [step(motion.translation.norm(), 0), step(motion.rotation.angle(), 3)]
}

impl Steps {
    fn take(&mut self, step: Step) {
        self.0.push_back(step);
        if self.0.len() > STEPS {
            self.0.pop_front();
        }
    }

    fn is_far(&self, step: &Step) -> bool {
        if self.0.len() < STEPS_MIN {
            return false;
        }
        let longest = self.0.iter().map(|step| step.size).fold(0.0, f64::max);
        let mut secs: Vec<f64> = self.0.iter().map(|step| step.secs).collect();
        secs.sort_by(f64::total_cmp);
        step.size > FAR * longest && step.secs > LATE * secs[secs.len() / 2] && !self.is_accounted(step)
    }

    /// Whether the stated variance grows with the size as it did before.
    fn is_accounted(&self, step: &Step) -> bool {
        let total = self.0.iter().map(|step| step.size).sum::<f64>();
        let stated: Option<f64> = self.0.iter().map(|step| step.variance).sum();
        let usual = stated.map(|stated| stated / total * step.size);
        step.variance.zip(usual).is_some_and(|(variance, usual)| variance >= ACCOUNTED * usual)
    }
}

#[cfg(test)]
#[path = "loss_tests.rs"]
mod tests;

//! Whether a keyframe goes on from the one before it. A SLAM that restarts, or relocalises, puts the body elsewhere
//! from one keyframe to the next; taken for odometry, that would be a motion of many metres with a stated σ of
//! centimetres, and the map would be bent by it for good.
//!
//! A step is judged three ways. One that stays within a submap's own bounds (`distance_m`, `rotation_deg`) always goes
//! on. A longer one must be *possible*: not beyond `speed_max_m_s` (where the unit is the metre), `turn_max_deg_s` and
//! [`JUMP_SUBMAPS_MAX`]. And, once it is known how this front end hands over keyframes, it must be *usual*: not beyond
//! [`STEPS_MAX`] of its longest steps, nor beyond twice its speed for up to [`LOST_SECS_MAX`]. The last is relative, so
//! that it holds in any unit, for a car as for a crawler. Each is widened by four of the stated standard deviations:
//! a front end that states a large covariance of the motion may make a long step.
//!
//! The time since the last keyframe allows a longer step only up to a bound: a SLAM that restarts takes seconds, and
//! what the body may have driven meanwhile was not measured. Only after [`SILENT_SECS_MIN`] may a step span
//! [`SILENT_SUBMAPS_MAX`] submaps in any case.
//!
//! A keyframe that does not go on is refused, and remembered. If the next ones go on from *it*, the frame is another
//! one. Between the old way and the new one the nearer counts, so that the robot's new way, which may lead past the old
//! one, is not taken back into it.

use super::odometry::motion;
use super::{Keyframe, KeyframeError};
use crate::config::SubmapConfig;
use crate::kinds::ScaleKind;

/// Lengths of a submap (`distance_m`) that a body may move between two keyframes at most, however fast it is: a submap
/// is cut from several.
pub const JUMP_SUBMAPS_MAX: f64 = 10.0;
/// Longest steps of a front end that one step may span: three keyframes in a row may be lost.
pub const STEPS_MAX: f64 = 4.0;
/// How long keyframes may be lost at twice the usual speed, s, if they come faster than that.
pub const LOST_SECS_MAX: f64 = 2.0;
/// After so long without a keyframe, s, a step may be longer: a front end that takes keyframes of what it sees takes
/// none where it sees nothing.
pub const SILENT_SECS_MIN: f64 = 10.0;
/// Lengths of a submap (`distance_m`) that such a step may span: the silence leaves no more than a submap or two
/// unseen. *Measured*: of the MRCLAM robots' 23 minutes the longest step is 3.94 m, after 58 s without a landmark 2.98
/// m.
pub const SILENT_SUBMAPS_MAX: f64 = 2.0;
/// Keyframes from another place, each going on from the one before as is usual, that are another frame.
pub const RESTART_KEYFRAMES: u32 = 4;
/// The same where they go on as is possible, but not usual: the front end may have another pace than before.
pub const RESTART_ROUGH_KEYFRAMES: u32 = 8;
/// Stated standard deviations by which bounds are widened.
const SIGMAS: f64 = 4.0;
/// Steps, and submaps' lengths driven, from which on it is known what is usual.
const KNOWN: (u32, f64) = (4, 2.0);
/// A step shorter than so many voxels is none: the noise of a robot that stands.
const STILL_VOXELS: f64 = 0.1;
/// The longest step is forgotten by this share of the way driven since.
const FORGET_PER_M: f64 = 0.125;
/// What the mean speed keeps of what it was, a step.
const KEEP: f64 = 0.9;

/// What shows that keyframes are of another frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameSign {
    /// The front end says so.
    Session,
    /// They go on from where the last one of this frame is not.
    Jump,
}

/// The last keyframe that went on, how the body gets on, and where it seems to be instead.
#[derive(Clone, Debug, Default)]
pub(super) struct Continuity {
    last: Option<Keyframe>,
    pace: Pace,
    elsewhere: Option<Elsewhere>,
}

/// Refused keyframes of which each goes on from the one before.
#[derive(Clone, Debug)]
struct Elsewhere {
    last: Keyframe,
    count: u32,
    /// Those at the end that go on as is usual.
    usual: u32,
}

/// How a front end hands over keyframes.
#[derive(Clone, Copy, Debug, Default)]
struct Pace {
    longest: f64,
    /// Way and time of late, for the mean speed; of steps that are not much shorter than the longest.
    way: f64,
    secs: f64,
    steps: u32,
    total: f64,
}

/// A step and what it is held against.
#[derive(Clone, Copy, Debug)]
struct Step {
    moved: f64,
    turned: f64,
    secs: f64,
    possible: f64,
    usual: f64,
    turn: f64,
}

/// What a keyframe is.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Verdict {
    GoesOn,
    /// It goes on from the refused ones before it, as is usual (or only possible).
    Elsewhere(bool),
    Lost,
}

impl Step {
    fn is_possible(&self) -> bool {
        self.moved <= self.possible && self.turned <= self.turn
    }

    fn is_usual(&self) -> bool {
        self.is_possible() && self.moved <= self.usual
    }

    /// How far, in submaps.
    fn size(&self, config: &SubmapConfig) -> f64 {
        self.moved / config.distance_m + self.turned / config.rotation_deg.to_radians()
    }
}

impl Pace {
    fn take(&mut self, moved: f64, secs: f64, config: &SubmapConfig) {
        if moved < STILL_VOXELS * config.voxel_m {
            return;
        }
        self.longest = moved.max(self.longest - FORGET_PER_M * moved);
        self.steps = self.steps.saturating_add(1);
        self.total += moved;
        if moved >= self.longest / STEPS_MAX {
            self.way = KEEP * self.way + moved;
            self.secs = KEEP * self.secs + secs.min(LOST_SECS_MAX);
        }
    }

    /// The longest step that is usual; any until it is known.
    fn usual(&self, secs: f64, config: &SubmapConfig) -> f64 {
        if self.steps < KNOWN.0 || self.total < KNOWN.1 * config.distance_m {
            return f64::INFINITY;
        }
        let speed = if self.secs > 0.0 { self.way / self.secs } else { 0.0 };
        let unseen = if secs >= SILENT_SECS_MIN { SILENT_SUBMAPS_MAX * config.distance_m } else { 0.0 };
        (STEPS_MAX * self.longest).max(2.0 * speed * secs.min(LOST_SECS_MAX)).max(unseen)
    }
}

impl Continuity {
    /// Why a keyframe does not go on, if it does not. Its stamp is after the last one's.
    pub fn check(&self, keyframe: &Keyframe, config: &SubmapConfig) -> Result<(), KeyframeError> {
        let Some(last) = &self.last else { return Ok(()) };
        if self.verdict(keyframe, config) == Verdict::GoesOn {
            return Ok(());
        }
        let Step { moved, turned, secs, possible, usual, turn } = self.step(last, keyframe, config);
        let (turned_deg, allowed_deg) = (turned.to_degrees(), turn.to_degrees());
        Err(KeyframeError::Jump { moved, turned_deg, secs, allowed: possible.min(usual), allowed_deg })
    }

    /// Whether with this keyframe it is sure that the body goes on in another frame.
    pub fn is_restart(&self, keyframe: &Keyframe, config: &SubmapConfig) -> bool {
        let (Verdict::Elsewhere(is_usual), Some(elsewhere)) = (self.verdict(keyframe, config), &self.elsewhere) else {
            return false;
        };
        (is_usual && elsewhere.usual + 1 >= RESTART_KEYFRAMES) || elsewhere.count + 1 >= RESTART_ROUGH_KEYFRAMES
    }

    /// A keyframe that goes on.
    pub fn take(&mut self, keyframe: &Keyframe, config: &SubmapConfig) {
        if let Some(last) = &self.last {
            let moved = (keyframe.pose.pose.translation - last.pose.pose.translation).norm();
            self.pace.take(moved, keyframe.stamp.secs_since(last.stamp), config);
        }
        self.last = Some(without_points(keyframe));
        self.elsewhere = None;
    }

    /// A keyframe that does not.
    pub fn refuse(&mut self, keyframe: &Keyframe, config: &SubmapConfig) {
        // One that is sent twice says nothing new.
        if self.elsewhere.as_ref().is_some_and(|elsewhere| keyframe.stamp <= elsewhere.last.stamp) {
            return;
        }
        let (count, usual) = match (self.verdict(keyframe, config), &self.elsewhere) {
            (Verdict::Elsewhere(true), Some(before)) => (before.count.saturating_add(1), before.usual + 1),
            (Verdict::Elsewhere(false), Some(before)) => (before.count.saturating_add(1), 1),
            _ => (1, 1),
        };
        self.elsewhere = Some(Elsewhere { last: without_points(keyframe), count, usual });
    }

    fn verdict(&self, keyframe: &Keyframe, config: &SubmapConfig) -> Verdict {
        let Some(last) = &self.last else { return Verdict::GoesOn };
        let here = self.step(last, keyframe, config);
        let before = self.elsewhere.as_ref().filter(|elsewhere| keyframe.stamp > elsewhere.last.stamp);
        let there = before.map(|before| self.step(&before.last, keyframe, config)).filter(Step::is_possible);
        match (here.is_usual(), there) {
            (true, Some(there)) if there.size(config) > here.size(config) => Verdict::GoesOn,
            (_, Some(there)) => Verdict::Elsewhere(there.is_usual()),
            (true, None) => Verdict::GoesOn,
            (false, None) => Verdict::Lost,
        }
    }

    fn step(&self, from: &Keyframe, to: &Keyframe, config: &SubmapConfig) -> Step {
        let moved = (to.pose.pose.translation - from.pose.pose.translation).norm();
        let turned = (from.pose.pose.inverse() * to.pose.pose).rotation.angle();
        let secs = to.stamp.secs_since(from.stamp).max(0.0);
        let (distance, rotation) = (config.distance_m, config.rotation_deg.to_radians());
        if moved <= distance && turned <= rotation {
            return Step { moved, turned, secs, possible: distance, usual: distance, turn: rotation };
        }
        let sigmas = motion(from, to, config).covariance.sigmas() * SIGMAS;
        let [loose_m, loose_rad] = [0, 3].map(|k| sigmas.fixed_rows::<3>(k).max());
        let speed = match config.scale {
            ScaleKind::Metric => config.speed_max_m_s * secs,
            ScaleKind::Unknown => f64::INFINITY,
        };
        Step {
            moved,
            turned,
            secs,
            possible: distance.max(speed.min(JUMP_SUBMAPS_MAX * distance)) + loose_m,
            usual: distance.max(self.pace.usual(secs, config)) + loose_m,
            turn: rotation.max(config.turn_max_deg_s.to_radians() * secs) + loose_rad,
        }
    }
}

fn without_points(keyframe: &Keyframe) -> Keyframe {
    Keyframe { points: Vec::new(), marks: Vec::new(), place: None, ..*keyframe }
}

#[cfg(test)]
#[path = "continuity_tests.rs"]
mod tests;

//! The tree of transforms: which frame lies how in which, over time. Between two stamps a transform is interpolated
//! (along the screw from one to the other: slerp of the rotation); before the first and after the last there is none,
//! unless it never changed, as a robot_state_publisher of old sends fixed joints on `/tf`.
//!
//! A frame may be said to lie in several others (wheels' drivers publish `odom → base_link` and `odom →
//! base_footprint` beside `base_link → base_footprint`): the shortest way between two frames is taken. A loop, in
//! which a frame would lie in itself, is refused link by link.

use crate::limits::{CHAIN_MAX, FRAME_BYTES_MAX, FRAMES_MAX, GAP_SECS_MAX, LATE_MAX, TRANSFORMS_MAX};
use crate::msg::{TfMessage, TransformStamped, plain_frame};
use crate::order::{Order, Turn};
use merganser_geometry::Se3;
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use thiserror::Error;

/// Why a transform is not taken, or there is none.
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum TfError {
    /// No transform names the frame.
    #[error("there is no frame {frame:?}; there are {known}")]
    Frame {
        /// Which.
        frame: String,
        /// Those that there are.
        known: String,
    },
    /// The frames are not connected.
    #[error("frames {from:?} and {to:?} are not connected; there are {known}")]
    Unconnected {
        /// Which.
        from: String,
        /// And which.
        to: String,
        /// Those that there are.
        known: String,
    },
    /// The transform is not known then.
    #[error("{parent} → {child} is known from {first_ns} to {last_ns} ns, not at {at_ns} ns")]
    Time {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
        /// First stamp.
        first_ns: i64,
        /// Last stamp.
        last_ns: i64,
        /// Stamp that was asked for.
        at_ns: i64,
    },
    /// The transform was not published for too long.
    #[error("{parent} → {child} has a gap of {gap_ms} ms; across {max} s at most it is interpolated", max = GAP_SECS_MAX)]
    Gap {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
        /// How long.
        gap_ms: i64,
    },
    /// A frame would lie in itself.
    #[error("TF loop: {0}; these links are left out")]
    Loop(String),
    /// The transform is none.
    #[error("{parent} → {child} is no transform: a number is not finite or too large, or the quaternion is zero")]
    Value {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
    },
    /// A frame has no name, or is its own parent.
    #[error("a transform from {parent:?} to {child:?} names no two frames")]
    Names {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
    },
    /// The transform comes long after later ones.
    #[error("{parent} → {child} comes after more than {LATE_MAX} later ones; was the clock set back?")]
    Late {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
    },
    /// The transform's stamp lies before that of an earlier one.
    #[error("{parent} → {child}: the clock was set back, or the bag loops; left out")]
    Back {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
    },
    /// A transform's stamp lay far ahead of the ones before and after.
    #[error("{parent} → {child}: a stamp lies far ahead of those before and after it; left out")]
    Ahead {
        /// The parent.
        parent: String,
        /// The child.
        child: String,
    },
    /// The name of a frame is too long.
    #[error("a frame's name has {0} bytes; at most {FRAME_BYTES_MAX} (FRAME_BYTES_MAX) are read")]
    Long(usize),
    /// Too many frames.
    #[error("more than {FRAMES_MAX} links between frames (FRAMES_MAX)")]
    Frames,
    /// Too many transforms.
    #[error(
        "more than {TRANSFORMS_MAX} transforms (TRANSFORMS_MAX); cut the bag, or leave /tf of moving joints out of it"
    )]
    Transforms,
}

/// `t_parent_child` over time.
#[derive(Clone, Debug, Default)]
struct Link {
    /// For all time, if it was said so.
    fixed: Option<Se3>,
    /// In rising order of stamps.
    samples: Vec<(i64, Se3)>,
    /// Whether a sample differs from the first.
    moves: bool,
    order: Order,
    /// Whether the last sample came by moving the one before along.
    is_moved_along: bool,
}

/// Transforms between frames.
#[derive(Clone, Debug, Default)]
pub struct TfTree {
    /// By parent and child.
    links: BTreeMap<(String, String), Link>,
    /// Frames that are connected, both ways.
    beside: BTreeMap<String, BTreeSet<String>>,
    transforms: usize,
    /// Links that were refused, as they would close a loop, and the loop: links never go, and so neither does it.
    loops: BTreeMap<(String, String), String>,
    /// Transforms that were not taken, by the reason.
    refused: BTreeMap<String, u64>,
}

/// Reasons that are told apart.
const REASONS_MAX: usize = 16;

impl TfTree {
    /// Takes what `/tf` says, or `/tf_static`. What cannot be taken is counted in [`TfTree::refused`].
    pub fn take(&mut self, message: &TfMessage, is_fixed: bool) {
        for transform in &message.transforms {
            if let Err(error) = self.insert(transform, is_fixed) {
                self.refuse(&error);
            }
        }
    }

    fn refuse(&mut self, error: &TfError) {
        let reason = error.to_string();
        let is_told = self.refused.len() < REASONS_MAX || self.refused.contains_key(&reason);
        let reason = if is_told { reason } else { "other reasons".into() };
        *self.refused.entry(reason).or_default() += 1;
    }

    /// Transforms that were not taken, by the reason.
    pub fn refused(&self) -> &BTreeMap<String, u64> {
        &self.refused
    }

    /// Takes one transform.
    ///
    /// # Errors
    /// [`TfError`]; then nothing has changed.
    pub fn insert(&mut self, transform: &TransformStamped, is_fixed: bool) -> Result<(), TfError> {
        let (parent, child) = (transform.header.frame(), plain_frame(&transform.child_frame_id));
        let names = || (parent.to_owned(), child.to_owned());
        if let Some(long) = [parent, child].map(str::len).into_iter().find(|bytes| *bytes > FRAME_BYTES_MAX) {
            return Err(TfError::Long(long));
        }
        if parent.is_empty() || child.is_empty() || parent == child {
            let (parent, child) = names();
            return Err(TfError::Names { parent, child });
        }
        let Some(pose) = transform.transform.se3() else {
            let (parent, child) = names();
            return Err(TfError::Value { parent, child });
        };
        let key = names();
        if !self.links.contains_key(&key) {
            if let Some(told) = self.loops.get(&key) {
                return Err(TfError::Loop(told.clone()));
            }
            if self.links.len() == FRAMES_MAX || self.loops.len() == FRAMES_MAX {
                return Err(TfError::Frames);
            }
            if let Some(chain) = self.down(child, parent) {
                let told = told_chain(&chain, child);
                self.loops.insert(key, told.clone());
                return Err(TfError::Loop(told));
            }
        }
        if self.transforms >= TRANSFORMS_MAX {
            return Err(TfError::Transforms);
        }
        for (a, b) in [(parent, child), (child, parent)] {
            if !self.beside.get(a).is_some_and(|beside| beside.contains(b)) {
                self.beside.entry(a.into()).or_default().insert(b.into());
            }
        }
        let stamp = transform.header.stamp_ns;
        let link = self.links.entry(key).or_default();
        let before = link.samples.len();
        let taken = link.take(stamp, pose, is_fixed);
        self.transforms = (self.transforms + link.samples.len()).saturating_sub(before);
        let (parent, child) = names();
        match taken {
            Taken::Whole => Ok(()),
            Taken::Late => Err(TfError::Late { parent, child }),
            Taken::Back => Err(TfError::Back { parent, child }),
            // It is the one before that is left out.
            Taken::Instead => {
                self.refuse(&TfError::Ahead { parent, child });
                Ok(())
            }
        }
    }

    /// The frames from `top` down to `frame`, if it lies in it.
    fn down<'a>(&'a self, top: &'a str, frame: &str) -> Option<Vec<&'a str>> {
        let mut parents: BTreeMap<&str, &str> = BTreeMap::from([(top, top)]);
        let mut next = vec![top];
        while let Some(last) = next.pop() {
            if last == frame {
                let up = |frame: &&'a str| parents.get(frame).copied().filter(|parent| parent != frame);
                let mut chain: Vec<&str> = std::iter::successors(Some(last), up).collect();
                chain.reverse();
                return Some(chain);
            }
            for child in self.beside.get(last).into_iter().flatten() {
                if !parents.contains_key(child.as_str()) && self.links.contains_key(&(last.to_owned(), child.clone())) {
                    parents.insert(child, last);
                    next.push(child);
                }
            }
        }
        None
    }

    /// Whether any transform names the frame.
    pub fn knows(&self, frame: &str) -> bool {
        self.beside.contains_key(plain_frame(frame))
    }

    /// The first frames by name, for people.
    pub fn known(&self) -> String {
        const TOLD: usize = 12;
        let mut frames: Vec<&str> = self.beside.keys().take(TOLD).map(String::as_str).collect();
        if self.beside.len() > TOLD {
            frames.push("…");
        }
        if frames.is_empty() { "none, as no TF was recorded".into() } else { frames.join(", ") }
    }

    /// `t_target_source` at this time: maps coordinates of `source` to those of `target`.
    ///
    /// # Errors
    /// [`TfError`].
    pub fn lookup(&self, target: &str, source: &str, at_ns: i64) -> Result<Se3, TfError> {
        let (target, source) = (plain_frame(target), plain_frame(source));
        if target == source {
            return Ok(Se3::identity());
        }
        for frame in [target, source] {
            if !self.knows(frame) {
                return Err(TfError::Frame { frame: frame.into(), known: self.known() });
            }
        }
        let way = self.way(target, source).ok_or_else(|| TfError::Unconnected {
            from: source.into(),
            to: target.into(),
            known: self.known(),
        })?;
        let mut transform = Se3::identity();
        for step in way.windows(2) {
            transform = transform * self.step(&step[0], &step[1], at_ns)?;
        }
        Ok(transform)
    }

    /// Whether the way between the frames never moves.
    pub fn is_fixed(&self, target: &str, source: &str) -> bool {
        let moves = |a: &String, b: &String| {
            let link = self.links.get(&(a.clone(), b.clone())).or_else(|| self.links.get(&(b.clone(), a.clone())));
            link.is_none_or(|link| link.fixed.is_none() && link.moves)
        };
        let way = self.way(plain_frame(target), plain_frame(source));
        way.is_some_and(|way| !way.windows(2).any(|step| moves(&step[0], &step[1])))
    }

    /// The shortest way from frame to frame, both included.
    fn way(&self, from: &str, to: &str) -> Option<Vec<String>> {
        let mut before: BTreeMap<&str, &str> = BTreeMap::from([(from, from)]);
        let mut next = VecDeque::from([from]);
        while let Some(frame) = next.pop_front() {
            if frame == to {
                let back = std::iter::successors(Some(frame), |frame| {
                    before.get(frame).copied().filter(|before| before != frame)
                });
                let mut way: Vec<String> = back.map(Into::into).collect();
                way.reverse();
                return (way.len() <= CHAIN_MAX).then_some(way);
            }
            for beside in self.beside.get(frame).into_iter().flatten() {
                if !before.contains_key(beside.as_str()) {
                    before.insert(beside, frame);
                    next.push_back(beside);
                }
            }
        }
        None
    }

    /// `t_a_b` of frames that are connected.
    fn step(&self, a: &str, b: &str, at_ns: i64) -> Result<Se3, TfError> {
        let of = |parent: &str, child: &str| {
            let link = self.links.get(&(parent.to_owned(), child.to_owned()))?;
            Some(link.at(at_ns).map_err(|when| when.of(parent, child, at_ns)))
        };
        match of(a, b) {
            Some(transform) => transform,
            None => match of(b, a) {
                Some(transform) => transform.map(|transform| transform.inverse()),
                None => Err(TfError::Unconnected { from: b.into(), to: a.into(), known: self.known() }),
            },
        }
    }

    /// Parent and child of each link.
    pub fn links(&self) -> impl Iterator<Item = (&str, &str)> {
        self.links.keys().map(|(parent, child)| (parent.as_str(), child.as_str()))
    }

    /// The stamps of `t_parent_child`, if that was published over time.
    pub fn stamps(&self, parent: &str, child: &str) -> Option<impl Iterator<Item = i64> + '_> {
        let link = self.links.get(&(parent.to_owned(), child.to_owned()))?;
        (!link.samples.is_empty()).then(|| link.samples.iter().map(|(stamp, _)| *stamp))
    }
}

/// What became of a sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Taken {
    Whole,
    /// It comes too late.
    Late,
    /// The clock was set back.
    Back,
    /// In the place of the one before, whose stamp lay far ahead.
    Instead,
}

/// Frames of a loop, for people.
fn told_chain(chain: &[&str], top: &str) -> String {
    const TOLD: usize = 12;
    let (told, rest) = chain.split_at(chain.len().min(TOLD));
    let more = if rest.is_empty() { String::new() } else { format!(" → … ({} more)", rest.len()) };
    format!("{}{more} → {top}", told.join(" → "))
}

impl Link {
    fn take(&mut self, stamp_ns: i64, pose: Se3, is_fixed: bool) -> Taken {
        if is_fixed {
            self.fixed = Some(pose);
            return Taken::Whole;
        }
        let mut taken = Taken::Whole;
        match self.order.take(stamp_ns) {
            Turn::On => {}
            Turn::Back => return Taken::Back,
            Turn::Alone(before_ns) => {
                taken = Taken::Instead;
                match self.samples.last_mut() {
                    Some((last_ns, _)) if self.is_moved_along => *last_ns = before_ns,
                    _ => drop(self.samples.pop()),
                }
            }
        }
        if self.samples.iter().rev().nth(LATE_MAX).is_some_and(|(other, _)| stamp_ns < *other) {
            return Taken::Late;
        }
        self.moves |= self.samples.first().is_some_and(|(_, first)| *first != pose);
        // While it rests the last sample moves along.
        if let [.., (_, before), (last_ns, last)] = self.samples.as_mut_slice()
            && *before == pose
            && *last == pose
            && *last_ns < stamp_ns
        {
            *last_ns = stamp_ns;
            self.is_moved_along = true;
            return taken;
        }
        self.is_moved_along = false;
        let at = self.samples.partition_point(|(other, _)| *other < stamp_ns);
        match self.samples.get_mut(at) {
            Some((same, there)) if *same == stamp_ns => *there = pose,
            _ => self.samples.insert(at, (stamp_ns, pose)),
        }
        taken
    }

    fn at(&self, at_ns: i64) -> Result<Se3, When> {
        if let Some(fixed) = self.fixed {
            return Ok(fixed);
        }
        let samples = self.samples.as_slice();
        if let ([(_, pose), ..], false) = (samples, self.moves) {
            return Ok(*pose);
        }
        interpolated(samples, at_ns, |pose| *pose)
    }
}

/// Why there is nothing at a time.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum When {
    /// Before the first, or after the last, whose stamps these are; equal if there is none.
    Outside(i64, i64),
    /// Between two that are too far apart, ns.
    Gap(i64),
}

impl When {
    fn of(self, parent: &str, child: &str, at_ns: i64) -> TfError {
        let (parent, child) = (parent.to_owned(), child.to_owned());
        match self {
            Self::Outside(first_ns, last_ns) => TfError::Time { parent, child, first_ns, last_ns, at_ns },
            Self::Gap(gap_ns) => TfError::Gap { parent, child, gap_ms: gap_ns / 1_000_000 },
        }
    }
}

/// The pose at a time, from samples in rising order of stamps. Where it rests across a gap it rests.
pub(crate) fn interpolated<T>(samples: &[(i64, T)], at_ns: i64, pose: impl Fn(&T) -> Se3) -> Result<Se3, When> {
    let (Some((first_ns, _)), Some((last_ns, _))) = (samples.first(), samples.last()) else {
        return Err(When::Outside(0, 0));
    };
    let after = samples.partition_point(|(stamp, _)| *stamp < at_ns);
    let Some((after_ns, next)) = samples.get(after) else { return Err(When::Outside(*first_ns, *last_ns)) };
    let next = pose(next);
    if *after_ns == at_ns {
        return Ok(next);
    }
    let Some((before_ns, before)) = after.checked_sub(1).and_then(|before| samples.get(before)) else {
        return Err(When::Outside(*first_ns, *last_ns));
    };
    let before = pose(before);
    let gap = after_ns.saturating_sub(*before_ns);
    if gap as f64 > GAP_SECS_MAX * 1e9 && before != next {
        return Err(When::Gap(gap));
    }
    let share = at_ns.saturating_sub(*before_ns) as f64 / gap as f64;
    let rotation = before.rotation.interpolate(&next.rotation, share);
    Ok(Se3::new(rotation, before.translation.lerp(&next.translation, share)))
}

#[cfg(test)]
mod tests;

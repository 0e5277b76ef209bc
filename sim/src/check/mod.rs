//! The invariants, a file each (DESIGN §8). A check watches every output as it happens and samples of the whole swarm
//! now and then; the first one that objects ends the run. Each file ends with a test that its check bites.

mod bounded;
mod closed;
mod contract;
mod converged;
mod durable_first;
mod floors;
mod honest_covariance;
mod merged_as_expected;
mod never_back;
mod no_false_merge;
mod nobody_slandered;
mod pending;
mod same_estimate;
mod same_facts;
mod sound_numbers;
mod unique_entries;

use crate::scenario::Expect;
use merganser_protocol::agent::io::Output;
use merganser_protocol::geometry::Sim3;
use merganser_protocol::ids::{FrameId, Hash, RobotId};
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::time::Instant;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// An invariant.
pub trait Check {
    /// Its name in reports.
    fn name(&self) -> &'static str;

    /// Something happened on a robot.
    ///
    /// # Errors
    /// What is broken.
    fn see(&mut self, _robot: usize, _seen: &Seen<'_>) -> Result<(), String> {
        Ok(())
    }

    /// The whole swarm at one moment.
    ///
    /// # Errors
    /// What is broken.
    fn sample(&mut self, _sample: &Sample<'_>) -> Result<(), String> {
        Ok(())
    }
}

/// What a check can watch on one robot.
#[derive(Clone, Copy, Debug)]
pub enum Seen<'a> {
    /// The process of this robot started.
    Started(RobotId),
    /// It is about to handle a message of these bytes, or something else: then there are none.
    Heard(&'a [u8]),
    /// A peer's question was put to it under this token.
    Asked(u64),
    /// It made an output.
    Output(&'a Output),
    /// Its disk made everything up to this batch durable.
    Durable(u64),
    /// The process died, and what was not durable with it.
    Died,
    /// Its disk was replaced by an empty one.
    Wiped,
    /// Its disk lost something that it had confirmed: bits flipped, it lied, or an old image was put on it.
    Damaged,
    /// From now on there may be two histories of this robot's logs, by no fault of the core.
    MayFork(RobotId),
    /// It restates clouds that it has from others, who hold them: of these it may send before it stored them.
    Mirrors,
    /// From now on entries may come with this robot's signature that its core did not write: by a forger who has its
    /// key, or by a twin, who may even write the very same.
    Forges(RobotId),
}

/// Where in the run a sample was taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Phase {
    /// Robots drive, faults rage.
    Storm,
    /// The network has healed.
    Calm,
    /// The last sample.
    End,
}

/// The swarm at one moment.
#[derive(Clone, Debug)]
pub struct Sample<'a> {
    /// When.
    pub at: Instant,
    /// In which phase.
    pub phase: Phase,
    /// Every robot that is running.
    pub robots: Vec<RobotSample>,
    /// The others, but for those that have left for good.
    pub down: Vec<String>,
    /// `t_world_frame` of every frame, by `name/epoch`; the scale is its unit, m.
    pub truth: &'a BTreeMap<String, Sim3>,
    /// What the scenario asks for.
    pub expect: &'a Expect,
    /// Names of members that lie of their own place, so that nothing is promised of it.
    pub adversaries: &'a BTreeSet<String>,
}

/// One running robot.
#[derive(Clone, Debug)]
pub struct RobotSample {
    /// Its number.
    pub index: usize,
    /// Its name.
    pub name: String,
    /// Digest of the facts it holds.
    pub digest: Hash,
    /// Lengths of the logs it holds; `None` for those with two histories.
    pub logs: BTreeMap<FrameId, Option<u32>>,
    /// Size of its store's file.
    pub disk_bytes: u64,
    /// What it believes.
    pub snapshot: Option<Snapshot>,
    /// It measures falsehoods, and so lies to itself: between two frames of its own there is no second witness.
    pub lies: bool,
}

/// A broken invariant.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Violation {
    /// Which.
    pub invariant: String,
    /// Virtual time, s.
    pub at_secs: f64,
    /// What is broken.
    pub what: String,
}

/// All checks of a run.
pub struct Checks(Vec<Box<dyn Check>>);

impl Checks {
    /// Every invariant there is, for robots that hold so many epochs of each.
    pub fn all(epochs_per_robot_max: usize) -> Self {
        Self(vec![
            Box::<contract::Contract>::default(),
            Box::<durable_first::DurableFirst>::default(),
            Box::<unique_entries::UniqueEntries>::default(),
            Box::new(never_back::NeverBack::new(epochs_per_robot_max)),
            Box::<closed::Closed>::default(),
            Box::<floors::Floors>::default(),
            Box::new(bounded::Bounded::new(epochs_per_robot_max)),
            Box::new(same_facts::SameFacts),
            Box::new(same_estimate::SameEstimate),
            Box::new(sound_numbers::SoundNumbers),
            Box::new(no_false_merge::NoFalseMerge),
            Box::new(nobody_slandered::NobodySlandered),
            Box::new(honest_covariance::HonestCovariance),
            Box::<converged::Converged>::default(),
            Box::new(merged_as_expected::MergedAsExpected),
        ])
    }

    /// Shows all checks what happened.
    pub fn see(&mut self, now: Instant, robot: usize, seen: &Seen<'_>) -> Option<Violation> {
        self.first(now, |check| check.see(robot, seen))
    }

    /// Shows all checks the swarm.
    pub fn sample(&mut self, now: Instant, sample: &Sample<'_>) -> Option<Violation> {
        self.first(now, |check| check.sample(sample))
    }

    fn first(&mut self, now: Instant, mut ask: impl FnMut(&mut dyn Check) -> Result<(), String>) -> Option<Violation> {
        self.0.iter_mut().find_map(|check| {
            let what = ask(check.as_mut()).err()?;
            Some(Violation { invariant: check.name().to_owned(), at_secs: now.as_secs_f64(), what })
        })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3};
    use merganser_protocol::snapshot::{
        FrameView, FramesView, GraphView, MapView, PathView, PosesView, RelationView, StatsView, StatusView,
    };

    /// A relation with the same standard deviation in all six directions.
    pub fn relation(pose: Se3, sigma: f64) -> RelationView {
        let covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
        RelationView::from(&Relative::Metric(PoseWithCovariance { pose, covariance }))
    }

    /// A robot that believes these relations `t_own_frame`.
    pub fn robot(name: &str, digest: u8, frames: &[(&str, RelationView)]) -> RobotSample {
        let status = StatusView {
            swarm: "test".into(),
            robot: name.into(),
            id: String::new(),
            epoch: 1,
            neighbours: Vec::new(),
            entries: 3,
            digest: digest.to_string(),
            estimate: String::new(),
            submaps: 1,
            keyframes: 1,
            keyframes_lost: BTreeMap::new(),
            gaps: 0,
            remarks: Vec::new(),
            pending: 0,
            idle: true,
            merged_with: frames.iter().filter_map(|(f, _)| f.split('/').next().map(str::to_owned)).collect(),
            unsaved: 0,
            receive_only: false,
        };
        let frame = |(frame, t): &(&str, RelationView)| FrameView {
            frame: (*frame).to_owned(),
            robot: frame.split('/').next().unwrap_or_default().to_owned(),
            submaps: 1,
            component: 0,
            t_own_frame: Some(t.clone()),
        };
        let frames = FramesView {
            own: format!("{name}/1"),
            frames: frames.iter().map(frame).collect(),
            pairs: Vec::new(),
            suspects: Vec::new(),
            tries: Vec::new(),
        };
        let snapshot = Snapshot {
            status,
            frames,
            poses: PosesView::default(),
            map: MapView { submaps: Vec::new() },
            path: PathView::default(),
            graph: GraphView::default(),
            stats: StatsView::default(),
        };
        RobotSample {
            index: 0,
            name: name.into(),
            digest: Hash([digest; 32]),
            logs: BTreeMap::new(),
            disk_bytes: 0,
            snapshot: Some(snapshot),
            lies: false,
        }
    }

    static NOBODY: BTreeSet<String> = BTreeSet::new();

    /// A last sample of these robots.
    pub fn sample<'a>(robots: Vec<RobotSample>, truth: &'a BTreeMap<String, Sim3>, expect: &'a Expect) -> Sample<'a> {
        Sample { at: Instant::ZERO, phase: Phase::End, robots, down: Vec::new(), truth, expect, adversaries: &NOBODY }
    }
}

//! One robot of a run: its key, its process (if it runs), its disk, its SLAM and what its shell remembers.

use super::store::Store;
use crate::adversary::Adversary;
use crate::network::millis;
use crate::scenario::{MachineOptions, Scenario};
use crate::stage::Stage;
use crate::world::drive::Step;
use crate::world::landmarks::Sightings;
use core::ops::Range;
use ed25519_dalek::SigningKey;
use merganser_protocol::agent::Identity;
use merganser_protocol::agent::io::{QueryId, Record};
use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3, Sim3, So3};
use merganser_protocol::ids::{Name, NameError, RobotId};
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::{Instant, Stamp};
use merganser_store::Owner;
use merganser_store::simulated::Picture;
use nalgebra::Vector3;
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Standard deviation stated for a keyframe that defines its frame (m, rad): as good as exact.
const FIRST_SIGMA: f64 = 1e-6;
/// The stamp that a clock without offset shows when the run begins, ns.
const FIRST_STAMP_NS: i64 = 1_700_000_000_000_000_000;

/// 2020-01-01 in seconds since 1970: epochs count from there.
const EPOCH_ORIGIN_SECS: i64 = 1_577_836_800;

/// One robot.
pub(super) struct Robot<C> {
    pub name: Name,
    pub id: RobotId,
    pub identity: Identity,
    /// The process, if it runs.
    pub core: Option<C>,
    /// Counts starts of the process; what was meant for an earlier one is void.
    pub incarnation: u32,
    pub booted: Instant,
    pub wake: Option<Instant>,
    /// Paused until then.
    pub paused_until: Instant,
    pub gone: bool,
    pub store: Store,
    /// A fault befell it that explains damage: what its store reports excuses it only then.
    pub suspect: bool,
    /// The disk as it was at some time.
    pub image: Option<Picture>,
    /// The fault that makes this robot another's twin.
    pub twin: Option<usize>,
    /// Tells two stories.
    pub equivocates: bool,
    /// Speaks another version.
    pub other_version: bool,
    pub slam: Slam,
    /// SLAM began a new frame, and the agent has not closed the old one on disk.
    pub new_frame: Option<NewFrame>,
    pub questions: BTreeSet<QueryId>,
    pub asked: BTreeMap<u64, Asked>,
    pub tokens: u64,
    pub workers: Vec<Instant>,
    /// Whom it hears, or once heard.
    pub hears: BTreeMap<usize, Hearing>,
    pub usage: BTreeMap<&'static str, Usage>,
    /// The second half of the drive.
    later: Range<Instant>,
    pub keyframes: u64,
}

/// How far the agent is told of SLAM's new frame. Whoever supervises a robot tells it anew until it is on disk.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum NewFrame {
    /// The agent must be told, or will answer.
    Owed,
    /// The old frame is closed with this batch.
    Closing(u64),
}

/// A peer's question that waits for our answer.
pub(super) struct Asked {
    pub from: usize,
    pub incarnation: u32,
    pub query: QueryId,
    pub kind: &'static str,
}

/// What a robot's shell knows about one peer's presence.
#[derive(Clone, Copy, Default)]
pub(super) struct Hearing {
    /// What the core was told.
    pub told: bool,
    /// What is so at present.
    pub so: bool,
    /// Counts changes: a telling of an older change is void.
    pub version: u64,
}

/// Messages and payload bytes that a robot handed to the network.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Usage {
    /// Messages; a broadcast counts once.
    pub messages: u64,
    /// Bytes of payload.
    pub bytes: u64,
    /// Those of them that were sent in the second half of the drive, when most of it is no longer new.
    pub later: u64,
}

impl<C> Robot<C> {
    pub fn new(identity: Identity, id: RobotId, slam: Slam, scenario: &Scenario) -> Self {
        let owner = Owner { swarm: identity.swarm.clone(), robot: identity.name.clone(), id };
        let [middle, end] = [0.5, 1.0].map(|part| Instant::ZERO.after(millis(part * scenario.duration_secs * 1e3)));
        Self {
            name: identity.name.clone(),
            id,
            identity,
            core: None,
            incarnation: 0,
            booted: Instant::ZERO,
            wake: None,
            paused_until: Instant::ZERO,
            gone: false,
            suspect: false,
            store: Store::new(owner),
            image: None,
            twin: None,
            equivocates: false,
            other_version: false,
            slam,
            new_frame: None,
            questions: BTreeSet::new(),
            asked: BTreeMap::new(),
            tokens: 0,
            workers: vec![Instant::ZERO; scenario.machine.workers],
            hears: BTreeMap::new(),
            usage: BTreeMap::new(),
            later: middle..end,
            keyframes: 0,
        }
    }

    /// Its name, for people.
    pub fn label(&self) -> String {
        if self.twin.is_some() { format!("{}'s twin", self.name) } else { self.name.to_string() }
    }

    /// The process's own clock, which begins when it does.
    pub fn local(&self, now: Instant) -> Instant {
        Instant::from_nanos(self.booted_nanos(now))
    }

    fn booted_nanos(&self, now: Instant) -> u64 {
        now.as_nanos().saturating_sub(self.booted.as_nanos())
    }

    /// A moment on the process's own clock, on everyone's.
    pub fn global(&self, local: Instant) -> Instant {
        Instant::from_nanos(self.booted.as_nanos().saturating_add(local.as_nanos()))
    }

    /// All that dies with the process.
    pub fn forget(&mut self, now: Instant) {
        self.core = None;
        self.wake = None;
        self.questions.clear();
        self.asked.clear();
        self.workers.fill(now);
        for hearing in self.hears.values_mut() {
            *hearing = Hearing { version: hearing.version + 1, ..Hearing::default() };
        }
    }

    /// When a job handed over now and taking `nanos` is done, on the first worker that is free.
    pub fn work(&mut self, now: Instant, nanos: u64) -> Instant {
        let done = |free: &Instant| Instant::from_nanos(free.max(&now).as_nanos().saturating_add(nanos));
        match self.workers.iter_mut().min() {
            Some(free) => {
                *free = done(free);
                *free
            }
            None => done(&now),
        }
    }

    /// A batch was handed to the disk by a core that writes this epoch.
    pub fn hands_over(&mut self, writes: Option<u32>, batch: u64, records: &[Record]) {
        // An epoch of a lost store that comes back is closed as well; that is not the frame which the SLAM left.
        let left = |epoch: u32| writes == epoch.checked_add(1);
        let closes = records.iter().any(|record| matches!(record, Record::EpochClosed { epoch } if left(*epoch)));
        if closes && self.new_frame.is_some() {
            self.new_frame = Some(NewFrame::Closing(batch));
        }
    }

    /// All batches up to `up_to` are on disk.
    pub fn is_durable(&mut self, up_to: u64) {
        self.new_frame = self.new_frame.filter(|told| !matches!(told, NewFrame::Closing(batch) if *batch <= up_to));
    }

    pub fn count(&mut self, now: Instant, kind: &'static str, bytes: usize) {
        let usage = self.usage.entry(kind).or_default();
        usage.messages += 1;
        usage.bytes += bytes as u64;
        usage.later += if self.later.contains(&now) { bytes as u64 } else { 0 };
    }
}

/// The robot's SLAM, between the drive and the agent: it goes on when the agent's process does not, and can restart in
/// a new local frame.
#[derive(Clone)]
pub(super) struct Slam {
    stamp_offset: i64,
    /// Time since the drive began, ns, by stamp: clocks jump.
    stamps: BTreeMap<i64, u64>,
    /// When each frame that a restart began, began, ns, and where in the drive.
    frames: Vec<(u64, Se3)>,
    restart: bool,
    /// Motion since the last keyframe that the agent took.
    motion: Option<PoseWithCovariance>,
    adversary: Option<Adversary>,
}

impl Slam {
    pub fn new(offset_secs: f64, adversary: Option<Adversary>) -> Self {
        let stamp_offset = FIRST_STAMP_NS + (offset_secs * 1e9) as i64;
        Self { stamp_offset, stamps: BTreeMap::new(), frames: Vec::new(), restart: false, motion: None, adversary }
    }

    /// Time since the drive began, ns, of the keyframe with the nearest stamp.
    pub fn drive_nanos(&self, stamp_secs: f64) -> u64 {
        let stamp = (stamp_secs * 1e9) as i64;
        let near = self.stamps.range(..=stamp).next_back().into_iter().chain(self.stamps.range(stamp..).next());
        near.min_by_key(|(at, _)| at.abs_diff(stamp)).map_or(0, |(_, nanos)| *nanos)
    }

    /// The clock jumps; it shows 1970 at least.
    pub fn jump(&mut self, secs: f64, now: Instant) {
        let earliest = now.as_nanos().cast_signed().wrapping_neg();
        self.stamp_offset = self.stamp_offset.saturating_add((secs * 1e9) as i64).max(earliest);
    }

    /// Seconds since 2020 that the clock shows.
    pub fn wall_epoch(&self, now: Instant) -> u32 {
        let secs = self.stamp_offset.saturating_add_unsigned(now.as_nanos()).div_euclid(1_000_000_000);
        u32::try_from(secs - EPOCH_ORIGIN_SECS).unwrap_or(0)
    }

    /// The next keyframe begins a new frame.
    pub fn restart(&mut self) {
        self.restart = true;
    }

    /// Odometry of the body at `step`, in the frame of that time.
    pub fn t_frame_body(&self, step: &Step) -> Se3 {
        let begun = self.frames.iter().rev().find(|(nanos, _)| *nanos <= step.nanos);
        let true_one =
            begun.map_or(step.t_frame_body, |(_, t_drive_frame)| t_drive_frame.inverse() * step.t_frame_body);
        let stretch = self.adversary.map_or(1.0, Adversary::stretch);
        Se3::new(true_one.rotation, true_one.translation * stretch)
    }

    /// Where the frame of that time lies, by this step, if its unit is `unit_m`.
    pub fn t_world_frame(&self, step: &Step, unit_m: f64) -> Sim3 {
        let unit = Sim3::new(So3::identity(), Vector3::zeros(), unit_m);
        Sim3::from_se3(&step.t_world_body) * unit * Sim3::from_se3(&self.t_frame_body(step).inverse())
    }

    /// The agent will not see this keyframe: its motion belongs to the next one.
    pub fn skip(&mut self, step: &Step) {
        self.motion = Some(self.motion_with(step));
    }

    /// The keyframe as the agent gets it.
    pub fn keyframe(&mut self, step: &Step, seen: Sightings) -> Result<Keyframe, CovarianceError> {
        let mut motion = self.motion_with(step);
        self.motion = None;
        if core::mem::take(&mut self.restart) {
            self.frames.push((step.nanos, step.t_frame_body));
            motion.covariance = Covariance::from_sigmas([FIRST_SIGMA; 6])?;
        }
        let pose = self.t_frame_body(step);
        let claims = self.adversary.map_or(1.0, Adversary::claims);
        let stamp = self.stamp_offset.saturating_add_unsigned(step.nanos);
        self.stamps.insert(stamp, step.nanos);
        let (points, marks) = seen;
        Ok(Keyframe {
            stamp: Stamp(stamp),
            pose: PoseWithCovariance { pose, covariance: motion.covariance.scaled(claims) },
            covariance_of: CovarianceOf::Motion,
            session: None,
            points,
            marks,
            place: None,
            up: None,
        })
    }

    fn motion_with(&self, step: &Step) -> PoseWithCovariance {
        self.motion.map_or(step.motion, |before| before.compose(&step.motion))
    }
}

/// The members of a swarm, one per name of the stage, with keys drawn from the seed.
pub(super) fn identities(stage: &Stage, seed: u64) -> Result<Vec<(Identity, RobotId)>, NameError> {
    let secret = |name: &str| *blake3::hash(format!("key {seed} {name}").as_bytes()).as_bytes();
    let public = |name: &str| SigningKey::from_bytes(&secret(name)).verifying_key().to_bytes();
    let roster: BTreeMap<Name, [u8; 32]> =
        stage.names().iter().map(|name| Ok((Name::new(name)?, public(name)))).collect::<Result<_, _>>()?;
    let swarm = Name::new("sim")?;
    let one = |text: &String| {
        let name = Name::new(text)?;
        let identity = Identity { swarm: swarm.clone(), name, secret_key: secret(text), roster: roster.clone() };
        Ok((identity, RobotId::of_key(&public(text))))
    };
    stage.names().iter().map(one).collect()
}

/// Virtual time that a job takes that is about so many anchors and measurements, ns.
pub(super) fn job_nanos(kind: &str, size: usize, machine: &MachineOptions) -> u64 {
    // Measured on one core of a laptop, rounded up: solves of 2,200 and 8,100 took 130 and 440 ms.
    let ms = match kind {
        "describe" => 120.0,
        "solve" => (0.06 * size as f64).max(60.0),
        _ => 150.0,
    };
    (ms * machine.slowness * 1e6) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(k: u64) -> Step {
        let pose = |x: f64| Se3::new(So3::identity(), [x, 0.0, 0.0].into());
        let covariance = Covariance::from_sigmas([0.1; 6]).unwrap();
        let motion = PoseWithCovariance { pose: pose(1.0), covariance };
        Step { nanos: k * 1_000_000_000, t_world_body: pose(k as f64), motion, t_frame_body: pose(k as f64) }
    }

    #[test]
    fn a_keyframe_answers_for_the_motion_of_those_that_were_missed() {
        let mut slam = Slam::new(-5.5, None);
        let one = slam.keyframe(&step(1), Sightings::default()).unwrap();
        slam.skip(&step(2));
        slam.skip(&step(3));
        let four = slam.keyframe(&step(4), Sightings::default()).unwrap();
        let five = slam.keyframe(&step(5), Sightings::default()).unwrap();
        let variance = |k: &Keyframe| k.pose.covariance.matrix()[(0, 0)];
        assert!((variance(&four) - 3.0 * variance(&one)).abs() < 1e-12);
        assert_eq!(variance(&five), variance(&one));
        assert_eq!(four.stamp.0 - one.stamp.0, 3_000_000_000);
        assert!(slam.drive_nanos(four.stamp.as_secs_f64()).abs_diff(4_000_000_000) < 1000);
    }

    #[test]
    fn a_restarted_slam_begins_at_the_identity() {
        let mut slam = Slam::new(0.0, None);
        slam.keyframe(&step(1), Sightings::default()).unwrap();
        slam.restart();
        assert_eq!(slam.keyframe(&step(2), Sightings::default()).unwrap().pose.pose, Se3::identity());
        assert_eq!(slam.keyframe(&step(3), Sightings::default()).unwrap().pose.pose.translation.x, 1.0);
    }
}

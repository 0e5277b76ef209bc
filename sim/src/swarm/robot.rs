//! One robot of a run: its key, its process (if it runs), its disk, its SLAM and what its shell remembers.

use super::store::Store;
use crate::scenario::{MachineOptions, Scenario};
use crate::stage::Stage;
use crate::world::drive::Step;
use ed25519_dalek::SigningKey;
use merganser_protocol::agent::Identity;
use merganser_protocol::agent::io::QueryId;
use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3};
use merganser_protocol::ids::{Name, NameError, RobotId};
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::{Instant, Stamp};
use serde::Serialize;
use std::collections::{BTreeMap, BTreeSet};

/// Standard deviation stated for a keyframe that defines its frame (m, rad): as good as exact.
const FIRST_SIGMA: f64 = 1e-6;
/// The stamp that a clock without offset shows when the run begins, ns.
const FIRST_STAMP_NS: i64 = 1_700_000_000_000_000_000;

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
    pub disk_full: bool,
    pub slam: Slam,
    pub questions: BTreeSet<QueryId>,
    pub asked: BTreeMap<u64, Asked>,
    pub tokens: u64,
    pub workers: Vec<Instant>,
    pub hears: Vec<Hearing>,
    pub usage: BTreeMap<&'static str, Usage>,
    pub keyframes: u64,
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
}

impl<C> Robot<C> {
    pub fn new(identity: Identity, id: RobotId, slam: Slam, scenario: &Scenario) -> Self {
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
            store: Store::default(),
            disk_full: false,
            slam,
            questions: BTreeSet::new(),
            asked: BTreeMap::new(),
            tokens: 0,
            workers: vec![Instant::ZERO; scenario.machine.workers],
            hears: vec![Hearing::default(); scenario.robots],
            usage: BTreeMap::new(),
            keyframes: 0,
        }
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
        for hearing in &mut self.hears {
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

    pub fn count(&mut self, kind: &'static str, bytes: usize) {
        let usage = self.usage.entry(kind).or_default();
        usage.messages += 1;
        usage.bytes += bytes as u64;
    }
}

/// The robot's SLAM, between the drive and the agent: it goes on when the agent's process does not, and can restart in
/// a new local frame.
pub(super) struct Slam {
    stamp_offset: i64,
    /// When each frame that a restart began, began, ns, and where in the drive.
    frames: Vec<(u64, Se3)>,
    restart: bool,
    /// Motion since the last keyframe that the agent took.
    motion: Option<PoseWithCovariance>,
}

impl Slam {
    pub fn new(offset_secs: f64) -> Self {
        let stamp_offset = FIRST_STAMP_NS + (offset_secs * 1e9) as i64;
        Self { stamp_offset, frames: Vec::new(), restart: false, motion: None }
    }

    /// Time since the drive began of a stamp in seconds, ns: good to a microsecond.
    pub fn drive_nanos(&self, stamp_secs: f64) -> u64 {
        ((stamp_secs - self.stamp_offset as f64 * 1e-9).max(0.0) * 1e9) as u64
    }

    /// The next keyframe begins a new frame.
    pub fn restart(&mut self) {
        self.restart = true;
    }

    /// Odometry of the body at `step`, in the frame of that time.
    pub fn t_frame_body(&self, step: &Step) -> Se3 {
        let begun = self.frames.iter().rev().find(|(nanos, _)| *nanos <= step.nanos);
        begun.map_or(step.t_frame_body, |(_, t_drive_frame)| t_drive_frame.inverse() * step.t_frame_body)
    }

    /// The agent will not see this keyframe: its motion belongs to the next one.
    pub fn skip(&mut self, step: &Step) {
        self.motion = Some(self.motion_with(step));
    }

    /// The keyframe as the agent gets it.
    pub fn keyframe(&mut self, step: &Step, points: Vec<[f32; 3]>) -> Result<Keyframe, CovarianceError> {
        let mut motion = self.motion_with(step);
        self.motion = None;
        if core::mem::take(&mut self.restart) {
            self.frames.push((step.nanos, step.t_frame_body));
            motion.covariance = Covariance::from_sigmas([FIRST_SIGMA; 6])?;
        }
        let pose = self.t_frame_body(step);
        Ok(Keyframe {
            stamp: Stamp(self.stamp_offset.saturating_add_unsigned(step.nanos)),
            pose: PoseWithCovariance { pose, covariance: motion.covariance },
            covariance_of: CovarianceOf::Motion,
            points,
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

/// Virtual time that a job takes, ns.
pub(super) fn job_nanos(kind: &str, machine: &MachineOptions) -> u64 {
    // Measured on one core of a laptop, rounded up; unknown kinds count as the dearest.
    let ms = match kind {
        "describe" | "submap" => 120.0,
        "solve" | "estimate" => 60.0,
        "marginals" => 60.0,
        _ => 150.0,
    };
    (ms * machine.slowness * 1e6) as u64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn step(k: u64) -> Step {
        let pose = |x: f64| Se3::new(merganser_protocol::geometry::So3::identity(), [x, 0.0, 0.0].into());
        let covariance = Covariance::from_sigmas([0.1; 6]).unwrap();
        let motion = PoseWithCovariance { pose: pose(1.0), covariance };
        Step { nanos: k * 1_000_000_000, t_world_body: pose(k as f64), motion, t_frame_body: pose(k as f64) }
    }

    #[test]
    fn a_keyframe_answers_for_the_motion_of_those_that_were_missed() {
        let mut slam = Slam::new(-5.5);
        let one = slam.keyframe(&step(1), Vec::new()).unwrap();
        slam.skip(&step(2));
        slam.skip(&step(3));
        let four = slam.keyframe(&step(4), Vec::new()).unwrap();
        let five = slam.keyframe(&step(5), Vec::new()).unwrap();
        let variance = |k: &Keyframe| k.pose.covariance.matrix()[(0, 0)];
        assert!((variance(&four) - 3.0 * variance(&one)).abs() < 1e-12);
        assert_eq!(variance(&five), variance(&one));
        assert_eq!(four.stamp.0 - one.stamp.0, 3_000_000_000);
        assert!(slam.drive_nanos(four.stamp.as_secs_f64()).abs_diff(4_000_000_000) < 1000);
    }

    #[test]
    fn a_restarted_slam_begins_at_the_identity() {
        let mut slam = Slam::new(0.0);
        slam.keyframe(&step(1), Vec::new()).unwrap();
        slam.restart();
        assert_eq!(slam.keyframe(&step(2), Vec::new()).unwrap().pose.pose, Se3::identity());
        assert_eq!(slam.keyframe(&step(3), Vec::new()).unwrap().pose.pose.translation.x, 1.0);
    }
}

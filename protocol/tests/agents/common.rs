//! A tiny shell for tests: agents joined by perfect wires, jobs run inline, a world of random boxes.

use merganser_protocol::agent::io::{Channel, Event, Input, JobId, Output, QueryKind, Record};
use merganser_protocol::agent::job::{AlignJob, Job, JobResult, Measured, NotAligned};
use merganser_protocol::agent::{Agent, Identity, Restored};
use merganser_protocol::config::Config;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::{Name, RobotId};
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::{Instant, Stamp};
use nalgebra::{Vector3, Vector6};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use std::collections::{BTreeMap, VecDeque};
use std::time::Duration;

pub const NAMES: [&str; 3] = ["alpha", "beta", "gamma"];

pub fn name(k: usize) -> Name {
    Name::new(NAMES[k]).unwrap()
}

pub fn secret(k: usize) -> [u8; 32] {
    [k as u8 + 1; 32]
}

pub fn public(k: usize) -> [u8; 32] {
    ed25519_dalek::SigningKey::from_bytes(&secret(k)).verifying_key().to_bytes()
}

pub fn robot(k: usize) -> RobotId {
    RobotId::of_key(&public(k))
}

pub fn identity(k: usize) -> Identity {
    let roster: BTreeMap<Name, [u8; 32]> = (0..3).map(|n| (name(n), public(n))).collect();
    Identity { swarm: Name::new("test").unwrap(), name: name(k), secret_key: secret(k), roster }
}

pub fn config() -> Config {
    let mut config = Config::default();
    config.submap.voxel_m = 0.2;
    config.submap.distance_m = 3.0;
    config
}

pub fn agent(k: usize, restored: Restored) -> Agent {
    Agent::new(config(), identity(k), 42 + k as u64, restored, Instant::ZERO).unwrap()
}

/// A new robot with knobs of its own.
pub fn agent_of(k: usize, config: &Config) -> Agent {
    Agent::new(config.clone(), identity(k), 42, Restored::default(), Instant::ZERO).unwrap()
}

/// Points on the faces of random boxes inside a 16 m hall.
pub struct World {
    boxes: Vec<(Vector3<f64>, Vector3<f64>, So3)>,
}

impl World {
    pub fn new(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let boxes = (0..45)
            .map(|_| {
                let c =
                    Vector3::new(rng.random_range(-8.0..8.0), rng.random_range(-8.0..8.0), rng.random_range(0.0..2.5));
                let h =
                    Vector3::new(rng.random_range(0.15..1.2), rng.random_range(0.15..1.2), rng.random_range(0.15..1.2));
                (c, h, So3::exp(&Vector3::new(0.0, 0.0, rng.random_range(-3.0..3.0))))
            })
            .collect();
        Self { boxes }
    }

    /// What a sensor at `t_world_body` sees: noisy samples of every face within range, a new draw each time.
    pub fn scan(&self, t_world_body: &Se3, seed: u64) -> Vec<[f32; 3]> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let t_body_world = t_world_body.inverse();
        let mut points = Vec::new();
        for (c, h, r) in &self.boxes {
            for _ in 0..150 {
                let mut u = Vector3::from_fn(|_, _| rng.random_range(-1.0..1.0));
                let axis = rng.random_range(0..3usize);
                u[axis] = if rng.random_range(0.0..1.0) < 0.5 { -1.0 } else { 1.0 };
                let p = t_body_world * (*r * u.component_mul(h) + c);
                let noise = Vector3::from_fn(|_, _| rng.random_range(-0.02..0.02));
                if p.norm() < 9.0 {
                    let p = p + noise;
                    points.push([p.x as f32, p.y as f32, p.z as f32]);
                }
            }
        }
        points
    }
}

/// Keyframes of robot `k` driving a circle through the world, with odometry noise of 5 mm and 0.002 rad a step.
pub fn drive(world: &World, k: usize, count: usize) -> (Vec<Keyframe>, Vec<Se3>) {
    let mut rng = ChaCha8Rng::seed_from_u64(900 + k as u64);
    let sigmas = Vector6::new(0.005, 0.005, 0.005, 0.002, 0.002, 0.002);
    let covariance = Covariance::from_sigmas(sigmas.into()).unwrap();
    let mut truth: Vec<Se3> = Vec::new();
    let mut odometry = Se3::identity();
    let mut keyframes = Vec::new();
    for n in 0..count {
        let angle = k as f64 * 1.2 + n as f64 * 0.17;
        let position = Vector3::new(4.5 * angle.cos(), 4.5 * angle.sin(), 1.0);
        let pose = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, angle + 1.6)), position);
        if let Some(last) = truth.last() {
            let noise = Vector6::from_fn(|i, _| sigmas[i] * gaussian(&mut rng));
            odometry = odometry * (last.inverse() * pose).retract(&noise);
        }
        keyframes.push(Keyframe {
            stamp: Stamp(n as i64 * 1_000_000_000),
            pose: PoseWithCovariance { pose: odometry, covariance },
            covariance_of: CovarianceOf::Motion,
            session: None,
            points: world.scan(&pose, 7 * n as u64 + 1000 * k as u64),
            marks: Vec::new(),
            place: None,
            up: None,
        });
        truth.push(pose);
    }
    (keyframes, truth)
}

fn gaussian(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| rng.random_range(0.0..1.0)).sum::<f64>() - 6.0
}

/// What an outsider answers to a question of this robot's.
type Forged = Box<dyn Fn(usize, QueryKind, &[u8]) -> Vec<Vec<u8>>>;
/// Whether an answer never comes: to whom, and which.
type Lost = Box<dyn Fn(usize, &[u8]) -> bool>;

type Answers = Box<dyn Fn(&AlignJob) -> Option<Result<Box<Measured>, NotAligned>>>;

/// Agents on perfect wires: everything is delivered at once, every record is durable at once.
pub struct Wires {
    pub agents: Vec<Agent>,
    pub now: Instant,
    pub events: Vec<(usize, Event)>,
    pub disks: Vec<Vec<Record>>,
    /// Of each batch that went to a disk: whose, how many records, and how many of them refused pairs.
    pub batches: Vec<(usize, usize, usize)>,
    pub published: Vec<(usize, Channel, Vec<u8>)>,
    /// Who asked for a piece of a blob, when, and the answer.
    pub pieces: Vec<(usize, Instant, Option<Vec<u8>>)>,
    /// What a look at a pair comes to, if it is not to be run.
    pub answers: Answers,
    /// Which answers are lost.
    pub lost: Lost,
    /// What an outsider answers before the one who is asked does.
    pub forged: Forged,
    /// Kinds of jobs that are not run, and whose they are.
    pub hold: &'static [&'static str],
    pub held: Vec<(usize, JobId, Job)>,
    inbox: VecDeque<(usize, Input)>,
}

impl Wires {
    pub fn new(agents: Vec<Agent>) -> Self {
        let disks = vec![Vec::new(); agents.len()];
        let mut wires = Self {
            agents,
            now: Instant::ZERO,
            events: Vec::new(),
            disks,
            batches: Vec::new(),
            published: Vec::new(),
            pieces: Vec::new(),
            answers: Box::new(|_| None),
            lost: Box::new(|_, _| false),
            forged: Box::new(|_, _, _| Vec::new()),
            hold: &[],
            held: Vec::new(),
            inbox: VecDeque::new(),
        };
        for a in 0..wires.agents.len() {
            for b in 0..wires.agents.len() {
                if a != b {
                    let robot = wires.agents[b].robot();
                    wires.inbox.push_back((a, Input::Neighbour { robot, up: true }));
                }
            }
        }
        wires.settle();
        wires
    }

    pub fn input(&mut self, k: usize, input: Input) {
        self.inbox.push_back((k, input));
        self.settle();
    }

    /// Lets virtual time pass in steps to every wake-up asked for.
    pub fn run(&mut self, duration: Duration) {
        let end = self.now.after(duration);
        loop {
            let next = self.agents.iter().filter_map(Agent::poll_timeout).min().unwrap_or(end).max(self.now);
            if next > end {
                break;
            }
            self.now = next.after(Duration::from_millis(1));
            for k in 0..self.agents.len() {
                self.inbox.push_back((k, Input::Timeout));
            }
            self.settle();
        }
        self.now = end;
    }

    fn settle(&mut self) {
        while let Some((k, input)) = self.inbox.pop_front() {
            self.agents[k].handle(self.now, input);
            while let Some(output) = self.agents[k].poll_output() {
                self.carry(k, output);
            }
        }
    }

    fn carry(&mut self, k: usize, output: Output) {
        match output {
            Output::Persist { batch, records } => {
                let refused = records.iter().filter(|record| matches!(record, Record::Refused { .. })).count();
                self.batches.push((k, records.len(), refused));
                records.into_iter().for_each(|record| put(&mut self.disks[k], record));
                self.inbox.push_back((k, Input::Persisted { up_to: batch }));
            }
            Output::Publish { channel, bytes } => {
                let from = self.agents[k].robot();
                for other in (0..self.agents.len()).filter(|other| *other != k) {
                    self.inbox.push_back((other, Input::Received { from, channel, bytes: bytes.clone() }));
                }
                self.published.push((k, channel, bytes));
            }
            Output::Ask { query, peer, kind, bytes: question } => {
                let bytes = question.clone();
                let token = merganser_protocol::agent::io::AskToken(query.0);
                let answer = self.agents.iter().position(|agent| agent.robot() == peer).map(|other| {
                    self.agents[other].handle(self.now, Input::Asked { token, kind, bytes });
                    let mut answer = None;
                    while let Some(output) = self.agents[other].poll_output() {
                        match output {
                            Output::Answer { token: t, bytes } if t == token => answer = Some(bytes),
                            output => self.carry(other, output),
                        }
                    }
                    answer.expect("every question is answered at once")
                });
                let answer = answer.filter(|bytes| !(self.lost)(k, bytes));
                if kind == QueryKind::Blob {
                    self.pieces.push((k, self.now, answer.clone()));
                }
                let forged = (self.forged)(k, kind, &question);
                for bytes in forged.into_iter().chain(answer).map(Some).chain([None]) {
                    self.inbox.push_back((k, Input::Answered { query, bytes }));
                }
            }
            Output::Answer { .. } => {}
            Output::Run { id, job } if self.hold.contains(&job.kind()) => self.held.push((k, id, job)),
            Output::Run { id, job } => {
                let answer = if let Job::Align(job) = &job { (self.answers)(job) } else { None };
                let result = answer.map_or_else(|| job.run(), JobResult::Aligned);
                self.inbox.push_back((k, Input::JobDone { job: id, result }));
            }
            Output::Event(event) => self.events.push((k, event)),
        }
    }
}

/// What a disk does with a record.
fn put(disk: &mut Vec<Record>, record: Record) {
    if let Record::Refused { i, j, .. } = record {
        disk.retain(|other| !matches!(other, Record::Refused { i: a, j: b, .. } if (*a, *b) == (i, j)));
    }
    let (frame, below, submaps, blobs) = match record {
        Record::Replaced { below, submaps, blobs } => (below.frame, Some(below.seq), submaps, blobs),
        Record::Retired { frame, submaps, blobs } => (frame, None, submaps, blobs),
        record => {
            let stays = !matches!(record, Record::Refused { evidence: None, .. });
            return disk.extend(stays.then_some(record));
        }
    };
    disk.retain(|record| match record {
        Record::Entry { id, .. } => id.frame != frame || below.is_some_and(|below| id.seq >= below),
        Record::Fork { frame: of, .. } => *of != frame || below.is_some(),
        Record::Private { submap, .. } => !submaps.contains(submap),
        Record::Blob { hash, .. } => !blobs.contains(hash),
        _ => true,
    });
}

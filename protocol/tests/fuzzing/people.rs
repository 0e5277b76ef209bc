//! Who is in the stories: two agents, a member who lies, and a stranger; and what they see.

use ed25519_dalek::SigningKey;
use merganser_protocol::agent::{Agent, Identity, Restored};
use merganser_protocol::config::Config;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use merganser_protocol::ids::{Name, RobotId};
use merganser_protocol::submap::{self, CovarianceOf, Keyframe, SubmapBuilder};
use merganser_protocol::time::{Instant, Stamp};
use std::sync::OnceLock;

/// The robots that are agents.
pub const AGENTS: usize = 2;
/// The roster: the agents and the liar.
pub const MEMBERS: usize = 3;
/// All robots: the last is in no roster.
pub const ROBOTS: usize = 4;
/// Points in a scan.
pub const SCAN: usize = 90;

const NAMES: [&str; ROBOTS] = ["alpha", "beta", "gamma", "stranger"];

/// Keys are dear to make, and every story needs them.
struct Person {
    key: SigningKey,
    public: [u8; 32],
    robot: RobotId,
}

fn person(k: usize) -> &'static Person {
    static ALL: OnceLock<Vec<Person>> = OnceLock::new();
    let make = |k: usize| {
        let key = SigningKey::from_bytes(&[k as u8 + 1; 32]);
        let public = key.verifying_key().to_bytes();
        Person { key, public, robot: RobotId::of_key(&public) }
    };
    &ALL.get_or_init(|| (0..ROBOTS).map(make).collect())[k]
}

pub fn key(k: usize) -> &'static SigningKey {
    &person(k).key
}

pub fn robot(k: usize) -> RobotId {
    person(k).robot
}

pub fn name(k: usize) -> Name {
    Name::new(NAMES[k]).unwrap()
}

pub fn swarm() -> Name {
    Name::new("test").unwrap()
}

pub fn roster() -> Vec<(Name, [u8; 32])> {
    (0..MEMBERS).map(|k| (name(k), person(k).public)).collect()
}

/// Narrow limits, so that short stories meet them.
pub fn config() -> Config {
    let mut config = Config::default();
    config.submap.voxel_m = 0.2;
    config.submap.keyframes_max = 2;
    config.submap.points_max = 100;
    config.submap.keypoints = 16;
    config.submap.keypoints_further = 16;
    config.align.support_min = 3.0;
    config.align.fit_min = 0.0;
    config.align.jobs_max = 1;
    config.align.candidates_max = 4;
    config.estimate.alignments_min = 1;
    config.estimate.iterations_max = 5;
    config.estimate.interval_secs = 0.1;
    config.gossip.delta_bytes_max = 4096;
    config.gossip.entries_per_frame_max = 12;
    config.gossip.condense_entries = 5;
    config.gossip.epochs_per_robot_max = 3;
    config
}

pub fn agent(k: usize, restored: Restored, now: Instant) -> Agent {
    let secret_key = key(k).to_bytes();
    let identity = Identity { swarm: swarm(), name: name(k), secret_key, roster: roster().into_iter().collect() };
    Agent::new(config(), identity, 42 + k as u64, restored, now).unwrap()
}

/// What a sensor sees: two walls and a floor, or with another `seed` something else.
pub fn scan(seed: u8, points: usize) -> Vec<[f32; 3]> {
    let mut state = u32::from(seed).wrapping_mul(0x9e37_79b9) | 1;
    let mut uniform = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    let point = |k: usize| {
        let (a, b) = (2.0 * uniform() - 1.0, 2.0 * uniform() - 1.0);
        match k % 3 {
            0 => [a, b, -0.5],
            1 => [1.0, a, 0.5 * b],
            _ => [a, -1.0 + 0.3 * a, 0.5 * b],
        }
    };
    (0..points).map(point).collect()
}

pub fn sigmas(sigma: f64) -> Option<Covariance<6>> {
    Covariance::from_sigmas([sigma; 6]).ok()
}

/// A keypoint blob and a summary as an honest robot makes them.
pub fn described() -> &'static (Vec<u8>, Vec<u8>) {
    static DESCRIBED: OnceLock<(Vec<u8>, Vec<u8>)> = OnceLock::new();
    DESCRIBED.get_or_init(|| {
        let pose = PoseWithCovariance { pose: Se3::identity(), covariance: sigmas(0.01).unwrap() };
        let mut builder = SubmapBuilder::new(config().submap);
        let points = scan(1, SCAN);
        builder
            .push(Keyframe {
                stamp: Stamp(1),
                pose,
                covariance_of: CovarianceOf::Motion,
                session: None,
                points,
                marks: Vec::new(),
                place: None,
                up: None,
            })
            .unwrap();
        let described = submap::describe(&builder.flush().unwrap(), &config().submap);
        (described.keypoints.encode(), described.summary.encode())
    })
}

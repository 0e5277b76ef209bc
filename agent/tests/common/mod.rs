//! What the network tests share: swarms on loopback with free ports and no multicast, a stand-in for the core,
//! keyframes of a room, and waiting with an end.
#![allow(dead_code, reason = "each test file uses its part")]

use merganser::certificates::Holder;
use merganser::certificates::authority::Authority;
use merganser::config::{FileConfig, Security};
use merganser::driver::Clock;
use merganser::host::{Host, Options};
use merganser::store;
use merganser::trust::SecretKey;
use merganser_protocol::agent::io::{Input, Output};
use merganser_protocol::agent::{Agent, Core};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use merganser_protocol::ids::{Hash, Name, RobotId};
use merganser_protocol::snapshot::Snapshot;
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::{Instant, Stamp};
use nalgebra::Vector3;
use std::collections::VecDeque;
use std::net::TcpListener;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// However loaded the machine is, a test ends.
pub const PATIENCE: Duration = Duration::from_secs(60);

pub fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

/// Configurations of a swarm on loopback, each connected to all before it.
pub fn swarm(folder: &Path, names: &[&str]) -> Vec<FileConfig> {
    let keys: Vec<SecretKey> = (1..=names.len() as u8).map(|i| SecretKey::from_bytes([i; 32])).collect();
    let roster: std::collections::BTreeMap<_, _> =
        names.iter().map(|n| name(n)).zip(keys.iter().map(SecretKey::public)).collect();
    let listeners: Vec<TcpListener> = names.iter().map(|_| TcpListener::bind("127.0.0.1:0").unwrap()).collect();
    let endpoints: Vec<String> =
        listeners.iter().map(|l| format!("tcp/127.0.0.1:{}", l.local_addr().unwrap().port())).collect();
    drop(listeners);
    let member = |(i, robot): (usize, &&str)| {
        let key_file = folder.join(format!("{robot}.key"));
        keys[i].save(&key_file).unwrap();
        let mut config = FileConfig::new(name("test"), name(robot), key_file, roster.clone());
        config.store.path = folder.join(format!("{robot}.redb"));
        config.zenoh.listen = vec![endpoints[i].clone()];
        config.zenoh.connect = endpoints[..i].to_vec();
        config.zenoh.multicast = false;
        config.debug.interval_secs = 0.1;
        config.core.gossip.have_secs = 0.2;
        config.core.gossip.pose_secs = 0.1;
        config
    };
    names.iter().enumerate().map(member).collect()
}

/// Links of all these robots by TLS, with certificates of an authority of their own; whom they know as observers and
/// routers is given by name. Keys of observers are those of the names' places from 101.
pub fn secured(folder: &Path, configs: &mut [FileConfig], observers: &[&str], routers: &[&str]) -> Authority {
    let authority = Authority::generate(configs[0].swarm.clone(), 10).unwrap();
    let ca = folder.join("authority.crt");
    std::fs::write(&ca, authority.certificate().pem()).unwrap();
    for config in &mut *configs {
        let certificate = folder.join(format!("{}.crt", config.robot));
        let holder = Holder::Robot(config.robot.clone());
        let made = authority.issue(&holder, &config.roster[&config.robot], 100).unwrap();
        std::fs::write(&certificate, made.pem()).unwrap();
        let keys = observers.iter().zip(101..).map(|(n, byte)| (name(n), SecretKey::from_bytes([byte; 32]).public()));
        config.observers = keys.collect();
        let zenoh = &mut config.zenoh;
        (zenoh.security, zenoh.certificate, zenoh.authority) =
            (Some(Security::Tls), Some(certificate), Some(ca.clone()));
        zenoh.routers = routers.iter().map(|n| name(n)).collect();
        let by_tls = |endpoint: &String| endpoint.replace("tcp/", "tls/");
        zenoh.listen = zenoh.listen.iter().map(by_tls).collect();
        zenoh.connect = zenoh.connect.iter().map(by_tls).collect();
        zenoh.input_listen = Some(vec![free_endpoint()]);
    }
    authority
}

pub fn free_endpoint() -> String {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    format!("tcp/127.0.0.1:{}", listener.local_addr().unwrap().port())
}

/// An agent of which `core` is the core: it says what it is told to, and keeps what it hears.
pub async fn puppet(config: &FileConfig, core: &Puppet) -> Host {
    let store = store::open(config).unwrap().store;
    Host::assemble(config, core.clone(), store, None, Clock::start()).await.unwrap()
}

/// The robot of a configuration.
pub fn id(config: &FileConfig) -> RobotId {
    RobotId::of_key(&config.roster[&config.robot].to_bytes())
}

pub async fn start(config: &FileConfig, journal: Option<&Path>) -> Host {
    let options = Options { journal: journal.map(Into::into), seed: Some(7) };
    Host::start(config.clone(), options).await.unwrap()
}

/// Waits until `done` says so.
pub async fn until(what: &str, mut done: impl AsyncFnMut() -> bool) {
    let waiting = async {
        while !done().await {
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    };
    assert!(tokio::time::timeout(PATIENCE, waiting).await.is_ok(), "waited in vain for: {what}");
}

/// A stand-in for the core: remembers what it is handed, and says what it is told to say.
#[derive(Clone, Debug, Default)]
pub struct Puppet {
    pub heard: Arc<Mutex<Vec<Input>>>,
    pub to_say: Arc<Mutex<VecDeque<Output>>>,
    /// Answers each question with its bytes in reverse.
    pub answers: bool,
    /// Takes so long over each input.
    pub slow: Duration,
    pub now: Instant,
    pub ready: VecDeque<Output>,
}

impl Puppet {
    pub fn say(&self, output: Output) {
        self.to_say.lock().unwrap().push_back(output);
    }

    pub fn has_heard(&self, what: impl Fn(&Input) -> bool) -> bool {
        self.heard.lock().unwrap().iter().any(what)
    }
}

impl Core for Puppet {
    fn handle(&mut self, now: Instant, input: Input) {
        assert!(now >= self.now, "time went back");
        assert!(self.ready.is_empty(), "the outputs of the last input were not drained");
        self.now = now;
        std::thread::sleep(self.slow);
        if let (true, Input::Asked { token, bytes, .. }) = (self.answers, &input) {
            let bytes = bytes.iter().rev().copied().collect();
            self.ready.push_back(Output::Answer { token: *token, bytes });
        }
        self.ready.extend(self.to_say.lock().unwrap().drain(..));
        if !matches!(input, Input::Timeout) {
            self.heard.lock().unwrap().push(input);
        }
    }
    fn poll_output(&mut self) -> Option<Output> {
        self.ready.pop_front()
    }
    fn poll_timeout(&self) -> Option<Instant> {
        Some(self.now.after(Duration::from_millis(10)))
    }
    fn digest(&self) -> Hash {
        Hash::of(b"puppet")
    }
    fn snapshot(&self, now: Instant) -> Option<Snapshot> {
        Some(real_core_of_nobody().snapshot(now))
    }
}

/// A core that has seen nothing, for its empty snapshot.
fn real_core_of_nobody() -> Agent {
    let key = SecretKey::from_bytes([9; 32]);
    let identity = merganser_protocol::agent::Identity {
        swarm: name("test"),
        name: name("nobody"),
        secret_key: *key.to_bytes(),
        roster: [(name("nobody"), key.public().to_bytes())].into(),
    };
    Agent::new(Default::default(), identity, 0, Default::default(), Instant::ZERO).unwrap()
}

/// The `index`-th keyframe of a walk through a room; each `robot` walks another way. Points are drawn from a fixed
/// sequence, so the same call gives the same keyframe.
pub fn keyframe(robot: u64, index: u64) -> Keyframe {
    let mut state = robot * 1000 + index + 1;
    let mut draw = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f64 / f64::from(1 << 24)
    };
    let x = 0.4 * index as f64;
    let t_room_body =
        Se3::new(So3::exp(&Vector3::new(0.0, 0.0, 0.05 * index as f64)), Vector3::new(x, robot as f64, 1.0));
    let t_body_room = t_room_body.inverse();
    let points = (0..3000).map(|i| {
        let (a, b) = (draw(), draw());
        let p = match i % 4 {
            0 => Vector3::new(10.0 * a - 3.0, -2.0, 2.5 * b),
            1 => Vector3::new(10.0 * a - 3.0, 3.0 + 0.3 * (2.0 * a).floor(), 2.5 * b),
            2 => Vector3::new(7.0, 5.0 * a - 2.0, 2.5 * b),
            _ => Vector3::new(10.0 * a - 3.0, 5.0 * b - 2.0, 0.0),
        };
        let p = t_body_room * p;
        [p.x as f32, p.y as f32, p.z as f32]
    });
    let covariance = Covariance::from_sigmas([0.01, 0.01, 0.01, 0.002, 0.002, 0.002]).unwrap();
    Keyframe {
        stamp: Stamp(1_000_000_000 + index as i64 * 500_000_000),
        pose: PoseWithCovariance { pose: t_room_body, covariance },
        covariance_of: CovarianceOf::Motion,
        session: None,
        points: points.collect(),
        marks: Vec::new(),
        place: None,
        up: None,
    }
}

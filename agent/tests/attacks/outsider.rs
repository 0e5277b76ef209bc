//! A member of the swarm that is no agent: it speaks on Zenoh as a robot would, and remembers all that others told it.
//! And agents as processes, to be killed.

use super::common::{PATIENCE, name, until};
use merganser::config::{FileConfig, ZenohConfig};
use merganser::keys;
use merganser::link::session::{self, Role};
use merganser::observation::SightingMessage;
use merganser::trust::SecretKey;
use merganser_protocol::agent::io::{Channel, QueryKind};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use merganser_protocol::ids::{EntryId, FrameId, RobotId, SubmapId};
use merganser_protocol::replica::{IngestError, Ingested, Replica, VectorForm};
use merganser_protocol::snapshot::{StatsView, StatusView};
use merganser_protocol::time::Stamp;
use merganser_protocol::wire::{Beacon, BeaconAge, BeaconContent, Entry, Life, LifeContent, Message, SwarmTag};
use serde::de::DeserializeOwned;
use std::fs::File;
use std::path::Path;
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{self, Receiver};
use std::time::Duration;
use zenoh::Session;
use zenoh::bytes::Encoding;
use zenoh::query::Query;

const PROGRAM: &str = env!("CARGO_BIN_EXE_merganser");
/// Longest wait for one answer.
const ANSWER_WAIT: Duration = Duration::from_secs(5);

/// See the module.
pub struct Outsider {
    session: Session,
    me: RobotId,
    name: String,
    key: ed25519_dalek::SigningKey,
    heard: Receiver<Vec<u8>>,
    /// All that was told and follows from the first entries on.
    pub replica: Replica,
    /// What was told since the last [`Outsider::take_told`].
    told: Vec<(EntryId, Vec<u8>)>,
    /// Beacons that it sent.
    beacons: Arc<AtomicU64>,
}

impl Outsider {
    /// The member of this configuration, which hears what `teller` publishes.
    pub async fn join(config: &FileConfig, teller: &str) -> Self {
        let zenoh = ZenohConfig { multicast: false, gossip: false, ..config.zenoh.clone() };
        let session = session::open(&zenoh, Role::Robot).await.unwrap();
        let (sender, heard) = mpsc::channel();
        let key = keys::of(&config.swarm, &name(teller), keys::channel(Channel::Facts));
        let subscriber = session.declare_subscriber(key).callback(move |sample| {
            let _ = sender.send(sample.payload().to_bytes().into_owned()); // fails at the end of the test alone
        });
        subscriber.background().await.unwrap();
        let secret = SecretKey::load(&config.key_file).unwrap();
        let beacons = Arc::new(AtomicU64::new(0));
        let (key, sent) = (ed25519_dalek::SigningKey::from_bytes(&secret.to_bytes()), beacons.clone());
        let swarm = SwarmTag::of(&config.swarm);
        let is_there = move |query: Query| {
            use zenoh::Wait as _;
            let Ok(Message::LifeRequest { nonce }) = Message::decode(&query.payload().unwrap().to_bytes()) else {
                return;
            };
            let counter = sent.load(Relaxed);
            let latest = BeaconAge { epoch: 1, stamp: Stamp(counter as i64), counter };
            let robot = RobotId::of_key(key.verifying_key().as_bytes());
            let life = Life::sign(&key, swarm, LifeContent { robot, nonce, latest: Some(latest) });
            query.reply(query.key_expr().clone(), Message::LifeReply(life).encode()).wait().unwrap();
        };
        let life = keys::of(&config.swarm, &config.robot, keys::query(QueryKind::Life));
        session.declare_queryable(life).callback(is_there).background().await.unwrap();
        let roster = config.roster.iter().map(|(name, key)| (name.clone(), key.to_bytes()));
        Self {
            session,
            me: RobotId::of_key(&secret.public().to_bytes()),
            name: config.robot.to_string(),
            key: ed25519_dalek::SigningKey::from_bytes(&secret.to_bytes()),
            heard,
            replica: Replica::new(&config.swarm, roster, &config.core.gossip).unwrap(),
            told: Vec::new(),
            beacons,
        }
    }

    /// A view of `robot`, if it answers.
    async fn view<T: DeserializeOwned>(&self, robot: &str, view: &str) -> Option<T> {
        let key = keys::of(&name("test"), &name(robot), &format!("view/{view}"));
        let replies = self.session.get(key).timeout(ANSWER_WAIT).await.unwrap();
        let reply = replies.recv_async().await.ok()?;
        Some(serde_json::from_slice(&reply.result().ok()?.payload().to_bytes()).unwrap())
    }

    pub async fn try_status(&self, robot: &str) -> Option<StatusView> {
        self.view(robot, "status").await
    }

    /// Waits for the robot's status.
    pub async fn status(&self, robot: &str) -> StatusView {
        let mut status = None;
        until("a status", async || {
            status = self.try_status(robot).await;
            status.is_some()
        })
        .await;
        status.unwrap()
    }

    /// Waits for the robot's counters.
    pub async fn stats(&self, robot: &str) -> StatsView {
        let mut stats = None;
        until("counters", async || {
            stats = self.view(robot, "stats").await;
            stats.is_some()
        })
        .await;
        stats.unwrap()
    }

    /// Takes in what `teller` published so far.
    pub fn listen(&mut self) {
        while let Ok(bytes) = self.heard.try_recv() {
            let Ok(Message::Facts(entries)) = Message::decode(&bytes) else { panic!("no facts: {bytes:?}") };
            entries.iter().for_each(|entry| self.learn(&entry.0));
        }
    }

    /// Asks `robot` for what is missing here, until nothing is. False if there was no answer.
    pub async fn sync(&mut self, robot: &str) -> bool {
        loop {
            let have = self.replica.have(self.me, VectorForm { tagged: true, ..VectorForm::default() });
            let key = keys::of(&name("test"), &name(robot), keys::query(QueryKind::Sync));
            let question = self.session.get(key).payload(Message::SyncRequest(have).encode()).timeout(ANSWER_WAIT);
            let replies = question.encoding(keys::query_encoding(QueryKind::Sync)).await.unwrap();
            let Ok(reply) = replies.recv_async().await else { return false };
            let Ok(sample) = reply.result() else { return false };
            let message = Message::decode(&sample.payload().to_bytes());
            let Ok(Message::SyncReply(delta)) = message else { panic!("{message:?}") };
            assert!(delta.forks.is_empty(), "{robot} tells of a fork: {:?}", delta.forks);
            delta.entries.iter().for_each(|entry| self.learn(&entry.0));
            if !delta.more {
                return true;
            }
        }
    }

    fn learn(&mut self, bytes: &[u8]) {
        self.told.push((Entry::decode(bytes).unwrap().id(), bytes.to_vec()));
        match self.replica.ingest(bytes) {
            Ok(Ingested::New(ids)) => ids.into_iter().for_each(|id| self.replica.mark_durable(id)),
            // Published entries may be too far ahead of what arrived; the next sync brings what is between.
            Ok(_) | Err(IngestError::TooEarly(_)) => {}
            Err(error) => panic!("{error}"),
        }
    }

    /// All that was told since the last call.
    pub fn take_told(&mut self) -> Vec<(EntryId, Vec<u8>)> {
        std::mem::take(&mut self.told)
    }

    /// Sends `robot` something as its own SLAM would.
    pub async fn feed(&self, robot: &str, input: &str, message: &impl serde::Serialize) {
        let key = keys::of(&name("test"), &name(robot), &format!("in/{input}"));
        let put = self.session.put(key, postcard::to_stdvec(message).unwrap());
        put.encoding(Encoding::APPLICATION_OCTET_STREAM).await.unwrap();
    }

    /// For saying things beside all else.
    pub fn voice(&self) -> Voice {
        Voice(self.session.clone())
    }

    /// Tells all where it is, so that it can be sighted.
    pub async fn beacon(&mut self) {
        let counter = self.beacons.fetch_add(1, Relaxed) + 1;
        let covariance = Covariance::from_sigmas([0.01; 6]).unwrap();
        let content = BeaconContent {
            anchor: SubmapId { frame: FrameId { robot: self.me, epoch: 1 }, index: 0 },
            stamp: Stamp(counter as i64),
            counter,
            t_anchor_body: PoseWithCovariance { pose: Se3::identity(), covariance },
        };
        let beacon = Beacon::sign(&self.key, self.replica.swarm(), &content).unwrap();
        self.voice().say(&self.name, Channel::Pose, Message::Pose(beacon).encode()).await;
    }

    pub async fn leave(self) {
        session::close(&self.session, PATIENCE).await;
    }
}

/// Says on a channel whatever it likes, under any name.
pub struct Voice(Session);

impl Voice {
    pub async fn say(&self, robot: &str, channel: Channel, bytes: Vec<u8>) {
        let key = keys::of(&name("test"), &name(robot), keys::channel(channel));
        self.0.put(key, bytes).encoding(keys::encoding(channel)).await.unwrap();
    }
}

/// A sighting of a robot.
pub fn sighting(stamp_ns: i64, robot: &str) -> SightingMessage {
    let mut covariance = [0.0; 21];
    for diagonal in [0, 6, 11, 15, 18, 20] {
        covariance[diagonal] = 1e-4;
    }
    let (translation, rotation) = ([1.0, 2.0, 0.5], [0.0, 0.0, 0.0, 1.0]);
    SightingMessage { stamp_ns, robot: name(robot), translation, rotation, covariance }
}

/// An agent as a process; killed with its value.
pub struct Agent(Child);

impl Agent {
    /// Runs the agent of `{robot}.toml` in a folder; `more` are further arguments.
    pub fn run(folder: &Path, robot: &str, more: &[&str]) -> Self {
        let log = File::options().create(true).append(true).open(folder.join(format!("{robot}.log"))).unwrap();
        let mut command = Command::new(PROGRAM);
        command.args(["run", "--leash", "--config", &format!("{robot}.toml")]).args(more).current_dir(folder);
        command.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(log);
        Self(command.spawn().unwrap())
    }

    /// SIGKILL.
    pub fn kill(mut self) -> ExitStatus {
        assert_eq!(self.0.try_wait().unwrap(), None, "it ended by itself");
        self.0.kill().unwrap();
        self.0.wait().unwrap()
    }

    /// Resident memory, bytes; `None` where the system does not tell.
    pub fn memory(&self) -> Option<u64> {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.0.id())).ok()?;
        let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:"))?;
        Some(line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok()? * 1024)
    }
}

impl Drop for Agent {
    fn drop(&mut self) {
        let _ = self.0.kill(); // it may have ended
        let _ = self.0.wait();
    }
}

//! A robot in its namespace: the real program, fed with one of the demonstration's recordings, and what its spectator
//! sees of it.

use super::air::Air;
use super::common::{secured, swarm};
use super::spectator::{PORT, ROBOT};
use merganser::config::{FileConfig, Security};
use merganser_protocol::snapshot::{FramesView, StatsView, StatusView};
use serde::Deserialize;
use std::collections::BTreeSet;
use std::fs::{self, File};
use std::io::{BufRead as _, BufReader};
use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdout, ExitStatus, Stdio};
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::{Duration, Instant};

const PROGRAM: &str = env!("CARGO_BIN_EXE_merganser");
const RECORDINGS: &str = "recordings";

/// However slow the link and the computer are, a test ends.
const PATIENCE: Duration = Duration::from_secs(120);
/// All must have held the same for this long.
const SETTLED: Duration = Duration::from_secs(2);
/// Time between two looks at what the spectators saw.
const LOOK_EVERY: Duration = Duration::from_millis(100);

/// The robots of every test, as the recordings name them.
pub fn name_list() -> [&'static str; 3] {
    ["alpha", "beta", "gamma"]
}

/// Robots on one piece of air.
pub struct Fleet<'a> {
    robots: Vec<Robot<'a>>,
    _folder: tempfile::TempDir,
}

impl<'a> Fleet<'a> {
    /// Three agents as a swarm is recommended to be set up (a full connect list and multicast), each fed with its
    /// recording, `speed` times faster than it was driven.
    pub fn drive(air: &'a Air, speed: f64) -> Self {
        Self::start(air, speed, true, false)
    }

    /// The same with links by TLS.
    pub fn drive_guarded(air: &'a Air, speed: f64) -> Self {
        Self::start(air, speed, true, true)
    }

    /// The same without a connect list.
    pub fn scout(air: &'a Air, speed: f64) -> Self {
        Self::start(air, speed, false, false)
    }

    /// The same by TLS.
    pub fn scout_guarded(air: &'a Air, speed: f64) -> Self {
        Self::start(air, speed, false, true)
    }

    fn start(air: &'a Air, speed: f64, names_peers: bool, guarded: bool) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let names = name_list();
        let mut configs = swarm(folder.path(), &names);
        if guarded {
            secured(folder.path(), &mut configs, &[], &[]);
        }
        let transport = if guarded { "tls" } else { "tcp" };
        let endpoint = |name: &&str| format!("{transport}/{}:{PORT}", air.address(name));
        let connect: Vec<String> = names.iter().map(endpoint).collect();
        let robots = configs.into_iter().map(|config| {
            let own = endpoint(&config.robot.as_str());
            let others = connect.iter().filter(|other| names_peers && **other != own);
            let others = others.cloned().collect();
            Robot::new(air, folder.path(), config, others)
        });
        let mut fleet = Self { robots: robots.collect(), _folder: folder };
        fleet.robots.iter_mut().for_each(|robot| robot.start(Some(speed)));
        fleet
    }

    pub fn alpha(&mut self) -> &mut Robot<'a> {
        &mut self.robots[0]
    }

    pub fn beta(&mut self) -> &mut Robot<'a> {
        &mut self.robots[1]
    }

    pub fn gamma(&mut self) -> &mut Robot<'a> {
        &mut self.robots[2]
    }

    pub fn until_all(&mut self, what: &str, good: impl Fn(&Seen) -> bool) {
        for robot in &mut self.robots {
            robot.until(what, &good);
        }
    }

    /// Waits until all recordings are over, nobody has anything left to do, and all have held the same for a while.
    pub fn end_alike(&mut self) {
        self.settle(|seen| seen.status.idle);
    }

    /// The same where not all hear each other: keypoints that nobody in reach has are looked for half a minute longer.
    pub fn hold_alike(&mut self) {
        self.settle(|_| true);
    }

    fn settle(&mut self, done: impl Fn(&Seen) -> bool) {
        let began = Instant::now();
        let mut held: Option<(Instant, String, u64)> = None;
        loop {
            let seen: Vec<Seen> = self.robots.iter_mut().map(Robot::now).collect();
            let first = &seen[0].status;
            let over = |(robot, seen): (&Robot, &Seen)| seen.status.keyframes == robot.keyframes && done(seen);
            let over = self.robots.iter().zip(&seen).all(over);
            let alike = seen.iter().all(|s| (&s.status.digest, s.status.entries) == (&first.digest, first.entries));
            if !over || !alike {
                held = None;
            } else if held.as_ref().is_none_or(|(_, digest, _)| *digest != first.digest) {
                held = Some((Instant::now(), first.digest.clone(), first.entries));
            }
            if held.as_ref().is_some_and(|(since, ..)| since.elapsed() > SETTLED) {
                break;
            }
            assert!(began.elapsed() < PATIENCE, "they never held the same:\n{seen:#?}\n{}", self.logs());
            sleep(LOOK_EVERY);
        }
        let (_, digest, entries) = held.unwrap();
        println!("all hold {entries} entries, digest {digest:.16}…, after {:.0} s", began.elapsed().as_secs_f64());
        for robot in &mut self.robots {
            let seen = robot.now();
            for other in name_list() {
                assert!(seen.own_submaps(other) > 0, "{seen:?}");
            }
            let bad: Vec<_> = seen.stats.rejected.keys().filter(|reason| reason.contains("fork")).collect();
            assert!(bad.is_empty(), "{bad:?}");
        }
    }

    fn logs(&self) -> String {
        self.robots.iter().map(Robot::log_tail).collect()
    }
}

/// See the module.
pub struct Robot<'a> {
    air: &'a Air,
    name: String,
    home: PathBuf,
    agent: Option<Process>,
    _spectator: Process,
    seen: Arc<Mutex<Option<(Instant, Seen)>>>,
    /// What its last run will be fed with.
    keyframes: u64,
}

/// What a spectator saw at one moment.
#[derive(Clone, Debug, Deserialize)]
pub struct Seen {
    pub status: StatusView,
    frames: FramesView,
    stats: StatsView,
}

impl Seen {
    pub fn neighbours(&self) -> BTreeSet<&str> {
        self.status.neighbours.iter().map(String::as_str).collect()
    }

    /// Submaps that this robot knows of another (or of itself).
    pub fn own_submaps(&self, robot: &str) -> u64 {
        self.frames.frames.iter().filter(|frame| frame.robot == robot).map(|frame| frame.submaps).sum()
    }
}

impl<'a> Robot<'a> {
    fn new(air: &'a Air, home: &Path, config: FileConfig, connect: Vec<String>) -> Self {
        let mut config = FileConfig { core: Default::default(), ..config };
        let security = *config.zenoh.security.get_or_insert(Security::None);
        let everywhere = if security == Security::Tls { "tls/0.0.0.0" } else { "tcp/[::]" };
        config.zenoh.listen = vec![format!("{everywhere}:{PORT}")];
        config.zenoh.input_listen = None;
        config.zenoh.connect = connect;
        config.zenoh.multicast = true;
        let name = config.robot.to_string();
        config.save(&home.join(format!("{name}.toml"))).unwrap();
        let this = std::env::current_exe().unwrap();
        let mut spectator = air.command(&name, this.to_str().unwrap());
        spectator.args(["--exact", "spectator", "--ignored", "--nocapture"]).env(ROBOT, &name);
        let log = File::create(home.join(format!("{name}.spectator.log"))).unwrap();
        spectator.stdin(Stdio::piped()).stdout(Stdio::piped()).stderr(log);
        let mut spectator = Process(spectator.spawn().unwrap());
        let seen = Arc::default();
        let (lines, into) = (spectator.0.stdout.take().unwrap(), Arc::clone(&seen));
        std::thread::spawn(move || note(lines, &into));
        Self { air, name, home: home.into(), agent: None, _spectator: spectator, seen, keyframes: 0 }
    }

    /// Starts the agent, with its recording if a speed is given.
    pub fn start(&mut self, speed: Option<f64>) {
        let config = self.home.join(format!("{}.toml", self.name));
        let mut command = self.air.command(&self.name, PROGRAM);
        command.args(["run", "--leash", "--config"]).arg(config);
        self.keyframes = 0;
        if let Some(speed) = speed {
            let recording = std::path::absolute(RECORDINGS).unwrap().join(&self.name);
            let table = fs::read_to_string(recording.join("keyframes.csv")).unwrap();
            self.keyframes = table.lines().count() as u64 - 1;
            command.args(["--speed", &speed.to_string(), "--recording"]).arg(recording);
        }
        let log = File::options().create(true).append(true).open(log(&self.home, &self.name)).unwrap();
        command.stdin(Stdio::piped()).stdout(log.try_clone().unwrap()).stderr(log);
        self.agent = Some(Process(command.spawn().unwrap()));
    }

    /// Ends the agent without a word.
    pub fn kill(&mut self) -> ExitStatus {
        let mut agent = self.agent.take().unwrap();
        agent.0.kill().unwrap();
        agent.0.wait().unwrap()
    }

    /// Waits until the agent ends by itself; how, and the last that it wrote.
    pub fn end(&mut self) -> (ExitStatus, String) {
        let began = Instant::now();
        let agent = self.agent.as_mut().unwrap();
        let ended = loop {
            if let Some(ended) = agent.0.try_wait().unwrap() {
                break ended;
            }
            assert!(began.elapsed() < PATIENCE, "{} does not end\n{}", self.name, log_tail(&self.home, &self.name));
            sleep(LOOK_EVERY);
        };
        self.agent = None;
        (ended, self.log_tail())
    }

    /// What is seen from now on, as soon as it is.
    pub fn now(&mut self) -> Seen {
        self.until("an answer", |_| true)
    }

    /// Waits until something is seen.
    pub fn until(&mut self, what: &str, good: impl Fn(&Seen) -> bool) -> Seen {
        let asked = Instant::now();
        loop {
            let fresh = self.seen.lock().unwrap().clone().filter(|(when, _)| *when > asked).map(|(_, seen)| seen);
            if let Some(seen) = fresh.as_ref().filter(|seen| good(seen)) {
                return seen.clone();
            }
            self.wait_on(asked, what, &fresh);
        }
    }

    /// Waits until something holds of the robot.
    pub fn until_itself(&mut self, what: &str, good: impl Fn(&Self) -> bool) {
        let asked = Instant::now();
        while !good(self) {
            self.wait_on(asked, what, &None);
        }
    }

    fn wait_on(&mut self, since: Instant, what: &str, seen: &Option<Seen>) {
        if let Some(agent) = &mut self.agent {
            let ended = agent.0.try_wait().unwrap();
            assert!(ended.is_none(), "{} ended by itself\n{}", self.name, self.log_tail());
        }
        let name = &self.name;
        assert!(since.elapsed() < PATIENCE, "{name}: waited in vain: {what}\n{seen:#?}\n{}", self.log_tail());
        sleep(LOOK_EVERY);
    }

    /// Own addresses of all TCP connections in the robot's namespace, as the kernel tells them.
    pub fn links(&self) -> Vec<Ipv4Addr> {
        let agent = self.agent.as_ref().unwrap().0.id();
        let read = |table: &str| fs::read_to_string(format!("/proc/{agent}/net/{table}")).unwrap();
        // An IPv4 connection to a socket that serves both is listed with the IPv6 ones, its address in the last 8
        // digits.
        let (v4, v6) = (read("tcp"), read("tcp6"));
        let address = |line: &str| {
            let fields: Vec<&str> = line.split_whitespace().collect();
            let established = *fields.get(3)? == "01";
            let address = fields.get(1)?.split(':').next()?;
            let v4 = u32::from_str_radix(&address[address.len().checked_sub(8)?..], 16).ok()?;
            established.then(|| Ipv4Addr::from(v4.to_le_bytes()))
        };
        v4.lines().chain(v6.lines()).filter_map(address).collect()
    }

    fn log_tail(&self) -> String {
        log_tail(&self.home, &self.name)
    }
}

fn log(home: &Path, name: &str) -> PathBuf {
    home.join(format!("{name}.log"))
}

fn log_tail(home: &Path, name: &str) -> String {
    let text = fs::read_to_string(log(home, name)).unwrap_or_default();
    let lines: Vec<&str> = text.lines().collect();
    format!("--- {name}\n{}\n", lines[lines.len().saturating_sub(20)..].join("\n"))
}

/// Notes what the spectator says until it ends.
fn note(lines: ChildStdout, into: &Mutex<Option<(Instant, Seen)>>) {
    for line in BufReader::new(lines).lines() {
        let Ok(line) = line else { return };
        if line.starts_with('{') {
            // Views that are missing were not answered: the agent is not there.
            let seen = serde_json::from_str(&line).ok().map(|seen| (Instant::now(), seen));
            *into.lock().unwrap() = seen;
        }
    }
}

/// A process that ends with its value.
struct Process(Child);

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill(); // it may have ended by itself
        let _ = self.0.wait();
    }
}

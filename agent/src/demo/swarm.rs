//! The agents of the demonstration: child processes of this program, each with a key, a configuration, a store and a
//! log of its own, linked over loopback. They end with the value that holds them.

use crate::config::FileConfig;
use crate::recording::Recording;
use crate::trust::{PublicKey, SecretKey};
use anyhow::{Context, Result, bail};
use merganser_protocol::ids::Name;
use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::Read;
use std::net::{Ipv4Addr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

/// Bytes of a log in which warnings are looked for.
const START_BYTES: u64 = 4 << 20;
/// Lines of a log shown when something failed.
const TAIL_LINES: usize = 15;
/// Log files larger than this are shown from their end only.
const TAIL_BYTES: usize = 64 * 1024;

/// One running agent.
#[derive(Debug)]
pub(super) struct Agent {
    pub name: Name,
    pub log: PathBuf,
    child: Child,
}

/// All running agents, in the order of their recordings.
#[derive(Debug)]
pub(super) struct Swarm {
    pub name: Name,
    pub agents: Vec<Agent>,
    pub endpoints: Vec<String>,
}

impl Swarm {
    /// Starts an agent per recording, with its files in `folder/{robot}`.
    pub fn start(recordings: &[Recording], folder: &Path, speed: f64, seed: u64) -> Result<Self> {
        let program = std::env::current_exe().context("cannot find this program's own file")?;
        let name = Name::new("demo")?;
        let endpoints = free_endpoints(recordings.len())?;
        let mut roster = BTreeMap::new();
        for recording in recordings {
            let robot = recording.manifest().robot.clone();
            let key = home(folder, &robot).join("key");
            fs::create_dir_all(home(folder, &robot)).with_context(|| home(folder, &robot).display().to_string())?;
            let secret = SecretKey::generate()?;
            secret.save(&key)?;
            roster.insert(robot, secret.public());
        }
        let mut agents = Vec::new();
        for (index, recording) in recordings.iter().enumerate() {
            let config = configure(&name, recording, &roster, &endpoints, index);
            let home = home(folder, &config.robot);
            let path = home.join("config.toml");
            config.save(&path).with_context(|| path.display().to_string())?;
            let log = home.join("log.txt");
            let out = File::create(&log).with_context(|| log.display().to_string())?;
            let child = Command::new(&program)
                .arg("run")
                .args([Path::new("--config"), &path, Path::new("--recording"), recording.folder()])
                .args(["--speed", &speed.to_string(), "--seed", &(seed.wrapping_add(index as u64)).to_string()])
                .arg("--leash")
                .stdin(Stdio::piped()) // closed when we end, however we end
                .stdout(out.try_clone().with_context(|| log.display().to_string())?)
                .stderr(out)
                .spawn()
                .with_context(|| format!("cannot start {}", program.display()))?;
            agents.push(Agent { name: config.robot, log, child });
        }
        Ok(Self { name, agents, endpoints })
    }

    /// Fails if an agent has ended, with the end of its log.
    pub fn all_run(&mut self) -> Result<()> {
        for agent in &mut self.agents {
            if let Some(status) = agent.child.try_wait()? {
                bail!("{} ended too early ({status}); the end of its log:\n{}", agent.name, agent.log_tail());
            }
        }
        Ok(())
    }
}

impl Agent {
    /// Resident memory now and at its largest, bytes; `None` where the system does not tell.
    pub fn memory(&self) -> Option<(u64, u64)> {
        let status = fs::read_to_string(format!("/proc/{}/status", self.child.id())).ok()?;
        let value = |key: &str| -> Option<u64> {
            let line = status.lines().find_map(|line| line.strip_prefix(key))?;
            Some(line.trim().strip_suffix(" kB")?.trim().parse::<u64>().ok()? * 1024)
        };
        Some((value("VmRSS:")?, value("VmHWM:")?))
    }

    /// The beginning of its log, where what is wrong with its input is told.
    pub fn log_start(&self) -> String {
        let mut bytes = Vec::new();
        let read = File::open(&self.log).and_then(|file| file.take(START_BYTES).read_to_end(&mut bytes));
        read.map_or_else(|_| String::new(), |_| String::from_utf8_lossy(&bytes).into_owned())
    }

    /// The last lines of its log.
    pub fn log_tail(&self) -> String {
        let bytes = fs::read(&self.log).unwrap_or_default();
        let text = String::from_utf8_lossy(&bytes[bytes.len().saturating_sub(TAIL_BYTES)..]);
        let lines: Vec<&str> = text.lines().collect();
        lines[lines.len().saturating_sub(TAIL_LINES)..].join("\n")
    }
}

impl Drop for Agent {
    /// The store survives a kill at any point, so there is nothing to wait for.
    fn drop(&mut self) {
        let _ = self.child.kill(); // it may have ended by itself
        let _ = self.child.wait();
    }
}

fn home(folder: &Path, robot: &Name) -> PathBuf {
    folder.join(robot.as_str())
}

/// The configuration of one robot: linked to all others, found by nobody else.
fn configure(
    swarm: &Name,
    recording: &Recording,
    roster: &BTreeMap<Name, PublicKey>,
    endpoints: &[String],
    index: usize,
) -> FileConfig {
    let robot = recording.manifest().robot.clone();
    let mut config = FileConfig::new(swarm.clone(), robot, "key".into(), roster.clone());
    config.core = recording.manifest().config.clone();
    config.zenoh.listen = vec![endpoints[index].clone()];
    config.zenoh.connect = endpoints.iter().filter(|endpoint| **endpoint != endpoints[index]).cloned().collect();
    config.zenoh.multicast = false;
    config
}

/// Loopback endpoints whose ports are free now. All are held until all are found, so they differ.
fn free_endpoints(count: usize) -> Result<Vec<String>> {
    let listeners = (0..count).map(|_| TcpListener::bind((Ipv4Addr::LOCALHOST, 0))).collect::<Result<Vec<_>, _>>();
    let listeners = listeners.context("no free port on 127.0.0.1")?;
    let mut endpoints = Vec::new();
    for listener in &listeners {
        endpoints.push(format!("tcp/127.0.0.1:{}", listener.local_addr()?.port()));
    }
    Ok(endpoints)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_ports_differ() {
        let mut endpoints = free_endpoints(20).unwrap();
        endpoints.sort();
        endpoints.dedup();
        assert_eq!(endpoints.len(), 20);
    }

    #[test]
    fn an_agent_is_killed_with_its_value_and_its_memory_is_read() {
        let log = tempfile::NamedTempFile::new().unwrap();
        fs::write(log.path(), (0..40).map(|i| format!("line {i}\n")).collect::<String>()).unwrap();
        let child = Command::new("sleep").arg("60").spawn().unwrap();
        let id = child.id();
        let agent = Agent { name: Name::new("alpha").unwrap(), log: log.path().into(), child };
        if Path::new("/proc/self/status").exists() {
            let (now, most) = agent.memory().unwrap();
            assert!(now > 0 && now <= most);
        }
        assert!(agent.log_tail().starts_with("line 25") && agent.log_tail().ends_with("line 39"));
        drop(agent);
        assert!(!Path::new(&format!("/proc/{id}")).exists());
    }
}

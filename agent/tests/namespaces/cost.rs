//! What TLS costs: a link between two namespaces, first plain and then by TLS with certificates on both sides. Each end is
//! a process of its own (this test program, started anew), so that its processor time is its own; bytes are counted on
//! the bridge.

use super::air::Air;
use super::common::{name, secured, swarm};
use merganser::config::{FileConfig, Mode, Security};
use merganser::keys;
use merganser::link::session::{self, Guard, Role};
use serde_json::{Value, json};
use std::fs;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::time::{Duration, Instant};
use zenoh::qos::CongestionControl;

/// The configuration of an end; without it there is nothing to do.
const CONFIG: &str = "MERGANSER_TEST_END_OF_A_LINK";
const PORT: u16 = 7447;
/// Times that both are measured, in turn.
const ROUNDS: usize = 3;
/// Links opened one after the other.
const OPENED: usize = 40;
/// Messages of a beacon's size, and the time between two.
const SMALL: (usize, usize, Duration) = (3_000, 200, Duration::from_millis(2));
/// Pieces of a blob, as fast as they go.
const LARGE: (usize, usize, Duration) = (20_000, 16_384, Duration::ZERO);

pub fn measure(air: &Air) {
    println!(
        "| links | open, median and 90 % | 200 B: bytes each | CPU each, both ends | 16 KiB: bytes each | CPU each | MB/s |"
    );
    for guarded in [false, true].into_iter().cycle().take(2 * ROUNDS) {
        let folder = tempfile::tempdir().unwrap();
        let mut configs = swarm(folder.path(), &["alpha", "beta"]);
        if guarded {
            secured(folder.path(), &mut configs, &[], &[]);
        } else {
            configs.iter_mut().for_each(|config| config.zenoh.security = Some(Security::None));
        }
        let transport = if guarded { "tls" } else { "tcp" };
        let endpoint = |host: &str| vec![format!("{transport}/{host}:{PORT}")];
        configs[1].zenoh.listen = endpoint("0.0.0.0");
        configs[0].zenoh.mode = Mode::Client;
        configs[0].zenoh.listen = Vec::new();
        configs[0].zenoh.connect = endpoint(&air.address("beta").to_string());
        configs[1].zenoh.connect = Vec::new();
        let mut far = End::start(air, folder.path(), &configs[1]);
        far.hear(); // it listens
        let mut near = End::start(air, folder.path(), &configs[0]);
        let opened: Vec<f64> = serde_json::from_value(near.hear()["open_ms"].clone()).unwrap();
        let mut phase = |count: usize| {
            let (bytes, before) = (air.carried_bytes(), far.ask());
            let near = near.ask();
            let mut after = far.ask();
            while after["count"].as_u64().unwrap() < before["count"].as_u64().unwrap() + count as u64 {
                std::thread::sleep(Duration::from_millis(20));
                after = far.ask();
            }
            let bytes = (air.carried_bytes() - bytes) as f64 / count as f64;
            let cpu = |value: &Value| value["cpu_us"].as_f64().unwrap();
            let cpu = (cpu(&near) + cpu(&after) - cpu(&before)) / count as f64;
            (bytes, cpu, near["secs"].as_f64().unwrap())
        };
        let (small_bytes, small_cpu, _) = phase(SMALL.0);
        let (large_bytes, large_cpu, secs) = phase(LARGE.0);
        println!(
            "| {transport} | {:.1} ms, {:.1} ms | {small_bytes:.0} B | {small_cpu:.0} µs | {large_bytes:.0} B | {large_cpu:.0} µs | {:.0} |",
            opened[OPENED / 2],
            opened[OPENED * 9 / 10],
            (LARGE.0 * LARGE.1) as f64 / secs / 1e6
        );
    }
}

/// One end, as a process in its namespace.
struct End(Child, ChildStdin, BufReader<ChildStdout>);

impl End {
    fn start(air: &Air, folder: &Path, config: &FileConfig) -> Self {
        let path = folder.join(format!("{}.toml", config.robot));
        config.save(&path).unwrap();
        let this = std::env::current_exe().unwrap();
        let mut command = air.command(config.robot.as_str(), this.to_str().unwrap());
        command.args(["--exact", "end_of_a_link", "--ignored", "--nocapture"]).env(CONFIG, &path);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let (say, hear) = (child.stdin.take().unwrap(), BufReader::new(child.stdout.take().unwrap()));
        Self(child, say, hear)
    }

    fn ask(&mut self) -> Value {
        writeln!(self.1).unwrap();
        self.hear()
    }

    fn hear(&mut self) -> Value {
        let mut line = String::new();
        while !line.starts_with('{') {
            line.clear();
            assert!(self.2.read_line(&mut line).unwrap() > 0, "an end ended");
        }
        serde_json::from_str(&line).unwrap()
    }
}

impl Drop for End {
    fn drop(&mut self) {
        let _ = self.0.kill(); // it may have ended by itself
        let _ = self.0.wait();
    }
}

pub fn main() {
    let Ok(path) = std::env::var(CONFIG) else { return };
    let config = FileConfig::load(Path::new(&path)).unwrap();
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(1).enable_all().build().unwrap();
    runtime
        .block_on(async { if config.zenoh.mode == Mode::Client { near(&config).await } else { far(&config).await } });
}

/// Waits for the parent's word; false when it is gone.
async fn told() -> bool {
    tokio::task::spawn_blocking(|| std::io::stdin().read_line(&mut String::new()).is_ok_and(|bytes| bytes > 0))
        .await
        .unwrap()
}

async fn far(config: &FileConfig) {
    let guard = Guard::of(config).unwrap();
    let session = session::open_guarded(&config.zenoh, Role::Robot, guard.as_ref()).await.unwrap();
    let count = Arc::new(AtomicU64::new(0));
    let counted = count.clone();
    let subscriber = session.declare_subscriber(keys::of_all(&config.swarm, "facts"));
    subscriber
        .callback(move |_| {
            counted.fetch_add(1, Relaxed);
        })
        .background()
        .await
        .unwrap();
    println!("{{}}");
    while told().await {
        println!("{}", json!({"count": count.load(Relaxed), "cpu_us": cpu_us()}));
    }
}

async fn near(config: &FileConfig) {
    let guard = Guard::of(config).unwrap();
    let mut opened = Vec::new();
    for _ in 0..OPENED {
        let began = Instant::now();
        let session = session::open_guarded(&config.zenoh, Role::Robot, guard.as_ref()).await.unwrap();
        opened.push(began.elapsed().as_secs_f64() * 1e3);
        session::close(&session, Duration::from_secs(5)).await;
    }
    opened.sort_by(f64::total_cmp);
    let session = session::open_guarded(&config.zenoh, Role::Robot, guard.as_ref()).await.unwrap();
    let publisher = session.declare_publisher(keys::of(&config.swarm, &name("alpha"), "facts"));
    let publisher = publisher.congestion_control(CongestionControl::Block).await.unwrap();
    while !publisher.matching_status().await.unwrap().matching() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    println!("{}", json!({"open_ms": opened}));
    for (count, size, pause) in [SMALL, LARGE] {
        if !told().await {
            return;
        }
        let (cpu, began) = (cpu_us(), Instant::now());
        for _ in 0..count {
            publisher.put(vec![7; size]).await.unwrap();
            if !pause.is_zero() {
                tokio::time::sleep(pause).await;
            }
        }
        tokio::time::sleep(Duration::from_millis(1)).await;
        println!("{}", json!({"cpu_us": cpu_us() - cpu, "secs": began.elapsed().as_secs_f64()}));
    }
    told().await;
}

/// Processor time of all threads that live, microseconds.
fn cpu_us() -> f64 {
    let tasks = fs::read_dir("/proc/self/task").unwrap();
    let nanoseconds = tasks.filter_map(|task| {
        let stat = fs::read_to_string(task.ok()?.path().join("schedstat")).ok()?;
        stat.split_whitespace().next()?.parse::<f64>().ok()
    });
    nanoseconds.sum::<f64>() / 1e3
}

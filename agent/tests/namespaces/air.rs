//! A piece of air: network namespaces for robots on a bridge in one more, where all faults are. Everything lives inside
//! these namespaces and goes with them, also when a test panics; the network of the computer itself is not touched.

use std::collections::BTreeMap;
use std::net::Ipv4Addr;
use std::os::unix::fs::MetadataExt as _;
use std::process::{Command, Output, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// The table that all faults are in.
const TABLE: &str = "bridge faults";

/// Namespaces made by this process so far: their names must differ.
static MADE: AtomicU32 = AtomicU32::new(0);

/// See the module.
#[derive(Debug)]
pub struct Air {
    bridge: Namespace,
    robots: BTreeMap<String, Place>,
}

#[derive(Debug)]
struct Place {
    namespace: Namespace,
    address: Mutex<Ipv4Addr>,
}

impl Air {
    /// Air for these robots; `None`, and a line that says why, where it cannot be had.
    pub fn open(robots: &[&str]) -> Option<Self> {
        match Self::try_open(robots) {
            Ok(air) => Some(air),
            Err(why) => {
                eprintln!("SKIPPED: no network namespaces here: {why}");
                None
            }
        }
    }

    fn try_open(robots: &[&str]) -> Result<Self, String> {
        if std::fs::metadata("/proc/self").map_err(|error| error.to_string())?.uid() != 0 {
            return Err("only root can make them".into());
        }
        for program in ["ip", "tc", "nft"] {
            run(Command::new(program).arg("-V"))?;
        }
        let number = MADE.fetch_add(1, Relaxed);
        let unique = |name: &str| format!("merganser-{}-{number}-{name}", std::process::id());
        let bridge = Namespace::new(unique("air"))?;
        bridge.ip("link add air type bridge")?;
        bridge.ip("link set air up")?;
        for command in [
            format!("add table {TABLE}"),
            format!("add counter {TABLE} dropped"),
            format!("add counter {TABLE} carried"),
            format!("add chain {TABLE} drops {{ type filter hook forward priority 0; }}"),
            format!("add chain {TABLE} rest {{ type filter hook forward priority 1; }}"),
            format!("add rule {TABLE} rest counter name carried"),
        ] {
            bridge.run("nft", &command)?;
        }
        bridge.run("nft", &loss(0)).and(bridge.run("nft", &no_faults()))?; // does the kernel have all that is needed?
        bridge
            .run("tc", &format!("qdisc add dev air {}", pace("1mbit")))
            .and(bridge.run("tc", "qdisc del dev air root"))?;
        let mut places = BTreeMap::new();
        for (name, number) in robots.iter().zip(1..) {
            let namespace = Namespace::new(unique(name))?;
            let address = Ipv4Addr::new(10, 77, 0, number);
            bridge.ip(&format!("link add {name} type veth peer name radio netns {}", namespace.name))?;
            bridge.ip(&format!("link set {name} master air up"))?;
            namespace.ip("link set lo up")?;
            namespace.ip("link set radio up")?;
            namespace.ip(&format!("address add {address}/24 dev radio"))?;
            places.insert((*name).to_owned(), Place { namespace, address: Mutex::new(address) });
        }
        Ok(Self { bridge, robots: places })
    }

    /// A command that will run where the robot is.
    pub fn command(&self, robot: &str, program: &str) -> Command {
        self.robots[robot].namespace.command(program)
    }

    pub fn address(&self, robot: &str) -> Ipv4Addr {
        *self.robots[robot].address.lock().unwrap()
    }

    /// Gives the robot another address instead of the one it has.
    pub fn readdress(&self, robot: &str) -> Ipv4Addr {
        let place = &self.robots[robot];
        let old = self.address(robot);
        let [a, b, c, d] = old.octets();
        let new = Ipv4Addr::new(a, b, c, d + 100);
        place.namespace.ip(&format!("address del {old}/24 dev radio")).unwrap();
        place.namespace.ip(&format!("address add {new}/24 dev radio")).unwrap();
        *place.address.lock().unwrap() = new;
        new
    }

    /// From now on, what the one sends does not reach the other.
    pub fn block(&self, from: &str, to: &str) {
        self.nft(&format!("add rule {TABLE} drops iifname {from} oifname {to} counter name dropped drop"));
    }

    /// From now on, so much of everything is lost.
    pub fn lose(&self, percent: u32) {
        self.nft(&loss(percent));
    }

    /// Ends all blocks and losses.
    pub fn heal(&self) {
        self.nft(&no_faults());
    }

    /// Frames that were dropped so far.
    pub fn dropped(&self) -> u64 {
        self.count("dropped")
    }

    /// Frames that were carried from robot to robot so far.
    pub fn carried(&self) -> u64 {
        self.count("carried")
    }

    /// Takes the robot's radio away.
    pub fn unplug(&self, robot: &str) {
        self.bridge.ip(&format!("link set {robot} down")).unwrap();
    }

    /// Gives it back.
    pub fn plug(&self, robot: &str) {
        self.bridge.ip(&format!("link set {robot} up")).unwrap();
    }

    /// `Some` if the robot's radio has a carrier.
    pub fn carrier(&self, robot: &str) -> Option<()> {
        let shown = self.robots[robot].namespace.ip("-json link show radio").unwrap();
        let flags = &serde_json::from_str::<serde_json::Value>(&shown).unwrap()[0]["flags"];
        flags.as_array().unwrap().iter().any(|flag| flag == "LOWER_UP").then_some(())
    }

    /// From now on, the robot sends no faster.
    pub fn slow(&self, robot: &str, rate: &str) {
        let namespace = &self.robots[robot].namespace;
        namespace.run("tc", &format!("qdisc add dev radio {}", pace(rate))).unwrap();
    }

    /// How often the robot wanted to send faster.
    pub fn slowed(&self, robot: &str) -> u64 {
        let shown = self.robots[robot].namespace.run("tc", "-s -j qdisc show dev radio").unwrap();
        serde_json::from_str::<serde_json::Value>(&shown).unwrap()[0]["overlimits"].as_u64().unwrap()
    }

    /// Bytes that were carried from robot to robot so far, with all headers but those of Ethernet's.
    pub fn carried_bytes(&self) -> u64 {
        self.counted("carried", "bytes")
    }

    fn count(&self, counter: &str) -> u64 {
        self.counted(counter, "packets")
    }

    fn counted(&self, counter: &str, what: &str) -> u64 {
        let shown = self.bridge.run("nft", &format!("-j list counter {TABLE} {counter}")).unwrap();
        let shown: serde_json::Value = serde_json::from_str(&shown).unwrap();
        let objects = shown["nftables"].as_array().unwrap();
        objects.iter().find_map(|object| object["counter"][what].as_u64()).unwrap()
    }

    fn nft(&self, command: &str) {
        self.bridge.run("nft", command).unwrap();
    }
}

fn loss(percent: u32) -> String {
    format!("add rule {TABLE} drops numgen random mod 100 < {percent} counter name dropped drop")
}

fn no_faults() -> String {
    format!("flush chain {TABLE} drops")
}

fn pace(rate: &str) -> String {
    format!("root tbf rate {rate} burst 4kb latency 400ms")
}

/// One network namespace, removed with its value.
#[derive(Debug)]
struct Namespace {
    name: String,
}

impl Namespace {
    fn new(name: String) -> Result<Self, String> {
        run(Command::new("ip").args(["netns", "add", &name]))?;
        Ok(Self { name })
    }

    fn command(&self, program: &str) -> Command {
        let mut command = Command::new("ip");
        command.args(["netns", "exec", &self.name, program]);
        command
    }

    fn ip(&self, arguments: &str) -> Result<String, String> {
        run(Command::new("ip").args(["-n", &self.name]).args(arguments.split(' ')))
    }

    fn run(&self, program: &str, arguments: &str) -> Result<String, String> {
        run(self.command(program).args(arguments.split(' ')))
    }
}

impl Drop for Namespace {
    fn drop(&mut self) {
        // A failure has no one left to tell; what is inside goes when its last process does.
        let _ = run(Command::new("ip").args(["netns", "del", &self.name]));
    }
}

fn run(command: &mut Command) -> Result<String, String> {
    let told = |error: String| format!("{command:?}: {error}");
    let done = Command::new(command.get_program()).args(command.get_args()).stdin(Stdio::null()).output();
    let Output { status, stdout, stderr } = done.map_err(|error| told(error.to_string()))?;
    if status.success() {
        Ok(String::from_utf8_lossy(&stdout).into_owned())
    } else {
        Err(told(format!("{status}: {}", String::from_utf8_lossy(&stderr).trim())))
    }
}

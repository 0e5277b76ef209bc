//! A scenario: robots, world, network, faults and what the run must show, from a TOML file. Everything has a default;
//! unknown keys and impossible values are refused with the key's name and what to write instead.

use crate::adversary::Adversary;
use crate::faults::Fault;
use crate::field::Layout;
use crate::network::NetworkOptions;
use crate::world::WorldOptions;
use crate::world::drive::DriveOptions;
use crate::world::landmarks::LandmarkOptions;
use crate::world::places::PlaceOptions;
use crate::world::sensor::SensorOptions;
use merganser_protocol::config::{Config, ConfigError, Sensor};
use merganser_protocol::wire::fact::ScaleKind;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use thiserror::Error;

/// Robots in one scenario at most.
pub const ROBOTS_MAX: usize = 1000;
/// Longest run, s.
pub const DURATION_MAX_SECS: f64 = 24.0 * 3600.0;
/// Names of the first robots; later ones are `robot-11` and so on.
const NAMES: [&str; 10] = ["alpha", "beta", "gamma", "delta", "epsilon", "zeta", "eta", "theta", "iota", "kappa"];

/// A whole scenario.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// What it is called in reports.
    pub name: String,
    /// What it shows, for people.
    #[serde(default)]
    pub about: String,
    /// How many robots.
    pub robots: usize,
    /// How long robots drive and faults rage, s. After it the network heals.
    pub duration_secs: f64,
    /// Within this time of the healing all must hold the same facts and be done, s.
    #[serde(default = "default_settle_secs")]
    pub settle_secs: f64,
    /// The world.
    #[serde(default)]
    pub world: WorldOptions,
    /// How robots drive.
    #[serde(default)]
    pub drive: DriveOptions,
    /// What they see with.
    #[serde(default)]
    pub sensor: SensorOptions,
    /// A camera whose SLAM keeps landmarks, in the sensor's place: none by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub landmarks: Option<LandmarkOptions>,
    /// What takes the place of scans and their alignment, for runs that are about replication: none by default.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub summary: Option<SummaryOptions>,
    /// What lies between them.
    #[serde(default)]
    pub network: NetworkOptions,
    /// Who is in reach of whom: all, unless told otherwise. Once faults are over, nobody is out of reach of all others.
    #[serde(default)]
    pub radio: Layout,
    /// What a place-recognition network of theirs says of each keyframe; without it, none runs.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub places: Option<PlaceOptions>,
    /// Their computers.
    #[serde(default)]
    pub machine: MachineOptions,
    /// What must hold at the end.
    #[serde(default)]
    pub expect: Expect,
    /// Overrides of the core's configuration.
    #[serde(default)]
    pub config: Config,
    /// What goes wrong, and when.
    #[serde(default)]
    pub faults: Vec<Fault>,
}

/// A robot's computer, in virtual time.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MachineOptions {
    /// From `Persist` to `Persisted`, ms.
    pub persist_ms: f64,
    /// Jobs run at once.
    pub workers: usize,
    /// Job times are multiplied by this: 1 is one core of a laptop.
    pub slowness: f64,
    /// Robots start within this time of each other, s.
    pub start_within_secs: f64,
    /// Robots' clocks (the stamps of their keyframes) differ by up to this, s.
    pub clock_offset_secs: f64,
    /// A new store's epoch is the second that the wall clock shows, as in a real agent; else it counts starts.
    pub wall_epochs: bool,
}

/// Summary level: no rays are cast and no clouds aligned. A scan is a handful of points, and an alignment is the truth
/// with noise where two submaps lie within reach of each other.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SummaryOptions {
    /// Points in a scan.
    pub points: usize,
    /// Anchors farther apart than this do not align, m.
    pub reach_m: f64,
    /// Standard deviation of an alignment, m and rad.
    pub sigma: [f64; 2],
    /// Share of an alignment's variance that all alignments of the one submap have in common, and of the other: 0 to
    /// 0.5.
    pub common: f64,
    /// Share of the pairs that align which are refused at first sight, and found with further keypoints.
    pub refused_at_first: f64,
    /// Whether the joint estimate is solved; else robots believe nothing about one another.
    pub solve: bool,
    /// Robots that state false alignments, each its own falsehood.
    pub liars: Vec<String>,
    /// Robots that lie of themselves, and how.
    pub adversaries: BTreeMap<String, Adversary>,
}

impl Default for SummaryOptions {
    fn default() -> Self {
        Self {
            points: 24,
            reach_m: 6.0,
            sigma: [0.02, 0.005],
            common: 0.0,
            refused_at_first: 0.0,
            solve: true,
            liars: Vec::new(),
            adversaries: BTreeMap::new(),
        }
    }
}

impl Default for MachineOptions {
    fn default() -> Self {
        Self {
            persist_ms: 20.0,
            workers: 2,
            slowness: 1.0,
            start_within_secs: 1.0,
            clock_offset_secs: 3600.0,
            wall_epochs: false,
        }
    }
}

/// What a run must show, beyond the invariants.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Expect {
    /// At the end, the present frames of all living robots are merged.
    pub merged: bool,
    /// No merged frame may be off by more than this, m...
    pub error_max_m: f64,
    /// ...and this, degrees, whatever its covariance says.
    pub error_max_deg: f64,
}

impl Default for Expect {
    fn default() -> Self {
        Self { merged: false, error_max_m: 1.5, error_max_deg: 12.0 }
    }
}

/// Why a scenario cannot be run.
#[derive(Debug, Error)]
pub enum ScenarioError {
    /// Not TOML, or not a scenario.
    #[error("not a scenario: {0}")]
    Toml(#[from] toml::de::Error),
    /// A value that cannot work.
    #[error("{key} = {value}: {mend}")]
    Value {
        /// Dotted name of the key.
        key: String,
        /// What it is.
        value: String,
        /// What it should be.
        mend: &'static str,
    },
    /// A value of the core's configuration that cannot work.
    #[error("config.{0}")]
    Config(#[from] ConfigError),
}

impl Scenario {
    /// Reads and checks a scenario.
    ///
    /// # Errors
    /// [`ScenarioError`]: syntax, unknown keys (with their place), or the first value out of range.
    pub fn parse(text: &str) -> Result<Self, ScenarioError> {
        let scenario: Self = toml::from_str(text)?;
        scenario.validate()?;
        Ok(scenario)
    }

    /// The robots' names, in order.
    pub fn names(&self) -> Vec<String> {
        let name = |k: usize| NAMES.get(k).map_or_else(|| format!("robot-{:02}", k + 1), ToString::to_string);
        (0..self.robots).map(name).collect()
    }

    /// How this robot lies of itself, if it does.
    pub fn adversary(&self, robot: &str) -> Option<Adversary> {
        self.summary.as_ref()?.adversaries.get(robot).copied()
    }

    /// Robots that lie of themselves.
    pub fn adversaries(&self) -> BTreeSet<String> {
        self.summary.iter().flat_map(|summary| summary.adversaries.keys().cloned()).collect()
    }

    /// The core's configuration on this robot.
    pub fn config_of(&self, robot: &str) -> Config {
        let mut config = self.config.clone();
        if self.landmarks.as_ref().is_some_and(|camera| camera.metric.iter().any(|name| name == robot)) {
            config.submap.scale = ScaleKind::Metric;
        }
        config
    }

    fn validate(&self) -> Result<(), ScenarioError> {
        range("robots", self.robots as f64, 1.0, ROBOTS_MAX as f64, "use 1 to 1000 robots")?;
        range("duration_secs", self.duration_secs, 1.0, DURATION_MAX_SECS, "use 1 s to a day")?;
        range("settle_secs", self.settle_secs, 0.0, DURATION_MAX_SECS, "use 0 s to a day")?;
        self.validate_world()?;
        let m = &self.machine;
        range("machine.persist_ms", m.persist_ms, 0.0, 60_000.0, "use 0 to 60000 ms")?;
        range("machine.workers", m.workers as f64, 1.0, 64.0, "use 1 to 64")?;
        range("machine.slowness", m.slowness, 0.0, 1000.0, "use 0 to 1000")?;
        range("machine.start_within_secs", m.start_within_secs, 0.0, self.duration_secs, "use at most the duration")?;
        range("machine.clock_offset_secs", m.clock_offset_secs, 0.0, 1e9, "use 0 to 1e9 s")?;
        if let Some(summary) = &self.summary {
            range("summary.points", summary.points as f64, 12.0, 1000.0, "use 12 to 1000")?;
            range("summary.reach_m", summary.reach_m, 0.0, 1e6, "use 0 to 1e6 m")?;
            range("summary.sigma[0]", summary.sigma[0], 1e-6, 10.0, "use 1e-6 to 10 m")?;
            range("summary.sigma[1]", summary.sigma[1], 1e-6, 1.0, "use 1e-6 to 1 rad")?;
            range("summary.common", summary.common, 0.0, 0.5, "use 0 to 0.5")?;
            range("summary.refused_at_first", summary.refused_at_first, 0.0, 1.0, "use 0 to 1")?;
            summary.liars.iter().try_for_each(|liar| self.validate_name("summary.liars", liar))?;
            summary.adversaries.keys().try_for_each(|name| self.validate_name("summary.adversaries", name))?;
        }
        self.validate_landmarks()?;
        for (key, value, low, high, mend) in self.places.iter().flat_map(PlaceOptions::ranges) {
            range(key, value, low, high, mend)?;
        }
        range("expect.error_max_m", self.expect.error_max_m, 1e-6, 1e6, "use a positive length")?;
        range("expect.error_max_deg", self.expect.error_max_deg, 1e-6, 180.0, "use 0 to 180 degrees")?;
        for (key, value, low, high, mend) in self.network.ranges().into_iter().chain(self.radio.ranges()) {
            range(key, value, low, high, mend)?;
        }
        self.config.validate()?;
        self.faults.iter().enumerate().try_for_each(|(index, fault)| self.validate_fault(index, fault))
    }

    fn validate_world(&self) -> Result<(), ScenarioError> {
        let (w, d, s) = (&self.world, &self.drive, &self.sensor);
        range("world.loop_radius_m", w.loop_radius_m, 2.0, 1000.0, "use 2 to 1000 m")?;
        range("world.loop_spread_m", w.loop_spread_m, 0.0, 1000.0, "use 0 to 1000 m")?;
        range("world.margin_m", w.margin_m, 1.0, 100.0, "use 1 to 100 m")?;
        range("world.clearance_m", w.clearance_m, 0.2, 10.0, "use 0.2 to 10 m")?;
        for (key, value) in [
            ("world.boxes_per_100m2", w.boxes_per_100m2),
            ("world.pillars_per_100m2", w.pillars_per_100m2),
            ("world.walls_per_100m2", w.walls_per_100m2),
        ] {
            range(key, value, 0.0, 100.0, "use 0 to 100")?;
        }
        range("world.cell_m", w.cell_m, 2.0, 100.0, "use 2 to 100 m")?;
        for (key, set, needs, mend) in [
            ("world.aisles", w.aisles, w.aliased && !w.streets, "set world.aliased too, and no streets"),
            ("world.rooms", w.rooms, w.aisles, "set world.aisles too"),
        ] {
            if set && !needs {
                return Err(ScenarioError::Value { key: key.to_owned(), value: set.to_string(), mend });
            }
        }
        range("drive.speed_m_s", d.speed_m_s, 0.01, 100.0, "use 0.01 to 100 m/s")?;
        range("drive.keyframe_m", d.keyframe_m, 0.05, 100.0, "use 0.05 to 100 m")?;
        range("drive.tilt_deg", d.tilt_deg, 0.0, 30.0, "use 0 to 30 degrees")?;
        range("drive.drift_m_per_sqrt_m", d.drift_m_per_sqrt_m, 1e-6, 10.0, "use 1e-6 to 10")?;
        range("drive.drift_deg_per_sqrt_m", d.drift_deg_per_sqrt_m, 1e-6, 45.0, "use 1e-6 to 45 degrees")?;
        range("drive.drift_per_sqrt_turn", d.drift_per_sqrt_turn, 0.0, 1.0, "use 0 to 1")?;
        range("sensor.rows", s.rows as f64, 1.0, 256.0, "use 1 to 256 rows")?;
        range("sensor.columns", s.columns as f64, 1.0, 4096.0, "use 1 to 4096 columns")?;
        range("sensor.elevation_deg[0]", s.elevation_deg[0], -89.0, s.elevation_deg[1], "use low, then high")?;
        range("sensor.elevation_deg[1]", s.elevation_deg[1], -89.0, 89.0, "use -89 to 89 degrees")?;
        range("sensor.range_m[0]", s.range_m[0], 0.0, s.range_m[1], "use shortest, then longest")?;
        range("sensor.range_m[1]", s.range_m[1], 0.1, 60.0, "use 0.1 to 60 m")?;
        range("sensor.range_sigma_m", s.range_sigma_m, 0.0, 1.0, "use 0 to 1 m")?;
        range("sensor.dropout", s.dropout, 0.0, 1.0, "use 0 to 1")?;
        let gravity = s.gravity_sigma_deg.map(|sigma| range(GRAVITY, sigma, 0.06, 28.0, "use 0.06 to 28 degrees"));
        gravity.unwrap_or(Ok(()))
    }

    fn validate_landmarks(&self) -> Result<(), ScenarioError> {
        let sensor = self.config.submap.sensor;
        if sensor.sees_landmarks() != self.landmarks.is_some()
            || sensor == Sensor::Landmarks2d
            || (self.landmarks.is_some() && self.summary.is_some())
        {
            let (key, value) = ("config.submap.sensor".to_owned(), format!("{sensor:?}"));
            let mend = "[landmarks] and sensor = \"landmarks\" go together, without [summary]";
            return Err(ScenarioError::Value { key, value, mend });
        }
        let Some(camera) = &self.landmarks else { return Ok(()) };
        for (key, value, low, high, mend) in camera.ranges() {
            range(key, value, low, high, mend)?;
        }
        camera.metric.iter().try_for_each(|robot| self.validate_name("landmarks.metric", robot))
    }

    fn validate_fault(&self, index: usize, fault: &Fault) -> Result<(), ScenarioError> {
        let key = |field: &str| format!("faults[{index}].{field}");
        range(&key("at"), fault.begins(), 0.0, self.duration_secs, "use a time within duration_secs")?;
        if let Some(ends) = fault.ends() {
            let lasts = ends - fault.begins();
            range(&key("lasts"), lasts, 0.0, self.duration_secs - fault.begins(), "end it within duration_secs")?;
        }
        fault.robots().into_iter().try_for_each(|robot| self.validate_name(&key("robot"), robot))
    }

    fn validate_name(&self, key: &str, robot: &str) -> Result<(), ScenarioError> {
        if self.names().iter().any(|name| name == robot) {
            return Ok(());
        }
        Err(ScenarioError::Value {
            key: key.to_owned(),
            value: format!("{robot:?}"),
            mend: "name one of the scenario's robots: alpha, beta, gamma…",
        })
    }
}

/// What agents take is between 0.001 and 0.5 rad.
const GRAVITY: &str = "sensor.gravity_sigma_deg";

fn range(key: &str, value: f64, low: f64, high: f64, mend: &'static str) -> Result<(), ScenarioError> {
    if (low..=high).contains(&value) {
        return Ok(());
    }
    Err(ScenarioError::Value { key: key.to_owned(), value: value.to_string(), mend })
}

fn default_settle_secs() -> f64 {
    30.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const MINIMAL: &str = "name = \"x\"\nrobots = 3\nduration_secs = 10\n";

    fn refusal(extra: &str) -> String {
        Scenario::parse(&format!("{MINIMAL}{extra}")).unwrap_err().to_string()
    }

    #[test]
    fn everything_but_the_essentials_has_a_default() {
        let scenario = Scenario::parse(MINIMAL).unwrap();
        assert_eq!(scenario.names(), ["alpha", "beta", "gamma"]);
        assert_eq!(scenario.config, Config::default());
    }

    #[test]
    fn refusals_say_where_and_how_to_mend() {
        for (extra, key, mend) in [
            ("[network]\nlos = 0.1", "los", "expected one of"),
            ("[network]\nloss = 1.5", "network.loss = 1.5", "0 to 1"),
            ("[network]\nloss = nan", "network.loss = NaN", "0 to 1"),
            ("[world]\nloop_radius_m = 0.5", "world.loop_radius_m = 0.5", "2 to 1000"),
            (
                "[radio]\nlayout = \"waypoints\"\nside_m = 9.0\nrange_m = 0.0\nspeed_m_s = 1.0",
                "radio.range_m = 0",
                "0.1 to",
            ),
            ("[radio]\nlayout = \"star\"", "star", "expected one of"),
            ("[sensor]\nrange_m = [5.0, 1.0]", "sensor.range_m[0] = 5", "shortest"),
            ("[sensor]\ngravity_sigma_deg = 0.05", "sensor.gravity_sigma_deg = 0.05", "0.06 to 28"),
            ("[sensor]\ngravity_sigma_deg = 28.1", "sensor.gravity_sigma_deg = 28.1", "0.06 to 28"),
            ("[config.submap]\nvoxel_m = 0.0", "config.submap.voxel_m = 0", "0.001 to 10"),
            ("[world]\naisles = true", "world.aisles = true", "aliased too"),
            ("[world]\naliased = true\nstreets = true\naisles = true", "world.aisles = true", "no streets"),
            ("[world]\naliased = true\nrooms = true", "world.rooms = true", "aisles too"),
            ("[config]\nvoxel = 1", "voxel", "unknown field"),
            ("[landmarks]", "config.submap.sensor = Points3d", "go together"),
            ("[config.submap]\nsensor = \"landmarks\"", "config.submap.sensor = Landmarks", "go together"),
            ("[landmarks]\n[config.submap]\nsensor = \"landmarks_2d\"", "= Landmarks2d", "go together"),
            ("[landmarks]\nseen = 1.1\n[config.submap]\nsensor = \"landmarks\"", "landmarks.seen = 1.1", "0 to 1"),
            ("[places]\nnumbers = 1", "places.numbers = 1", "2 to 16384"),
            ("[landmarks]\nunit_m = [2.0, 1.0]\n[config.submap]\nsensor = \"landmarks\"", "unit_m[0] = 2", "then most"),
            (
                "[landmarks]\nmetric = [\"delta\"]\n[config.submap]\nsensor = \"landmarks\"",
                "metric = \"delta\"",
                "alpha",
            ),
            ("[[faults]]\nkind = \"kill\"\nat = 1\nlasts = 2\nrobot = \"delta\"", "faults[0].robot", "alpha, beta"),
            ("[[faults]]\nkind = \"kill\"\nat = 9\nlasts = 2\nrobot = \"beta\"", "faults[0].lasts = 2", "within"),
            ("[[faults]]\nkind = \"kill\"\nat = 11\nlasts = 0\nrobot = \"beta\"", "faults[0].at = 11", "within"),
            ("[[faults]]\nkind = \"explode\"\nat = 1", "explode", "expected one of"),
            ("[[faults]]\nkind = \"leave\"\nat = 1\nrobot = \"beta\"\nx = 1", "unknown field", "x"),
        ] {
            let text = refusal(extra);
            assert!(text.contains(key) && text.contains(mend), "{extra:?} gave {text:?}");
        }
        let text = Scenario::parse("name = \"x\"\nrobots = 0\nduration_secs = 10").unwrap_err().to_string();
        assert!(text.starts_with("robots = 0"), "{text}");
        assert!(Scenario::parse("name = \"x\"\nrobots = 3\n").unwrap_err().to_string().contains("duration_secs"));
    }

    #[test]
    fn limits_are_inclusive() {
        let parse = |robots: usize| Scenario::parse(&format!("name = \"x\"\nrobots = {robots}\nduration_secs = 10"));
        assert!(parse(ROBOTS_MAX).is_ok() && parse(ROBOTS_MAX + 1).is_err());
    }
}

//! Drawing a run from a seed. Each part has its own stream of dice, so that a change in one leaves the others as they
//! were.

use crate::adversary::Adversary;
use crate::dice::Dice;
use crate::faults::Fault;
use crate::field::Layout;
use crate::network::NetworkOptions;
use crate::scenario::{Expect, MachineOptions, Scenario, SummaryOptions};
use crate::world::WorldOptions;
use crate::world::drive::DriveOptions;
use merganser_protocol::config::Config;
use std::collections::BTreeMap;

/// The stated bound: within this time of the healing, all hold the same facts, virtual s...
const SETTLE_SECS: f64 = 60.0;
/// ...and in a crowd this much later for each row of robots that facts have to cross.
const ROW_SECS: f64 = 3.0;
/// More robots than this are a crowd: not all are in reach of all, and faults come in rounds, one for so many robots.
const CROWD: usize = 10;
const ROUNDS_MAX: usize = 10;
/// In a crowd robots write less each, the more of them there are, by this factor at most: everybody checks
/// everybody's signatures, and what many do at once is to be attacked, not how much they write.
const SPARSEST: f64 = 5.0;
/// Share of the crowds that drive about; the others stand on a grid.
const MOVING_SHARE: f64 = 0.5;
/// How many a robot that drives about has in reach, on average.
const IN_REACH: f64 = 12.0;
/// Share of the runs in which robots also align, merge and solve.
const SOLVE_SHARE: f64 = 0.15;
/// Share of the pairs that align which a first look refuses.
const REFUSED_AT_FIRST: f64 = 0.15;
/// Share of the runs in which robots may send little, and how little, B/s; in a crowd as much more as there are more of
/// them, for everybody's facts cross every link, and within the stated time they must be able to.
const SLOW_LINK_SHARE: f64 = 0.25;
const SLOW_LINK: [f64; 2] = [4_000.0, 40_000.0];
/// Shares of the runs in which the swarm is also split for so long, s; crowds not for the longest.
const LONG_SPLITS: [(f64, f64); 2] = [(0.03, 180.0), (0.005, 1800.0)];
const CROWD_SPLIT_SECS_MAX: f64 = 180.0;
/// Faults begin after this, s: robots boot first.
const CALM_SECS: f64 = 2.0;

/// Within this time of the healing all must hold the same facts, virtual s.
pub fn settle_secs(robots: usize) -> f64 {
    if robots <= CROWD { SETTLE_SECS } else { SETTLE_SECS + ROW_SECS * libm::sqrt(robots as f64) }
}

/// The run that a seed stands for; of so many robots, if that is given, else of 2 to 10.
pub fn draw(seed: u64, robots: Option<usize>) -> Scenario {
    let mut dice = Dice::new(seed, "vopr");
    let drawn = 2 + dice.bits() as usize % 9;
    let robots = robots.unwrap_or(drawn);
    let duration_secs = dice.range(25.0, 70.0);
    let solve = dice.chance(SOLVE_SHARE);
    let mut scenario = Scenario {
        landmarks: None,
        places: None,
        name: format!("vopr-{seed}"),
        about: "drawn from the seed".into(),
        robots,
        duration_secs,
        settle_secs: settle_secs(robots),
        world: WorldOptions {
            boxes_per_100m2: 0.0,
            pillars_per_100m2: 0.0,
            walls_per_100m2: 0.0,
            ..WorldOptions::default()
        },
        drive: DriveOptions { keyframe_m: sparsity(robots) * dice.range(1.0, 3.0), ..DriveOptions::default() },
        sensor: crate::world::sensor::SensorOptions::default(),
        summary: None,
        radio: radio(robots, &mut Dice::new(seed, "vopr radio")),
        network: network(&mut Dice::new(seed, "vopr network")),
        machine: machine(&mut Dice::new(seed, "vopr machines")),
        expect: Expect::default(),
        config: config(robots, &mut Dice::new(seed, "vopr config")),
        faults: Vec::new(),
    };
    scenario.machine.start_within_secs = scenario.machine.start_within_secs.min(0.3 * duration_secs);
    let mut liars = if solve { liars(&scenario, &mut dice) } else { Vec::new() };
    let adversaries = adversaries(&mut liars, &mut Dice::new(seed, "vopr adversaries"));
    let summary =
        SummaryOptions { solve, liars, adversaries, refused_at_first: REFUSED_AT_FIRST, ..SummaryOptions::default() };
    scenario.summary = Some(summary);
    let split_secs = split_secs(robots, &mut Dice::new(seed, "vopr long"));
    if let Some(split_secs) = split_secs {
        slow_down(&mut scenario, split_secs);
    }
    scenario.faults = faults(&scenario, seed, solve, split_secs);
    scenario
}

/// How long the swarm is split in a long run, if this is one.
fn split_secs(robots: usize, dice: &mut Dice) -> Option<f64> {
    let drawn = dice.range(0.0, 1.0);
    let mut below = 0.0;
    let long = LONG_SPLITS.iter().find(|(share, _)| {
        below += share;
        drawn < below
    });
    long.map(|(_, secs)| *secs).filter(|secs| robots <= CROWD || *secs <= CROWD_SPLIT_SECS_MAX)
}

/// Makes room for a long split. Robots write as much as in a short run: what all must hear of in the stated time is no
/// more.
fn slow_down(scenario: &mut Scenario, split_secs: f64) {
    let shorter = scenario.duration_secs;
    scenario.duration_secs += split_secs;
    scenario.drive.speed_m_s *= shorter / scenario.duration_secs;
}

/// By how much keyframes lie farther apart than among few robots.
fn sparsity(robots: usize) -> f64 {
    libm::sqrt(robots.max(CROWD) as f64 / CROWD as f64).min(SPARSEST)
}

fn radio(robots: usize, dice: &mut Dice) -> Layout {
    let (moving, range_m, speed_m_s) = (dice.chance(MOVING_SHARE), dice.range(10.0, 100.0), dice.range(0.5, 5.0));
    match (robots > CROWD, moving) {
        (false, _) => Layout::Mesh,
        (true, false) => Layout::Grid,
        (true, true) => {
            let side_m = range_m * libm::sqrt(core::f64::consts::PI * robots as f64 / IN_REACH);
            Layout::Waypoints { side_m, range_m, speed_m_s }
        }
    }
}

fn network(dice: &mut Dice) -> NetworkOptions {
    let mut sometimes = |p: f64, low: f64, high: f64| {
        let (hit, value) = (dice.chance(p), dice.range(low, high));
        if hit { value } else { 0.0 }
    };
    let latency_ms_min = sometimes(0.8, 0.5, 20.0);
    NetworkOptions {
        latency_ms_min,
        latency_ms_mean: latency_ms_min + 0.1 + sometimes(0.7, 1.0, 200.0),
        loss: [0.0, 0.1, 0.3, 0.6][sometimes(0.6, 0.0, 4.0) as usize],
        bursts_per_min: sometimes(0.3, 1.0, 30.0),
        burst_ms_mean: 100.0 + sometimes(0.5, 0.0, 3000.0),
        burst_loss: 1.0 - sometimes(0.5, 0.0, 0.5),
        duplicate: sometimes(0.3, 0.0, 0.5),
        reorder: sometimes(0.3, 0.0, 0.5),
        reorder_ms_max: 50.0 + sometimes(0.5, 0.0, 5000.0),
        mangle: sometimes(0.3, 0.0, 0.2),
        replay: sometimes(0.3, 0.0, 0.5),
        bytes_per_sec: sometimes(0.2, 3_000.0, 60_000.0),
        queue_ms_max: 100.0 + sometimes(0.5, 0.0, 3000.0),
        answer_ms_max: 500.0 + sometimes(0.7, 0.0, 4000.0),
        discover_ms: 50.0 + sometimes(0.7, 0.0, 2000.0),
        lease_ms: 500.0 + sometimes(0.7, 0.0, 8000.0),
    }
}

fn machine(dice: &mut Dice) -> MachineOptions {
    MachineOptions {
        persist_ms: libm::pow(10.0, dice.range(0.0, 2.7)),
        workers: 1 + dice.bits() as usize % 3,
        slowness: libm::pow(10.0, dice.range(-1.5, 0.7)),
        start_within_secs: [0.0, 1.0, 15.0][dice.bits() as usize % 3],
        clock_offset_secs: [0.0, 3600.0, 1e6][dice.bits() as usize % 3],
        wall_epochs: true,
    }
}

/// Share of the runs in which robots may have one to three epochs each.
const FEW_EPOCHS_SHARE: f64 = 0.3;

fn config(robots: usize, dice: &mut Dice) -> Config {
    let mut config = Config::default();
    config.submap.voxel_m = 0.4;
    config.submap.keyframes_max = 3 + dice.bits() as u32 % 3;
    config.submap.distance_m = 1e3;
    config.submap.rotation_deg = 180.0;
    config.submap.keypoints = 16;
    config.submap.keypoints_further = 16;
    // Few tries: runs are about facts, and must have an end.
    config.align.candidates_max = 24;
    config.estimate.interval_secs = dice.range(2.0, 8.0);
    config.gossip.have_secs = dice.range(0.4, 2.0);
    config.gossip.pose_secs = dice.range(2.0, 10.0);
    config.gossip.answer_secs = dice.range(0.5, 3.0);
    // Logs are short in a run; in half of them floors rise all the same.
    config.gossip.condense_entries = [0, 8 + dice.bits() as u32 % 40][dice.bits() as usize % 2];
    config.gossip.delta_bytes_max = 4096 + dice.bits() as usize % (60 * 1024);
    let (slow, bytes_per_sec) = (dice.chance(SLOW_LINK_SHARE), dice.range(SLOW_LINK[0], SLOW_LINK[1]));
    if slow {
        config.gossip.link_bytes_per_sec = bytes_per_sec * robots.max(CROWD) as f64 / CROWD as f64;
    }
    // Robots begin few epochs in a run; in some runs they give up old ones all the same.
    let (few, epochs) = (dice.chance(FEW_EPOCHS_SHARE), 1 + dice.bits() as usize % 3);
    if few {
        config.gossip.epochs_per_robot_max = epochs;
    }
    config
}

/// One to three of eight, at most a third.
fn liars(scenario: &Scenario, dice: &mut Dice) -> Vec<String> {
    let count = (dice.bits() as usize % 4).min(scenario.robots / 3);
    scenario.names().into_iter().rev().take(count).collect()
}

/// In half of the runs with liars, each of them lies of itself instead, in a way of its own; in a quarter, all collude.
fn adversaries(liars: &mut Vec<String>, dice: &mut Dice) -> BTreeMap<String, Adversary> {
    let way = |dice: &mut Dice| Adversary::ALL[dice.bits() as usize % Adversary::ALL.len()];
    match dice.bits() % 4 {
        0 => BTreeMap::new(),
        1 => core::mem::take(liars).into_iter().map(|name| (name, Adversary::Colluder)).collect(),
        _ => core::mem::take(liars).into_iter().map(|name| (name, way(dice))).collect(),
    }
}

/// Draws faults, one group after another, each with its share of the runs.
struct Faults<'a> {
    dice: Dice,
    names: Vec<String>,
    scenario: &'a Scenario,
    faults: Vec<Fault>,
}

fn faults(scenario: &Scenario, seed: u64, solve: bool, split_secs: Option<f64>) -> Vec<Fault> {
    let dice = Dice::new(seed, "vopr faults");
    let mut drawn = Faults { dice, names: scenario.names(), scenario, faults: Vec::new() };
    let rounds = (scenario.robots / CROWD).clamp(1, ROUNDS_MAX);
    for _ in 0..rounds {
        drawn.links();
        drawn.processes();
        drawn.disks();
        // Where frames lie is known by the name of robot and epoch: runs that are about the map leave out what can
        // give one name to two frames.
        if !solve {
            drawn.doubtful_disks();
            drawn.members();
        }
    }
    drawn.dice = Dice::new(seed, "vopr new frames");
    (0..rounds).for_each(|_| drawn.new_frames());
    drawn.dice = Dice::new(seed, "vopr reads");
    (0..rounds).for_each(|_| drawn.reads());
    if let Some(lasts) = split_secs {
        drawn.dice = Dice::new(seed, "vopr long split");
        drawn.long_split(lasts);
    }
    drawn.faults.sort_by(|a, b| a.begins().total_cmp(&b.begins()));
    drawn.faults
}

impl Faults<'_> {
    fn happens(&mut self, share: f64) -> bool {
        self.dice.chance(share)
    }

    fn robot(&mut self) -> String {
        let index = self.dice.bits() as usize % self.names.len();
        self.names[index].clone()
    }

    /// When it begins, and how long it lasts: `low` to `high` seconds, cut to the run.
    fn when(&mut self, low: f64, high: f64) -> (f64, f64) {
        let lasts = self.dice.range(low, high).min(self.scenario.duration_secs - CALM_SECS - 1.0);
        (self.dice.range(CALM_SECS, self.scenario.duration_secs - lasts), lasts)
    }

    fn times(&mut self, most: u64) -> u64 {
        1 + self.dice.bits() % most
    }

    fn links(&mut self) {
        if self.happens(0.4) {
            let (at, lasts) = self.when(5.0, 60.0);
            let groups = self.halves();
            self.faults.push(Fault::Partition { at, lasts, groups });
        }
        if self.happens(0.15) {
            self.ferry();
        }
        if self.happens(0.3) {
            let ((at, lasts), robot) = (self.when(5.0, 40.0), self.robot());
            self.faults.push(Fault::Isolate { at, lasts, robot });
        }
        if self.happens(0.3) {
            for _ in 0..self.times(3) {
                self.one_way(3.0, 40.0);
            }
        }
        if self.happens(0.2) {
            for _ in 0..10 + self.times(30) {
                self.one_way(0.2, 4.0); // swizzle: links clog and unclog at random
            }
        }
    }

    fn one_way(&mut self, low: f64, high: f64) {
        let (from, to) = (self.robot(), self.robot());
        let (at, lasts) = self.when(low, high);
        if from != to {
            self.faults.push(Fault::OneWay { at, lasts, from, to });
        }
    }

    fn halves(&mut self) -> Vec<Vec<String>> {
        let side: Vec<bool> = self.names.iter().map(|_| self.dice.chance(0.5)).collect();
        let half = |wanted: bool| {
            let members = self.names.iter().zip(&side).filter(|(_, side)| **side == wanted);
            members.map(|(name, _)| name.clone()).collect()
        };
        vec![half(true), half(false)]
    }

    /// Two groups that meet only in one robot, which is with the one and then with the other.
    fn ferry(&mut self) {
        let groups = self.halves();
        let ferry = self.robot();
        let (mut at, lasts) = self.when(20.0, 60.0);
        let end = at + lasts;
        let mut with = 0;
        while at + 1.0 < end {
            let stay = self.dice.range(2.0, 8.0).min(end - at);
            let group = |k: usize| {
                let members = groups[k].iter().filter(|name| **name != ferry).cloned();
                members.chain((k == with).then(|| ferry.clone())).collect()
            };
            self.faults.push(Fault::Partition { at, lasts: stay, groups: vec![group(0), group(1)] });
            (at, with) = (at + stay, 1 - with);
        }
    }

    fn processes(&mut self) {
        if self.happens(0.5) {
            for _ in 0..self.times(4) {
                let ((at, lasts), robot) = (self.when(0.1, 20.0), self.robot());
                self.faults.push(Fault::Kill { at, lasts, robot });
            }
        }
        if self.happens(0.25) {
            let ((at, lasts), robot) = (self.when(1.0, 60.0), self.robot());
            self.faults.push(Fault::Pause { at, lasts, robot });
        }
        if self.happens(0.2) {
            let ((at, _), robot) = (self.when(0.0, 0.0), self.robot());
            self.faults.push(Fault::NewFrame { at, robot });
        }
        if self.happens(0.15) && self.names.len() > 2 {
            let ((at, _), robot) = (self.when(0.0, 0.0), self.robot());
            self.faults.push(Fault::Leave { at, robot });
        }
    }

    /// The SLAM restarts, and before the new frame has its first fact, so does the robot.
    fn new_frames(&mut self) {
        if self.happens(0.15) {
            let ((at, _), robot) = (self.when(8.0, 8.0), self.robot());
            let (later, lasts) = (self.dice.range(0.1, 3.0), self.dice.range(0.1, 5.0));
            self.faults.push(Fault::NewFrame { at, robot: robot.clone() });
            self.faults.push(Fault::Kill { at: at + later, lasts, robot });
        }
    }

    fn disks(&mut self) {
        if self.happens(0.5) {
            for _ in 0..self.times(4) {
                let ((at, lasts), robot) = (self.when(1.5, 10.0), self.robot());
                let (mid, writes) = (self.dice.chance(0.6), self.dice.bits() % 24);
                self.faults.push(Fault::PowerCut { at, lasts, robot, mid_commit: mid.then_some(writes) });
            }
        }
        if self.happens(0.2) {
            let ((at, lasts), robot) = (self.when(2.0, 30.0), self.robot());
            self.faults.push(Fault::DiskFull { at, lasts, robot });
        }
        if self.happens(0.25) {
            let ((at, _), robot, errors) = (self.when(0.0, 0.0), self.robot(), self.times(30));
            self.faults.push(Fault::DiskErrors { at, robot, errors, reads: false });
        }
        if self.happens(0.2) {
            let ((at, lasts), robot) = (self.when(0.5, 15.0), self.robot());
            self.faults.push(Fault::Wipe { at, lasts, robot });
        }
    }

    /// A disk that cannot be read, and the robot must: it starts anew.
    fn reads(&mut self) {
        if self.happens(0.15) {
            let ((at, lasts), robot, errors) = (self.when(0.5, 10.0), self.robot(), self.times(30));
            self.faults.push(Fault::DiskErrors { at, robot: robot.clone(), errors, reads: true });
            self.faults.push(Fault::Kill { at, lasts, robot });
        }
    }

    fn long_split(&mut self, lasts: f64) {
        let at = self.dice.range(CALM_SECS, self.scenario.duration_secs - lasts);
        let groups = self.halves();
        self.faults.push(Fault::Partition { at, lasts, groups });
    }

    fn doubtful_disks(&mut self) {
        if self.happens(0.15) {
            let ((at, lasts), robot) = (self.when(3.0, 30.0), self.robot());
            self.faults.push(Fault::LyingDisk { at, lasts, robot });
        }
        if self.happens(0.15) {
            let ((at, lasts), robot) = (self.when(3.0, 30.0), self.robot());
            self.faults.push(Fault::OldImage { at, lasts, robot });
        }
        if self.happens(0.2) {
            for _ in 0..self.times(2) {
                let ((at, lasts), robot, bits) = (self.when(0.1, 5.0), self.robot(), self.times(20));
                self.faults.push(Fault::FlipBits { at, lasts, robot, bits });
            }
        }
    }

    fn members(&mut self) {
        if self.happens(0.15) {
            let ((at, _), robot) = (self.when(0.0, 0.0), self.robot());
            let secs = [-1e10, -3600.0, 3600.0][self.dice.bits() as usize % 3];
            self.faults.push(Fault::ClockJump { at, robot, secs });
        }
        if self.happens(0.1) {
            let ((at, lasts), robot) = (self.when(3.0, 30.0), self.robot());
            self.faults.push(Fault::Twin { at, lasts, robot });
        }
        if self.happens(0.1) {
            let ((at, lasts), robot) = (self.when(3.0, 30.0), self.robot());
            self.faults.push(Fault::Equivocate { at, lasts, robot });
        }
        if self.happens(0.1) {
            let ((at, lasts), robot) = (self.when(3.0, 40.0), self.robot());
            self.faults.push(Fault::OtherVersion { at, lasts, robot });
        }
        if self.happens(0.1) {
            let ((at, lasts), robot) = (self.when(1.0, 10.0), self.robot());
            let per_sec = libm::pow(10.0, self.dice.range(1.0, 4.0));
            self.faults.push(Fault::Flood { at, lasts, robot, per_sec });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_seed_draws_a_good_scenario_and_always_the_same() {
        for seed in 0..500 {
            let text = toml::to_string(&draw(seed, None)).unwrap();
            let read = Scenario::parse(&text).unwrap_or_else(|error| panic!("seed {seed}: {error}\n{text}"));
            assert_eq!(read, draw(seed, None), "seed {seed}: what is printed is what is run");
        }
    }

    #[test]
    fn crowds_stand_or_drive_out_of_reach_of_most_and_more_befalls_them() {
        let crowds: Vec<Scenario> = (0..20).map(|seed| draw(seed, Some(100))).collect();
        for crowd in &crowds {
            assert_eq!(Scenario::parse(&toml::to_string(crowd).unwrap()).unwrap(), *crowd);
        }
        assert!(crowds.iter().any(|crowd| crowd.radio == Layout::Grid));
        assert!(crowds.iter().any(|crowd| matches!(crowd.radio, Layout::Waypoints { .. })));
        let faults = |robots| (0..20).map(|seed| draw(seed, robots).faults.len()).sum::<usize>();
        assert!(faults(Some(100)) > 5 * faults(Some(CROWD)));
        assert_eq!(draw(0, Some(CROWD)).radio, Layout::Mesh);
    }

    #[test]
    fn every_fault_is_drawn_by_some_seed() {
        let drawn: std::collections::BTreeSet<String> = (0..500)
            .flat_map(|seed| draw(seed, None).faults)
            .map(|fault| format!("{fault:?}").split(' ').next().unwrap().to_owned())
            .collect();
        assert_eq!(drawn.len(), 19, "every variant of `Fault`: {drawn:?}");
        let summaries: Vec<SummaryOptions> = (0..500).filter_map(|seed| draw(seed, None).summary).collect();
        assert!(summaries.iter().any(|summary| !summary.liars.is_empty()));
        for way in Adversary::ALL {
            assert!(summaries.iter().any(|summary| summary.adversaries.values().any(|one| *one == way)), "{way:?}");
        }
    }
}

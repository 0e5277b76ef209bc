//! `merganser-sim bench flood`: what 10,000 unknown ids a second cost honest robots. The same swarm of real agents runs
//! twice, without and with strangers at the ears of two of its robots: its halves are cut off from each other while all
//! state facts, and heal in the middle of the flood.

use crate::bar::progress_bar;
use crate::faults::Fault;
use crate::field::Layout;
use crate::network::NetworkOptions;
use crate::scenario::{Expect, MachineOptions, Scenario, SummaryOptions};
use crate::swarm::Swarm;
use crate::world::WorldOptions;
use crate::world::drive::DriveOptions;
use crate::world::sensor::SensorOptions;
use clap::Args;
use merganser_protocol::agent::Agent;
use merganser_protocol::config::Config;
use std::io::Write;

/// Facts are stated, and the halves cut off, until then, s.
const HEALED_SECS: f64 = 60.0;
/// When the flood begins and how long it lasts, s.
const FLOOD_SECS: [f64; 2] = [30.0, 60.0];
/// Messages under unknown ids a second, at each flooded robot.
const PER_SEC: f64 = 10_000.0;
/// Most by which the swarm may be slower.
const SLOWER_MAX: f64 = 2.0;
/// Most by which the peak of the whole process may grow, bytes.
const GROWTH_MAX: u64 = 16 << 20;

/// `bench flood`.
#[derive(Debug, Args)]
pub struct Flood {
    /// Robots
    #[arg(long, default_value_t = 30, value_parser = clap::value_parser!(u16).range(4..=200))]
    robots: u16,
    /// Worlds
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    seeds: u64,
    /// The first world's seed
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..1 << 62))]
    first: u64,
}

/// One run.
struct Ran {
    /// From the healing until all held the same, s; `None` if something broke or they never did.
    settled_secs: Option<f64>,
    messages: u64,
    /// Most memory that the process had in the run, bytes.
    peak: Option<u64>,
}

/// Measures and prints. Returns whether every swarm converged, none much slower for the flood, and memory stayed.
///
/// # Errors
/// Standard output that cannot be written, a scenario that does not start.
pub fn run(options: &Flood) -> anyhow::Result<bool> {
    let bar = progress_bar(2 * options.seeds, "swarms")?;
    let mut out = std::io::stdout().lock();
    writeln!(out, "seed   robots   quiet: equal after s   flooded: equal after s   messages of strangers   growth kB")?;
    let mut good = true;
    let mut sums = [0.0; 2];
    for seed in options.first..options.first + options.seeds {
        forget_peak();
        let quiet = ran(usize::from(options.robots), seed, false)?;
        bar.inc(1);
        forget_peak();
        let flooded = ran(usize::from(options.robots), seed, true)?;
        bar.inc(1);
        let growth = quiet.peak.zip(flooded.peak).map(|(before, after)| after.saturating_sub(before));
        let secs = |ran: &Ran| ran.settled_secs.map_or_else(|| "-".to_owned(), |secs| format!("{secs:.1}"));
        let kilobytes = growth.map_or_else(|| "-".to_owned(), |bytes| (bytes >> 10).to_string());
        let (robots, messages) = (options.robots, flooded.messages);
        let line =
            format!("{seed:<6} {robots:>6} {:>22} {:>24} {messages:>23} {kilobytes:>11}", secs(&quiet), secs(&flooded));
        bar.suspend(|| writeln!(out, "{line}"))?;
        good &= quiet.settled_secs.is_some() && flooded.settled_secs.is_some() && growth.unwrap_or(0) < GROWTH_MAX;
        sums[0] += quiet.settled_secs.unwrap_or_default();
        sums[1] += flooded.settled_secs.unwrap_or_default();
    }
    bar.finish_and_clear();
    let ratio = sums[1] / sums[0].max(1.0);
    writeln!(out, "slower by {ratio:.2}")?;
    Ok(good && ratio <= SLOWER_MAX)
}

fn ran(robots: usize, seed: u64, flooded: bool) -> anyhow::Result<Ran> {
    let outcome = Swarm::<Agent>::new(scenario(robots, flooded), seed)?.run(|_| {})?;
    let agreed = outcome.agreed_since.filter(|_| outcome.violation.is_none());
    Ok(Ran {
        settled_secs: agreed.map(|at| (at.as_secs_f64() - HEALED_SECS).max(0.0)),
        messages: outcome.counts.floods,
        peak: peak_bytes(),
    })
}

fn scenario(robots: usize, flooded: bool) -> Scenario {
    let mut config = Config::default();
    config.submap.voxel_m = 0.4;
    config.submap.keyframes_max = 3;
    config.submap.distance_m = 1e3;
    config.submap.rotation_deg = 180.0;
    config.submap.keypoints = 16;
    config.submap.keypoints_further = 16;
    config.align.candidates_max = 24;
    let mut scenario = Scenario {
        landmarks: None,
        places: None,
        radio: Layout::Mesh,
        name: "flood".into(),
        about: "halves that heal in a flood of strangers".into(),
        robots,
        duration_secs: HEALED_SECS,
        settle_secs: 120.0,
        world: WorldOptions {
            boxes_per_100m2: 0.0,
            pillars_per_100m2: 0.0,
            walls_per_100m2: 0.0,
            ..WorldOptions::default()
        },
        drive: DriveOptions { keyframe_m: 1.5, ..DriveOptions::default() },
        sensor: SensorOptions::default(),
        summary: Some(SummaryOptions { solve: false, ..SummaryOptions::default() }),
        network: NetworkOptions { loss: 0.1, ..NetworkOptions::default() },
        machine: MachineOptions { start_within_secs: 0.0, ..MachineOptions::default() },
        expect: Expect::default(),
        config,
        faults: Vec::new(),
    };
    let names = scenario.names();
    let (left, right) = names.split_at(robots / 2);
    let groups = vec![left.to_vec(), right.to_vec()];
    scenario.faults.push(Fault::Partition { at: 2.0, lasts: HEALED_SECS - 2.0, groups });
    let [at, lasts] = FLOOD_SECS;
    for robot in [&left[0], &right[0]] {
        if flooded {
            scenario.faults.push(Fault::Flood { at, lasts, robot: robot.clone(), per_sec: PER_SEC });
        }
    }
    scenario
}

/// What earlier runs took must not hide what the next one takes. Where the system cannot, the first run's growth
/// counts.
fn forget_peak() {
    let _ = std::fs::write("/proc/self/clear_refs", "5");
}

/// The most memory that this process had since [`forget_peak`], where the system tells.
fn peak_bytes() -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find(|line| line.starts_with("VmHWM:"))?;
    line.split_whitespace().nth(1)?.parse::<u64>().ok().map(|kilobytes| kilobytes << 10)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_flood_comes_lasts_beyond_the_healing_and_stops_nobody() {
        let mut few = scenario(4, true);
        for fault in &mut few.faults {
            if let Fault::Flood { per_sec, .. } = fault {
                *per_sec = 50.0;
            }
        }
        let outcome = Swarm::<Agent>::new(few, 1).unwrap().run(|_| {}).unwrap();
        assert_eq!(outcome.violation, None);
        assert!(outcome.agreed_since.is_some());
        assert!(outcome.counts.floods > (2.0 * 50.0 * (HEALED_SECS - FLOOD_SECS[0])) as u64, "{:?}", outcome.counts);
        let quiet = ran(4, 1, false).unwrap();
        assert!(quiet.settled_secs.is_some() && quiet.messages == 0);
    }
}

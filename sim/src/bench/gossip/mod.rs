//! `merganser-sim bench gossip`: what it costs to make the sets of facts of a whole swarm equal (DESIGN §4). Robots
//! hold real replicas of real signed entries; only the radio, the motion and the time are made up. Beside our gossip
//! runs a plain one in the same worlds, on the same messages: root hashes at a fixed interval, then the whole
//! have-vector with hashes to whoever differs. Where contacts come and go, the time that no gossip can beat is told as
//! well.

mod bound;
mod case;
mod plain;
mod policy;
mod radio;
mod run;
#[cfg(test)]
mod tests;

pub use case::Case;
pub use run::{Outcome, Shared, measure, share};

use crate::bar::progress_bar;
use crate::field::Layout;
use clap::Args;
use policy::Policy;
use std::io::Write;

/// `bench gossip`.
#[derive(Debug, Args)]
pub struct Gossip {
    /// What happens to the swarm
    #[arg(long, value_enum)]
    case: Vec<Case>,
    /// Robots; each case has its usual number
    #[arg(long, value_parser = clap::value_parser!(u16).range(2..=4096))]
    robots: Option<u16>,
    /// Messages lost, in per cent; each case has its usual loss
    #[arg(long, value_parser = clap::value_parser!(u8).range(0..=90))]
    loss: Option<u8>,
    /// Speed of robots that drive about, m/s; the slower, the longer no gossip can be done
    #[arg(long, value_name = "M/S", value_parser = clap::value_parser!(u8).range(1..=100))]
    speed: Option<u8>,
    /// Worlds
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    seeds: u64,
    /// The first world's seed
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(..1 << 62))]
    first: u64,
    /// Leave the plain gossip out
    #[arg(long)]
    alone: bool,
}

/// Measures and prints. Returns whether every swarm converged.
///
/// # Errors
/// Standard output that cannot be written.
pub fn run(options: &Gossip) -> anyhow::Result<bool> {
    let cases = if options.case.is_empty() { Case::usual() } else { options.case.clone() };
    let policies: &[Policy] = if options.alone { &[Policy::Ours] } else { &[Policy::Ours, Policy::Plain] };
    let bar = progress_bar(cases.len() as u64 * options.seeds * policies.len() as u64, "swarms")?;
    let mut out = std::io::stdout().lock();
    let mut all = true;
    writeln!(out, "{}", Outcome::HEADER)?;
    for case in cases {
        let mut world = case.world();
        world.robots = options.robots.map_or(world.robots, usize::from);
        world.loss = options.loss.map_or(world.loss, |percent| f64::from(percent) / 100.0);
        if let (Some(speed), Layout::Waypoints { speed_m_s, .. }) = (options.speed, &mut world.layout) {
            *speed_m_s = f64::from(speed);
        }
        for seed in options.first..options.first + options.seeds {
            if let Some(bound) = bound::bound(&world, seed) {
                bar.suspend(|| writeln!(out, "{bound}"))?;
            }
            for policy in policies {
                let outcome = measure(&world, *policy, seed)?;
                all &= outcome.converged();
                bar.suspend(|| writeln!(out, "{outcome}"))?;
                bar.inc(1);
            }
        }
    }
    bar.finish_and_clear();
    Ok(all)
}

//! `merganser-sim`: runs scenarios, writes the demo's recordings, measures the estimators.
//!
//! Exit codes: 0 all invariants held and goals were reached, 1 not so, 2 the command or a file cannot be used.

use clap::{Parser, Subcommand};
use merganser_sim::bar::progress_bar;
use merganser_sim::bench::{self, Bench};
use merganser_sim::fingerprint::{self, FingerprintArgs};
use merganser_sim::record::record;
use merganser_sim::run::{self, RunArgs, load};
use merganser_sim::scenario::Scenario;
use merganser_sim::vopr::command::{self, VoprArgs};
use merganser_sim::world::trajectory::Trajectory;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// A simulated swarm is many small allocations: with this allocator a crowd takes a sixth less time.
#[cfg(feature = "mimalloc")]
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// The scenario that the demo's recordings are made from, and the seed.
const DEMO: &str = include_str!("../scenarios/three.toml");
const DEMO_SEED: u64 = 1;
/// The scenario for recorded drives.
const STREETS: &str = include_str!("../scenarios/streets.toml");

/// The Merganser core on a virtual network, in virtual time.
#[derive(Debug, Parser)]
#[command(version, about)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Run a scenario and check every invariant
    Run(RunArgs),
    /// Attack swarms: draw networks, machines and faults from seeds, and check every invariant
    Vopr(VoprArgs),
    /// Print what scenarios come to, to the bit, and check every invariant
    Fingerprint(FingerprintArgs),
    /// Write recordings for `merganser demo --data`, the same bytes each time: the demo's three, if not told otherwise
    Record {
        /// Where the recordings' folders go
        #[arg(long, value_name = "DIR")]
        out: PathBuf,
        /// The seed
        #[arg(long, default_value_t = DEMO_SEED)]
        seed: u64,
        /// Another scenario than the demo's (with --along: than sim/scenarios/streets.toml)
        #[arg(long)]
        scenario: Option<PathBuf>,
        /// Robots drive along this recorded trajectory, cut into a stretch for each: lines `stamp x y z qx qy qz qw`
        /// (TUM, KITTI's LiDAR poses), perhaps packed (.xz)
        #[arg(long, value_name = "FILE")]
        along: Option<PathBuf>,
    },
    /// Measure the estimators: success, honesty and time
    #[command(subcommand)]
    Bench(Bench),
}

fn main() -> ExitCode {
    match dispatch(Cli::parse().command) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => ExitCode::from(1),
        Err(error) => {
            let _ = writeln!(std::io::stderr(), "merganser-sim: {error:#}");
            ExitCode::from(2)
        }
    }
}

fn dispatch(command: Command) -> anyhow::Result<bool> {
    match command {
        Command::Vopr(args) => command::run(&args),
        Command::Fingerprint(args) => fingerprint::run(&args),
        Command::Bench(what) => bench::run(what),
        Command::Record { out, seed, scenario, along } => {
            let scenario = match (scenario, &along) {
                (Some(path), _) => load(&path)?,
                (None, Some(_)) => Scenario::parse(STREETS)?,
                (None, None) => Scenario::parse(DEMO)?,
            };
            let along = along.map(|path| Trajectory::read(&path)).transpose()?;
            write_recordings(&scenario, along.as_ref(), seed, &out)?;
            Ok(true)
        }
        Command::Run(args) => run::run(&args),
    }
}

fn write_recordings(scenario: &Scenario, along: Option<&Trajectory>, seed: u64, out: &Path) -> anyhow::Result<()> {
    let bar = progress_bar(0, "keyframes")?;
    let recorded = record(scenario, along, seed, out, |done, all| {
        bar.set_length(all as u64);
        bar.set_position(done as u64);
    });
    bar.finish_and_clear();
    for done in recorded? {
        say(&format!(
            "{:<8} {} keyframes, {} points, {:.1} m in {:.1} s, {} bytes",
            done.robot, done.keyframes, done.points, done.metres, done.secs, done.bytes
        ))?;
    }
    Ok(())
}

fn say(text: &str) -> std::io::Result<()> {
    writeln!(std::io::stdout().lock(), "{text}")
}

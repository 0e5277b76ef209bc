//! `merganser-sim`: runs scenarios, writes the demo's recordings, measures the estimators.
//!
//! Exit codes: 0 all invariants held and goals were reached, 1 not so, 2 the command or a file cannot be used.

use anyhow::Context;
use clap::{Parser, Subcommand};
use merganser_protocol::agent::Agent;
use merganser_sim::band::{Band, parse_band};
use merganser_sim::bar::progress_bar;
use merganser_sim::bench::{self, Bench};
use merganser_sim::record::record;
use merganser_sim::report::Report;
use merganser_sim::scenario::Scenario;
use merganser_sim::svg::picture;
use merganser_sim::swarm::{Outcome, Swarm};
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
    Run {
        /// The scenario file (see sim/scenarios)
        scenario: PathBuf,
        /// The seed that everything is drawn from
        #[arg(long, default_value_t = 1, conflicts_with = "seeds")]
        seed: u64,
        /// Run a band of seeds, FIRST..END (without END)
        #[arg(long, value_name = "FIRST..END", value_parser = parse_band)]
        seeds: Option<Band>,
        /// Write report.json and trajectories.svg here (a folder per seed for a band)
        #[arg(long, value_name = "DIR")]
        report: Option<PathBuf>,
        /// Run each seed twice and compare the traces
        #[arg(long)]
        twice: bool,
    },
    /// Attack swarms: draw networks, machines and faults from seeds, and check every invariant
    Vopr(VoprArgs),
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
        Command::Run { scenario: path, seed, seeds, report, twice } => {
            let scenario = load(&path)?;
            say(&format!("# {} — every option of this run:\n{}", path.display(), toml::to_string(&scenario)?))?;
            let (first, last) = seeds.map_or((seed, seed), |band| (band.0, band.1 - 1));
            let mut good = true;
            for seed in first..=last {
                let folder = report.as_ref().map(|dir| match seeds {
                    Some(_) => dir.join(seed.to_string()),
                    None => dir.clone(),
                });
                good &= run(&scenario, seed, &path, folder.as_deref(), twice, seeds.is_some())?;
            }
            Ok(good)
        }
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

fn load(path: &Path) -> anyhow::Result<Scenario> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    Scenario::parse(&text).with_context(|| path.display().to_string())
}

/// Runs one seed. Returns whether all invariants held.
fn run(
    scenario: &Scenario,
    seed: u64,
    path: &Path,
    folder: Option<&Path>,
    twice: bool,
    brief: bool,
) -> anyhow::Result<bool> {
    let began = std::time::Instant::now();
    let outcome = simulate(scenario, seed)?;
    let wall = began.elapsed().as_secs_f64();
    let report = Report::of(&outcome);
    if let Some(folder) = folder {
        write(folder, &report, &outcome)?;
    }
    say(&line(&report, wall))?;
    if !brief {
        say(&table(&report))?;
        say(&laps(&outcome))?;
    }
    if twice && simulate(scenario, seed)?.trace != outcome.trace {
        say(&format!("BROKEN   seed {seed}: two runs, two traces; something outside the seed has an influence"))?;
        return Ok(false);
    }
    let Some(violation) = &report.violation else { return Ok(true) };
    say(&format!(
        "BROKEN   seed {seed}, at {:.3} s: {}\n         {}\nREPLAY   merganser-sim run {} --seed {seed}",
        violation.at_secs,
        violation.invariant,
        violation.what,
        path.display()
    ))?;
    Ok(false)
}

fn simulate(scenario: &Scenario, seed: u64) -> anyhow::Result<Outcome<Agent>> {
    let swarm = Swarm::<Agent>::new(scenario.clone(), seed)?;
    let bar = progress_bar(swarm.end().as_secs_f64() as u64, "virtual s")?;
    let outcome = swarm.run(|now| bar.set_position(now.as_secs_f64() as u64));
    bar.finish_and_clear();
    Ok(outcome?)
}

fn write(folder: &Path, report: &Report, outcome: &Outcome<Agent>) -> anyhow::Result<()> {
    let put = |name: &str, text: String| {
        let path = folder.join(name);
        std::fs::create_dir_all(folder).and_then(|()| std::fs::write(&path, text))
    };
    put("report.json", serde_json::to_string_pretty(report)? + "\n").context("report.json")?;
    put("trajectories.svg", picture(outcome)).context("trajectories.svg")
}

/// One line per seed.
fn line(report: &Report, wall: f64) -> String {
    let verdict = if report.violation.is_some() { "broken" } else { "good" };
    let worst = report.frame_errors.iter().map(|e| e.metres).fold(0.0, f64::max);
    let d2 = report.mean_d2.map_or_else(|| "-".to_owned(), |d2| format!("{d2:.1}"));
    format!(
        "seed {} {verdict}: {:.0} virtual s in {wall:.2} s ({:.1} simulated s per wall s), {} merged relations, worst \
         {worst:.3} m, mean d² {d2}, trace {}",
        report.seed,
        report.ended_secs,
        report.ended_secs / wall.max(1e-9),
        report.frame_errors.len(),
        &report.trace[..16]
    )
}

fn table(report: &Report) -> String {
    let mut text = format!(
        "\n{:<10} {:>8} {:>8} {:>8} {:>10}  merged with\n",
        "robot", "submaps", "facts", "pending", "bytes sent"
    );
    for robot in &report.robots {
        text += &format!(
            "{:<10} {:>8} {:>8} {:>8} {:>10}  {}\n",
            robot.name,
            robot.submaps,
            robot.entries,
            robot.pending,
            report.bytes_sent(&robot.name),
            robot.merged_with.join(" ")
        );
    }
    text += &format!("\n{:<22} {:>8} {:>7} {:>7} {:>9}\n", "relation", "m", "deg", "scale", "d²");
    for e in &report.frame_errors {
        let relation = format!("{} -> {}", e.own, e.frame);
        text += &format!("{relation:<22} {:>8.4} {:>7.3} {:>7.4} {:>9.2}\n", e.metres, e.degrees, e.scale, e.d2);
    }
    let counts = serde_json::to_value(&report.faults).unwrap_or_default();
    let fired = counts.as_object().into_iter().flatten().filter(|(_, count)| **count != 0);
    let fired: Vec<String> = fired.map(|(name, count)| format!("{count} {}", name.replace('_', " "))).collect();
    text += &format!("\nfaults: {}\n", fired.join(", "));
    text
}

/// Where the wall time went.
fn laps(outcome: &Outcome<Agent>) -> String {
    let laps = outcome.stopwatch.laps().into_iter();
    let laps: Vec<String> = laps.map(|(kind, calls, secs)| format!("{kind} {secs:.2} s in {calls}")).collect();
    format!("wall time: {}", laps.join(", "))
}

fn say(text: &str) -> std::io::Result<()> {
    writeln!(std::io::stdout().lock(), "{text}")
}

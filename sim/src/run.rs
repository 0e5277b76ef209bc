//! `merganser-sim run`: a scenario, for one seed or a band of them.

use crate::band::{Band, jobs, parse_band};
use crate::bar::progress_bar;
use crate::report::Report;
use crate::scenario::Scenario;
use crate::svg::picture;
use crate::swarm::{Outcome, Swarm};
use anyhow::Context;
use merganser_protocol::agent::Agent;
use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

/// Run a scenario and check every invariant.
#[derive(Clone, Debug, clap::Args)]
pub struct RunArgs {
    /// The scenario file (see sim/scenarios)
    pub scenario: PathBuf,
    /// The seed that everything is drawn from
    #[arg(long, default_value_t = 1, conflicts_with = "seeds")]
    pub seed: u64,
    /// Run a band of seeds, FIRST..END (without END)
    #[arg(long, value_name = "FIRST..END", value_parser = parse_band)]
    pub seeds: Option<Band>,
    /// Seeds of a band run at once, so that each takes longer by itself; all processors if absent
    #[arg(long, value_name = "N", requires = "seeds", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub jobs: Option<u16>,
    /// Write report.json and trajectories.svg here (a folder per seed for a band)
    #[arg(long, value_name = "DIR")]
    pub report: Option<PathBuf>,
    /// Run each seed twice and compare the traces
    #[arg(long)]
    pub twice: bool,
}

/// Runs the seeds. Whether all invariants held.
///
/// # Errors
/// If the scenario cannot be used, nothing can be printed, or a report cannot be written.
pub fn run(args: &RunArgs) -> anyhow::Result<bool> {
    let scenario = load(&args.scenario)?;
    say(&format!("# {} — every option of this run:\n{}", args.scenario.display(), toml::to_string(&scenario)?))?;
    let Some(band) = args.seeds else {
        let bar = progress_bar(0, "virtual s")?;
        let told = run_seed(args, &scenario, args.seed, |now, end| {
            bar.set_length(end as u64);
            bar.set_position(now as u64);
        });
        bar.finish_and_clear();
        let told = told?;
        say(&told.text)?;
        return Ok(told.good);
    };
    let bar = progress_bar(band.1 - band.0, "seeds")?;
    let (mut good, mut errors, failed) = (true, Vec::new(), AtomicBool::new(false));
    let fails = || failed.store(true, Ordering::Relaxed);
    let work = |seed| {
        if failed.load(Ordering::Relaxed) {
            return None;
        }
        // A panic is told like an error, with its seed: the other jobs must not go on for hours before it is seen.
        let told = catch_unwind(AssertUnwindSafe(|| run_seed(args, &scenario, seed, |_, _| {})));
        let told = told.unwrap_or_else(|_| Err(anyhow::anyhow!("seed {seed} panicked")));
        if told.is_err() {
            fails();
        }
        bar.inc(1);
        Some(told)
    };
    let print = |told: Told| bar.suspend(|| say(&told.text)).map(|()| told.good);
    band.for_each(jobs(args.jobs), work, |_, told| match told.and_then(|told| Ok(print(told)?)) {
        Ok(held) => good &= held,
        Err(error) => {
            fails();
            errors.push(error);
        }
    });
    bar.finish_and_clear();
    errors.into_iter().next().map_or(Ok(good), Err)
}

/// Reads a scenario's file.
///
/// # Errors
/// If it cannot be read or used.
pub fn load(path: &Path) -> anyhow::Result<Scenario> {
    let text = std::fs::read_to_string(path).with_context(|| path.display().to_string())?;
    Scenario::parse(&text).with_context(|| path.display().to_string())
}

/// What one seed has to tell.
struct Told {
    text: String,
    /// Whether all invariants held.
    good: bool,
}

/// Runs one seed; `progress` is told the virtual time and its end, s.
fn run_seed(args: &RunArgs, scenario: &Scenario, seed: u64, progress: impl Fn(f64, f64)) -> anyhow::Result<Told> {
    let began = std::time::Instant::now();
    let outcome = simulate(scenario, seed, &progress)?;
    let wall = began.elapsed().as_secs_f64();
    let report = Report::of(&outcome);
    if let Some(folder) = &args.report {
        write(&args.seeds.map_or_else(|| folder.clone(), |_| folder.join(seed.to_string())), &report, &outcome)?;
    }
    let mut text = line(&report, wall);
    if args.seeds.is_none() {
        text += &format!("\n{}\n{}", table(&report), laps(&outcome));
    }
    let file = args.scenario.display();
    if args.twice && simulate(scenario, seed, &progress)?.trace != outcome.trace {
        text += &format!(
            "\nBROKEN   seed {seed}: two runs, two traces; something outside the seed has an influence\nREPLAY   \
             merganser-sim run {file} --seed {seed} --twice"
        );
        return Ok(Told { text, good: false });
    }
    if let Some(violation) = &report.violation {
        text += &format!(
            "\nBROKEN   seed {seed}, at {:.3} s: {}\n         {}\nREPLAY   merganser-sim run {file} --seed {seed}",
            violation.at_secs, violation.invariant, violation.what,
        );
    }
    Ok(Told { text, good: report.violation.is_none() })
}

fn simulate(scenario: &Scenario, seed: u64, progress: impl Fn(f64, f64)) -> anyhow::Result<Outcome<Agent>> {
    let swarm = Swarm::<Agent>::new(scenario.clone(), seed)?;
    let end = swarm.end().as_secs_f64();
    Ok(swarm.run(|now| progress(now.as_secs_f64(), end))?)
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

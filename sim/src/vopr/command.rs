//! `merganser-sim vopr`: one seed, told in full, or a band of them, told in sum.

use super::{SeedReport, Tally, draw, run_seed, settle_secs};
use crate::band::{Band, jobs, parse_band};
use crate::bar::progress_bar;
use crate::check::Violation;
use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

/// Of a band, each seed of which this is a divisor runs twice, and must leave one trace.
const TWICE_EVERY: u64 = 16;

/// Draw networks, machines and faults from seeds, and check every invariant.
///
/// A run is a storm, in which everything that can go wrong with links, disks, processes and clocks does, and then calm,
/// in which all must come to hold the same facts within a stated time. Exits with 0 only if no invariant broke.
#[derive(Clone, Debug, clap::Args)]
#[command(group(clap::ArgGroup::new("which").required(true).args(["seed", "seeds"])))]
pub struct VoprArgs {
    /// Run one seed, and print all that it drew first: the way to replay a failure
    #[arg(long, value_name = "N")]
    pub seed: Option<u64>,
    /// Run a band of seeds, FIRST..END (without END)
    #[arg(long, value_name = "FIRST..END", value_parser = parse_band)]
    pub seeds: Option<Band>,
    /// So many robots, instead of the 2 to 10 that a seed draws
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(2..=1000))]
    pub robots: Option<u16>,
    /// Seeds run at once; all processors if absent
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=256))]
    pub jobs: Option<u16>,
    /// Run every seed twice and compare the traces (a band does so with every sixteenth)
    #[arg(long)]
    pub twice: bool,
    /// Begin no further seed once an invariant broke
    #[arg(long)]
    pub fail_fast: bool,
    /// Write what was counted here, as JSON
    #[arg(long, value_name = "FILE")]
    pub report: Option<PathBuf>,
}

/// Runs the seeds. Whether no invariant broke.
///
/// # Errors
/// If nothing can be printed or the report cannot be written.
pub fn run(args: &VoprArgs) -> anyhow::Result<bool> {
    // A panic that is caught is told as a broken invariant, or is the store's way to meet damage.
    std::panic::set_hook(Box::new(|_| {}));
    let band = match (args.seed, args.seeds) {
        (Some(seed), _) => Band(seed, seed.saturating_add(1)),
        (None, Some(band)) => band,
        (None, None) => anyhow::bail!("give --seed or --seeds"),
    };
    let robots = args.robots.map(usize::from);
    if let Some(seed) = args.seed {
        let options = toml::to_string(&draw(seed, robots))?;
        say(&format!("# seed {seed} — every option of this run, drawn from it:\n{options}"))?;
    }
    let began = Instant::now();
    let reports = run_band(band, args)?;
    let wall = began.elapsed().as_secs_f64();
    let mut tally = Tally::default();
    reports.values().for_each(|report| tally.add(report));
    say(&tally.table())?;
    if let [report] = &reports.values().collect::<Vec<_>>()[..] {
        say(&one_line(report))?;
    }
    say(&format!(
        "{} seeds, {} broken; {:.0} virtual s in {wall:.1} s ({:.2} s a seed); slowest to agree after the \
         healing: {:.1} s (seed {}), allowed {:.0} s",
        tally.seeds,
        tally.broken.len(),
        tally.virtual_secs,
        wall / tally.seeds.max(1) as f64,
        tally.slowest.0,
        tally.slowest.1,
        settle_secs(robots.unwrap_or_default())
    ))?;
    if let Some(path) = &args.report {
        let text = serde_json::to_string_pretty(&tally)? + "\n";
        std::fs::write(path, text).map_err(|error| anyhow::anyhow!("{}: {error}", path.display()))?;
    }
    Ok(tally.broken.is_empty())
}

fn run_band(band: Band, args: &VoprArgs) -> anyhow::Result<BTreeMap<u64, SeedReport>> {
    let bar = progress_bar(band.1 - band.0, "seeds")?;
    let broken = AtomicBool::new(false);
    let mut reports = BTreeMap::new();
    let work = |seed: u64| {
        if args.fail_fast && broken.load(Ordering::Relaxed) {
            return None;
        }
        let report = run_seed(seed, args.robots.map(usize::from), args.twice || seed.is_multiple_of(TWICE_EVERY));
        if let Some(text) = broken_text(&report, args) {
            broken.store(true, Ordering::Relaxed);
            // Told at once: a long band may be ended before its time.
            bar.suspend(|| say(&text)).unwrap_or_default();
        }
        bar.inc(1);
        Some(report)
    };
    band.for_each(jobs(args.jobs), work, |seed, report| {
        reports.insert(seed, report);
    });
    bar.finish_and_clear();
    Ok(reports)
}

/// What broke, if anything, and how to see it again.
fn broken_text(report: &SeedReport, args: &VoprArgs) -> Option<String> {
    let Violation { invariant, at_secs, what } = report.violation.as_ref()?;
    let robots = args.robots.map_or_else(String::new, |robots| format!(" --robots {robots}"));
    // A seed alone is run once, unless it is said.
    let twice = if args.twice || report.seed.is_multiple_of(TWICE_EVERY) { " --twice" } else { "" };
    let seed = report.seed;
    Some(format!(
        "BROKEN   seed {seed}, at {at_secs:.3} s: {invariant}\n         {what}\nREPLAY   merganser-sim vopr --seed \
         {seed}{robots}{twice}"
    ))
}

fn one_line(report: &SeedReport) -> String {
    let verdict = if report.violation.is_some() { "broken" } else { "good" };
    format!(
        "seed {} {verdict}: {} robots, {} entries at the end, ended at {:.1} s, all agreed {:.1} s after the healing, trace {}",
        report.seed, report.robots, report.entries, report.ended_secs, report.settled_secs, report.trace
    )
}

fn say(text: &str) -> std::io::Result<()> {
    writeln!(std::io::stdout().lock(), "{text}")
}

//! `merganser-sim bench`: how good and how fast the estimators are, as tables (MATH §4 and §5).

pub mod frames;

use crate::bar::progress_bar;
use clap::Subcommand;
use std::io::Write;

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum Bench {
    /// Frame-level consensus on seeded worlds: success, refusals and honesty of the covariance
    ///
    /// Two robots drive a figure-eight of about 120 m with drifting odometry; a cell has 20 alignments between them, of
    /// which most are false and some agree with each other on a lie. Exit code 1 if a cell falls short of its goal.
    Frames {
        /// Worlds a cell
        #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
        seeds: u64,
        /// The first world's seed
        #[arg(long, default_value_t = 7000, value_parser = clap::value_parser!(u64).range(..1 << 62))]
        first: u64,
    },
}

/// Measures and prints. Returns whether the goals were reached.
///
/// # Errors
/// Standard output that cannot be written.
pub fn run(bench: Bench) -> anyhow::Result<bool> {
    match bench {
        Bench::Frames { seeds, first } => {
            let cells = frames::cells();
            let bar = progress_bar(cells.len() as u64 * seeds, "worlds")?;
            let measured: Vec<_> =
                cells.iter().map(|cell| frames::measure(cell, first..first + seeds, || bar.inc(1))).collect();
            bar.finish_and_clear();
            let mut out = std::io::stdout().lock();
            write!(out, "{}", frames::table(&cells, &measured))?;
            Ok(cells.iter().zip(&measured).all(|(cell, tally)| cell.shortfall(tally).is_none()))
        }
    }
}

//! `merganser graph`: the joint estimate's solver on its own, for pose graphs in files.

mod change;
mod fuse;
mod identity;
mod read;
mod robust;
mod solve;
mod write;

use super::{BadInput, say};
use anyhow::Result;
use clap::{Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use read::Source;
use std::path::PathBuf;
use std::time::Duration;

/// What `merganser graph` can be told.
#[derive(Clone, Debug, Subcommand)]
pub enum GraphCommand {
    /// Solve a pose graph.
    ///
    /// Each connected part is solved by itself: from a relaxation that needs no initial values, or from the certified
    /// minimum of SE-Sync's cost. It lies where the file has its first pose, or the one that a FIX line names; without
    /// a vertex of that pose, it begins at the origin. Prints a line per part, and exits with 1 if one did not converge
    /// or, with --certify, was not certified. Where there are several parts, a comment above each in the files tells
    /// them apart: nothing is known of where they lie to each other.
    Solve(SolveArgs),
    /// Share a graph's poses among robots: the same graph, with a robot's letter in the top byte of each pose's id.
    Split(SplitArgs),
    /// Fuse two estimates of the same poses that may rest on the same measurements, nobody knows which.
    ///
    /// By split covariance intersection: the result is never surer than both allow, however much their errors have in
    /// common, and is refused where they contradict each other. Poses are matched by id and must be in one frame,
    /// with covariances relative to the same pose.
    ///
    /// Use it for estimates that came without the measurements behind them. Where you have those, unite them in one
    /// graph and solve it (`merganser graph solve A.g2o B.g2o`): a measurement in both files counts once, nothing is
    /// thrown away, and the result is surer. Robots of a swarm do that; they never fuse estimates.
    Fuse(FuseArgs),
    /// Turn measurements of another project into a graph.
    #[command(subcommand)]
    Import(ImportCommand),
}

/// How to solve, and what to write.
#[derive(Clone, Debug, clap::Args)]
pub struct SolveArgs {
    /// g2o files; several are robots' files of one graph.
    #[arg(required = true, value_name = "FILE")]
    pub files: Vec<PathBuf>,
    /// Where the minimisation starts.
    #[arg(long, value_enum, default_value_t = StartArg::Relaxed)]
    pub start: StartArg,
    /// Minimise SE-Sync's cost, prove that its minimum is global, and start from there.
    #[arg(long, conflicts_with = "start")]
    pub certify: bool,
    /// Take the isotropic weights of SE-Sync in place of the information matrices.
    #[arg(long)]
    pub isotropic: bool,
    /// Leave out measurements that contradict the rest, and list them. Consecutive poses of a robot (the top byte of
    /// their ids) are tied by its odometry, which is trusted.
    #[arg(long, conflicts_with_all = ["start", "certify"])]
    pub robust: bool,
    /// Write the solved graph as g2o: poses and all measurements, with --robust those that count.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Write the poses as a TUM trajectory, in place of times the numbers of the poses: their ids without the robot's
    /// letter. Where there are several robots, each has a file: for `--tum out.tum` they are out_a.tum, out_b.tum, …
    #[arg(long, value_name = "FILE")]
    pub tum: Option<PathBuf>,
    /// Write the poses with their covariances as CSV.
    ///
    /// Columns: id; origin, the pose of the same part that the covariance is relative to (its first, or the one that is
    /// fixed); x, y, z, qx, qy, qz, qw; the upper triangle of the covariance of the pose's own perturbation (ρ, φ) in
    /// m and rad, row by row. With --robust it is that of the measurements that count, as they state it.
    #[arg(long, value_name = "FILE")]
    pub marginals: Option<PathBuf>,
    /// With --robust, write each measurement's weight and the reason if it is 0, as CSV.
    #[arg(long, value_name = "FILE", requires = "robust")]
    pub verdicts: Option<PathBuf>,
    /// Iterations at most.
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=10_000))]
    pub iterations: u32,
}

/// Where a minimisation starts.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum StartArg {
    /// Chordal relaxation.
    Relaxed,
    /// The minimum of SE-Sync's cost.
    Chordal,
    /// The values of the file.
    Given,
}

/// What to share, and among how many.
#[derive(Clone, Debug, clap::Args)]
pub struct SplitArgs {
    /// The g2o file.
    #[arg(value_name = "FILE")]
    pub file: PathBuf,
    /// Robots; each gets a run of consecutive poses.
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=26))]
    pub robots: u8,
    /// The first robot's letter. With one robot, poses keep their numbers: so files of robots that all count from 0
    /// become fit to be solved together.
    #[arg(long, value_name = "LETTER", default_value = "a", value_parser = letter)]
    pub first: char,
    /// The g2o file to write.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
}

/// What to fuse.
#[derive(Clone, Debug, clap::Args)]
pub struct FuseArgs {
    /// A table of poses with covariances, as `graph solve --marginals` writes it.
    #[arg(value_name = "A.csv")]
    pub first: PathBuf,
    /// Another.
    #[arg(value_name = "B.csv")]
    pub second: PathBuf,
    /// The table to write: fused what is in both, as it is what is in one.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
    /// The share of each covariance, 0 to 1, that is known to be independent of the other table.
    ///
    /// 0, nothing is known: covariance intersection. 1, no measurement is behind both: the information-weighted mean,
    /// which is far too sure of itself where that is not so.
    #[arg(long, value_name = "SHARE", default_value_t = 0.0, value_parser = share)]
    pub independent: f64,
}

/// Where measurements come from.
#[derive(Clone, Debug, Subcommand)]
pub enum ImportCommand {
    /// Kimera-Multi: a folder of robots' folders, each with a measurements.csv.
    Kimera {
        /// The folder.
        #[arg(value_name = "DIR")]
        folder: PathBuf,
        /// The g2o file to write.
        #[arg(long, value_name = "FILE")]
        out: PathBuf,
    },
}

/// Solves, splits, fuses or imports.
///
/// # Errors
/// If a file cannot be read, is no graph or table, cannot be solved or fused, or cannot be written.
pub fn run(command: &GraphCommand) -> Result<bool> {
    match command {
        GraphCommand::Solve(args) if args.robust => robust::solve(args),
        GraphCommand::Solve(args) => solve::solve(args),
        GraphCommand::Split(args) => change::split(args),
        GraphCommand::Fuse(args) => fuse::fuse(args),
        GraphCommand::Import(ImportCommand::Kimera { folder, out }) => change::import_kimera(folder, out),
    }
}

fn source_of(args: &SolveArgs) -> Result<Source> {
    let mut source = Source::read(&args.files)?;
    if args.isotropic {
        source.graph = source.graph.isotropic();
    }
    Ok(source)
}

fn share(text: &str) -> Result<f64, String> {
    let share = text.parse::<f64>().ok().filter(|share| (0.0..=1.0).contains(share));
    share.ok_or_else(|| "a share is a number from 0 to 1".to_owned())
}

fn letter(text: &str) -> Result<char, String> {
    match text.as_bytes() {
        [letter] if letter.is_ascii_lowercase() => Ok(char::from(*letter)),
        _ => Err("a robot's letter is one from a to z".to_owned()),
    }
}

/// "1 part", "2 parts".
fn counted(n: usize, thing: &str) -> String {
    if n == 1 { format!("1 {thing}") } else { format!("{n} {thing}s") }
}

/// Says what is odd, beside the results.
fn warn(text: &str) {
    // Nowhere left to say that it cannot be said.
    let _ = console::Term::stderr().write_line(&format!("merganser: {text}"));
}

/// Turns while something long goes on; hidden where nobody sees it.
fn waiting(what: &str) -> ProgressBar {
    let bar = ProgressBar::new_spinner();
    if let Ok(style) = ProgressStyle::with_template("{elapsed:>4} {spinner} {msg}") {
        bar.set_style(style);
    }
    bar.set_message(what.to_owned());
    bar.enable_steady_tick(Duration::from_millis(100));
    bar
}

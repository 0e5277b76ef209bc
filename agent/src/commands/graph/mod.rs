//! `merganser graph`: the joint estimate's solver on its own, for pose graphs in files.

use super::say;
use anyhow::{Context, Result, bail};
use clap::{Subcommand, ValueEnum};
use merganser_protocol::config::EstimateConfig;
use merganser_protocol::estimate::posegraph::g2o::{self, Parser};
use merganser_protocol::estimate::posegraph::kimera::Importer;
use merganser_protocol::estimate::posegraph::robust::{RobustSolved, Verdict, robot_of};
use merganser_protocol::estimate::posegraph::solve::{ChordalOutcome, Start};
use merganser_protocol::estimate::posegraph::{Measurement, PoseGraph};
use merganser_protocol::geometry::Se3;
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::time::Instant;

/// What `merganser graph` can be told.
#[derive(Clone, Debug, Subcommand)]
pub enum GraphCommand {
    /// Solve a pose graph.
    ///
    /// Each connected part is solved by itself: from a relaxation that needs no initial values, or from the certified
    /// minimum of SE-Sync's cost. Prints a line per part, and exits with 1 if one did not converge or, with --certify,
    /// was not certified.
    Solve(SolveArgs),
    /// Share a graph's poses among robots: the same graph, with a robot's letter in the top byte of each pose's id.
    Split(SplitArgs),
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
    #[arg(long, conflicts_with_all = ["start", "certify", "marginals"])]
    pub robust: bool,
    /// Write the solved graph as g2o: poses and all measurements, with --robust those that count.
    #[arg(long, value_name = "FILE")]
    pub out: Option<PathBuf>,
    /// Write the poses as a TUM trajectory, ids in place of times.
    #[arg(long, value_name = "FILE")]
    pub tum: Option<PathBuf>,
    /// Write each pose's covariance relative to the first as CSV: id, then the upper triangle in (ρ, φ), row by row.
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
    /// The g2o file to write.
    #[arg(long, value_name = "FILE")]
    pub out: PathBuf,
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

/// Solves, splits or imports.
///
/// # Errors
/// If a file cannot be read, is no graph, or cannot be written.
pub fn run(command: &GraphCommand) -> Result<bool> {
    match command {
        GraphCommand::Solve(args) if args.robust => solve_robustly(args),
        GraphCommand::Solve(args) => solve(args),
        GraphCommand::Split(args) => split(args),
        GraphCommand::Import(ImportCommand::Kimera { folder, out }) => import_kimera(folder, out),
    }
}

fn solve(args: &SolveArgs) -> Result<bool> {
    let graph = graph_of(args)?;
    let (mut good, mut solved, mut marginals) = (true, BTreeMap::new(), String::new());
    let parts = graph.parts();
    for (k, part) in parts.iter().enumerate() {
        let began = Instant::now();
        let iterations = args.iterations as usize;
        let smallest = part.poses.keys().next().copied().unwrap_or_default();
        let place = || format!("the part of pose {smallest}");
        let (start, certified) = if args.certify {
            let (values, outcome) = part.certified(iterations).with_context(place)?;
            (values, Some(outcome))
        } else {
            let start = match args.start {
                StartArg::Relaxed => Start::Relaxed,
                StartArg::Chordal => Start::Chordal,
                StartArg::Given => Start::Given,
            };
            (part.start(start, iterations).with_context(place)?, None)
        };
        let out = part.solve(&start, iterations).with_context(place)?;
        let seconds = began.elapsed().as_secs_f64();
        good &= out.solution.converged && certified.as_ref().is_none_or(|c| c.converged && c.certificate.certified);
        say(&format!(
            "part {} of {}: {} poses, {} measurements, {} after {} iterations, χ² {:.6} of {} dof, {seconds:.3} s",
            k + 1,
            parts.len(),
            part.poses.len(),
            part.measurements.len(),
            if out.solution.converged { "converged" } else { "NOT CONVERGED" },
            out.solution.iterations,
            out.solution.chi2,
            out.solution.dof,
        ))?;
        if let Some(outcome) = &certified {
            say(&certificate_line(part, outcome))?;
        }
        if args.marginals.is_some() {
            out.marginals().iter().for_each(|(id, c)| add_marginal(&mut marginals, *id, c.matrix()));
        }
        solved.extend(out.ids.iter().copied().zip(out.values.iter().copied()));
    }
    if let Some(path) = &args.marginals {
        write(path, &marginals)?;
    }
    write_solved(args, &graph, &solved, |_| true)?;
    Ok(good)
}

fn graph_of(args: &SolveArgs) -> Result<PoseGraph> {
    let graph = read(&args.files)?;
    Ok(if args.isotropic { graph.isotropic() } else { graph })
}

fn certificate_line(part: &PoseGraph, outcome: &ChordalOutcome) -> String {
    let certificate = &outcome.certificate;
    let verdict = match (certificate.certified, part.is_isotropic()) {
        (true, true) => "certified: the global minimum",
        (true, false) => {
            "certified for the isotropic weights; not applicable to the graph's own, which are not isotropic"
        }
        (false, _) => "NOT CERTIFIED",
    };
    let gap = certificate.gap.map_or_else(|| "unknown".to_owned(), |gap| format!("{gap:.1e}"));
    let eigenvalue = certificate.eigenvalue.map_or_else(|| "far below 0".to_owned(), |x| format!("{x:.1e}"));
    format!(
        "  SE-Sync's cost {:.8} after {} iterations; {verdict} (smallest eigenvalue {eigenvalue}, gap at most {gap})",
        outcome.cost, outcome.iterations
    )
}

fn add_marginal(out: &mut String, id: u64, covariance: &nalgebra::Matrix6<f64>) {
    let _ = write!(out, "{id}");
    for r in 0..6 {
        for c in r..6 {
            let _ = write!(out, ",{:e}", covariance[(r, c)]);
        }
    }
    out.push('\n');
}

fn solve_robustly(args: &SolveArgs) -> Result<bool> {
    let graph = graph_of(args)?;
    let began = Instant::now();
    let config = EstimateConfig { iterations_max: args.iterations as usize, ..EstimateConfig::default() };
    let solved = graph.solve_robustly(&config);
    let seconds = began.elapsed().as_secs_f64();
    let count = |keep: fn(&Verdict) -> bool| solved.verdicts.iter().filter(|v| keep(v)).count();
    say(&format!(
        "{} poses in {} parts; {} odometry, {} of {} other measurements used; χ² {:.3} of {} dof, {}, {seconds:.3} s",
        graph.poses.len(),
        solved.components.len(),
        count(|v| *v == Verdict::Odometry),
        count(|v| matches!(v, Verdict::Used(_))),
        count(|v| *v != Verdict::Odometry),
        solved.map.chi2,
        solved.map.dof,
        if solved.map.converged { "converged" } else { "NOT CONVERGED" },
    ))?;
    reasons(&solved).into_iter().try_for_each(|line| say(&line))?;
    if let Some(path) = &args.verdicts {
        write(path, &verdicts_csv(&graph, &solved))?;
    }
    let values = solved.components.iter().flatten().map(|(&id, &value)| (id, value)).collect();
    let used: BTreeMap<usize, bool> =
        solved.verdicts.iter().map(|v| !matches!(v, Verdict::Unused(_))).enumerate().collect();
    write_solved(args, &graph, &values, |k| used.get(&k).copied().unwrap_or_default())?;
    Ok(solved.map.converged)
}

/// How many measurements were left out for which reason.
fn reasons(solved: &RobustSolved) -> Vec<String> {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for verdict in &solved.verdicts {
        if let Verdict::Unused(reason) = verdict {
            // From the first number or bracket on, the text is each one's own.
            let text = reason.to_string();
            let common = text.split(|c: char| c == '(' || c.is_ascii_digit()).next().unwrap_or_default();
            *counts.entry(common.trim_end().to_owned()).or_default() += 1;
        }
    }
    counts.into_iter().map(|(reason, n)| format!("  {n} left out: {reason}")).collect()
}

fn verdicts_csv(graph: &PoseGraph, solved: &RobustSolved) -> String {
    let mut out = String::from("i,j,weight,reason\n");
    for (m, verdict) in graph.measurements.iter().zip(&solved.verdicts) {
        let _ = match verdict {
            Verdict::Odometry => writeln!(out, "{},{},1,odometry", m.i, m.j),
            Verdict::Used(weight) => writeln!(out, "{},{},{weight},", m.i, m.j),
            Verdict::Unused(reason) => writeln!(out, "{},{},0,\"{reason}\"", m.i, m.j),
        };
    }
    out
}

fn write_solved(
    args: &SolveArgs,
    graph: &PoseGraph,
    values: &BTreeMap<u64, Se3>,
    keep: impl Fn(usize) -> bool,
) -> Result<()> {
    if let Some(path) = &args.out {
        let kept = graph.measurements.iter().enumerate().filter(|(k, _)| keep(*k)).map(|(_, m)| m.clone());
        let poses = graph.poses.keys().map(|&id| (id, values.get(&id).copied())).collect();
        write(path, &g2o::write(&PoseGraph { poses, measurements: kept.collect(), planar: graph.planar }))?;
    }
    if let Some(path) = &args.tum {
        write(path, &g2o::write_tum(values))?;
    }
    Ok(())
}

fn split(args: &SplitArgs) -> Result<bool> {
    let graph = read(std::slice::from_ref(&args.file))?;
    let (poses, robots) = (graph.poses.len(), usize::from(args.robots));
    if poses < robots {
        bail!("{}: {poses} poses cannot be shared among {robots} robots", args.file.display());
    }
    let name = |(k, &id): (usize, &u64)| {
        let robot = k * robots / poses;
        let first = (robot * poses).div_ceil(robots);
        (id, ((u64::from(b'a') + robot as u64) << 56) | (k - first) as u64)
    };
    let names: BTreeMap<u64, u64> = graph.poses.keys().enumerate().map(name).collect();
    let renamed = |m: &Measurement| Measurement { i: names[&m.i], j: names[&m.j], ..m.clone() };
    let out = PoseGraph {
        poses: graph.poses.iter().map(|(id, value)| (names[id], *value)).collect(),
        measurements: graph.measurements.iter().map(renamed).collect(),
        planar: graph.planar,
    };
    let between = out.measurements.iter().filter(|m| robot_of(m.i) != robot_of(m.j)).count();
    write(&args.out, &g2o::write(&out))?;
    say(&format!("{poses} poses shared among {robots} robots, {between} measurements between them"))?;
    Ok(true)
}

fn import_kimera(folder: &Path, out: &Path) -> Result<bool> {
    let mut tables = Vec::new();
    for entry in std::fs::read_dir(folder).with_context(|| folder.display().to_string())? {
        let path = entry?.path().join("measurements.csv");
        if path.is_file() {
            tables.push(path);
        }
    }
    tables.sort();
    if tables.is_empty() {
        bail!("{}: no folder in it has a measurements.csv", folder.display());
    }
    let mut importer = Importer::default();
    for path in &tables {
        importer.begin();
        for line in lines(path)? {
            importer.line(&line?).with_context(|| path.display().to_string())?;
        }
    }
    let (graph, _) = importer.finish();
    write(out, &g2o::write(&graph))?;
    say(&format!("{} tables: {} poses, {} measurements", tables.len(), graph.poses.len(), graph.measurements.len()))?;
    Ok(true)
}

fn read(files: &[PathBuf]) -> Result<PoseGraph> {
    let mut parser = Parser::default();
    for path in files {
        parser.begin();
        for line in lines(path)? {
            parser
                .line(&line.with_context(|| path.display().to_string())?)
                .with_context(|| path.display().to_string())?;
        }
    }
    let graph = parser.finish();
    if graph.poses.is_empty() {
        bail!("{}: no pose in it", files.first().map(|f| f.display().to_string()).unwrap_or_default());
    }
    Ok(graph)
}

/// The lines of a text file; a line without end is cut, so that the parser refuses it.
fn lines(path: &Path) -> Result<impl Iterator<Item = std::io::Result<String>>> {
    let file = File::open(path).with_context(|| path.display().to_string())?;
    let mut reader = BufReader::new(file);
    Ok(std::iter::from_fn(move || {
        let mut line = Vec::new();
        loop {
            let (used, done) = match reader.fill_buf() {
                Ok([]) if line.is_empty() => return None,
                Ok([]) => (0, true),
                Ok(bytes) => {
                    let end = bytes.iter().position(|&b| b == b'\n');
                    let text = &bytes[..end.unwrap_or(bytes.len())];
                    let room = (2 * g2o::LINE_MAX).saturating_sub(line.len());
                    line.extend_from_slice(&text[..text.len().min(room)]);
                    (text.len() + usize::from(end.is_some()), end.is_some())
                }
                Err(error) => return Some(Err(error)),
            };
            reader.consume(used);
            if done {
                return Some(Ok(String::from_utf8_lossy(&line).into_owned()));
            }
        }
    }))
}

fn write(path: &Path, text: &str) -> Result<()> {
    std::fs::write(path, text).with_context(|| path.display().to_string())
}

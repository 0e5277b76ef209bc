//! The correspondence-level estimator on a folder of problems: MATH §4's cells, beside what peers gave on them.

use super::corr;
use super::outliers;
use super::peer;
use super::peers::Peers;
use super::row::{HEADER, Row, Status};
use super::solve::{Refinement, Solved, solve};
use super::table::table;
use crate::bar::progress_bar;
use anyhow::{Context, bail};
use clap::Args;
use std::fmt::Write as _;
use std::io::Write;
use std::path::{Path, PathBuf};

/// What to solve and how.
#[derive(Debug, Args)]
pub struct Registration {
    /// Folder of .corr files, searched through; rows of peers come from peers.csv beside it
    #[arg(long, value_name = "DIR", required_unless_present = "pure_outliers")]
    pub inputs: Option<PathBuf>,
    /// Write a row per problem here
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
    /// Upper bound of the noise's standard deviation that the estimator is told
    #[arg(long, default_value_t = 0.03, value_parser = parse_sigma)]
    pub sigma_max: f64,
    /// Only files whose name contains this, such as SE3_N01000 or o99
    #[arg(long, value_name = "STR", default_value = "")]
    pub filter: String,
    /// Weights that refine the answer; several make a table each
    #[arg(long, value_delimiter = ',', default_value = "auto")]
    pub weighting: Vec<Refinement>,
    /// Recorded results of peers; without it, peers.csv beside DIR
    #[arg(long, value_name = "FILE")]
    pub peers: Option<PathBuf>,
    /// Measure peers on the same files, in this Python interpreter
    #[arg(long, value_name = "PYTHON", requires = "inputs")]
    pub peer_python: Option<PathBuf>,
    /// Which peers, of kiss_prune_solve, kiss_solve, o3d_ransac, o3d_fgr; without it, all that are installed
    #[arg(long, value_delimiter = ',', requires = "peer_python")]
    pub peer: Vec<String>,
    /// Solve also this many problems without a true match, which nothing should be accepted in
    #[arg(long, value_name = "COUNT")]
    pub pure_outliers: Option<u32>,
    /// Matches of those
    #[arg(long, value_delimiter = ',', default_values_t = [100, 1000], requires = "pure_outliers")]
    pub n: Vec<usize>,
}

fn parse_sigma(text: &str) -> Result<f64, String> {
    let mend = || format!("{text:?} is no standard deviation: write a number > 0, such as 0.03");
    let sigma: f64 = text.parse().map_err(|_| mend())?;
    if sigma > 0.0 && sigma.is_finite() { Ok(sigma) } else { Err(mend()) }
}

/// Solves, prints, writes. Returns whether no wrong answer was accepted.
///
/// # Errors
/// A folder, file or interpreter that cannot be used.
pub fn run(options: &Registration) -> anyhow::Result<bool> {
    let mut out = std::io::stdout().lock();
    let mut good = true;
    if let Some(folder) = &options.inputs {
        let files = files(folder, &options.filter)?;
        let peers = recorded(options, folder)?;
        let solved = solve_all(&files, options)?;
        let (measured, notes) = match &options.peer_python {
            Some(python) => peer::measure(python, &options.peer, options.sigma_max, &files)?,
            None => (Vec::new(), Vec::new()),
        };
        if let Some(path) = &options.csv {
            let rows = solved.iter().map(|s| &s.row).chain(&measured);
            std::fs::write(path, csv(rows)).with_context(|| path.display().to_string())?;
        }
        writeln!(
            out,
            "{} problems, σ_max {}\n\n{}",
            files.len(),
            options.sigma_max,
            table(&solved, &measured, peers.as_ref())
        )?;
        for note in notes {
            writeln!(out, "{note}")?;
        }
        good &= !solved.iter().any(|s| s.row.status == Status::Ok && s.row.is_wrong());
    }
    for (&refinement, &n) in options.weighting.iter().flat_map(|w| options.n.iter().map(move |n| (w, n))) {
        let Some(count) = options.pure_outliers else { break };
        let bar = progress_bar(u64::from(count), "problems without a true match")?;
        let alarms = outliers::measure(count, n, options.sigma_max, refinement, || bar.inc(1))?;
        bar.finish_and_clear();
        writeln!(out, "{}, {alarms}", refinement.solver())?;
        good &= alarms.accepted == 0;
    }
    Ok(good)
}

/// Every `.corr` file below a folder whose name contains `filter`, in order.
///
/// # Errors
/// A folder that cannot be read, or has no such file.
pub fn files(folder: &Path, filter: &str) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    let mut folders = vec![folder.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).with_context(|| folder.display().to_string())? {
            let entry = entry?;
            let path = entry.path();
            if entry.file_type()?.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|e| e == "corr")
                && entry.file_name().to_string_lossy().contains(filter)
            {
                found.push(path);
            }
        }
    }
    if found.is_empty() {
        bail!("{}: no .corr file{} below", folder.display(), if filter.is_empty() { "" } else { " of that filter" });
    }
    found.sort();
    Ok(found)
}

fn recorded(options: &Registration, folder: &Path) -> anyhow::Result<Option<Peers>> {
    let beside = folder.parent().map(|parent| parent.join("peers.csv")).filter(|path| path.is_file());
    // A file that is named must be there; one that happens to lie there is welcome.
    options.peers.clone().or(beside).map(|path| Peers::read(&path)).transpose()
}

fn solve_all(files: &[PathBuf], options: &Registration) -> anyhow::Result<Vec<Solved>> {
    let bar = progress_bar((files.len() * options.weighting.len()) as u64, "problems")?;
    let mut solved = Vec::new();
    for path in files {
        let corr = corr::read(path).with_context(|| path.display().to_string())?;
        for &refinement in &options.weighting {
            solved.push(solve(&corr, options.sigma_max, refinement).with_context(|| path.display().to_string())?);
            bar.inc(1);
        }
    }
    bar.finish_and_clear();
    Ok(solved)
}

fn csv<'r>(rows: impl Iterator<Item = &'r Row>) -> String {
    let mut text = format!("{HEADER}\n");
    for row in rows {
        let _ = writeln!(text, "{row}");
    }
    text
}

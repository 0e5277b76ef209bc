//! Real logs, cut into robots and played through the cores: what merges, what was ever wrong, and how far off the maps
//! are, by truths that came with the logs.

pub mod errors;
pub mod find;
pub mod judge;
pub mod mrclam;
pub mod reference;
mod row;
pub mod track;

use super::cpu::thread_seconds;
use crate::bar::progress_bar;
use crate::wires::{Wires, play, play_lossy};
use anyhow::anyhow;
use clap::Args;
use find::{Set, find};
use merganser_recording::Recording;
use merganser_recording::import::LOG_ROBOTS_MAX;
use reference::Reference;
use row::{COLUMNS, NOTE, Row};
use std::io::Write;
use std::path::{Path, PathBuf};
use track::Track;

/// Share of the messages and questions that lossy wires lose.
const LOSS: f64 = 0.2;

/// What to measure.
#[derive(Debug, Args)]
pub struct Logs {
    /// Folder that is looked through: NAME.clf or NAME.log (.bz2, .xz) with NAME.gt.tum or NAME.relations (.xz) beside
    /// it, MRCLAM's logs, 7-Scenes, LiDAR scans with poses, recordings with truth.csv
    #[arg(long, value_name = "DIR")]
    pub data: PathBuf,
    /// Robots that a laser log is cut into
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(2..=LOG_ROBOTS_MAX as i64))]
    pub robots: u8,
    /// Only sets whose name contains this
    #[arg(long, value_name = "TEXT")]
    pub only: Option<String>,
    /// The seed of the cores and of the losses
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Writes the rows here, too
    #[arg(long, value_name = "FILE")]
    pub csv: Option<PathBuf>,
}

/// Plays every set on perfect and on lossy wires, and prints a row each. Returns whether nothing was ever wrong and all
/// merged that should.
///
/// # Errors
/// Data that cannot be used.
pub fn run(options: &Logs) -> anyhow::Result<bool> {
    let (mut sets, left_out) = find(&options.data)?;
    sets.retain(|set| options.only.as_ref().is_none_or(|only| set.name.contains(only)));
    if sets.is_empty() {
        let why = "holds nothing that can be played and judged (see --help)";
        return Err(anyhow!(
            "{}: {why}{}",
            options.data.display(),
            left_out.iter().map(|l| format!("\n  {l}")).collect::<String>()
        ));
    }
    let mut out = std::io::stdout().lock();
    left_out.iter().try_for_each(|why| writeln!(out, "left out: {why}"))?;
    let mut csv = options.csv.as_ref().map(std::fs::File::create).transpose()?;
    if let Some(csv) = &mut csv {
        writeln!(csv, "{}", COLUMNS.join(","))?;
    }
    let bar = progress_bar(2 * sets.len() as u64, "plays")?;
    let (mut good, mut played) = (true, 0);
    for set in &sets {
        let scratch = tempfile::tempdir()?;
        let prepared = match prepared(set, scratch.path(), usize::from(options.robots)) {
            Ok(prepared) => prepared,
            Err(error) => {
                bar.suspend(|| writeln!(out, "left out: {error:#}"))?;
                continue;
            }
        };
        played += 1;
        for remark in &prepared.remarks {
            bar.suspend(|| writeln!(out, "{}: {remark}", set.name))?;
        }
        for loss in [None, Some(LOSS)] {
            let play = play_set(&prepared.recordings, options.seed, loss)?;
            let row = Row::of(set, loss, &prepared, &play);
            bar.inc(1);
            bar.suspend(|| row.print(&mut out))?;
            if let Some(csv) = &mut csv {
                writeln!(csv, "{}", row.fields().join(","))?;
            }
            good &= row.is_good();
        }
    }
    bar.finish_and_clear();
    if played == 0 {
        return Err(anyhow!("{}: nothing that was found could be played", options.data.display()));
    }
    writeln!(out, "{NOTE}")?;
    Ok(good)
}

/// The robots of a set, and their truth.
struct Prepared {
    recordings: Vec<Recording>,
    reference: Option<Reference>,
    tracks: Vec<Track>,
    /// What was amiss with the data.
    remarks: Vec<String>,
}

fn prepared(set: &Set, scratch: &Path, robots: usize) -> anyhow::Result<Prepared> {
    let made = set.recordings(scratch, robots)?;
    let reference = Reference::of(set)?;
    let tracks = Track::all(set, &made.recordings, reference.as_ref())?;
    if tracks.iter().all(|track| track.anchors.is_empty()) {
        return Err(anyhow!("{}: nothing tells where its robots truly were", set.path.display()));
    }
    let remarks = made.remarks.into_iter().chain(reference.iter().flat_map(|r| r.remarks.clone())).collect();
    Ok(Prepared { recordings: made.recordings, reference, tracks, remarks })
}

/// A finished play.
struct Played {
    wires: Wires,
    cpu_s: f64,
}

fn play_set(recordings: &[Recording], seed: u64, loss: Option<f64>) -> anyhow::Result<Played> {
    let before = thread_seconds();
    let wires = match loss {
        None => play(recordings, seed),
        Some(loss) => play_lossy(recordings, seed, loss),
    };
    Ok(Played { wires: wires.map_err(|error| anyhow!(error))?, cpu_s: thread_seconds() - before })
}

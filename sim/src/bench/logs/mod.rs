//! Real logs, cut into robots and played through the cores: what merges, what was ever wrong, and how far off the maps
//! are, by truths that came with the logs.

mod errors;
mod find;
mod judge;
mod reference;
mod track;

use super::cpu::thread_seconds;
use super::table::median;
use crate::bar::progress_bar;
use crate::wires::{Wires, play, play_lossy};
use anyhow::anyhow;
use clap::Args;
use find::{Set, TruthFile, find, is_planar};
use judge::{Errors, Judge, Judged, TRUTH};
use merganser_recording::Recording;
use merganser_recording::import::LOG_ROBOTS_MAX;
use reference::Reference;
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

/// Names of the columns.
const COLUMNS: [&str; 26] = [
    "set",
    "wires",
    "robots",
    "keyframes",
    "stated",
    "agreed",
    "used",
    "false_agreed",
    "false_used",
    "overlapping",
    "merged",
    "seconds",
    "fell_apart",
    "wrong",
    "wrong_secs",
    "worst_m",
    "unjudged",
    "within_m",
    "within_deg",
    "between_m",
    "between_deg",
    "nees_pairs",
    "nees_anchors",
    "bytes",
    "cpu_s",
    "verdict",
];

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
        let (recordings, reference, tracks) = match prepared(set, scratch.path(), usize::from(options.robots)) {
            Ok(prepared) => prepared,
            Err(error) => {
                bar.suspend(|| writeln!(out, "left out: {error:#}"))?;
                continue;
            }
        };
        played += 1;
        for loss in [None, Some(LOSS)] {
            let play = play_set(&recordings, options.seed, loss)?;
            let row = Row::of(set, loss, &tracks, reference.as_ref(), &recordings, &play);
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
fn prepared(
    set: &Set,
    scratch: &Path,
    robots: usize,
) -> anyhow::Result<(Vec<Recording>, Option<Reference>, Vec<Track>)> {
    let recordings = set.recordings(scratch, robots)?;
    let reference = Reference::of(set)?;
    let tracks = Track::all(set, &recordings, reference.as_ref())?;
    Ok((recordings, reference, tracks))
}

const NOTE: &str = "wrong: a stated relation of two robots was off by more than 1 m or its claimed 99.9 % (truth: 0.05 m, \
                    0.01 rad); merged: of pairs with 10 m of common way or more, at the end, by both; errors: means";

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

/// What is printed of one play.
struct Row {
    set: String,
    wires: String,
    robots: Vec<String>,
    keyframes: usize,
    judged: Judged,
    cpu_s: f64,
}

impl Row {
    fn of(
        set: &Set,
        loss: Option<f64>,
        tracks: &[Track],
        reference: Option<&Reference>,
        recordings: &[Recording],
        played: &Played,
    ) -> Self {
        let truth = if set.truth == TruthFile::Recorded { (0.0, 0.0) } else { TRUTH };
        let judge = Judge { tracks, planar: recordings.iter().all(is_planar), truth };
        let (mut judged, views) = judge.judge(&played.wires);
        [judged.within, judged.between] = errors::errors(tracks, reference, &views);
        Self {
            set: set.name.clone(),
            wires: loss.map_or_else(|| "perfect".into(), |loss| format!("{:.0} % lost", 100.0 * loss)),
            robots: tracks.iter().map(|track| track.robot.clone()).collect(),
            keyframes: tracks.iter().map(|track| track.stamps.len()).sum(),
            judged,
            cpu_s: played.cpu_s,
        }
    }

    /// Pairs that truly overlap, and those of them that are merged.
    fn overlapping(&self) -> [usize; 2] {
        let pairs = || self.judged.pairs.values().filter(|pair| pair.overlap_secs.is_some());
        [pairs().count(), pairs().filter(|pair| pair.merged).count()]
    }

    fn wrong(&self) -> usize {
        self.judged.pairs.values().map(|pair| pair.wrong).sum()
    }

    fn fell_apart(&self) -> usize {
        self.judged.pairs.values().map(|pair| pair.fell_apart).sum()
    }

    fn is_good(&self) -> bool {
        let [overlapping, merged] = self.overlapping();
        self.wrong() == 0 && self.judged.falsely[1] == 0 && merged == overlapping
    }

    fn verdict(&self) -> &'static str {
        let [overlapping, merged] = self.overlapping();
        match (self.is_good(), merged == overlapping) {
            (true, _) => "good",
            (false, true) => "WRONG",
            (false, false) if self.wrong() > 0 || self.judged.falsely[1] > 0 => "WRONG, in pieces",
            (false, false) => "in pieces",
        }
    }

    /// In the order of [`COLUMNS`].
    fn fields(&self) -> Vec<String> {
        let Judged { alignments, falsely, pairs, unjudged, .. } = &self.judged;
        let [overlapping, merged] = self.overlapping();
        let waits = pairs.values().filter_map(|pair| Some((pair.merged_secs? - pair.overlap_secs?).max(0.0)));
        let mean =
            |errors: &Errors, pick: fn(&(f64, f64)) -> f64| errors.iter().map(pick).sum::<f64>() / errors.len() as f64;
        let share = |all: &[f64]| all.iter().sum::<f64>() / all.len() as f64;
        let Judged { within, between, nees_pairs, nees_anchors, bytes, .. } = &self.judged;
        let counts = [alignments[0], alignments[1], alignments[2], falsely[0], falsely[1], overlapping, merged];
        let mut fields = vec![self.set.clone(), self.wires.clone()];
        fields.extend([self.robots.len(), self.keyframes].map(|n| n.to_string()));
        fields.extend(counts.map(|n| n.to_string()));
        fields.push(format!("{:.0}", median(waits.collect())));
        fields.extend([self.fell_apart(), self.wrong()].map(|n| n.to_string()));
        fields.push(format!("{:.0}", pairs.values().map(|pair| pair.wrong_secs).sum::<f64>()));
        fields.push(format!("{:.2}", pairs.values().map(|pair| pair.worst_m).fold(0.0, f64::max)));
        fields.push(unjudged.to_string());
        for errors in [within, between] {
            fields.push(format!("{:.3}", mean(errors, |error| error.0)));
            fields.push(format!("{:.2}", mean(errors, |error| error.1)));
        }
        fields.extend([nees_pairs, nees_anchors].map(|all| format!("{:.2}", share(all))));
        fields.extend([bytes.to_string(), format!("{:.1}", self.cpu_s), self.verdict().into()]);
        fields
    }

    fn print(&self, out: &mut impl Write) -> std::io::Result<()> {
        let fields = self.fields();
        let of = |name: &str| COLUMNS.iter().position(|column| *column == name).map_or("", |k| fields[k].as_str());
        writeln!(
            out,
            "{} ({}): {}\n  {} keyframes of {} robots, {} bytes sent, {} s of one core\n  alignments: {} stated, {} \
             agreed ({} false), {} used ({} false)\n  pairs that overlap: {}, merged {}, {} s later (median); fell apart \
             {} times\n  ever wrong: {} statements, {} s in all, {} m at worst ({} not judged)\n  relations: within one \
             robot {} m {} deg of {}, between robots {} m {} deg of {}\n  NEES per degree of freedom: pairs {} of {}, \
             anchors {} of {}",
            of("set"),
            of("wires"),
            of("verdict"),
            of("keyframes"),
            of("robots"),
            of("bytes"),
            of("cpu_s"),
            of("stated"),
            of("agreed"),
            of("false_agreed"),
            of("used"),
            of("false_used"),
            of("overlapping"),
            of("merged"),
            of("seconds"),
            of("fell_apart"),
            of("wrong"),
            of("wrong_secs"),
            of("worst_m"),
            of("unjudged"),
            of("within_m"),
            of("within_deg"),
            self.judged.within.len(),
            of("between_m"),
            of("between_deg"),
            self.judged.between.len(),
            of("nees_pairs"),
            self.judged.nees_pairs.len(),
            of("nees_anchors"),
            self.judged.nees_anchors.len(),
        )?;
        for ((a, b), pair) in &self.judged.pairs {
            let secs = |secs: Option<f64>| secs.map_or_else(|| "never".into(), |secs| format!("{secs:.0} s"));
            writeln!(
                out,
                "    {} {}: overlap {}, merged {}, {} at the end; wrong {} times, {:.0} s; at worst {:.2} m, {:.1} deg, \
                 {:.2} of the claimed 99.9 %",
                self.robots[*a],
                self.robots[*b],
                secs(pair.overlap_secs),
                secs(pair.merged_secs),
                pair.status.map_or_else(|| "unknown".into(), |status| format!("{status:?}").to_lowercase()),
                pair.wrong,
                pair.wrong_secs,
                pair.worst_m,
                pair.worst_deg,
                pair.worst_claim,
            )?;
        }
        self.judged.false_ones.iter().try_for_each(|one| writeln!(out, "    false: {one}"))?;
        out.flush()
    }
}

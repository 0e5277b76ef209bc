//! `merganser-sim bench`: how good and how fast the estimators are, as tables (MATH §4 and §5).

mod anchors;
pub mod calibration;
pub mod corr;
pub mod cpu;
mod fit;
pub mod flood;
pub mod frames;
pub mod gossip;
pub mod graph;
pub mod liars;
pub mod logs;
pub mod mission;
pub mod outliers;
pub mod peer;
pub mod peers;
pub mod places;
pub mod registration;
pub mod row;
pub mod share;
pub mod solve;
pub mod table;

use crate::bar::progress_bar;
use clap::Subcommand;
use std::io::Write;

/// What to measure.
#[derive(Debug, Subcommand)]
pub enum Bench {
    /// Correspondence-level consensus on a folder of .corr files: success, errors, honesty and time, beside peers
    ///
    /// A file holds matched points, most of them wrong, and the truth. Times are of the processor, per solve, so other
    /// work on the machine counts little; ratios are the peer's time over ours. Exit code 1 if a wrong answer was
    /// accepted, 2 if a file or option cannot be used.
    Registration(registration::Registration),
    /// Gossip of facts in large swarms: time until all hold the same, and bytes, beside a plain gossip
    ///
    /// Robots hold real replicas of signed facts; radio, motion and time are simulated. Exit code 1 if a swarm did not
    /// converge in the time its case allows.
    Gossip(gossip::Gossip),
    /// The joint estimate's solver on g2o graphs: minima, certificates, covariances and time, beside GTSAM
    ///
    /// Exit code 1 if a graph did not converge, was not certified, or missed its known optimum; 2 if a file cannot be
    /// used.
    Graph(graph::GraphBench),
    /// Seeing the same place on recorded data: alignments, candidates, bytes and time, beside KISS-Matcher
    ///
    /// Alignments are one way: one submap's keypoints against the other's features. Times are of the processor. Exit
    /// code 1 if a wrong alignment was accepted or fewer were found than promised, 2 if the data cannot be used.
    Places(places::Places),
    /// Pose graphs split among robots who share their measurements: bytes sent until all have the whole optimum
    ///
    /// Exit code 1 if a robot's minimum is not that of the whole graph (1e-9), or robots differ; 2 if a file cannot be
    /// used.
    Share(share::Share),
    /// A flood of unknown ids: how much slower honest robots converge, and how much memory it takes
    ///
    /// The same swarm of real agents runs without and with 10,000 messages of strangers a second at two of its robots,
    /// for 60 s; its halves heal meanwhile. Exit code 1 if it is more than twice as slow, or grows by 16 MB.
    Flood(flood::Flood),
    /// Robots that drive for minutes: when they merge, how far off their map is, and what they send
    ///
    /// Scans are ray-cast, so this takes a while: about twice the time driven, for ten robots. Exit code 1 if robots
    /// that see the same take more than 60 s to merge, the map errs by more than 1.1 times that of a solver given every
    /// true loop, or a robot sends more than 1 kB/s.
    Mission(mission::Mission),
    /// Whether frames, submaps and live poses of simulated swarms are as uncertain as they say
    ///
    /// Alignments are made up, and err as much as they say. Exit code 1 if a mean normalised error lies outside of 0.93
    /// to 1.07 times its degrees of freedom.
    Calibration(calibration::Calibration),
    /// Members that lie of themselves, one to three of eight: what becomes of the honest, and who is named
    ///
    /// Each swarm runs without and with them. Exit code 1 if honest pairs are farther off than they say, or an
    /// honest robot is named.
    Liars(liars::Liars),
    /// Real logs, cut into robots and played through the cores: merges, errors, what was ever wrong, bytes and time
    ///
    /// Each set is played on perfect wires and on such that lose a fifth of all messages. Exit code 1 if a relation of
    /// two robots was ever wrong, a false alignment is used, or robots with 10 m of common way did not merge; 2 if the
    /// data cannot be used.
    Logs(logs::Logs),
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
/// Files that cannot be used, standard output that cannot be written.
pub fn run(bench: Bench) -> anyhow::Result<bool> {
    match bench {
        Bench::Registration(options) => registration::run(&options),
        Bench::Gossip(options) => gossip::run(&options),
        Bench::Graph(options) => graph::run(&options),
        Bench::Places(options) => places::run(&options),
        Bench::Share(options) => share::run(&options),
        Bench::Flood(options) => flood::run(&options),
        Bench::Mission(options) => mission::run(&options),
        Bench::Calibration(options) => calibration::run(&options),
        Bench::Liars(options) => liars::run(&options),
        Bench::Logs(options) => logs::run(&options),
        Bench::Frames { seeds, first } => frames(first, seeds),
    }
}

fn frames(first: u64, seeds: u64) -> anyhow::Result<bool> {
    let cells = frames::cells();
    let bar = progress_bar(cells.len() as u64 * seeds, "worlds")?;
    let measure = |cell| frames::measure(cell, first..first + seeds, || bar.inc(1));
    let measured: Vec<_> = cells.iter().map(measure).collect();
    bar.finish_and_clear();
    write!(std::io::stdout().lock(), "{}", frames::table(&cells, &measured))?;
    Ok(cells.iter().zip(&measured).all(|(cell, tally)| cell.shortfall(tally).is_none()))
}

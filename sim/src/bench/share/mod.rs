//! `merganser-sim bench share`: a pose graph split among robots, who tell each other their measurements over the
//! simulated network and each solve the whole (DESIGN §7). A measurement is sent to each peer once, within a signed
//! entry of a real replica, so that what counts is bytes: everything sent, by everybody, until all hold everything.

mod pack;

use super::gossip::share;
use crate::bar::progress_bar;
use anyhow::{Context, bail, ensure};
use clap::Args;
use merganser_protocol::estimate::posegraph::g2o::Parser;
use merganser_protocol::estimate::posegraph::solve::Start;
use merganser_protocol::estimate::posegraph::{Measurement, PoseGraph};
use merganser_protocol::replica::Replica;
use merganser_protocol::wire::Entry;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};

/// Kind of the entries: one that robots carry without reading it.
const KIND: u8 = 200;
/// Iterations after which a minimisation gives up.
const ITERATIONS_MAX: usize = 100;
/// How near each robot's minimum must be to the one of the whole graph, as a share of it.
const EXACT: f64 = 1e-9;
/// Bytes of one measurement that are taken as the measure.
const PLAIN_LEN: usize = 80;

/// `bench share`.
#[derive(Debug, Args)]
pub struct Share {
    /// Pose graphs (g2o)
    #[arg(required = true, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Robots; each has a stretch of the poses
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u8).range(2..=100))]
    robots: u8,
    /// Messages lost, in per cent
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u8).range(0..=90))]
    loss: u8,
    /// The seed of the network
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Measures and prints. Returns whether every robot of every swarm found the optimum of the whole graph, and all the
/// same to the bit.
///
/// # Errors
/// Files that cannot be used, standard output that cannot be written.
pub fn run(options: &Share) -> anyhow::Result<bool> {
    let bar = progress_bar(options.files.len() as u64, "graphs")?;
    let mut out = std::io::stdout().lock();
    writeln!(
        out,
        "{:<28} {:>6} {:>6} {:>8} {:>10} {:>10} {:>10} {:>8} {:>10} {:>6}",
        "graph", "poses", "meas.", "entries", "sent kB", "80 B kB", "control kB", "after s", "χ²/opt - 1", "equal"
    )?;
    let mut good = true;
    for file in &options.files {
        let row = measure(file, options).with_context(|| file.display().to_string())?;
        bar.suspend(|| writeln!(out, "{row}"))?;
        good &= row.is_good();
        bar.inc(1);
    }
    bar.finish_and_clear();
    writeln!(
        out,
        "sent: every byte that anybody sent until all {} robots held everything, {} % of messages lost; 80 B: each \
         measurement to each peer once at {PLAIN_LEN} bytes; equal: all robots found the same, to the bit",
        options.robots, options.loss
    )?;
    Ok(good)
}

struct Row {
    name: String,
    poses: usize,
    measurements: usize,
    entries: usize,
    sent: usize,
    control: usize,
    plain: usize,
    after: Option<f64>,
    excess: f64,
    equal: bool,
}

impl Row {
    fn is_good(&self) -> bool {
        self.after.is_some() && self.equal && self.excess.abs() <= EXACT
    }
}

impl core::fmt::Display for Row {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        write!(
            f,
            "{:<28} {:>6} {:>6} {:>8} {:>10.1} {:>10.1} {:>10.1} {:>8} {:>10.1e} {:>6}",
            self.name,
            self.poses,
            self.measurements,
            self.entries,
            self.sent as f64 / 1e3,
            self.plain as f64 / 1e3,
            self.control as f64 / 1e3,
            self.after.map_or_else(|| "never".to_owned(), |secs| format!("{secs:.1}")),
            self.excess,
            if self.equal { "yes" } else { "NO" }
        )
    }
}

fn measure(file: &Path, options: &Share) -> anyhow::Result<Row> {
    let graph = read(file)?;
    let optimum = minimum(&graph)?.0;
    let robots = usize::from(options.robots);
    let payloads = split(&graph, robots)?;
    let entries = payloads.iter().map(Vec::len).sum();
    let shared = share(payloads, KIND, f64::from(options.loss) / 100.0, options.seed)?;
    let mut minima = Vec::new();
    for replica in &shared.replicas {
        minima.push(minimum(&gathered(replica)?)?);
    }
    let worst = minima
        .iter()
        .map(|(chi2, _)| chi2 / optimum - 1.0)
        .fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
    Ok(Row {
        name: file.file_stem().map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
        poses: graph.poses.len(),
        measurements: graph.measurements.len(),
        entries,
        sent: shared.data + shared.control,
        control: shared.control,
        plain: graph.measurements.len() * PLAIN_LEN * (robots - 1),
        after: shared.equal_after,
        excess: worst,
        equal: minima.windows(2).all(|two| two[0] == two[1]),
    })
}

/// χ² and the poses' numbers, to the bit.
fn minimum(graph: &PoseGraph) -> anyhow::Result<(f64, Vec<u64>)> {
    let start = graph.start(Start::Relaxed, ITERATIONS_MAX)?;
    let solved = graph.minimise(&start, ITERATIONS_MAX)?;
    ensure!(solved.converged, "the minimisation did not converge");
    let numbers = |pose: &merganser_protocol::geometry::Se3| -> Vec<u64> {
        pose.translation.iter().copied().chain(pose.rotation.xyzw()).map(f64::to_bits).collect()
    };
    Ok((solved.chi2, solved.values.iter().flat_map(numbers).collect()))
}

/// Each robot's payloads: it has a stretch of the poses, and the measurements that begin there.
fn split(graph: &PoseGraph, robots: usize) -> anyhow::Result<Vec<Vec<Vec<u8>>>> {
    let poses = graph.poses.len();
    let owner: BTreeMap<u64, usize> = graph.poses.keys().enumerate().map(|(k, id)| (*id, k * robots / poses)).collect();
    let mut own: Vec<Vec<&Measurement>> = vec![Vec::new(); robots];
    for m in &graph.measurements {
        own[owner[&m.i]].push(m);
    }
    own.into_iter().map(pack::pack).collect()
}

/// The graph that a robot holds.
fn gathered(replica: &Replica) -> anyhow::Result<PoseGraph> {
    let mut graph = PoseGraph::default();
    for (_, bytes) in replica.entries() {
        graph.measurements.extend(pack::unpack(Entry::decode(bytes)?.payload())?);
    }
    graph.poses = graph.measurements.iter().flat_map(|m| [(m.i, None), (m.j, None)]).collect();
    Ok(graph)
}

fn read(file: &Path) -> anyhow::Result<PoseGraph> {
    let mut parser = Parser::default();
    parser.begin();
    for line in BufReader::new(File::open(file)?).lines() {
        parser.line(&line?)?;
    }
    let graph = parser.finish();
    if graph.planar {
        bail!("a planar graph; give one in space");
    }
    Ok(graph)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dice::Dice;
    use merganser_protocol::estimate::posegraph::{g2o, isotropic_weights};
    use merganser_protocol::geometry::{Se3, So3};
    use nalgebra::{Matrix6, Vector3, Vector6};

    /// A noisy walk of three laps, with closures to the lap before.
    fn laps(poses: u64, lap: u64) -> PoseGraph {
        let mut dice = Dice::new(8, "laps");
        let mut graph = PoseGraph { poses: (0..poses).map(|k| (k, None)).collect(), ..PoseGraph::default() };
        let information = Matrix6::from_diagonal_element(100.0);
        let (kappa, tau) = isotropic_weights(&information).unwrap();
        let turn = core::f64::consts::TAU / lap as f64;
        let step = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, turn)), Vector3::new(1.0, 0.0, 0.0));
        let mut add = |i: u64, j: u64, truth: Se3| {
            let t_i_j = truth.retract(&Vector6::from_fn(|_, _| 0.05 * dice.normal()));
            let printed = t_i_j.rotation.matrix();
            graph.measurements.push(Measurement { i, j, t_i_j, printed, information, kappa, tau, line: 0 });
        };
        for k in 1..poses {
            add(k - 1, k, step);
            if k >= lap {
                add(k - lap, k, Se3::identity());
            }
        }
        graph
    }

    #[test]
    fn every_robot_finds_the_optimum_of_the_whole() {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), g2o::write(&laps(90, 30))).unwrap();
        for loss in [0, 30] {
            let options = Share { files: vec![], robots: 3, loss, seed: 4 };
            let row = measure(file.path(), &options).unwrap();
            assert!(row.is_good(), "{row}");
            assert_eq!((row.poses, row.measurements), (90, 149));
            assert!(row.sent > 2 * 40 * 149, "{row}");
            let other = Row { equal: false, ..measure(file.path(), &options).unwrap() };
            assert!(!other.is_good() && !Row { equal: true, excess: -2e-9, ..other }.is_good());
        }
    }
}

//! The joint estimate's solver on benchmark graphs: minima, certificates, covariances and time, beside GTSAM.

mod ate;
mod draws;
mod files;
mod kimera;
mod measure;
mod peer;
mod peer_marginals;
mod peer_robust;
mod scale;
mod spoil;
mod swarm;
mod table;

use crate::bar::progress_bar;
use clap::Args;
use std::io::Write;
use std::path::PathBuf;

/// What to solve and beside whom.
#[derive(Debug, Args)]
pub struct GraphBench {
    /// Folder of g2o graphs, searched through; a folder of robots' files is one graph. Certified optima come from the
    /// optima.csv in it
    #[arg(long, value_name = "DIR", required_unless_present_any = ["scale", "kimera"])]
    pub data: Option<PathBuf>,
    /// Instead of files, a swarm of so many robots and anchors each, which then grows anchor by anchor: batch solve,
    /// covariances, single updates, memory. Exit code 1 if the grown estimate is not that of a batch solve
    #[arg(long, value_name = "ROBOTSxANCHORS", conflicts_with_all = ["data", "spoil", "peer_python"])]
    pub scale: Option<scale::Size>,
    /// Instead, a folder of Kimera-Multi's measurement tables: what is used of their closures beside the weights that
    /// are recorded in them, and where the two differ most. Exit code 1 if the robots do not share one frame
    #[arg(long, value_name = "DIR", conflicts_with_all = ["data", "scale", "spoil", "peer_python"])]
    pub kimera: Option<PathBuf>,
    /// Only graphs whose name contains this
    #[arg(long, value_name = "STR", default_value = "")]
    pub filter: String,
    /// Measure GTSAM on the same graphs, in this Python interpreter; with --spoil, its GNC and PCM. Where it fails on a
    /// graph, that is told and the bench goes on
    #[arg(long, value_name = "PYTHON")]
    pub peer_python: Option<PathBuf>,
    /// Replace this share of the closures between robots by random ones, %, and solve robustly instead. Exit code 1 if
    /// closures or poses of any graph are worse than those of a solver that is told which are true, by the bounds
    /// printed
    #[arg(long, value_name = "PERCENT", value_parser = clap::value_parser!(u32).range(0..=99))]
    pub spoil: Option<u32>,
    /// Draw every measurement anew around the solution so many times, with the noise that the graph states, and tell
    /// whether the covariances are honest; 300 tell it to a few per cent
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=100_000), conflicts_with_all = ["spoil", "peer_python", "scale", "kimera"])]
    pub draws: Option<u32>,
    /// The seed that the random closures, the draws, or the swarm come from
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Solves of each kind; the fastest counts, for us and for the peer
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u8).range(1..=20))]
    pub repeats: u8,
}

/// Solves, prints. Returns whether every graph with a known optimum was solved to it and certified.
///
/// # Errors
/// A folder, file or interpreter that cannot be used.
pub fn run(options: &GraphBench) -> anyhow::Result<bool> {
    if let Some(size) = options.scale {
        let (text, is_good) = scale::run(size, options.seed)?;
        write!(std::io::stdout().lock(), "{text}")?;
        return Ok(is_good);
    }
    if let Some(folder) = &options.kimera {
        let (text, is_good) = kimera::run(folder)?;
        write!(std::io::stdout().lock(), "{text}")?;
        return Ok(is_good);
    }
    let Some(data) = &options.data else { anyhow::bail!("give --data or --scale") };
    let optima = files::optima(data)?;
    let sources = files::find(data, &optima, &options.filter)?;
    options.peer_python.as_deref().map_or(Ok(()), peer::expect)?;
    let bar = progress_bar(sources.len() as u64, "graphs")?;
    if let Some(percent) = options.spoil {
        let mut rows = Vec::new();
        for source in &sources {
            rows.extend(spoil::measure(source, percent, options.seed, options.peer_python.as_deref())?);
            bar.inc(1);
        }
        bar.finish_and_clear();
        write!(std::io::stdout().lock(), "{}", spoil::table(percent, options.seed, &rows))?;
        return Ok(rows.iter().all(spoil::Spoiled::is_good));
    }
    if let Some(draws) = options.draws {
        let mut rows = Vec::new();
        for source in &sources {
            rows.extend(draws::measure(source, draws, options.seed)?);
            bar.inc(1);
        }
        bar.finish_and_clear();
        write!(std::io::stdout().lock(), "{}", draws::table(draws, options.seed, &rows))?;
        return Ok(rows.iter().all(draws::Drawn::is_good));
    }
    let mut rows = Vec::new();
    for source in &sources {
        let mut graph = source.read()?;
        let isotropic = !graph.has_covariances();
        if isotropic {
            graph = graph.isotropic();
        }
        let measured = measure::measure(&graph, options.repeats)?;
        let peer = match options.peer_python.as_deref().zip(source.one_file()).filter(|_| !isotropic) {
            Some((python, file)) => peer::or_told(peer::measure(python, file, options.repeats), &source.name),
            None => None,
        };
        let is_small = graph.poses.len() <= peer_marginals::GRAPH_POSES_MAX && !graph.planar;
        let marginals = match options.peer_python.as_deref().filter(|_| is_small && !isotropic) {
            Some(python) => peer_marginals::difference(python, &source.name, &graph, &measured.values)?,
            None => None,
        };
        let (name, optimum) = (source.name.clone(), optima.get(&source.name).copied());
        rows.push(table::Row { name, optimum, isotropic, measured, peer, marginals });
        bar.inc(1);
    }
    bar.finish_and_clear();
    write!(std::io::stdout().lock(), "{}", table::table(&rows))?;
    Ok(rows.iter().all(table::Row::is_good))
}

#[cfg(all(test, unix))]
mod tests {
    use super::*;
    use std::fs;
    use std::os::unix::fs::PermissionsExt;

    /// A chain of three poses, and a peer that is there and fails on every graph.
    #[test]
    fn a_peer_that_fails_on_a_graph_ends_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let edge =
            |i: u32| format!("EDGE_SE3:QUAT {i} {} 1 0 0 0 0 0 1 9 0 0 0 0 0 9 0 0 0 0 9 0 0 0 9 0 0 9 0 9\n", i + 1);
        let vertex = |i: u32| format!("VERTEX_SE3:QUAT {i} {i} 0 0 0 0 0 1\n");
        let text: String = (0..3).map(vertex).chain((0..2).map(edge)).collect();
        fs::write(dir.path().join("chain.g2o"), text).unwrap();
        let python = dir.path().join("python");
        let peer = |body: &str| {
            fs::write(&python, format!("#!/bin/sh\n{body}\n")).unwrap();
            fs::set_permissions(&python, fs::Permissions::from_mode(0o755)).unwrap();
            let options = GraphBench {
                data: Some(dir.path().to_owned()),
                scale: None,
                kimera: None,
                filter: String::new(),
                peer_python: Some(python.clone()),
                spoil: None,
                draws: None,
                seed: 1,
                repeats: 1,
            };
            run(&options)
        };
        assert!(peer("[ \"$2\" = \"import gtsam\" ]").unwrap());
        assert!(peer("exit 1").unwrap_err().to_string().contains("pip install gtsam"));
    }
}

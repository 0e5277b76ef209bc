//! Seeing the same place on recorded data: alignments of submaps that overlap and of such that do not, candidates by
//! their summaries, bytes and time, beside KISS-Matcher. The sets and rules are those the design was measured on: ten
//! submaps of five depth images of one room (7-Scenes), five LiDAR scans along a street (KITTI 07), five of another
//! (KITTI 00), each in a frame of random orientation; and the way of a planar laser through an office building (aces).

mod aces;
mod candidates;
mod files;
mod measure;
mod peer;
mod sets;
mod table;

use crate::bar::progress_bar;
use clap::Args;
use merganser_protocol::config::UP_SIGMA_RANGE_RAD;
use std::io::Write;
use std::path::PathBuf;

/// What to measure.
#[derive(Debug, Args)]
pub struct Places {
    /// Folder that holds rgbd_7scenes, lidar_gtsam_points, kitti00_scans, kitti_poses_lidar and lidar2d_radish
    #[arg(long, value_name = "DIR")]
    pub data: PathBuf,
    /// Keypoints sent one way: 330, and the address of further ones, are 7.0 kB
    #[arg(long, default_value_t = 330, value_parser = clap::value_parser!(u16).range(16..=1024))]
    pub keypoints: u16,
    /// The first seed of the random orientations
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Runs, each with the next seed
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=100))]
    pub runs: u64,
    /// Tell each submap which way is up, with a draw of this standard deviation, rad, about each horizontal axis. What
    /// is up in the depth camera's world is taken from its walls and floor
    #[arg(long, value_name = "RAD", value_parser = sigma_rad)]
    pub gravity: Option<f64>,
    /// Measure KISS-Matcher on the same LiDAR pairs, in this Python interpreter
    #[arg(long, value_name = "PYTHON")]
    pub peer_python: Option<PathBuf>,
    /// KISS-Matcher's voxel, m; its own default is 0.3
    #[arg(long, default_value_t = 0.3)]
    pub peer_voxel: f64,
}

fn sigma_rad(text: &str) -> Result<f64, String> {
    let sigma: f64 = text.parse().map_err(|error: core::num::ParseFloatError| error.to_string())?;
    if UP_SIGMA_RANGE_RAD.contains(&sigma) { Ok(sigma) } else { Err("use 0.001 to 0.5".into()) }
}

/// Measures and prints. Returns whether as much was found as promised, and no more wrong accepted (nothing, but of the
/// planar laser).
///
/// # Errors
/// Data or an interpreter that cannot be used.
pub fn run(options: &Places) -> anyhow::Result<bool> {
    let mut good = true;
    for seed in options.seed..options.seed + options.runs {
        let sets = sets::load(&options.data, usize::from(options.keypoints), options.gravity, seed)?;
        let bar = progress_bar(measure::pairs(&sets).len() as u64, "pairs")?;
        let tried = measure::all(&sets, || bar.inc(1))?;
        bar.finish_and_clear();
        let peers = match &options.peer_python {
            Some(python) => peer::measure(python, options.peer_voxel, &sets, &tried)?,
            None => Vec::new(),
        };
        let dense = &sets::dense(&options.data, usize::from(options.keypoints), seed)?;
        let outcome = table::Outcome { seed, sets: &sets, tried: &tried, peers: &peers, dense };
        write!(std::io::stdout().lock(), "{outcome}")?;
        good &= outcome.is_good();
    }
    Ok(good)
}

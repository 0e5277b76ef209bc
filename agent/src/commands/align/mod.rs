//! `merganser align A B`: two clouds, or submaps of recordings, aligned as two robots would, with what one needs to
//! understand a missing merge: the transform with its covariance, what supports it, or why there is none.

mod report;
mod side;

use super::BadInput;
use super::topics::Topics;
use crate::picture;
use anyhow::{Context, Result};
use merganser_protocol::agent::job::{AlignJob, Measured, Refused};
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::geometry::Relative;
use merganser_protocol::wire::fact::ScaleKind;
use merganser_recording::manifest::CloudFormat;
use side::Side;
use std::path::PathBuf;

/// What `merganser align` can be told.
#[derive(Clone, Debug, clap::Args)]
#[command(
    after_help = "A and B are clouds (.ply, .pcd, .bin) or keyframes as messages (.json), points in the sensor's or \
                        body's frame, or submaps of recordings and ROS bags: FOLDER, or FOLDER:7 for its eighth. t_a_b maps coordinates in B into A.\n\
                        Exit codes: 0 aligned, 1 not, 2 the command line or a file is wrong."
)]
pub struct AlignArgs {
    /// The one.
    pub a: PathBuf,
    /// The other.
    pub b: PathBuf,
    /// What made the points: points_3d (a depth camera), lidar_3d, laser_2d, landmarks or landmarks_2d (a .ply with the
    /// properties cxx to czz). Without it, what a recording says; of clouds, what their extent suggests.
    #[arg(long, value_name = "SENSOR", value_parser = sensor)]
    pub sensor: Option<Sensor>,
    /// Whether A and B are in metres, or each in a unit of its own (of one camera): the scale is then estimated, too.
    #[arg(long, value_name = "metric|unknown", value_parser = scale)]
    pub scale: Option<ScaleKind>,
    /// Clouds are made of several views, or their sensor was not at their origin: nothing is concluded from what it must
    /// have looked through (a recording knows it), so that places that look alike are told apart less often. Surfaces are still taken to face the
    /// origin: it must lie on the side from which most of both were seen, or else within them.
    #[arg(long)]
    pub fused: bool,
    /// Thinning, m: about a hundredth of the range. Without it, what a recording says or the clouds' extent suggests.
    #[arg(long, value_name = "M", value_parser = length)]
    pub voxel: Option<f64>,
    /// Largest noise of matched points, m; 1.5 voxels without it.
    #[arg(long, value_name = "M", value_parser = length)]
    pub sigma_max: Option<f64>,
    /// How clouds are stored, if their names do not tell: ply, pcd, kitti-bin or xyz-bin.
    #[arg(long, value_name = "FORMAT", value_parser = format)]
    pub format: Option<CloudFormat>,
    /// Topics of bags.
    #[command(flatten)]
    pub topics: Topics,
    /// Seed of the sampler.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub seed: u64,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
    /// Draw both, apart and aligned, as .png or .svg.
    #[arg(long, value_name = "FILE")]
    pub picture: Option<PathBuf>,
}

fn sensor(text: &str) -> Result<Sensor, String> {
    match text {
        "points_3d" => Ok(Sensor::Points3d),
        "lidar_3d" => Ok(Sensor::Lidar3d),
        "laser_2d" => Ok(Sensor::Laser2d),
        "landmarks" => Ok(Sensor::Landmarks),
        "landmarks_2d" => Ok(Sensor::Landmarks2d),
        _ => Err("use points_3d, lidar_3d, laser_2d, landmarks or landmarks_2d".into()),
    }
}

fn scale(text: &str) -> Result<ScaleKind, String> {
    match text {
        "metric" => Ok(ScaleKind::Metric),
        "unknown" => Ok(ScaleKind::Unknown),
        _ => Err("use metric or unknown".into()),
    }
}

fn length(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(metres) if (1e-3..=100.0).contains(&metres) => Ok(metres),
        _ => Err("use 0.001 to 100 m".into()),
    }
}

fn format(text: &str) -> Result<CloudFormat, String> {
    match text {
        "ply" => Ok(CloudFormat::Ply),
        "pcd" => Ok(CloudFormat::Pcd),
        "kitti-bin" => Ok(CloudFormat::KittiBin),
        "xyz-bin" => Ok(CloudFormat::XyzBin),
        _ => Err("use ply, pcd, kitti-bin or xyz-bin".into()),
    }
}

/// What came of it.
struct Outcome {
    config: Config,
    sides: [Side; 2],
    found: Result<Measured, Refused>,
    fused: bool,
    picture: Option<PathBuf>,
}

/// Aligns, tells what was found, and whether anything was.
///
/// # Errors
/// A file or an argument that cannot be used, or a picture that cannot be written.
pub fn run(args: &AlignArgs) -> Result<bool> {
    let picture = args.picture.as_ref().map(|path| ending(path).map(|png| (path, png))).transpose()?;
    let sources = [side::read(&args.a, args)?, side::read(&args.b, args)?];
    if args.fused && !sources.iter().any(side::Source::is_cloud) {
        return Err(BadInput::told("--fused is for clouds; a recording knows what its sensor saw from where"));
    }
    let config = side::config(&sources, args)?;
    let [a, b] = sources;
    let sides = [a.describe(&config, args.fused)?, b.describe(&config, args.fused)?];
    let found = look(&sides, &config, args.seed);
    let mut outcome = Outcome { config, sides, found, fused: args.fused, picture: None };
    if let Some((path, png)) = picture {
        let svg = picture::draw(&report::scene(&outcome));
        let bytes = if png { picture::png(&svg, 1.0)? } else { svg.into_bytes() };
        std::fs::write(path, bytes).with_context(|| format!("cannot write {}", path.display()))?;
        outcome.picture = Some(path.clone());
    }
    super::say(&if args.json { report::json(&outcome)? } else { report::text(&outcome) })?;
    Ok(outcome.found.is_ok())
}

/// Whether a picture is to be a PNG, by its name.
fn ending(path: &std::path::Path) -> Result<bool> {
    match path.extension().map(|ending| ending.to_ascii_lowercase()) {
        Some(ending) if ending == "png" => Ok(true),
        Some(ending) if ending == "svg" => Ok(false),
        _ => Err(BadInput::told(format!("--picture {}: name a file that ends in .png or .svg", path.display()))),
    }
}

/// Both ways, as a robot looks at two submaps of its own: what each finds of the other must agree.
fn look([a, b]: &[Side; 2], config: &Config, seed: u64) -> Result<Measured, Refused> {
    let job = AlignJob {
        theirs: b.keypoints.clone(),
        mine: a.features.clone(),
        back: Some((a.keypoints.clone(), b.features.clone())),
        config: config.align.clone(),
        voxel_m: config.submap.voxel_m,
        sensor: config.submap.sensor,
        verticals: None,
        scale: config.submap.scale,
        seed,
    };
    job.look()
}

/// `t_a_b`, if it was found.
fn t_a_b(outcome: &Outcome) -> Option<&Relative> {
    outcome.found.as_ref().ok().map(|measured| &measured.t_mine_theirs)
}

//! ROS bags become recordings: a bag each, or robots in one bag by the first part of their topics' names; a bag of
//! one robot alone is cut into three by time, as a laser's log is, or left whole. Keyframes are chosen by motion.
//! Covariances are those that the odometry states, where it states any.

use super::Writer;
use super::carmen::{STEP_M, STEP_RAD, driven};
use super::cut::NAMES;
use super::deal::{Deal, deal};
use super::error::{Problem, RecordingError, on};
use super::import::ROBOTS_MAX;
use super::import_laser::planar;
use super::unmeasured::of_body;
use crate::manifest::{CloudFormat, FORMAT, Manifest, VERSION};
use merganser_protocol::config::{Config, Sensor};
use merganser_protocol::geometry::{Covariance, CovarianceError, PoseWithCovariance, Se3};
use merganser_protocol::ids::{NAME_LEN_MAX, Name};
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::Stamp;
use merganser_ros::bag::{Bag, Flow};
use merganser_ros::join::{JoinError, Joined, Placed, Posed, Tally, Wanted, choose, gather};
use nalgebra::{Matrix6, Vector3};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Robots that a bag of one is cut into.
pub(super) const ROBOTS: usize = 3;
/// Clouds that reach farther are taken for a LiDAR's, m.
const CAMERA_REACH_M: f64 = 10.0;
/// Points of a cloud that tells what kind of sensor it is: the first ones of one that warms up hold none, or a few.
const TELLING_MIN: usize = 64;
/// Points of a planar laser lie in a plane to this, m: what single precision leaves of a scan.
const FLAT_M: f32 = 1e-3;
/// Side of the cubes in which a reach is counted, m: sensors see most points near.
const CELL_M: f64 = 0.25;
/// A keyframe of a LiDAR is taken after this way, m, or this turn, rad...
const LIDAR_STEP: (f64, f64) = (1.0, 0.2);
/// ...and one of a depth camera.
const CAMERA_STEP: (f64, f64) = (0.1, 0.1);
/// Standard deviations of odometry in space that states none: each axis, m, a share of the way and so much besides...
const WAY: (f64, f64) = (0.05, 0.01);
/// ...and of rotation, rad, per metre and per rad turned and so much besides.
const ROTATION: (f64, f64, f64) = (0.01, 0.05, 0.002);

/// Submaps that a robot should have at least, so that three alignments can be found...
const SUBMAPS_PER_ROBOT: f64 = 4.0;
/// ...of so many keyframes each.
const KEYFRAMES_MIN: f64 = 4.0;

/// What is to become of a bag of one robot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Single {
    /// So many robots, by time.
    Cut(usize),
    /// One recording.
    Whole,
}

/// One robot of a bag.
struct Source<'a> {
    bag: &'a Bag,
    joined: Joined,
    name: String,
    /// When all robots of the bag begin, if there are several.
    begins: Option<i64>,
}

/// Writes a recording for each robot of these bags into `out`, and returns what there is to say of them.
pub(super) fn import(
    bags: &[PathBuf],
    out: &Path,
    wanted: &Wanted,
    single: Single,
) -> Result<Vec<String>, RecordingError> {
    let mut remarks = Vec::new();
    let opened = bags.iter().map(|path| Bag::open(path)).collect::<Result<Vec<_>, _>>()?;
    let mut sources: Vec<Source<'_>> = Vec::new();
    for bag in &opened {
        let told = |error: JoinError| of_bag(bag, error);
        let choices = choose(bag.topics(), wanted).map_err(told)?;
        if sources.len() + choices.len() > ROBOTS_MAX {
            let why = format!("more than {ROBOTS_MAX} robots; choose some by --odometry and --cloud");
            return Err(Problem::Data(why).of(bag.path()));
        }
        let robots = gather(bag, &choices).map_err(told)?;
        remarks.extend(bag.damage().told().into_iter().map(|told| about(bag, &told)));
        let begins = robots.iter().filter_map(|joined| joined.clouds.first()).map(|first| first.stamp_ns).min();
        let begins = begins.filter(|_| robots.len() > 1);
        for joined in robots {
            let name = joined.choice.namespace.clone().unwrap_or_else(|| stem(bag.path()));
            let name = unused(&name, sources.iter().map(|source| source.name.as_str()));
            sources.push(Source { bag, joined, name, begins });
        }
    }
    for source in &sources {
        let told = match (single, sources.len()) {
            (Single::Cut(robots), 1) => source.cut(out, robots)?,
            _ => source.write(out)?,
        };
        remarks.extend(told.into_iter().map(|told| about(source.bag, &told)));
    }
    Ok(remarks)
}

fn about(bag: &Bag, told: &str) -> String {
    format!("{}: {told}", bag.path().file_name().unwrap_or_default().to_string_lossy())
}

fn of_bag(bag: &Bag, error: JoinError) -> RecordingError {
    match error {
        JoinError::Bag(error) => error.into(),
        error => {
            let error = Box::new(error);
            match bag.damage().told().join("; ") {
                told if told.is_empty() => Problem::Join(error),
                told => Problem::Damaged { error, told },
            }
            .of(bag.path())
        }
    }
}

/// The name of a file or folder without its ending.
fn stem(path: &Path) -> String {
    let name = if path.is_dir() { path.file_name() } else { path.file_stem() };
    name.unwrap_or_default().to_string_lossy().into_owned()
}

/// A robot's name from a namespace or the name of a file, not one of those that there are.
fn unused<'a>(text: &str, others: impl Iterator<Item = &'a str>) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() || c == '-' { c.to_ascii_lowercase() } else { '_' };
    let mut name: String = text.chars().map(allowed).take(NAME_LEN_MAX).collect();
    if name.is_empty() {
        name.push_str("robot");
    }
    let others: BTreeSet<&str> = others.collect();
    let numbered = |number: usize| {
        let end = format!("_{number}");
        name.chars().take(NAME_LEN_MAX - end.len()).collect::<String>() + &end
    };
    let free = |name: &String| !others.contains(name.as_str());
    if free(&name) { name } else { (2..).map(numbered).find(free).unwrap_or_default() }
}

/// What suits a sensor.
struct Profile {
    sensor: &'static str,
    config: Config,
    /// Way, m, and turn, rad, after which a keyframe is taken.
    step: (f64, f64),
    /// Of a motion by odometry that states none.
    covariance: fn(&Se3) -> Result<Covariance<6>, CovarianceError>,
}

impl Profile {
    fn laser() -> Self {
        Self { sensor: "laser2d", config: planar(), step: (STEP_M, STEP_RAD), covariance: driven }
    }

    fn of_cloud(placed: &Placed) -> Self {
        let mut config = Config::default();
        config.submap.keyframes_max = 10;
        if is_flat(placed) {
            return Self::laser();
        }
        if reach(placed) <= CAMERA_REACH_M {
            config.submap.voxel_m = 0.05;
            return Self { sensor: "depth", config, step: CAMERA_STEP, covariance: moved };
        }
        config.submap.sensor = Sensor::Lidar3d;
        config.submap.voxel_m = 0.5;
        config.submap.distance_m = 10.0;
        Self { sensor: "lidar3d", config, step: LIDAR_STEP, covariance: moved }
    }

    /// Makes submaps so short that a robot that goes so far, m, has enough of them.
    fn shortened(mut self, way: f64) -> Self {
        let least = KEYFRAMES_MIN * self.step.0;
        let distance = &mut self.config.submap.distance_m;
        *distance = distance.min((way / SUBMAPS_PER_ROBOT).max(least));
        self
    }
}

/// Whether all points lie at one height of the body, as those of a planar laser do.
fn is_flat(placed: &Placed) -> bool {
    let first = placed.points.first().map_or(0.0, |point| point[2]);
    placed.points.iter().all(|point| (point[2] - first).abs() < FLAT_M)
}

/// How far the body went, m.
fn way(clouds: &[Posed]) -> f64 {
    clouds.windows(2).map(|two| (two[1].pose.translation - two[0].pose.translation).norm()).sum()
}

fn moved(motion: &Se3) -> Result<Covariance<6>, CovarianceError> {
    let (way, turn) = (motion.translation.norm(), motion.rotation.angle());
    let (t, r) = (WAY.0 * way + WAY.1, ROTATION.0 * way + ROTATION.1 * turn + ROTATION.2);
    Covariance::from_sigmas([t, t, t, r, r, r])
}

/// 90 % of the surface is nearer to the sensor, m.
fn reach(placed: &Placed) -> f64 {
    let from = placed.t_body_sensor.translation;
    let cell = |point: &[f32; 3]| (Vector3::from(point.map(f64::from)) - from).map(|x| (x / CELL_M).round() as i64);
    let cells: BTreeSet<[i64; 3]> = placed.points.iter().map(|point| cell(point).into()).collect();
    let mut far: Vec<f64> = cells.iter().map(|cell| CELL_M * Vector3::from(cell.map(|x| x as f64)).norm()).collect();
    far.sort_by(f64::total_cmp);
    far.get(far.len() * 9 / 10).copied().unwrap_or(0.0)
}

impl Source<'_> {
    /// By the first cloud with points enough to tell; else by the first that can be used.
    fn profile(&self) -> Result<Profile, RecordingError> {
        if self.joined.is_planar {
            return Ok(Profile::laser());
        }
        let mut profile = None;
        let looked = self.joined.read(
            self.bag,
            |_| true,
            |_, _, placed| -> Result<Flow, JoinError> {
                let is_telling = placed.points.len() >= TELLING_MIN;
                if is_telling || profile.is_none() {
                    profile = Some(Profile::of_cloud(&placed));
                }
                Ok(if is_telling { Flow::Stop } else { Flow::On })
            },
        );
        looked.map_err(|error| of_bag(self.bag, error))?;
        Ok(profile.unwrap_or_else(Profile::laser))
    }

    /// The whole way of one robot.
    fn write(&self, out: &Path) -> Result<Vec<String>, RecordingError> {
        let profile = self.profile()?;
        let all = 0..self.joined.clouds.len();
        let mut recorder = Recorder::begin(self, &profile, out, &self.name, String::new(), all)?;
        let tally = self.play(std::slice::from_mut(&mut recorder))?;
        let counts = recorder.finish()?;
        Ok(self.remarks(&tally, &[counts]))
    }

    /// The way of one robot as that of several.
    fn cut(&self, out: &Path, robots: usize) -> Result<Vec<String>, RecordingError> {
        let clouds = &self.joined.clouds;
        if clouds.len() < robots {
            let why = format!("holds {} clouds with a pose; {robots} robots need at least one each", clouds.len());
            return Err(Problem::Data(why).of(self.bag.path()));
        }
        let profile = self.profile()?.shortened(way(clouds) / robots as f64);
        let dealt: Deal = deal(clouds.iter().map(|posed| &posed.pose), robots);
        let begin = |(robot, name): (usize, &&str)| {
            Recorder::begin(self, &profile, out, name, format!("; {}", dealt.how(robot)), dealt.of(robot))
        };
        let recorders = NAMES.iter().take(robots).enumerate().map(begin);
        let mut recorders = recorders.collect::<Result<Vec<_>, _>>()?;
        let tally = self.play(&mut recorders)?;
        let counts = recorders.into_iter().map(Recorder::finish).collect::<Result<Vec<_>, _>>()?;
        Ok(self.remarks(&tally, &counts))
    }

    /// Reads the clouds of all recorders once.
    fn play(&self, recorders: &mut [Recorder<'_>]) -> Result<Tally, RecordingError> {
        let wanted: BTreeSet<usize> = recorders.iter().flat_map(|recorder| recorder.chosen.iter().copied()).collect();
        let each = |index: usize, posed: &Posed, placed: Placed| -> Result<Flow, Failed> {
            let of = recorders.iter_mut().filter(|recorder| recorder.chosen.contains(&index));
            for recorder in of {
                recorder.push(posed, &placed.points)?;
            }
            Ok(Flow::On)
        };
        self.joined.read(self.bag, |index| wanted.contains(&index), each).map_err(|failed| match failed {
            Failed::Join(error) => of_bag(self.bag, error),
            Failed::Write(error) => error,
        })
    }

    /// What there is to say.
    fn remarks(&self, clouds: &Tally, counts: &[Counts]) -> Vec<String> {
        let counted = |(reason, count): (&str, u64)| match count {
            1 => format!("1 message: {reason}"),
            count => format!("{count} messages: {reason}"),
        };
        let mut remarks: Vec<String> = self.joined.tally.reasons().map(counted).collect();
        let cloud = &self.joined.cloud;
        remarks
            .extend(clouds.reasons().map(|(reason, count)| format!("{count} keyframes of {cloud} left out: {reason}")));
        let silent: usize = counts.iter().map(|counts| counts.unstated).sum();
        let all: usize = counts.iter().map(|counts| counts.keyframes).sum();
        if silent > 0 {
            remarks.push(format!(
                "{} states no usable covariance at {silent} of {all} keyframes: motions count as known to what drives \
                 so, which is generous; let the driver state pose.covariance",
                self.joined.poses
            ));
        } else if counts.iter().any(|counts| counts.is_constant) {
            remarks.push(format!(
                "{} states one covariance for all poses, which says nothing of any motion: motions count as known to \
                 what drives so, which is generous; let the driver state a pose.covariance that grows along the way",
                self.joined.poses
            ));
        }
        remarks
    }
}

enum Failed {
    Join(JoinError),
    Write(RecordingError),
}

impl From<JoinError> for Failed {
    fn from(error: JoinError) -> Self {
        Self::Join(error)
    }
}

impl From<RecordingError> for Failed {
    fn from(error: RecordingError) -> Self {
        Self::Write(error)
    }
}

/// What became of a robot.
struct Counts {
    keyframes: usize,
    /// Keyframes whose odometry states no covariance that can be one.
    unstated: usize,
    /// Whether it states one for all poses.
    is_constant: bool,
}

/// A recording that is being made.
struct Recorder<'a> {
    writer: Writer,
    folder: PathBuf,
    profile: &'a Profile,
    joined: &'a Joined,
    /// Which of [`Joined::clouds`] are keyframes.
    chosen: BTreeSet<usize>,
    /// Whether the odometry states covariances of all of them, and not always the same.
    is_stated: bool,
    last: Option<Se3>,
    counts: Counts,
}

impl<'a> Recorder<'a> {
    fn begin(
        source: &'a Source<'_>,
        profile: &'a Profile,
        out: &Path,
        name: &str,
        how: String,
        given: impl Iterator<Item = usize>,
    ) -> Result<Self, RecordingError> {
        let folder = out.join(name);
        // What an earlier run left must not pass for part of this one.
        if folder.exists() {
            on(&folder, std::fs::remove_dir_all(&folder))?;
        }
        let joined = &source.joined;
        let chosen = apart(&joined.clouds, given, profile.step);
        let unstated = chosen.iter().filter(|index| stated(joined, &joined.clouds[**index]).is_none()).count();
        // One for all poses does not grow along the way, and is no chain; turned into the body's axes it would look
        // like one.
        let is_constant = joined.covariances.len() == 1 && chosen.len() > 1;
        let origin = format!(
            "ROS bag {}: {} (frame of the body: {}) by {}{how}",
            source.bag.path().file_name().unwrap_or_default().to_string_lossy(),
            joined.cloud,
            joined.body,
            joined.poses,
        );
        let manifest = Manifest {
            format: FORMAT.into(),
            version: VERSION,
            robot: Name::new(name).map_err(|error| Problem::Data(error.to_string()).of(&folder))?,
            sensor: profile.sensor.into(),
            covariance_of: CovarianceOf::Motion,
            clouds: CloudFormat::Ply,
            keyframes: 0,
            unit_m: None,
            begins_ns: source.begins,
            places: None,
            origin,
            config: profile.config.clone(),
        };
        let writer = Writer::create(&folder, manifest)?;
        let counts = Counts { keyframes: 0, unstated, is_constant };
        let is_stated = unstated == 0 && !is_constant;
        Ok(Self { writer, folder, profile, joined, is_stated, chosen, last: None, counts })
    }

    fn push(&mut self, posed: &Posed, points: &[[f32; 3]]) -> Result<(), RecordingError> {
        let (covariance_of, covariance) = match stated(self.joined, posed).filter(|_| self.is_stated) {
            Some(covariance) => (CovarianceOf::Pose, covariance),
            None => {
                let motion = self.last.map_or_else(Se3::identity, |last| last.inverse() * posed.pose);
                let covariance = (self.profile.covariance)(&motion);
                (CovarianceOf::Motion, covariance.map_err(|error| Problem::Covariance(error).of(&self.folder))?)
            }
        };
        let pose = PoseWithCovariance { pose: posed.pose, covariance };
        let keyframe = Keyframe {
            stamp: Stamp(posed.stamp_ns),
            session: None,
            pose,
            covariance_of,
            points: points.to_vec(),
            marks: Vec::new(),
            place: None,
            up: None,
        };
        self.writer.push(&keyframe, None)?;
        self.last = Some(posed.pose);
        self.counts.keyframes += 1;
        Ok(())
    }

    fn finish(self) -> Result<Counts, RecordingError> {
        if self.counts.keyframes == 0 {
            return Err(Problem::Data("no keyframe of this robot has points".into()).of(&self.folder));
        }
        self.writer.finish()?;
        Ok(self.counts)
    }
}

/// Those that lie so far apart.
fn apart(clouds: &[Posed], given: impl Iterator<Item = usize>, (way, turn): (f64, f64)) -> BTreeSet<usize> {
    let mut last: Option<&Se3> = None;
    let mut chosen = BTreeSet::new();
    for index in given {
        let pose = &clouds[index].pose;
        let is_near = last.is_some_and(|last| {
            let motion = last.inverse() * *pose;
            motion.translation.norm() < way && motion.rotation.angle() < turn
        });
        if !is_near {
            chosen.insert(index);
            last = Some(pose);
        }
    }
    chosen
}

/// The covariance of the body's pose, if the odometry states one. ROS states perturbations along and about the axes of
/// the odometry's frame, we along and about those of the body.
fn stated(joined: &Joined, posed: &Posed) -> Option<Covariance<6>> {
    let stated = joined.covariances.get(posed.covariance?)?;
    Covariance::new(of_body(&Matrix6::from_row_slice(stated), &posed.pose.rotation)).ok()
}

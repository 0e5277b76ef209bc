//! Whatever lies in a folder becomes recordings, one per robot: a folder of recordings as it is; 7-Scenes RGB-D
//! frames and LiDAR scans cut into robots by time; a planar laser's log, or a ROS bag of one robot, cut into robots
//! with its real odometry; ROS bags of several robots. A robot cut from frames or scans has a local frame of its own
//! (its first body pose) and a seeded drift on its true motion, and its manifest says so.

use super::cut::NAMES;
use super::error::{Problem, RecordingError, on};
use super::import_bag::Single;
use super::{KEYFRAMES, MANIFEST, Recording, import_bag, import_laser, import_lidar, import_mrclam, import_rgbd};
use merganser_ros::bag::{bags_in, kind_of};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

pub use super::import_laser::{log_name, read_log};
pub use merganser_ros::join::Wanted;

/// Robots in one data set at most: each becomes a process of its own.
pub const ROBOTS_MAX: usize = 16;

/// Robots that one log is cut into at most.
pub const LOG_ROBOTS_MAX: usize = NAMES.len();

/// What a folder holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Kind {
    /// Sub-folders that are recordings.
    Recordings,
    /// `frame-XXXXXX.depth.png`, `camera-intrinsics.txt`, `poses_all_1000.txt`.
    SevenScenes,
    /// `graph.txt` and `NNNNNN/points.bin`, a dump of GLIM, or `NNNNNN.bin` (`.pcd`, `.ply`) and `poses.txt`.
    Lidar,
    /// `*.mcap`, `*.db3`, `*.bag`, or folders of them with `metadata.yaml`: ROS bags.
    Bags,
    /// One `*.clf` or `*.log`, perhaps packed (`.bz2`, `.xz`): a planar laser's log.
    Carmen,
    /// `RobotN_Odometry.dat`, `RobotN_Measurement.dat` (or packed, `.xz`) and `Barcodes.dat`: robots among landmarks.
    Mrclam,
}

/// Tells what `folder` holds.
///
/// # Errors
/// [`Problem::Data`] if it is nothing known.
pub fn detect(folder: &Path) -> Result<Kind, RecordingError> {
    if folder.is_file() && kind_of(folder).is_some() {
        return Ok(Kind::Bags);
    }
    if folder.is_file() {
        let why =
            "one file alone is read if it is a ROS bag (.mcap, .db3, .bag); of all else give the folder that holds it";
        return Err(Problem::Data(why.into()).of(folder));
    }
    let entries = on(folder, folder.read_dir())?;
    let mut names: Vec<String> = entries.flatten().map(|entry| entry.file_name().to_string_lossy().into()).collect();
    names.sort();
    let any = |found: &dyn Fn(&str) -> bool| names.iter().any(|name| found(name));
    if any(&|name| name == MANIFEST) {
        let why = "this is the recording of one robot; a swarm needs a folder of at least two such folders";
        return Err(Problem::Data(why.into()).of(folder));
    }
    if any(&|name| folder.join(name).join(MANIFEST).is_file()) {
        return Ok(Kind::Recordings);
    }
    if any(&|name| name.ends_with(import_rgbd::DEPTH_SUFFIX)) {
        return Ok(Kind::SevenScenes);
    }
    if import_lidar::is_scans(folder, &names) {
        return Ok(Kind::Lidar);
    }
    if any(&|name| import_mrclam::robot(name).is_some()) {
        return Ok(Kind::Mrclam);
    }
    let logs = import_laser::logs(&names.iter().map(String::as_str).collect::<Vec<_>>());
    match (bags_in(folder)?.first(), logs.first()) {
        // Any program may have left a file.log beside its bag.
        (Some(bag), Some(log)) if import_laser::is_surely_log(log) => {
            let why = format!(
                "holds a ROS bag, {}, and a laser's log, {log}: give the bag itself, or a folder of one kind",
                bag.file_name().unwrap_or_default().to_string_lossy()
            );
            return Err(Problem::Data(why).of(folder));
        }
        (Some(_), _) => return Ok(Kind::Bags),
        (None, Some(_)) => return Ok(Kind::Carmen),
        (None, None) if import_lidar::is_dump(folder, &names) => return Ok(Kind::Lidar),
        (None, None) => {}
    }
    let why = format!(
        "nothing here can be fed to robots; expected folders with a {MANIFEST}, 7-Scenes frames (*{}), LiDAR scans \
         ({} with NNNNNN/points.bin, a dump of GLIM, or NNNNNN{}, .pcd or .ply with {}), a CARMEN log (*.clf or *.log, perhaps packed: \
         .bz2, .xz), MRCLAM logs (RobotN_Odometry.dat), or ROS bags (*.mcap, *.db3, *.bag)",
        import_rgbd::DEPTH_SUFFIX,
        import_lidar::GRAPH,
        import_lidar::SCAN_SUFFIX,
        import_lidar::POSES,
    );
    Err(Problem::Data(why).of(folder))
}

/// What became of a folder.
#[derive(Clone, Debug)]
pub struct Prepared {
    /// One per robot, sorted by the robots' names, which differ.
    pub recordings: Vec<Recording>,
    /// What was amiss with the data and could be mended, a sentence each; for whoever gave them.
    pub remarks: Vec<String>,
}

/// Opens the recordings in `data`, or makes them from it in `out` (a folder per robot) with drift from `seed`.
/// There are two to [`ROBOTS_MAX`].
///
/// # Errors
/// [`RecordingError`] for the first problem.
pub fn prepare(data: &Path, out: &Path, seed: u64) -> Result<Prepared, RecordingError> {
    prepare_topics(data, out, seed, &Wanted::default())
}

/// The same; of ROS bags by these topics.
///
/// # Errors
/// [`RecordingError`] for the first problem, one being that these are no bags, and topics are named.
pub fn prepare_topics(data: &Path, out: &Path, seed: u64, wanted: &Wanted) -> Result<Prepared, RecordingError> {
    let mut remarks = Vec::new();
    let kind = detect(data)?;
    if kind != Kind::Bags {
        refuse_topics(data, wanted)?;
    }
    let folder = match kind {
        Kind::Recordings => data,
        Kind::SevenScenes => {
            import_rgbd::import(data, out, seed)?;
            out
        }
        Kind::Lidar => {
            remarks = import_lidar::import(data, out, seed)?;
            out
        }
        Kind::Bags => {
            remarks = import_bag::import(&bags_of(data)?, out, wanted, Single::Cut(import_bag::ROBOTS))?;
            out
        }
        Kind::Carmen => {
            remarks = import_laser::import(data, out)?;
            out
        }
        Kind::Mrclam => {
            import_mrclam::import(data, out)?;
            out
        }
    };
    Ok(Prepared { recordings: open_all(folder)?, remarks })
}

/// Refuses named topics of what has none.
///
/// # Errors
/// [`Problem::Data`] if any is named.
pub fn refuse_topics(data: &Path, wanted: &Wanted) -> Result<(), RecordingError> {
    if *wanted == Wanted::default() {
        return Ok(());
    }
    Err(Problem::Data("this is no ROS bag; --odometry and --cloud name topics of one: leave them out".into()).of(data))
}

/// Whether it is a bag, or a folder of bags.
pub fn is_bag(path: &Path) -> bool {
    let is_other = path.join(MANIFEST).exists();
    !is_other && detect(path).is_ok_and(|kind| kind == Kind::Bags)
}

/// Makes a recording for each robot of a bag, or of a folder of bags, in `out` (a folder per robot). There are one to
/// [`ROBOTS_MAX`].
///
/// # Errors
/// [`RecordingError`] for the first problem.
pub fn prepare_bag(path: &Path, out: &Path, wanted: &Wanted) -> Result<Prepared, RecordingError> {
    let remarks = import_bag::import(&bags_of(path)?, out, wanted, Single::Whole)?;
    Ok(Prepared { recordings: open_some(out, 1)?, remarks })
}

fn bags_of(path: &Path) -> Result<Vec<PathBuf>, RecordingError> {
    if path.is_file() { Ok(vec![path.into()]) } else { Ok(bags_in(path)?) }
}

/// Cuts one laser log into so many robots, in `out` (a folder per robot). There are two to [`LOG_ROBOTS_MAX`].
///
/// # Errors
/// [`RecordingError`] for the first problem.
pub fn prepare_log(log: &Path, out: &Path, robots: usize) -> Result<Prepared, RecordingError> {
    if !(2..=LOG_ROBOTS_MAX).contains(&robots) {
        return Err(Problem::Data(format!("can be cut into 2 to {LOG_ROBOTS_MAX} robots, not {robots}")).of(log));
    }
    let remarks = import_laser::import_log(log, out, robots)?;
    Ok(Prepared { recordings: open_all(out)?, remarks })
}

/// Opens every recording in the sub-folders of `folder`.
///
/// # Errors
/// [`RecordingError`] for the first problem: one that cannot be read, two of the same robot, fewer than two.
pub fn open_all(folder: &Path) -> Result<Vec<Recording>, RecordingError> {
    open_some(folder, 2)
}

fn open_some(folder: &Path, least: usize) -> Result<Vec<Recording>, RecordingError> {
    let mut folders = Vec::new();
    for entry in on(folder, folder.read_dir())? {
        let path = on(folder, entry)?.path();
        // A robot whose manifest is missing must not be left out in silence.
        if path.join(MANIFEST).exists() || path.join(KEYFRAMES).exists() {
            folders.push(path);
        }
    }
    folders.sort();
    if !(least..=ROBOTS_MAX).contains(&folders.len()) {
        let why = format!("holds {} recordings; a swarm of 2 to {ROBOTS_MAX} robots can be played", folders.len());
        return Err(Problem::Data(why).of(folder));
    }
    let mut robots = BTreeMap::new();
    for path in folders {
        let recording = Recording::open(&path)?;
        if let Some(other) = robots.insert(recording.manifest().robot.clone(), recording) {
            let why =
                format!("robot = {:?} is also that of {}", other.manifest().robot.as_str(), other.folder().display());
            return Err(Problem::Data(why).of(path.join(MANIFEST)));
        }
    }
    Ok(robots.into_values().collect())
}

//! What a folder of LiDAR scans holds, and where the poses are. Dumps that tell too little are named, with what to give
//! instead.

use super::poses::Poses;
use super::{glim, kitti, times};
use crate::error::{Problem, RecordingError, on};
use crate::manifest::CloudFormat;
use merganser_protocol::geometry::Se3;
use merganser_protocol::time::Stamp;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Poses of a gtsam_points dump.
pub(crate) const GRAPH: &str = "graph.txt";
/// Poses of a KITTI sequence.
pub(crate) const POSES: &str = "poses.txt";
/// How KITTI's scans end.
pub(crate) const SCAN_SUFFIX: &str = ".bin";
/// How nuScenes' end, which are no PCD.
const NUSCENES_SUFFIX: &str = ".pcd.bin";
/// Points of a keyframe in a gtsam_points dump.
const POINTS: &str = "points.bin";
/// Folders in which scans lie: KITTI's, and those of pose graphs on top of LOAM and FAST-LIO.
const SCAN_FOLDERS: [&str; 3] = ["", "velodyne", "Scans"];
/// Other names of [`POSES`] that such pose graphs use.
const POSE_FILES: [&str; 2] = [POSES, "optimized_poses.txt"];
/// FAST-LIO's own files: clouds in its map's frame, and a log of its states.
const FAST_LIO: [&str; 2] = ["PCD", "Log/pos_log.txt"];

/// One scan with its pose.
pub(super) struct Frame {
    pub number: u64,
    /// If the time is known.
    pub stamp: Option<Stamp>,
    /// `t_world_lidar`.
    pub pose: Se3,
    pub source: PathBuf,
}

/// What a folder holds.
pub(super) struct Dump {
    pub format: CloudFormat,
    /// By their numbers.
    pub frames: Vec<Frame>,
    /// Poses that are stated.
    pub stated: usize,
    pub remarks: Vec<String>,
    /// Whether each cloud is a SLAM's submap.
    pub is_submaps: bool,
    /// Whether numbers of scans may count the turns of a LiDAR.
    pub are_turns: bool,
}

/// Whether scans lie in the folder, by the names of what does.
pub(crate) fn is_scans(folder: &Path, names: &[String]) -> bool {
    let is_own = |name: &String| *name == GRAPH || name.ends_with(SCAN_SUFFIX);
    names.iter().any(is_own) || names.iter().any(|name| is_submap(&folder.join(name)))
}

/// Whether clouds of other formats, or a dump that is to be named, lie in a folder that holds nothing else.
pub(crate) fn is_dump(folder: &Path, names: &[String]) -> bool {
    let is_cloud = |name: &String| format_of(name).is_some();
    names.iter().any(is_cloud)
        || folder.join("velodyne").is_dir()
        || folder.join("Scans").is_dir()
        || is_fast_lio(folder)
}

fn is_submap(folder: &Path) -> bool {
    folder.join(glim::FACTS).is_file() && folder.join(glim::POINTS).is_file()
}

fn is_fast_lio(folder: &Path) -> bool {
    if folder.join(FAST_LIO[1]).is_file() {
        return true;
    }
    let is_scans = |folder: &Path| {
        let names = folder.read_dir().into_iter().flatten().flatten().map(|entry| entry.file_name());
        names.map(|name| name.to_string_lossy().into_owned()).any(|name| {
            let middle = name.strip_prefix("scans").and_then(|name| name.strip_suffix(".pcd"));
            middle.is_some_and(|middle| middle.trim_start_matches('_').chars().all(|c| c.is_ascii_digit()))
        })
    };
    is_scans(folder) || is_scans(&folder.join(FAST_LIO[0]))
}

/// The format of a cloud by the end of its name.
fn format_of(name: &str) -> Option<CloudFormat> {
    let end = name.rsplit_once('.')?.1;
    match end.to_ascii_lowercase().as_str() {
        "pcd" => Some(CloudFormat::Pcd),
        "ply" => Some(CloudFormat::Ply),
        "bin" => Some(CloudFormat::KittiBin),
        _ => None,
    }
}

impl Dump {
    /// Finds and reads poses, and finds the scans.
    pub fn read(data: &Path) -> Result<Self, RecordingError> {
        let folders = numbered(data)?;
        let submaps: BTreeMap<u64, PathBuf> =
            folders.iter().filter(|(_, path)| is_submap(path)).map(|(k, path)| (*k, path.clone())).collect();
        if !submaps.is_empty() {
            return Self::of_glim(submaps);
        }
        if data.join(GRAPH).is_file() {
            return Self::of_graph(data, folders);
        }
        Self::of_scans(data)
    }

    fn of_glim(submaps: BTreeMap<u64, PathBuf>) -> Result<Self, RecordingError> {
        let mut frames: Vec<Frame> = Vec::new();
        for (number, folder) in submaps {
            let facts = folder.join(glim::FACTS);
            let (pose, stamp) = glim::read(&facts)?;
            if let Some(last) = frames.last().and_then(|last| last.stamp).filter(|last| *last >= stamp) {
                return Err(Problem::Unsorted { stamp: stamp.0, previous: last.0 }.of(facts));
            }
            frames.push(Frame { number, stamp: Some(stamp), pose, source: folder.join(glim::POINTS) });
        }
        let told = "GLIM's submaps: each is a cloud of several scans, put together as seen from the middle one, by poses \
                    that its loops have already corrected: what lies before a point counts as seen to be free, which \
                    refuses some pairs; a bag of its odometry and scans is truer";
        let (format, stated) = (CloudFormat::XyzBin, frames.len());
        Ok(Self { format, frames, stated, remarks: vec![told.into()], is_submaps: true, are_turns: false })
    }

    fn of_graph(data: &Path, folders: BTreeMap<u64, PathBuf>) -> Result<Self, RecordingError> {
        let points = |(k, path): (u64, PathBuf)| Some((k, path.join(POINTS))).filter(|(_, path)| path.is_file());
        let scans = folders.into_iter().filter_map(points).collect();
        let path = data.join(GRAPH);
        let mut poses = Poses::read(&path)?;
        let stated = poses.len();
        let mut remarks: Vec<String> = poses.order_told().into_iter().collect();
        remarks.extend(kitti::of_lidar(data, &path, &mut poses)?);
        let frames = poses.join(data, scans)?;
        remarks.extend(missing(&frames));
        Ok(Self { format: CloudFormat::XyzBin, frames, stated, remarks, is_submaps: false, are_turns: false })
    }

    fn of_scans(data: &Path) -> Result<Self, RecordingError> {
        let path = poses_of(data);
        if is_fast_lio(data) && path.is_none() {
            let why = "is a dump of FAST-LIO, whose clouds (PCD/scans*.pcd) lie in its map's frame, often many scans in \
                       one, and without a pose each; record its body-frame topics while it runs, and give that bag \
                       (--cloud /cloud_registered_body --odometry /Odometry, with scan_bodyframe_pub_en: true), or write \
                       each scan in the body's frame as NNNNNN.pcd and their poses as poses.txt";
            return Err(Problem::Data(why.into()).of(data));
        }
        for folder in SCAN_FOLDERS {
            let folder = if folder.is_empty() { data.to_path_buf() } else { data.join(folder) };
            if !folder.is_dir() {
                continue;
            }
            let Some(Clouds { format, by_number, remarks }) = clouds(&folder)? else { continue };
            let Some(path) = path else {
                let why = format!(
                    "holds scans but neither {GRAPH} nor {POSES}; state the pose of each scan in {POSES} (of a KITTI \
                     sequence NN copy poses/NN.txt to it, and {} beside it)",
                    kitti::CALIBRATION
                );
                return Err(Problem::Data(why).of(data));
            };
            let mut poses = Poses::read(&path)?;
            let stated = poses.len();
            let order = poses.order_told().into_iter().collect();
            let mut remarks = [remarks, order, kitti::of_lidar(data, &path, &mut poses)?].concat();
            let mut frames = poses.join(data, by_number)?;
            remarks.extend(missing(&frames));
            times::give(data, &mut frames)?;
            return Ok(Self { format, frames, stated, remarks, is_submaps: false, are_turns: true });
        }
        Err(Problem::Data(format!("holds no scans NNNNNN{SCAN_SUFFIX}, NNNNNN.pcd or NNNNNN.ply")).of(data))
    }
}

/// Says which scans are missing: whole steps that the others' usual one leaves out. A thinned sequence has a larger step,
/// and names that are times have uneven ones.
pub(super) fn missing(frames: &[Frame]) -> Option<String> {
    let steps: Vec<u64> = frames.windows(2).map(|two| two[1].number - two[0].number).collect();
    let mut sorted = steps.clone();
    sorted.sort_unstable();
    let usual = *sorted.get(sorted.len() / 2)?;
    let are_counted = 2 * steps.iter().filter(|step| **step == usual).count() > steps.len();
    let gaps: Vec<(usize, u64)> = steps.iter().copied().enumerate().filter(|(_, step)| step / usual >= 2).collect();
    let (after, _) = *gaps.first().filter(|_| are_counted)?;
    let count: u64 = gaps.iter().map(|(_, step)| step / usual - 1).sum();
    let (first, s) = (frames[after].number + usual, if count == 1 { " is" } else { "s are" });
    Some(format!(
        "{count} scan{s} missing between the others, the first {first:06}: the motion across is longer, and its error taken to \
         grow with the way"
    ))
}

/// The table of poses in a folder; KITTI's lies where the set keeps it, too.
fn poses_of(data: &Path) -> Option<PathBuf> {
    let beside = POSE_FILES.iter().map(|name| data.join(name)).find(|path| path.is_file());
    let of_set = || {
        let mut name = data.file_name()?.to_os_string();
        name.push(".txt");
        Some(data.parent()?.parent()?.join("poses").join(name)).filter(|path| path.is_file())
    };
    beside.or_else(of_set)
}

/// Numbered clouds of one format.
struct Clouds {
    format: CloudFormat,
    by_number: BTreeMap<u64, PathBuf>,
    /// What is left out.
    remarks: Vec<String>,
}

/// Numbered clouds in a folder; `None` if no clouds lie there.
fn clouds(folder: &Path) -> Result<Option<Clouds>, RecordingError> {
    let mut found: BTreeMap<u64, (CloudFormat, PathBuf)> = BTreeMap::new();
    let mut others = Vec::new();
    for entry in on(folder, folder.read_dir())? {
        let path = on(folder, entry)?.path();
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        if name.ends_with(NUSCENES_SUFFIX) {
            let why = format!(
                "is a scan of nuScenes, whose poses are in its tables (ego_pose.json, calibrated_sensor.json); number \
                 the scans of a scene 000000{SCAN_SUFFIX}, 000001{SCAN_SUFFIX}…, and write their poses to {POSES} as \
                 `index x y z qx qy qz qw`"
            );
            return Err(Problem::Data(why).of(path));
        }
        let (Some(format), Some((stem, _))) = (format_of(&name), name.rsplit_once('.')) else { continue };
        match stem.parse() {
            Ok(number) => insert(&mut found, number, (format, path), |(_, path)| path)?,
            Err(_) => others.push(name),
        }
    }
    others.sort();
    let Some(format) = found.values().next().map(|(format, _)| *format) else {
        let Some(other) = others.first() else { return Ok(None) };
        let why = format!(
            "holds clouds ({other}), but none with a number for a name; name them NNNNNN{SCAN_SUFFIX}, NNNNNN.pcd or \
             NNNNNN.ply"
        );
        return Err(Problem::Data(why).of(folder));
    };
    if let Some((_, path)) = found.values().find(|(other, _)| *other != format) {
        return Err(Problem::Data("is of another format than the other scans; give a folder of one".into()).of(path));
    }
    let told = |other| format!("{other}: left out (of {} such), since its name is no number", others.len());
    let remarks = others.first().map(told).into_iter().collect();
    Ok(Some(Clouds { format, by_number: found.into_iter().map(|(k, (_, path))| (k, path)).collect(), remarks }))
}

/// Folders by their number.
fn numbered(folder: &Path) -> Result<BTreeMap<u64, PathBuf>, RecordingError> {
    let mut found = BTreeMap::new();
    for entry in on(folder, folder.read_dir())? {
        let path = on(folder, entry)?.path();
        let number = path.file_name().unwrap_or_default().to_string_lossy().parse().ok();
        if let Some(number) = number.filter(|_| path.is_dir()) {
            insert(&mut found, number, path, |path| path)?;
        }
    }
    Ok(found)
}

/// Refuses a second of one number.
fn insert<T>(
    found: &mut BTreeMap<u64, T>,
    number: u64,
    new: T,
    path: impl Fn(&T) -> &PathBuf,
) -> Result<(), RecordingError> {
    let Some(other) = found.get(&number) else {
        found.insert(number, new);
        return Ok(());
    };
    let why = format!("has the number of {}, too; number each differently", path(other).display());
    Err(Problem::Data(why).of(path(&new)))
}

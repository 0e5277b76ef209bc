//! Where a log's body truly was: poses as published, or relations that people checked by hand, which become a way by
//! the graph solver: odometry, loosely, between the scans, and the relations.

use super::find::{Set, TruthFile};
use anyhow::{Context, anyhow};
use merganser_protocol::estimate::posegraph::solve::Start;
use merganser_protocol::estimate::posegraph::{Measurement, PoseGraph};
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::time::Stamp;
use merganser_recording::carmen::Log;
use merganser_recording::import::read_log;
use nalgebra::{Matrix6, Vector3, Vector6};
use std::collections::{BTreeMap, BTreeSet};
use std::io::Read;
use std::path::Path;

/// Between true poses that are farther apart by the wheels, m and rad together, nothing is known.
const APART_MAX: f64 = 3.0;
/// Standard deviations of wheels: along and across, a share of the way and so much besides, m; heading, rad, per metre,
/// per rad turned and so much besides. As the importer has them.
const WHEELS: [f64; 5] = [0.15, 0.02, 0.05, 0.15, 0.01];
/// Standard deviations of a relation: m and rad.
const RELATION: (f64, f64) = (0.03, 0.01);
/// Height (m) and tilt (rad) on a floor.
const OUT_OF_PLANE: (f64, f64) = (1e-3, 1e-4);
/// Stamps that differ by no more are the same, ns.
const SAME_NANOS: i64 = 1_000_000;
/// Steps of the solver at most.
const ITERATIONS_MAX: usize = 100;
/// Bytes of a file of truth at most.
const BYTES_MAX: u64 = 256 << 20;

/// How the body lay at one stamp, seen from another.
#[derive(Clone, Copy, Debug)]
pub struct Stated {
    /// The first stamp.
    pub from: Stamp,
    /// The second.
    pub to: Stamp,
    /// `t_from_to`.
    pub t_from_to: Se3,
}

/// A log's truth.
#[derive(Debug)]
pub struct Reference {
    /// The wheels' pose of every scan.
    pub odometry: BTreeMap<Stamp, Se3>,
    /// True poses of some of the scans, by the scan's own stamp: logs that were written in bursts have several within a
    /// millisecond, each turned on by a tenth of a radian.
    poses: BTreeMap<Stamp, Se3>,
    /// Relations that were published.
    pub relations: Vec<Stated>,
    /// What was amiss with the truth, a sentence each.
    pub remarks: Vec<String>,
}

impl Reference {
    /// Of a laser log; `None` for other sets.
    ///
    /// # Errors
    /// Files that cannot be used.
    pub fn of(set: &Set) -> anyhow::Result<Option<Self>> {
        let (path, is_tum) = match &set.truth {
            TruthFile::Tum(path) => (path, true),
            TruthFile::Relations(path) => (path, false),
            TruthFile::Mrclam | TruthFile::Recorded => return Ok(None),
        };
        let Log { scans, .. } = read_log(&set.path)?;
        let odometry: BTreeMap<Stamp, Se3> = scans.iter().map(|scan| (scan.stamp, scan.pose)).collect();
        let rows = rows(path)?;
        let all = rows.len();
        let reference = if is_tum {
            let of_scan = |row| {
                let (stamp, pose) = tum(row);
                Some((nearest(&odometry, stamp)?.0, pose))
            };
            let known: Vec<(Stamp, Se3)> = rows.iter().filter_map(of_scan).collect();
            let remarks = unknown(path, all - known.len(), all);
            let poses = known.into_iter().collect();
            Self { odometry, poses, relations: Vec::new(), remarks }
        } else {
            let relations = relations(&rows, &odometry);
            let poses = way(&odometry, &relations).with_context(|| path.display().to_string())?;
            let remarks = unknown(path, all - relations.len(), all);
            Self { odometry, poses, relations, remarks }
        };
        if reference.poses.is_empty() {
            return Err(anyhow!("{}: no line is of a stamp of {}", path.display(), set.path.display()));
        }
        Ok(Some(reference))
    }

    /// `t_world_body` at a scan's stamp: the true poses before and after it, and between them what the wheels say, mended
    /// so that it leads from one to the other; and how doubtful that is, m and rad together: what wheels err by from the
    /// nearer of the two, or how far off the body would be had it moved evenly, whichever is more. Logs repeat a pose of
    /// wheels for a scan of a body that has turned on meanwhile. `None` before the first, after the last, and where they
    /// are far apart.
    pub fn at(&self, stamp: Stamp) -> Option<(Se3, f64)> {
        let (stamp, here) = nearest(&self.odometry, stamp)?;
        let before = self.poses.range(..=stamp).next_back()?;
        if *before.0 == stamp {
            return Some((*before.1, self.doubt(stamp)));
        }
        let after = self.poses.range(stamp..).next()?;
        let (from, to) = (*self.odometry.get(before.0)?, *self.odometry.get(after.0)?);
        let near = moved(&from, &here).min(moved(&here, &to));
        let mended = mended([&from, &to], &here, [before.1, after.1]);
        let share = stamp.secs_since(*before.0) / after.0.secs_since(*before.0);
        let doubt = self.doubt(*before.0).max(self.doubt(*after.0));
        let evenly = moved(&mended, &before.1.interpolate(after.1, share));
        (moved(&from, &to) <= APART_MAX).then_some((mended, doubt.max(evenly).max(WHEELS[0] * near)))
    }

    /// How doubtful a true pose itself is, rad. A relation may be of the scan before or after the one that it names: half
    /// of what the body turns from the one to the other. On a straight way all poses are then early or late alike, which
    /// relations do not show. *Measured* on `aces`, whose relations name scans by their stamps: where the robot turns by
    /// 37° a second they have a scan's heading 5.9° off the scans three others of the same room were matched with, to
    /// 0.2°, by hand.
    fn doubt(&self, stamp: Stamp) -> f64 {
        let before = self.odometry.range(..stamp).next_back();
        let after = self.odometry.range(stamp..).find(|(s, _)| **s > stamp);
        let turns = before.zip(after).map_or(0.0, |((_, from), (_, to))| (from.inverse() * *to).rotation.angle());
        if self.relations.is_empty() { 0.0 } else { 0.5 * turns }
    }
}

/// How far a body moves, m, a radian counted as a metre.
pub fn moved(a: &Se3, b: &Se3) -> f64 {
    let between = a.inverse() * *b;
    between.translation.norm() + between.rotation.angle()
}

/// Where a body is that the wheels have at `here`, between two of their poses that are known better: as they say, from
/// either, the nearer the more.
pub fn mended(raw: [&Se3; 2], here: &Se3, known: [&Se3; 2]) -> Se3 {
    let [from, to] = [0, 1].map(|k| *known[k] * (raw[k].inverse() * *here));
    let (since, left) = (moved(raw[0], here), moved(here, raw[1]));
    if since + left > 0.0 { from.interpolate(&to, since / (since + left)) } else { from }
}

/// Lines that are of no scan of the log.
fn unknown(path: &Path, lines: usize, all: usize) -> Vec<String> {
    let told = || format!("{}: {lines} of {all} lines name no scan of the log; they are left out", path.display());
    (lines > 0).then(told).into_iter().collect()
}

/// The numbers of each line that is no remark.
fn rows(path: &Path) -> anyhow::Result<Vec<[f64; 8]>> {
    let mut rows = Vec::new();
    for (line, text) in text(path)?.lines().enumerate() {
        if text.trim().is_empty() || text.starts_with('#') {
            continue;
        }
        let numbers: Result<Vec<f64>, _> = text.split_ascii_whitespace().map(str::parse).collect();
        let numbers = numbers.ok().filter(|numbers| numbers.iter().all(|x| x.is_finite()));
        let row = numbers.and_then(|numbers| <[f64; 8]>::try_from(numbers).ok());
        rows.push(row.ok_or_else(|| anyhow!("{}:{}: eight numbers are due", path.display(), line + 1))?);
    }
    Ok(rows)
}

/// The text of a file, packed (`.xz`) or not.
///
/// # Errors
/// A file that cannot be read, or is no text.
pub fn text(path: &Path) -> anyhow::Result<String> {
    let read = || -> std::io::Result<String> {
        let file = std::fs::File::open(path)?;
        let mut text = String::new();
        if path.extension().is_some_and(|ending| ending == "xz") {
            let unpacked = lzma_rust2::XzReader::new(std::io::BufReader::new(file), true);
            unpacked.take(BYTES_MAX + 1).read_to_string(&mut text)?;
        } else {
            file.take(BYTES_MAX + 1).read_to_string(&mut text)?;
        }
        Ok(text)
    };
    let text = read().with_context(|| path.display().to_string())?;
    if text.len() as u64 > BYTES_MAX {
        return Err(anyhow!("{}: is longer than {BYTES_MAX} bytes; cut it", path.display()));
    }
    Ok(text)
}

fn stamp(seconds: f64) -> Stamp {
    Stamp((seconds * 1e6).round() as i64 * 1000)
}

fn planar(x: f64, y: f64, heading: f64) -> Se3 {
    Se3::new(So3::exp(&Vector3::new(0.0, 0.0, heading)), Vector3::new(x, y, 0.0))
}

fn tum(row: &[f64; 8]) -> (Stamp, Se3) {
    let [seconds, x, y, _, _, _, qz, qw] = *row;
    (stamp(seconds), planar(x, y, 2.0 * libm::atan2(qz, qw)))
}

/// The relations of scans of the log. Of a log that lost its stamps they name scans by their place in it, counted from 0,
/// and the scan of each place was found again by the odometry: that is so where all that they name are whole numbers,
/// none of which is a stamp.
fn relations(rows: &[[f64; 8]], odometry: &BTreeMap<Stamp, Se3>) -> Vec<Stated> {
    let stamps: Vec<Stamp> = odometry.keys().copied().collect();
    let stamped = |seconds: f64| nearest(odometry, stamp(seconds)).map(|(stamp, _)| stamp);
    let counted = |place: f64| stamps.get(place as usize).copied();
    let named = || rows.iter().flat_map(|row| [row[0], row[1]]);
    let by_place = named().all(|x| x >= 0.0 && x.fract() == 0.0) && named().all(|x| stamped(x).is_none());
    let relation = |row: &[f64; 8]| {
        let [from, to, x, y, _, _, _, yaw] = *row;
        let [from, to] = [from, to].map(|name| if by_place { counted(name) } else { stamped(name) });
        Some(Stated { from: from?, to: to?, t_from_to: planar(x, y, yaw) })
    };
    rows.iter().filter_map(relation).collect()
}

/// The scan of a stamp, which may be rounded differently.
pub fn nearest(odometry: &BTreeMap<Stamp, Se3>, stamp: Stamp) -> Option<(Stamp, Se3)> {
    let range = Stamp(stamp.0.saturating_sub(SAME_NANOS))..=Stamp(stamp.0.saturating_add(SAME_NANOS));
    odometry.range(range).min_by_key(|(s, _)| (s.0 - stamp.0).abs()).map(|(s, pose)| (*s, *pose))
}

/// The way that fits odometry and relations best.
fn way(odometry: &BTreeMap<Stamp, Se3>, relations: &[Stated]) -> anyhow::Result<BTreeMap<Stamp, Se3>> {
    let named: BTreeSet<Stamp> = relations.iter().flat_map(|r| [r.from, r.to]).collect();
    let nodes: Vec<(Stamp, Se3)> = named.iter().filter_map(|stamp| Some((*stamp, *odometry.get(stamp)?))).collect();
    if nodes.is_empty() {
        return Err(anyhow!("no line names two scans of the log, by their stamps or by their places in it"));
    }
    let number: BTreeMap<Stamp, u64> = nodes.iter().map(|(stamp, _)| *stamp).zip(0..).collect();
    let mut graph = PoseGraph { planar: true, ..PoseGraph::default() };
    graph.poses = nodes.iter().zip(0..).map(|((_, pose), k)| (k, Some(*pose))).collect();
    for (k, two) in nodes.windows(2).enumerate() {
        let t_i_j = two[0].1.inverse() * two[1].1;
        let (way, turn) = (t_i_j.translation.norm(), t_i_j.rotation.angle());
        let [share, least, per_m, per_rad, besides] = WHEELS;
        graph.measurements.push(measurement(
            [k as u64, k as u64 + 1],
            t_i_j,
            (share * way + least, per_m * way + per_rad * turn + besides),
        ));
    }
    for r in relations.iter().filter(|r| r.from != r.to) {
        graph.measurements.push(measurement([number[&r.from], number[&r.to]], r.t_from_to, RELATION));
    }
    let told = |error| anyhow!("the way that fits the relations cannot be found: {error}");
    let start = graph.start(Start::Relaxed, ITERATIONS_MAX).map_err(told)?;
    let solved = graph.minimise(&start, ITERATIONS_MAX).map_err(told)?;
    Ok(nodes.into_iter().map(|(stamp, _)| stamp).zip(solved.values).collect())
}

fn measurement([i, j]: [u64; 2], t_i_j: Se3, (metres, heading): (f64, f64)) -> Measurement {
    let (height, tilt) = OUT_OF_PLANE;
    let sigmas = Vector6::new(metres, metres, height, tilt, tilt, heading);
    let information = Matrix6::from_diagonal(&sigmas.map(|s| 1.0 / (s * s)));
    Measurement {
        i,
        j,
        t_i_j,
        printed: t_i_j.rotation.matrix().clone_owned(),
        information,
        kappa: 1.0 / (heading * heading),
        tau: 1.0 / (metres * metres),
        line: 0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn relations_name_scans_by_stamp_or_by_place() {
        let log = |begins: f64| -> BTreeMap<Stamp, Se3> {
            (0..9).map(|k| (stamp(begins + 0.44 * f64::from(k)), planar(f64::from(k), 0.0, 0.0))).collect()
        };
        let row = |from: f64, to: f64| [from, to, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let named = |rows: &[[f64; 8]], begins: f64| -> Vec<(Stamp, Stamp)> {
            relations(rows, &log(begins)).iter().map(|r| (r.from, r.to)).collect()
        };
        let second_and_fifth = (stamp(1000.44), stamp(1001.76));
        assert_eq!(named(&[row(1.0, 4.0), row(1.0, 90.0)], 1000.0), [second_and_fifth], "90 is beyond the log");
        assert_eq!(named(&[row(1000.44, 1001.76)], 1000.0), [second_and_fifth]);
        assert_eq!(named(&[row(1000.44, 1001.5)], 1000.0), []);
        // 0 is the first stamp of this log, so 3 is none of its.
        assert_eq!(named(&[row(0.0, 3.0)], 0.0), []);
        assert!(way(&log(0.0), &[]).unwrap_err().to_string().contains("no line names two scans"));
    }

    /// A scan is itself, and not another one half a millisecond away.
    #[test]
    fn scans_of_a_burst_are_told_apart() {
        let at = |k: i64| Stamp(k * 500_000);
        let pose = |k: i64| planar(0.0, 0.0, 0.1 * k as f64);
        let odometry: BTreeMap<Stamp, Se3> = (0..5).map(|k| (at(k), pose(k))).collect();
        let poses = [1, 3].map(|k| (at(k), pose(k))).into();
        let reference = Reference { odometry, poses, relations: Vec::new(), remarks: Vec::new() };
        for k in 1..4 {
            let (here, doubt) = reference.at(at(k)).unwrap();
            assert!(here.local(&pose(k)).norm() < 1e-9, "scan {k} is at {here:?}");
            assert!((doubt - if k == 2 { WHEELS[0] * 0.1 } else { 0.0 }).abs() < 1e-9, "scan {k}: {doubt}");
        }
        // A relation may be of the scan before or after.
        let relations = vec![Stated { from: at(1), to: at(3), t_from_to: pose(1).inverse() * pose(3) }];
        let related = Reference { relations, ..reference };
        assert!((related.at(at(1)).unwrap().1 - 0.1).abs() < 1e-9);
        let reference = Reference { relations: Vec::new(), ..related };
        // A stamp that was rounded otherwise is that of the nearest scan.
        assert!(reference.at(Stamp(at(3).0 + 200_000)).unwrap().0.local(&pose(3)).norm() < 1e-9);
        assert!(reference.at(at(0)).is_none() && reference.at(at(4)).is_none());
    }

    /// A robot turns by 0.4 rad in two seconds, and the wheels repeat their pose for the scan in between: it may be as
    /// wrong as half of that. Where the wheels turn with it, they err by their share of the way.
    #[test]
    fn a_scan_with_a_stale_pose_of_wheels_is_doubtful() {
        let truth: BTreeMap<Stamp, Se3> = [0.0, 2.0].map(|s| (stamp(s), planar(0.0, 0.0, 0.2 * s))).into();
        let doubt = |between: f64| {
            let turns = [(0.0, 0.0), (1.0, between), (2.0, 0.4)];
            let odometry = turns.map(|(s, turn)| (stamp(s), planar(0.0, 0.0, turn))).into();
            let reference = Reference { odometry, poses: truth.clone(), relations: Vec::new(), remarks: Vec::new() };
            reference.at(stamp(1.0)).unwrap().1
        };
        assert!(
            (doubt(0.0) - 0.2).abs() < 1e-9 && (doubt(0.2) - WHEELS[0] * 0.2).abs() < 1e-9,
            "{} {}",
            doubt(0.0),
            doubt(0.2)
        );
        assert!((doubt(0.1) - 0.1).abs() < 1e-9, "{}", doubt(0.1));
    }

    /// Wheels that turn too much by a tenth on a square are mended by what was checked by hand.
    #[test]
    fn relations_mend_the_odometry() {
        let step = |turn: f64| planar(0.5, 0.0, turn);
        let turn_at = |k: usize| if k % 10 == 9 { core::f64::consts::FRAC_PI_2 } else { 0.0 };
        let drive = |factor: f64| -> Vec<Se3> {
            let mut poses = vec![Se3::identity()];
            for k in 0..80 {
                poses.push(poses[k] * step(factor * turn_at(k)));
            }
            poses
        };
        let (truth, wheels) = (drive(1.0), drive(1.1));
        let at = |k: usize| Stamp(k as i64 * 1_000_000_000);
        let odometry: BTreeMap<Stamp, Se3> = wheels.iter().enumerate().map(|(k, pose)| (at(k), *pose)).collect();
        let between = |i: usize, j: usize| Stated { from: at(i), to: at(j), t_from_to: truth[i].inverse() * truth[j] };
        let relations: Vec<Stated> =
            (0..76).step_by(4).map(|k| between(k, k + 4)).chain([between(0, 40), between(8, 48)]).collect();
        let poses = way(&odometry, &relations).unwrap();
        let worst = |poses: &dyn Fn(usize) -> Se3| {
            let off = |k: usize| ((poses(0).inverse() * poses(k)).translation - truth[k].translation).norm();
            (0..=76).step_by(4).map(off).fold(0.0, f64::max)
        };
        assert!(worst(&|k| wheels[k]) > 2.0 && worst(&|k| poses[&at(k)]) < 0.3, "{}", worst(&|k| poses[&at(k)]));
    }
}

//! The planar set: the way of one robot with a 2-D laser through an office building (Radish `aces`), cut into submaps.
//! The truth is the map that fits the relations checked by hand best, with the robot's own odometry in between; it is
//! itself good to a tenth of a metre and a degree or two.

use super::sets::{Place, Set};
use crate::bench::cpu::thread_seconds;
use anyhow::{Context, ensure};
use merganser_protocol::config::{Sensor, SubmapConfig};
use merganser_protocol::estimate::graph::{Factor, Graph, Source};
use merganser_protocol::estimate::solve::minimum;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, So3};
use merganser_protocol::ids::{FrameId, RobotId, SubmapId};
use merganser_protocol::submap::{Submap, SubmapBuilder, describe};
use merganser_recording::carmen::{Parser, keyframes};
use nalgebra::Vector3;
use std::collections::BTreeSet;
use std::io::Read;
use std::path::Path;

/// Every so many scans of the log are used, as by each of three robots that share it.
const EVERY: usize = 3;
/// Standard deviations of a relation checked by hand: m, and rad.
const RELATION: (f64, f64) = (0.05, 0.02);
/// Out of the plane nothing moves: m, and rad.
const OUT_OF_PLANE: (f64, f64) = (1e-3, 1e-4);
const ITERATIONS_MAX: usize = 100;
const FRAME: FrameId = FrameId { robot: RobotId([1; 8]), epoch: 1 };

/// Loads the log and the relations, and fits the truth.
pub(super) fn load(data: &Path, keypoints: usize) -> anyhow::Result<Set> {
    let folder = data.join("lidar2d_radish");
    let config = SubmapConfig {
        sensor: Sensor::Laser2d,
        distance_m: 6.0,
        rotation_deg: 360.0,
        keyframes_max: 32,
        keypoints,
        ..Default::default()
    };
    let way = Way::drive(&folder.join("aces.clf.bz2"), &config)?;
    let relations = super::files::text(&folder.join("aces.relations"))?;
    let truth = way.truth(&relations)?;
    let place = |(drawn, t_world_anchor): (Drawn, Se3)| {
        let start = thread_seconds();
        let described = describe(&drawn.submap, &config);
        let describe_s = thread_seconds() - start;
        let name = drawn.submap.index.to_string();
        let (keyframes, thin_s) = (drawn.submap.keyframes.len(), drawn.thin_s);
        Place { name, described, t_world_anchor, keyframes, thin_s, describe_s, scan: None }
    };
    let places = way.submaps.into_iter().zip(truth).map(place).collect();
    Ok(Set {
        name: "aces",
        sensor: Sensor::Laser2d,
        places,
        rotation_deg: 6.0,
        translation_m: 0.5,
        found_min: 75,
        wrong_max: 5,
    })
}

/// A submap and the processor time it took, s.
struct Drawn {
    submap: Submap,
    thin_s: f64,
}

/// The robot's way: where each keyframe is in its submap.
struct Way {
    submaps: Vec<Drawn>,
    /// Stamp (ns), submap, `t_anchor_body`, and `t_odometry_body` as recorded.
    bodies: Vec<(i64, usize, Se3, Se3)>,
    /// Stamp (ns) and `t_odometry_body` of every scan.
    scans: Vec<(i64, Se3)>,
}

impl Way {
    fn drive(log: &Path, config: &SubmapConfig) -> anyhow::Result<Self> {
        let packed = std::fs::File::open(log).with_context(|| log.display().to_string())?;
        let mut text = String::new();
        bzip2::read::MultiBzDecoder::new(std::io::BufReader::new(packed)).read_to_string(&mut text)?;
        let mut parser = Parser::default();
        text.lines().try_for_each(|line| parser.line(line)).with_context(|| log.display().to_string())?;
        let scans = parser.finish().scans;
        let keyframes = keyframes(scans.iter().step_by(EVERY));
        let scans = scans.iter().map(|scan| (scan.stamp.0, scan.pose)).collect();
        let mut builder = SubmapBuilder::new(config.clone());
        let (mut way, mut waiting) = (Self { submaps: Vec::new(), bodies: Vec::new(), scans }, Vec::new());
        let mut thin_s = 0.0;
        for keyframe in keyframes {
            waiting.push((keyframe.stamp.0, keyframe.pose.pose));
            let start = thread_seconds();
            let closed = builder.push(keyframe)?;
            thin_s += thread_seconds() - start;
            if let Some(submap) = closed {
                way.close(submap, core::mem::take(&mut thin_s), &mut waiting)?;
            }
        }
        if let Some(submap) = builder.flush() {
            way.close(submap, thin_s, &mut waiting)?;
        }
        ensure!(waiting.is_empty(), "{} keyframes of {} are in no submap", waiting.len(), log.display());
        Ok(way)
    }

    fn close(&mut self, submap: Submap, thin_s: f64, waiting: &mut Vec<(i64, Se3)>) -> anyhow::Result<()> {
        ensure!(
            submap.keyframes.len() <= waiting.len(),
            "submap {} holds more keyframes than were pushed",
            submap.index
        );
        let at = self.submaps.len();
        let own = waiting.drain(..submap.keyframes.len()).zip(&submap.keyframes);
        self.bodies.extend(own.map(|((stamp, raw), t_anchor_body)| (stamp, at, *t_anchor_body, raw)));
        self.submaps.push(Drawn { submap, thin_s });
        Ok(())
    }

    /// Submap and `t_anchor_body` when a scan was taken: from the keyframe before it on by odometry.
    fn at(&self, stamp: i64) -> Option<(usize, Se3)> {
        let scan = self.scans.binary_search_by_key(&stamp, |scan| scan.0).ok()?;
        let next = self.bodies.partition_point(|body| body.0 <= stamp);
        let (_, submap, t_anchor_body, raw) = self.bodies.get(next.checked_sub(1)?)?;
        Some((*submap, *t_anchor_body * (raw.inverse() * self.scans[scan].1)))
    }

    /// `t_world_anchor` of every submap.
    fn truth(&self, relations: &str) -> anyhow::Result<Vec<Se3>> {
        let id = |index: usize| SubmapId { frame: FRAME, index: index as u32 };
        let odometry = (1..self.submaps.len()).map(|k| Factor {
            label: Source::Odometry,
            i: id(k - 1),
            j: id(k),
            t_i_j: Relative::Metric(self.submaps[k].submap.odometry),
            weight: 1.0,
        });
        let mut factors: Vec<Factor<SubmapId>> = odometry.collect();
        let (flat, (height, tilt)) = (RELATION, OUT_OF_PLANE);
        let covariance = Covariance::from_sigmas([flat.0, flat.0, height, tilt, tilt, flat.1])?;
        for (place, line) in relations.lines().enumerate() {
            let (stamps, t_then_later) = relation(line)?;
            let [Some((i, t_i_then)), Some((j, t_j_later))] = stamps.map(|stamp| self.at(stamp)) else { continue };
            if i == j {
                continue;
            }
            let pose = t_i_then * t_then_later * t_j_later.inverse();
            let (i, j) = (id(i), id(j));
            let label = Source::Measurement(place);
            let t_i_j = Relative::Metric(PoseWithCovariance { pose, covariance });
            factors.push(Factor { label, i, j, t_i_j, weight: 1.0 });
        }
        let nodes = (0..self.submaps.len()).map(id).collect();
        let mut graphs = Graph::components(&nodes, &BTreeSet::new(), factors)?;
        ensure!(graphs.len() == 1, "the way falls into {} parts", graphs.len());
        let start = self.submaps.iter().map(|drawn| Sim3::from_se3(&drawn.submap.t_frame_anchor)).collect();
        let fit = minimum(&graphs.remove(0), start, ITERATIONS_MAX)?;
        ensure!(fit.converged, "the relations do not fit together");
        Ok(fit.values.iter().map(|t_world_anchor| t_world_anchor.to_se3()).collect())
    }
}

/// A line `time time x y z roll pitch yaw`: two stamps, ns, and the pose at the second as seen from the first.
fn relation(line: &str) -> anyhow::Result<([i64; 2], Se3)> {
    let v = super::files::numbers(line)?;
    ensure!(v.len() == 8, "{line:?} is no relation: two times, x y z, roll pitch yaw");
    let rotation = So3::exp(&Vector3::new(0.0, 0.0, v[7]));
    Ok(([v[0], v[1]].map(|t| (t * 1e6).round() as i64 * 1000), Se3::new(rotation, Vector3::new(v[2], v[3], 0.0))))
}

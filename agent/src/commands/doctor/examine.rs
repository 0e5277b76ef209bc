//! Keyframes put through what an agent puts them through, and counted.

use super::clock;
use ed25519_dalek::SigningKey;
use merganser_protocol::agent::job::{AlignJob, Measured, Refused};
use merganser_protocol::agent::stated;
use merganser_protocol::config::Config;
use merganser_protocol::geometry::Se3;
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId};
use merganser_protocol::submap::habits::Habits;
use merganser_protocol::submap::{Described, Features, Keyframe, Keypoints, Submap, SubmapBuilder, describe};
use merganser_protocol::time::{Instant, Stamp};
use merganser_protocol::wire::{Entry, EntryContent, SwarmTag};
use nalgebra::Vector3;
use serde::Serialize;
use std::collections::BTreeMap;
use std::sync::Arc;

/// Submaps that are looked at; no more are cut.
const SUBMAPS_MAX: usize = 24;
/// Pairs of neighbours that are aligned.
const PAIRS_MAX: usize = 12;
/// So few pairs that none of them aligns says nothing.
const PAIRS_MIN: usize = 3;

/// A described submap, as two robots look at one another's.
type Side = (Arc<Features>, Arc<Keypoints>);

/// What was seen of one robot.
#[derive(Clone, Debug, Serialize)]
pub struct Examined {
    /// Its name.
    pub robot: String,
    /// What makes its points, as configured.
    pub sensor: merganser_protocol::config::Sensor,
    /// As configured, m.
    pub voxel_m: f64,
    /// Keyframes that were taken.
    pub keyframes: usize,
    /// From the first of them to the last, by their stamps, s.
    pub secs: f64,
    /// What clock their stamps are of; empty without keyframes.
    pub clock: String,
    /// Why others were not, and how many.
    pub refused: BTreeMap<String, u64>,
    /// Points of a keyframe, median.
    pub points: f64,
    /// How far points are off, m: the median, and nine in ten.
    pub reach_m: [f64; 2],
    /// Motion between keyframes, m and degrees, medians.
    pub step: [f64; 2],
    /// Standard deviations that are stated, medians: x, y, z (m), roll, pitch, yaw (degrees).
    pub sigmas: [f64; 6],
    /// Submaps, at most 24.
    pub submaps: usize,
    /// Keypoints of a submap, median.
    pub keypoints: f64,
    /// Of neighbouring submaps, pairs that align, and pairs that were tried.
    pub aligned: [usize; 2],
    /// How far off the odometry the alignments of neighbours are, m, median.
    pub off_odometry_m: Option<f64>,
    /// Bytes of a submap: what each robot gets, and what those get besides that may have seen the same.
    pub bytes: [f64; 2],
    /// The same a second.
    pub bytes_per_sec: [f64; 2],
    /// What is odd, and what to do about it.
    pub remarks: Vec<String>,
}

/// See the module.
pub struct Examination {
    robot: String,
    config: Config,
    builder: SubmapBuilder,
    habits: Habits,
    submaps: Vec<Submap>,
    stamps: Option<[Stamp; 2]>,
    /// What this host's clock showed when the first keyframe came.
    host: Option<Stamp>,
    last: Option<Se3>,
    keyframes: usize,
    refused: BTreeMap<String, u64>,
    points: Vec<f64>,
    reaches: Vec<f64>,
    steps: [Vec<f64>; 2],
    sigmas: [Vec<f64>; 6],
    remarks: Vec<String>,
}

impl Examination {
    /// Of a robot that is configured so.
    pub fn new(robot: String, config: Config) -> Self {
        Self {
            robot,
            builder: SubmapBuilder::new(config.submap.clone()),
            config,
            habits: Habits::default(),
            submaps: Vec::new(),
            stamps: None,
            host: None,
            last: None,
            keyframes: 0,
            refused: BTreeMap::new(),
            points: Vec::new(),
            reaches: Vec::new(),
            steps: Default::default(),
            sigmas: Default::default(),
            remarks: Vec::new(),
        }
    }

    /// The first keyframe came when this host's clock showed this.
    pub fn came(&mut self, host: Stamp) {
        self.host = Some(host);
    }

    /// Something came that was no keyframe.
    pub fn refuse(&mut self, reason: String, count: u64) {
        *self.refused.entry(reason).or_default() += count;
    }

    /// What is odd so far.
    pub fn remarks(&self) -> &[String] {
        &self.remarks
    }

    /// Submaps that are closed.
    pub fn submaps(&self) -> usize {
        self.submaps.len()
    }

    /// Whether more would change nothing.
    pub fn has_enough(&self) -> bool {
        self.submaps.len() >= SUBMAPS_MAX
    }

    /// A keyframe, and when it came, if that is known.
    pub fn take(&mut self, at: Option<Instant>, keyframe: Keyframe) {
        let (stamp, pose, points) = (keyframe.stamp, keyframe.pose, keyframe.points.len());
        let middle = keyframe.points.get(points / 2).map(|_| ranges(&keyframe.points));
        // A SLAM that starts again begins another frame: what was cut stays, as of an agent.
        if self.builder.another_frame(&keyframe).is_some() {
            self.close();
            self.builder = self.builder.begun_anew(true);
        }
        let pushed = self.builder.push(keyframe);
        self.remarks.extend(self.builder.take_oddities().iter().map(ToString::to_string));
        match pushed {
            Ok(closed) => self.keep(closed),
            Err(error) => {
                return self.refuse(without_numbers(&error.to_string()), 1);
            }
        }
        self.remarks.extend(at.and_then(|at| self.habits.take(at, stamp)).map(|oddity| oddity.to_string()));
        self.keyframes += 1;
        self.stamps = Some([self.stamps.map_or(stamp, |[first, _]| first), stamp]);
        self.points.push(points as f64);
        self.reaches.extend(middle.into_iter().flatten());
        if let Some(last) = self.last.replace(pose.pose) {
            let step = last.inverse() * pose.pose;
            self.steps[0].push(step.translation.norm());
            self.steps[1].push(step.rotation.angle().to_degrees());
        }
        let sigmas = pose.covariance.sigmas();
        for (axis, all) in self.sigmas.iter_mut().enumerate() {
            all.push(if axis < 3 { sigmas[axis] } else { sigmas[axis].to_degrees() });
        }
    }

    fn close(&mut self) {
        let closed = self.builder.flush();
        self.keep(closed);
    }

    fn keep(&mut self, closed: Option<Submap>) {
        self.submaps.extend(closed.filter(|_| self.submaps.len() < SUBMAPS_MAX));
        if let Some(voxels) = self.builder.take_misfit() {
            self.remarks.push(format!(
                "views of one submap lie {voxels:.1} voxels off one another: check the camera's intrinsics, units, \
                 extrinsics and the odometry"
            ));
        }
    }

    /// What was seen. `expected` is where a SLAM was listened for.
    pub fn finish(mut self, expected: Option<&str>) -> Examined {
        self.close();
        let described: Vec<Described> =
            self.submaps.iter().map(|submap| describe(submap, &self.config.submap)).collect();
        let keypoints: Vec<f64> = described.iter().map(|described| described.keypoints.len() as f64).collect();
        let sees_surfaces = !self.config.submap.sensor.sees_landmarks();
        for count in described.iter().map(|described| described.keypoints.len()).filter(|_| sees_surfaces) {
            self.remarks.extend(self.habits.described(count).map(|oddity| oddity.to_string()));
        }
        let looks = self.looks(&described);
        let aligned = looks.iter().filter(|(_, look)| look.is_ok()).count();
        let commonest = commonest(looks.iter().filter_map(|(_, look)| look.as_ref().err()));
        if let Some(why) = commonest.filter(|_| looks.len() >= PAIRS_MIN && aligned == 0) {
            self.remarks.push(format!(
                "none of {} submaps aligns with the one after it, which saw nearly the same: others will hardly align with \
                 this robot ({why})",
                looks.len()
            ));
        }
        if let Some(key) = expected.filter(|_| self.keyframes == 0) {
            self.remarks.push(format!(
                "nothing that could be used was sent: is the SLAM connected to this endpoint, and does it publish {key}?"
            ));
        }
        let clock = self.stamps.map_or(clock::Told::default(), |[first, _]| clock::told(first, self.host));
        // The rate of stamps tells it, too, of many keyframes.
        if clock.is_other_unit && !self.remarks.iter().any(|told| told.contains("stamps rise as if")) {
            self.remarks.push(clock.text.clone());
        }
        for (reason, count) in &self.refused {
            self.remarks.push(format!("refused {count} times: {reason}"));
        }
        let off: Vec<f64> =
            looks.iter().filter_map(|(odometry, look)| Some(off(odometry, look.as_ref().ok()?))).collect();
        let secs = self.stamps.map_or(0.0, |[first, last]| last.secs_since(first));
        let bytes = self.bytes(&described);
        let [median_bytes, per_sec] = [
            bytes.clone().map(|all| median(all).unwrap_or_default()),
            bytes.map(|all| if secs > 0.0 { all.iter().sum::<f64>() / secs } else { 0.0 }),
        ];
        let mut reaches = self.reaches;
        reaches.sort_by(f64::total_cmp);
        let share = |share: f64| reaches.get((reaches.len() as f64 * share) as usize).copied().unwrap_or_default();
        Examined {
            robot: self.robot,
            sensor: self.config.submap.sensor,
            voxel_m: self.config.submap.voxel_m,
            keyframes: self.keyframes,
            secs,
            clock: clock.text,
            refused: self.refused,
            points: median(self.points).unwrap_or_default(),
            reach_m: [share(0.5), share(0.9)],
            step: self.steps.map(|all| median(all).unwrap_or_default()),
            sigmas: self.sigmas.map(|all| median(all).unwrap_or_default()),
            submaps: described.len(),
            keypoints: median(keypoints).unwrap_or_default(),
            aligned: [aligned, looks.len()],
            off_odometry_m: median(off),
            bytes: median_bytes,
            bytes_per_sec: per_sec,
            remarks: self.remarks,
        }
    }

    /// Each submap aligned with the one after it, as a robot aligns two of its own, and what the odometry says.
    fn looks(&self, described: &[Described]) -> Vec<(Se3, Result<Measured, Refused>)> {
        let sides: Vec<Side> = described
            .iter()
            .map(|described| {
                let further = described.further.as_ref().and_then(|further| described.keypoints.with_further(further));
                let keypoints = further.unwrap_or_else(|| described.keypoints.clone());
                (Arc::new(described.features.clone()), Arc::new(keypoints))
            })
            .collect();
        let neighbours = self.submaps.windows(2).zip(sides.windows(2));
        // Those of another frame begin anew with the first index.
        let neighbours = neighbours.filter(|(submaps, _)| submaps[1].index == submaps[0].index + 1).take(PAIRS_MAX);
        let look = |(submaps, sides): (&[Submap], &[Side])| {
            let job = AlignJob {
                theirs: sides[1].1.clone(),
                mine: sides[0].0.clone(),
                back: Some((sides[0].1.clone(), sides[1].0.clone())),
                config: self.config.align.clone(),
                voxel_m: self.config.submap.voxel_m,
                sensor: self.config.submap.sensor,
                verticals: None,
                scale: self.config.submap.scale,
                seed: 1,
            };
            (submaps[1].odometry.pose, job.look())
        };
        neighbours.map(look).collect()
    }

    /// Bytes of each submap as a fact, and of its keypoints.
    fn bytes(&self, described: &[Described]) -> [Vec<f64>; 2] {
        let key = SigningKey::from_bytes(&[1; 32]); // only the length of what it signs counts
        let robot = RobotId::of_key(key.verifying_key().as_bytes());
        let swarm = Name::new("doctor").map(|name| SwarmTag::of(&name));
        let mut all = [Vec::new(), Vec::new()];
        for (submap, described) in self.submaps.iter().zip(described) {
            let (fact, (_, blob)) = stated(submap, described, self.config.submap.scale);
            let id = EntryId { frame: FrameId { robot, epoch: 1 }, seq: submap.index };
            let entry = swarm.as_ref().ok().zip(fact.to_payload().ok()).and_then(|(swarm, payload)| {
                let content =
                    EntryContent { swarm: *swarm, id, kind: fact.kind(), floor: 0, previous: Hash::default(), payload };
                Entry::sign(&key, content).ok()
            });
            all[0].push(entry.map_or(0, |entry| entry.encode().len()) as f64);
            all[1].push(blob.len() as f64);
        }
        all
    }
}

/// A reason to count by: numbers would make each of them another.
fn without_numbers(reason: &str) -> String {
    let mut chars: Vec<char> = reason.chars().map(|c| if c.is_ascii_digit() { '#' } else { c }).collect();
    chars.dedup_by(|a, b| *a == '#' && *b == '#');
    chars.into_iter().collect()
}

/// How far points are off, m; of many, evenly.
fn ranges(points: &[[f32; 3]]) -> Vec<f64> {
    let some = points.iter().step_by(points.len().div_ceil(64).max(1));
    some.map(|p| Vector3::from(p.map(f64::from)).norm()).collect()
}

fn off(odometry: &Se3, measured: &Measured) -> f64 {
    (measured.t_mine_theirs.sim().translation - odometry.translation).norm()
}

fn commonest<'a>(refused: impl Iterator<Item = &'a Refused>) -> Option<String> {
    let mut counts = BTreeMap::<&str, usize>::new();
    refused.for_each(|refused| *counts.entry(&refused.why).or_default() += 1);
    counts.into_iter().max_by_key(|(_, count)| *count).map(|(why, _)| why.to_owned())
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len().checked_sub(1)? / 2;
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

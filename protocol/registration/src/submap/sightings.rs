//! The same of landmarks as [`reading`](super::reading) finds of surfaces: whether a front end means its poses and points as
//! they are read here. Who a landmark is tells its label, so one landmark seen twice does what a view laid over another
//! does for surfaces: each [`Reading`] says where the landmark should have been seen, and the right one is right.
//!
//! A sighting is judged once the body has turned, or gone, far enough since the one before of that landmark. It says
//! nothing where a reading and what was stated expect the landmark at the same place, or neither does where it was seen.

use super::Keyframe;
use super::reading::Reading;
use crate::config::SubmapConfig;
use crate::geometry::Se3;
use crate::submap::stated::Oddity;
use nalgebra::Vector3;
use std::collections::BTreeMap;

/// Landmarks that are remembered; further ones are left out.
pub const LABELS_MAX: usize = 1024;
/// How far the body moves between two sightings at least: rad, and as a share of the landmark's range.
const TURN_MIN: f64 = 0.5;
const WAY_MIN: f64 = 0.5;
/// Keyframes after which a sighting is too old, as odometry drifts.
const AGE_MAX: u32 = 200;
/// A landmark is where it was expected within this share of its range, and two places differ by more than that.
const HIT: f64 = 0.12;
const APART: f64 = 0.36;
/// Sightings that a reading must win.
pub const WINS_MIN: u32 = 16;
/// Their share of those that tell it from what was stated.
const WINS_SHARE: f64 = 0.9;
/// It wins so many times as many as any other, or there were so many sightings that the others are as good as the same.
const LEAD: f64 = 1.25;
const SIGHTINGS_OF_RIVALS: u32 = 4 * WINS_MIN;
/// After so many sightings no more is looked for.
pub const SIGHTINGS_MAX: u32 = 512;

/// What sightings said of one reading.
#[derive(Clone, Copy, Debug, Default)]
struct Tally {
    wins: u32,
    losses: u32,
}

#[derive(Clone, Copy, Debug)]
struct Sighting {
    t_frame_body: Se3,
    at: Vector3<f64>,
    keyframe: u32,
}

/// Looks at labelled landmarks as they come, until it is clear how they are meant.
#[derive(Clone, Debug, Default)]
pub(super) struct Sightings {
    seen: BTreeMap<u32, Sighting>,
    tallies: Vec<Tally>,
    keyframes: u32,
    judged: u32,
    is_over: bool,
}

impl Sightings {
    /// Takes a keyframe of finite numbers, and its pose as the sensor has it; what is odd, if that shows now.
    pub fn look(&mut self, keyframe: &Keyframe, pose: &Se3, config: &SubmapConfig) -> Option<Oddity> {
        if self.is_over || keyframe.marks.is_empty() {
            return None;
        }
        self.keyframes = self.keyframes.saturating_add(1);
        let planar = config.sensor.is_planar();
        let readings = Reading::all(planar);
        self.tallies.resize(readings.len(), Tally::default());
        for (point, mark) in keyframe.points.iter().zip(&keyframe.marks) {
            let Some(label) = mark.label else { continue };
            let mut at = Vector3::from(point.map(f64::from));
            if planar {
                at.z = 0.0;
            }
            let new = Sighting { t_frame_body: *pose, at, keyframe: self.keyframes };
            let Some(before) = self.seen.get(&label).copied() else {
                if self.seen.len() < LABELS_MAX {
                    self.seen.insert(label, new);
                }
                continue;
            };
            let t = before.t_frame_body.inverse() * *pose;
            let range = before.at.norm().max(at.norm());
            let is_old = self.keyframes - before.keyframe > AGE_MAX;
            if t.rotation.angle() < TURN_MIN && t.translation.norm() < WAY_MIN * range && !is_old {
                continue;
            }
            self.seen.insert(label, new);
            if !is_old && range > 0.0 {
                self.judge(&before, &new, range, &readings);
            }
        }
        self.conclude(&readings)
    }

    /// Nothing is looked for any more.
    pub fn stop(&mut self) {
        self.is_over = true;
        self.seen.clear();
    }

    fn judge(&mut self, before: &Sighting, new: &Sighting, range: f64, readings: &[Reading]) {
        self.judged += 1;
        let stated = before.t_frame_body.inverse() * new.t_frame_body * new.at;
        let is_hit = |expected: &Vector3<f64>| (expected - before.at).norm() <= HIT * range;
        for (reading, tally) in readings.iter().zip(&mut self.tallies) {
            let expected = reading.motion(&before.t_frame_body, &new.t_frame_body) * new.at;
            if (expected - stated).norm() < APART * range {
                continue;
            }
            match (is_hit(&expected), is_hit(&stated)) {
                (true, false) => tally.wins += 1,
                (false, true) => tally.losses += 1,
                _ => {}
            }
        }
    }

    fn conclude(&mut self, readings: &[Reading]) -> Option<Oddity> {
        let sums: Vec<[u32; 2]> = self.tallies.iter().map(|tally| [tally.wins, tally.wins + tally.losses]).collect();
        let best = (0..sums.len()).max_by_key(|k| (sums[*k][0], core::cmp::Reverse(*k)))?;
        let rival = (0..sums.len()).filter(|k| *k != best).map(|k| sums[k][0]).max().unwrap_or_default();
        let [wins, pairs] = sums[best].map(f64::from);
        let leads = wins >= LEAD * f64::from(rival) || sums[best][1] >= SIGHTINGS_OF_RIVALS;
        let is_told = sums[best][0] >= WINS_MIN && wins >= WINS_SHARE * pairs && leads;
        let found = is_told.then(|| Oddity::Seen { reading: readings[best], sightings: sums[best] });
        if found.is_some() || self.judged >= SIGHTINGS_MAX {
            self.stop();
        }
        found
    }
}

#[cfg(test)]
#[path = "sightings_tests.rs"]
mod tests;

//! Tells which sightings of a growing submap are of one landmark: by their label if they have one; else by place
//! (within the uncertainty of both) and, where both are described, by descriptor. Memory is bounded whatever comes.

use super::{Descriptor, LANDMARKS_MAX, Mark, differing};
use crate::geometry::Se3;
use nalgebra::{Matrix3, Vector3};
use std::collections::BTreeMap;

/// Sightings kept of one landmark; later ones say little more.
pub const SIGHTINGS_MAX: usize = 48;
/// Bits by which descriptors of one landmark differ at most: of unrelated ones 128 ± 8 do.
pub const BITS_MAX: u32 = 64;
/// Sightings without a label are of one landmark within this squared distance (χ²₃, 99 %)...
const CHI2_MAX: f64 = 11.345;
/// ...or within so many times that where descriptors say so too: the body may have drifted between them.
const ALIKE: f64 = 4.0;

/// A sighting.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sighting {
    /// By which keyframe of the submap.
    pub keyframe: u16,
    /// In its body frame...
    pub at: Vector3<f64>,
    /// ...and the covariance of that.
    pub covariance: Matrix3<f64>,
}

/// All sightings of one landmark.
#[derive(Clone, Debug, PartialEq)]
pub struct Seen {
    /// Its label.
    pub label: Option<u32>,
    /// Its descriptor: the first one.
    pub descriptor: Option<Descriptor>,
    /// In order of the keyframes.
    pub sightings: Vec<Sighting>,
    /// How many there were, kept or not.
    pub count: u32,
    /// Where the last sighting put it, about the first body pose, and the covariance.
    place: (Vector3<f64>, Matrix3<f64>),
}

/// The landmarks of one submap while it grows.
#[derive(Clone, Debug)]
pub struct Gatherer {
    /// What passes for one place besides the stated uncertainty, frame units.
    slack: f64,
    most: usize,
    seen: Vec<Seen>,
    labelled: BTreeMap<u32, usize>,
}

impl Gatherer {
    /// Of at most `most` landmarks; unlabelled ones within `slack` (frame units) are one.
    pub fn new(slack: f64, most: usize) -> Self {
        Self { slack, most: most.min(LANDMARKS_MAX), seen: Vec::new(), labelled: BTreeMap::new() }
    }

    /// Adds the sightings of one keyframe whose body stands at `t_first_body`.
    pub fn add(&mut self, keyframe: u16, t_first_body: &Se3, points: &[[f32; 3]], marks: &[Mark]) {
        let turn = t_first_body.rotation.matrix();
        for (point, mark) in points.iter().zip(marks) {
            let at = Vector3::from(point.map(f64::from));
            let covariance = *mark.covariance.matrix();
            let place = (*t_first_body * at, turn * covariance * turn.transpose());
            let sighting = Sighting { keyframe, at, covariance };
            match self.known(keyframe, mark, &place) {
                Some(k) => self.seen[k].take(sighting, place, mark),
                None if self.seen.len() < self.most => {
                    mark.label.map(|label| self.labelled.insert(label, self.seen.len()));
                    let (label, descriptor) = (mark.label, mark.descriptor);
                    self.seen.push(Seen { label, descriptor, sightings: vec![sighting], count: 1, place });
                }
                None => {}
            }
        }
    }

    /// The landmarks, in order of their first sightings.
    pub fn finish(self) -> Vec<Seen> {
        self.seen
    }

    /// Which landmark this is, if it was seen before.
    fn known(&self, keyframe: u16, mark: &Mark, place: &(Vector3<f64>, Matrix3<f64>)) -> Option<usize> {
        if let Some(label) = mark.label {
            return self.labelled.get(&label).copied();
        }
        let near = |seen: &Seen| {
            // One keyframe does not see one landmark twice.
            let other = seen.label.is_none() && seen.sightings.last().is_none_or(|last| last.keyframe != keyframe);
            let most = match (&seen.descriptor, &mark.descriptor) {
                (Some(a), Some(b)) if differing(a, b) <= BITS_MAX => ALIKE * CHI2_MAX,
                (Some(_), Some(_)) => 0.0,
                _ => CHI2_MAX,
            };
            let away = place.0 - seen.place.0;
            let covariance = place.1 + seen.place.1 + Matrix3::from_diagonal_element(self.slack * self.slack);
            let distance = (other && away.norm_squared() <= most * covariance.trace())
                .then(|| covariance.cholesky().map(|c| away.dot(&c.solve(&away))))??;
            (distance <= most).then_some(distance)
        };
        let all = self.seen.iter().enumerate().filter_map(|(k, seen)| Some((near(seen)?, k)));
        all.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, k)| k)
    }
}

impl Seen {
    fn take(&mut self, sighting: Sighting, place: (Vector3<f64>, Matrix3<f64>), mark: &Mark) {
        self.count = self.count.saturating_add(1);
        self.descriptor = self.descriptor.or(mark.descriptor);
        self.place = place;
        if self.sightings.len() < SIGHTINGS_MAX {
            self.sightings.push(sighting);
        }
    }
}

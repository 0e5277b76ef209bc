//! A robot that stands sees nothing new. Once a submap is full of keyframes that were all taken in one place, no other
//! begins until the body has left it; keyframes meanwhile say when it was still there, and no more.
//!
//! The own motion alone decides, by odometry: what else moves about the robot does not. A body has not moved if it is
//! within a voxel and a tenth of `rotation_deg`, or within what the noise that its odometry states may feign: five
//! standard deviations. Noise adds up over a night, so two places are looked at. From a *mark*, which is set anew
//! wherever noise alone may have led a voxel away, a robot that drives off shows at once; from where it came to
//! stand, what is too slow for that shows, at half a submap's bounds the latest.
//!
//! While it stands, motions do not compound as if each were driven: the error of where the body is by its odometry is
//! how far it seems to have got, beside one motion's own. Their sum counts as long as it is less.

use super::PoseWithCovariance;
use super::odometry::isotropic;
use crate::config::SubmapConfig;
use crate::geometry::{Covariance, Se3};

/// A body that turns by less than this share of `rotation_deg`, and moves by less than a voxel, stands.
const STANDS_TURN: f64 = 0.1;
/// Stated standard deviations that pass for noise. In a night at 100 Hz a mark is set some 10,000 times; of so many
/// chances a Gaussian takes none.
const SIGMAS: f64 = 5.0;
/// ...up to this share of a submap's bounds.
pub const NOISE_MAX: f64 = 0.5;
/// Stands for a distance of none.
const NO_WAY: f64 = 1e-8;

/// A body at rest.
#[derive(Clone, Debug)]
pub(super) struct Rest {
    /// Where it came to stand: in the frame of the submaps...
    pub t_frame_body: Se3,
    /// ...by odometry...
    at: Se3,
    /// ...and from the last submap's anchor.
    pub since_finished: PoseWithCovariance,
    stood: Option<Stood>,
    /// Where it was last looked whether it has left, and what motions from there state.
    mark: (Se3, Option<PoseWithCovariance>),
}

/// What motions said since the body came to stand.
#[derive(Clone, Copy, Debug)]
struct Stood {
    /// All of them compounded.
    sum: PoseWithCovariance,
    /// The covariance of the least certain one.
    widest: Covariance<6>,
}

impl Rest {
    pub fn new(at: Se3, t_frame_body: Se3, since_finished: PoseWithCovariance) -> Self {
        Self { t_frame_body, at, since_finished, stood: None, mark: (at, None) }
    }

    /// Whether a keyframe was taken that said no more than that the body still stands.
    pub fn has_stood(&self) -> bool {
        self.stood.is_some()
    }

    /// Takes a motion that leads to `pose` by odometry, unless it leads away. Whether it did take it.
    pub fn take(&mut self, pose: &Se3, step: &PoseWithCovariance, config: &SubmapConfig) -> bool {
        let compound = |before: Option<PoseWithCovariance>| before.map_or(*step, |before| before.compose(step));
        let sum = compound(self.stood.map(|stood| stood.sum));
        let marked = compound(self.mark.1);
        let [from_rest, from_mark] = [self.at, self.mark.0].map(|from| from.inverse() * *pose);
        if is_blurred(&step.covariance, config)
            || !is_near(&from_rest, &sum.covariance, NOISE_MAX, config)
            || !is_near(&from_mark, &marked.covariance, f64::INFINITY, config)
        {
            return false;
        }
        let wider = |stood: Stood| {
            if size(&stood.widest, config) > size(&step.covariance, config) { stood.widest } else { step.covariance }
        };
        self.stood = Some(Stood { sum, widest: self.stood.map_or(step.covariance, wider) });
        let [way, turn] = worst(&marked.covariance, config).map(|sigma| SIGMAS * sigma);
        let [voxel, still] = still(config);
        self.mark = if way > voxel || turn > still { (*pose, None) } else { (self.mark.0, Some(marked)) };
        true
    }

    /// The motion from where the body came to stand to `pose`.
    pub fn motion(&self, pose: &Se3, config: &SubmapConfig) -> Option<PoseWithCovariance> {
        let Stood { sum, widest } = self.stood?;
        let pose = self.at.inverse() * *pose;
        let apart = [pose.translation.norm(), pose.rotation.angle()].map(|x| x.max(NO_WAY));
        let stood = widest.plus(&isotropic(apart[0], apart[1], &widest));
        let covariance = if size(&stood, config) < size(&sum.covariance, config) { stood } else { sum.covariance };
        Some(PoseWithCovariance { pose, covariance })
    }
}

/// Whether a body that went so far, by motions of this covariance, may still be where it was.
pub(super) fn is_near(t: &Se3, noise: &Covariance<6>, noise_max: f64, config: &SubmapConfig) -> bool {
    let most = [noise_max * config.distance_m, noise_max * config.rotation_deg.to_radians()];
    let sigmas = worst(noise, config);
    let [way, turn] = [0, 1].map(|k| still(config)[k].max((SIGMAS * sigmas[k]).min(most[k])));
    t.translation.norm() < way && t.rotation.angle() < turn
}

/// Whether a pose is so uncertain that a submap does not go on to it.
pub(super) fn is_blurred(covariance: &Covariance<6>, config: &SubmapConfig) -> bool {
    let [way, turn] = worst(covariance, config);
    way > config.sigma_max_m || turn > config.sigma_max_deg.to_radians()
}

/// Largest standard deviation of a translation and of a rotation. Out of the plane nothing is claimed to be known.
fn worst(covariance: &Covariance<6>, config: &SubmapConfig) -> [f64; 2] {
    let sigmas = covariance.sigmas();
    let axes: [&[usize]; 2] = if config.sensor.is_planar() { [&[0, 1], &[5]] } else { [&[0, 1, 2], &[3, 4, 5]] };
    axes.map(|axes| axes.iter().map(|&k| sigmas[k]).fold(0.0, f64::max))
}

/// What is no motion in any case.
fn still(config: &SubmapConfig) -> [f64; 2] {
    [config.voxel_m, STANDS_TURN * config.rotation_deg.to_radians()]
}

/// How uncertain, in what is no motion.
fn size(covariance: &Covariance<6>, config: &SubmapConfig) -> f64 {
    let (sigmas, still) = (worst(covariance, config), still(config));
    (0..2).map(|k| (sigmas[k] / still[k]).powi(2)).sum()
}

#[cfg(test)]
#[path = "rest_tests.rs"]
mod tests;

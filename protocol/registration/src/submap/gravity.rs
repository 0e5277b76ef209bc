//! Which way is up. An inertial sensor tells it within a degree or two, wherever the robot is and however its frame is
//! turned; hence of the three angles between two submaps two are known beforehand. A pose that tilts one submap's
//! vertical against the other's by more than both their errors allow is wrong, whatever the clouds say of it.
//!
//! **Gate.** Under the true rotation the angle between the two verticals is the length of a Gaussian in the plane, of
//! variance σ² = σ_theirs² + σ_mine² + σ_pose² along each axis, so angle² / σ² has a χ² distribution of two degrees of
//! freedom; what exceeds its 99.9 % quantile is refused.
//!
//! **Mean.** Errors of one sensor's verticals have much in common (the bias of its accelerometer, how it is mounted),
//! so that averaging those of a submap's keyframes makes them no surer: the mean is as uncertain as if they all erred
//! alike, or as they scatter, whichever is more.

use super::block::{folded, unfolded};
use super::scene::Pose;
use crate::config::UP_SIGMA_RANGE_RAD;
use crate::geometry::{PoseWithCovariance, Se3, So3};
use nalgebra::{Matrix3, Vector3};
use thiserror::Error;

/// The length of a direction may be off from 1 by this: three decimals will do, an acceleration in m/s² will not.
pub const UP_LENGTH_TOLERANCE: f64 = 0.01;
/// The 99.9 % quantile of χ² with two degrees of freedom, −2 ln 0.001.
const GATE: f64 = 13.815_510_557_964_274;
/// Bytes of an encoded vertical: two octahedral coordinates, i16 each, and the standard deviation.
pub(super) const LEN: usize = 5;
/// Levels of the standard deviation, a constant factor (2.5 %) apart.
const SIGMA_LEVELS: f64 = 255.0;
/// An octahedral coordinate of 1.
const STEPS: f64 = 32_767.0;

/// The direction against gravity in some frame, and how well it is known.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Up {
    /// Of length 1.
    direction: Vector3<f64>,
    /// Standard deviation about each horizontal axis, rad.
    sigma: f64,
}

/// Why a vertical is refused.
#[derive(Clone, Copy, Debug, Error, PartialEq)]
pub enum UpError {
    /// Not of length 1.
    #[error("up has length {0}, not 1; state the direction against gravity, not an acceleration")]
    Length(f64),
    /// Out of range.
    #[error("up is known to {0} rad, not to {min} to {max}", min = UP_SIGMA_RANGE_RAD.start(), max = UP_SIGMA_RANGE_RAD.end())]
    Sigma(f64),
}

impl Up {
    /// A direction of length 1 to within [`UP_LENGTH_TOLERANCE`], and its standard deviation about each horizontal
    /// axis, rad, within [`UP_SIGMA_RANGE_RAD`].
    ///
    /// # Errors
    /// [`UpError`].
    pub fn new(direction: [f64; 3], sigma: f64) -> Result<Self, UpError> {
        let direction = Vector3::from(direction);
        let length = direction.norm();
        if !length.is_finite() || (length - 1.0).abs() > UP_LENGTH_TOLERANCE {
            return Err(UpError::Length(length));
        }
        if !UP_SIGMA_RANGE_RAD.contains(&sigma) {
            return Err(UpError::Sigma(sigma));
        }
        Ok(Self { direction: direction / length, sigma })
    }

    /// Where the frame's z axis points up: as the body turned so has it.
    ///
    /// # Errors
    /// [`UpError::Sigma`].
    pub fn of_frame_z(r_frame_body: &So3, sigma: f64) -> Result<Self, UpError> {
        Self::new((r_frame_body.inverse() * Vector3::z()).into(), sigma)
    }

    /// The direction, of length 1.
    pub fn direction(&self) -> &Vector3<f64> {
        &self.direction
    }

    /// Standard deviation about each horizontal axis, rad.
    pub fn sigma(&self) -> f64 {
        self.sigma
    }

    /// The nearest that travels; its standard deviation is rounded up.
    #[must_use]
    pub(super) fn rounded(&self) -> Self {
        // Codes on the rim of the octahedron's lower half come in pairs; the second round makes it one of them.
        let once = Self::of(code(&self.direction), level(self.sigma));
        Self::of(code(&once.direction), level(self.sigma))
    }

    pub(super) fn encode(&self) -> [u8; LEN] {
        let [[x0, x1], [y0, y1]] = code(&self.direction).map(i16::to_le_bytes);
        [x0, x1, y0, y1, level(self.sigma)]
    }

    /// Accepts exactly what [`Up::encode`] writes of what was [`rounded`](Self::rounded).
    pub(super) fn decode(bytes: [u8; LEN]) -> Option<Self> {
        let [x0, x1, y0, y1, level] = bytes;
        let code = [i16::from_le_bytes([x0, x1]), i16::from_le_bytes([y0, y1])];
        let up = Self::of(code, level);
        (up.encode() == bytes && !code.contains(&i16::MIN)).then_some(up)
    }

    fn of(code: [i16; 2], level: u8) -> Self {
        Self { direction: folded(code.map(|c| f64::from(c) / STEPS)), sigma: sigma_of(level) }
    }
}

fn code(direction: &Vector3<f64>) -> [i16; 2] {
    unfolded(direction).map(|c| (c * STEPS).round() as i16)
}

/// The standard deviation of a level...
fn sigma_of(level: u8) -> f64 {
    let (least, most) = (UP_SIGMA_RANGE_RAD.start(), UP_SIGMA_RANGE_RAD.end());
    least * libm::pow(most / least, f64::from(level) / SIGMA_LEVELS)
}

/// ...and the lowest level that is no less than one.
fn level(sigma: f64) -> u8 {
    (0..u8::MAX).find(|&level| sigma_of(level) >= sigma).unwrap_or(u8::MAX)
}

/// The mean of what keyframes at `t_anchor_body` know, in the anchor frame. `motions` lead from each keyframe to the
/// next: what the turn since the `anchor`-th one is not known well counts as an error of the vertical.
pub(super) fn mean(
    ups: &[Option<Up>],
    t_anchor_body: &[Se3],
    motions: &[PoseWithCovariance],
    anchor: usize,
) -> Option<Up> {
    let turned = turn_variances(motions, anchor, ups.len());
    let known: Vec<(Vector3<f64>, f64)> = ups
        .iter()
        .zip(t_anchor_body)
        .zip(turned)
        .filter_map(|((up, t), turned)| {
            let up = up.as_ref()?;
            Some((t.rotation * up.direction, (up.sigma * up.sigma + turned).sqrt()))
        })
        .collect();
    let weights: f64 = known.iter().map(|(_, sigma)| 1.0 / (sigma * sigma)).sum();
    let mean = known.iter().map(|(up, sigma)| up / (sigma * sigma)).sum::<Vector3<f64>>() / weights;
    let direction = mean.normalize();
    let stated = known.iter().map(|(_, sigma)| 1.0 / sigma).sum::<f64>() / weights;
    // Along two axes.
    let off = known.iter().map(|(up, sigma)| (up - direction).norm_squared() / (sigma * sigma)).sum::<f64>();
    let scatter = (off / (2.0 * weights)).sqrt();
    // Nothing known gives NaN, which is out of every range.
    Up::new(direction.into(), stated.max(scatter)).ok().map(|up| up.rounded())
}

/// Variance of each keyframe's rotation from the anchor, about its worst axis.
fn turn_variances(motions: &[PoseWithCovariance], anchor: usize, keyframes: usize) -> Vec<f64> {
    let worst = |m: &PoseWithCovariance| {
        m.covariance.matrix().fixed_view::<3, 3>(3, 3).into_owned().symmetric_eigenvalues().max()
    };
    let steps: Vec<f64> = motions.iter().map(worst).collect();
    let between = |k: usize| steps.get(k.min(anchor)..k.max(anchor)).map_or(0.0, |steps| steps.iter().sum());
    (0..keyframes).map(between).collect()
}

/// Standard deviation of a pose's tilt, rad, before it is polished, beyond what the verticals err: poses of few matches
/// are often off by several degrees,...
const TILT_SIGMA_ROUGH: f64 = 0.06;
/// ...and polished ones hardly by one.
const TILT_SIGMA: f64 = 0.02;
/// Largest standard deviation of a vertical, rad, by which the ground is found: over a hundred voxels it errs by three.
/// With a larger one the ground is taken from what is seen.
const GROUND_SIGMA_MAX: f64 = 0.03;

/// Both verticals of a pair of submaps.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Verticals {
    /// In the peer's anchor frame.
    pub theirs: Up,
    /// In mine.
    pub mine: Up,
}

impl Verticals {
    /// Of a pair of which both are known.
    pub fn of(theirs: Option<&Up>, mine: Option<&Up>) -> Option<Self> {
        Some(Self { theirs: *theirs?, mine: *mine? })
    }

    /// The other way round.
    #[must_use]
    pub fn back(self) -> Self {
        Self { theirs: self.mine, mine: self.theirs }
    }

    /// By which angle (rad, 0 to π) a rotation of their frame into mine tilts their vertical against mine.
    pub fn tilt(&self, r_mine_theirs: &Matrix3<f64>) -> f64 {
        let turned = r_mine_theirs * self.theirs.direction;
        libm::atan2(turned.cross(&self.mine.direction).norm(), turned.dot(&self.mine.direction))
    }

    /// The largest tilt that is not refused, rad, of a rotation that errs by `sigma` (rad, about each axis) itself.
    pub fn tilt_max(&self, sigma: f64) -> f64 {
        let squares = [self.theirs.sigma, self.mine.sigma, sigma].map(|s| s * s);
        (GATE * squares.iter().sum::<f64>()).sqrt()
    }

    /// Whether a rotation that errs by `sigma` (rad, about each axis) itself may be right.
    pub fn allow(&self, r_mine_theirs: &Matrix3<f64>, sigma: f64) -> bool {
        self.tilt(r_mine_theirs) <= self.tilt_max(sigma)
    }
}

/// What is known of which way is up, as a judge of poses in voxels.
pub(super) struct Upright(pub(super) Option<Verticals>);

impl Upright {
    /// Whether a pose may be right, before it is polished...
    pub(super) fn allows_rough(&self, pose: &Pose) -> bool {
        self.0.is_none_or(|known| known.allow(&pose.rotation, TILT_SIGMA_ROUGH))
    }

    /// ...and after.
    pub(super) fn allows(&self, pose: &Pose) -> bool {
        self.0.is_none_or(|known| known.allow(&pose.rotation, TILT_SIGMA))
    }

    /// Which way is up in my frame, of length 1, if it is known well enough to lay shifts along the ground.
    pub(super) fn up(&self) -> Option<&Vector3<f64>> {
        self.0.as_ref().map(|known| &known.mine).filter(|up| up.sigma <= GROUND_SIGMA_MAX).map(Up::direction)
    }
}

#[cfg(test)]
#[path = "gravity_tests.rs"]
mod tests;

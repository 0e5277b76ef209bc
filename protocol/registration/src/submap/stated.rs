//! Covariances as drivers state them. Wheels measure neither height nor tilt, and their drivers say so by a variance that
//! no motion between two keyframes has (1e6, 9999, a square radian): such an axis is *unmeasured*. It ends no submap. The body goes on as its
//! poses say, and errs in this axis by `gap_sigma_per_m` of its way, as across a gap of which nothing is known: a loose
//! axis, which alignments tie.
//!
//! Only z, roll and pitch of the body (x forward, y left, z up) can be unmeasured, and only beside axes of their kind
//! that are measured. Where nothing is, or where the way ahead is unknown, as in a corridor, views cannot be laid over one
//! another, and the submap ends.
//!
//! A pose covariance that is the same at two poses is no chain's, whose errors add up: its driver states a constant. The
//! motion then counts as known to `gap_sigma_per_m` as well.

use super::reading::Reading;
use super::{CovarianceOf, Keyframe};
use crate::config::SubmapConfig;
use crate::geometry::Covariance;
use core::fmt;
use serde::Serialize;

/// Names of the axes, in the order of a tangent.
const NAMES: [&str; 6] = ["x", "y", "z", "roll", "pitch", "yaw"];
/// Those that may be unmeasured, and those of their kind that must be measured then.
const KINDS: [([usize; 2], [usize; 2]); 2] = [([2, 2], [0, 1]), ([3, 4], [5, 5])];
/// A rotation with a larger standard deviation, rad, is not known: no Gaussian about one rotation means much beyond.
pub const TURN_SIGMA_MAX: f64 = 0.5;
/// Two variances are the same if they differ by less than this share: what writing them as text leaves.
const SAME: f64 = 1e-9;
/// Submaps in a row that end by what is stated after a single keyframe, from which on it is no gap but a habit.
pub const BLURRED_MAX: u32 = 5;

/// What a robot on wheels does not measure (z, roll, pitch), if its rotation stands first. No robot knows its height and
/// tilt, and neither where it is nor its heading.
const ROTATION_FIRST: Axes = Axes([true, true, false, false, false, true]);

/// Axes of a tangent (ρ, φ).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize)]
pub struct Axes([bool; 6]);

impl Axes {
    /// The axes that this covariance of one motion, or of a pose, leaves unmeasured.
    pub(super) fn unmeasured(stated: &Covariance<6>, config: &SubmapConfig) -> Self {
        let [way, turn] = [config.sigma_max_m, config.sigma_max_deg.to_radians()];
        let wide = Self::beyond(stated, [way, turn]).0;
        let nothing = Self::beyond(stated, [way.max(config.distance_m), turn.max(TURN_SIGMA_MAX)]).0;
        let mut axes = [false; 6];
        for (out, beside) in KINDS.into_iter().filter(|_| !config.sensor.is_planar()) {
            if beside.iter().all(|axis| !wide[*axis]) {
                out.into_iter().for_each(|axis| axes[axis] = nothing[axis]);
            }
        }
        Self(axes)
    }

    /// The axes that alone are less certain than a submap goes on to.
    pub(super) fn wider(stated: &Covariance<6>, config: &SubmapConfig) -> Self {
        Self::beyond(stated, [config.sigma_max_m, config.sigma_max_deg.to_radians()])
    }

    /// The axes with a larger standard deviation than this of a translation or a rotation.
    fn beyond(stated: &Covariance<6>, most: [f64; 2]) -> Self {
        let sigmas = stated.sigmas();
        Self(core::array::from_fn(|axis| sigmas[axis] > most[axis / 3]))
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        *self == Self::default()
    }

    /// `covariance` with these axes as `loose` has them, without correlation.
    pub(super) fn loosened(&self, covariance: &Covariance<6>, loose: &Covariance<6>) -> Covariance<6> {
        if self.is_empty() {
            return *covariance;
        }
        let (mut matrix, loose) = (*covariance.matrix(), loose.matrix());
        for axis in (0..6).filter(|axis| self.0[*axis]) {
            matrix.row_mut(axis).fill(0.0);
            matrix.column_mut(axis).fill(0.0);
            matrix[(axis, axis)] = loose[(axis, axis)];
        }
        Covariance::new(matrix).unwrap_or(*covariance)
    }
}

impl fmt::Display for Axes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let names: Vec<&str> = NAMES.iter().zip(self.0).filter(|(_, is)| *is).map(|(name, _)| *name).collect();
        f.write_str(&names.join(", "))
    }
}

/// Whether both keyframes state one pose covariance although the body moved.
pub(super) fn is_constant(last: &Keyframe, next: &Keyframe, config: &SubmapConfig) -> bool {
    let t_last_next = last.pose.pose.inverse() * next.pose.pose;
    let is_of_poses = [last, next].iter().all(|keyframe| keyframe.covariance_of == CovarianceOf::Pose);
    let moved = t_last_next.translation.norm() > config.voxel_m
        || t_last_next.rotation.angle() > config.rotation_deg.to_radians() / 10.0;
    let (a, b) = (last.pose.covariance.matrix(), next.pose.covariance.matrix());
    let scale = |r: usize, c: usize| (b[(r, r)] * b[(c, c)]).sqrt();
    is_of_poses && moved && (0..6).all(|r| (0..=r).all(|c| (a[(r, c)] - b[(r, c)]).abs() <= SAME * scale(r, c)))
}

/// What is odd about what a front end sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
pub enum Oddity {
    /// These axes are not measured.
    Unmeasured(Axes),
    /// One pose covariance for all poses.
    Constant,
    /// Each keyframe ends a submap, because these axes are less certain than `sigma_max_m` or `sigma_max_deg`.
    Blurs(Axes),
    /// Views lie over one another if poses and points are read in another way than they are.
    Read {
        /// In which.
        reading: Reading,
        /// Pairs of views that say so, of so many that tell the two apart.
        pairs: [u32; 2],
    },
    /// Labelled landmarks are where they should be if poses and points are read in another way than they are.
    Seen {
        /// In which.
        reading: Reading,
        /// Sightings that say so, of so many that tell the two apart.
        sightings: [u32; 2],
    },
    /// The body moves as if quaternions were written w first.
    WFirst,
    /// Points lie farther off than any sensor sees.
    Reach {
        /// In the median.
        metres: u32,
    },
    /// Keyframes lie so far apart that no two see the same.
    StepsApart {
        /// The steps, and how far points lie off, in the median, hundredths of a frame unit.
        centimetres: [u32; 2],
    },
    /// Stamps are not in nanoseconds: by so much they rise too slowly.
    Stamps {
        /// As a power of ten.
        power: u32,
    },
    /// Submaps have hardly any keypoints.
    Bare {
        /// The median.
        keypoints: u32,
    },
}

impl fmt::Display for Oddity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Unmeasured(axes) => write!(
                f,
                "the odometry does not measure {axes}, by its stated variances: taken to err there by submap.gap_sigma_per_m \
                 of the way"
            ),
            Self::Constant => f.write_str(
                "one pose covariance is stated for all poses, which is no chain's: motions are taken to err by \
                 submap.gap_sigma_per_m of the way; state covariance_of = \"motion\", or covariances that grow",
            ),
            Self::Blurs(axes) => {
                write!(
                    f,
                    "the stated covariances are too large in {axes} for views to be laid over one another: each keyframe is \
                     a submap of its own, and hardly any will merge; "
                )?;
                f.write_str(if *axes == ROTATION_FIRST {
                    "this is what wheels' covariances look like whose rotation stands first: state translation first"
                } else {
                    "state what the odometry really errs by from keyframe to keyframe, or raise submap.sigma_max_m and \
                     submap.sigma_max_deg"
                })
            }
            Self::Read { reading, pairs: [wins, pairs] } => {
                write!(f, "views lie over one another ({wins} pairs of {pairs}) if {reading}")
            }
            Self::Seen { reading, sightings: [wins, all] } => {
                write!(f, "labelled landmarks are where they should be ({wins} sightings of {all}) if {reading}")
            }
            Self::WFirst => write!(f, "the body moves one way in its own axes only if {}", Reading::WFirst),
            Self::Reach { metres } => write!(
                f,
                "points lie {metres} m off in the median, farther than any sensor sees: most likely they are in millimetres; \
                 send metres, or state submap.scale = \"unknown\""
            ),
            Self::StepsApart { centimetres } => {
                let [step, reach] = centimetres.map(|c| f64::from(c) / 100.0);
                write!(
                    f,
                    "keyframes lie {step} m apart, and points only {reach} m off, so that no two views overlap: send \
                     keyframes more often, or, if poses are in millimetres, metres"
                )
            }
            Self::Stamps { power } => {
                let unit = match power {
                    9 => "seconds",
                    6 => "milliseconds",
                    _ => "microseconds",
                };
                write!(f, "stamps rise as if they were in {unit}: send nanoseconds (times 10^{power})")
            }
            Self::Bare { keypoints } => write!(
                f,
                "submaps have {keypoints} keypoints in the median, too few to be recognised: points are too sparse for \
                 submap.voxel_m, or see little beyond one plane; try a voxel of a hundredth of how far they reach, a longer \
                 submap.distance_m, or the right submap.sensor"
            ),
        }
    }
}

/// What was told, and what is to be.
#[derive(Clone, Debug, Default)]
pub(super) struct Oddities {
    told: Vec<Oddity>,
    news: Vec<Oddity>,
    blurred: u32,
}

impl Oddities {
    /// Looks at a motion as it was stated between two keyframes.
    pub fn look(&mut self, last: &Keyframe, next: &Keyframe, is_constant: bool, config: &SubmapConfig) {
        let axes = Axes::unmeasured(&next.pose.covariance, config);
        if is_constant {
            self.tell(Oddity::Constant);
        } else if !axes.is_empty() && Axes::unmeasured(&last.pose.covariance, config) == axes {
            self.tell(Oddity::Unmeasured(axes)); // Twice: a habit.
        }
    }

    /// A submap of so many keyframes ended because this motion is too uncertain; or, without a motion, otherwise.
    pub fn ended(&mut self, keyframes: usize, by: Option<&Covariance<6>>, config: &SubmapConfig) {
        let axes = by.map(|stated| Axes::wider(stated, config)).filter(|axes| keyframes == 1 && !axes.is_empty());
        self.blurred = axes.map_or(0, |_| self.blurred.saturating_add(1));
        if let Some(axes) = axes.filter(|_| self.blurred >= BLURRED_MAX) {
            self.tell(Oddity::Blurs(axes));
        }
    }

    /// Keeps what is to be told, unless one of its kind was.
    pub fn tell(&mut self, oddity: Oddity) {
        let kind = core::mem::discriminant(&oddity);
        if !self.told.iter().any(|told| core::mem::discriminant(told) == kind) {
            self.told.push(oddity);
            self.news.push(oddity);
        }
    }

    /// What was found since the last call; each kind once.
    pub fn take(&mut self) -> Vec<Oddity> {
        core::mem::take(&mut self.news)
    }
}

#[cfg(test)]
#[path = "stated_tests.rs"]
mod tests;

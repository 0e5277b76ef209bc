//! The consensus of planar robots, in their three degrees of freedom.
//!
//! A laser or landmarks in the plane measure x, y and heading. Height, roll and pitch of such an alignment are a gauge,
//! the same in all: zero, as uncertain as floors and mountings are. Six dimensions take their never differing for
//! agreement, half of which is then not measured: an NFA and evidence that count it are too sure where the gauge is
//! narrow and, since a tilt grows with the way between two anchors, too unsure where they lie apart; χ² tests with six
//! degrees of freedom let pass what three refuse. In the plane the odometry, the alignments and what follows from them
//! are marginals that nothing out of it touches, so that nothing is lost.

use super::measured::Measured;
use super::{FrameConsensusConfig, FrameOutcome, PairAlignment};
use crate::geometry::se2::{IN_PLANE, OUT_OF_PLANE, in_plane};
use crate::geometry::{Covariance, PoseWithCovariance, Se2};
use crate::trajectory::Trajectory;
use nalgebra::Matrix6;

/// A pose is of the plane if its height, m, and tilts, rad, are at most this: what rounding makes of zero.
const FLAT_MAX: f64 = 1e-6;
/// A covariance ties plane and rest together if a correlation between them is larger than rounding makes zero.
const CORRELATION_MAX: f64 = 1e-6;

/// As [`super::align_frames`] of frames of which all that is known lies in one plane; `None` of others.
pub(super) fn align(
    alpha: &Trajectory,
    beta: &Trajectory,
    alignments: &[PairAlignment],
    config: &FrameConsensusConfig,
) -> Option<FrameOutcome> {
    if !is_planar(alpha, beta, alignments) {
        return None;
    }
    let outcome = measured(alpha, beta, alignments, config).outcome();
    Some(outcome.map(|used, pose: Se2, covariance: Covariance<3>| {
        let rest = used.iter().filter_map(|&k| out_of_plane(alpha, beta, alignments.get(k)?));
        let mut sigma = rest.min_by(|a, b| rest_of(a).total_cmp(&rest_of(b))).unwrap_or_else(Matrix6::identity);
        for (r, row) in IN_PLANE.into_iter().enumerate() {
            OUT_OF_PLANE.iter().for_each(|&c| (sigma[(row, c)], sigma[(c, row)]) = (0.0, 0.0));
            IN_PLANE.into_iter().enumerate().for_each(|(c, column)| sigma[(row, column)] = covariance.matrix()[(r, c)]);
        }
        PoseWithCovariance { pose: pose.in_space(), covariance: Covariance::new_or_wider(sigma) }
    }))
}

/// What was measured, in the plane.
pub(super) fn measured<'a>(
    alpha: &'a Trajectory,
    beta: &'a Trajectory,
    alignments: &[PairAlignment],
    config: &'a FrameConsensusConfig,
) -> Measured<'a, 3, Se2> {
    let flat = alignments.iter().map(|a| {
        let covariance = Covariance::new_or_wider(in_plane(a.t_i_j.covariance.matrix()));
        (a.i, a.j, (Se2::of(&a.t_i_j.pose), covariance, true))
    });
    Measured::new(alpha, beta, flat, config)
}

/// Whether nothing that two frames know leaves the plane: their anchors, the odometry between them, the alignments.
pub(super) fn is_planar(alpha: &Trajectory, beta: &Trajectory, alignments: &[PairAlignment]) -> bool {
    let odometry = || [alpha, beta].into_iter().flat_map(|t| (0..t.len()).filter_map(|k| t.anchor(k)));
    alignments.iter().map(|a| &a.t_i_j).chain(odometry()).all(is_flat)
}

fn is_flat(t: &PoseWithCovariance) -> bool {
    let (r, sigma) = (t.pose.rotation.matrix(), t.covariance.matrix());
    let tilt = r[(2, 0)].abs().max(r[(2, 1)].abs());
    let apart = |(row, column): (usize, usize)| {
        let product = sigma[(row, row)] * sigma[(column, column)];
        let (one, other) = (sigma[(row, column)], sigma[(column, row)]);
        (one * one).max(other * other) <= CORRELATION_MAX * CORRELATION_MAX * product
    };
    t.pose.translation.z.abs() <= FLAT_MAX
        && tilt <= FLAT_MAX
        // Upside down has no tilt, either.
        && r[(2, 2)] > 0.0
        && IN_PLANE.into_iter().flat_map(|r| OUT_OF_PLANE.map(|c| (r, c))).all(apart)
}

/// Covariance of T_αβ as one alignment alone has it. Height and tilts of a result are those of its best member: what
/// mounting and floor do to one alignment they do to all, so that many know no more of it.
fn out_of_plane(alpha: &Trajectory, beta: &Trajectory, a: &PairAlignment) -> Option<Matrix6<f64>> {
    let (t_alpha_i, t_beta_j) = (alpha.anchor(a.i)?, beta.anchor(a.j)?);
    Some(*t_alpha_i.compose(&a.t_i_j).compose(&t_beta_j.inverse()).covariance.matrix())
}

/// The variances of height and tilts, by which one is narrower than another.
fn rest_of(sigma: &Matrix6<f64>) -> f64 {
    OUT_OF_PLANE.iter().map(|&k| sigma[(k, k)]).sum()
}

#[cfg(test)]
#[path = "planar_tests.rs"]
mod tests;

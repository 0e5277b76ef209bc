//! What an alignment of two clouds cannot know: a submap's cloud is bent by the odometry drift within it, so the cloud as
//! a whole is displaced from the anchor it is named by, and every alignment of that submap inherits the same error.
//!
//! For a random walk of K steps from the anchor the mean displacement of the keyframes has about a third of the
//! variance of the whole walk, which is the odometry covariance to the next anchor. As that error is common to the
//! `n` alignments of one submap, each is charged `n` times its variance: together they then claim no more than one
//! measurement of the displaced cloud. (Exact for alignments dominated by the common error, conservative otherwise.)
//!
//! Of an alignment's own covariance, too, a share is common to all alignments of a submap: a depth camera bends every
//! view of a place alike. It is charged in the same way.

use crate::estimate::joint::{AgreedAlignment, FrameChain};
use crate::geometry::{Covariance, Relative};
use crate::ids::{FrameId, SubmapId};
use nalgebra::{Matrix6, SMatrix};
use std::collections::BTreeMap;

/// Variance of a submap's mean displacement from its anchor, per variance of the walk to the next anchor.
const SHARE_OF_WALK: f64 = 1.0 / 3.0;

/// Share of an alignment's own variance that its submaps' other alignments have in common. *Measured*: with 0 the
/// frames of the 7-Scenes thirds average a NEES of 8.6 for 6 degrees of freedom over 24 merges, with a quarter 6.5 on
/// the eight drift seeds it was chosen on and 7.4 on four others: still a little too small there.
const SHARE_IN_COMMON: f64 = 0.25;

/// Adds the common errors of both submaps to every alignment's covariance.
pub(super) fn charge(alignments: &mut [AgreedAlignment], frames: &BTreeMap<FrameId, FrameChain>) {
    let mut uses: BTreeMap<SubmapId, usize> = BTreeMap::new();
    for alignment in alignments.iter() {
        *uses.entry(alignment.i).or_default() += 1;
        *uses.entry(alignment.j).or_default() += 1;
    }
    let count = |id: &SubmapId| uses.get(id).copied().unwrap_or(1) as f64;
    let displacement = |id: &SubmapId| {
        let chain = frames.get(&id.frame)?;
        walk(chain, id.index as usize).map(|w| w * (SHARE_OF_WALK * count(id)))
    };
    for alignment in alignments {
        let others = 0.5 * (count(&alignment.i) + count(&alignment.j)) - 1.0;
        scale(&mut alignment.t_i_j, 1.0 + SHARE_IN_COMMON * others);
        let of_i = displacement(&alignment.i).unwrap_or_else(Matrix6::zeros);
        let of_j = displacement(&alignment.j).unwrap_or_else(Matrix6::zeros);
        widen(&mut alignment.t_i_j, &of_i, &of_j);
    }
}

/// Odometry covariance over the submap's own stretch: the step to the next anchor, or for the last submap the step
/// that led to it.
fn walk(chain: &FrameChain, index: usize) -> Option<Matrix6<f64>> {
    let step = chain.odometry.get(index + 1).or_else(|| chain.odometry.get(index).filter(|_| index > 0))?;
    Some(*step.covariance.matrix())
}

fn scale(t_i_j: &mut Relative, factor: f64) {
    match t_i_j {
        Relative::Metric(p) => p.covariance = p.covariance.scaled(factor),
        Relative::Similarity(s) => s.covariance = s.covariance.scaled(factor),
    }
}

/// `t_i_j` measured between displaced clouds: i's displacement acts through Ad(t_i_j⁻¹), j's directly.
fn widen(t_i_j: &mut Relative, of_i: &Matrix6<f64>, of_j: &Matrix6<f64>) {
    match t_i_j {
        Relative::Metric(p) => {
            let a = p.pose.inverse().adjoint();
            p.covariance = Covariance::new_or_wider(p.covariance.matrix() + a * of_i * a.transpose() + of_j);
        }
        Relative::Similarity(s) => {
            let a = s.sim.inverse().adjoint();
            let (of_i, of_j) = (lifted(of_i), lifted(of_j));
            s.covariance = Covariance::new_or_wider(s.covariance.matrix() + a * of_i * a.transpose() + of_j);
        }
    }
}

/// A rigid displacement leaves the scale alone.
fn lifted(m: &Matrix6<f64>) -> SMatrix<f64, 7, 7> {
    let mut out = SMatrix::<f64, 7, 7>::zeros();
    out.fixed_view_mut::<6, 6>(0, 0).copy_from(m);
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{PoseWithCovariance, Se3};
    use crate::ids::{EntryId, RobotId};
    use crate::wire::fact::ScaleKind;

    fn submap(robot: u8, index: u32) -> SubmapId {
        SubmapId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 1 }, index }
    }

    fn pose(sigma: f64) -> PoseWithCovariance {
        PoseWithCovariance { pose: Se3::identity(), covariance: Covariance::from_sigmas([sigma; 6]).unwrap() }
    }

    fn alignment(seq: u32, i: SubmapId, j: SubmapId) -> AgreedAlignment {
        let entry = EntryId { frame: i.frame, seq };
        AgreedAlignment { entry, i, j, t_i_j: Relative::Metric(pose(0.01)) }
    }

    /// However often one submap is aligned, its alignments together never claim to know the anchor better than the
    /// cloud's displacement from it allows.
    #[test]
    fn many_alignments_of_one_submap_do_not_average_its_distortion_away() {
        let chain = FrameChain { scale: ScaleKind::Metric, odometry: vec![pose(0.1); 40] };
        let frames = [1, 2].map(|robot| (submap(robot, 0).frame, chain.clone())).into();
        let mut all: Vec<_> = (0..20).map(|n| alignment(n, submap(1, 3), submap(2, n))).collect();
        charge(&mut all, &frames);
        let information: f64 = all
            .iter()
            .map(|a| match a.t_i_j {
                Relative::Metric(p) => 1.0 / p.covariance.matrix()[(0, 0)],
                Relative::Similarity(_) => 0.0,
            })
            .sum();
        assert!(1.0 / information >= SHARE_OF_WALK * 0.01, "claims a variance of {}", 1.0 / information);
    }
}

//! What an alignment of two clouds cannot know: most of its error is common to all alignments of a submap, because a
//! depth camera bends every view of a place alike, so that it neither averages out over alignments nor shows in their
//! residuals. As the joint estimate takes alignments as independent, each of `n` of one submap is charged `n` times its
//! variance: together they claim no more than one measurement of the bent cloud. (Exact where the common error is all
//! there is, conservative otherwise.)
//!
//! What two frames' alignments say of one another has only those in common that belong to both: an alignment is widened by
//! its submaps' uses between its two frames, for their consensus, and counts in the joint estimate with the share that
//! is left by the uses in all.
//!
//! A LiDAR bends nothing; what its alignments of one submap have in common is the noise of that submap's own points. *Measured*
//! over 2,670 pairs of alignments of one ray-cast submap: their errors correlate by 0.14 and 0.21 (translation, rotation).
//! So much of the variance comes from either submap, and twice their mean is charged for each further alignment:
//! `1 + c (n − 1)`, c = [`COMMON_LIDAR`]. In swarms that err just so (`merganser-sim bench calibration`) frames then have a
//! NEES of 1.0 by degrees of freedom; with half of it, 1.2.
//!
//! *Measured* on 7-Scenes with almost no odometry drift, where nothing else is left: charged a quarter of it, the merged
//! frames have a NEES of 18 for 6 degrees of freedom, charged in full 7.6.
//!
//! That odometry drift bends the cloud too is accounted for where submaps are anchored (see
//! [`builder`](crate::submap::builder)).

use crate::estimate::joint::AgreedAlignment;
use crate::geometry::Relative;
use crate::ids::{EntryId, FrameId, SubmapId};
use std::collections::BTreeMap;

/// Share of an alignment's variance that others of its submaps have in common, either submap's together, between submaps
/// that a LiDAR saw.
const COMMON_LIDAR: f64 = 0.35;

/// Share of an alignment's variance that others of its submaps have in common.
pub(super) fn common(bends: bool) -> f64 {
    if bends { 1.0 } else { COMMON_LIDAR }
}

/// Widens every alignment's covariance by what it has in `common` with the others of its submaps between its two frames,
/// and returns what share of its information is left once those with other frames are reckoned with.
pub(super) fn charge(alignments: &mut [AgreedAlignment], common: &[f64]) -> BTreeMap<EntryId, f64> {
    let mut uses: BTreeMap<SubmapId, usize> = BTreeMap::new();
    let mut uses_between: BTreeMap<(SubmapId, FrameId), usize> = BTreeMap::new();
    for AgreedAlignment { i, j, .. } in alignments.iter() {
        for (id, other) in [(i, j), (j, i)] {
            *uses.entry(*id).or_default() += 1;
            *uses_between.entry((*id, other.frame)).or_default() += 1;
        }
    }
    let mut shares = BTreeMap::new();
    for (AgreedAlignment { entry, i, j, t_i_j }, common) in alignments.iter_mut().zip(common) {
        let charged = |uses: [usize; 2]| 1.0 + common * (0.5 * (uses[0] + uses[1]) as f64 - 1.0);
        let in_all = charged([uses[i], uses[j]]);
        let between = charged([uses_between[&(*i, j.frame)], uses_between[&(*j, i.frame)]]);
        scale(t_i_j, between);
        shares.insert(*entry, between / in_all);
    }
    shares
}

fn scale(t_i_j: &mut Relative, factor: f64) {
    match t_i_j {
        Relative::Metric(p) => p.covariance = p.covariance.scaled(factor),
        Relative::Similarity(s) => s.covariance = s.covariance.scaled(factor),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::{Covariance, PoseWithCovariance, Se3};
    use crate::ids::RobotId;

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

    fn variance(a: &AgreedAlignment) -> f64 {
        match a.t_i_j {
            Relative::Metric(p) => p.covariance.matrix()[(0, 0)],
            Relative::Similarity(_) => f64::NAN,
        }
    }

    /// However often one submap is aligned, its alignments together never count as more than two.
    #[test]
    fn many_alignments_of_one_submap_do_not_average_its_distortion_away() {
        let information = |count: u32| {
            let mut all: Vec<_> = (0..count).map(|n| alignment(n, submap(1, 3), submap(2, n))).collect();
            charge(&mut all, &[1.0; 200]);
            all.iter().map(|a| 1.0 / variance(a)).sum::<f64>()
        };
        assert!((1.0 / information(1) - 1e-4).abs() < 1e-12, "a single one is left as it is");
        for count in [2, 20, 200] {
            // Between one and two measurements: the other submap of each alignment is seen once only.
            let measurements = 1e-4 * information(count);
            assert!((1.0..2.0).contains(&measurements), "{count} count as {measurements}");
        }
    }

    /// Five robots align one submap of a sixth: each pair of frames judges its own by what it claims, and together they
    /// still count as one measurement of that submap.
    #[test]
    fn uses_by_other_frames_take_a_share_and_leave_the_consensus_of_two_frames_alone() {
        let mut all: Vec<_> = (0..5).map(|n| alignment(n, submap(1, 3), submap(2 + n as u8, n))).collect();
        let shares = charge(&mut all, &[1.0; 5]);
        for a in &all {
            assert!((variance(a) - 1e-4).abs() < 1e-12);
            assert!((shares[&a.entry] - 1.0 / 3.0).abs() < 1e-12, "half of five and one uses");
        }
        let (mut within, other) = (all[..2].to_vec(), alignment(9, submap(1, 3), submap(2, 7)));
        within.push(other);
        within.iter_mut().for_each(|a| a.t_i_j = Relative::Metric(pose(0.01)));
        let shares = charge(&mut within, &[1.0; 3]);
        // Submap 1#3 has two uses with robot 2 and three in all.
        assert!((variance(&within[0]) - 1.5e-4).abs() < 1e-12 && (shares[&within[0].entry] - 0.75).abs() < 1e-12);
        assert!((variance(&within[1]) - 1e-4).abs() < 1e-12 && (shares[&within[1].entry] - 0.5).abs() < 1e-12);
    }

    #[test]
    fn of_lidar_alignments_only_the_common_share_is_charged() {
        let mut all: Vec<_> = (0..5).map(|n| alignment(n, submap(1, 3), submap(2, n))).collect();
        charge(&mut all, &[common(false); 5]);
        // Half of five uses and one are three: two beyond itself.
        assert!((variance(&all[0]) - 1e-4 * (1.0 + 2.0 * COMMON_LIDAR)).abs() < 1e-12);
        assert!(common(true) == 1.0 && common(false) < 1.0);
    }
}

//! A submap while it grows: what its keyframes saw about the first of them, until it is known which is the middle one.

use super::gravity::{self, Up};
use super::landmarks::{Gatherer, adjust};
use super::misfit::Views;
use super::place::PlaceMean;
use super::thinning::Thinner;
use super::{PoseWithCovariance, Submap};
use crate::geometry::{Covariance, Se3};
use crate::time::Stamp;
use nalgebra::{Matrix6, Vector3};

/// Stands for a standard deviation of zero: a body that did not move.
const ZERO_SIGMA: f64 = 1e-8;

#[derive(Clone, Debug)]
pub(super) struct Open {
    pub(super) stamps: [Stamp; 2],
    /// `t_prev_first`, or `t_frame_first` for the first submap: the first body pose in the anchor before.
    pub(super) odometry: PoseWithCovariance,
    pub(super) t_frame_first: Se3,
    /// Motion to each keyframe from the one before; none to the first.
    pub(super) motions: Vec<PoseWithCovariance>,
    /// All of them compounded.
    pub(super) gathered: Option<PoseWithCovariance>,
    /// `t_first_body` of each keyframe.
    pub(super) keyframes: Vec<Se3>,
    /// About the first body pose, until it is known which is the middle one.
    pub(super) cloud: Thinner,
    pub(super) landmarks: Gatherer,
    pub(super) place: PlaceMean,
    pub(super) views: Views,
    /// Which way each keyframe has up.
    pub(super) ups: Vec<Option<Up>>,
}

impl Open {
    /// The motion from the first keyframe to the one that this step leads to.
    pub(super) fn gathered_with(&self, step: &PoseWithCovariance) -> PoseWithCovariance {
        self.gathered.map_or(*step, |gathered| gathered.compose(step))
    }

    /// Position of the keyframe that anchors the submap.
    pub(super) fn middle(&self) -> usize {
        self.keyframes.len().saturating_sub(1) / 2
    }

    /// `t_first_anchor`.
    pub(super) fn t_first_anchor(&self) -> Se3 {
        self.keyframes.get(self.middle()).copied().unwrap_or_else(Se3::identity)
    }

    /// `t_anchor_last`: the last body pose.
    pub(super) fn t_anchor_last(&self) -> PoseWithCovariance {
        let last = self.keyframes.last().copied().unwrap_or_else(Se3::identity);
        along(self.motions.iter().skip(self.middle()), self.t_first_anchor().inverse() * last)
    }

    pub(super) fn close(self, index: u32) -> Submap {
        let t_first_anchor = self.t_first_anchor();
        let t_anchor_first = t_first_anchor.inverse();
        let odometry = self.odometry_to_anchor();
        let anchor = self.middle();
        let keyframes: Vec<Se3> = self.keyframes.iter().map(|t_first_body| t_anchor_first * *t_first_body).collect();
        let up = gravity::mean(&self.ups, &keyframes, &self.motions, anchor);
        let constellation = adjust(&self.landmarks.finish(), &self.motions, &keyframes, anchor);
        let (mut cloud, seen_from) = self.cloud.finish();
        let about_anchor = |p: [f32; 3]| moved(&t_anchor_first, p.map(f64::from)).map(|x| x as f32);
        cloud.iter_mut().for_each(|p| *p = about_anchor(*p));
        cloud.extend(constellation.landmarks.iter().map(|l| <[f32; 3]>::from(l.at.map(|x| x as f32))));
        Submap {
            index,
            stamps: self.stamps,
            odometry,
            t_frame_anchor: self.t_frame_first * t_first_anchor,
            keyframes,
            cloud,
            seen_from,
            constellation,
            place: self.place.finish(),
            up,
        }
    }

    pub(super) fn odometry_to_anchor(&self) -> PoseWithCovariance {
        if self.middle() == 0 {
            return self.odometry;
        }
        self.odometry.compose(&along(self.motions.iter().take(self.middle()), self.t_first_anchor()))
    }
}

/// Compounds motions. Their mean is known better from the SLAM's poses than from the product, which drifts by rounding.
fn along<'a>(motions: impl Iterator<Item = &'a PoseWithCovariance>, mean: Se3) -> PoseWithCovariance {
    let compounded = motions.copied().reduce(|sum, motion| sum.compose(&motion));
    let covariance = compounded.map_or_else(unmoved, |sum| sum.covariance);
    PoseWithCovariance { pose: mean, covariance }
}

/// The covariance of no motion at all.
fn unmoved() -> Covariance<6> {
    Covariance::new_or_wider(Matrix6::from_diagonal_element(ZERO_SIGMA * ZERO_SIGMA))
}

pub(super) fn moved(t: &Se3, p: [f64; 3]) -> [f64; 3] {
    (*t * Vector3::from(p)).into()
}

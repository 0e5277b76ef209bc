//! How far the swarm's beliefs are from the truth: each robot's merged frames against where those frames really lie,
//! and what one is in them.

use crate::check::{RobotSample, Sample};
use merganser_protocol::geometry::{Covariance, Se3, Sim3, So3};
use merganser_protocol::kinds::PairStatus;
use merganser_protocol::snapshot::{FrameView, PairView, PoseView, RelationView};
use nalgebra::{SMatrix, SVector};
use serde::Serialize;

/// The error of one robot's belief about one other frame.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct FrameError {
    /// The frame that the relation is given in, `name/epoch`.
    pub own: String,
    /// The frame that it places.
    pub frame: String,
    /// Error of the translation, m.
    pub metres: f64,
    /// Error of the rotation, degrees.
    pub degrees: f64,
    /// Scale over its true value.
    pub scale: f64,
    /// Normalised error squared, `δᵀ P⁻¹ δ`; infinite if the covariance is none.
    pub d2: f64,
    /// Its degrees of freedom: 6, or 7 where a unit is unknown.
    pub degrees_of_freedom: u32,
}

/// The errors of all frames that any robot has merged with its own, where the truth is known; of a liar's, not those of
/// its own. Where adversaries lie of themselves, the errors of what two honest robots measured of one another: of the
/// place of an adversary, and of what hangs on it alone, nothing is promised.
pub fn frame_errors(sample: &Sample<'_>) -> Vec<FrameError> {
    sample.robots.iter().flat_map(|robot| errors_of(robot, sample)).collect()
}

fn errors_of(robot: &RobotSample, sample: &Sample<'_>) -> Vec<FrameError> {
    let Some(snapshot) = &robot.snapshot else { return Vec::new() };
    let own = &snapshot.frames.own;
    let Some(t_world_own) = sample.truth.get(own) else { return Vec::new() };
    let deceives_itself = |frame: &FrameView| robot.lies && frame.robot == snapshot.status.robot;
    let is_promised = |frame: &FrameView| {
        let lies = |name: &String| sample.adversaries.contains(name);
        let measured = |pair: &PairView| {
            pair.status == PairStatus::Merged && [&pair.a, &pair.b].iter().all(|end| [own, &frame.frame].contains(end))
        };
        let is_honest = !lies(&snapshot.status.robot) && !lies(&frame.robot);
        sample.adversaries.is_empty() || (is_honest && snapshot.frames.pairs.iter().any(measured))
    };
    let others = snapshot.frames.frames.iter();
    let others = others.filter(|frame| frame.frame != *own && !deceives_itself(frame) && is_promised(frame));
    others
        .filter_map(|frame| {
            let relation = frame.t_own_frame.as_ref()?;
            let truth = t_world_own.inverse() * *sample.truth.get(&frame.frame)?;
            Some(error(own, &frame.frame, relation, &truth, t_world_own.scale))
        })
        .collect()
}

/// `unit_m` is what one is in the own frame.
fn error(own: &str, frame: &str, relation: &RelationView, truth: &Sim3, unit_m: f64) -> FrameError {
    let estimate = similarity(&relation.pose);
    let apart = |estimate: Sim3| unit_m * (estimate.translation - truth.translation).norm();
    let turned = |estimate: Sim3| (estimate.rotation.inverse() * truth.rotation).angle().to_degrees();
    FrameError {
        own: own.to_owned(),
        frame: frame.to_owned(),
        metres: estimate.map_or(f64::NAN, apart),
        degrees: estimate.map_or(f64::NAN, turned),
        scale: relation.pose.scale / truth.scale,
        d2: estimate.map_or(f64::INFINITY, |estimate| match relation.covariance.len() {
            28 => normalised(relation, &estimate.local(truth)),
            _ => normalised(relation, &estimate.to_se3().local(&truth.to_se3())),
        }),
        degrees_of_freedom: if relation.covariance.len() == 28 { 7 } else { 6 },
    }
}

/// `δᵀ P⁻¹ δ` of a rigid relation's error; infinite for what is none.
pub fn nees(relation: &RelationView, truth: &Se3) -> f64 {
    rigid(&relation.pose).map_or(f64::INFINITY, |estimate| normalised(relation, &estimate.local(truth)))
}

/// Infinite unless the covariance is one, of as many values as the error has.
fn normalised<const N: usize>(relation: &RelationView, delta: &SVector<f64, N>) -> f64 {
    if relation.covariance.len() != N * (N + 1) / 2 {
        return f64::INFINITY;
    }
    Covariance::new(square::<N>(&relation.covariance)).map_or(f64::INFINITY, |p| p.mahalanobis_squared(delta))
}

/// A pose with its scale; `None` if it is not finite, or its quaternion or scale are none.
pub fn similarity(pose: &PoseView) -> Option<Sim3> {
    let rigid = rigid(pose)?;
    (pose.scale.is_finite() && pose.scale > 0.0).then(|| Sim3::new(rigid.rotation, rigid.translation, pose.scale))
}

/// The rigid part of a pose; `None` if it is not finite or its quaternion is zero.
pub fn rigid(pose: &PoseView) -> Option<Se3> {
    let finite = pose.translation.iter().all(|x| x.is_finite());
    Some(Se3::new(So3::from_xyzw(pose.rotation).filter(|_| finite)?, pose.translation.into()))
}

/// The symmetric matrix of a row-major upper triangle.
pub fn square<const N: usize>(triangle: &[f64]) -> SMatrix<f64, N, N> {
    let mut m = SMatrix::zeros();
    let places = (0..N).flat_map(|row| (row..N).map(move |column| (row, column)));
    for ((row, column), &value) in places.zip(triangle) {
        m[(row, column)] = value;
        m[(column, row)] = value;
    }
    m
}

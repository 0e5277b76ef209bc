//! How far the swarm's beliefs are from the truth: each robot's merged frames against where those frames really lie.

use crate::check::{RobotSample, Sample};
use merganser_protocol::geometry::{Covariance, Se3, So3};
use merganser_protocol::snapshot::{FrameView, PoseView, RelationView};
use nalgebra::{SMatrix, Vector6};
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
    /// Scale over its true value (1 for metric frames).
    pub scale: f64,
    /// Normalised error squared, `δᵀ P⁻¹ δ`; `None` for similarities.
    pub d2: Option<f64>,
}

/// The errors of all frames that any robot has merged with its own, where the truth is known; of a liar's, not those of
/// its own.
pub fn frame_errors(sample: &Sample<'_>) -> Vec<FrameError> {
    sample.robots.iter().flat_map(|robot| errors_of(robot, sample)).collect()
}

fn errors_of(robot: &RobotSample, sample: &Sample<'_>) -> Vec<FrameError> {
    let Some(snapshot) = &robot.snapshot else { return Vec::new() };
    let own = &snapshot.frames.own;
    let Some(t_world_own) = sample.truth.get(own) else { return Vec::new() };
    let deceives_itself = |frame: &FrameView| robot.lies && frame.robot == snapshot.status.robot;
    let others = snapshot.frames.frames.iter().filter(|frame| frame.frame != *own && !deceives_itself(frame));
    others
        .filter_map(|frame| {
            let relation = frame.t_own_frame.as_ref()?;
            let truth = t_world_own.inverse() * *sample.truth.get(&frame.frame)?;
            Some(error(own, &frame.frame, relation, &truth))
        })
        .collect()
}

fn error(own: &str, frame: &str, relation: &RelationView, truth: &Se3) -> FrameError {
    let (metres, degrees, d2) = match rigid(&relation.pose) {
        None => (f64::NAN, f64::NAN, Some(f64::INFINITY)),
        Some(estimate) => {
            let delta = estimate.local(truth);
            let apart = (estimate.translation - truth.translation).norm();
            (apart, (estimate.inverse() * *truth).rotation.angle().to_degrees(), normalised(relation, &delta))
        }
    };
    FrameError { own: own.to_owned(), frame: frame.to_owned(), metres, degrees, scale: relation.pose.scale, d2 }
}

/// `δᵀ P⁻¹ δ` of a rigid relation's error; `None` for similarities, infinite for what is none.
pub fn nees(relation: &RelationView, truth: &Se3) -> Option<f64> {
    match rigid(&relation.pose) {
        None => Some(f64::INFINITY),
        Some(estimate) => normalised(relation, &estimate.local(truth)),
    }
}

/// `None` unless the covariance is that of a rigid motion; infinite if it is no covariance.
fn normalised(relation: &RelationView, delta: &Vector6<f64>) -> Option<f64> {
    (relation.covariance.len() == 21).then(|| {
        let covariance = Covariance::new(square::<6>(&relation.covariance));
        covariance.map_or(f64::INFINITY, |p| p.mahalanobis_squared(delta))
    })
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

//! Submap anchors, their truth, and how far a map is from it.

use crate::bench::fit::rms_after_fit;
use crate::swarm::Outcome;
use crate::truth::rigid;
use anyhow::{Context, ensure};
use merganser_protocol::agent::Agent;
use merganser_protocol::geometry::Se3;
use merganser_protocol::snapshot::{RelationView, Snapshot};
use nalgebra::Vector3;

/// A submap's anchor was a keyframe: nothing else lies so near by odometry, m.
const SAME_M: f64 = 1e-3;

/// A submap's anchor.
#[derive(Clone, Debug)]
pub(super) struct Anchor {
    /// `name/epoch#index`.
    pub(super) name: String,
    pub(super) robot: usize,
    pub(super) index: u32,
    /// Which keyframe of its robot's drive it is.
    pub(super) step: usize,
    /// The truth.
    pub(super) t_world_anchor: Se3,
    /// By odometry alone.
    pub(super) t_frame_anchor: Se3,
    /// By the joint estimate of the first robot.
    pub(super) t_own_anchor: Option<RelationView>,
}

impl Anchor {
    /// By the joint estimate of the first robot, without its covariance.
    pub(super) fn estimated(&self) -> Option<Se3> {
        rigid(&self.t_own_anchor.as_ref()?.pose)
    }

    pub(super) fn is_near(&self, other: &Self, metres: f64) -> bool {
        (self.t_world_anchor.translation - other.t_world_anchor.translation).norm_squared() <= metres * metres
    }
}

/// All submaps that a robot knows, with their truth.
///
/// # Errors
/// A submap that is of no robot's drive.
pub(super) fn anchors(outcome: &Outcome<Agent>, snapshot: &Snapshot) -> anyhow::Result<Vec<Anchor>> {
    let mut all = Vec::new();
    for view in &snapshot.map.submaps {
        let robot = outcome.stage.names().iter().position(|name| *name == view.robot).context("an unknown robot")?;
        let t_frame_anchor = rigid(&view.t_frame_anchor).context("an anchor that is no pose")?;
        let off =
            |k: &usize| (outcome.stage.steps(robot)[*k].t_frame_body.translation - t_frame_anchor.translation).norm();
        let steps = 0..outcome.stage.steps(robot).len();
        let step = steps.min_by(|a, b| off(a).total_cmp(&off(b))).context("a robot that never drove")?;
        ensure!(off(&step) < SAME_M, "{}#{} is no keyframe: {} m", view.frame, view.index, off(&step));
        all.push(Anchor {
            name: format!("{}#{}", view.frame, view.index),
            robot,
            index: view.index,
            step,
            t_world_anchor: outcome.stage.steps(robot)[step].t_world_body,
            t_frame_anchor,
            t_own_anchor: view.t_own_anchor.clone(),
        });
    }
    all.sort_by_key(|anchor| (anchor.robot, anchor.index));
    Ok(all)
}

/// Root mean square distance of anchors from the truth after the rigid motion that fits best, m.
pub(super) fn errors(anchors: &[Anchor], place: impl Fn(&Anchor) -> Option<Se3>) -> f64 {
    let pairs: Vec<(Vector3<f64>, Vector3<f64>)> =
        anchors.iter().filter_map(|a| Some((a.t_world_anchor.translation, place(a)?.translation))).collect();
    rms_after_fit(&pairs)
}

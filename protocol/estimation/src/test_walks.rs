//! Robots whose odometry walks at random and bends the clouds that it makes, for tests of what both have in common.

use super::test_graphs::*;
use super::test_world::{ODOMETRY, World};
use crate::geometry::{Covariance, PoseWithCovariance, Se3};
use crate::ids::SubmapId;
use core::num::NonZero;
use nalgebra::Vector6;
use rand_chacha::ChaCha8Rng;
use std::collections::BTreeMap;

/// Robots that drove, and told how many keyframes made each submap, but not yet what they saw of one another.
pub(crate) struct Walked {
    pub(crate) world: World,
    /// Where each anchor would be if its submap's keyframes lay by it as the odometry says: `t_world_anchor` of the
    /// cloud.
    pub(crate) clouds: BTreeMap<SubmapId, Se3>,
    /// The last of each robot.
    pub(crate) bodies: Vec<Body>,
}

/// The last keyframe of a robot's last submap.
pub(crate) struct Body {
    /// From the last anchor, as measured.
    pub(crate) t_anchor_body: PoseWithCovariance,
    /// The truth.
    pub(crate) t_world_body: Se3,
}

/// From the last anchor to the last keyframe.
pub(crate) fn onward() -> Se3 {
    Se3::exp(&Vector6::new(1.0, 0.1, 0.0, 0.02, -0.01, 0.2))
}

/// Drives them, with three keyframes to a submap or more.
pub(crate) fn walked(rng: &mut ChaCha8Rng, robots: u8, anchors: usize, keyframes: u16) -> Walked {
    let mut world = World::new(rng, robots, anchors, true);
    let (mut clouds, mut bodies) = (BTreeMap::new(), Vec::new());
    for robot in 0..robots {
        let chain = &mut world.problem.frames.get_mut(&frame(robot)).unwrap().odometry;
        let truth = |index: usize| world.truth[&submap(robot, index)];
        let (of_robot, body) = walk(rng, chain, truth, keyframes);
        clouds.extend((0..).zip(of_robot).map(|(index, cloud)| (submap(robot, index), cloud)));
        bodies.push(body);
    }
    world.problem.keyframes = world.truth.keys().map(|id| (*id, NonZero::new(keyframes).unwrap())).collect();
    Walked { world, clouds, bodies }
}

/// Makes a chain's exact steps those of odometry that walks; its clouds, and its last body.
fn walk(
    rng: &mut ChaCha8Rng,
    chain: &mut [PoseWithCovariance],
    truth: impl Fn(usize) -> Se3,
    keyframes: u16,
) -> (Vec<Se3>, Body) {
    let before = (keyframes - 1) / 2;
    let after = keyframes - 1 - before;
    let step = sigmas(ODOMETRY.0, ODOMETRY.1).scaled(1.0 / f64::from(keyframes));
    let steps = |count: u16| step.scaled(f64::from(count));
    let mut clouds = Vec::new();
    // What was lost from the anchor before to the first keyframe, and from the anchor to the last one.
    let (mut since, mut from) = (Vector6::zeros(), Vector6::zeros());
    for (index, stated) in chain.iter_mut().enumerate() {
        let [to, sum_before] = one_side(rng, before, &step);
        let sum_after;
        [from, sum_after] = one_side(rng, after, &step);
        // A keyframe before the anchor lies behind by what was lost on the way to it.
        clouds.push(truth(index) * Se3::exp(&((sum_after - sum_before) / f64::from(keyframes))));
        let (pose, covariance) = match index {
            // The origin is the first keyframe.
            0 => (stated.pose, steps(before)),
            _ => {
                let moved = stated.pose.inverse().adjoint();
                let covariance = steps(after + 1).transported(&moved).unwrap().plus(&steps(before));
                (Se3::exp(&-since) * stated.pose, covariance)
            }
        };
        *stated = PoseWithCovariance { pose: pose * Se3::exp(&-to), covariance };
        // One more step leads to the next submap's first keyframe.
        since = from + noise(rng, &step);
    }
    let covariance = steps(after).transported(&onward().inverse().adjoint()).unwrap();
    let t_world_body = truth(chain.len() - 1) * Se3::exp(&from) * onward();
    (clouds, Body { t_anchor_body: PoseWithCovariance { pose: onward(), covariance }, t_world_body })
}

/// Odometry on one side of an anchor, seen from there: what it is off by as a whole, and the sum of what the keyframes
/// on the way are off by.
fn one_side(rng: &mut ChaCha8Rng, steps: u16, step: &Covariance<6>) -> [Vector6<f64>; 2] {
    let (mut off, mut sum) = (Vector6::zeros(), Vector6::zeros());
    for _ in 0..steps {
        off += noise(rng, step);
        sum += off;
    }
    [off, sum]
}

//! How live robots lie by one another: decides which relations are drawn from the joint estimate before its
//! factorisation goes, and what is told of pairs of robots.
//!
//! A robot is where its anchor is, by the estimate, and by that anchor where its beacon says. The anchors of two robots
//! are correlated, as whatever ties both of them to a third moves both alike: so their relation is asked of the
//! estimate itself, and never made of two poses in our frame (MATH §3). The beacons are independent of one another; in
//! relations of two robots they are taken to be so of the estimate too, which is cautious
//! ([`ends`](crate::estimate::extrapolation)).

use super::Estimation;
use crate::agent::context::Context;
use crate::agent::replication::Body;
use crate::agent::replication::beacons::Beacons;
use crate::agent::replication::knowledge::Gaps;
use crate::estimate::MapProblem;
use crate::geometry::{PoseWithCovariance, Relative, Se3};
use crate::ids::{RobotId, SubmapId};
use crate::snapshot::{RelationView, RobotPairView, RobotView};
use crate::time::Instant;
use std::collections::BTreeSet;

/// With so many live robots, this one included, the relation of every two of them is told: 120 pairs, 100 kB of JSON.
/// With more, only the relations to this robot are: those of two others stand in their own views.
pub const ROBOTS_ALL_PAIRS_MAX: usize = 16;

/// A robot and the keyframe that it was last heard of.
pub(in crate::agent) struct Live {
    robot: RobotId,
    anchor: SubmapId,
    t_anchor_body: PoseWithCovariance,
    /// Whether it is known to be there now.
    is_live: bool,
    age_secs: f64,
    stamp_secs: f64,
}

/// Every robot whose pose is known, this one first; the others ascend.
pub(in crate::agent) fn live_robots(
    context: &Context,
    body: Option<Body>,
    beacons: &Beacons,
    now: Instant,
) -> Vec<Live> {
    let own = body.map(|(index, t_anchor_body, stamp)| {
        let anchor = SubmapId { frame: context.frame(), index };
        let stamp_secs = stamp.as_secs_f64();
        Live { robot: context.robot(), anchor, t_anchor_body, is_live: true, age_secs: 0.0, stamp_secs }
    });
    let others = beacons.last_known(now).map(|(robot, known)| Live {
        robot,
        anchor: known.content.anchor,
        t_anchor_body: known.content.t_anchor_body,
        is_live: known.is_live,
        age_secs: known.age_secs,
        stamp_secs: known.content.stamp.as_secs_f64(),
    });
    own.into_iter().chain(others).collect()
}

/// The anchors of live robots that the estimate of `problem` is to relate, as the problem counts them: those of the
/// beacons at hand, and the latest of all, which beacons will tell of by the time it is solved.
pub(super) fn live_pairs(me: RobotId, live: &[Live], problem: &MapProblem, gaps: &Gaps) -> Vec<(SubmapId, SubmapId)> {
    let anchors_of = |live: &Live| {
        let frame = live.anchor.frame;
        let count = problem.frames.get(&frame).map_or(0, |chain| chain.odometry.len());
        let index = place(gaps, live.anchor);
        let latest = count.checked_sub(1).and_then(|last| u32::try_from(last).ok());
        let known = index.filter(|&index| (index as usize) < count);
        let all: BTreeSet<u32> = known.into_iter().chain(latest).collect();
        all.into_iter().map(|index| SubmapId { frame, index }).collect()
    };
    let is_ours_first = live.first().is_some_and(|first| first.robot == me);
    pairs_among(&live.iter().map(anchors_of).collect::<Vec<_>>(), is_ours_first)
}

/// Live pose = estimate ∘ beacon. `t_odom_body` is of this robot alone: where its SLAM has it.
pub(in crate::agent) fn robot_view(
    context: &Context,
    estimation: &Estimation,
    live: &Live,
    t_odom_body: Option<Se3>,
) -> RobotView {
    let t_own_body = estimation.t_own_body(context.frame(), live.anchor, &live.t_anchor_body);
    RobotView {
        robot: context.robot_name(live.robot),
        live: live.is_live,
        age_secs: live.age_secs,
        stamp_secs: live.stamp_secs,
        anchor: context.submap_name(live.anchor),
        t_own_body: t_own_body.as_ref().map(RelationView::from),
        t_map_odom: t_own_body.zip(t_odom_body).map(|(body, odom)| RelationView::from(&body.onto(&odom.inverse()))),
    }
}

/// The relations of live robots that the estimate knows.
pub(in crate::agent) fn pair_views(context: &Context, estimation: &Estimation, live: &[Live]) -> Vec<RobotPairView> {
    let live: Vec<&Live> = live.iter().filter(|robot| robot.is_live).collect();
    let pairs = live.iter().enumerate().flat_map(|(k, a)| live[k + 1..].iter().map(move |b| (a, b)));
    let related = pairs.filter_map(|(a, b)| {
        let t_anchor_anchor = estimation.t_anchor_anchor(a.anchor, b.anchor)?;
        let t_a_b = between_bodies(&a.t_anchor_body, &t_anchor_anchor, &b.t_anchor_body);
        let [a, b] = [a, b].map(|live| context.robot_name(live.robot));
        Some(RobotPairView { a, b, t_a_b: RelationView::from(&t_a_b) })
    });
    related.collect()
}

/// `t_a_b` of two bodies from that of their anchors.
fn between_bodies(at_a: &PoseWithCovariance, t_a_b: &Relative, at_b: &PoseWithCovariance) -> Relative {
    Relative::Metric(*at_a).inverse().compose(t_a_b).compose(&Relative::Metric(*at_b))
}

/// Where a chain that has gaps holds a submap.
fn place(gaps: &Gaps, id: SubmapId) -> Option<u32> {
    match gaps.get(&id.frame) {
        Some(chain) => chain.binary_search(&id.index).ok().and_then(|place| u32::try_from(place).ok()),
        None => Some(id.index),
    }
}

/// Pairs of anchors of different robots: of all robots, or, of more than [`ROBOTS_ALL_PAIRS_MAX`], with the first if it
/// is ours.
fn pairs_among(robots: &[Vec<SubmapId>], is_ours_first: bool) -> Vec<(SubmapId, SubmapId)> {
    let firsts = match robots.len() {
        0..=ROBOTS_ALL_PAIRS_MAX => robots.len(),
        _ => usize::from(is_ours_first),
    };
    let mut pairs = Vec::new();
    for (k, of_a) in robots[..firsts].iter().enumerate() {
        for of_b in &robots[k + 1..] {
            pairs.extend(of_a.iter().flat_map(|&a| of_b.iter().map(move |&b| (a, b))));
        }
    }
    pairs
}

#[cfg(test)]
#[path = "live_tests.rs"]
mod tests;

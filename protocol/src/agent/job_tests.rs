use super::job::*;
use crate::config::{AlignConfig, Sensor};
use crate::geometry::Relative;
use crate::submap::Described;
use crate::submap::testing::{config, moved_room, room};
use crate::wire::fact::{RefusalReason, ScaleKind};
use nalgebra::Vector3;
use std::sync::Arc;

fn moved(turn: f64, x: f64) -> Described {
    moved_room(6, Vector3::new(0.1, -0.2, turn), Vector3::new(x, 0.1, 0.05)).0
}

/// A loop between a room and the same room seen from elsewhere, looked at from there as `back` sees it.
fn closed(theirs: &Described, back: Option<&Described>) -> Result<Measured, RefusalReason> {
    let mine = room(6);
    let job = AlignJob {
        theirs: Arc::new(theirs.keypoints.clone()),
        mine: Arc::new(mine.features),
        back: back.map(|theirs| (Arc::new(mine.keypoints), Arc::new(theirs.features.clone()))),
        config: AlignConfig::default(),
        voxel_m: config().voxel_m,
        sensor: Sensor::Points3d,
        scale: ScaleKind::Metric,
        seed: 1,
    };
    let JobResult::Aligned(answer) = Job::Align(Box::new(job)).run() else { panic!("another job's result") };
    answer.map(|measured| *measured)
}

#[test]
fn a_loop_counts_if_it_is_seen_from_both_ends() {
    let theirs = moved(1.2, 0.3);
    let one_way = closed(&theirs, None).unwrap();
    let both = closed(&theirs, Some(&theirs)).unwrap();
    let (Relative::Metric(one_way_pose), Relative::Metric(pose)) = (one_way.t_mine_theirs, both.t_mine_theirs) else {
        panic!("metric")
    };
    let off = one_way_pose.pose.local(&pose.pose).norm();
    assert!(off > 0.0 && off < 0.01, "midway between two that differ a little: {off}");
    assert!(both.support <= one_way.support && both.sigma >= one_way.sigma && both.log10_nfa >= one_way.log10_nfa);
}

#[test]
fn a_loop_that_looks_otherwise_from_its_other_end_is_ambiguous() {
    let theirs = moved(1.2, 0.3);
    assert!(closed(&moved(1.2, 0.6), None).is_ok(), "from elsewhere the room is found as well");
    assert_eq!(closed(&theirs, Some(&moved(1.2, 0.6))).unwrap_err(), RefusalReason::Ambiguous);
    assert_eq!(closed(&theirs, Some(&room(7))).unwrap_err(), RefusalReason::NoConsensus);
}

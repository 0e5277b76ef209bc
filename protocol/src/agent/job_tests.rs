use super::job::*;
use crate::config::{AlignConfig, Sensor};
use crate::geometry::{Relative, So3};
use crate::submap::testing::{config, moved_room, room};
use crate::submap::{Described, Up, Verticals};
use crate::wire::fact::{RefusalReason, ScaleKind};
use nalgebra::Vector3;
use std::sync::Arc;

fn moved(turn: f64, x: f64) -> Described {
    moved_room(6, Vector3::new(0.1, -0.2, turn), Vector3::new(x, 0.1, 0.05)).0
}

/// A loop between a room and the same room seen from elsewhere, looked at from there as `back` sees it.
fn closed(theirs: &Described, back: Option<&Described>) -> Result<Measured, RefusalReason> {
    aligned(theirs, back, ScaleKind::Metric, None)
}

fn aligned(
    theirs: &Described,
    back: Option<&Described>,
    scale: ScaleKind,
    verticals: Option<Verticals>,
) -> Result<Measured, RefusalReason> {
    let mine = room(6);
    let job = AlignJob {
        theirs: Arc::new(theirs.keypoints.clone()),
        mine: Arc::new(mine.features),
        back: back.map(|theirs| (Arc::new(mine.keypoints), Arc::new(theirs.features.clone()))),
        config: AlignConfig::default(),
        voxel_m: config().voxel_m,
        sensor: Sensor::Points3d,
        verticals,
        scale,
        seed: 1,
    };
    let JobResult::Aligned(answer) = Job::Align(Box::new(job)).run() else { panic!("another job's result") };
    answer.map(|measured| *measured).map_err(|why| why.reason)
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

#[test]
fn what_is_upright_stays_so_at_both_ends_and_in_any_unit() {
    let (theirs, t_theirs_mine) = moved_room(6, Vector3::new(0.1, -0.2, 1.2), Vector3::new(0.3, 0.1, 0.05));
    let up = |direction: Vector3<f64>| Up::new(direction.into(), 0.02).unwrap();
    let verticals = |tilt: f64| {
        let tilted = So3::exp(&Vector3::new(0.0, tilt, 0.0)) * Vector3::z();
        Some(Verticals { theirs: up(t_theirs_mine.rotation * Vector3::z()), mine: up(tilted) })
    };
    for back in [None, Some(&theirs)] {
        assert!(aligned(&theirs, back, ScaleKind::Metric, verticals(0.0)).is_ok());
        let tilted = aligned(&theirs, back, ScaleKind::Metric, verticals(0.35));
        assert_eq!(tilted.unwrap_err(), RefusalReason::NoConsensus);
    }
    assert!(aligned(&theirs, None, ScaleKind::Unknown, verticals(0.0)).is_ok());
    let tilted = aligned(&theirs, None, ScaleKind::Unknown, verticals(0.35));
    assert_eq!(tilted.unwrap_err(), RefusalReason::NoConsensus);
}

//! What a map says against itself, where a pair is judged, and where paths are drawn; on the other tests' views.

use super::evaluate::evaluate;
use super::tests::{BOUNDS, PER_SUBMAP, all_views, broken, covariance, frame, path, relation, tracks};
use super::views::{self, Views};
use merganser_protocol::snapshot::{EdgeView, FailedView, MiddleView, PairStatus, PoseView};
use nalgebra::Vector6;

/// Scans correct the odometry, so that anchors lie on another way than the poses that the SLAM sent: hung from anchors,
/// those would be off by all that was corrected.
#[test]
fn paths_are_those_that_anchors_lie_on() {
    let tracks = tracks();
    let mut views = all_views(&tracks, &Vector6::zeros());
    let t_world = |robot: usize| tracks[robot].t_world_frame().unwrap().to_se3();
    for (own, track) in tracks.iter().enumerate() {
        let right = |k: usize| t_world(own).inverse() * track.truth.as_ref().unwrap()[k];
        views[own].path = path(&tracks, own, right);
        for submap in views.iter_mut().flat_map(|views| &mut views.map.submaps) {
            if submap.frame == frame(own) {
                submap.t_frame_anchor = PoseView::from(&right(submap.index as usize * PER_SUBMAP));
            }
        }
    }
    // A keyframe that was refused goes on by odometry.
    let lost = views[1].path.keyframes.remove(PER_SUBMAP + 2);
    let evaluation = evaluate(&tracks, &views, Some(&BOUNDS));
    let t_ref_world = t_world(0).inverse();
    for (robot, track) in tracks.iter().enumerate() {
        let corrected = evaluation.corrected[robot].as_ref().unwrap();
        for (k, body) in corrected.poses.iter().enumerate() {
            let truth = t_ref_world * track.truth.as_ref().unwrap()[k];
            let off = truth.local(&body.to_se3()).norm();
            if track.stamps_secs[k] != lost.stamp_secs || robot != 1 {
                assert!(off < 1e-9, "{robot} {k}: {off}");
            } else {
                let before = track.truth.as_ref().unwrap()[k - 1];
                let step = track.odometry[k - 1].inverse() * track.odometry[k];
                assert!((t_ref_world * before * step).local(&body.to_se3()).norm() < 1e-9 && off > 1e-3, "{off}");
            }
        }
    }
    // The alignment is judged by where its anchors truly are, too.
    assert!(evaluation.singles.count == 1 && evaluation.singles.nees_mean < 1e-9, "{:?}", evaluation.singles);
}

#[test]
fn a_map_that_contradicts_itself_is_told() {
    let none = Vector6::zeros();
    let edge = |views: &Views, contradicts| EdgeView {
        weight: if contradicts { 0.0 } else { 1.0 },
        contradicts,
        ..views.graph.edges[0].clone()
    };
    // Two hold. One against them may be false; as many as hold may be right.
    let against = |n: usize| {
        broken(&none, move |views| {
            let more = std::iter::once(edge(&views[0], false)).chain((0..n).map(|_| edge(&views[0], true)));
            let more: Vec<EdgeView> = more.collect();
            views[0].graph.edges.extend(more);
        })
    };
    assert!(against(1).is_empty());
    let told = against(2);
    assert!(told.len() == 1 && told[0].contains("alpha–beta: 2 alignments hold, 2 contradict them"), "{told:?}");
    let told = broken(&none, |views| views[0].frames.pairs[1].status = PairStatus::Inconsistent);
    assert!(told.len() == 1 && told[0].contains("alpha–gamma is inconsistent"), "{told:?}");
    let told = broken(&none, |views| {
        let reason = "it did not converge".into();
        views[2].graph.failed.push(FailedView { frames: vec![frame(2)], reason });
    });
    assert!(told.len() == 1 && told[0].contains("gamma could not solve it: it did not converge"), "{told:?}");
}

/// Loops of one robot are counted apart from alignments of two.
#[test]
fn loops_that_contradict_are_told() {
    let tracks = tracks();
    let mut views = all_views(&tracks, &Vector6::zeros());
    let one = views[0].graph.edges[0].clone();
    let own = |contradicts| EdgeView {
        j: "alpha/7#2".into(),
        weight: if contradicts { 0.0 } else { 1.0 },
        contradicts,
        ..one.clone()
    };
    views[0].graph.edges.extend([own(false), own(true), own(true)]);
    let evaluation = evaluate(&tracks, &views, None);
    let told: Vec<_> = evaluation.loops.iter().map(|c| (c.hold, c.contradict)).collect();
    assert_eq!(told, [(1, 2), (0, 0), (0, 0)]);
    assert_eq!((evaluation.pairs[0].certainty.hold, evaluation.pairs[0].certainty.contradict), (1, 0));
    let printed = super::report::evaluation(&evaluation, &tracks);
    assert!(printed.contains("Loops of alpha: 1 alignments hold, 2 contradict"), "{printed}");
    assert!(!printed.contains("Loops of beta"), "{printed}");
}

/// What a merge is worth shows where both were: a frame may lie well there, and its origin be far off, or the reverse.
#[test]
fn a_pair_is_judged_where_both_were() {
    let tracks = tracks();
    let with_middle = |error: f64| {
        let mut views = all_views(&tracks, &Vector6::zeros());
        let edge = views[0].graph.edges[0].clone();
        let t = views::relation(&edge.t_i_j).unwrap().pose.retract(&Vector6::new(0.0, error, 0.0, 0.0, 0.0, 0.0));
        views[0].frames.pairs[0].middle = Some(MiddleView { i: edge.i, j: edge.j, t_i_j: relation(t) });
        evaluate(&tracks, &views, None)
    };
    let right = with_middle(0.0);
    assert!(right.held() && right.pairs[0].middle.unwrap().translation_m < 1e-9);
    let sigmas = covariance().sigmas();
    let (ends, known) = right.pairs[0].certainty.middle.clone().unwrap();
    assert_eq!((ends, known.as_slice()), (["alpha/7#0".into(), "beta/7#2".into()], sigmas.as_slice()));
    let off = with_middle(0.5);
    assert!(!off.held() && (off.pairs[0].middle.unwrap().translation_m - 0.5).abs() < 1e-9);
}

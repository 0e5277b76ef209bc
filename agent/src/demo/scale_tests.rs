//! The evaluation of robots whose units nobody knew: the same map as in the other tests, each robot in a unit of its own.

use super::evaluate::{Evaluation, evaluate};
use super::report;
use super::tests::{BOUNDS, all_views, tracks};
use super::track::Track;
use super::views::{Views, relation};
use merganser_protocol::geometry::sim3::Matrix7;
use merganser_protocol::geometry::{Covariance, Relative, Se3, Sim3, SimWithCovariance, So3};
use merganser_protocol::snapshot::{PoseView, RelationView};
use nalgebra::{Vector3, Vector6};

const UNITS_M: [f64; 3] = [0.5, 1.3, 2.0];
/// Standard deviation of log-scale that the robots state.
const LOG_SCALE_SIGMA: f64 = 0.01;

fn unit(robot: usize) -> Sim3 {
    Sim3::new(So3::identity(), Vector3::zeros(), UNITS_M[robot])
}

/// A rigid relation in metres as `a` and `b`, each in its unit, would have it.
fn in_units(view: &RelationView, a: usize, b: usize) -> RelationView {
    let t = relation(view).unwrap();
    let sim = unit(a).inverse() * Sim3::from_se3(&t.pose) * unit(b);
    let mut m = Matrix7::from_diagonal_element(LOG_SCALE_SIGMA * LOG_SCALE_SIGMA);
    let per_unit = Vector6::from_fn(|k, _| if k < 3 { 1.0 / UNITS_M[b] } else { 1.0 });
    let of_six = t.covariance.matrix().component_mul(&(per_unit * per_unit.transpose()));
    m.fixed_view_mut::<6, 6>(0, 0).copy_from(&of_six);
    RelationView::from(&Relative::Similarity(SimWithCovariance { sim, covariance: Covariance::new(m).unwrap() }))
}

/// Tracks and views of the other tests, with this error, in units.
fn swarm(error: &Vector6<f64>) -> (Vec<Track>, Vec<Views>) {
    let (mut tracks, metric) = (tracks(), all_views(&tracks(), error));
    let robot = |tracks: &[Track], frame: &str| tracks.iter().position(|t| frame.starts_with(&t.name)).unwrap();
    let mut views = metric;
    for (own, one) in views.iter_mut().enumerate() {
        for pair in &mut one.frames.pairs {
            let (a, b) = (robot(&tracks, &pair.a), robot(&tracks, &pair.b));
            pair.t_a_b = pair.t_a_b.as_ref().map(|t| in_units(t, a, b));
        }
        for submap in &mut one.map.submaps {
            let of = robot(&tracks, &submap.frame);
            submap.t_own_anchor = submap.t_own_anchor.as_ref().map(|t| in_units(t, own, of));
            submap.t_frame_anchor.translation = submap.t_frame_anchor.translation.map(|x| x / UNITS_M[of]);
        }
        for edge in &mut one.graph.edges {
            edge.t_i_j = in_units(&edge.t_i_j, robot(&tracks, &edge.i), robot(&tracks, &edge.j));
        }
    }
    for (track, unit_m) in tracks.iter_mut().zip(UNITS_M) {
        track.unit_m = Some(unit_m);
        track.odometry.iter_mut().for_each(|t| *t = Se3::new(t.rotation, t.translation / unit_m));
    }
    (tracks, views)
}

fn evaluated(spoil: impl FnOnce(&mut Vec<Track>, &mut Vec<Views>)) -> Evaluation {
    let (mut tracks, mut views) = swarm(&Vector6::zeros());
    spoil(&mut tracks, &mut views);
    evaluate(&tracks, &views, &BOUNDS)
}

#[test]
fn errors_are_in_metres_whatever_the_units_are() {
    let error = Vector6::new(0.02, -0.01, 0.03, 0.002, 0.004, -0.003);
    let metric = evaluate(&tracks(), &all_views(&tracks(), &error), &BOUNDS);
    let (tracks, views) = swarm(&error);
    let scaled = evaluate(&tracks, &views, &BOUNDS);
    assert!(scaled.held(), "{:?}", scaled.checks);
    for (m, s) in metric.pairs.iter().zip(&scaled.pairs) {
        let (m, s) = (m.error.unwrap(), s.error.unwrap());
        assert!((m.translation_m - s.translation_m).abs() < 1e-9, "{} {}", m.translation_m, s.translation_m);
        assert!((m.rotation_deg - s.rotation_deg).abs() < 1e-9 && (s.scale - 1.0).abs() < 1e-12);
        assert!((m.nees / s.nees - 1.0).abs() < 1e-6 && s.degrees_of_freedom == 7);
    }
    let (m, s) = (metric.trajectory.unwrap(), scaled.trajectory.unwrap());
    assert!((m.merged_m.1 - s.merged_m.1).abs() < 1e-9 && (m.alone_m.1 - s.alone_m.1).abs() < 1e-9, "{m:?} {s:?}");
    assert!((metric.singles.translation_rms_m - scaled.singles.translation_rms_m).abs() < 1e-9);
    assert!((metric.singles.nees_mean * 6.0 / 7.0 / scaled.singles.nees_mean - 1.0).abs() < 1e-6);
}

#[test]
fn a_wrong_scale_is_told() {
    // Half a standard deviation: inside; four: outside, and so would be the rest of the map.
    let off = |factor: f64| {
        let evaluation = evaluated(|_, views| {
            for pair in views.iter_mut().flat_map(|v| &mut v.frames.pairs) {
                pair.t_a_b.as_mut().unwrap().pose.scale *= factor;
            }
        });
        let error = evaluation.pairs[0].error.unwrap();
        assert!((error.scale / factor - 1.0).abs() < 1e-12);
        (evaluation.held(), error.inside_95(), report::evaluation(&evaluation, &tracks()))
    };
    let (held, inside, text) = off(1.005);
    assert!(held && inside && text.contains("scale +0.50 %") && text.contains("14.067"), "{text}");
    let (held, inside, text) = off(0.95);
    assert!(!held && !inside && text.contains("scale -5.00 %"), "{text}");
}

#[test]
fn a_scale_that_is_not_told_is_wrong() {
    let evaluation = evaluated(|_, views| {
        for pair in views.iter_mut().flat_map(|v| &mut v.frames.pairs) {
            let pose = pair.t_a_b.take().unwrap().pose;
            let rigid = PoseView { scale: 1.0, ..pose };
            let covariance = Covariance::from_sigmas([9.0; 6]).unwrap();
            let mut view = RelationView::from(&Relative::Metric(merganser_protocol::geometry::PoseWithCovariance {
                pose: Se3::identity(),
                covariance,
            }));
            view.pose = rigid;
            pair.t_a_b = Some(view);
        }
    });
    let wrong = evaluation.checks.iter().filter(|check| !check.held && check.found.contains("scale")).count();
    assert_eq!(wrong, 3, "{:?}", evaluation.checks);
}

#[test]
fn without_a_unit_nothing_is_judged_and_nothing_is_claimed() {
    let evaluation = evaluated(|tracks, _| tracks.iter_mut().for_each(|track| track.unit_m = None));
    assert!(evaluation.pairs.iter().all(|pair| pair.truth.is_none() && pair.error.is_none() && pair.t_a_b.is_some()));
    assert!(evaluation.trajectory.is_none() && evaluation.singles.count == 0);
    assert_eq!(evaluation.checks.len(), 2);
}

//! The evaluation of robots whose units nobody knew: the same map as in the other tests, each robot in a unit of its
//! own.

use super::evaluate::{CHI2_7_95, Evaluation, PoseError, evaluate};
use super::outputs::{Cloud, Outcome};
use super::scene;
use super::tests::{BOUNDS, all_views, record, tracks};
use super::trajectory::{fit, fit_similarity};
use super::views::{Views, relation, relative};
use super::*;
use crate::picture::Scene;
use merganser_protocol::geometry::sim3::{Matrix7, Vector7};
use merganser_protocol::geometry::{Covariance, Relative, Se3, Sim3, SimWithCovariance, So3};
use merganser_protocol::snapshot::{PoseView, RelationView};
use merganser_protocol::wire::fact::ScaleKind;
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
        for keyframe in &mut one.path.keyframes {
            for t in [&mut keyframe.t_odom_body, &mut keyframe.t_frame_body] {
                t.translation = t.translation.map(|x| x / UNITS_M[own]);
            }
        }
        for edge in &mut one.graph.edges {
            edge.t_i_j = in_units(&edge.t_i_j, robot(&tracks, &edge.i), robot(&tracks, &edge.j));
        }
    }
    for (track, unit_m) in tracks.iter_mut().zip(UNITS_M) {
        (track.scale, track.unit_m) = (ScaleKind::Unknown, Some(unit_m));
        track.odometry.iter_mut().for_each(|t| *t = Se3::new(t.rotation, t.translation / unit_m));
    }
    (tracks, views)
}

/// Disturbs every estimate of a pair, and makes its standard deviations larger by a factor.
fn disturb(views: &mut [Views], error: &Vector7, factor: f64) {
    for pair in views.iter_mut().flat_map(|views| &mut views.frames.pairs) {
        let Some(Relative::Similarity(t)) = pair.t_a_b.as_ref().and_then(relative) else { panic!("a similarity") };
        let covariance = t.covariance.scaled(factor * factor);
        let t = SimWithCovariance { sim: t.sim.retract(error), covariance };
        pair.t_a_b = Some(RelationView::from(&Relative::Similarity(t)));
    }
}

fn seen(views: Vec<Views>) -> Seen {
    Seen { ending: Ending::Done, after: Duration::from_secs(3), views }
}

fn broken(evaluation: &Evaluation) -> Vec<String> {
    let broken = evaluation.checks.iter().filter(|check| !check.held);
    broken.map(|check| format!("{}: {}", check.what, check.found)).collect()
}

fn evaluated(spoil: impl FnOnce(&mut Vec<Track>, &mut Vec<Views>)) -> Evaluation {
    let (mut tracks, mut views) = swarm(&Vector6::zeros());
    spoil(&mut tracks, &mut views);
    evaluate(&tracks, &views, Some(&BOUNDS))
}

#[test]
fn errors_are_in_metres_whatever_the_units_are() {
    let error = Vector6::new(0.02, -0.01, 0.03, 0.002, 0.004, -0.003);
    let metric = evaluate(&tracks(), &all_views(&tracks(), &error), Some(&BOUNDS));
    let (tracks, views) = swarm(&error);
    let scaled = evaluate(&tracks, &views, Some(&BOUNDS));
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
    // A claim of no scale is an error of scale, far outside of what it claims.
    let error = evaluation.pairs[0].error.unwrap();
    let log_scale = -(UNITS_M[1] / UNITS_M[0]).ln();
    assert!((error.xi[6] - log_scale).abs() < 1e-12 && error.degrees_of_freedom == 7 && !error.inside_95());
}

#[test]
fn a_rigid_motion_is_wrong_even_if_the_units_happen_to_be_the_same() {
    for (unknown, wrong) in [(vec![], 0), (vec![2], 2), (vec![0, 1, 2], 3)] {
        let (mut tracks, views) = (tracks(), all_views(&tracks(), &Vector6::zeros()));
        unknown.iter().for_each(|robot| tracks[*robot].scale = ScaleKind::Unknown);
        let told = broken(&evaluate(&tracks, &views, Some(&BOUNDS)));
        assert_eq!(told.len(), wrong, "{told:?}");
        assert!(told.iter().all(|line| line.contains("a similarity, ") && line.contains(": a rigid motion, 0.000 m")));
        // Nor is it right where nobody knows the units.
        tracks.iter_mut().filter(|track| track.scale == ScaleKind::Unknown).for_each(|track| track.unit_m = None);
        let told = broken(&evaluate(&tracks, &views, Some(&BOUNDS)));
        assert!(told.len() == wrong && told.iter().all(|line| line.ends_with(": a rigid motion")), "{told:?}");
    }
}

#[test]
fn a_known_error_is_found_to_the_digit() {
    let error = Vector7::from([0.02, -0.01, 0.03, 0.002, 0.004, -0.003, 0.006]);
    let evaluation = evaluated(|_, views| disturb(views, &error, 1.0));
    assert!(evaluation.held(), "{:?}", evaluation.checks);
    for pair in &evaluation.pairs {
        let (found, truth) = (pair.error.unwrap(), pair.truth.unwrap());
        assert!((found.xi - error).amax() < 1e-12, "{}", found.xi);
        assert!((found.scale / error[6].exp() - 1.0).abs() < 1e-12);
        let robot = tracks().iter().position(|track| track.name == pair.robots[0]).unwrap();
        let moved = UNITS_M[robot] * (truth.retract(&error).translation - truth.translation).norm();
        assert!((found.translation_m - moved).abs() < 1e-12 && moved > 0.01, "{moved}");
        assert!((found.rotation_deg - error.fixed_rows::<3>(3).norm().to_degrees()).abs() < 1e-9);
    }
}

#[test]
fn the_ellipsoid_of_a_similarity_has_seven_axes() {
    let sigmas = [0.1, 0.2, 0.3, 0.01, 0.02, 0.04, 0.005];
    let covariance = Covariance::from_sigmas(sigmas).unwrap();
    let truth = Sim3::exp(&Vector7::from([1.0, 2.0, 3.0, 0.4, -0.2, 2.0, 0.7]));
    let of = |deviations: f64| {
        let sim = truth.retract(&(Vector7::from(sigmas) * deviations));
        PoseError::of(&Relative::Similarity(SimWithCovariance { sim, covariance }), &truth, 1.0)
    };
    assert!((of(1.0).nees - 7.0).abs() < 1e-9 && of(1.0).degrees_of_freedom == 7);
    let edge = (CHI2_7_95 / 7.0).sqrt();
    assert!(of(0.999 * edge).inside_95() && !of(1.001 * edge).inside_95());
}

#[test]
fn a_scale_may_be_off_by_a_twentieth_and_no_more_however_uncertain() {
    let off = |factor: f64| {
        let error = Vector7::from([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, factor.ln()]);
        broken(&evaluated(|_, views| disturb(views, &error, 20.0))).len()
    };
    assert_eq!([off(1.049), off(0.951), off(1.051), off(0.949)], [0, 0, 3, 3]);
}

#[test]
fn a_covariance_that_is_too_small_is_told() {
    let error = Vector7::from([0.02, -0.01, 0.03, 0.002, 0.004, -0.003, 0.006]);
    let at = |factor: f64| evaluated(|_, views| disturb(views, &error, factor));
    let largest = at(1.0).pairs.iter().map(|pair| pair.error.unwrap().nees).fold(0.0, f64::max);
    // The 99.9 % ellipsoid: the worst pair just inside, and just outside.
    let edge = (largest / 24.321_886_347_856_854).sqrt();
    assert!(at(1.001 * edge).held());
    assert!(!broken(&at(0.999 * edge)).is_empty());
    let told = broken(&at(0.01));
    assert!(told.len() == 3 && told.iter().all(|line| line.contains("scale +0.60 %")), "{told:?}");
}

#[test]
fn relations_that_are_none_are_refused() {
    let (_, views) = swarm(&Vector6::zeros());
    let good = views[0].frames.pairs[0].t_a_b.clone().unwrap();
    let rigid = all_views(&tracks(), &Vector6::zeros())[0].frames.pairs[0].t_a_b.clone().unwrap();
    assert!(matches!(relative(&good), Some(Relative::Similarity(_))) && relation(&good).is_none());
    assert!(matches!(relative(&rigid), Some(Relative::Metric(_))) && relation(&rigid).is_some());
    let refused = |of: &RelationView, spoil: &dyn Fn(&mut RelationView)| {
        let mut view = of.clone();
        spoil(&mut view);
        relative(&view).is_none()
    };
    for view in [&good, &rigid] {
        assert!(!refused(view, &|_| ()));
        for bad in [f64::NAN, f64::INFINITY] {
            assert!(refused(view, &|v| v.pose.translation[1] = bad));
            assert!(refused(view, &|v| v.pose.rotation[0] = bad));
            assert!(refused(view, &|v| v.pose.scale = bad));
            assert!(refused(view, &|v| v.covariance[1] = bad));
        }
        assert!(refused(view, &|v| v.pose.rotation = [0.0; 4]));
        let stretch = |k: f64| move |v: &mut RelationView| v.pose.rotation = v.pose.rotation.map(|x| x * k);
        assert!(!refused(view, &stretch(1.0 + 1e-7)) && refused(view, &stretch(1.0 + 1e-5)));
        assert!(refused(view, &|v| v.pose.scale = 0.0) && refused(view, &|v| v.pose.scale = -1.0));
        assert!(refused(view, &|v| v.covariance[0] = -1e-4), "not positive definite");
        assert!(refused(view, &|v| v.covariance.truncate(20)) && refused(view, &|v| v.covariance.push(0.0)));
    }
    assert!(refused(&rigid, &|v| v.pose.scale = 1.01) && !refused(&good, &|v| v.pose.scale = 1.01));
}

#[test]
fn the_best_fit_has_a_scale_only_where_the_first_robot_knows_none() {
    let t = Sim3::exp(&Vector7::from([1.0, -2.0, 0.5, 0.3, 2.0, -1.0, 0.4]));
    let points: Vec<Vector3<f64>> =
        (0..9).map(f64::from).map(|i| Vector3::new(i, (i * 1.7).sin(), (i * 0.6).cos())).collect();
    let moved: Vec<_> = points.iter().map(|p| t * *p).collect();
    assert!(t.local(&fit_similarity(&points, &moved)).norm() < 1e-9);
    assert_eq!(fit_similarity(&points[..1], &moved[..1]).scale, 1.0, "one point has no size");
    // The whole map 3 % too large, as if the first robot's unit were: no error after the fit, where that is free.
    let larger = |views: &mut [Views]| {
        for anchor in views[0].map.submaps.iter_mut().filter_map(|submap| submap.t_own_anchor.as_mut()) {
            anchor.pose.translation = anchor.pose.translation.map(|x| x * 1.03);
            anchor.pose.scale *= 1.03;
        }
    };
    let right = evaluated(|_, _| ()).trajectory.unwrap();
    let free = evaluated(|_, views| larger(views)).trajectory.unwrap();
    assert!(free.merged_m.1 > 0.05 && (free.fitted_m.1 - right.fitted_m.1).abs() < 1e-9, "{free:?}");
    assert!((free.fitted_scale.unwrap() * 1.03 / right.fitted_scale.unwrap() - 1.0).abs() < 1e-9);
    let known = |tracks: &mut Vec<Track>| tracks[0].scale = ScaleKind::Metric;
    let bound = evaluated(|tracks, views| (known(tracks), larger(views)).0).trajectory.unwrap();
    assert!(bound.fitted_scale.is_none() && bound.fitted_m.1 > 2.0 * right.fitted_m.1, "{bound:?}");
    // Fitting rigid what needs no scale is the same.
    assert!(fit(&points, &points).log().norm() < 1e-9 && (fit_similarity(&points, &points).scale - 1.0).abs() < 1e-12);
}

/// The picture's contents.
fn drawn(tracks: &[Track], views: &[Views]) -> Scene {
    let evaluation = evaluate(tracks, views, Some(&BOUNDS));
    let outcome = Outcome { recordings: &[], tracks, views, evaluation: &evaluation, headline: String::new() };
    scene::scene(&outcome, &[Cloud::default(), Cloud::default(), Cloud::default()])
}

#[test]
fn the_picture_is_the_same_in_metres() {
    let near = |a: &[Vector3<f64>], b: &[Vector3<f64>]| {
        assert!(a.len() == b.len() && a.iter().zip(b).all(|(a, b)| (a - b).norm() < 1e-9), "{a:?} {b:?}");
    };
    let error = Vector6::new(0.02, -0.01, 0.03, 0.002, 0.004, -0.003);
    let (mut tracks, views) = swarm(&error);
    let (metric, scaled) = (drawn(&tests::tracks(), &all_views(&tests::tracks(), &error)), drawn(&tracks, &views));
    assert!(metric.in_metres && scaled.in_metres);
    for (m, s) in metric.robots.iter().zip(&scaled.robots) {
        near(&m.alone.1, &s.alone.1);
        near(&m.merged.1, &s.merged.1);
        near(&m.truth, &s.truth);
        assert!(m.anchors.len() == 3 && s.anchors.len() == 3);
        for (m, s) in m.anchors.iter().zip(&s.anchors) {
            near(&[m.0], &[s.0]);
            assert!((m.1 - s.1).amax() < 1e-9 * m.1.amax(), "{} {}", m.1, s.1);
        }
    }
    near(metric.alignments.as_flattened(), scaled.alignments.as_flattened());
    // With the unit of the first robot unknown, everything is in its units.
    tracks[0].unit_m = None;
    let unknown = drawn(&tracks, &views);
    assert!(!unknown.in_metres && unknown.robots.iter().all(|robot| robot.truth.is_empty()));
    let in_units: Vec<_> = metric.robots[1].merged.1.iter().map(|p| p / UNITS_M[0]).collect();
    near(&in_units, &unknown.robots[1].merged.1);
}

#[test]
fn what_is_written_and_printed_tells_the_scale() {
    let dir = tempfile::tempdir().unwrap();
    let (tracks, mut views) = swarm(&Vector6::zeros());
    disturb(&mut views, &Vector7::from([0.01, 0.0, 0.0, 0.0, 0.0, 0.0, 0.001]), 1.0);
    let recordings = record(&tracks, &dir.path().join("recordings"));
    let read: Vec<Track> = recordings.iter().map(Track::of).collect();
    assert!(read.iter().zip(&tracks).all(|(r, t)| (r.scale, r.unit_m) == (t.scale, t.unit_m)));
    let driven = |tracks: &[Track]| tracks.iter().map(Track::driven_m).sum::<f64>();
    assert!((driven(&read) - driven(&tests::tracks())).abs() < 1e-6, "in metres");
    let evaluation = evaluate(&tracks, &views, Some(&BOUNDS));
    write(&recordings, &tracks, &seen(views), &evaluation, dir.path()).unwrap();
    let json: serde_json::Value =
        serde_json::from_slice(&fs::read(dir.path().join("alignments.json")).unwrap()).unwrap();
    let pair = &json["pairs"][0];
    let near =
        |value: &serde_json::Value, wanted: f64| assert!((value.as_f64().unwrap() - wanted).abs() < 1e-9, "{value}");
    near(&pair["truth"]["scale"], UNITS_M[1] / UNITS_M[0]);
    near(&pair["error"]["scale"], 0.001f64.exp());
    near(&json["chi2_7_95"], CHI2_7_95);
    near(&json["units_m"]["gamma"], UNITS_M[2]);
    assert_eq!((pair["error"]["xi"].as_array().unwrap().len(), &pair["error"]["degrees_of_freedom"]), (7, &7.into()));
    assert!(json["conventions"].as_str().unwrap().contains("log-scale"));
    let printed = report::evaluation(&evaluation, &tracks);
    for part in
        ["scale         2.6026   σ 1.00 %", "scale +0.10 %", "(NEES ≤ 14.067)", "best fit of the swarm, with scale"]
    {
        assert!(printed.contains(part), "{part} is not in\n{printed}");
    }
    assert!(report::checks(&evaluation.checks).contains("1.5° and 5 % of scale"));
}

#[test]
fn one_robot_without_a_unit_keeps_nobody_else_from_being_judged() {
    let evaluation = evaluated(|tracks, _| tracks[2].unit_m = None);
    assert!(evaluation.held(), "{:?}", evaluation.checks);
    let errors: Vec<bool> = evaluation.pairs.iter().map(|pair| pair.error.is_some()).collect();
    assert_eq!(errors, [true, false, false]);
    let told: Vec<bool> =
        evaluation.checks[3..].iter().map(|check| check.what.contains("how far off is unknown")).collect();
    assert_eq!(told, [false, true, true]);
    // It still has to be found.
    let lost = evaluated(|tracks, views| {
        tracks[2].unit_m = None;
        views[0].frames.pairs[2].t_a_b = None;
    });
    assert!(broken(&lost).iter().any(|line| line.contains("beta–gamma") && line.contains("no alignment")));
}

#[test]
fn robots_that_know_the_metre_are_judged_beside_one_that_does_not() {
    let (mut tracks, mut views) = (tracks(), all_views(&tracks(), &Vector6::zeros()));
    let (in_units, scaled) = swarm(&Vector6::zeros());
    // gamma in its unit, alpha and beta in metres.
    tracks[2] = in_units[2].clone();
    for (views, scaled) in views.iter_mut().zip(&scaled) {
        for (pair, other) in [(1, 0), (2, 1)] {
            let t = scaled.frames.pairs[pair].t_a_b.as_ref().and_then(relative).unwrap().lifted();
            let t = SimWithCovariance { sim: unit(other) * t.sim, ..t };
            views.frames.pairs[pair].t_a_b = Some(RelationView::from(&Relative::Similarity(t)));
        }
    }
    let evaluation = evaluate(&tracks, &views, Some(&BOUNDS));
    assert!(evaluation.held(), "{:?}", evaluation.checks);
    let freedoms: Vec<usize> = evaluation.pairs.iter().map(|pair| pair.error.unwrap().degrees_of_freedom).collect();
    assert_eq!(freedoms, [6, 7, 7]);
    let text = report::evaluation(&evaluation, &tracks);
    assert!(text.contains("(NEES ≤ 12.592, with a scale 14.067)"), "{text}");
}

#[test]
fn without_a_unit_nothing_is_judged_and_nothing_is_claimed() {
    let evaluation = evaluated(|tracks, _| tracks.iter_mut().for_each(|track| track.unit_m = None));
    assert!(evaluation.pairs.iter().all(|pair| pair.truth.is_none() && pair.error.is_none() && pair.t_a_b.is_some()));
    assert!(evaluation.trajectory.is_none() && evaluation.singles.count == 0);
    assert!(evaluation.held(), "{:?}", evaluation.checks);
    assert!(evaluation.checks[3..].iter().all(|check| check.what.contains("how far off is unknown")));
}

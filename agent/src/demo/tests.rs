//! The evaluation and the outputs on views made up here: no process, no network.

use super::evaluate::{Bounds, CHI2_6_95, PoseError, evaluate, missing};
use super::track::Track;
use super::trajectory::fit;
use super::views::Views;
use super::*;
use crate::recording::{Drift, Writer, cloud};
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3};
use merganser_protocol::snapshot::{
    EdgeView, FrameView, FramesView, GraphView, KeyframeView, MapView, PairStatus, PairView, PathView, PoseView,
    RelationView, StatsView, StatusView, SubmapView,
};
use merganser_protocol::submap::{CovarianceOf, Keyframe};
use merganser_protocol::time::Stamp;
use merganser_protocol::wire::fact::ScaleKind;
use merganser_recording::manifest::{CloudFormat, Manifest};
use nalgebra::{Matrix6, Vector3, Vector6};
use std::collections::BTreeMap;

const NAMES: [&str; 3] = ["alpha", "beta", "gamma"];
pub(super) const BOUNDS: Bounds = Bounds { translation_m: 0.15, rotation_deg: 1.5 };
/// Keyframes of a robot and of a submap.
const KEYFRAMES: usize = 12;
pub(super) const PER_SUBMAP: usize = 4;

fn pose(rho: [f64; 3], phi: [f64; 3]) -> Se3 {
    Se3::exp(&Vector6::new(rho[0], rho[1], rho[2], phi[0], phi[1], phi[2]))
}

/// A covariance with unequal axes and correlations.
pub(super) fn covariance() -> Covariance<6> {
    let a = Matrix6::from_fn(|r, c| if r == c { 0.02 * (r + 1) as f64 } else { 0.003 * ((r * 2 + c) % 3) as f64 });
    Covariance::new(a * a.transpose()).unwrap()
}

pub(super) fn tracks() -> Vec<Track> {
    let drift = Drift { per_metre: 0.02, floor_m: 0.005, step_deg: 0.5 };
    let track = |(index, name): (usize, &&str)| {
        let start = pose([3.0 * index as f64, -1.0, 0.2], [0.1, 0.0, 1.3 * index as f64]);
        let truth: Vec<Se3> = (0..KEYFRAMES)
            .map(|k| start * pose([0.4 * k as f64, 0.1 * k as f64, 0.0], [0.0, 0.02, 0.1 * k as f64]))
            .collect();
        Track {
            name: (*name).into(),
            stamps_secs: (0..KEYFRAMES).map(|k| 0.5 * k as f64).collect(),
            odometry: drift.odometry(&truth, index as u64).unwrap().iter().map(|p| p.pose).collect(),
            scale: ScaleKind::Metric,
            unit_m: Some(1.0),
            truth: Some(truth),
        }
    };
    NAMES.iter().enumerate().map(track).collect()
}

pub(super) fn relation(pose: Se3) -> RelationView {
    RelationView::from(&Relative::Metric(PoseWithCovariance { pose, covariance: covariance() }))
}

pub(super) fn frame(robot: usize) -> String {
    format!("{}/7", NAMES[robot])
}

/// What robot `own` would show if its estimate of each pair were the truth disturbed by `error`, and of each anchor the
/// truth.
fn views(tracks: &[Track], own: usize, error: &Vector6<f64>) -> Views {
    let t_world = |robot: usize| tracks[robot].t_world_frame().unwrap().to_se3();
    let t_a_b = |a: usize, b: usize| (t_world(a).inverse() * t_world(b)).retract(error);
    let pair = |a: usize, b: usize| PairView {
        a: frame(a),
        b: frame(b),
        status: PairStatus::Merged,
        proposed: 9,
        agreed: 8,
        used: 7,
        log10_nfa: Some(-20.0),
        t_a_b: Some(relation(t_a_b(a, b))),
        middle: None,
        reason: String::new(),
    };
    let submap = |robot: usize, index: usize| {
        let (first, last) = (index * PER_SUBMAP, (index + 1) * PER_SUBMAP - 1);
        let track = &tracks[robot];
        SubmapView {
            frame: frame(robot),
            robot: NAMES[robot].into(),
            index: index as u32,
            stamps_secs: [track.stamps_secs[first], track.stamps_secs[last]],
            t_frame_anchor: PoseView::from(&track.odometry[first]),
            t_own_anchor: Some(relation(t_world(own).inverse() * track.truth.as_ref().unwrap()[first])),
        }
    };
    // alpha/7#0 and beta/7#2
    let first_of = |robot: usize, submap: usize| tracks[robot].truth.as_ref().unwrap()[submap * PER_SUBMAP];
    let true_t_i_j = first_of(0, 0).inverse() * first_of(1, 2);
    let others = |robot: usize| (0..3).filter(move |i| *i != robot).map(|i| NAMES[i].to_owned()).collect::<Vec<_>>();
    Views {
        status: StatusView {
            swarm: "demo".into(),
            robot: NAMES[own].into(),
            id: "00".into(),
            epoch: 7,
            neighbours: others(own),
            entries: 30,
            digest: "abcd".into(),
            estimate: String::new(),
            submaps: 3,
            keyframes: KEYFRAMES as u64,
            keyframes_lost: BTreeMap::new(),
            gaps: 0,
            remarks: Vec::new(),
            pending: 0,
            idle: true,
            merged_with: others(own),
            unsaved: 0,
            receive_only: false,
        },
        frames: FramesView {
            own: frame(own),
            frames: (0..3)
                .map(|i| FrameView {
                    frame: frame(i),
                    robot: NAMES[i].into(),
                    submaps: 3,
                    component: 0,
                    t_own_frame: None,
                })
                .collect(),
            pairs: vec![pair(0, 1), pair(0, 2), pair(1, 2)],
            suspects: Vec::new(),
            tries: Vec::new(),
        },
        map: MapView { submaps: (0..3).flat_map(|r| (0..3).map(move |i| (r, i))).map(|(r, i)| submap(r, i)).collect() },
        path: path(tracks, own, |k| tracks[own].odometry[k]),
        graph: GraphView {
            nodes: 9,
            chi2: 1.0,
            dof: 1,
            edges: vec![EdgeView {
                kind: "alignment".into(),
                i: "alpha/7#0".into(),
                j: "beta/7#2".into(),
                t_i_j: relation(true_t_i_j.retract(error)),
                agreed: true,
                weight: 1.0,
                reason: String::new(),
                contradicts: false,
            }],
            ..GraphView::default()
        },
        stats: StatsView { sent_bytes: BTreeMap::from([("facts".into(), 12_345)]), ..StatsView::default() },
    }
}

/// What a robot shows of its keyframes if its scans put them there.
pub(super) fn path(tracks: &[Track], own: usize, t_frame_body: impl Fn(usize) -> Se3) -> PathView {
    let track = &tracks[own];
    let keyframe = |k: usize| KeyframeView {
        stamp_secs: track.stamps_secs[k],
        submap: (k / PER_SUBMAP) as u32,
        t_odom_body: PoseView::from(&track.odometry[k]),
        t_frame_body: PoseView::from(&t_frame_body(k)),
    };
    PathView { frame: frame(own), keyframes: (0..KEYFRAMES).map(keyframe).collect(), forgotten: 0 }
}

pub(super) fn all_views(tracks: &[Track], error: &Vector6<f64>) -> Vec<Views> {
    (0..3).map(|own| views(tracks, own, error)).collect()
}

fn rigid_error(pose: Se3, covariance: Covariance<6>, truth: &Se3) -> PoseError {
    PoseError::of(&Relative::Metric(PoseWithCovariance { pose, covariance }), &Sim3::from_se3(truth), 1.0)
}

#[test]
fn a_known_offset_gives_the_known_error() {
    let truth = pose([1.0, 2.0, 3.0], [0.4, -0.2, 2.0]);
    let sigmas = [0.1, 0.2, 0.3, 0.01, 0.02, 0.04];
    let covariance = Covariance::from_sigmas(sigmas).unwrap();
    let shifted = truth * Se3::new(Se3::identity().rotation, Vector3::new(0.3, 0.0, -0.3));
    let e = rigid_error(shifted, covariance, &truth);
    assert!((e.translation_m - 0.3 * 2f64.sqrt()).abs() < 1e-12 && e.rotation_deg < 1e-6);
    assert!((e.nees - 10.0).abs() < 1e-9, "3² + 1²: {}", e.nees);
    assert!(e.inside_95());
    let turned = truth * pose([0.0; 3], [0.0, 0.0, 0.16]);
    let e = rigid_error(turned, covariance, &truth);
    assert!((e.rotation_deg - 0.16f64.to_degrees()).abs() < 1e-9 && e.translation_m < 1e-12);
    assert!((e.nees - 16.0).abs() < 1e-9 && !e.inside_95());
}

#[test]
fn an_honest_estimate_has_nees_of_six_and_lies_inside_in_95_percent() {
    // Draws through the drift's own dice would test nothing new: here δ = L n with a full covariance.
    let l = covariance().matrix().cholesky().unwrap().l();
    let unit = Drift { per_metre: 0.0, floor_m: 1.0, step_deg: 1f64.to_degrees() };
    let still = vec![Se3::identity(); 4001];
    let steps = unit.odometry(&still, 3).unwrap();
    let truth = pose([5.0, -2.0, 1.0], [1.0, 1.5, -0.5]);
    let (mut sum, mut inside) = (0.0, 0);
    for step in steps.windows(2) {
        let n = (step[0].pose.inverse() * step[1].pose).log();
        let e = rigid_error(truth.retract(&(l * n)), covariance(), &truth);
        sum += e.nees / 4000.0;
        inside += u32::from(e.inside_95());
    }
    // |n| reaches π and wraps in a few draws, which only lowers the mean a little.
    assert!((sum - 6.0).abs() < 0.25, "{sum}");
    let share = f64::from(inside) / 4000.0;
    assert!((0.94..0.965).contains(&share), "{share}");
}

#[test]
fn a_true_map_passes_every_check() {
    let tracks = tracks();
    let evaluation = evaluate(&tracks, &all_views(&tracks, &Vector6::zeros()), Some(&BOUNDS));
    assert!(evaluation.held(), "{:?}", evaluation.checks);
    assert_eq!(evaluation.pairs.len(), 3);
    assert_eq!(evaluation.checks.len(), 6);
    let errors = evaluation.trajectory.unwrap();
    assert!(errors.alone_m.1 > errors.merged_m.1, "{errors:?}");
    // The anchors are true: only the drift inside each submap is left, and none at an anchor.
    let corrected = evaluation.corrected[1].as_ref().unwrap();
    let t_ref_world = tracks[0].t_world_frame().unwrap().to_se3().inverse();
    for first in (0..KEYFRAMES).step_by(PER_SUBMAP) {
        let truth = t_ref_world * tracks[1].truth.as_ref().unwrap()[first];
        assert!(truth.local(&corrected.poses[first].to_se3()).norm() < 1e-9);
    }
    assert_eq!(corrected.anchors.len(), 3);
}

#[test]
fn single_alignments_are_compared_with_the_anchors_truth() {
    let tracks = tracks();
    let singles = |x: f64| {
        let error = Vector6::new(x, 0.0, 0.0, 0.0, 0.0, 0.0);
        evaluate(&tracks, &all_views(&tracks, &error), Some(&BOUNDS)).singles
    };
    let per_square = covariance().mahalanobis_squared(&Vector6::x());
    for (x, inside_95) in [(0.0, 1), (0.01, 1), (0.2, 0)] {
        let singles = singles(x);
        assert_eq!((singles.count, singles.inside_95), (1, inside_95), "{x}");
        assert!((singles.nees_mean - per_square * x * x).abs() < 1e-6, "{x}: {}", singles.nees_mean);
        assert!((singles.translation_rms_m - x).abs() < 1e-9 && singles.rotation_rms_deg < 1e-6, "{singles:?}");
    }
}

#[test]
fn a_pair_stated_the_other_way_round_is_the_same() {
    let tracks = tracks();
    let error = Vector6::new(0.02, -0.01, 0.03, 0.002, 0.004, -0.003);
    let straight = all_views(&tracks, &error);
    let mut turned = straight.clone();
    for views in &mut turned {
        let pair = &mut views.frames.pairs[1];
        let t = views::relation(pair.t_a_b.as_ref().unwrap()).unwrap().inverse();
        pair.t_a_b = Some(RelationView::from(&Relative::Metric(t)));
        std::mem::swap(&mut pair.a, &mut pair.b);
    }
    let (a, b) = (evaluate(&tracks, &straight, Some(&BOUNDS)), evaluate(&tracks, &turned, Some(&BOUNDS)));
    assert!(a.held() && b.held());
    for (a, b) in a.pairs.iter().zip(&b.pairs) {
        assert_eq!(a.robots, b.robots);
        assert!((a.error.unwrap().nees / b.error.unwrap().nees - 1.0).abs() < 1e-6);
    }
}

/// The checks that do not hold after `spoil`.
pub(super) fn broken(error: &Vector6<f64>, spoil: impl FnOnce(&mut Vec<Views>)) -> Vec<String> {
    let tracks = tracks();
    let mut views = all_views(&tracks, error);
    spoil(&mut views);
    let checks = evaluate(&tracks, &views, Some(&BOUNDS)).checks;
    checks.into_iter().filter(|check| !check.held).map(|check| format!("{}: {}", check.what, check.found)).collect()
}

#[test]
fn each_check_bites() {
    let none = Vector6::zeros();
    assert!(broken(&none, |_| ()).is_empty());
    // The bound: one side of it, and the other.
    let shift = |x: f64| Vector6::new(x, 0.0, 0.0, 0.0, 0.0, 0.0);
    let wide: fn(&mut Vec<Views>) = |views| {
        for pair in views.iter_mut().flat_map(|v| &mut v.frames.pairs) {
            pair.t_a_b.as_mut().unwrap().covariance.iter_mut().for_each(|c| *c *= 100.0);
        }
    };
    assert!(broken(&shift(0.149), wide).is_empty());
    assert_eq!(broken(&shift(0.151), wide).len(), 3);
    let turn = |deg: f64| Vector6::new(0.0, 0.0, 0.0, 0.0, 0.0, deg.to_radians());
    assert!(broken(&turn(1.49), wide).is_empty());
    assert_eq!(broken(&turn(1.51), wide).len(), 3);
    // Where no bound is known, an honest claim is enough.
    let unknown = |views: &[Views]| evaluate(&tracks(), views, None).held();
    let off = |x: f64, spoil: fn(&mut Vec<Views>)| {
        let mut views = all_views(&tracks(), &shift(x));
        spoil(&mut views);
        views
    };
    assert!(unknown(&off(0.151, wide)) && !unknown(&off(0.5, |_| ())));
    // Small, but claimed to be much smaller.
    let narrow = |views: &mut Vec<Views>| {
        for pair in views.iter_mut().flat_map(|v| &mut v.frames.pairs) {
            pair.t_a_b.as_mut().unwrap().covariance.iter_mut().for_each(|c| *c *= 1e-4);
        }
    };
    assert_eq!(broken(&shift(0.05), narrow).len(), 3);
    // One robot estimates something else by more than rounding.
    let other = |by: f64| {
        move |views: &mut Vec<Views>| {
            views[2].frames.pairs[0].t_a_b.as_mut().unwrap().pose.translation[1] += by;
        }
    };
    assert!(broken(&none, other(5e-7)).is_empty());
    let told = broken(&none, other(3e-6));
    assert!(told.len() == 1 && told[0].starts_with("all robots hold the same estimate"), "{told:?}");
    let told = broken(&none, |views| views[1].frames.pairs.clear());
    assert!(told[0].contains("an estimate is absent"), "{told:?}");
    let told = broken(&none, |views| views[0].frames.pairs[0].t_a_b = None);
    assert!(told.iter().any(|line| line.contains("alpha–beta") && line.contains("no alignment")), "{told:?}");
}

#[test]
fn what_is_missing_is_said() {
    let tracks = tracks();
    let told = |spoil: &dyn Fn(&mut Vec<Views>)| {
        let mut views = all_views(&tracks, &Vector6::zeros());
        spoil(&mut views);
        missing(&tracks, &views.iter().map(|v| Some(&v.status)).collect::<Vec<_>>()).join("; ")
    };
    assert_eq!(told(&|_| ()), "");
    assert_eq!(told(&|v| v[1].status.keyframes = 3), "beta has taken 3 of 12 keyframes");
    assert_eq!(told(&|v| v[1].status.merged_with = vec!["alpha".into()]), "beta has not merged with gamma");
    assert_eq!(told(&|v| (v[0].status.idle, v[0].status.pending) = (false, 4)), "alpha still works (4 pending)");
    assert_eq!(told(&|v| v[2].status.digest = "ef".into()), "the robots do not hold the same facts yet");
    assert_eq!(told(&|v| v[2].status.receive_only = true), "gamma is receive-only; its log says why");
    assert_eq!(missing(&tracks[..1], &[None]), ["alpha does not answer"]);
}

#[test]
fn the_best_rigid_fit_is_found_also_for_points_in_a_plane() {
    let t = pose([1.0, -2.0, 0.5], [0.3, 2.0, -1.0]);
    for flat in [1.0, 0.0] {
        let points: Vec<Vector3<f64>> =
            (0..9).map(f64::from).map(|i| Vector3::new(i, (i * 1.7).sin(), flat * (i * 0.6).cos())).collect();
        let moved: Vec<_> = points.iter().map(|p| t * *p).collect();
        assert!(t.local(&fit(&points, &moved)).norm() < 1e-9, "flat {flat}");
    }
}

#[test]
fn views_are_read_from_json_and_bad_ones_are_not() {
    let tracks = tracks();
    let views = views(&tracks, 0, &Vector6::zeros());
    let mut stats = serde_json::to_value(&views.stats).unwrap();
    stats["shell"] = serde_json::json!({"dropped": 1});
    let mut documents = BTreeMap::from([
        ("status".to_owned(), serde_json::to_vec(&views.status).unwrap()),
        ("frames".to_owned(), serde_json::to_vec(&views.frames).unwrap()),
        ("map".to_owned(), serde_json::to_vec(&views.map).unwrap()),
        ("path".to_owned(), serde_json::to_vec(&views.path).unwrap()),
        ("graph".to_owned(), serde_json::to_vec(&views.graph).unwrap()),
        ("stats".to_owned(), serde_json::to_vec(&stats).unwrap()),
    ]);
    let parsed = Views::parse(&documents).unwrap();
    assert!(parsed.status == views.status && parsed.stats == views.stats && parsed.map.submaps.len() == 9);
    let t = |views: &Views| views.pair(&frame(2), &frame(0)).unwrap().1.unwrap();
    // JSON numbers may differ in their last digit.
    assert!(t(&parsed).sim().local(&t(&views).sim()).norm() < 1e-12);
    documents.insert("map".into(), b"null".to_vec());
    assert!(Views::parse(&documents).unwrap_err().starts_with("view/map is of another shape"));
    documents.remove("status");
    assert_eq!(Views::parse(&documents).unwrap_err(), "view/status did not come");
}

/// Recordings of the tracks in `folder`, each keyframe seeing points of one room.
pub(super) fn record(tracks: &[Track], folder: &Path) -> Vec<Recording> {
    for track in tracks {
        let unknown = track.scale == ScaleKind::Unknown;
        let mut config = merganser_protocol::config::Config::default();
        config.submap.scale = track.scale;
        let manifest = Manifest {
            format: String::new(),
            version: 0,
            robot: merganser_protocol::ids::Name::new(track.name.clone()).unwrap(),
            sensor: "none".into(),
            covariance_of: CovarianceOf::Motion,
            clouds: CloudFormat::Ply,
            keyframes: 0,
            origin: "a test".into(),
            unit_m: track.unit_m.filter(|_| unknown),
            begins_ns: None,
            places: None,
            config,
        };
        let mut writer = Writer::create(&folder.join(&track.name), manifest).unwrap();
        for (index, truth) in track.truth.as_ref().unwrap().iter().enumerate() {
            let room = (0..400)
                .map(f64::from)
                .map(|i| Vector3::new((i * 0.1) % 12.0 - 2.0, (i * 0.37).sin() * 4.0, (i % 10.0) * 0.2));
            let unit_m = track.unit_m.unwrap_or(1.0);
            let points = room.map(|p| (truth.inverse() * p).map(|x| (x / unit_m) as f32).into()).collect();
            let pose = PoseWithCovariance { pose: track.odometry[index], covariance: covariance() };
            let stamp = Stamp((track.stamps_secs[index] * 1e9) as i64);
            let covariance_of = CovarianceOf::Motion;
            writer
                .push(
                    &Keyframe {
                        stamp,
                        session: None,
                        pose,
                        covariance_of,
                        points,
                        marks: vec![],
                        place: None,
                        up: None,
                    },
                    Some(truth),
                )
                .unwrap();
        }
        writer.finish().unwrap();
    }
    import::open_all(folder).unwrap()
}

#[test]
fn all_outputs_are_written() {
    let dir = tempfile::tempdir().unwrap();
    let tracks = tracks();
    let recordings = record(&tracks, &dir.path().join("recordings"));
    let read: Vec<Track> = recordings.iter().map(Track::of).collect();
    assert_eq!(read[2].name, "gamma");
    assert!(read[1].odometry[5].local(&tracks[1].odometry[5]).norm() < 1e-12);
    let seen = Seen {
        ending: Ending::Done,
        after: Duration::from_secs(3),
        views: all_views(&tracks, &Vector6::new(0.01, 0.0, 0.0, 0.0, 0.0, 0.0)),
    };
    let evaluation = evaluate(&tracks, &seen.views, Some(&BOUNDS));
    let out = dir.path().join("out");
    fs::create_dir(&out).unwrap();
    let files = write(&recordings, &tracks, &seen, &evaluation, &out).unwrap();
    assert_eq!(
        files,
        "merged.ply, robot_alpha.tum, robot_beta.tum, robot_gamma.tum, alignments.json, merge.png, merge.svg"
    );
    assert!(cloud::read(&out.join("merged.ply"), CloudFormat::Ply).unwrap().len() > 300);
    let tum = fs::read_to_string(out.join("robot_alpha.tum")).unwrap();
    assert_eq!(tum.lines().count(), KEYFRAMES);
    assert!(tum.lines().nth(1).unwrap().starts_with("0.500000000 0.38"));
    let json: serde_json::Value = serde_json::from_slice(&fs::read(out.join("alignments.json")).unwrap()).unwrap();
    assert_eq!(json["pairs"][0]["error"]["inside_95"], true);
    assert!((json["pairs"][2]["error"]["translation_m"].as_f64().unwrap() - 0.01).abs() < 1e-9);
    assert_eq!(json["chi2_6_95"], CHI2_6_95);
    assert!(fs::read(out.join("merge.png")).unwrap().len() > 20_000);
    if let Some(folder) = std::env::var_os("MERGANSER_PICTURES") {
        fs::copy(out.join("merge.png"), Path::new(&folder).join("outputs.png")).unwrap();
    }
    let printed = [
        report::recordings(&recordings, 10.0),
        report::evaluation(&evaluation, &tracks),
        report::costs(&seen.views, &[Some((20_000_000, 30_000_000)), None, None]),
        report::checks(&evaluation.checks),
    ]
    .concat();
    println!("{printed}");
    for part in ["alpha – gamma", "3 of 3 errors lie inside", "12.3 (0)", "20 (30)", "unknown", "RMSE"] {
        assert!(printed.contains(part), "{part} is not in\n{printed}");
    }
}

#[test]
fn only_our_own_work_folder_is_removed() {
    let dir = tempfile::tempdir().unwrap();
    let work = fresh(dir.path()).unwrap();
    fs::write(work.join("old"), "").unwrap();
    assert!(!fresh(dir.path()).unwrap().join("old").exists());
    fs::remove_file(work.join(MARK)).unwrap();
    fs::write(work.join("thesis"), "").unwrap();
    assert!(fresh(dir.path()).unwrap_err().to_string().contains("not ours"));
    assert!(work.join("thesis").exists());
}

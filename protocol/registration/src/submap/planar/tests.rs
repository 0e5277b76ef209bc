//! Floor plans made of segments, seen by a made-up laser.

use super::super::runs::Runs;
use super::super::{CovarianceOf, Described, Keyframe, KeyframeError, RegisterError, Registered, SubmapBuilder};
use super::se2::{Se2, in_plane, in_space};
use super::{OUT_OF_PLANE_ALIGNED, PlanarConfig, TILT_MAX, register};
use crate::config::{Sensor, SubmapConfig};
use crate::geometry::{Covariance, PoseWithCovariance, Se3, So3};
use crate::time::Stamp;
use nalgebra::{Matrix3, Vector2, Vector3};
use proptest::prelude::*;

/// A wall from one point to another.
type Wall = [[f64; 2]; 2];

fn config() -> SubmapConfig {
    let most = SubmapConfig { keyframes_max: 100, distance_m: 100.0, rotation_deg: 360.0, ..Default::default() };
    SubmapConfig { sensor: Sensor::Laser2d, ..most }
}

fn rectangle(x: [f64; 2], y: [f64; 2]) -> Vec<Wall> {
    let corners = [[x[0], y[0]], [x[1], y[0]], [x[1], y[1]], [x[0], y[1]]];
    (0..4).map(|k| [corners[k], corners[(k + 1) % 4]]).collect()
}

/// A hall like no other: an L, with pillars and a slanted cupboard.
fn hall() -> Vec<Wall> {
    let outline = [[0.0, 0.0], [9.0, 0.0], [9.0, 3.0], [5.0, 3.0], [5.0, 8.0], [0.0, 8.0]];
    let mut walls: Vec<Wall> = (0..6).map(|k| [outline[k], outline[(k + 1) % 6]]).collect();
    walls.extend(rectangle([2.0, 2.6], [5.0, 5.4]));
    walls.extend(rectangle([6.5, 6.9], [1.9, 2.4]));
    walls.push([[0.0, 6.2], [1.3, 7.1]]);
    walls.push([[8.0, 0.0], [9.0, 1.4]]);
    walls
}

/// Two long walls, `ends` included or not.
fn corridor(ends: bool) -> Vec<Wall> {
    let all = rectangle([-40.0, 40.0], [-1.2, 1.2]);
    all.into_iter().filter(|[a, b]| ends || (a[0] - b[0]).abs() > 1.0).collect()
}

/// What a laser at `pose` sees all around, body frame: a beam each half degree, up to 15 m.
fn scan(pose: &Se2, walls: &[Wall]) -> Vec<[f32; 3]> {
    let beam = |k: i32| {
        let way = Se2::new(f64::from(k) * 0.5_f64.to_radians(), Vector2::zeros()).turn(&Vector2::x());
        let world = pose.turn(&way);
        let hit = |[a, b]: &Wall| {
            let (a, b) = (Vector2::from(*a) - pose.at, Vector2::from(*b) - pose.at);
            let along = b - a;
            let det = world.x * -along.y + world.y * along.x;
            let range = (a.x * -along.y + a.y * along.x) / det;
            let share = (world.x * a.y - world.y * a.x) / det;
            (range > 0.1 && (0.0..=1.0).contains(&share)).then_some(range)
        };
        let range = walls.iter().filter_map(hit).min_by(f64::total_cmp).filter(|r| *r < 15.0)?;
        Some([(way.x * range) as f32, (way.y * range) as f32, 0.0])
    };
    (0..720).filter_map(beam).collect()
}

fn keyframe(stamp: i64, pose: Se3, sigma: f64, points: Vec<[f32; 3]>) -> Keyframe {
    let covariance = Covariance::from_sigmas([sigma, sigma, 1e-3, 1e-4, 1e-4, 0.5 * sigma]).unwrap();
    let pose = PoseWithCovariance { pose, covariance };
    Keyframe {
        stamp: Stamp(stamp),
        pose,
        covariance_of: CovarianceOf::Motion,
        session: None,
        points,
        marks: Vec::new(),
        place: None,
        up: None,
    }
}

/// A drive along places of the plan, seen in a frame `t_frame_plan`; and `t_plan_anchor`.
fn driven(walls: &[Wall], way: &[Se2]) -> (Described, Se2) {
    let mut builder = SubmapBuilder::new(config());
    for (k, pose) in (1..).zip(way) {
        builder.push(keyframe(k, pose.se3(1.0), 0.02, scan(pose, walls))).unwrap();
    }
    let submap = builder.flush().unwrap();
    (super::super::describe(&submap, &config()), Se2::of(&submap.t_frame_anchor, 1.0))
}

/// From a place in steps of 0.3 m.
fn way(x: f64, y: f64, heading: f64, steps: i32) -> Vec<Se2> {
    (0..steps).map(|k| Se2::new(heading, Vector2::new(x, y)).after(&ahead(0.3 * f64::from(k)))).collect()
}

fn ahead(x: f64) -> Se2 {
    Se2::new(0.0, Vector2::new(x, 0.0))
}

fn aligned(a: &(Described, Se2), b: &(Described, Se2)) -> Result<Registered, RegisterError> {
    register(&a.0.keypoints, &b.0.features, &PlanarConfig::default())
}

#[test]
fn a_hall_is_recognised_from_elsewhere_and_the_covariance_covers_the_error() {
    let there = driven(&hall(), &way(1.0, 1.5, 0.3, 9));
    let back = driven(&hall(), &way(6.0, 1.2, 2.9, 10));
    assert!(there.0.keypoints.encode().len() <= 7_000 && there.0.summary.encode().len() <= 400);
    let (first, further) = (&there.0.keypoints, there.0.further.as_ref().unwrap());
    let near = first.surfels();
    assert!(further.surfels().iter().all(|one| !near.contains(one)) && first.further().is_some());
    let both = first.with_further(further).unwrap();
    assert!(register(&both, &back.0.features, &PlanarConfig::default()).is_ok());
    for (theirs, mine) in [(&there, &back), (&back, &there)] {
        let found = aligned(theirs, mine).unwrap();
        let truth = (mine.1.inverse().after(&theirs.1)).se3(1.0);
        let error = found.refined.pose.pose.local(&truth);
        assert!(error.fixed_rows::<3>(0).norm() < 0.1 && error[5].abs() < 0.02, "{error:?}");
        assert!(found.refined.pose.covariance.mahalanobis_squared(&error) < 12.6);
        // Nothing is claimed of height and tilt but that both stand on one floor.
        let sigmas = found.refined.pose.covariance.sigmas();
        let (height, tilt) = OUT_OF_PLANE_ALIGNED;
        assert!((sigmas[2] - height).abs() < 1e-9 && (sigmas[3] - tilt).abs() < 1e-9);
        assert!(sigmas[0] < 0.3 && sigmas[5] < 0.1);
    }
}

/// Neither where the same corridor is seen twice nor of two places of it is there an answer.
#[test]
fn a_bare_corridor_is_never_aligned() {
    let (here, there) =
        (driven(&corridor(false), &way(-3.0, 0.1, 0.0, 12)), driven(&corridor(false), &way(4.0, 0.0, 3.1, 12)));
    assert!(aligned(&here, &there).is_err());
    assert!(aligned(&there, &here).is_err());
    assert!(aligned(&here, &here).is_err());
}

/// A rectangle looks the same after half a turn.
#[test]
fn a_symmetric_room_is_ambiguous() {
    let room = rectangle([0.0, 7.0], [0.0, 4.0]);
    let (here, there) = (driven(&room, &way(1.5, 1.0, 0.4, 8)), driven(&room, &way(5.0, 2.5, 2.0, 4)));
    assert!(matches!(aligned(&here, &there), Err(RegisterError::Ambiguous { .. } | RegisterError::NoConsensus { .. })));
}

#[test]
fn other_places_and_submaps_in_space_are_refused() {
    let here = driven(&hall(), &way(1.0, 1.5, 0.3, 9));
    let mut other = corridor(true);
    other.extend(rectangle([2.0, 2.5], [0.5, 1.0]));
    let elsewhere = driven(&other, &way(-3.0, 0.0, 0.0, 14));
    assert!(aligned(&here, &elsewhere).is_err() && aligned(&elsewhere, &here).is_err());
    let room = super::super::testing::room(1);
    assert_eq!(register(&room.keypoints, &here.0.features, &PlanarConfig::default()), Err(RegisterError::NotPlanar));
    assert_eq!(register(&here.0.keypoints, &room.features, &PlanarConfig::default()), Err(RegisterError::NotPlanar));
}

/// Wheels that claim a tenth too much: in a hall the scans put it right, in a corridor nobody can know.
#[test]
fn scans_sharpen_motion_where_they_can_and_say_so_where_not() {
    let driven = |walls: &[Wall], start: Se2| {
        let mut builder = SubmapBuilder::new(config());
        for k in 0..12 {
            let (true_way, told) = (0.3 * f64::from(k), 0.33 * f64::from(k));
            let points = scan(&start.after(&ahead(true_way)), walls);
            builder.push(keyframe(i64::from(k) + 1, ahead(told).se3(1.0), 0.05, points)).unwrap();
        }
        let submap = builder.flush().unwrap();
        let moved = submap.keyframes[0].inverse() * submap.keyframes[11];
        (moved.translation.x, submap.odometry.covariance.sigmas()[0])
    };
    let (hall, sure) = driven(&hall(), Se2::new(0.1, Vector2::new(1.0, 1.0)));
    assert!((hall - 3.3).abs() < 0.05, "{hall}");
    let (corridor, unsure) = driven(&corridor(false), Se2::new(0.0, Vector2::zeros()));
    assert!((corridor - 3.63).abs() < 0.05, "{corridor}");
    assert!(unsure > 2.0 * sure, "{unsure} {sure}");
}

/// Wheels that count a way back as a way ahead, or spin on the spot, and claim to be good to 5 cm: where walls tell, the
/// scans put it right; a claim that walls bear out stays as it is.
#[test]
fn scans_mend_wheels_that_are_wrong_by_far_more_than_they_say() {
    let driven = |ways: &[(f64, f64)]| {
        let start = Se2::new(0.1, Vector2::new(1.0, 1.0));
        let mut builder = SubmapBuilder::new(config());
        let (mut at, mut told) = (0.0, 0.0);
        for (k, (true_step, told_step)) in core::iter::once(&(0.0, 0.0)).chain(ways).enumerate() {
            (at, told) = (at + true_step, told + told_step);
            let points = scan(&start.after(&ahead(at)), &hall());
            builder.push(keyframe(k as i64 + 1, ahead(told).se3(1.0), 0.05, points)).unwrap();
        }
        let submap = builder.flush().unwrap();
        (submap.keyframes[0].inverse() * submap.keyframes[ways.len()]).translation.x - at
    };
    let ahead = [(0.3, 0.3); 6];
    let back = [(0.3, 0.3), (0.3, 0.3), (0.3, 0.3), (-0.4, 0.4), (-0.4, 0.4), (0.3, 0.3)];
    let spinning = [(0.3, 0.3), (0.3, 0.3), (0.0, 0.5), (0.0, 0.5), (0.0, 0.5), (0.3, 0.3)];
    for ways in [ahead, back, spinning] {
        assert!(driven(&ways).abs() < 0.05, "{ways:?}: {} m off", driven(&ways));
    }
}

/// At each step of a bare corridor a stretch of wall comes into view for the first time: that is no reason to believe
/// that the robot came less far than its wheels say.
#[test]
fn what_comes_into_view_shortens_no_motion() {
    let mut builder = SubmapBuilder::new(config());
    for k in 0..8 {
        let at = 1.2 * f64::from(k);
        let points = scan(&ahead(at), &corridor(false));
        let near = points.into_iter().filter(|p| p[0].hypot(p[1]) < 2.0).collect();
        builder.push(keyframe(i64::from(k) + 1, ahead(at).se3(1.0), 0.2, near)).unwrap();
    }
    let submap = builder.flush().unwrap();
    assert_eq!(submap.keyframes.len(), 8, "a slip was believed, which blurs a submap");
    let moved = (submap.keyframes[0].inverse() * submap.keyframes[7]).translation.x;
    assert!((moved - 8.4).abs() < 0.2, "{moved}");
}

/// Points far beyond what is looked at, and no walls at all, cost neither memory nor a panic.
#[test]
fn scans_of_any_size_are_taken() {
    for far in [1e3_f32, 1e9, 1e30] {
        let mut builder = SubmapBuilder::new(config());
        for k in 0..4 {
            let points = vec![[far, 0.0, 0.0], [0.0, -far, 0.0], [1.0, 1.0, 0.0]];
            builder.push(keyframe(i64::from(k) + 1, ahead(0.3 * f64::from(k)).se3(1.0), 0.05, points)).unwrap();
        }
        assert!(builder.flush().is_some_and(|s| s.keyframes.iter().all(|t| t.translation.norm() < 2.0)), "{far}");
    }
}

#[test]
fn a_tilted_body_is_refused_and_height_is_left_out() {
    let tilted = |angle: f64| Se3::new(So3::exp(&Vector3::new(angle, 0.0, 0.0)), Vector3::new(0.0, 0.0, 0.7));
    let push = |angle| SubmapBuilder::new(config()).push(keyframe(1, tilted(angle), 0.02, vec![[1.0, 0.0, 0.4]]));
    assert!(push(TILT_MAX - 1e-3).is_ok());
    assert!(matches!(push(TILT_MAX + 1e-3), Err(KeyframeError::NotPlanar { .. })));
    let mut builder = SubmapBuilder::new(config());
    builder.push(keyframe(1, tilted(0.0), 0.02, vec![[1.0, 0.0, 0.4]])).unwrap();
    let submap = builder.flush().unwrap();
    assert_eq!((submap.t_frame_anchor.translation.z, submap.cloud[0][2]), (0.0, 0.0));
}

/// After a restart of the agent nobody knows how far scans had led the map away from the wheels.
#[test]
fn a_restart_is_as_uncertain_as_the_way_before_it_was_long() {
    let sigma = |submaps: u32| {
        let mut builder = SubmapBuilder::resume(config(), submaps, Some(Se3::identity()), Runs::default());
        builder.push(keyframe(1, Se3::identity(), 0.02, vec![[1.0, 0.0, 0.0]])).unwrap();
        builder.flush().unwrap().odometry.covariance.sigmas()[0]
    };
    assert!(sigma(1) > 9.0 && sigma(4) > 3.0 * sigma(1));
}

proptest! {
    #[test]
    fn poses_in_the_plane_compose_as_in_space(a in -4.0..4.0f64, x in -9.0..9.0f64, y in -9.0..9.0f64, b in -4.0..4.0f64) {
        let (p, q) = (Se2::new(a, Vector2::new(x, y)), Se2::new(b, Vector2::new(y, -x)));
        prop_assert!(p.after(&q).se3(0.5).local(&(p.se3(0.5) * q.se3(0.5))).amax() < 1e-9);
        prop_assert!(p.inverse().se3(2.0).local(&p.se3(2.0).inverse()).amax() < 1e-9);
        prop_assert!(p.local(&p.retract(&Vector3::new(0.1, 0.2, 0.3))).z - 0.3 < 1e-9);
        let covariance = Matrix3::new(0.2, 0.01, 0.02, 0.01, 0.3, -0.01, 0.02, -0.01, 0.4);
        let carried = in_space(&p, 0.1, &covariance, (0.4, 0.08));
        prop_assert!((in_plane(&carried.covariance, 0.1) - covariance).amax() < 1e-12);
    }
}

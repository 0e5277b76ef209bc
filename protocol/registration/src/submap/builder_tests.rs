use super::super::testing::keyframe;
use super::*;
use crate::config::Sensor;
use crate::geometry::{Covariance, So3};
use crate::submap::CovarianceOf;
use nalgebra::{Vector3, Vector6};

fn config() -> SubmapConfig {
    SubmapConfig { voxel_m: 0.1, distance_m: 2.0, rotation_deg: 60.0, keyframes_max: 10, ..Default::default() }
}

fn at(x: f64) -> Se3 {
    Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0))
}

/// Pushes keyframes at the given poses; returns which of them closed a submap, and the submaps.
fn drive(builder: &mut SubmapBuilder, poses: &[Se3]) -> (Vec<usize>, Vec<Submap>) {
    let push = |(k, pose): (usize, &Se3)| {
        builder.push(keyframe(k as i64 + 1, *pose, &[Vector3::new(1.0, 0.0, 0.0)])).unwrap().map(|submap| (k, submap))
    };
    poses.iter().enumerate().filter_map(push).unzip()
}

#[test]
fn a_submap_ends_at_each_limit_and_not_before() {
    let along = |step: f64| (0..30).map(|k| at(f64::from(k) * step)).collect::<Vec<_>>();
    // 0.01 short of the distance goes on; the distance itself ends it.
    assert_eq!(drive(&mut SubmapBuilder::new(config()), &[at(0.0), at(1.99), at(2.0)]).0, vec![2]);
    assert_eq!(drive(&mut SubmapBuilder::new(config()), &along(0.0)).0, vec![9], "what stands has been seen");
    assert_eq!(drive(&mut SubmapBuilder::new(config()), &along(1.0)).0, vec![2, 5, 8, 11, 14, 17, 20, 23, 26, 29]);
    let turned = |deg: f64| Se3::new(So3::exp(&Vector3::new(0.0, 0.0, deg.to_radians())), Vector3::zeros());
    assert_eq!(drive(&mut SubmapBuilder::new(config()), &[turned(0.0), turned(59.9), turned(60.1)]).0, vec![2]);
    let single = SubmapConfig { keyframes_max: 1, ..config() };
    assert_eq!(drive(&mut SubmapBuilder::new(single), &along(0.2)[..3]).0, vec![0, 1, 2]);
}

/// Keyframes at these times (s) and places, with this standard deviation of each motion: which closed a submap, and how
/// many keyframes it has.
fn timed(config: SubmapConfig, keyframes: &[(f64, Se3)], sigma: f64) -> Vec<(usize, usize)> {
    let mut builder = SubmapBuilder::new(config);
    let push = |(k, (secs, pose)): (usize, &(f64, Se3))| {
        let mut keyframe = keyframe((secs * 1e9) as i64, *pose, &[]);
        keyframe.pose.covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
        builder.push(keyframe).unwrap().map(|submap| (k, submap.keyframes.len()))
    };
    keyframes.iter().enumerate().filter_map(push).collect()
}

#[test]
fn a_submap_ends_in_time_unless_the_body_stands() {
    let config = SubmapConfig { secs_max: 60.0, ..config() };
    let closed = |last: f64, x: f64| timed(config.clone(), &[(0.0, at(0.0)), (1.0, at(x)), (last, at(0.0))], 0.01);
    assert_eq!(closed(59.9, 1.0), vec![]);
    assert_eq!(closed(60.0, 1.0), vec![(2, 3)], "it has moved, though it came back");
    assert_eq!(closed(60.0, 0.11), vec![(2, 3)]);
    assert_eq!(closed(60.0, 0.09), vec![], "less than a voxel is no motion");
    let turned = |deg: f64| Se3::new(So3::exp(&Vector3::new(0.0, 0.0, deg.to_radians())), Vector3::zeros());
    let closed = |deg: f64| timed(config.clone(), &[(0.0, turned(0.0)), (99.0, turned(deg))], 0.01);
    assert_eq!((closed(5.9), closed(6.1)), (vec![], vec![(1, 2)]));
    // A robot that stands for a day is one submap.
    let day: Vec<_> = (0..25).map(|k| (3600.0 * f64::from(k), at(0.0))).collect();
    assert_eq!(timed(config, &day, 0.01), vec![(9, 10)]);
}

#[test]
fn a_submap_ends_before_a_motion_that_would_blur_it() {
    let steps: Vec<_> = (0..6).map(|k| (f64::from(k), at(0.0))).collect();
    // Each motion adds 0.1: 0.1, 0.141, 0.173, 0.2 of the position, and as many rad.
    let way = |sigma_max_m: f64| timed(SubmapConfig { sigma_max_m, sigma_max_deg: 1e3, ..config() }, &steps, 0.1);
    assert_eq!(way(0.21), vec![(5, 5)]);
    assert_eq!(way(0.19), vec![(4, 4)]);
    let turn = |sigma_max: f64| {
        let config = SubmapConfig { sigma_max_m: 1e3, sigma_max_deg: sigma_max.to_degrees(), ..config() };
        timed(config, &steps, 0.1)
    };
    assert_eq!((turn(0.21), turn(0.19)), (vec![(5, 5)], vec![(4, 4)]));
    // The motion that was too much lies between the two.
    let mut builder = SubmapBuilder::new(SubmapConfig { sigma_max_m: 0.2, ..config() });
    builder.push(keyframe(1, at(0.0), &[])).unwrap();
    let mut blurred = keyframe(2, at(0.5), &[]);
    blurred.pose.covariance = Covariance::from_sigmas([0.3; 6]).unwrap();
    let first = builder.push(blurred).unwrap().unwrap();
    assert_eq!((first.index, first.keyframes.len()), (0, 1));
    let second = builder.flush().unwrap();
    assert_eq!((second.index, second.odometry.pose), (1, at(0.5)));
    assert!((second.odometry.covariance.sigmas()[0] - 0.3).abs() < 1e-12);
    // Where each keyframe is a submap, each push closes one.
    let single = SubmapConfig { keyframes_max: 1, sigma_max_m: 0.05, ..config() };
    let driven: Vec<_> = (0..3).map(|k| (f64::from(k), at(f64::from(k)))).collect();
    assert_eq!(timed(single, &driven, 0.1), vec![(0, 1), (1, 1), (2, 1)]);
}

#[test]
fn out_of_the_plane_a_planar_robot_blurs_nothing() {
    let closed = |sensor| {
        let mut builder =
            SubmapBuilder::new(SubmapConfig { sensor, sigma_max_m: 0.2, sigma_max_deg: 10.0, ..config() });
        (1..=4)
            .filter_map(|k| {
                let mut keyframe = keyframe(k, at(0.0), &[]);
                keyframe.pose.covariance = Covariance::from_sigmas([0.01, 0.01, 0.9, 0.9, 0.9, 0.01]).unwrap();
                builder.push(keyframe).unwrap()
            })
            .count()
    };
    assert_eq!((closed(Sensor::Landmarks2d), closed(Sensor::Landmarks)), (0, 3));
}

#[test]
fn anchors_are_middle_keyframes_that_chain_without_gaps_and_covariances_compound() {
    let step = Se3::exp(&Vector6::new(0.5, 0.1, 0.0, 0.02, 0.0, 0.1));
    let poses: Vec<Se3> = std::iter::successors(Some(at(3.0)), |p| Some(*p * step)).take(24).collect();
    let mut builder = SubmapBuilder::new(config());
    let (_, submaps) = drive(&mut builder, &poses);
    assert!(submaps.len() >= 3);
    let one = PoseWithCovariance { pose: step, covariance: Covariance::from_sigmas([0.01; 6]).unwrap() };
    let steps = |count: usize| (1..count).fold(one, |sum, _| sum.compose(&one));
    let count = submaps[0].keyframes.len();
    let middle = (count - 1) / 2;
    assert!(count > 2 && middle > 0);
    assert_eq!(submaps[0].keyframes[middle], Se3::identity());
    assert!(submaps[0].odometry.pose.local(&poses[middle]).amax() < 1e-12);
    // From the frame's origin, where the first body pose is certain.
    let sure = isotropic(FIRST_ANCHOR_SIGMA, FIRST_ANCHOR_SIGMA, &one.covariance);
    let expected = PoseWithCovariance { pose: poses[0], covariance: sure }.compose(&steps(middle));
    let difference = submaps[0].odometry.covariance.matrix() - expected.covariance.matrix();
    assert!(difference.amax() < 1e-12, "{difference}");
    for (k, pair) in submaps.windows(2).enumerate() {
        assert_eq!(pair[1].index as usize, k + 1);
        let chained = pair[0].t_frame_anchor * pair[1].odometry.pose;
        assert!(chained.local(&pair[1].t_frame_anchor).amax() < 1e-12);
        let between = pair[0].keyframes.len() - (pair[0].keyframes.len() - 1) / 2 + (pair[1].keyframes.len() - 1) / 2;
        let difference = pair[1].odometry.covariance.matrix() - steps(between).covariance.matrix();
        assert!(difference.amax() < 1e-9, "{difference}");
    }
    let (index, t_anchor_body, stamp) = builder.body_since_anchor().unwrap();
    let last = submaps.last().unwrap();
    assert_eq!((index, stamp), (last.index, Stamp(24)));
    assert!((last.t_frame_anchor * t_anchor_body.pose).local(&poses[23]).amax() < 1e-12);
}

#[test]
fn flush_closes_what_is_open_once() {
    let mut builder = SubmapBuilder::new(config());
    assert!(builder.flush().is_none() && builder.body_since_anchor().is_none());
    drive(&mut builder, &[at(0.0), at(0.5)]);
    assert!(builder.body_since_anchor().is_none());
    let submap = builder.flush().unwrap();
    assert_eq!((submap.index, submap.stamps, submap.keyframes.len()), (0, [Stamp(1), Stamp(2)], 2));
    // Two keyframes saw the body-fixed point at two places.
    assert_eq!(submap.cloud, vec![[1.0, 0.0, 0.0], [1.5, 0.0, 0.0]]);
    assert_eq!(submap.seen_from, vec![0, 1]);
    assert!(builder.flush().is_none());
    assert_eq!(builder.body_since_anchor().unwrap().1.pose, at(0.5));
}

#[test]
fn a_restart_continues_the_numbering_and_admits_the_gap() {
    let mut builder = SubmapBuilder::resume(config(), 7, Some(at(1.0)), Runs::default());
    assert!(builder.body_since_anchor().is_none());
    builder.push(keyframe(100, at(3.0), &[])).unwrap();
    let (index, t_anchor_body, _) = builder.body_since_anchor().unwrap();
    assert_eq!((index, t_anchor_body.pose), (6, at(2.0)));
    assert!((t_anchor_body.covariance.sigmas()[0] - 0.1 * 2.1).abs() < 1e-12);
    let submap = builder.flush().unwrap();
    assert_eq!((submap.index, submap.odometry), (7, t_anchor_body));
    // Nothing was finished before: as new.
    let mut fresh = SubmapBuilder::resume(config(), 0, None, Runs::default());
    fresh.push(keyframe(1, at(3.0), &[])).unwrap();
    let first = fresh.flush().unwrap();
    assert_eq!((first.index, first.odometry.pose), (0, at(3.0)));
}

#[test]
fn bad_keyframes_are_refused_by_name_and_change_nothing() {
    let mut builder = SubmapBuilder::new(config());
    builder.push(keyframe(5, at(0.0), &[])).unwrap();
    let refused = |builder: &mut SubmapBuilder, keyframe: Keyframe| builder.push(keyframe).unwrap_err();
    for stamp in [5, 4, i64::MIN] {
        assert_eq!(
            refused(&mut builder, keyframe(stamp, at(0.1), &[])),
            KeyframeError::StampNotRising { stamp, last: 5 }
        );
    }
    for x in [f64::NAN, f64::INFINITY, -2e7] {
        assert_eq!(refused(&mut builder, keyframe(6, at(x), &[])), KeyframeError::BadPosition);
    }
    for x in [f64::NAN, f64::NEG_INFINITY] {
        let points = [Vector3::zeros(), Vector3::new(0.0, x, 0.0)];
        assert_eq!(refused(&mut builder, keyframe(6, at(0.1), &points)), KeyframeError::PointNotFinite { index: 1 });
    }
    let crowd = vec![Vector3::zeros(); POINTS_PER_KEYFRAME_MAX + 1];
    let too_many = KeyframeError::TooManyPoints { count: crowd.len() };
    assert_eq!(refused(&mut builder, keyframe(6, at(0.1), &crowd)), too_many);
    assert!(matches!(refused(&mut builder, keyframe(6, at(2.1), &[])), KeyframeError::Jump { moved: 2.1, .. }));
    builder.push(keyframe(6, at(0.2), &crowd[1..])).unwrap();
    let submap = builder.flush().unwrap();
    assert_eq!((submap.stamps, submap.cloud.len()), ([Stamp(5), Stamp(6)], 1));
}

#[test]
fn stamps_may_be_as_large_as_the_wire_can_carry() {
    for stamp in [i64::MIN, -STAMP_MAX - 1, STAMP_MAX + 1, i64::MAX] {
        let refused = SubmapBuilder::new(config()).push(keyframe(stamp, at(0.0), &[]));
        assert_eq!(refused, Err(KeyframeError::StampOutOfRange { stamp }));
    }
    let mut builder = SubmapBuilder::new(config());
    builder.push(keyframe(-STAMP_MAX, at(0.0), &[])).unwrap();
    let submap = builder.push(keyframe(STAMP_MAX, at(0.1), &[])).unwrap();
    let [first, last] = submap.unwrap().stamps;
    assert!(last.0.checked_sub(first.0).is_some());
}

#[test]
fn a_refused_keyframe_widens_the_odometry_and_a_repeated_one_does_not() {
    let sigma_after = |between: Option<Keyframe>| {
        let mut builder = SubmapBuilder::new(SubmapConfig { keyframes_max: 1, ..config() });
        builder.push(keyframe(1, at(0.0), &[])).unwrap();
        if let Some(bad) = between {
            builder.push(bad).unwrap_err();
        }
        builder.push(keyframe(3, at(1.0), &[])).unwrap().unwrap().odometry.covariance.sigmas()[0]
    };
    let clean = sigma_after(None);
    assert!((clean - 0.01).abs() < 1e-9);
    assert_eq!(sigma_after(Some(keyframe(1, at(0.0), &[]))), clean);
    assert!(sigma_after(Some(keyframe(2, at(f64::NAN), &[]))) > 0.1);
}

#[test]
fn pose_covariances_give_the_motion_by_subtraction_and_never_less_than_the_floor() {
    let with = |stamp, x: f64, sigma: f64| {
        let mut keyframe = keyframe(stamp, at(x), &[]);
        keyframe.covariance_of = CovarianceOf::Pose;
        keyframe.pose.covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
        keyframe
    };
    let odometry = |second: f64| {
        let mut builder = SubmapBuilder::new(SubmapConfig { keyframes_max: 1, ..config() });
        builder.push(with(1, 0.0, 0.03)).unwrap();
        builder.push(with(2, 1.0, second)).unwrap().unwrap().odometry.covariance
    };
    // Along the motion no lever arm mixes in: √(0.05² − 0.03²).
    assert!((odometry(0.05).sigmas()[0] - 0.04).abs() < 1e-9);
    // A loop closure shrank the pose's covariance below the one before: the floor, 1 mm per metre.
    assert!((odometry(0.02).sigmas()[0] - 1.1e-3).abs() < 1e-9);
}

#[test]
fn memory_is_bounded_by_points_max() {
    let config = SubmapConfig { points_max: 500, keyframes_max: 3, ..config() };
    let grid: Vec<_> = (0..4000).map(|k| Vector3::new(f64::from(k % 80), f64::from(k / 80), 0.0) * 0.2).collect();
    let mut builder = SubmapBuilder::new(config);
    let closed: Vec<_> = (1..=3).map(|k| builder.push(keyframe(k, at(0.0), &grid)).unwrap()).collect();
    assert_eq!(closed[2].as_ref().unwrap().cloud.len(), 500);
}

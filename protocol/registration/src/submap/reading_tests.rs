//! Each reading is found in views of a room, and none where poses and points are as they are to be.

use super::super::testing::{config, keyframe, room_points};
use super::*;
use crate::config::Sensor;

/// Drives through a room, turning; what is sent of each place.
fn drive(count: u32, send: impl Fn(Se3, Vec<Vector3<f64>>) -> (Se3, Vec<Vector3<f64>>)) -> Vec<Keyframe> {
    let room = room_points(3);
    let place = |k: u32| {
        let a = f64::from(k) * 0.13;
        let turn = So3::exp(&Vector3::new(0.1 * (3.0 * a).sin(), 0.15 * (2.0 * a).cos(), a));
        Se3::new(turn, Vector3::new(1.2 * a.sin(), 1.0 - a.cos(), 0.2 * (2.0 * a).sin()))
    };
    let sent = |k: u32| {
        let t_room_body = place(0).inverse() * place(k);
        let seen: Vec<Vector3<f64>> = room.iter().map(|p| place(k).inverse() * *p).collect();
        let (pose, points) = send(t_room_body, seen);
        keyframe(i64::from(k) * 500_000_000 + 1, pose, &points)
    };
    (0..count).map(sent).collect()
}

fn found(keyframes: &[Keyframe], config: &SubmapConfig) -> Vec<Oddity> {
    let mut readings = Readings::default();
    keyframes.iter().flat_map(|keyframe| readings.look(keyframe, config)).collect()
}

fn reading(keyframes: &[Keyframe]) -> Option<Reading> {
    match found(keyframes, &config())[..] {
        [Oddity::Read { reading, .. }] => Some(reading),
        [Oddity::WFirst] => Some(Reading::WFirst),
        [] => None,
        ref other => panic!("{other:?}"),
    }
}

#[test]
fn what_is_sent_as_it_is_to_be_is_not_remarked() {
    assert_eq!(reading(&drive(120, |pose, points| (pose, points))), None);
    // A poor odometry lays views badly over one another, and so does any other reading.
    let mut drifting = drive(120, |pose, points| (pose, points));
    for (k, keyframe) in drifting.iter_mut().enumerate() {
        let off = Vector3::new(0.004, -0.003, 0.01) * k as f64;
        keyframe.pose.pose = keyframe.pose.pose * Se3::new(So3::exp(&off), off);
    }
    assert_eq!(reading(&drifting), None);
}

#[test]
fn each_reading_is_told_from_all_others() {
    let axes = |axes: [i8; 3]| {
        move |pose: Se3, points: Vec<Vector3<f64>>| {
            let r_points_body = matrix(axes).transpose();
            (pose, points.into_iter().map(|p| r_points_body * p).collect())
        }
    };
    assert_eq!(
        reading(&drive(80, |pose, points| (pose, points.iter().map(|p| pose * *p).collect()))),
        Some(Reading::InFrame)
    );
    assert_eq!(reading(&drive(80, |pose, points| (pose.inverse(), points))), Some(Reading::Inverse));
    let w_first = |pose: Se3, points| {
        let [x, y, z, w] = pose.rotation.xyzw();
        (Se3::new(So3::from_xyzw([w, x, y, z]).unwrap(), pose.translation), points)
    };
    assert_eq!(reading(&drive(80, w_first)), Some(Reading::WFirst));
    for known in [OPTICAL, Y_UP, MIRRORED, [-1, -2, 3], [2, -1, 3], [1, 3, -2]] {
        assert_eq!(reading(&drive(80, axes(known))), Some(Reading::Axes(known)), "{known:?}");
    }
    // Points too far off for what they are taken for, as well.
    let milli = drive(80, |pose, points| (pose, points.iter().map(|p| p * 1000.0).collect()));
    let odd = found(&milli, &config());
    assert!(
        matches!(
            odd[..],
            [Oddity::Reach { metres: 1000.. }, Oddity::Read { reading: Reading::PointsInMillimetres, .. }]
        ),
        "{odd:?}"
    );
}

#[test]
fn upside_down_and_moved_sensors_are_no_other_reading() {
    let mount = Se3::new(So3::exp(&Vector3::new(std::f64::consts::PI, 0.0, 0.0)), Vector3::new(0.0, 0.0, 0.4));
    let hung = |pose: Se3, points: Vec<Vector3<f64>>| {
        (mount.inverse() * pose * mount, points.iter().map(|p| mount.inverse() * *p).collect())
    };
    assert_eq!(reading(&drive(80, hung)), None);
}

#[test]
fn in_a_plane_there_are_fewer_readings() {
    let planar = SubmapConfig { sensor: Sensor::Laser2d, ..config() };
    let all = Reading::all(true);
    assert!(all.contains(&Reading::Axes(MIRRORED)) && !all.contains(&Reading::Axes(OPTICAL)), "{all:?}");
    assert_eq!((all.len(), Reading::all(false).len()), (3 + 7, 4 + 47));
    let sent = |send: fn(Vector3<f64>) -> Vector3<f64>| {
        let keyframes = (0..80_i64).map(|k| {
            let a = k as f64 * 0.13;
            let pose = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, a)), Vector3::new(1.2 * a.sin(), 1.0 - a.cos(), 0.0));
            let slice = room_points(3).into_iter().filter(|p| p.z.abs() < 0.1);
            let seen: Vec<Vector3<f64>> =
                slice.map(|p| pose.inverse() * Vector3::new(p.x, p.y, 0.0)).map(send).collect();
            keyframe(k * 500_000_000 + 1, pose, &seen)
        });
        found(&keyframes.collect::<Vec<_>>(), &planar)
    };
    assert_eq!(sent(|p| p), []);
    let odd = sent(|p| Vector3::new(p.x, -p.y, 0.0));
    assert!(matches!(odd[..], [Oddity::Read { reading: Reading::Axes(MIRRORED), .. }]), "{odd:?}");
    let odd = sent(|p| Vector3::new(-p.x, -p.y, 0.0));
    assert!(matches!(odd[..], [Oddity::Read { reading: Reading::Axes([-1, -2, 3]), .. }]), "{odd:?}");
}

#[test]
fn units_that_no_sensor_and_no_robot_has_are_told() {
    let both = |by: [f64; 2]| {
        let odd = found(
            &drive(80, |pose, points| {
                (Se3::new(pose.rotation, pose.translation * by[0]), points.iter().map(|p| p * by[1]).collect())
            }),
            &config(),
        );
        odd.into_iter().map(|oddity| core::mem::discriminant(&oddity)).collect::<Vec<_>>()
    };
    let kind = |oddity: Oddity| core::mem::discriminant(&oddity);
    assert_eq!(both([1000.0, 1000.0]), [kind(Oddity::Reach { metres: 0 })]);
    assert_eq!(both([1000.0, 1.0]), [kind(Oddity::StepsApart { centimetres: [0; 2] })]);
    assert_eq!(both([1.0, 1.0]), []);
    // Where the scale is unknown, no unit is wrong.
    let unknown = SubmapConfig { scale: ScaleKind::Unknown, ..config() };
    let large = drive(20, |pose, points| {
        (Se3::new(pose.rotation, pose.translation * 1e3), points.iter().map(|p| p * 1e3).collect())
    });
    assert_eq!(found(&large, &unknown), []);
}

#[test]
fn few_points_and_a_body_that_stands_say_nothing() {
    let few = drive(80, |pose, points| (pose.inverse(), points.into_iter().take(PROBES_MIN - 1).collect()));
    assert_eq!(found(&few, &config()), []);
    let standing = drive(80, |_, points| (Se3::identity(), points));
    assert_eq!(reading(&standing[..1].iter().cycle().take(50).cloned().collect::<Vec<_>>()), None);
}

#[test]
fn it_takes_six_pairs_and_looks_at_no_more_than_so_many() {
    let inverse = |keyframe: &mut Keyframe| keyframe.pose.pose = keyframe.pose.pose.inverse();
    let mut sent = drive(200, |pose, points| (pose, points));
    let pairs_until = |keyframes: &[Keyframe]| {
        let mut readings = Readings::default();
        keyframes.iter().take_while(|keyframe| readings.look(keyframe, &config()).is_empty()).count();
        (readings.pairs, readings.is_over)
    };
    let mut wrong = sent.clone();
    wrong.iter_mut().for_each(inverse);
    let (pairs, is_over) = pairs_until(&wrong);
    assert!(is_over && (WINS_MIN..=PAIRS_OF_RIVALS).contains(&pairs), "{pairs}");
    // A front end does not change its mind: what comes after so many pairs is not looked at.
    let mut readings = Readings::default();
    let last = sent.iter().position(|keyframe| {
        readings.look(keyframe, &config());
        readings.is_over
    });
    assert_eq!(readings.pairs, PAIRS_MAX);
    sent.iter_mut().skip(last.unwrap()).for_each(inverse);
    assert_eq!(reading(&sent), None);
    // Nor are views looked at for ever that never overlap.
    let mut readings = Readings::default();
    let far = |k: u32| {
        let pose = Se3::new(So3::identity(), Vector3::new(4.0 * f64::from(k), 0.0, 0.0));
        Keyframe {
            stamp: Stamp(i64::from(k) + 1),
            pose: crate::geometry::PoseWithCovariance { pose, ..sent[0].pose },
            ..sent[0].clone()
        }
    };
    let looked = (0..2 * VIEWS_MAX).take_while(|k| {
        readings.look(&far(*k), &config());
        !readings.is_over
    });
    assert_eq!(looked.count(), VIEWS_MAX as usize);
}

/// A robot that stands for long before it drives, as most do, is judged when it drives.
#[test]
fn a_body_that_stands_first_is_judged_when_it_drives() {
    let driven = drive(80, |pose, points| (pose.inverse(), points));
    for tremble in [0.0, 1e-3] {
        let mut readings = Readings::default();
        for k in 0..3 * i64::from(VIEWS_MAX) {
            let off = Vector3::new(tremble * (k % 2) as f64, 0.0, 0.0);
            let pose = Se3::new(So3::identity(), off);
            let stands = crate::geometry::PoseWithCovariance { pose, ..driven[0].pose };
            let odd =
                readings.look(&Keyframe { stamp: Stamp(k - 1_000_000), pose: stands, ..driven[0].clone() }, &config());
            assert_eq!(odd, []);
        }
        assert!(!readings.is_over, "{tremble}");
        let odd: Vec<Oddity> = driven.iter().flat_map(|keyframe| readings.look(keyframe, &config())).collect();
        assert!(matches!(odd[..], [Oddity::Read { reading: Reading::Inverse, .. }]), "{tremble}: {odd:?}");
    }
}

#[test]
fn lengths_are_told_beyond_their_bounds_and_not_before() {
    let told = |reach: f64, step: f64| {
        let seen: Vec<_> =
            (0..100).map(|k| Vector3::new(reach * f64::from(k).sin(), reach * f64::from(k).cos(), 0.0)).collect();
        let at = |k: i64| keyframe(k + 1, Se3::new(So3::identity(), Vector3::new(step * k as f64, 0.0, 0.0)), &seen);
        found(&(0..20).map(at).collect::<Vec<_>>(), &config()).len()
    };
    assert_eq!([told(REACH_MAX_M - 1.0, 0.1), told(REACH_MAX_M + 1.0, 0.1)], [0, 1]);
    assert_eq!([told(5.0, 5.0 * STEP_MAX - 0.1), told(5.0, 5.0 * STEP_MAX + 0.1)], [0, 1]);
}

/// A robot whose sensor tells nothing of its poses, such as landmarks without labels.
#[test]
fn quaternions_w_first_show_in_the_poses_alone() {
    let told = |w_first: bool| {
        let sent = drive(80, |pose, _| {
            // Ahead, along x.
            let heading = pose.rotation.log().z;
            let pose = Se3::new(
                So3::exp(&Vector3::new(0.0, 0.0, heading)),
                pose.translation.component_mul(&Vector3::new(1.0, 1.0, 0.0)),
            );
            let [x, y, z, w] = pose.rotation.xyzw();
            let turn = if w_first { [w, x, y, z] } else { [x, y, z, w] };
            (Se3::new(So3::from_xyzw(turn).unwrap(), pose.translation), Vec::new())
        });
        found(&sent, &config())
    };
    assert_eq!(told(false), []);
    let odd = told(true);
    assert!(odd == [Oddity::WFirst] && odd[0].to_string().contains("send [x, y, z, w]"), "{odd:?}");
}

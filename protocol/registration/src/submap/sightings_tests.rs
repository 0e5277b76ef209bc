//! Landmarks that are sent in another way than they are to be are told with the cure, and others are not.

use super::super::Mark;
use super::super::reading::Readings;
use super::super::testing::keyframe;
use super::*;
use crate::config::Sensor;
use crate::geometry::{Covariance, So3};
use proptest::prelude::*;

/// Drives a curve among landmarks, of which it sees a few at a time; what is sent of each place.
fn drive(
    count: u32,
    [radius, noise]: [f64; 2],
    labelled: bool,
    send: impl Fn(Se3, Vector3<f64>) -> (Se3, Vector3<f64>),
) -> Vec<Keyframe> {
    let place = |k: u32| {
        let a = f64::from(k) * 0.08;
        let at = Vector3::new(radius * a.sin(), radius * (1.0 - a.cos()), 0.0);
        Se3::new(So3::exp(&Vector3::new(0.0, 0.0, a)), at)
    };
    let landmarks: Vec<Vector3<f64>> = (0..9)
        .map(|k| Vector3::new(6.0 * (2.1 * f64::from(k)).sin(), 2.0 + 6.0 * (1.3 * f64::from(k)).cos(), 0.0))
        .collect();
    let one = |k: u32| {
        let (mut points, mut marks, mut pose) = (Vec::new(), Vec::new(), place(k));
        for (label, landmark) in (0..).zip(&landmarks).filter(|(label, _)| (label + k).is_multiple_of(3)) {
            let seen = place(k).inverse() * *landmark;
            let off = noise * Vector3::new((1.7 * f64::from(k)).sin(), (2.3 * f64::from(k)).cos(), 0.0);
            let (sent_pose, point) = send(place(k), seen + off * seen.norm());
            pose = sent_pose;
            points.push(point);
            let covariance = Covariance::from_sigmas([0.1, 0.1, 0.1]).unwrap();
            marks.push(Mark { covariance, label: labelled.then_some(label), descriptor: None });
        }
        Keyframe { marks, ..keyframe(i64::from(k) * 500_000_000 + 1, pose, &points) }
    };
    (0..count).map(one).collect()
}

fn told(sensor: Sensor, keyframes: &[Keyframe]) -> Vec<Oddity> {
    let config = SubmapConfig { sensor, ..SubmapConfig::default() };
    let mut readings = Readings::default();
    keyframes.iter().flat_map(|keyframe| readings.look(keyframe, &config)).collect()
}

#[test]
fn landmarks_in_the_slams_frame_are_told_with_the_cure() {
    for sensor in [Sensor::Landmarks, Sensor::Landmarks2d] {
        let told = told(sensor, &drive(100, [3.0, 0.0], true, |pose, at| (pose, pose * at)));
        assert!(matches!(told[..], [Oddity::Seen { reading: Reading::InFrame, .. }]), "{told:?}");
        assert!(told[0].to_string().contains("send them in the body's"), "{}", told[0]);
    }
}

#[test]
fn landmarks_without_labels_say_nothing() {
    assert_eq!(told(Sensor::Landmarks2d, &drive(100, [3.0, 0.0], false, |pose, at| (pose, pose * at))), []);
}

#[test]
fn as_many_are_remembered_and_judged_as_the_limits_say() {
    let mut sightings = Sightings::default();
    let config = SubmapConfig { sensor: Sensor::Landmarks, ..SubmapConfig::default() };
    let covariance = Covariance::from_sigmas([0.1; 3]).unwrap();
    let mut send = |k: u32, labels: core::ops::Range<u32>| {
        let x = f64::from(10 * (k % 2));
        let pose = Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0));
        let points: Vec<_> = labels.clone().map(|label| Vector3::new(f64::from(label) - x, 1.0, 0.0)).collect();
        let marks = labels.map(|label| Mark { covariance, label: Some(label), descriptor: None }).collect();
        sightings.look(&Keyframe { marks, ..keyframe(i64::from(k) + 1, pose, &points) }, &pose, &config);
        (sightings.seen.len(), sightings.judged, sightings.is_over)
    };
    let most = LABELS_MAX as u32;
    assert_eq!(send(0, 0..most - 1).0, LABELS_MAX - 1);
    assert_eq!(send(0, 0..most + 1).0, LABELS_MAX);
    let judged = (1..=SIGHTINGS_MAX).find(|k| send(*k, 0..1).2);
    assert_eq!(judged, Some(SIGHTINGS_MAX));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(16))]

    #[test]
    fn each_way_to_send_is_told_from_what_is_right(radius in 2.0..5.0_f64, noise in 0.0..0.02_f64) {
        for sensor in [Sensor::Landmarks, Sensor::Landmarks2d] {
            let told = |send: fn(Se3, Vector3<f64>) -> (Se3, Vector3<f64>)| {
                told(sensor, &drive(140, [radius, noise], true, send))
            };
            prop_assert_eq!(told(|pose, at| (pose, at)), vec![]);
            let is = |told: &[Oddity], wanted: Reading| {
                matches!(told, [Oddity::Seen { reading, .. }] if *reading == wanted)
            };
            let in_frame = told(|pose, at| (pose, pose * at));
            prop_assert!(is(&in_frame, Reading::InFrame), "{in_frame:?}");
            let inverse = told(|pose, at| (pose.inverse(), at));
            prop_assert!(is(&inverse, Reading::Inverse), "{inverse:?}");
            let mirrored = told(|pose, at| (pose, Vector3::new(at.x, -at.y, at.z)));
            prop_assert!(is(&mirrored, Reading::Axes([1, -2, 3])), "{mirrored:?}");
        }
    }
}

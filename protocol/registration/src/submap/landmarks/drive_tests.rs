//! Submaps of robots that drive among landmarks: what is kept of their sightings, and what a keyframe may hold.

use super::super::builder::{Submap, SubmapBuilder};
use super::super::{CovarianceOf, Described, Keyframe, Keypoints, describe};
use super::tests::{Dice, Thing, flat_frame, nees, normal, planar, vector, world};
use super::{Codec, Mark, SIGMA_RANGE, register};
use crate::config::{Sensor, SubmapConfig};
use crate::geometry::{Covariance, PoseWithCovariance, Se3, Sim3, So3};
use crate::ids::Hash;
use crate::submap::KeyframeError;
use crate::time::Stamp;
use nalgebra::{Matrix3, Vector3, Vector6};
use rand::{RngExt, SeedableRng};

fn config(sensor: Sensor) -> SubmapConfig {
    SubmapConfig { sensor, keyframes_max: 16, distance_m: 3.0, rotation_deg: 360.0, ..SubmapConfig::default() }
}

fn keyframe(stamp: i64, pose: Se3, points: Vec<[f32; 3]>, marks: Vec<Mark>) -> Keyframe {
    let covariance = Covariance::from_sigmas(MOTION).unwrap();
    let pose = PoseWithCovariance { pose, covariance };
    Keyframe {
        stamp: Stamp(stamp),
        pose,
        covariance_of: CovarianceOf::Motion,
        session: None,
        points,
        marks,
        place: None,
        up: None,
    }
}

/// Standard deviations of a keyframe's motion in these tests.
const MOTION: [f64; 6] = [0.02, 0.01, 1e-3, 1e-4, 1e-4, 0.02];

/// A robot that drives a curve and sees landmarks all about with range and bearing; `t_frame_world` is where its frame
/// truly lies at the anchor.
fn driven(dice: &mut Dice, things: &[Thing], labelled: bool) -> (Submap, Se3) {
    let mut builder = SubmapBuilder::new(config(Sensor::Landmarks2d));
    let step = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, 0.1)), Vector3::new(0.15, 0.0, 0.0));
    let mut start = flat_frame(dice).to_se3();
    start.translation *= 0.4;
    let (mut truth, mut odometry) = (start, Se3::identity());
    let mut truths = Vec::new();
    for stamp in 0.. {
        let (mut points, mut marks) = (Vec::new(), Vec::new());
        for (k, thing) in things.iter().enumerate() {
            let at = truth.inverse() * thing.at;
            let (range, bearing) = (at.norm(), at.y.atan2(at.x));
            if range > 5.0 || dice.random_range(0..3) != 0 {
                continue;
            }
            let (r, b) = (range + 0.08 * normal(dice), bearing + 0.015 * normal(dice));
            let axes = So3::exp(&Vector3::new(0.0, 0.0, b)).matrix();
            let variances = Vector3::new(0.08 * 0.08, (0.015 * r) * (0.015 * r), 1e-6);
            let covariance = Covariance::new(axes * Matrix3::from_diagonal(&variances) * axes.transpose()).unwrap();
            points.push([(r * b.cos()) as f32, (r * b.sin()) as f32, 0.3]);
            marks.push(Mark { covariance, label: labelled.then_some(k as u32), descriptor: Some(thing.descriptor) });
        }
        truths.push(truth);
        if let Some(submap) = builder.push(keyframe(stamp, odometry, points, marks)).unwrap() {
            let anchor = (submap.keyframes.len() - 1) / 2;
            return (submap, truths[anchor]);
        }
        let noise = Vector6::from_fn(|k, _| if matches!(k, 2..=4) { 0.0 } else { MOTION[k] * normal(dice) });
        truth = truth * step;
        odometry = odometry * step.retract(&noise);
    }
    unreachable!("a submap ends")
}

/// Landmarks of whole submaps, and alignments of these: covariances are honest in both.
#[test]
fn a_drive_becomes_landmarks_and_drives_are_aligned() {
    let mut dice = Dice::seed_from_u64(5);
    let (mut places, mut count, mut aligned, mut sum) = (0.0, 0, 0, 0.0);
    let trials = 100;
    for _ in 0..trials {
        let things = world(&mut dice, 25, 5.0, true);
        let submaps = [0, 1].map(|_| driven(&mut dice, &things, true));
        let [(mine, t_world_mine), (theirs, t_world_theirs)] = &submaps;
        for landmark in &mine.constellation.landmarks {
            let at = t_world_mine.inverse() * things[landmark.mark.label.unwrap() as usize].at;
            let mut j = nalgebra::Matrix3x6::identity();
            j.fixed_view_mut::<3, 3>(0, 3).copy_from(&-crate::geometry::so3::hat(&landmark.at));
            let common = j * mine.constellation.common.matrix() * j.transpose();
            let whole = Covariance::new(landmark.mark.covariance.matrix() + common).unwrap();
            places += whole.mahalanobis_squared(&(landmark.at - at));
            count += 1;
        }
        let described = [mine, theirs].map(|s| describe(s, &config(Sensor::Landmarks2d)));
        let [Described { features, .. }, Described { keypoints, .. }] = &described;
        let found = match register(keypoints, features, &planar()) {
            Ok(found) => found,
            Err(error) => {
                println!("drives: {error}");
                continue;
            }
        };
        let truth = Sim3::from_se3(&(t_world_mine.inverse() * *t_world_theirs));
        aligned += 1;
        sum += nees(&found, &truth);
    }
    let (places, sum) = (places / f64::from(count), sum / f64::from(aligned));
    println!("drives: landmarks NEES {places:.2} for 2, {aligned} of {trials} aligned, NEES {sum:.2} for 3");
    assert!((1.5..2.6).contains(&places), "{places}");
    assert!(aligned >= trials * 9 / 10 && (1.0..4.5).contains(&sum), "{aligned} {sum}");
}

#[test]
fn sightings_without_labels_are_told_apart_by_place_and_looks() {
    let mut dice = Dice::seed_from_u64(6);
    let things = world(&mut dice, 25, 5.0, true);
    let (labelled, _) = driven(&mut Dice::seed_from_u64(7), &things, true);
    let (bare, _) = driven(&mut Dice::seed_from_u64(7), &things, false);
    // Same dice: the same sightings, which fall into the same landmarks.
    let (bare, labelled) = (bare.constellation, labelled.constellation);
    assert_eq!(bare.landmarks.len(), labelled.landmarks.len());
    for (a, b) in bare.landmarks.iter().zip(&labelled.landmarks) {
        assert_eq!((a.at, a.mark.covariance, a.sightings), (b.at, b.mark.covariance, b.sightings));
    }
}

/// A label seen in two places is nobody's; one misread among many sightings is left out.
#[test]
fn a_label_that_lies_within_a_submap_is_dropped() {
    let mark =
        |label| Mark { covariance: Covariance::from_sigmas([0.05; 3]).unwrap(), label: Some(label), descriptor: None };
    let mut builder = SubmapBuilder::new(config(Sensor::Landmarks));
    let at = |x: f32| [x, 1.0, 0.2];
    for k in 0..12 {
        let moved = Se3::new(So3::identity(), Vector3::new(0.1 * f64::from(k), 0.0, 0.0));
        let off = 0.1 * k as f32;
        let two = if k % 2 == 0 { at(2.0 - off) } else { at(4.0 - off) };
        let misread = if k == 5 { [9.0, 9.0, 9.0] } else { at(3.0 - off) };
        let points = vec![at(1.0 - off), two, misread];
        builder.push(keyframe(i64::from(k), moved, points, vec![mark(1), mark(2), mark(3)])).unwrap();
    }
    let submap = builder.flush().unwrap();
    let labels: Vec<u32> = submap.constellation.landmarks.iter().filter_map(|l| l.mark.label).collect();
    assert_eq!(labels, [1, 3]);
    let third = submap.t_frame_anchor * submap.constellation.landmarks[1].at;
    assert!((third - Vector3::new(3.0, 1.0, 0.2)).norm() < 0.02, "{third}");
}

#[test]
fn marks_and_points_must_fit_the_sensor() {
    let mark =
        |sigma: f64| Mark { covariance: Covariance::from_sigmas([sigma; 3]).unwrap(), label: None, descriptor: None };
    let try_with = |sensor, points: usize, marks: Vec<Mark>| {
        let mut builder = SubmapBuilder::new(config(sensor));
        builder.push(keyframe(1, Se3::identity(), vec![[1.0, 0.0, 0.0]; points], marks)).map(drop)
    };
    assert_eq!(try_with(Sensor::Landmarks, 2, vec![mark(0.1); 2]), Ok(()));
    assert_eq!(try_with(Sensor::Points3d, 2, vec![]), Ok(()));
    assert_eq!(try_with(Sensor::Landmarks, 2, vec![]), Err(KeyframeError::Marks { points: 2, marks: 0 }));
    assert_eq!(try_with(Sensor::Landmarks2d, 2, vec![mark(0.1); 3]), Err(KeyframeError::Marks { points: 2, marks: 3 }));
    assert_eq!(try_with(Sensor::Laser2d, 2, vec![mark(0.1); 2]), Err(KeyframeError::Marks { points: 2, marks: 2 }));
    let (least, most) = (*SIGMA_RANGE.start(), *SIGMA_RANGE.end());
    for (sigma, good) in [(least * 1.01, true), (least * 0.99, false), (most * 0.99, true), (most * 1.01, false)] {
        let told = try_with(Sensor::Landmarks, 1, vec![mark(sigma)]);
        assert_eq!(told, if good { Ok(()) } else { Err(KeyframeError::MarkOutOfRange { index: 0 }) }, "{sigma}");
    }
}

#[test]
fn memory_is_bounded_and_a_blob_stays_within_its_bytes() {
    let mut dice = Dice::seed_from_u64(8);
    let mut builder = SubmapBuilder::new(config(Sensor::Landmarks));
    let mark = |label| Mark {
        covariance: Covariance::from_sigmas([0.01; 3]).unwrap(),
        label: Some(label),
        descriptor: Some([7; 32]),
    };
    for k in 0..3 {
        let points = (0..1500).map(|_| vector(&mut dice, 50.0).map(|x| x as f32).into()).collect();
        let marks = (0..1500).map(|n| mark(1500 * k + n)).collect();
        builder.push(keyframe(i64::from(k), Se3::identity(), points, marks)).unwrap();
    }
    let submap = builder.flush().unwrap();
    assert_eq!(submap.constellation.landmarks.len(), super::LANDMARKS_MAX);
    let described = describe(&submap, &config(Sensor::Landmarks));
    assert_eq!(described.features.len(), super::LANDMARKS_MAX);
    let blob = described.keypoints.encode();
    let further = described.further.unwrap();
    for (len, fewest) in [(blob.len(), 6_900), (further.encode().len(), 6_860)] {
        assert!((fewest..=7_000).contains(&len), "{len}");
    }
    let both = described.keypoints.with_further(&further).unwrap();
    let landmarks = |of: &Codec| of.landmarks();
    let all = landmarks(described.features.landmarks.as_ref().unwrap());
    assert_eq!(landmarks(both.landmarks.as_ref().unwrap()), all[..both.len()]);
    assert_eq!(Keypoints::decode(&blob).unwrap().further(), Some(Hash::of(&further.encode())));
    assert!(described.summary.encode().len() <= super::super::SUMMARY_LEN_MAX);
}

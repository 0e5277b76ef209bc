use super::super::descriptor::Code;
use super::super::testing::{config, keyframe, moved_room, room, room_points, submap};
use super::super::{RefineConfig, RefineError, SubmapBuilder, fit, match_keypoints, refine};
use super::*;
use crate::geometry::{Se3, Sim3};

#[test]
fn describing_is_reproducible_to_the_bit() {
    let again = || describe(&submap(&room_points(3)), &config());
    assert_eq!(again(), again());
    assert_ne!(again().keypoints, room(4).keypoints);
}

#[test]
fn descriptors_do_not_turn_with_the_robot() {
    // The cloud as it stands (no second thinning, whose grid would turn too): same points, turned.
    let upright = submap(&room_points(5));
    let t = Se3::exp(&nalgebra::Vector6::new(0.3, -0.2, 0.1, 0.9, -1.1, 2.0));
    let turn = |p: &[f32; 3]| {
        let q = t * Vector3::from(p.map(f64::from));
        [q.x as f32, q.y as f32, q.z as f32]
    };
    let turned = Submap {
        cloud: upright.cloud.iter().map(turn).collect(),
        keyframes: upright.keyframes.iter().map(|pose| t * *pose).collect(),
        ..upright.clone()
    };
    let (a, b) = (describe(&upright, &config()), describe(&turned, &config()));
    let apart = |(a, b): (&Code, &Code)| -> i32 {
        a.iter().zip(b).map(|(&x, &y)| (i32::from(x) - i32::from(y)) * (i32::from(x) - i32::from(y))).sum()
    };
    let median = |mut all: Vec<i32>| {
        all.sort_unstable();
        all[all.len() / 2]
    };
    let turned = median(a.features.codes().iter().zip(b.features.codes()).map(apart).collect());
    let others = median(a.features.codes().iter().zip(b.features.codes().iter().rev()).map(apart).collect());
    // The neighbours are thinned along other axes, so that the same place differs a little.
    assert!(10 * turned < others, "{turned} {others}");
    assert!(a.summary.similarity(&b.summary) > 0.9);
}

#[test]
fn one_room_from_two_places_is_matched_and_refined() {
    let mine = room(6);
    let (theirs, t_theirs_mine) = moved_room(6, Vector3::new(0.4, -0.3, 1.9), Vector3::new(0.3, 0.1, 0.05));
    let truth = t_theirs_mine.inverse();
    let matches = match_keypoints(&theirs.keypoints, &mine.features);
    let near = |(s, t): &(&[f64; 3], &[f64; 3])| (truth * Vector3::from(**s) - Vector3::from(**t)).norm() < 0.15;
    let right = matches.source.iter().zip(&matches.target).filter(near).count();
    assert!(right >= 30, "{right} of {}", matches.source.len());
    assert!(matches.scores.is_sorted_by(|a, b| a >= b));

    let rough = truth.retract(&nalgebra::Vector6::new(0.1, -0.08, 0.05, 0.03, 0.02, -0.03));
    let refined = refine(&theirs.keypoints, &mine.features, &rough, &RefineConfig::default()).unwrap();
    let error = refined.pose.pose.local(&truth);
    assert!(error.fixed_rows::<3>(0).norm() < 0.01 && error.fixed_rows::<3>(3).norm() < 0.005, "{error}");
    assert!(refined.pose.covariance.mahalanobis_squared(&error) < 12.6);
    let fits = |t: &Se3| fit(&theirs.keypoints, &mine.features, &Sim3::from_se3(t), 0.15);
    assert!(fits(&truth) > 0.95);
    let elsewhere = Se3::new(truth.rotation, truth.translation + Vector3::new(9.0, 0.0, 0.0));
    assert_eq!(fits(&elsewhere), 0.0);
}

#[test]
fn clouds_without_shape_are_described_and_never_aligned() {
    let line: Vec<_> = (0..400).map(|k| Vector3::new(f64::from(k) * 0.05, 0.0, 0.0)).collect();
    let place = vec![Vector3::new(1.0, 2.0, 3.0); 400];
    let plane: Vec<_> =
        (0..6400).map(|k| Vector3::new(f64::from(k % 80) * 0.05, f64::from(k / 80) * 0.05, 2.0)).collect();
    let pair = [Vector3::zeros(), Vector3::new(1e30, 0.0, 0.0)];
    for (points, planar) in [(&[][..], false), (&line, false), (&place, false), (&pair, false), (&plane, true)] {
        let described = describe(&submap(points), &config());
        let (theirs, mine) = (&described.keypoints, &described.features);
        assert_eq!(Keypoints::decode(&theirs.encode()).as_ref(), Ok(theirs));
        match_keypoints(theirs, mine);
        assert!(described.extent.iter().all(|e| e.is_finite()));
        let refused = refine(theirs, mine, &Se3::identity(), &RefineConfig::default()).unwrap_err();
        assert_eq!(matches!(refused, RefineError::Degenerate { .. }), planar, "{refused}");
    }
}

#[test]
fn keypoints_are_as_many_as_asked_for_within_the_limit() {
    let points = room_points(2);
    let asked = |keypoints: usize| describe(&submap(&points), &SubmapConfig { keypoints, ..config() }).keypoints.len();
    assert_eq!((asked(16), asked(1024), asked(1025)), (16, 1024, 1024));
}

#[test]
fn further_keypoints_change_nothing_of_the_first_and_are_others() {
    let points = room_points(2);
    let described = |keypoints_further| describe(&submap(&points), &SubmapConfig { keypoints_further, ..config() });
    let alone = described(0);
    assert_eq!((alone.further, alone.keypoints.further()), (None, None));
    for (asked, given) in [(1, 1), (330, 330), (1024, 1024), (1025, 1024)] {
        let Described { keypoints, further, features, summary, .. } = described(asked);
        let further = further.unwrap();
        assert_eq!(further.len(), given);
        assert_eq!(
            (keypoints.surfels(), &features, &summary),
            (alone.keypoints.surfels(), &alone.features, &alone.summary)
        );
        let first = keypoints.surfels();
        assert!(further.surfels().iter().all(|one| !first.contains(one)));
        assert_eq!(keypoints.with_further(&further).unwrap().len(), keypoints.len() + given);
    }
    // Where the first take all there is, nothing goes on.
    let few: Vec<_> = points.iter().take(150).copied().collect();
    let few = describe(&submap(&few), &config());
    assert_eq!((few.further, few.keypoints.further()), (None, None));
}

#[test]
fn normals_look_back_at_the_keyframe_that_saw_them() {
    let mut builder = SubmapBuilder::new(config());
    let wall: Vec<_> = (0..900).map(|k| Vector3::new(2.0, f64::from(k % 30) * 0.1, f64::from(k / 30) * 0.1)).collect();
    builder.push(keyframe(1, Se3::identity(), &wall)).unwrap();
    let described = describe(&builder.flush().unwrap(), &config());
    let surfels = described.features.surfels();
    let normals: Vec<_> = surfels.iter().filter(|s| s.roughness.is_some()).map(|s| s.normal).collect();
    assert!(normals.len() > 300);
    for n in normals {
        assert!((n + Vector3::x()).norm() < 1e-9, "{n}");
    }
}

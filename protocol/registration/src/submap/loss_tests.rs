use super::super::testing::keyframe;
use super::super::{KeyframeError, SubmapBuilder};
use super::*;
use crate::geometry::{Covariance, Se3, So3};
use nalgebra::Vector3;

fn config() -> SubmapConfig {
    SubmapConfig { voxel_m: 0.1, distance_m: 10.0, keyframes_max: 1, ..Default::default() }
}

/// At this second and place on a straight way, turned by so much, with these standard deviations.
fn at(secs: f64, x: f64, turn: f64, sigma: f64) -> Keyframe {
    let pose = Se3::new(So3::exp(&Vector3::new(0.0, 0.0, turn)), Vector3::new(x, 0.0, 0.0));
    let mut keyframe = keyframe((secs * 1e9) as i64, pose, &[]);
    keyframe.pose.covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
    keyframe
}

/// What is stated of the motion to the last of these, and the gap before it.
fn crossed(keyframes: &[Keyframe]) -> (f64, Option<Loss>) {
    let mut builder = SubmapBuilder::new(config());
    let mut sigma = 0.0;
    for keyframe in keyframes {
        let _ = builder.take_gap();
        if let Ok(Some(submap)) = builder.push(keyframe.clone()) {
            sigma = submap.odometry.covariance.sigmas()[0];
        }
    }
    ((sigma * 1e6).round() / 1e6, builder.take_gap())
}

/// Keyframes a second and a metre apart, then one at this place and second.
fn straight(secs: f64, x: f64, sigma: f64) -> Vec<Keyframe> {
    let usual = (0..10).map(|k| at(f64::from(k), f64::from(k), 0.0, 0.01));
    usual.chain([at(9.0 + secs, 9.0 + x, 0.0, sigma)]).collect()
}

#[test]
fn a_step_far_longer_than_all_before_in_way_and_time_is_a_gap() {
    assert_eq!(crossed(&straight(1.0, 1.0, 0.01)), (0.01, None));
    assert_eq!(crossed(&straight(2.4, 2.4, 0.01)).1, None, "one lost keyframe looks like a little haste");
    let (sigma, gap) = crossed(&straight(3.0, 3.0, 0.01));
    assert!((0.3..0.33).contains(&sigma) && gap == Some(Loss::Unseen), "{sigma}");
    // Faster, but no keyframe is missing; late, but hardly farther; and a front end that knows what it does.
    assert_eq!(crossed(&straight(1.0, 4.0, 0.01)), (0.01, None));
    assert_eq!(crossed(&straight(60.0, 1.2, 0.01)), (0.01, None));
    assert_eq!(crossed(&straight(9.0, 9.0, 0.03)), (0.03, None));
    assert_eq!(crossed(&straight(9.0, 9.0, 0.02)).1, Some(Loss::Unseen));
}

#[test]
fn the_same_of_a_turn_on_the_spot() {
    let turning = |turn: f64, secs: f64| {
        let usual = (0..10).map(|k| at(f64::from(k), 0.0, 0.1 * f64::from(k), 0.01));
        crossed(&usual.chain([at(9.0 + secs, 0.0, 0.9 + turn, 0.01)]).collect::<Vec<_>>()).1
    };
    assert_eq!([turning(0.2, 2.0), turning(0.5, 5.0), turning(0.5, 1.0)], [None, Some(Loss::Unseen), None]);
}

#[test]
fn nothing_is_missed_before_it_is_known_what_is_usual() {
    let few = |count: u32| {
        let mut keyframes: Vec<_> = (0..count).map(|k| at(f64::from(k), f64::from(k), 0.0, 0.01)).collect();
        keyframes.push(at(60.0, 9.0, 0.0, 0.01));
        crossed(&keyframes).1
    };
    assert_eq!([few(1), few(4), few(5)], [None, None, Some(Loss::Unseen)]);
    // A robot that stands makes no steps.
    let mut standing: Vec<_> = (0..50).map(|k| at(f64::from(k), 0.005 * f64::from(k % 2), 0.0, 0.01)).collect();
    standing.push(at(60.0, 3.0, 0.0, 0.01));
    assert_eq!(crossed(&standing).1, None);
}

/// What the shell, the core or a full queue lost widens the next motion, and that alone.
#[test]
fn whatever_was_lost_widens_one_motion() {
    for why in [Loss::Unreadable, Loss::TooLarge, Loss::QueueFull, Loss::Overload] {
        let mut builder = SubmapBuilder::new(config());
        builder.lose(why); // nothing lies before it
        builder.push(at(0.0, 0.0, 0.0, 0.01)).unwrap();
        assert_eq!(builder.take_gap(), None);
        builder.push(at(1.0, 1.0, 0.0, 0.01)).unwrap();
        assert_eq!(builder.take_gap(), None);
        builder.lose(why);
        builder.lose(Loss::Late);
        let sigma = builder.push(at(3.0, 3.0, 0.0, 0.01)).unwrap().unwrap().odometry.covariance.sigmas()[0];
        assert!((0.2..0.22).contains(&sigma), "{sigma}");
        assert_eq!((builder.take_gap(), builder.take_gap()), (Some(why), None));
        let sigma = builder.push(at(4.0, 4.0, 0.0, 0.01)).unwrap().unwrap().odometry.covariance.sigmas()[0];
        assert!((sigma - 0.01).abs() < 1e-9, "{sigma}");
    }
}

#[test]
fn a_late_keyframe_is_lost_and_a_repeated_one_is_not() {
    let after = |between: &[f64]| {
        let mut builder = SubmapBuilder::new(config());
        (0..10).for_each(|k| drop(builder.push(at(f64::from(k), f64::from(k), 0.0, 0.01)).unwrap()));
        for secs in between {
            let refused = builder.push(at(*secs, *secs, 0.0, 0.01));
            assert!(matches!(refused, Err(KeyframeError::StampNotRising { .. })));
        }
        builder.push(at(10.0, 10.0, 0.0, 0.01)).unwrap();
        builder.take_gap()
    };
    assert_eq!([after(&[]), after(&[9.0, 3.0, 0.0])], [None, None]);
    // The clock was set back by 2.5 s; one came out of order.
    assert_eq!([after(&[7.5, 8.5]), after(&[8.9])], [Some(Loss::Late); 2]);
}

#[test]
fn as_many_stamps_are_remembered_as_the_limit_says() {
    let mut arrivals = Arrivals::default();
    (0..=STAMPS_MAX as i64).for_each(|k| arrivals.take(None, &keyframe(k, Se3::identity(), &[]), &config()));
    assert!(!arrivals.has(Stamp(0)) && arrivals.has(Stamp(1)) && arrivals.has(Stamp(STAMPS_MAX as i64)));
}

/// The covariances of a chain of poses span a gap; those that do not grow are no chain's.
#[test]
fn poses_span_a_gap_if_their_covariances_grow() {
    let of_pose = |secs: f64, sigma: f64| Keyframe { covariance_of: CovarianceOf::Pose, ..at(secs, secs, 0.0, sigma) };
    let gap = |sigma: f64| {
        let mut builder = SubmapBuilder::new(config());
        builder.push(of_pose(0.0, 0.03)).unwrap();
        builder.lose(Loss::Unreadable);
        let submap = builder.push(of_pose(5.0, sigma)).unwrap().unwrap();
        (submap.odometry.covariance.sigmas()[0], builder.take_gap())
    };
    let (sigma, why) = gap(0.5);
    assert!(why.is_none() && (0.49..0.5).contains(&sigma), "{sigma}");
    let (sigma, why) = gap(0.03);
    assert!(why == Some(Loss::Unreadable) && sigma >= 0.5, "{sigma}");
}

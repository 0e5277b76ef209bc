use super::super::runs::SESSIONS_OVER_MAX;
use super::super::testing::keyframe;
use super::super::{CovarianceOf, SubmapBuilder};
use super::*;
use crate::geometry::{Covariance, Se3, So3};
use crate::time::Stamp;
use nalgebra::Vector3;

fn at(x: f64) -> Se3 {
    Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0))
}

fn turned(deg: f64) -> Se3 {
    Se3::new(So3::exp(&Vector3::new(0.0, 0.0, deg.to_radians())), Vector3::zeros())
}

fn timed(secs: f64, pose: Se3) -> Keyframe {
    keyframe((secs * 1e9).round() as i64, pose, &[])
}

/// How keyframes at these times and places are taken.
#[derive(Debug, Default, PartialEq)]
struct Taken {
    refused: Vec<usize>,
    frames: Vec<usize>,
}

/// As an agent does: refuses what does not go on, and begins anew where another frame has begun.
fn drive(config: &SubmapConfig, keyframes: &[Keyframe]) -> Taken {
    let mut builder = SubmapBuilder::new(config.clone());
    let mut taken = Taken::default();
    for (k, keyframe) in keyframes.iter().enumerate() {
        if builder.another_frame(keyframe).is_some() {
            builder = SubmapBuilder::new(config.clone());
            taken.frames.push(k);
        }
        if let Err(error) = builder.push(keyframe.clone()) {
            assert!(matches!(error, KeyframeError::Jump { .. }), "{error}");
            taken.refused.push(k);
        }
    }
    taken
}

/// A drive at 1 m/s, a keyframe a second, from second `from` to `to`; where the frame's origin lies at `zero`.
fn along(from: u32, to: u32, zero: f64) -> Vec<Keyframe> {
    (from..to).map(|k| timed(f64::from(k), at(f64::from(k) - zero))).collect()
}

#[test]
fn a_front_end_that_restarts_begins_another_frame_near_or_far() {
    for way in [5, 15, 31] {
        for scale in [ScaleKind::Metric, ScaleKind::Unknown] {
            let config = SubmapConfig { scale, ..Default::default() };
            // The same way again, from the origin.
            let keyframes = [along(0, way + 1, 0.0), along(way + 1, 3 * way + 9, f64::from(way) + 1.0)].concat();
            let after = way as usize + 1;
            let wanted = Taken { refused: vec![after, after + 1, after + 2], frames: vec![after + 3] };
            assert_eq!(drive(&config, &keyframes), wanted, "{way}, {scale:?}");
        }
    }
    // Back towards where it was before: the new way leads through the last place of the old frame.
    let back = |k: u32| timed(f64::from(16 + k), at(10.0 + 1.2 * f64::from(k)));
    let keyframes = [along(0, 16, 0.0), (0..12).map(back).collect()].concat();
    assert_eq!(drive(&SubmapConfig::default(), &keyframes).frames, vec![19]);
    // It takes seconds, and the robot stands.
    for pause in [5.0, 60.0, 3600.0] {
        let after = |k: u32| timed(16.0 + pause + f64::from(k), at(f64::from(k)));
        let keyframes = [along(0, 16, 0.0), (0..12).map(after).collect()].concat();
        assert_eq!(drive(&SubmapConfig::default(), &keyframes).frames, vec![19], "{pause} s");
    }
}

/// What cannot be seen, and what is just seen: the documented limit.
#[test]
fn a_jump_as_long_as_a_few_steps_goes_on_and_a_longer_one_does_not() {
    let jump = |x: f64| drive(&SubmapConfig::default(), &[along(0, 11, 0.0), vec![timed(11.0, at(10.0 + x))]].concat());
    // Four steps of 1 m, and four σ of 1 cm.
    assert_eq!(jump(4.03), Taken::default());
    assert_eq!(jump(4.05).refused, vec![11]);
    // Until it is known how it drives, only what no robot does is refused: twenty metres, or 50 m/s.
    let early = |secs: f64, x: f64| drive(&SubmapConfig::default(), &[timed(0.0, at(0.0)), timed(secs, at(x))]);
    assert_eq!((early(1.0, 20.03), early(1.0, 20.05).refused), (Taken::default(), vec![1]));
    assert_eq!((early(0.2, 10.03), early(0.2, 10.05).refused), (Taken::default(), vec![1]));
    // Within a submap's length no speed is judged: stamps may be coarse.
    assert_eq!((early(1e-9, 2.0), early(1e-9, 2.05).refused), (Taken::default(), vec![1]));
    // Who says that he does not know is believed.
    let mut unsure = timed(1.0, at(25.0));
    unsure.pose.covariance = Covariance::from_sigmas([2.0, 0.01, 0.01, 0.01, 0.01, 0.01]).unwrap();
    assert_eq!(drive(&SubmapConfig::default(), &[timed(0.0, at(0.0)), unsure]), Taken::default());
}

#[test]
fn a_turn_is_judged_by_its_time() {
    let config = SubmapConfig { turn_max_deg_s: 90.0, ..Default::default() };
    let turn = |secs: f64, deg: f64| drive(&config, &[timed(0.0, turned(0.0)), timed(secs, turned(deg))]);
    // Four σ of 0.01 rad are 2.3°.
    assert_eq!((turn(1.0, 92.0), turn(1.0, 93.0).refused), (Taken::default(), vec![1]));
    assert_eq!((turn(0.01, 62.0), turn(0.01, 63.0).refused), (Taken::default(), vec![1]));
    assert_eq!(turn(2.0, 180.0), Taken::default());
    // A robot that spins as fast as it can is none that restarts.
    let spins: Vec<_> = (0..40).map(|k| timed(0.5 * f64::from(k), turned(44.0 * f64::from(k)))).collect();
    assert_eq!(drive(&config, &spins), Taken::default());
}

#[test]
fn an_outlier_is_refused_and_nothing_else() {
    for (k, x) in [(12, -30.0), (12, 12.0 + 6.0), (12, 0.0)] {
        let mut keyframes = along(0, 30, 0.0);
        keyframes[k].pose.pose = at(x);
        assert_eq!(drive(&SubmapConfig::default(), &keyframes), Taken { refused: vec![k], frames: vec![] }, "{x}");
    }
    // Two at different places; what is sent twice counts once.
    let mut keyframes = along(0, 30, 0.0);
    keyframes[12].pose.pose = at(-30.0);
    keyframes[13].pose.pose = at(60.0);
    assert_eq!(drive(&SubmapConfig::default(), &keyframes).refused, vec![12, 13]);
    let keyframes = [along(0, 12, 0.0), vec![timed(12.0, at(-30.0)); 9], along(13, 30, 0.0)].concat();
    let taken = drive(&SubmapConfig::default(), &keyframes);
    assert_eq!((taken.refused, taken.frames), ((12..21).collect(), vec![]));
    // The motion over the hole is as uncertain as one over any.
    let mut builder = SubmapBuilder::new(SubmapConfig { keyframes_max: 1, ..Default::default() });
    let mut sigmas = Vec::new();
    for keyframe in [along(0, 12, 0.0), vec![timed(12.0, at(-30.0))], along(13, 15, 0.0)].concat() {
        sigmas.extend(builder.push(keyframe).ok().flatten().map(|submap| submap.odometry.covariance.sigmas()[0]));
    }
    assert!(sigmas[11] < 0.02 && sigmas[12] > 0.2 && sigmas[13] < 0.02, "{sigmas:?}");
}

#[test]
fn the_way_back_after_an_outlier_is_refused_too_if_it_is_too_far() {
    // Lost for ten seconds, of which each keyframe lies elsewhere; then where it would be.
    let lost = |k: u32| timed(f64::from(k), at(f64::from(k) + if k.is_multiple_of(2) { 300.0 } else { -300.0 }));
    let keyframes = [along(0, 12, 0.0), (12..22).map(lost).collect(), along(22, 40, 0.0)].concat();
    let taken = drive(&SubmapConfig::default(), &keyframes);
    assert_eq!(taken, Taken { refused: (12..25).collect(), frames: vec![25] });
}

#[test]
fn what_is_fast_or_seldom_is_no_restart() {
    let metres = SubmapConfig::default;
    let street = |secs: f64, speed: f64, distance_m: f64| {
        let config = SubmapConfig { distance_m, ..metres() };
        let keyframes: Vec<_> = (0..60).map(|k| timed(secs * f64::from(k), at(speed * secs * f64::from(k)))).collect();
        drive(&config, &keyframes)
    };
    assert_eq!(street(1.0, 15.0, 2.0), Taken::default(), "a car, even with a robot's submaps");
    assert_eq!(street(1.0, 36.0, 10.0), Taken::default(), "a motorway");
    assert_eq!(street(0.1, 36.0, 10.0), Taken::default());
    assert_eq!(street(5.0, 1.5, 2.0), Taken::default());
    // Waits at a light for half a minute, and pulls away at 4 m/s².
    let (mut x, mut v): (f64, f64) = (0.0, 15.0);
    let car = |k: u32| {
        v = if k % 60 < 30 { (v - 7.0).max(0.0) } else { (v + 4.0).min(15.0) };
        x += v;
        timed(f64::from(k), at(x))
    };
    let config = SubmapConfig { distance_m: 5.0, ..metres() };
    assert_eq!(drive(&config, &(0..240).map(car).collect::<Vec<_>>()), Taken::default());
    // Creeps, stands for an hour without a keyframe, creeps on.
    let creeps: Vec<_> = (0..40).map(|k| timed(f64::from(k + 3600 * (k / 10)), at(0.3 * f64::from(k)))).collect();
    assert_eq!(drive(&metres(), &creeps), Taken::default());
    // Three keyframes in a row are lost; at ten a second, two seconds of them.
    let mut holed = along(0, 40, 0.0);
    holed.drain(20..23);
    assert_eq!(drive(&metres(), &holed), Taken::default());
    let mut quick: Vec<_> = (0..200).map(|k| timed(0.1 * f64::from(k), at(0.3 * f64::from(k)))).collect();
    quick.drain(100..120);
    assert_eq!(drive(&metres(), &quick), Taken::default());
}

/// A robot that saw nothing for long may be a submap or two farther, and not a third.
#[test]
fn after_a_long_silence_a_step_may_span_two_submaps() {
    // Steps of 0.3 m: four of them are less than that.
    let creep = |from: f64, k: u32| timed(from + f64::from(k), at(0.3 * f64::from(k)));
    let silent = |secs: f64, way: f64| {
        let onward = |k: u32| timed(20.0 + secs + f64::from(k), at(6.0 + way + 0.3 * f64::from(k)));
        drive(
            &SubmapConfig::default(),
            &[(0..21).map(|k| creep(0.0, k)).collect::<Vec<_>>(), (0..9).map(onward).collect()].concat(),
        )
    };
    let two = SILENT_SUBMAPS_MAX * SubmapConfig::default().distance_m;
    assert_eq!(silent(SILENT_SECS_MIN, two), Taken::default());
    assert_eq!(silent(3600.0, two), Taken::default());
    assert_ne!(silent(SILENT_SECS_MIN - 0.1, two), Taken::default());
    // With four of the stated standard deviations.
    assert_ne!(silent(3600.0, two + 0.1), Taken::default());
}

/// A front end that hands keyframes over five times more seldom from now on loses some of them, and a frame, but is not
/// refused for ever.
#[test]
fn another_pace_is_another_frame_at_worst() {
    let seldom = |k: u32| timed(20.0 + 8.0 * f64::from(k), at(20.0 + 8.0 * f64::from(k)));
    let keyframes = [along(0, 21, 0.0), (1..30).map(seldom).collect()].concat();
    let taken = drive(&SubmapConfig::default(), &keyframes);
    assert_eq!(taken, Taken { refused: (21..28).collect(), frames: vec![28] });
}

#[test]
fn a_session_says_it_at_once() {
    let of = |session: Option<u64>, keyframes: Vec<Keyframe>| -> Vec<Keyframe> {
        keyframes.into_iter().map(|keyframe| Keyframe { session, ..keyframe }).collect()
    };
    let drive = |parts: &[Vec<Keyframe>]| drive(&SubmapConfig::default(), &parts.concat());
    let begun = |k: usize| Taken { refused: vec![], frames: vec![k] };
    assert_eq!(drive(&[of(Some(7), along(0, 3, 0.0)), of(Some(8), along(3, 9, 3.0))]), begun(3), "too near to be seen");
    assert_eq!(
        drive(&[of(Some(7), along(0, 31, 0.0)), of(Some(3), along(31, 39, 31.0))]),
        begun(31),
        "a counter that was lost"
    );
    // Nothing said is nothing new.
    assert_eq!(drive(&[along(0, 3, 0.0), of(Some(8), along(3, 9, 0.0)), along(9, 12, 0.0)]), Taken::default());
    assert_eq!(drive(&[of(Some(8), along(0, 3, 0.0)), along(3, 9, 0.0), of(Some(9), along(9, 12, 0.0))]), begun(9));
    // A clock that went back with the restart is no hindrance; a late keyframe of the session before is only late.
    assert_eq!(drive(&[of(Some(7), along(50, 53, 50.0)), of(Some(8), along(0, 9, 0.0))]), begun(3));
    let mut builder = SubmapBuilder::new(SubmapConfig::default());
    builder.push(of(Some(8), along(5, 6, 5.0)).remove(0)).unwrap();
    assert_eq!(builder.another_frame(&of(Some(7), along(5, 6, 0.0))[0]), None);
    assert_eq!(builder.another_frame(&of(Some(7), along(6, 7, 0.0))[0]), Some(FrameSign::Session));
}

#[test]
fn sessions_that_are_over_stay_so_and_a_bad_keyframe_begins_none() {
    let of = |session: u64| Keyframe { session: Some(session), ..along(1, 2, 1.0).remove(0) };
    let over = |session: u64| Err(KeyframeError::SessionOver { session });
    let mut builder = SubmapBuilder::new(SubmapConfig::default());
    for session in 0..=SESSIONS_OVER_MAX as u64 {
        builder.push(of(session)).unwrap();
        let mut bad = Keyframe { stamp: Stamp(i64::MAX), ..of(session + 1) };
        assert_eq!(builder.another_frame(&bad), None);
        bad.stamp = of(0).stamp;
        assert_eq!(builder.another_frame(&bad), Some(FrameSign::Session));
        builder = builder.begun_anew(true);
        assert_eq!((builder.another_frame(&of(session)), builder.push(of(session))), (None, over(session)));
    }
    // One more than are remembered were left.
    assert_eq!(builder.push(of(1)), over(1));
    assert!(builder.push(of(0)).is_ok());
    // A frame that ended otherwise is of a session that goes on.
    assert!(builder.begun_anew(false).push(of(0)).is_ok());
}

/// Poses that a loop closure corrected: a correction within a submap's length passes, with a covariance that knows
/// nothing of it; so says the documentation.
#[test]
fn absolute_poses_may_be_corrected_a_little() {
    let of_pose = |secs: f64, x: f64, sigma: f64| {
        let mut keyframe = timed(secs, at(x));
        keyframe.covariance_of = CovarianceOf::Pose;
        keyframe.pose.covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
        keyframe
    };
    let way: Vec<_> = (0..20).map(|k| of_pose(f64::from(k), f64::from(k), 0.01 * f64::from(k + 1).sqrt())).collect();
    let corrected =
        |by: f64| drive(&SubmapConfig::default(), &[way.clone(), vec![of_pose(20.0, 20.0 - by, 0.02)]].concat());
    assert_eq!(corrected(2.0), Taken::default());
    assert_eq!(corrected(9.0).refused, vec![20]);
}

#[test]
fn what_is_passed_over_is_known_to_have_been_there() {
    let mut builder = SubmapBuilder::new(SubmapConfig::default());
    along(0, 12, 0.0).into_iter().for_each(|keyframe| drop(builder.push(keyframe).unwrap()));
    along(12, 40, 0.0).iter().for_each(|keyframe| builder.pass(keyframe));
    assert!(builder.push(along(40, 41, 0.0).remove(0)).is_ok());
    let (_, t_anchor_body, _) = builder.body_since_anchor().unwrap();
    assert!(t_anchor_body.covariance.sigmas()[0] > 2.5, "a tenth of the way that nobody vouches for");
}

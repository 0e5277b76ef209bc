use super::super::testing::keyframe;
use super::super::{Keyframe, SubmapBuilder, describe};
use super::*;
use crate::config::{Gravity, Sensor, SubmapConfig, UP_SIGMA_RAD};
use crate::geometry::Covariance;
use proptest::prelude::*;

fn up(direction: [f64; 3], sigma: f64) -> Up {
    Up::new(direction, sigma).unwrap()
}

/// A direction tilted from z by `angle` towards a heading.
fn tilted(angle: f64, heading: f64) -> [f64; 3] {
    let (s, c) = (libm::sin(angle), libm::cos(angle));
    [s * libm::cos(heading), s * libm::sin(heading), c]
}

#[test]
fn what_is_no_direction_is_refused() {
    let of = |length: f64, sigma| Up::new([0.0, 0.0, length], sigma).map(|up| up.direction().z);
    assert_eq!((of(1.0, 0.02), of(0.991, 0.02), of(1.009, 0.02)), (Ok(1.0), Ok(1.0), Ok(1.0)));
    for length in [0.0, 0.989, 1.011, 9.81, f64::INFINITY] {
        assert_eq!(of(length, 0.02), Err(UpError::Length(length)));
    }
    assert!(matches!(of(f64::NAN, 0.02), Err(UpError::Length(_))));
    assert!(of(1.0, 0.001).is_ok() && of(1.0, 0.5).is_ok());
    for sigma in [0.0, -0.02, 0.000_999, 0.501] {
        assert_eq!(of(1.0, sigma), Err(UpError::Sigma(sigma)));
    }
    assert!(matches!(of(1.0, f64::NAN), Err(UpError::Sigma(_))));
    let message = Up::new([0.0, 0.0, 9.81], 0.02).unwrap_err().to_string();
    assert!(message.contains("9.81") && message.contains("not an acceleration"), "{message}");
}

#[test]
fn the_gate_lies_where_one_true_rotation_in_a_thousand_does() {
    let known = Verticals { theirs: up([0.0, 0.0, 1.0], 0.03), mine: up([0.0, 0.0, 1.0], 0.04) };
    let edge = 0.05 * (-2.0 * libm::log(1e-3)).sqrt();
    assert!((known.tilt_max(0.0) - edge).abs() < 1e-12 && known.tilt_max(0.05) > 1.4 * edge);
    let tilt = |angle: f64| So3::exp(&Vector3::new(0.0, angle, 0.0)).matrix() * So3::exp(&Vector3::z()).matrix();
    assert!((known.tilt(&tilt(0.3)) - 0.3).abs() < 1e-12);
    assert!(known.allow(&tilt(0.999 * edge), 0.0) && !known.allow(&tilt(1.001 * edge), 0.0));
    assert!(!known.allow(&tilt(core::f64::consts::PI), 0.0), "on its head");
    assert!(Verticals::of(Some(&known.mine), None).is_none() && Verticals::of(None, None).is_none());
}

/// Three keyframes a small turn apart of which some know what is up in their body.
fn submap(config: SubmapConfig, ups: [Option<Up>; 3], motion_sigma: f64) -> Option<Up> {
    let mut builder = SubmapBuilder::new(config.clone());
    for (stamp, up) in (1..).zip(ups) {
        let pose = Se3::new(So3::exp(&Vector3::new(0.0, 0.3 * (stamp - 2) as f64, 0.0)), Vector3::zeros());
        let mut one = Keyframe { up, ..keyframe(stamp, pose, &[Vector3::new(1.0, 2.0, 3.0)]) };
        one.pose.covariance = Covariance::from_sigmas([motion_sigma; 6]).unwrap();
        builder.push(one).unwrap();
    }
    let submap = builder.flush().unwrap();
    assert_eq!(describe(&submap, &config).summary.up(), submap.up.as_ref());
    submap.up
}

#[test]
fn a_submap_knows_what_its_keyframes_know() {
    let config = SubmapConfig::default;
    // The frame's z axis as each body has it; the anchor's is the middle one, which is not turned.
    let level = |k: f64| Some(up([-libm::sin(0.3 * k), 0.0, libm::cos(0.3 * k)], 0.02));
    let all = submap(config(), [level(-1.0), level(0.0), level(1.0)], 1e-3).unwrap();
    assert!((all.direction() - Vector3::z()).norm() < 1e-4, "{all:?}");
    assert!((0.02..0.0215).contains(&all.sigma()), "as uncertain as one: {all:?}");
    assert_eq!(submap(config(), [None; 3], 1e-3), None);
    // One that is far from the anchor knows less of it, by what the way there was measured to.
    let far = submap(config(), [level(-1.0), None, None], 0.1).unwrap();
    assert!((far.direction() - Vector3::z()).norm() < 1e-4 && (0.1..0.11).contains(&far.sigma()), "{far:?}");
    // What scatters more than it says is as uncertain as it scatters; what cancels out is nothing.
    let scattered = [0.1, -0.1].map(|angle| Some(up(tilted(angle, 1.5), 0.01)));
    let mean = mean(&scattered, &[Se3::identity(); 2], &[], 0).unwrap();
    assert!((0.06..0.08).contains(&mean.sigma()) && (mean.direction() - Vector3::z()).norm() < 1e-4, "{mean:?}");
    let contrary = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]].map(|direction| Some(up(direction, 0.02)));
    assert_eq!(super::mean(&contrary, &[Se3::identity(); 2], &[], 0), None);
}

#[test]
fn a_frame_whose_z_axis_points_up_tells_it_where_keyframes_do_not() {
    let frame = SubmapConfig { gravity: Gravity::FrameZ, gravity_sigma_rad: 0.03, ..Default::default() };
    let told = submap(frame.clone(), [None; 3], 1e-3).unwrap();
    assert!((told.direction() - Vector3::z()).norm() < 1e-4 && (0.03..0.033).contains(&told.sigma()), "{told:?}");
    // So uncertain a motion would end the submap before the keyframe that tells.
    let blurred = SubmapConfig { sigma_max_m: 10.0, sigma_max_deg: 1e3, ..frame.clone() };
    let own = submap(blurred, [None, Some(up([1.0, 0.0, 0.0], 0.001)), None], 1.0).unwrap();
    assert!((own.direction() - Vector3::x()).norm() < 0.01, "{own:?}");
    let planar = SubmapConfig { sensor: Sensor::Laser2d, ..frame };
    let mut builder = SubmapBuilder::new(planar);
    builder.push(keyframe(1, Se3::identity(), &[])).unwrap();
    assert_eq!(builder.flush().unwrap().up, None, "in the plane it goes without saying");
    assert_eq!(SubmapConfig::default().gravity_sigma_rad, UP_SIGMA_RAD);
}

proptest! {
    #[test]
    fn what_travels_is_nearly_what_was_known(angle in 0.0..=core::f64::consts::PI, heading in -4.0..4.0, sigma in 0.001..=0.5) {
        let known = up(tilted(angle, heading), sigma);
        let rounded = known.rounded();
        prop_assert!((known.direction() - rounded.direction()).norm() < 1e-4);
        prop_assert!(sigma <= rounded.sigma() * (1.0 + 1e-12) && rounded.sigma() < 1.026 * sigma);
        prop_assert_eq!(Up::decode(rounded.encode()), Some(rounded));
        prop_assert_eq!(rounded.rounded(), rounded);
    }

    #[test]
    fn any_bytes_are_no_vertical_or_come_back_the_same(bytes in any::<[u8; LEN]>()) {
        if let Some(up) = Up::decode(bytes) {
            prop_assert_eq!(up.encode(), bytes);
            prop_assert!(UP_SIGMA_RANGE_RAD.contains(&up.sigma()) || (up.sigma() / 0.5 - 1.0).abs() < 1e-9);
            prop_assert!((up.direction().norm() - 1.0).abs() < 1e-9);
        }
    }

    /// However two submaps are turned, and whichever way three standard deviations of all that errs lead: the truth
    /// passes.
    #[test]
    fn the_true_rotation_passes(
        turns in any::<[(i8, i8, i8); 2]>(),
        sigmas in [0.001..0.1, 0.001..0.1, 0.0..0.1],
        errs in 0.0..=3.0_f64,
        share in 0.0..=1.0_f64,
        heading in -4.0..4.0_f64,
    ) {
        let turn = |(x, y, z): (i8, i8, i8)| So3::exp(&(Vector3::new(f64::from(x), f64::from(y), f64::from(z)) / 40.0));
        let [r_theirs_world, r_mine_world] = turns.map(turn);
        let all = sigmas.iter().map(|s: &f64| s * s).sum::<f64>().sqrt();
        // The verticals' errors, opposed to one another, come to so many standard deviations of the whole.
        let seen = |r: &So3, angle: f64, sigma: f64| up((*r * Vector3::from(tilted(angle, heading))).into(), sigma);
        let theirs = seen(&r_theirs_world, errs * all * share, sigmas[0]);
        let mine = seen(&r_mine_world, -errs * all * (1.0 - share), sigmas[1]);
        let known = Verticals { theirs: theirs.rounded(), mine: mine.rounded() };
        let r_mine_theirs = (r_mine_world * r_theirs_world.inverse()).matrix();
        prop_assert!(known.allow(&r_mine_theirs, sigmas[2]));
        prop_assert!(known.back().allow(&r_mine_theirs.transpose(), sigmas[2]));
    }
}

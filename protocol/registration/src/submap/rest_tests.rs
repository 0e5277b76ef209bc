use super::super::testing::keyframe;
use super::super::{Keyframe, Loss, Submap, SubmapBuilder};
use super::*;
use crate::geometry::So3;
use crate::time::Stamp;
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

fn config() -> SubmapConfig {
    SubmapConfig { voxel_m: 0.1, distance_m: 2.0, rotation_deg: 60.0, keyframes_max: 10, ..Default::default() }
}

fn at(x: f64, turn: f64) -> Se3 {
    Se3::new(So3::exp(&Vector3::new(0.0, 0.0, turn)), Vector3::new(x, 0.0, 0.0))
}

fn stated(secs: f64, pose: Se3, sigma: f64) -> Keyframe {
    let mut keyframe = keyframe((secs * 1e9) as i64, pose, &[Vector3::new(1.0, 0.0, 0.0)]);
    keyframe.pose.covariance = Covariance::from_sigmas([sigma; 6]).unwrap();
    keyframe
}

/// Finished submaps of a robot that stands for `count` keyframes at `hz`, its odometry walking by `walk` a keyframe or
/// trembling by `noise`, with motions of this stated `sigma`.
fn stands(hz: f64, count: u32, [walk, noise, sigma]: [f64; 3]) -> (SubmapBuilder, Vec<Submap>) {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut builder = SubmapBuilder::new(config());
    let (mut x, mut closed) = (0.0, Vec::new());
    for k in 0..count {
        x += walk * (rng.random_range(0.0..1.0_f64) + rng.random_range(0.0..1.0) - 1.0) * 6.0_f64.sqrt();
        let pose = at(x + noise * rng.random_range(-1.0..1.0), 0.0);
        closed.extend(builder.push(stated(f64::from(k) / hz, pose, sigma)).unwrap());
    }
    (builder, closed)
}

#[test]
fn a_robot_that_stands_is_one_submap_at_any_rate_for_a_minute_or_a_night() {
    for (hz, secs) in [(0.1, 28_800.0), (1.0, 60.0), (10.0, 60.0), (100.0, 60.0), (10.0, 28_800.0)] {
        let count = (hz * secs) as u32;
        for noises in [[0.0, 0.0, 1e-3], [0.0, 0.01, 1e-3], [1e-3, 0.0, 1e-3], [0.0, 0.04, 0.02]] {
            let (builder, closed) = stands(hz, count, noises);
            assert_eq!(closed.len(), 1, "{hz} Hz, {secs} s, {noises:?}");
            assert_eq!(closed[0].keyframes.len(), 10);
            let (index, _, stamp) = builder.body_since_anchor().unwrap();
            let last = f64::from(count - 1) / hz;
            assert_eq!((index, stamp), (0, Stamp((last * 1e9) as i64)), "it is still there, and told so");
        }
    }
}

/// How uncertain it is after a night is one motion and how far it seems to have got, not 288,000 motions.
#[test]
fn standing_adds_no_doubt_but_how_far_odometry_went() {
    let (mut builder, closed) = stands(10.0, 288_000, [0.0, 0.0, 0.01]);
    let here = builder.body_since_anchor().unwrap().1;
    let sigma = here.covariance.sigmas()[0];
    assert!((0.01..0.05).contains(&sigma) && here.pose.translation.norm() < 1e-9, "{sigma}");
    // The next submap begins with the keyframe that left, and its odometry spans the night.
    let mut next = None;
    for k in 1..=12 {
        next = next.or(builder.push(stated(1e5 + f64::from(k), at(0.5 * f64::from(k), 0.0), 0.01)).unwrap());
    }
    let next = next.unwrap();
    assert_eq!((next.index, next.stamps[0]), (1, Stamp(100_001 * 1_000_000_000)));
    let chained = closed[0].t_frame_anchor * next.odometry.pose;
    assert!(chained.local(&next.t_frame_anchor).amax() < 1e-9);
    assert!((0.01..0.06).contains(&next.odometry.covariance.sigmas()[0]));
}

#[test]
fn it_stands_to_a_voxel_and_a_tenth_of_the_turn_and_no_farther() {
    let begins = |pose: Se3| {
        let (mut builder, _) = stands(1.0, 20, [0.0, 0.0, 1e-4]);
        builder.push(stated(30.0, pose, 1e-4)).unwrap();
        builder.flush().is_some()
    };
    assert_eq!([begins(at(0.099, 0.0)), begins(at(0.101, 0.0))], [false, true]);
    let deg = 1.0_f64.to_radians();
    assert_eq!([begins(at(0.0, 5.9 * deg)), begins(at(0.0, 6.1 * deg))], [false, true]);
}

/// A robot that creeps away slower than its noise hides is noticed at half a submap; one that drives, at once.
#[test]
fn noise_hides_a_way_up_to_half_a_submap() {
    let left = |step: f64, sigma: f64| {
        let (mut builder, _) = stands(10.0, 3000, [0.0, 0.0, sigma]);
        let mut ways = (1..).map(|k| step * f64::from(k));
        let has_left = |x: &f64| {
            builder.push(stated(1e4 + x, at(*x, 0.0), sigma)).unwrap();
            !builder.has_stood()
        };
        ways.find(has_left).unwrap()
    };
    assert_eq!(left(0.2, 1e-3), 0.2);
    assert!((0.1..0.2).contains(&left(0.005, 1e-3)));
    assert!((0.99..1.02).contains(&left(0.005, 0.02)), "{}", left(0.005, 0.02));
}

/// A keyframe lost while the robot stood widens what is known of where it is.
#[test]
fn a_gap_while_standing_is_not_forgotten() {
    let sigma = |lost: bool| {
        let (mut builder, _) = stands(10.0, 100, [0.0, 0.0, 1e-4]);
        if lost {
            builder.lose(Loss::Unreadable);
        }
        for k in 0..100 {
            builder.push(stated(100.0 + f64::from(k), at(0.0, 0.0), 1e-4)).unwrap();
        }
        builder.body_since_anchor().unwrap().1.covariance.sigmas()[0]
    };
    assert!(sigma(false) < 2e-3 && sigma(true) > 0.009, "{} {}", sigma(false), sigma(true));
}

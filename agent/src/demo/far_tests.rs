//! Frames whose origins are far from the robots, as of map coordinates (UTM): what is judged and written stays exact.

use super::evaluate::{PoseError, between_starts};
use super::outputs::{Cloud, merged_ply, offset_of, tum};
use super::tests::tracks;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Relative, Se3, Sim3, So3};
use nalgebra::{Vector3, Vector6};

#[test]
fn an_error_is_judged_where_robots_began_wherever_their_frames_do() {
    let [mut a, mut b] = [tracks().remove(0), tracks().remove(1)];
    let between = Se3::exp(&Vector6::new(3.0, -1.0, 0.2, 0.1, -0.2, 1.0));
    let near = PoseWithCovariance {
        pose: between.retract(&Vector6::new(0.03, -0.02, 0.01, 0.004, 0.002, -0.003)),
        covariance: Covariance::from_sigmas([0.02, 0.02, 0.03, 4e-3, 4e-3, 3e-3]).unwrap(),
    };
    let want = PoseError::of(&Relative::Metric(near), &Sim3::from_se3(&between), 1.0);
    for far in [0.0, 5.756e6] {
        let origin =
            |turn: f64, east: f64| Se3::new(So3::exp(&Vector3::new(0.0, 0.0, turn)), Vector3::new(east, far, 48.0));
        (a.odometry[0], b.odometry[0]) = (origin(0.3, 399_500.0), origin(-1.2, 399_512.0));
        let to_origin = |t: &Relative| {
            let Relative::Metric(t) = t.onto(&b.odometry[0].inverse()) else { panic!("it is rigid") };
            Relative::Metric(PoseWithCovariance { pose: a.odometry[0] * t.pose, ..t })
        };
        let truth = to_origin(&Relative::Metric(PoseWithCovariance { pose: between, ..near })).sim();
        let t_a_b = to_origin(&Relative::Metric(near));
        let (estimate, truth) = between_starts(&t_a_b, &truth, [&a, &b]);
        let error = PoseError::of(&estimate, &truth, 1.0);
        assert!((error.translation_m - want.translation_m).abs() < 1e-6, "{far}: {error:?}");
        // A covariance whose axes differ by ten orders of magnitude is widened by what rounding leaves of it.
        let least = if far < 1e4 { 0.99 * want.nees } else { 0.0 };
        assert!((least..1.01 * want.nees).contains(&error.nees), "{far}: {} {}", error.nees, want.nees);
    }
}

#[test]
fn a_map_far_from_its_origin_is_written_relative_to_an_offset_that_is_stated() {
    let cloud = |at: Vector3<f64>| {
        let common = (0..50).map(|k| at + Vector3::new(0.01, 0.02, 0.03) * f64::from(k)).collect();
        [Cloud { own: Vec::new(), common }]
    };
    let near = cloud(Vector3::new(8_000.0, 0.0, 0.0));
    assert_eq!(offset_of(&near), None);
    assert!(!String::from_utf8_lossy(&merged_ply(&near, None)).contains("comment"));
    let at = Vector3::new(399_512.0, 5_756_190.0, 48.0);
    let far = cloud(at);
    let offset = offset_of(&far).unwrap();
    assert_eq!(offset, Vector3::new(399_500.0, 5_756_200.0, 0.0));
    let bytes = merged_ply(&far, Some(offset));
    let head = String::from_utf8_lossy(&bytes);
    assert!(
        head.contains("comment offset 399500 5756200 0: to be added to each vertex\nelement vertex 50\n"),
        "{head}"
    );
    let first = bytes.windows(11).position(|window| window == b"end_header\n").unwrap() + 11;
    for (k, want) in far[0].common.iter().enumerate() {
        let number = |axis: usize| {
            let at = first + 15 * k + 4 * axis;
            f64::from(f32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()))
        };
        let written = Vector3::new(number(0), number(1), number(2)) + offset;
        assert!((written - want).amax() < 1e-4, "{written} {want}");
    }
}

#[test]
fn a_path_far_from_its_origin_is_written_to_the_micrometre() {
    let at = |k: u32| {
        let turn = So3::exp(&Vector3::new(0.01, -0.02, 0.1 * f64::from(k)));
        let far = Vector3::new(399_512.123_456_7, 5_756_190.654_321_1, 48.000_001_4);
        Sim3::from_se3(&Se3::new(turn, far + Vector3::new(0.001, 0.002, 0.003) * f64::from(k)))
    };
    let (poses, stamps): (Vec<Sim3>, Vec<f64>) = (0..40).map(|k| (at(k), 1_700_000_000.25 + f64::from(k))).unzip();
    for (k, line) in tum(&stamps, &poses).lines().enumerate() {
        let numbers: Vec<f64> = line.split(' ').map(|word| word.parse().unwrap()).collect();
        let [secs, x, y, z, qx, qy, qz, qw] = numbers[..] else { panic!("{line}") };
        let off = Vector3::new(x, y, z) - poses[k].translation;
        let turned = So3::from_xyzw([qx, qy, qz, qw]).unwrap().local(&poses[k].rotation).norm();
        assert!(off.amax() < 6e-7 && turned < 1e-8 && (secs - stamps[k]).abs() < 1e-6, "{line}: {off}, {turned}");
    }
}

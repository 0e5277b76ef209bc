use super::*;
use merganser_protocol::geometry::Se3;
use merganser_protocol::submap::Keyframe;
use nalgebra::{Vector2, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

#[test]
fn good_lines_read() {
    let speeds = speeds("# remark\n1248272272.841 \t 0.074 \t 0.229 \n\n1248272272.841 0 -1e-1\r\n").unwrap();
    assert_eq!(speeds.len(), 2);
    assert_eq!(speeds[0], Speed { stamp: Stamp(1_248_272_272_841_000_000), forward: 0.074, angular: 0.229 });
    let seen = sightings("1 72 2.148 0.025\n1 72 0.01 0\n2 5 51 0\n").unwrap();
    assert_eq!(seen, [Sighting { stamp: Stamp(1_000_000_000), barcode: 72, range: 2.148, bearing: 0.025 }]);
    assert_eq!(subjects("#\n 1 5\n 6 72\n").unwrap(), BTreeMap::from([(5, 1), (72, 6)]));
}

#[test]
fn bad_lines_are_told_with_their_number() {
    let long = format!("1 2 {}", "0".repeat(LINE_MAX));
    let cases: [(&str, usize, &str); 8] = [
        ("1 2 3\n1 2\n", 2, "2 numbers instead of 3 (time, forward velocity, angular velocity)"),
        ("1 2 3 4\n", 1, "4 numbers instead of 3"),
        ("#\n1 x 3\n", 2, "forward velocity = \"x\""),
        ("1 2 nan\n", 1, "angular velocity = \"nan\""),
        ("1 100.5 0\n", 1, "forward velocity = \"100.5\""),
        ("1e10 0 0\n", 1, "time = \"1e10\""),
        ("2 0 0\n1 0 0\n", 2, "before that of the line above"),
        (&long, 1, "longer than 1024 bytes"),
    ];
    for (text, line, what) in cases {
        let error = speeds(text).unwrap_err();
        assert_eq!(error.line, line, "{error}");
        assert!(error.to_string().contains(what), "{error}");
    }
    assert!(speeds("1 100 -100\n").is_ok());
    for (text, what) in [("1 -5 1 0", "barcode = \"-5\""), ("1 5 inf 0", "range = \"inf\""), ("1 5 1", "3 numbers")] {
        assert!(sightings(text).unwrap_err().to_string().contains(what));
    }
    for text in ["1 5\n2 5\n", "1 5\n1 6\n"] {
        assert_eq!(subjects(text).unwrap_err(), MrclamError { line: 2, what: BadLine::Subjects });
    }
    let many = |count: u32| (0..count).map(|k| format!("{k} {k}\n")).collect::<String>();
    assert!(subjects(&many(1_000)).is_ok() && subjects(&many(1_001)).is_err());
}

/// A robot that drives in circles among landmarks, five percent slower and turning a tenth less than commanded.
fn drive(seed: u64) -> (Vec<Speed>, Vec<Sighting>, Vec<(Stamp, Se3)>) {
    let mut dice = ChaCha8Rng::seed_from_u64(seed);
    let landmarks: Vec<Vector2<f64>> =
        (0..15).map(|_| Vector2::new(dice.random_range(-5.0..5.0), dice.random_range(-5.0..5.0))).collect();
    let mut normal = || (0..12).map(|_| dice.random_range(-0.5..0.5)).sum::<f64>();
    let (mut speeds, mut seen, mut truth) = (Vec::new(), Vec::new(), Vec::new());
    let (mut at, mut heading) = (Vector2::zeros(), 0.3_f64);
    for tick in 0..6_000 {
        let stamp = Stamp(tick * 50_000_000);
        let speed = Speed { stamp, forward: 0.1, angular: if (tick / 100) % 3 == 0 { 0.4 } else { 0.05 } };
        speeds.push(speed);
        let turn = merganser_protocol::geometry::So3::exp(&Vector3::new(0.0, 0.0, heading));
        truth.push((stamp, Se3::new(turn, Vector3::new(at.x, at.y, 0.0))));
        for (k, landmark) in landmarks.iter().enumerate() {
            let off: Vector2<f64> = landmark - at;
            let bearing = off.y.atan2(off.x) - heading;
            let bearing = bearing.sin().atan2(bearing.cos());
            if bearing.abs() < 0.6 && tick % 10 == k as i64 % 10 {
                let range = off.norm() + 0.06 * normal();
                seen.push(Sighting { stamp, barcode: k as u32, range, bearing: bearing + 0.015 * normal() });
            }
        }
        let (d, a): (f64, f64) = (0.95 * 0.1 * 0.05, 0.9 * speed.angular * 0.05);
        let (d, a) = (d + 0.08 * d.sqrt() * normal(), a + (0.14 * a.sqrt() + 0.06 * d.sqrt()) * normal());
        at += Vector2::new((heading + a / 2.0).cos(), (heading + a / 2.0).sin()) * d;
        heading += a;
    }
    (speeds, seen, truth)
}

/// The scales are found, and the motions between keyframes are as uncertain as stated.
#[test]
fn the_front_end_is_honest() {
    let (mut sum, mut count, mut far, mut fars) = (0.0, 0, 0.0, 0);
    for seed in 0..4 {
        let (speeds, seen, truth) = drive(seed);
        let found = Calibration::of(&speeds, &seen);
        assert!((found.speed - 0.95).abs() < 0.03 && (found.turn - 0.9).abs() < 0.04, "{found:?}");
        let keyframes = keyframes(&speeds, &seen);
        assert!(keyframes.len() > 100, "{}", keyframes.len());
        let at = |k: &Keyframe| truth[(k.stamp.0 / 50_000_000) as usize].1;
        let way = |a: &Keyframe, b: &Keyframe| {
            let true_way = at(a).inverse() * at(b);
            true_way.local(&(a.pose.pose.inverse() * b.pose.pose))
        };
        for pair in keyframes.windows(2) {
            sum += pair[1].pose.covariance.mahalanobis_squared(&way(&pair[0], &pair[1]));
            count += 1;
        }
        for stretch in keyframes.windows(21).step_by(10) {
            let motion = |k: usize| merganser_protocol::geometry::PoseWithCovariance {
                pose: stretch[k - 1].pose.pose.inverse() * stretch[k].pose.pose,
                covariance: stretch[k].pose.covariance,
            };
            let all = (1..21).map(motion).reduce(|sum, next| sum.compose(&next)).unwrap();
            far += all.covariance.mahalanobis_squared(&way(&stretch[0], &stretch[20]));
            fars += 1;
        }
    }
    let (near, far) = (sum / f64::from(count), far / f64::from(fars));
    println!("front end: NEES {near:.2} for 3 over one step, {far:.2} over twenty");
    assert!((1.5..4.0).contains(&near) && (0.2..4.5).contains(&far), "{near} {far}");
}

#[test]
fn an_empty_or_short_log_gives_no_keyframes() {
    assert!(keyframes(&[], &[]).is_empty());
    let (speeds, seen, _) = drive(1);
    assert!(keyframes(&speeds, &[]).is_empty() && keyframes(&[], &seen).is_empty());
    assert!(keyframes(&speeds[..1], &seen).len() <= 1);
}

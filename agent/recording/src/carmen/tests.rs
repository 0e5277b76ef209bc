//! Lines good and bad, their order, and the keyframes made of them.

use super::*;
use merganser_protocol::geometry::So3;
use nalgebra::Vector3;

const GOOD: &str = "FLASER 3 1.0 50.0 2.0 0 0 0 4.0 5.0 0.5 12.000001 host 3.0";

/// A laser that looks to the left of a robot at (4, 5), which is itself turned to the left; two remissions.
const NEWER: &str = "ROBOTLASER1 0 -1.5707963267948966 3.141592653589793 1.5707963267948966 20.0 0.01 1 \
     3 1.0 20.0 2.0 2 7.5 8.5 4.0 5.5 3.141592653589793 4.0 5.0 1.5707963267948966 0.3 0.1 0.5 0.4 1e6 12.5 host 3.0";

fn log_of(lines: &[&str]) -> Result<Log, CarmenError> {
    let mut parser = Parser::default();
    lines.iter().try_for_each(|line| parser.line(line))?;
    Ok(parser.finish())
}

fn parsed(lines: &[&str]) -> Result<Vec<Scan>, CarmenError> {
    log_of(lines).map(|log| log.scans)
}

fn assert_points(scan: &Scan, expected: &[[f64; 3]]) {
    assert_eq!(scan.points.len(), expected.len());
    for (p, q) in scan.points.iter().zip(expected) {
        assert!((0..3).all(|k| (p[k] - q[k] as f32).abs() < 1e-6), "{p:?}");
    }
}

#[test]
fn a_scan_is_read_as_the_robot_saw_it() {
    let scans = parsed(&["# comment", "", "PARAM robot_frontlaser_offset 0.25 nohost 0", "ODOM 1 2 3", GOOD]).unwrap();
    assert_eq!(scans.len(), 1);
    assert_eq!(scans[0].stamp, Stamp(12_000_001_000));
    assert!((scans[0].pose.translation - Vector3::new(4.0, 5.0, 0.0)).norm() < 1e-12);
    // To the right and to the left; what is ahead is too far.
    assert_points(&scans[0], &[[0.25, -1.0, 0.0], [0.25, 2.0, 0.0]]);
}

#[test]
fn the_newer_message_tells_how_the_laser_is_mounted() {
    // What PARAM says is of the older message's laser.
    let scans = parsed(&["PARAM robot_frontlaser_offset 9.0 nohost 0", NEWER]).unwrap();
    assert_eq!(scans[0].stamp, Stamp(12_500_000_000));
    let t_odometry_body =
        Se3::new(So3::exp(&Vector3::new(0.0, 0.0, core::f64::consts::FRAC_PI_2)), Vector3::new(4.0, 5.0, 0.0));
    assert!(scans[0].pose.local(&t_odometry_body).norm() < 1e-12);
    // Half a metre ahead, looking to the left: its right is ahead, its left behind. At the maximum range nothing was hit.
    assert_points(&scans[0], &[[1.5, 0.0, 0.0], [-1.5, 0.0, 0.0]]);
    // No remissions, and such a laser straight ahead in the middle.
    let plain = NEWER.replace(" 2 7.5 8.5 4.0 5.5 3.141592653589793", " 0 4.0 5.0 1.5707963267948966");
    assert_points(&parsed(&[&plain]).unwrap()[0], &[[0.0, -1.0, 0.0], [0.0, 2.0, 0.0]]);
}

#[test]
fn scans_out_of_order_are_sorted_and_repeated_ones_left_out() {
    let at = |secs: &str, x: &str| GOOD.replace("12.000001", secs).replace("4.0", x);
    let lines = [at("1.0", "1"), at("3.0", "3"), at("2.0", "2"), at("2.5", "2.5"), at("3.0", "9"), at("4.0", "4")];
    let log = log_of(&lines.each_ref().map(String::as_str)).unwrap();
    assert_eq!((log.late, log.repeated), (2, 1));
    let xs: Vec<f64> = log.scans.iter().map(|scan| scan.pose.translation.x).collect();
    assert_eq!(xs, [1.0, 2.0, 2.5, 3.0, 4.0], "of two with one stamp the first is kept");
    assert!(log.scans.windows(2).all(|two| two[0].stamp < two[1].stamp));
    let log = log_of(&lines[..2].iter().map(String::as_str).collect::<Vec<_>>()).unwrap();
    assert_eq!((log.late, log.repeated, log.scans.len()), (0, 0, 2));
}

#[test]
fn every_bad_line_is_told_with_its_number() {
    let told = |line: &str| parsed(&["# comment", line]).unwrap_err();
    for cut in 1..GOOD.split(' ').count() {
        let line = GOOD.split(' ').take(cut).collect::<Vec<_>>().join(" ");
        assert_eq!(told(&line).line, 2, "{line}");
    }
    assert!(matches!(told(&format!("{GOOD} 7")).what, BadLine::Fields { readings: 3, expected: 14, found: 15, .. }));
    assert!(matches!(told("FLASER 1 1.0 0 0 0 0 0 0 1 h 1").what, BadLine::Count { of: "readings", .. }));
    assert!(matches!(told("FLASER 4097 1.0").what, BadLine::Count { of: "readings", .. }));
    assert!(matches!(told("FLASER 4096 1.0").what, BadLine::Fields { readings: 4096, .. }));
    for bad in ["NaN", "inf", "x", "1e300"] {
        assert!(matches!(told(&GOOD.replace("4.0", bad)).what, BadLine::Number { field: "odom_x", .. }), "{bad}");
    }
    assert!(matches!(told(&GOOD.replace("50.0", "NaN")).what, BadLine::Number { field: "range", .. }));
    assert!(matches!(told(&GOOD.replace("12.000001", "1e10")).what, BadLine::Number { .. }));
    assert!(matches!(told("\u{1f}BZh9 x").what, BadLine::NoMessage(_)));
    assert_eq!(told(&" ".repeat(LINE_MAX + 1)).what, BadLine::TooLong);
    assert!(parsed(&[&" ".repeat(LINE_MAX)]).is_ok());
}

#[test]
fn every_bad_line_of_the_newer_message_is_told() {
    let told = |line: &str| parsed(&["# comment", line]).unwrap_err();
    let fields = NEWER.split_ascii_whitespace().count();
    for cut in 1..fields {
        let line = NEWER.split_ascii_whitespace().take(cut).collect::<Vec<_>>().join(" ");
        assert_eq!(told(&line).line, 2, "{line}");
    }
    let what = told(&format!("{NEWER} 7")).what;
    assert!(matches!(what, BadLine::Fields { message: "ROBOTLASER1", readings: 3, expected: 29, found: 30 }), "{what}");
    for (from, to, field) in [
        (" -1.57", " 7 -1.57", "start_angle"),
        (" 1.5707963267948966 20.0", " 0 20.0", "angular_resolution"),
        (" 1.5707963267948966 20.0", " -1 20.0", "angular_resolution"),
        (" 20.0 0.01", " inf 0.01", "maximum_range"),
        (" 3 1.0", " 3 NaN", "range"),
        (" 5.5 ", " x ", "laser_y"),
        (" 5.0 ", " 1e300 ", "robot_y"),
        (" 12.5 ", " 1e10 ", "ipc_timestamp"),
    ] {
        let spoilt = NEWER.replacen(from, to, 1).replace(" 7 -1.5707963267948966", " 7");
        assert!(spoilt != NEWER, "{from}");
        let what = told(&spoilt).what;
        assert!(matches!(what, BadLine::Number { field: found, .. } if found == field), "{field}: {what}");
    }
    let what = told(&NEWER.replace(" 3 1.0", " 1 1.0")).what;
    assert!(matches!(what, BadLine::Count { of: "readings", least: 2, .. }), "{what}");
    let what = told(&NEWER.replace(" 2 7.5", " 4097 7.5")).what;
    assert!(matches!(what, BadLine::Count { of: "remissions", least: 0, .. }), "{what}");
}

#[test]
fn keyframes_are_as_far_apart_as_stated() {
    let scan = |k: i32| Scan {
        stamp: Stamp(i64::from(k)),
        pose: Se3::new(So3::identity(), Vector3::new(0.1 * f64::from(k), 0.0, 0.0)),
        points: vec![[1.0, 0.0, 0.0]],
    };
    let scans: Vec<Scan> = (0..10).map(scan).collect();
    let stamps: Vec<i64> = keyframes(scans.iter()).iter().map(|k| k.stamp.0).collect();
    assert_eq!(stamps, [0, 3, 6, 9]);
    let blind = scans.iter().map(|s| Scan { points: vec![], ..s.clone() }).collect::<Vec<_>>();
    assert!(keyframes(blind.iter()).is_empty());
}

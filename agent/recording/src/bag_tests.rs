//! Bags of simulated drives become recordings: a robot each, several in one, or one cut into three. What they hold
//! lies on the walls of the room; covariances are those that the odometry states.

#[path = "../../ros/src/join/drive.rs"]
mod drive;
#[path = "../../ros/src/bag/write.rs"]
mod write;

use super::Recording;
use super::import::{self, Kind, Prepared, Wanted};
use drive::{BEGIN_NS, ROBOT, ROOM, Robot};
use merganser_protocol::config::Sensor;
use merganser_protocol::geometry;
use merganser_protocol::submap::CovarianceOf;
use merganser_ros as ros;
use nalgebra::{Matrix6, Vector3};
use ros::wire::Serialization;
use std::fs;
use std::path::Path;
use tempfile::TempDir;
use write::Written;

fn mcap(path: &Path, messages: &[Written]) {
    write::mcap(path, messages, Some(mcap::Compression::Zstd), true, "cdr");
}

fn prepared(data: &Path) -> (Prepared, TempDir) {
    let out = tempfile::tempdir().unwrap();
    (import::prepare(data, out.path(), 1).unwrap(), out)
}

/// Names and numbers of keyframes.
fn robots(recordings: &[Recording]) -> Vec<(&str, usize)> {
    recordings.iter().map(|recording| (recording.manifest().robot.as_str(), recording.len())).collect()
}

/// How far points lie off the nearest wall, at most, m.
fn off_walls(recording: &Recording) -> f64 {
    let mut worst = 0.0_f64;
    for index in 0..recording.len() {
        let keyframe = recording.keyframe(index).unwrap();
        for point in keyframe.points {
            let p = keyframe.pose.pose * Vector3::from(point.map(f64::from));
            worst = worst.max((0..2).map(|axis| (p[axis].abs() - ROOM[axis]).abs()).fold(f64::INFINITY, f64::min));
        }
    }
    worst
}

#[test]
fn a_bag_of_one_robot_is_cut_into_three() {
    let data = tempfile::tempdir().unwrap();
    mcap(&data.path().join("drive.mcap"), &ROBOT.drive(24.0));
    assert_eq!(import::detect(data.path()).unwrap(), Kind::Bags);
    for path in [data.path().to_owned(), data.path().join("drive.mcap")] {
        let (Prepared { recordings, remarks }, _out) = prepared(&path);
        // 18 m in all; 0.25 m or 0.15 rad, whichever is first, is every 0.3 s, the next third scan.
        let found = robots(&recordings);
        assert_eq!(found.iter().map(|(name, _)| *name).collect::<Vec<_>>(), ["alpha", "beta", "gamma"]);
        assert!(found.iter().all(|(_, count)| (8..40).contains(count)), "{found:?}");
        for recording in &recordings {
            assert!(off_walls(recording) < 2e-4 && recording.manifest().config.submap.sensor == Sensor::Laser2d);
            for two in recording.keyframes().windows(2) {
                let motion = two[0].pose.pose.inverse() * two[1].pose.pose;
                assert!(motion.translation.norm() >= 0.25 || motion.rotation.angle() >= 0.15);
            }
        }
        let stamps: Vec<_> = recordings.iter().flat_map(|r| r.keyframes().iter().map(|line| line.stamp)).collect();
        let distinct: std::collections::BTreeSet<_> = stamps.iter().collect();
        assert_eq!(distinct.len(), stamps.len(), "two robots hold the same scan");
        assert!(remarks.iter().any(|told| told.contains("/odom states no usable covariance")), "{remarks:?}");
    }
}

#[test]
fn a_bag_alone_is_left_whole_for_one_agent() {
    let (data, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let path = data.path().join("Drive of Monday.bag");
    write::ros1(&path, &Robot { serialization: Serialization::Ros1, ..ROBOT }.drive(24.0), "lz4");
    assert!(import::is_bag(&path) && !import::is_bag(&data.path().join("other.bag")));
    let Prepared { recordings, .. } = import::prepare_bag(&path, out.path(), &Wanted::default()).unwrap();
    assert_eq!(robots(&recordings), [("drive_of_monday", 60)]);
    assert!(off_walls(&recordings[0]) < 2e-4);
    assert!(import::is_bag(data.path()) && !import::is_bag(recordings[0].folder()));
}

#[test]
fn robots_in_one_bag_and_bags_of_one_robot_each_are_robots() {
    let robot = |namespace, phase| Robot { namespace, phase, sees_height: true, ..ROBOT };
    let mut both = robot("/R1", 0.0).drive(20.0);
    both.extend(robot("/r2", 2.0).drive(20.0));
    both.sort_by_key(|message| message.received_ns);
    let data = tempfile::tempdir().unwrap();
    mcap(&data.path().join("both.mcap"), &both);
    let (Prepared { recordings, .. }, _out) = prepared(data.path());
    assert_eq!(robots(&recordings), [("r1", 24), ("r2", 24)]);
    for recording in &recordings {
        assert!(off_walls(recording) < 2e-4 && recording.manifest().config.submap.sensor == Sensor::Lidar3d);
        assert_eq!(recording.begins().0, BEGIN_NS + 13_000_000, "robots in one bag begin together");
    }
    let data = tempfile::tempdir().unwrap();
    for (name, phase) in [("one", 0.0), ("two", 2.0)] {
        let folder = data.path().join(name);
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("metadata.yaml"), format!("  relative_file_paths:\n    - {name}_0.db3\n")).unwrap();
        write::db3(&folder.join(format!("{name}_0.db3")), &robot("", phase).drive(20.0), true, false);
    }
    mcap(&data.path().join("one.mcap"), &robot("", 1.0).drive(20.0));
    let (Prepared { recordings, .. }, _out) = prepared(data.path());
    assert_eq!(robots(&recordings), [("one", 24), ("one_2", 24), ("two", 24)]);
}

#[test]
fn covariances_are_those_of_the_odometry_in_the_axes_of_the_body() {
    let data = tempfile::tempdir().unwrap();
    let mut messages = Robot { variance: 1e-3, ..ROBOT }.drive(12.0);
    let odometries = messages.iter_mut().filter(|message| message.topic == "/odom");
    for (k, message) in odometries.enumerate() {
        let mut odometry = ROBOT.odometry(f64::from(k as u32) / 20.0);
        let c = &mut odometry.pose.covariance;
        // Sure along the x axis of the frame; z, roll and pitch marked in three ways.
        (c[0], c[7], c[14], c[21], c[28], c[35]) = (1e-4 * (1 + k) as f64, 0.04, -1.0, 0.0, 9999.0, 0.01);
        *message = ROBOT.message("odom", f64::from(k as u32) / 20.0, &odometry);
    }
    mcap(&data.path().join("drive.mcap"), &messages);
    let out = tempfile::tempdir().unwrap();
    let recordings = import::prepare_bag(data.path(), out.path(), &Wanted::default()).unwrap().recordings;
    assert_eq!(recordings[0].manifest().covariance_of, CovarianceOf::Pose);
    for line in recordings[0].keyframes() {
        let k = ((line.stamp.0 - BEGIN_NS) as f64 * 20e-9).round();
        let r = line.pose.pose.rotation.matrix().transpose();
        let mut turn = Matrix6::identity();
        turn.fixed_view_mut::<3, 3>(0, 0).copy_from(&r);
        turn.fixed_view_mut::<3, 3>(3, 3).copy_from(&r);
        let fixed = Matrix6::from_diagonal(&[1e-4 * (1.0 + k), 0.04, 1e6, 1e6, 1e6, 0.01].into());
        let want = turn * fixed * turn.transpose();
        let found = line.pose.covariance.matrix();
        assert!((found - want).amax() < 1e-6, "{found}{want}");
    }
}

/// Turned into the axes of a body that turns, one covariance for all poses would look like many.
#[test]
fn one_covariance_for_all_poses_is_no_chain_and_is_told() {
    let data = tempfile::tempdir().unwrap();
    let mut messages = ROBOT.drive(12.0);
    for (k, message) in messages.iter_mut().filter(|message| message.topic == "/odom").enumerate() {
        let mut odometry = ROBOT.odometry(f64::from(k as u32) / 20.0);
        let c = &mut odometry.pose.covariance;
        (c[0], c[7], c[14], c[21], c[28], c[35]) = (1e-3, 1e-2, 1e6, 1e6, 1e6, 1e-2);
        *message = ROBOT.message("odom", f64::from(k as u32) / 20.0, &odometry);
    }
    mcap(&data.path().join("drive.mcap"), &messages);
    let out = tempfile::tempdir().unwrap();
    let Prepared { recordings, remarks } = import::prepare_bag(data.path(), out.path(), &Wanted::default()).unwrap();
    assert_eq!(recordings[0].manifest().covariance_of, CovarianceOf::Motion);
    assert!(remarks.iter().any(|told| told.contains("/odom states one covariance for all poses")), "{remarks:?}");
}

#[test]
fn what_is_wrong_names_the_bag_and_topics_belong_to_bags() {
    let (data, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let path = data.path().join("drive.mcap");
    let scans = ROBOT.drive(2.0).into_iter().filter(|message| message.topic != "/odom");
    mcap(&path, &scans.collect::<Vec<_>>());
    let error = import::prepare(data.path(), out.path(), 1).unwrap_err().to_string();
    assert!(error.contains("drive.mcap: no nav_msgs/Odometry and no TF odom → base_link"), "{error}");
    fs::write(&path, "nothing").unwrap();
    let error = import::prepare(data.path(), out.path(), 1).unwrap_err().to_string();
    assert!(error.contains("drive.mcap: is no bag"), "{error}");
    let error = import::detect(out.path()).unwrap_err().to_string();
    assert!(error.contains("ROS bags (*.mcap, *.db3, *.bag)"), "{error}");
    fs::write(data.path().join("a.clf"), "").unwrap();
    let error = import::detect(data.path()).unwrap_err().to_string();
    assert!(error.contains("holds a ROS bag, drive.mcap, and a laser's log, a.clf"), "{error}");
    let error = import::detect(&data.path().join("a.clf")).unwrap_err().to_string();
    assert!(error.contains("a.clf: one file alone is read if it is a ROS bag"), "{error}");
    fs::remove_file(&path).unwrap();
    let wanted = Wanted { odometry: Some("/odom".into()), cloud: None };
    let error = import::prepare_topics(data.path(), out.path(), 1, &wanted).unwrap_err().to_string();
    assert!(error.contains("this is no ROS bag; --odometry and --cloud"), "{error}");
}

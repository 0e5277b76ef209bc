//! Drives in bags of every kind come together with their poses: what a laser saw lies on the room's walls. What does
//! not come together is told by name.

use super::drive::{BEGIN_NS, ROBOT, ROOM, Robot, header, stamp, transform};
use super::{JoinError, Joined, Poses, Tally, Wanted, choose, gather, listed};
use crate::bag::write::{self, Written};
use crate::bag::{Bag, Flow};
use crate::msg::{Header, PoseStamped, TfMessage, TransformStamped};
use crate::wire::{Message, Serialization};
use merganser_geometry::Se3;
use nalgebra::Vector3;
use std::path::Path;
use tempfile::TempDir;

fn bag(messages: &[Written]) -> (Bag, TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("drive.mcap");
    write::mcap(&path, messages, Some(mcap::Compression::Zstd), true, "cdr");
    (Bag::open(&path).unwrap(), folder)
}

fn joined(bag: &Bag, wanted: &Wanted) -> Result<Vec<Joined>, JoinError> {
    gather(bag, &choose(bag.topics(), wanted)?)
}

/// How far points lie from the nearest wall, at most, m; and how many clouds there were.
fn off_walls(bag: &Bag, robot: &Joined) -> (f64, usize, Tally) {
    let (mut worst, mut count) = (0.0_f64, 0);
    let read = robot.read(
        bag,
        |_| true,
        |_, posed, placed| -> Result<Flow, JoinError> {
            count += 1;
            for point in &placed.points {
                let p = posed.pose * Vector3::from(point.map(f64::from));
                let off = (0..2).map(|axis| (p[axis].abs() - ROOM[axis]).abs()).fold(f64::INFINITY, f64::min);
                worst = worst.max(off);
            }
            Ok(Flow::On)
        },
    );
    (worst, count, read.unwrap())
}

fn told(messages: &[Written], wanted: &Wanted) -> String {
    let (bag, _folder) = bag(messages);
    let found = joined(&bag, wanted).and_then(|robots| {
        robots.iter().try_for_each(|robot| robot.read(&bag, |_| true, |_, _, _| Ok(Flow::On)).map(drop))
    });
    found.unwrap_err().to_string()
}

fn named(odometry: &str, cloud: &str) -> Wanted {
    let name = |text: &str| (!text.is_empty()).then(|| text.to_owned());
    Wanted { odometry: name(odometry), cloud: name(cloud) }
}

#[test]
fn what_was_seen_lies_on_the_walls_whatever_the_bag() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    write::mcap(&path("a.mcap"), &ROBOT.drive(10.0), Some(mcap::Compression::Lz4), true, "cdr");
    write::db3(&path("a.db3"), &ROBOT.drive(10.0), false, false);
    let ros1 = Robot { serialization: Serialization::Ros1, ..ROBOT };
    write::ros1(&path("a.bag"), &ros1.drive(10.0), "bz2");
    write::mcap(&path("b.mcap"), &Robot { sees_height: true, ..ROBOT }.drive(10.0), None, false, "cdr");
    let mut poses: Vec<Vec<Se3>> = Vec::new();
    for name in ["a.mcap", "a.db3", "a.bag", "b.mcap"] {
        let bag = Bag::open(&path(name)).unwrap();
        let robots = joined(&bag, &Wanted::default()).unwrap();
        let [robot] = robots.as_slice() else { panic!("{name}: {}", robots.len()) };
        assert_eq!((robot.odom.as_str(), robot.body.as_str()), ("odom", "base_link"));
        let (worst, count, tally) = off_walls(&bag, robot);
        // The last cloud has no pose after it. Between poses a chord stands for the arc: 3 m · (0.25 · 0.05)² / 8.
        assert_eq!((count, tally.sum(), robot.tally.sum()), (100, 0, 0), "{name}: {:?}", robot.tally);
        assert!(worst < 2e-4, "{name}: {worst}");
        poses.push(robot.clouds.iter().map(|posed| posed.pose).collect());
    }
    assert!(poses.iter().all(|other| *other == poses[0]), "all bags say the same");
}

#[test]
fn poses_come_of_tf_where_there_is_no_odometry() {
    let mut messages = ROBOT.drive(5.0);
    for message in messages.iter_mut().filter(|message| message.topic == "/odom") {
        let secs = (message.received_ns - 2_000_000 - BEGIN_NS) as f64 * 1e-9;
        let link = |child: &str| TransformStamped {
            header: header(secs, "odom"),
            child_frame_id: child.into(),
            transform: transform(&ROBOT.pose(secs)),
        };
        *message =
            ROBOT.message("tf", secs, &TfMessage { transforms: vec![link("base_link"), link("base_footprint")] });
    }
    let (bag, _folder) = bag(&messages);
    let robots = joined(&bag, &Wanted::default()).unwrap();
    assert_eq!(robots[0].poses, "TF odom → base_link");
    let (worst, count, _) = off_walls(&bag, &robots[0]);
    assert!(worst < 2e-4 && count == 50, "{worst} {count}");
}

#[test]
fn poses_without_a_body_are_those_of_base_link() {
    let mut messages = ROBOT.drive(5.0);
    for message in messages.iter_mut().filter(|message| message.topic == "/odom") {
        let secs = (message.received_ns - 2_000_000 - BEGIN_NS) as f64 * 1e-9;
        let pose = super::drive::pose(&ROBOT.pose(secs));
        *message = ROBOT.message("slam/pose", secs, &PoseStamped { header: header(secs, "map"), pose });
    }
    assert!(told(&messages, &Wanted::default()).contains("name a topic of poses by --odometry"));
    let (bag, _folder) = bag(&messages);
    let robots = joined(&bag, &named("/slam/pose", "")).unwrap();
    assert!(off_walls(&bag, &robots[0]).0 < 2e-4);
    assert_eq!(robots[0].choice.poses, Poses::Stamped(1));
    assert_eq!(counted(&robots[0].tally, "/slam/pose: names no body; taken for that of base_link"), 100);
}

#[test]
fn robots_are_told_apart_by_their_namespaces() {
    let robots = [Robot { namespace: "/r1", ..ROBOT }, Robot { namespace: "/r2", phase: 2.0, ..ROBOT }];
    let mut messages: Vec<Written> = robots.iter().flat_map(|robot| robot.drive(5.0)).collect();
    messages.sort_by_key(|message| message.received_ns);
    let (two, _folder) = bag(&messages);
    let found = joined(&two, &Wanted::default()).unwrap();
    let names: Vec<_> = found.iter().map(|robot| robot.choice.namespace.as_deref()).collect();
    assert_eq!(names, [Some("r1"), Some("r2")]);
    for (robot, truth) in found.iter().zip(robots) {
        assert!(off_walls(&two, robot).0 < 2e-4);
        let first = &robot.clouds[0];
        let off = first.pose.local(&truth.pose((first.stamp_ns - BEGIN_NS) as f64 * 1e-9)).norm();
        assert!(off < 1e-3, "the robots are mixed up: {off}");
    }
    let one = joined(&two, &named("/r2/odom", "/r2/scan")).unwrap();
    assert_eq!((one.len(), one[0].clouds.len()), (1, 50));
    // Each robot has another cloud besides.
    for robot in robots {
        messages.extend((0..5).map(|k| robot.message("rear/scan", f64::from(k), &robot.scan(f64::from(k)))));
    }
    let why = told(&messages, &Wanted::default());
    assert!(why.contains("4 topics are sensor_msgs/PointCloud2 or LaserScan"), "{why}");
    assert!(why.ends_with("or that of each robot without its namespace: --cloud rear/scan"), "{why}");
    let (four, _folder) = bag(&messages);
    let ambiguous = joined(&four, &named("odom", "scan")).unwrap_err().to_string();
    assert!(ambiguous.ends_with("name one by --cloud"), "no hint that was followed already: {ambiguous}");
    assert_eq!(joined(&four, &named("odom", "rear/scan")).unwrap().len(), 2, "relative names are those of each robot");
}

#[test]
fn what_cannot_be_guessed_names_topics_and_option() {
    let mut messages = ROBOT.drive(2.0);
    messages.push(ROBOT.message("rear_scan", 1.0, &ROBOT.scan(1.0)));
    let why = told(&messages, &Wanted::default());
    assert!(
        why.contains("/rear_scan (sensor_msgs/LaserScan × 1), /scan (sensor_msgs/LaserScan × 20); name one by --cloud"),
        "{why}"
    );
    let why = told(&messages, &named("", "/front_scan"));
    assert!(
        why.contains("--cloud /front_scan: there is no such topic; the bag has /odom (nav_msgs/Odometry × 40)"),
        "{why}"
    );
    let why = told(&messages, &named("/scan", "/scan"));
    assert!(why.contains("--odometry /scan: is sensor_msgs/LaserScan; nav_msgs/Odometry"), "{why}");
    let mut two = ROBOT.drive(2.0);
    two.push(ROBOT.message("odometry/filtered", 1.0, &ROBOT.odometry(1.0)));
    let why = told(&two, &Wanted::default());
    assert!(why.contains("2 topics are nav_msgs/Odometry") && why.contains("--odometry"), "{why}");
    let without = |topic: &str| -> Vec<Written> {
        ROBOT.drive(2.0).into_iter().filter(|message| message.topic != topic).collect()
    };
    let why = told(&without("/odom"), &Wanted::default());
    assert!(why.contains("no nav_msgs/Odometry and no TF odom → base_link") && why.contains("/scan"), "{why}");
    let why = told(&without("/scan"), &Wanted::default());
    assert!(why.contains("no sensor_msgs/PointCloud2 and no sensor_msgs/LaserScan"), "{why}");
    let why = told(&without("/tf_static"), &Wanted::default());
    assert!(why.contains("no frame \"base_link\"") && why.contains("record /tf_static"), "{why}");
}

#[test]
fn a_silent_topic_is_called_silent() {
    let topic = |name: &str, kind: &str, count| crate::bag::Topic {
        name: name.into(),
        kind: kind.into(),
        serialization: Some(Serialization::Cdr),
        count,
    };
    let topics = [topic("/scan", "sensor_msgs/LaserScan", 5), topic("/odom", "nav_msgs/Odometry", 0)];
    let why = choose(&topics, &named("/odom", "")).unwrap_err().to_string();
    assert!(why.contains("--odometry /odom: the topic is in the bag, but silent"), "{why}");
    let why = choose(&topics, &Wanted::default()).unwrap_err().to_string();
    assert!(why.contains("/odom (nav_msgs/Odometry, silent)"), "{why}");
    let many: Vec<_> = (0..60).map(|k| topic(&format!("/a{k}"), "a/B", 1)).collect();
    assert!(listed(&many).ends_with("20 more"));
}

/// Changes the headers of a topic's messages.
fn restamped<M: Message>(topic: &str, change: impl Fn(usize, &mut M)) -> Vec<Written> {
    let mut messages = ROBOT.drive(4.0);
    let of = messages.iter_mut().filter(|message| message.topic == topic);
    for (k, message) in of.enumerate() {
        let mut read = M::decode(Serialization::Cdr, &message.bytes).unwrap();
        change(k, &mut read);
        message.bytes = read.encode(Serialization::Cdr);
    }
    messages
}

fn one(messages: &[Written]) -> (Joined, Bag, TempDir) {
    let (bag, folder) = bag(messages);
    let robots = joined(&bag, &Wanted::default()).unwrap();
    (robots.into_iter().next().unwrap(), bag, folder)
}

fn counted(tally: &Tally, part: &str) -> u64 {
    tally.reasons().filter(|(reason, _)| reason.contains(part)).map(|(_, count)| count).sum()
}

#[test]
fn clocks_that_are_wrong_are_told() {
    type Scan = crate::msg::LaserScan;
    type Odometry = crate::msg::Odometry;
    let why = told(
        &restamped("/scan", |_, scan: &mut Scan| scan.header.stamp_ns -= 1_600_000_000_000_000_000),
        &Wanted::default(),
    );
    assert!(why.contains("/scan: none of its 40 stamps") && why.contains("use_sim_time"), "{why}");
    // All stamps 0: the time of receipt stands in.
    let (robot, ..) = one(&restamped("/scan", |_, scan: &mut Scan| scan.header.stamp_ns = 0));
    assert_eq!((robot.clouds.len(), counted(&robot.tally, "time of receipt")), (40, 40));
    let (robot, ..) = one(&restamped("/odom", |_, odom: &mut Odometry| odom.header.stamp_ns = 0));
    assert_eq!(counted(&robot.tally, "/odom: taken by the time of receipt"), 80);
    // Some stamps 0: they are left out.
    let (robot, ..) = one(&restamped("/scan", |k, scan: &mut Scan| {
        if k % 4 == 3 {
            scan.header.stamp_ns = 0;
        }
    }));
    assert_eq!((robot.clouds.len(), counted(&robot.tally, "left out, as the stamp is 0")), (30, 10));
    // Late and repeated ones.
    let (robot, ..) = one(&restamped("/scan", |k, scan: &mut Scan| {
        if k % 10 == 5 {
            scan.header.stamp_ns -= 300_000_000;
        }
    }));
    assert_eq!((robot.clouds.len(), counted(&robot.tally, "does not come after")), (36, 4));
}

/// A bag that loops, or an NTP step: the second way is not mixed with the first.
#[test]
fn a_clock_set_back_leaves_out_what_follows_and_is_told() {
    type Odometry = crate::msg::Odometry;
    let second = Robot { phase: 2.0, ..ROBOT };
    let mut messages = restamped("/odom", |k, odom: &mut Odometry| {
        if k >= 50 {
            let secs = f64::from(k as u32 - 50) / 20.0 + 0.01;
            *odom = second.odometry(secs);
        }
    });
    let (robot, bag, _folder) = one(&messages);
    assert_eq!(counted(&robot.tally, "/odom: the clock was set back, or the bag loops; left out"), 30);
    let (worst, count, _) = off_walls(&bag, &robot);
    assert!(worst < 2e-4 && count == 25, "{worst} {count}");
    // One stamp far ahead is left out alone.
    messages = restamped("/odom", |k, odom: &mut Odometry| {
        if k == 40 {
            odom.header.stamp_ns += 1_000_000_000_000;
        }
    });
    let (robot, ..) = one(&messages);
    assert_eq!((robot.clouds.len(), counted(&robot.tally, "far ahead of those before and after")), (40, 1));
    assert_eq!(robot.tally.sum(), 1, "{:?}", robot.tally);
}

#[test]
fn a_cloud_stamped_in_the_future_is_left_out_alone() {
    let (robot, ..) = one(&restamped("/scan", |k, scan: &mut crate::msg::LaserScan| {
        if k == 3 {
            scan.header.stamp_ns += 1_000_000_000_000;
        }
    }));
    assert_eq!((robot.clouds.len(), robot.tally.sum()), (39, 1), "{:?}", robot.tally);
}

#[test]
fn poses_in_other_frames_than_most_are_left_out_and_told() {
    let second = Robot { phase: 2.0, ..ROBOT };
    let (robot, bag, _folder) = one(&restamped("/odom", |k, odom: &mut crate::msg::Odometry| match k % 5 {
        0 => {
            *odom = second.odometry(f64::from(k as u32) / 20.0);
            odom.header.frame_id = "a_map".into();
        }
        1 => odom.child_frame_id.clear(),
        _ => {}
    }));
    assert_eq!(counted(&robot.tally, "other frames (a_map → base_link) than most, odom → base_link"), 16);
    assert_eq!(counted(&robot.tally, "/odom: names no body; taken for that of base_link"), 16);
    let (worst, count, _) = off_walls(&bag, &robot);
    assert!(worst < 1e-3 && count == 39, "{worst} {count}");
}

#[test]
fn transforms_for_all_are_those_of_each_robot() {
    let robots = [Robot { namespace: "/r1", ..ROBOT }, Robot { namespace: "/r2", phase: 2.0, ..ROBOT }];
    let mut messages: Vec<Written> = robots.iter().flat_map(|robot| robot.drive(5.0)).collect();
    messages.retain(|message| !message.topic.ends_with("tf_static"));
    messages.push(ROBOT.message("tf_static", 0.0, &ROBOT.sensor_pose()));
    messages.push(Written { bytes: vec![9; 3], ..ROBOT.message("tf_static", 0.0, &ROBOT.sensor_pose()) });
    messages.sort_by_key(|message| message.received_ns);
    let (two, _folder) = bag(&messages);
    for robot in joined(&two, &Wanted::default()).unwrap() {
        assert_eq!(robot.tally.sum(), 1, "the one that cannot be read: {:?}", robot.tally);
        assert!(off_walls(&two, &robot).0 < 2e-4);
    }
}

#[test]
fn a_silence_of_the_odometry_is_not_bridged() {
    let messages: Vec<Written> = ROBOT
        .drive(6.0)
        .into_iter()
        .filter(|message| {
            message.topic != "/odom" || !(1_500..3_500).contains(&((message.received_ns - BEGIN_NS) / 1_000_000))
        })
        .collect();
    let (robot, bag, _folder) = one(&messages);
    let silent = counted(&robot.tally, "/odom is silent for more than 1 s");
    assert_eq!((robot.clouds.len() as u64 + silent, silent), (60, 20), "{:?}", robot.tally);
    assert!(off_walls(&bag, &robot).0 < 2e-4);
}

#[test]
fn bad_messages_are_counted_and_the_others_used() {
    let mut messages = ROBOT.drive(4.0);
    let of = |topic: &'static str| move |message: &&mut Written| message.topic == topic;
    messages.iter_mut().filter(of("/scan")).step_by(4).for_each(|message| message.bytes.truncate(60));
    messages.iter_mut().filter(of("/odom")).skip(1).step_by(8).for_each(|message| message.bytes[1] = 9);
    let (robot, bag, _folder) = one(&messages);
    assert_eq!(counted(&robot.tally, "/odom: begins with [00, 09]"), 10, "{:?}", robot.tally);
    let (worst, count, tally) = off_walls(&bag, &robot);
    assert_eq!((count, counted(&tally, "cut off?")), (30, 10), "{tally:?}");
    assert!(worst < 1e-3);
    // None is left.
    messages.iter_mut().filter(of("/odom")).for_each(|message| message.bytes.truncate(3));
    let why = told(&messages, &Wanted::default());
    assert!(why.contains("/odom: none of 80 messages can be used"), "{why}");
}

#[test]
fn empty_clouds_and_frames_that_do_not_exist_are_counted() {
    let messages = restamped("/scan", |k, scan: &mut crate::msg::LaserScan| match k % 4 {
        0 => scan.ranges.clear(),
        1 => scan.ranges.fill(f32::INFINITY),
        2 => scan.header.frame_id = "elsewhere".into(),
        _ => {}
    });
    let (robot, bag, _folder) = one(&messages);
    let (_, count, tally) = off_walls(&bag, &robot);
    assert_eq!(count, 10);
    for reason in ["has no points", "has no point that is finite and in range", "no frame \"elsewhere\""] {
        assert_eq!(counted(&tally, reason), 10, "{reason}: {tally:?}");
    }
    let why = told(
        &restamped("/scan", |_, scan: &mut crate::msg::LaserScan| scan.header.frame_id.clear()),
        &Wanted::default(),
    );
    assert!(why.contains("names no frame (header.frame_id is empty)"), "{why}");
}

#[test]
fn points_in_the_frame_of_the_odometry_are_put_into_that_of_the_body() {
    let mut messages = ROBOT.drive(4.0);
    messages.retain(|message| message.topic != "/tf_static" && message.topic != "/scan");
    let lidar = Robot { sees_height: true, ..ROBOT };
    for k in 0..30 {
        let secs = f64::from(k) * 0.1;
        let mut cloud = lidar.cloud(secs);
        let (points, _) = cloud.points(usize::MAX).unwrap();
        let t_odom_laser =
            ROBOT.pose(secs) * Se3::from_xyzw([0.0, 0.0, 0.2_f64.sin(), 0.2_f64.cos()], [0.2, 0.0, 0.3]).unwrap();
        let number = |x: f64| (x as f32).to_le_bytes();
        let moved = points.iter().flat_map(|p| {
            let p = t_odom_laser * Vector3::from(*p);
            [number(p.x), number(p.y), number(p.z), number(0.0)].concat()
        });
        cloud.data.0 = moved.collect();
        cloud.header.frame_id = "odom".into();
        messages.push(ROBOT.message("registered", secs, &cloud));
    }
    let (robot, bag, _folder) = one(&messages);
    let (worst, count, _) = off_walls(&bag, &robot);
    assert!(worst < 1e-3 && count == 30, "{worst} {count}");
    robot
        .read(
            &bag,
            |index| index == 20,
            |_, posed, placed| -> Result<Flow, JoinError> {
                // Seen from the body, where it is by then.
                let p = placed.t_body_sensor;
                assert!((posed.pose * p).local(&Se3::identity()).norm() < 1e-9);
                Ok(Flow::On)
            },
        )
        .unwrap();
}

/// A sensor on a joint that moves, whose transforms end before the drive does: the reason is told once.
#[test]
fn transforms_that_end_early_leave_clouds_out_and_are_told_once() {
    let mut messages = ROBOT.drive(4.0);
    messages.retain(|message| message.topic != "/tf_static");
    for k in 0..20 {
        let secs = f64::from(k) * 0.1;
        let mut links = ROBOT.sensor_pose();
        links.transforms.iter_mut().for_each(|link| link.header = header(secs, &link.header.frame_id));
        links.transforms[1].transform.translation.x += 1e-6 * f64::from(k);
        messages.push(ROBOT.message("tf", secs, &links));
    }
    messages.sort_by_key(|message| message.received_ns);
    let (robot, bag, _folder) = one(&messages);
    let (worst, count, tally) = off_walls(&bag, &robot);
    assert!(worst < 1e-3 && count == 19, "{worst} {count}");
    assert_eq!((counted(&tally, "TF mast → laser moves"), tally.reasons().count()), (21, 1), "{tally:?}");
}

#[test]
fn the_header_alone_is_that_of_the_message() {
    let scan = ROBOT.scan(1.0);
    for serialization in [Serialization::Cdr, Serialization::Ros1] {
        let read: Header = gather::header(serialization, &scan.encode(serialization)).unwrap();
        assert_eq!(read, scan.header);
    }
    assert_eq!(stamp(1.0), scan.header.stamp_ns);
}

/// Bags of others, if they are there.
#[test]
fn real_bags_are_read() {
    let shared = std::env::var("MERGANSER_SHARED")
        .unwrap_or_else(|_| concat!(env!("CARGO_MANIFEST_DIR"), "/../../../shared").into());
    let data = Path::new(&shared).join("data");
    if !data.join("ros2_bag_turtlebot4").is_dir() {
        eprintln!("skipped: there is no {}", data.display());
        return;
    }
    let bag = Bag::open(&data.join("ros2_bag_turtlebot4")).unwrap();
    let count = |name: &str| bag.topics().iter().find(|topic| topic.name == name).map(|topic| topic.count);
    assert_eq!(
        [count("/odom"), count("/tf"), count("/scan"), count("/tf_static")],
        [Some(920), Some(953), Some(357), Some(2)]
    );
    let robots = joined(&bag, &Wanted::default()).unwrap();
    assert!(robots[0].clouds.len() > 340, "{} {:?}", robots[0].clouds.len(), robots[0].tally);
    let tally = robots[0].read(&bag, |_| true, |_, _, _| -> Result<Flow, JoinError> { Ok(Flow::On) }).unwrap();
    assert_eq!(tally.sum(), 0, "{tally:?}");

    let bag = Bag::open(&data.join("ros1_bag_guardian/guardian_3.bag")).unwrap();
    let why = choose(bag.topics(), &Wanted::default()).unwrap_err().to_string();
    assert!(why.contains("/hokuyo_back_scan (sensor_msgs/LaserScan × 1038), /scan"), "{why}");
    for cloud in ["/hokuyo_back_scan", "/scan"] {
        let robots = joined(&bag, &named("", cloud)).unwrap();
        assert!(robots[0].clouds.len() > 1000, "{} {:?}", robots[0].clouds.len(), robots[0].tally);
        let tally = robots[0].read(&bag, |_| true, |_, _, _| -> Result<Flow, JoinError> { Ok(Flow::On) }).unwrap();
        assert_eq!(tally.sum(), 0, "{tally:?}");
    }
}

/// What is lost after the opening, which looks at no message's bytes, is told once.
#[test]
fn what_the_second_reading_of_a_bag_loses_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.db3");
    write::db3(&path, &ROBOT.drive(4.0), false, false);
    let long = crate::limits::MESSAGE_BYTES_MAX + (2 << 20);
    let change = format!("UPDATE messages SET data = zeroblob({long}) WHERE id = 5");
    rusqlite::Connection::open(&path).unwrap().execute_batch(&change).unwrap();
    let bag = Bag::open(&path).unwrap();
    let robots = joined(&bag, &Wanted::default()).unwrap();
    assert_eq!(counted(&robots[0].tally, "1 messages of more than"), 1, "{:?}", robots[0].tally);
    assert_eq!(off_walls(&bag, &robots[0]).2.sum(), 0);
}

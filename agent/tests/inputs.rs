//! Thirteen kinds of input that people brought and that once went wrong without a word, and where it is shown that each
//! is now understood, or told with the cure. Most are shown here; of the rest the table names the tests.
//!
//! | input | what is right | shown by |
//! |---|---|---|
//! | a `.bin` of five floats | read as five, and told | [`a_bin_of_five_floats_is_read_as_such_and_told`] |
//! | a CARMEN log of `ROBOTLASER1` | read, with its own field of view | [`a_log_of_the_newer_laser_message_is_read`] |
//! | two g2o files with the same ids | refused, with the letter as cure | `graph_command.rs`: `robots_that_number_alike_are_told_apart_by_the_cure` |
//! | a dump of keyframes 12 m apart | stamps that its own poses allow | [`keyframes_of_a_dump_are_taken`] |
//! | variances of unmeasured axes | used, and told by axis and key | [`unmeasured_axes_end_no_submap_and_are_told`]; that robots merge: `tests/tests/swarms/unmeasured.rs` |
//! | PCD with fields of `COUNT 0` | they have no bytes | [`fields_of_count_0_are_padding_without_bytes`] |
//! | PCD with a `VIEWPOINT` | told that it is not applied | [`a_viewpoint_is_told`] |
//! | JSON as Python sends it first | field, count, order, encoding | [`what_a_first_python_user_sends_is_told_with_the_cure`]; more of it: `observation_tests.rs` |
//! | nine lost keyframes | the motion across is known to `gap_sigma_per_m` | [`whatever_loses_keyframes_leaves_the_body_as_uncertain`]; by the agent's door: `lost_input.rs` |
//! | a minute's standing at 10 Hz | one submap | [`a_robot_that_stands_for_a_minute_makes_one_submap_more`], [`a_robot_that_stands_for_a_night_costs_one_submap_and_no_try`] |
//! | points in millimetres | told by extent and unit | [`points_in_millimetres_are_told`]; units of the rest: `doctor.rs` |
//! | poses in map coordinates (UTM) | written by an offset, judged where robots are | `src/demo/far_tests.rs`: both tests |
//! | input by the host's own address | one warning that names `zenoh.input_interfaces` | [`input_over_the_hosts_own_address_is_told_once_with_the_cure`]; that it is refused, whoever relays it: `door.rs` |
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

#[path = "inputs/a_core.rs"]
mod a_core;
mod common;

use a_core::ACore;
use common::{PATIENCE, name, swarm, until};
use merganser::commands::doctor::{Examination, Examined};
use merganser::keys;
use merganser::link::session;
use merganser::observation::{self, Format};
use merganser::recording::{Recording, import};
use merganser_protocol::agent::io::Input;
use merganser_protocol::geometry::{Covariance, Se3, So3};
use merganser_protocol::submap::{Keyframe, Loss, SubmapBuilder};
use merganser_protocol::time::Stamp;
use nalgebra::{Matrix6, Vector3};
use serde_json::{Value, json};
use std::fmt::Write as _;
use std::fs;
use std::net::UdpSocket;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::Duration;

/// Two robots with one keyframe each, of a cloud stored so, as `demo --data` reads them.
fn two_robots(clouds: &str, cloud: &[u8]) -> (Vec<Recording>, tempfile::TempDir) {
    let dir = tempfile::tempdir().unwrap();
    for robot in ["a", "b"] {
        let folder = dir.path().join(robot);
        fs::create_dir(&folder).unwrap();
        let triangle: Vec<&str> = (0..6).flat_map(|r| (r..6).map(move |c| if r == c { "1e-4" } else { "0" })).collect();
        let columns: Vec<String> = (0..6).flat_map(|r| (r..6).map(move |c| format!("c{r}{c}"))).collect();
        let table = format!(
            "stamp_ns,x,y,z,qx,qy,qz,qw,{},cloud\n1000000000,0,0,0,0,0,0,1,{},c\n",
            columns.join(","),
            triangle.join(",")
        );
        let manifest = format!(
            "format = \"merganser-recording\"\nversion = 1\nrobot = \"{robot}\"\nsensor = \"x\"\nclouds = \"{clouds}\"\n\
             keyframes = 1\n[config.submap]\nsensor = \"lidar_3d\"\nvoxel_m = 0.3\n"
        );
        for (file, bytes) in
            [("keyframes.csv", table.as_bytes()), ("recording.toml", manifest.as_bytes()), ("c", cloud)]
        {
            fs::write(folder.join(file), bytes).unwrap();
        }
    }
    let recordings = import::open_all(dir.path()).unwrap();
    (recordings, dir)
}

/// What a cloud holds, and what is told of it.
fn read(clouds: &str, cloud: &[u8]) -> (Vec<[f32; 3]>, Vec<String>) {
    let (recordings, _dir) = two_robots(clouds, cloud);
    assert_eq!(recordings.len(), 2);
    let told = recordings[0].check_clouds().unwrap().told();
    (recordings[0].points(0).unwrap(), told)
}

fn bytes(floats: impl IntoIterator<Item = f32>) -> Vec<u8> {
    floats.into_iter().flat_map(f32::to_le_bytes).collect()
}

#[test]
fn a_bin_of_five_floats_is_read_as_such_and_told() {
    let at = |k: u16| [0.7, -0.3, 0.1].map(|step| step * (f32::from(k) - 19.5));
    // Forty fives are fifty fours as well.
    let five = |k: u16| at(k).into_iter().chain([f32::from(k % 7) * 30.0, f32::from(k % 32)]);
    let (points, told) = read("kitti-bin", &bytes((0..40).flat_map(five)));
    assert_eq!(points, (0..40).map(at).collect::<Vec<_>>());
    assert!(told.len() == 1 && told[0].contains("five numbers a point"), "{told:?}");
}

#[test]
fn a_log_of_the_newer_laser_message_is_read() {
    let mut log = String::from("PARAM robot_frontlaser_offset 0.0 nohost 0\n");
    for k in 0..60 {
        let x = 0.1 * f64::from(k);
        log += "ROBOTLASER1 0 -1.5708 3.1416 0.174533 81.9 0.01 0 19";
        for beam in 0..19 {
            let _ = write!(log, " {:.2}", 2.0 / (0.2 + f64::from(beam) * 0.17).sin().abs().max(0.2));
        }
        let _ = writeln!(log, " 0 {x:.2} 0 0 {x:.2} 0 0 0 0 0 0 0 {}.0 robot {k}.0", 976_052_857 + k);
    }
    for name in ["new.clf", "new.log", "new.gfs.log"] {
        let (dir, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        fs::write(dir.path().join(name), &log).unwrap();
        let recordings = import::prepare(dir.path(), out.path(), 1).unwrap().recordings;
        assert_eq!(recordings.len(), 3, "{name}");
        // Nineteen beams over half a turn, but those at their range: the first at the right, 10 m off.
        let points = recordings[0].points(0).unwrap();
        let first = points[0];
        assert!(
            (15..=19).contains(&points.len()) && first[1] < -9.0 && first[0].abs() < 0.01,
            "{first:?} of {}",
            points.len()
        );
    }
}

#[test]
fn keyframes_of_a_dump_are_taken() {
    let (dir, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let mut graph = String::new();
    for k in 0..6 {
        let folder = dir.path().join(format!("{k:06}"));
        fs::create_dir(&folder).unwrap();
        let points = (0..60).flat_map(|n| [5.0, n as f32 * 0.5 - 15.0, 0.1 * n as f32]);
        fs::write(folder.join("points.bin"), bytes(points)).unwrap();
        let _ = writeln!(graph, "v{k} {} {} 0 0 0 0 1", 12 * k, 0.1 * f64::from(k));
    }
    fs::write(dir.path().join("graph.txt"), graph).unwrap();
    let recordings = import::prepare(dir.path(), out.path(), 1).unwrap().recordings;
    for recording in &recordings {
        let seen = examined(recording, |_| {});
        assert!(seen.keyframes == 3 && seen.refused.is_empty(), "{:?} of {}", seen.refused, seen.keyframes);
    }
}

/// The recordings that come with the program.
fn built_in(robot: &str) -> Recording {
    Recording::open(&Path::new("recordings").join(robot)).unwrap()
}

/// What an agent would tell of a recording whose keyframes are sent otherwise.
fn examined(recording: &Recording, send: impl Fn(&mut Keyframe)) -> Examined {
    let manifest = recording.manifest();
    let mut examination = Examination::new(manifest.robot.to_string(), manifest.config.clone());
    for index in 0..recording.len() {
        let mut keyframe = recording.keyframe(index).unwrap();
        send(&mut keyframe);
        examination.take(None, keyframe);
    }
    examination.finish(None)
}

#[test]
fn unmeasured_axes_end_no_submap_and_are_told() {
    let alpha = built_in("alpha");
    // Submaps, and what is told of what was stated.
    let cut = |send: &dyn Fn(&mut Matrix6<f64>)| {
        let mut builder = SubmapBuilder::new(alpha.manifest().config.submap.clone());
        let (mut submaps, mut told) = (0, Vec::new());
        for index in 0..alpha.len() {
            let mut keyframe = alpha.keyframe(index).unwrap();
            let mut matrix: Matrix6<f64> = *keyframe.pose.covariance.matrix();
            send(&mut matrix);
            keyframe.pose.covariance = Covariance::new(matrix).unwrap();
            submaps += usize::from(builder.push(keyframe).unwrap().is_some());
            told.extend(builder.take_oddities().iter().map(ToString::to_string));
        }
        (submaps, told)
    };
    let stated = |variance: f64, axes: core::ops::Range<usize>| {
        cut(&move |matrix| axes.clone().for_each(|axis| matrix[(axis, axis)] = variance))
    };
    let honest = cut(&|_| {}).0;
    for variance in [1e6, 9999.0] {
        let (submaps, told) = stated(variance, 2..5);
        assert!(told.len() == 1 && told[0].contains("does not measure z, roll, pitch"), "{variance}: {told:?}");
        assert!(told[0].contains("gap_sigma_per_m") && submaps == honest, "{variance}: {submaps}, {told:?}");
    }
    // Nothing is measured, or an identity matrix is stated: no submap holds, and the cure names axes and key.
    for variance in [1e6, 1.0] {
        let told = stated(variance, 0..6).1;
        let blurs = told.iter().find(|told| told.contains("too large in"));
        assert!(blurs.is_some_and(|told| told.contains("sigma_max") && told.contains("yaw")), "{variance}: {told:?}");
    }
}

/// A PCD of three points with more fields beside them, in binary.
fn pcd(fields: [&str; 4], viewpoint: &str, point: impl Fn([f32; 3]) -> Vec<u8>) -> Vec<u8> {
    let [names, sizes, types, counts] = fields;
    let head = format!(
        "# .PCD v0.7\nVERSION 0.7\nFIELDS {names}\nSIZE {sizes}\nTYPE {types}\nCOUNT {counts}\nWIDTH 3\nHEIGHT 1\n\
         VIEWPOINT {viewpoint}\nPOINTS 3\nDATA binary\n"
    );
    let points = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.5]];
    head.into_bytes().into_iter().chain(points.into_iter().flat_map(point)).collect()
}

#[test]
fn fields_of_count_0_are_padding_without_bytes() {
    let fields = ["x y z _ intensity t _", "4 4 4 1 4 4 1", "F F F U F U U", "1 1 1 0 1 1 0"];
    let cloud = pcd(fields, "0 0 0 1 0 0 0", |at| [bytes(at), bytes([0.5]), vec![7; 4]].concat());
    assert_eq!(read("pcd", &cloud), (vec![[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.5]], vec![]));
}

#[test]
fn a_viewpoint_is_told() {
    let fields = ["x y z", "4 4 4", "F F F", "1 1 1"];
    let cloud = pcd(fields, "10 20 3 0.7071068 0 0 0.7071068", bytes);
    let (points, told) = read("pcd", &cloud);
    assert_eq!(points[0], [1.0, 2.0, 3.0]);
    assert!(
        told.len() == 1 && told[0].contains("VIEWPOINT 10 20 3") && told[0].contains("must be in the body frame"),
        "{told:?}"
    );
}

#[test]
fn what_a_first_python_user_sends_is_told_with_the_cure() {
    let diagonal: Vec<f64> = (0..6).flat_map(|r| (r..6).map(move |c| if r == c { 1e-4 } else { 0.0 })).collect();
    let good = json!({"stamp_ns": 1_000_000_000, "translation": [0, 0, 0], "rotation": [0, 0, 0, 1],
        "covariance": diagonal, "covariance_of": "motion", "points": [[1.5, 0.2, 0.0]]});
    let with = |field: &str, value: Value| {
        let mut message = good.clone();
        message[field] = value;
        message.to_string()
    };
    let nan = good.to_string().replace("[1.5,0.2,0.0]", "[1.5,0.2,NaN]");
    let cases = [
        (Format::Postcard, good.to_string(), "this looks like JSON: state the encoding application/json"),
        (Format::Json, with("covariance", json!(vec![1e-4; 36])), "21 numbers are wanted, not 36: the upper triangle"),
        (Format::Json, with("points", json!([[1, 2, 3, 0.5]])), "points: [x, y, z] of each, not 4 numbers"),
        (Format::Json, nan, "points: every number must be finite"),
        (Format::Json, with("stamp_ns", json!(1_700_000_000.5)), "stamp_ns: a whole number of nanoseconds"),
    ];
    for (format, message, wanted) in cases {
        let told = observation::keyframe(format, message.as_bytes()).unwrap_err().to_string();
        assert!(told.contains(wanted), "{message}: {told}");
    }
    assert!(observation::keyframe(Format::Json, good.to_string().as_bytes()).is_ok());
}

/// The `index`-th keyframe of a way straight ahead, a metre and a second each.
fn ahead(index: i64) -> Keyframe {
    let (stamp, x) = (Stamp(1_000_000_000_000 + index * 1_000_000_000), index as f64);
    let mut keyframe = common::keyframe(0, 0);
    (keyframe.stamp, keyframe.pose.pose) = (stamp, Se3::new(So3::identity(), Vector3::new(x, 0.0, 0.0)));
    keyframe.pose.covariance = Covariance::from_sigmas([0.01, 0.01, 0.01, 1e-3, 1e-3, 1e-3]).unwrap();
    keyframe.points.truncate(400);
    keyframe
}

/// Forty keyframes, of which the 21st to the 29th are lost.
#[test]
fn whatever_loses_keyframes_leaves_the_body_as_uncertain() {
    let lost = 20..29;
    let driven = |send: &dyn Fn(i64) -> Option<Input>| {
        let mut config = built_in("alpha").manifest().config.clone();
        config.submap.distance_m = 10.0; // the way across the gap: more would be a jump
        let mut core = ACore::new(config);
        (0..40).filter_map(send).for_each(|input| core.input(input));
        (core.sigma_x(), core.gaps())
    };
    let taken = |k: i64| Some(Input::Keyframe(ahead(k)));
    let (sigma, gaps) = driven(&taken);
    assert!((0.01..0.1).contains(&sigma) && gaps == 0, "{sigma} with {gaps} gaps of what was not lost");
    // As `link` hands over what its decoder refuses.
    let unreadable = |change: &dyn Fn(&mut Value)| {
        let mut message = serde_json::to_value(observation::KeyframeMessage::from(&ahead(20))).unwrap();
        change(&mut message);
        assert!(observation::keyframe(Format::Json, message.to_string().as_bytes()).is_err(), "{message}");
        Some(Input::KeyframesLost { why: Loss::Unreadable, count: 1 })
    };
    type Way<'a> = (&'a str, &'a dyn Fn(i64) -> Option<Input>);
    let ways: [Way<'_>; 5] = [
        ("refused by the core: a stamp of the year 2116", &|k| {
            let stamp = if lost.contains(&k) { Stamp((1 << 62) + k) } else { ahead(k).stamp };
            Some(Input::Keyframe(Keyframe { stamp, ..ahead(k) }))
        }),
        ("refused by the decoder: a rotation of zeros", &|k| {
            if lost.contains(&k) { unreadable(&|m| m["rotation"] = json!([0, 0, 0, 0])) } else { taken(k) }
        }),
        ("refused by the decoder: a covariance that is none", &|k| {
            if lost.contains(&k) { unreadable(&|m| m["covariance"][1] = json!(7)) } else { taken(k) }
        }),
        ("late: the clock was set back by 9.5 s for good", &|k| {
            let back = if k < 20 { 0 } else { 9_500_000_000 };
            Some(Input::Keyframe(Keyframe { stamp: Stamp(ahead(k).stamp.0 - back), ..ahead(k) }))
        }),
        ("never arrived", &|k| if lost.contains(&k) { None } else { taken(k) }),
    ];
    for (what, send) in ways {
        let (sigma, gaps) = driven(send);
        // A tenth of the ten metres.
        assert!((0.7..1.5).contains(&sigma) && gaps == 1, "{what}: {sigma} m with {gaps} gaps");
    }
}

#[test]
fn a_robot_that_stands_for_a_minute_makes_one_submap_more() {
    let alpha = built_in("alpha");
    let submaps = |hz: i64| {
        let mut builder = SubmapBuilder::new(alpha.manifest().config.submap.clone());
        let mut count = 0;
        let mut push = |keyframe| count += usize::from(builder.push(keyframe).unwrap().is_some());
        for k in 0..60 * hz {
            let mut still = alpha.keyframe(0).unwrap();
            still.stamp = Stamp(still.stamp.0 + k * 1_000_000_000 / hz);
            still.points.truncate(200);
            // Odometry that trembles by 2 mm.
            still.pose.pose.translation = Vector3::new(0.002 * (k % 3 - 1) as f64, 0.002 * (k % 2) as f64, 0.0);
            still.pose.covariance = Covariance::from_sigmas([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4]).unwrap();
            push(still);
        }
        for index in 0..alpha.len() {
            let mut keyframe = alpha.keyframe(index).unwrap();
            keyframe.stamp = Stamp(keyframe.stamp.0 + 60_000_000_000);
            keyframe.points.truncate(200);
            push(keyframe);
        }
        count + usize::from(builder.flush().is_some())
    };
    let driven = submaps(0);
    for hz in [1, 10, 100] {
        assert!((driven..=driven + 1).contains(&submaps(hz)), "{hz} Hz: {} instead of {driven}", submaps(hz));
    }
}

/// Eight hours at 10 Hz: one submap of it, and nothing is tried again.
#[test]
fn a_robot_that_stands_for_a_night_costs_one_submap_and_no_try() {
    const TENTH: Duration = Duration::from_millis(100);
    let alpha = built_in("alpha");
    let mut core = ACore::new(alpha.manifest().config.clone());
    let last = alpha.len() - 1;
    for index in 0..alpha.len() {
        core.input_after(TENTH * 8, Input::Keyframe(alpha.keyframe(index).unwrap()));
    }
    let mut still = alpha.keyframe(last).unwrap();
    let (begun, at) = (still.stamp, still.pose.pose);
    still.points.truncate(100);
    still.pose.covariance = Covariance::from_sigmas([1e-3, 1e-3, 1e-3, 1e-4, 1e-4, 1e-4]).unwrap();
    let mut stand = |core: &mut ACore, tenths: core::ops::Range<i64>| {
        for k in tenths {
            // Odometry that trembles by 2 mm.
            let off = Vector3::new(0.002 * (k % 3 - 1) as f64, 0.002 * (k % 2) as f64, 0.0);
            still.stamp = Stamp(begun.0 + k * 100_000_000);
            still.pose.pose = at * Se3::new(So3::identity(), off);
            core.input_after(TENTH, Input::Keyframe(still.clone()));
        }
        let status = core.seen().status;
        (status.submaps, status.keyframes, core.tried, core.jobs)
    };
    let driven = core.seen().status.submaps;
    let (submaps, _, tried, jobs) = stand(&mut core, 1..600);
    assert!((driven..=driven + 2).contains(&submaps), "{driven} submaps became {submaps} in a minute");
    let night = stand(&mut core, 600..8 * 36_000);
    assert_eq!(night, (submaps, alpha.len() as u64 + 8 * 36_000 - 1, tried, jobs), "submaps, keyframes, tries, jobs");
    assert!(core.sigma_x() < 0.5, "{} m after a night at one place", core.sigma_x());
}

#[test]
fn points_in_millimetres_are_told() {
    let seen = examined(&built_in("alpha"), |keyframe| {
        keyframe.points.iter_mut().for_each(|point| *point = point.map(|c| 1000.0 * c));
    });
    let told = seen.remarks.iter().find(|told| told.contains("points are in millimetres and poses in metres"));
    assert!(told.is_some_and(|told| told.contains("send metres")), "{:?}", seen.remarks);
    assert!(seen.reach_m[0] > 1000.0 && seen.keypoints == 0.0, "{:?}", seen.reach_m);
}

/// The address that this host has in its network; loopback, if it is in none.
fn own_address() -> String {
    let asked = UdpSocket::bind("0.0.0.0:0").and_then(|socket| {
        socket.connect("192.0.2.77:9")?; // nothing is sent: it tells which address would send it
        socket.local_addr()
    });
    asked.map_or_else(|_| "127.0.0.1".into(), |address| address.ip().to_string())
}

#[tokio::test(flavor = "multi_thread")]
async fn input_over_the_hosts_own_address_is_told_once_with_the_cure() {
    let dir = tempfile::tempdir().unwrap();
    let mut config = swarm(dir.path(), &["alpha"]).remove(0);
    let port = config.zenoh.listen[0].rsplit(':').next().unwrap().to_owned();
    config.zenoh.listen = vec![format!("tcp/0.0.0.0:{port}")];
    config.zenoh.security = Some(merganser::config::Security::None);
    config.save(&dir.path().join("alpha.toml")).unwrap();
    let mut agent = Command::new(env!("CARGO_BIN_EXE_merganser"));
    agent.args(["run", "-c", "alpha.toml"]).current_dir(dir.path());
    let log = fs::File::create(dir.path().join("log")).unwrap();
    let mut agent = agent.stdin(Stdio::null()).stdout(Stdio::null()).stderr(log).spawn().unwrap();
    let mut client = zenoh::Config::default();
    for (key, value) in [
        ("mode", json!("client")),
        ("connect/endpoints", json!([format!("tcp/{}:{port}", own_address())])),
        ("connect/timeout_ms", json!(10_000)),
        ("scouting/multicast/enabled", json!(false)),
    ] {
        client.insert_json5(key, &value.to_string()).unwrap();
    }
    let slam = zenoh::open(client).await.unwrap();
    let message = serde_json::to_vec(&observation::KeyframeMessage::from(&ahead(0))).unwrap();
    let warnings = || {
        let log = fs::read_to_string(dir.path().join("log")).unwrap();
        log.lines().filter(|line| line.contains("zenoh.input_interfaces")).count()
    };
    until("a warning", async || {
        let put = slam.put(keys::of(&name("test"), &name("alpha"), "in/keyframe"), message.clone());
        put.encoding("application/json").await.unwrap();
        warnings() > 0
    })
    .await;
    session::close(&slam, PATIENCE).await;
    assert!(Command::new("kill").arg(agent.id().to_string()).status().unwrap().success());
    assert_eq!((agent.wait().unwrap().code(), warnings()), (Some(0), 1));
}

//! `merganser doctor`: what is told of keyframes that a front end means otherwise than they are read, of real sensors'
//! habits, and of nothing that is as it is to be.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{name, swarm};
use merganser::commands::doctor::{Examination, Examined};
use merganser::keys;
use merganser::observation::KeyframeMessage;
use merganser::recording::Recording;
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::submap::Keyframe;
use merganser_protocol::time::{Instant, Stamp};
use nalgebra::{UnitQuaternion, Vector3};
use serde_json::{Value, json};
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;
use zenoh::qos::CongestionControl;

type Points = Vec<[f32; 3]>;

/// Keyframes of the recordings' first ten submaps.
const TEN_SUBMAPS: usize = 38;

/// What is told of a recording whose poses and points are sent in another way.
fn told(robot: &str, send: impl Fn(&mut Se3, &mut Points)) -> Vec<String> {
    examination(robot, |keyframe| send(&mut keyframe.pose.pose, &mut keyframe.points)).remarks().to_vec()
}

fn examined(robot: &str, send: impl Fn(&mut Keyframe)) -> Examined {
    examination(robot, send).finish(None)
}

/// Before submaps are described and aligned.
fn examination(robot: &str, send: impl Fn(&mut Keyframe)) -> Examination {
    examination_of(robot, usize::MAX, send)
}

/// Of the first so many keyframes.
fn examination_of(robot: &str, keyframes: usize, send: impl Fn(&mut Keyframe)) -> Examination {
    let recording = Recording::open(&Path::new("recordings").join(robot)).unwrap();
    let mut examination = Examination::new(robot.to_owned(), recording.manifest().config.clone());
    let first = recording.keyframe(0).unwrap().stamp;
    for index in 0..recording.len().min(keyframes) {
        let mut keyframe = recording.keyframe(index).unwrap();
        let at = Instant::ZERO.after(Duration::from_secs_f64(keyframe.stamp.secs_since(first)));
        send(&mut keyframe);
        examination.take(Some(at), keyframe);
    }
    examination
}

#[test]
fn of_what_is_sent_as_it_is_to_be_nothing_is_told() {
    for robot in ["alpha", "beta", "gamma"] {
        let seen = examined(robot, |_| {});
        assert_eq!(seen.remarks, Vec::<String>::new());
        assert_eq!((seen.aligned, seen.submaps), ([11, 11], 12));
        // A LiDAR that hangs upside down, and poses of its own.
        let mount = Se3::new(So3::exp(&Vector3::new(std::f64::consts::PI, 0.0, 0.0)), Vector3::zeros());
        let hung = told(robot, |pose, points| {
            *pose = mount.inverse() * *pose * mount;
            points.iter_mut().for_each(|p| *p = [p[0], -p[1], -p[2]]);
        });
        assert_eq!(hung, Vec::<String>::new());
    }
}

#[test]
fn what_is_meant_otherwise_is_told_with_the_cure_within_ten_submaps() {
    // Submaps of four keyframes, as they are sent; what is wrong may cut them otherwise.
    let told = |robot: &str, send: &dyn Fn(&mut Se3, &mut Points)| {
        let sent = examination_of(robot, TEN_SUBMAPS, |keyframe| send(&mut keyframe.pose.pose, &mut keyframe.points));
        sent.remarks().to_vec()
    };
    for robot in ["alpha", "beta", "gamma"] {
        assert_eq!(examination_of(robot, TEN_SUBMAPS, |_| {}).submaps(), 9, "and one that is open");
        let is_told = |what: &str, remarks: &[String]| {
            let is_of_readings = |remark: &&String| {
                ["views lie over", "moves one way in its own axes"].iter().any(|how| remark.contains(how))
            };
            let of_readings: Vec<&String> = remarks.iter().filter(is_of_readings).collect();
            assert!(of_readings.len() == 1 && of_readings[0].contains(what), "{robot}: {what}: {remarks:?}");
        };
        let in_frame = told(robot, &|pose, points| {
            for p in points {
                *p = (*pose * Vector3::from(p.map(f64::from))).map(|x| x as f32).into();
            }
        });
        is_told("send them in the body's", &in_frame);
        is_told("poses are inverted", &told(robot, &|pose, _| *pose = pose.inverse()));
        let w_first = told(robot, &|pose, _| {
            let [x, y, z, w] = pose.rotation.xyzw();
            let q = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(z, w, x, y));
            *pose = Se3::new(So3::exp(&q.scaled_axis()), pose.translation);
        });
        is_told("written w first", &w_first);
        let axes =
            |axes: fn([f32; 3]) -> [f32; 3]| told(robot, &|_, points| points.iter_mut().for_each(|p| *p = axes(*p)));
        is_told("send points as (z, -x, -y)", &axes(|[x, y, z]| [-y, -z, x]));
        is_told("send points as (-z, -x, y)", &axes(|[x, y, z]| [-y, z, -x]));
        is_told("upside down", &axes(|[x, y, z]| [x, -y, z]));
        is_told("send them as (y, -x, z)", &axes(|[x, y, z]| [-y, x, z]));
        let thousand = |points: &mut Points| points.iter_mut().for_each(|p| *p = p.map(|x| 1000.0 * x));
        is_told("points are in millimetres and poses in metres", &told(robot, &|_, points| thousand(points)));
        let has = |what: &str, remarks: Vec<String>| {
            assert!(remarks.iter().any(|remark| remark.contains(what)), "{robot}: {what}: {remarks:?}");
        };
        let large = |pose: &mut Se3| *pose = Se3::new(pose.rotation, pose.translation * 1000.0);
        has(
            "farther than any sensor sees",
            told(robot, &|pose, points| [large(pose), thousand(points)].into_iter().collect()),
        );
        has("or, if poses are in millimetres, metres", told(robot, &|pose, _| large(pose)));
        for (unit, per_ns) in [("seconds", 1_000_000_000), ("milliseconds", 1_000_000), ("microseconds", 1_000)] {
            let sent = examination_of(robot, TEN_SUBMAPS, |keyframe| keyframe.stamp = Stamp(keyframe.stamp.0 / per_ns));
            has(&format!("as if they were in {unit}"), sent.remarks().to_vec());
        }
        has(
            "too few to be recognised",
            examination_of(robot, TEN_SUBMAPS, |keyframe| keyframe.points.truncate(20)).finish(None).remarks,
        );
    }
}

/// Submaps of one keyframe each, half a metre apart, of surfaces that have nothing in common.
fn of_noise(keyframes: usize) -> Examined {
    let recording = Recording::open(Path::new("recordings/alpha")).unwrap();
    let mut config = recording.manifest().config.clone();
    config.submap.keyframes_max = 1;
    let mut examination = Examination::new("alpha".to_owned(), config);
    let mut state = 1_u64;
    let mut draw = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / (1 << 24) as f32
    };
    let template = recording.keyframe(1).unwrap();
    for k in 0..keyframes {
        assert_eq!(examination.has_enough(), k >= 24, "{k}");
        let mut keyframe = Keyframe { stamp: Stamp(template.stamp.0 + 1_000_000_000 * k as i64), ..template.clone() };
        keyframe.pose.pose = Se3::new(So3::identity(), Vector3::new(0.5 * k as f64, 0.0, 0.0));
        keyframe.points = (0..3000).map(|_| [20.0 * draw() - 10.0, 20.0 * draw() - 10.0, 4.0 * draw() - 1.0]).collect();
        examination.take(None, keyframe);
    }
    examination.finish(None)
}

#[test]
fn as_many_submaps_are_looked_at_and_aligned_as_the_limits_say() {
    let tells = |seen: &Examined| seen.remarks.iter().any(|told| told.contains("aligns with the one after it"));
    // Of two pairs nothing is concluded, of three it is.
    for (submaps, told) in [(3, false), (4, true)] {
        let seen = of_noise(submaps);
        assert_eq!((seen.submaps, seen.aligned, tells(&seen)), (submaps, [0, submaps - 1], told), "{:?}", seen.remarks);
    }
    for (keyframes, submaps, pairs) in [(13, 13, 12), (26, 24, 12)] {
        let seen = of_noise(keyframes);
        assert_eq!((seen.submaps, seen.aligned[1]), (submaps, pairs));
    }
}

fn doctor(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_merganser")).arg("doctor").args(args).output().unwrap()
}

#[test]
fn it_ends_with_0_where_nothing_is_to_be_changed_and_with_2_of_what_cannot_be_read() {
    let good = doctor(&["recordings/alpha", "--json"]);
    let seen: Value = serde_json::from_slice(&good.stdout).unwrap();
    assert_eq!((good.status.code(), &seen[0]["keyframes"], &seen[0]["remarks"]), (Some(0), &json!(45), &json!([])));
    let all = doctor(&["recordings"]);
    assert_eq!(String::from_utf8_lossy(&all.stdout).matches("nothing to change").count(), 3, "{all:?}");
    let dir = tempfile::tempdir().unwrap();
    let empty = dir.path().display().to_string();
    for (args, why) in [
        (&[empty.as_str()][..], "nothing here can be fed to robots"),
        (&["--config", "recordings/none.toml"], "none.toml"),
        (&[], "required"),
        (&["recordings", "--config", "alpha.toml"], "cannot be used with"),
        (&["recordings", "--secs", "0"], "use 1 to 3600 s"),
    ] {
        let bad = doctor(args);
        assert!(
            bad.status.code() == Some(2) && String::from_utf8_lossy(&bad.stderr).contains(why),
            "{args:?}: {bad:?}"
        );
    }
}

/// A SLAM sends poses inverted, stamps in milliseconds, and now and then what is no keyframe.
#[tokio::test(flavor = "multi_thread")]
async fn it_listens_to_a_running_slam() {
    let dir = tempfile::tempdir().unwrap();
    let config = swarm(dir.path(), &["alpha"]).remove(0);
    let path = dir.path().join("alpha.toml");
    std::fs::write(&path, toml::to_string(&config).unwrap()).unwrap();
    let path = path.display().to_string();
    let nobody = doctor(&["--secs", "1", "--config", &path]);
    let text = String::from_utf8_lossy(&nobody.stdout);
    assert!(
        nobody.status.code() == Some(1) && text.contains("does it publish merganser/v1/test/alpha/in/keyframe?"),
        "{nobody:?}"
    );

    let listening = tokio::task::spawn_blocking(move || doctor(&["--json", "--secs", "12", "--config", &path]));
    let mut client = zenoh::Config::default();
    for (key, value) in [
        ("mode", json!("client")),
        ("connect/endpoints", json!([config.zenoh.listen[0]])),
        ("connect/timeout_ms", json!(10_000)),
        ("scouting/multicast/enabled", json!(false)),
    ] {
        client.insert_json5(key, &value.to_string()).unwrap();
    }
    let slam = zenoh::open(client).await.unwrap();
    let key = keys::of(&name("test"), &name("alpha"), "in/keyframe");
    let recording = Recording::open(Path::new("recordings/alpha")).unwrap();
    for index in (0..recording.len()).cycle().take(45) {
        let mut keyframe = recording.keyframe(index).unwrap();
        keyframe.pose.pose = keyframe.pose.pose.inverse();
        keyframe.stamp = Stamp(keyframe.stamp.0 / 1_000_000);
        let message = postcard::to_stdvec(&KeyframeMessage::from(&keyframe)).unwrap();
        let put = slam.put(&key, message).encoding("application/octet-stream");
        put.congestion_control(CongestionControl::Block).await.unwrap();
        tokio::time::sleep(Duration::from_millis(100)).await;
    }
    slam.put(&key, "no keyframe")
        .encoding("application/json")
        .congestion_control(CongestionControl::Block)
        .await
        .unwrap();
    slam.close().await.unwrap();
    let heard = listening.await.unwrap();
    let seen: Value = serde_json::from_slice(&heard.stdout).unwrap_or_else(|_| panic!("{heard:?}"));
    let remarks: Vec<&str> = seen[0]["remarks"].as_array().unwrap().iter().filter_map(Value::as_str).collect();
    assert_eq!(heard.status.code(), Some(1));
    for what in ["poses are inverted", "milliseconds", "refused 1 times"] {
        assert!(remarks.iter().any(|remark| remark.contains(what)), "{what}: {seen:#}");
    }
}

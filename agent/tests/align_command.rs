//! `merganser align`: what two clouds come to, and what is told where they come to nothing.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use merganser::recording::{Recording, cloud};
use merganser_protocol::geometry::{Se3, So3};
use merganser_recording::manifest::CloudFormat;
use nalgebra::{Matrix6, Vector3};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// One scan of a recording, as a file; and where its body truly was.
fn cloud_of(folder: &Path, index: usize, name: &str, format: CloudFormat) -> (PathBuf, Se3) {
    let recording = Recording::open(Path::new("recordings/alpha")).unwrap();
    let path = folder.join(name);
    std::fs::write(&path, cloud::encode(&recording.points(index).unwrap(), format).unwrap()).unwrap();
    (path, recording.truth().unwrap()[index].pose)
}

fn align(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_merganser")).arg("align").args(args).output().unwrap()
}

fn json(output: &Output) -> Value {
    serde_json::from_slice(&output.stdout).unwrap_or_else(|_| panic!("{output:?}"))
}

fn numbers(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|number| number.as_f64().unwrap()).collect()
}

/// `t_a_b`, and its covariance.
fn relation(value: &Value) -> (Se3, Matrix6<f64>) {
    let t = &value["found"]["t_a_b"];
    let (translation, q) = (numbers(&t["pose"]["translation"]), numbers(&t["pose"]["rotation"]));
    let q = nalgebra::UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(q[3], q[0], q[1], q[2]));
    let rotation = So3::exp(&q.scaled_axis());
    let mut covariance = Matrix6::zeros();
    let mut triangle = numbers(&t["covariance"]).into_iter();
    for (i, j) in (0..6).flat_map(|i| (i..6).map(move |j| (i, j))) {
        let value = triangle.next().unwrap();
        (covariance[(i, j)], covariance[(j, i)]) = (value, value);
    }
    (Se3::new(rotation, Vector3::from_column_slice(&translation)), covariance)
}

#[test]
fn two_scans_align_where_they_truly_lie_whatever_they_are_stored_as() {
    let dir = tempfile::tempdir().unwrap();
    let (a, t_world_a) = cloud_of(dir.path(), 6, "a.ply", CloudFormat::Ply);
    let (b, t_world_b) = cloud_of(dir.path(), 10, "b.bin", CloudFormat::KittiBin);
    let picture = dir.path().join("both.png");
    let output = align(&[a.to_str().unwrap(), b.to_str().unwrap(), "--json", "--picture", picture.to_str().unwrap()]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let told = json(&output);
    let (t_a_b, covariance) = relation(&told);
    let error = (t_world_a.inverse() * t_world_b).local(&t_a_b);
    let nees = error.dot(&(covariance.try_inverse().unwrap() * error));
    assert!(error.fixed_rows::<3>(0).norm() < 0.05 && error.fixed_rows::<3>(3).norm() < 0.02, "{error}");
    assert!(nees < 22.46, "{nees}, beyond 99.9 %");
    assert!(told["found"]["log10_nfa"].as_f64().unwrap() < -4.0 && told["aligned"] == true, "{told}");
    assert!(std::fs::read(&picture).unwrap().starts_with(b"\x89PNG"));
    // The other way round it is the inverse, and people are told the same.
    let back = align(&[b.to_str().unwrap(), a.to_str().unwrap(), "--json"]);
    let (t_b_a, _) = relation(&json(&back));
    assert!((t_a_b * t_b_a).log().norm() < 0.02, "{:?}", (t_a_b * t_b_a).log());
    let text = String::from_utf8(align(&[a.to_str().unwrap(), b.to_str().unwrap()]).stdout).unwrap();
    assert!(
        text.contains("aligned: t_a_b, which maps B into A") && text.contains("as good by chance: once in 10^"),
        "{text}"
    );
    assert!(text.contains(&format!("({:8.3},", t_a_b.translation.x)), "{text}");
}

#[test]
fn submaps_of_recordings_are_aligned_by_their_number() {
    let a = "recordings/alpha";
    let output = align(&[&format!("{a}:1"), a, "--json"]);
    let told = json(&output);
    assert_eq!(told["a"]["name"], "recordings/alpha:1");
    assert_eq!(told["voxel_m"], 0.3, "what the recording says");
    let beyond = align(&[&format!("{a}:99"), a]);
    let said = String::from_utf8(beyond.stderr.clone()).unwrap();
    assert!(beyond.status.code() == Some(2) && said.contains("there is no submap 99"), "{said}");
}

#[test]
fn what_does_not_align_is_told_with_what_was_found_and_what_to_try() {
    let dir = tempfile::tempdir().unwrap();
    let (a, _) = cloud_of(dir.path(), 6, "a.ply", CloudFormat::Ply);
    // Other surfaces: a ball.
    let ball: Vec<[f32; 3]> = (0..4000)
        .map(|k| {
            let (z, turn) = (1.0 - 2.0 * (f64::from(k) + 0.5) / 4000.0, 2.399_963 * f64::from(k));
            let r = (1.0 - z * z).sqrt();
            [2.0 * r * turn.cos(), 2.0 * r * turn.sin(), 2.0 * z].map(|c| c as f32)
        })
        .collect();
    let b = dir.path().join("ball.ply");
    std::fs::write(&b, cloud::encode(&ball, CloudFormat::Ply).unwrap()).unwrap();
    let picture = dir.path().join("both.svg");
    let args = [a.to_str().unwrap(), b.to_str().unwrap(), "--picture", picture.to_str().unwrap()];
    let output = align(&args);
    let text = String::from_utf8(output.stdout.clone()).unwrap();
    assert_eq!(output.status.code(), Some(1), "{output:?}");
    assert!(text.contains("not aligned: ") && text.contains("    try: "), "{text}");
    assert!(std::fs::read_to_string(&picture).unwrap().contains("not aligned"));
    let told = json(&align(&[&args[..2], &["--json"]].concat()));
    assert!(told["aligned"] == false && told["refused"]["why"].as_str().is_some_and(|why| why.len() > 20), "{told}");
}

/// `t_a_b`.
fn t_a_b(told: &Value) -> Se3 {
    relation(told).0
}

/// Landmarks with labels as a PLY of text, seen from a body at `t_world_body`, in units of so many metres.
fn landmarks(path: &Path, t_world_body: &Se3, unit_m: f64, labelled: bool) {
    use std::fmt::Write as _;
    let properties =
        ["cxx", "cxy", "cxz", "cyy", "cyz", "czz"].map(|name| format!("property double {name}\n")).concat();
    let mut text = format!(
        "ply\nformat ascii 1.0\nelement vertex 24\nproperty float x\nproperty float y\nproperty float z\n{properties}\
         property int label\nend_header\n"
    );
    for k in 0..24_u32 {
        let turn = 2.399_963 * f64::from(k);
        let at = Vector3::new(4.0 * turn.cos(), 3.0 * turn.sin(), f64::from(k % 5) * 0.5)
            + Vector3::new(0.3, 0.0, 0.1) * f64::from(k % 7);
        let p = (t_world_body.inverse() * at) / unit_m;
        let variance = 4e-4 / (unit_m * unit_m);
        let label = if labelled { i64::from(100 + k) } else { -1 };
        let _ = writeln!(text, "{} {} {} {variance} 0 0 {variance} 0 {variance} {label}", p.x, p.y, p.z);
    }
    std::fs::write(path, text).unwrap();
}

#[test]
fn landmarks_of_our_own_format_are_aligned_and_a_scale_is_found_where_it_is_not_known() {
    let dir = tempfile::tempdir().unwrap();
    let file = |name: &str| dir.path().join(name).to_str().unwrap().to_owned();
    let (a, b, halves, bare) = (file("a.ply"), file("b.ply"), file("halves.ply"), file("bare.ply"));
    let t_world_b = Se3::new(So3::exp(&Vector3::new(0.02, -0.03, 0.8)), Vector3::new(0.7, -0.4, 0.2));
    landmarks(a.as_ref(), &Se3::identity(), 1.0, true);
    landmarks(b.as_ref(), &t_world_b, 1.0, true);
    landmarks(halves.as_ref(), &t_world_b, 0.5, true);
    landmarks(bare.as_ref(), &t_world_b, 1.0, false);
    let aligned = |args: &[&str]| {
        let output = align(&[args, &["--json"]].concat());
        assert_eq!(output.status.code(), Some(0), "{output:?}");
        json(&output)
    };
    let told = aligned(&[&a, &b, "--sensor", "landmarks"]);
    assert!(t_world_b.local(&t_a_b(&told)).amax() < 0.01, "{told}");
    // Half metres in the other.
    let told = aligned(&[&a, &halves, "--sensor", "landmarks", "--scale", "unknown"]);
    assert!(t_world_b.local(&t_a_b(&told)).amax() < 0.01, "{told}");
    assert!((told["found"]["t_a_b"]["pose"]["scale"].as_f64().unwrap() - 0.5).abs() < 5e-3, "{told}");
    let text = align(&[&a, &halves, "--sensor", "landmarks", "--scale", "unknown"]).stdout;
    assert!(String::from_utf8(text).unwrap().contains("so much of A's unit is one of B's"));
    let wrong = json(&align(&[&a, &halves, "--sensor", "landmarks", "--json"]));
    assert_eq!(wrong["aligned"], false, "in metres they contradict each other: {wrong}");
    // Nothing by which one could be known again.
    let output = align(&[&a, &bare, "--sensor", "landmarks"]);
    let said = String::from_utf8(output.stdout).unwrap() + &String::from_utf8(output.stderr).unwrap();
    assert!(output.status.code() != Some(0) && !said.contains("panicked"), "{said}");
    // What lies in a plane tells no scale.
    let flat = align(&[&a, &b, "--sensor", "landmarks_2d", "--scale", "unknown"]);
    assert_eq!(flat.status.code(), Some(1), "{flat:?}");
}

/// A lump of some metres as a scanner sees it that looks along `towards`, each cloud in a frame whose origin is not where
/// the scanner stood.
fn lump(path: &Path, towards: Vector3<f64>, shift: f64, origin: Vector3<f64>) {
    let radius = |n: &Vector3<f64>| {
        1.0 + 0.20 * (3.0 * n.x + 1.0).sin() * (4.0 * n.y).cos()
            + 0.15 * (5.0 * n.z + 2.0 * n.x).sin()
            + 0.10 * (7.0 * n.y - 3.0 * n.z + 1.0).cos()
            + 0.06 * (9.0 * n.x - 8.0 * n.y + 2.0).sin()
            + 0.05 * (11.0 * n.z + 6.0 * n.y).sin()
    };
    let seen = (0..20_000).filter_map(|k| {
        let (z, turn) = (1.0 - 2.0 * (f64::from(k) + shift) / 20_000.0, 2.399_963_229_728_653 * f64::from(k));
        let flat = (1.0 - z * z).max(0.0).sqrt();
        let n = Vector3::new(flat * turn.cos(), flat * turn.sin(), z);
        (n.dot(&towards) > 0.1).then(|| (n * radius(&n) - origin).map(|c| c as f32).into())
    });
    std::fs::write(path, cloud::encode(&seen.collect::<Vec<[f32; 3]>>(), CloudFormat::Ply).unwrap()).unwrap();
}

#[test]
fn clouds_that_were_not_seen_from_their_origin_are_refused_with_the_cure_and_aligned_by_it() {
    let dir = tempfile::tempdir().unwrap();
    let [a, b] = ["a.ply", "b.ply"].map(|name| dir.path().join(name));
    let origins = [Vector3::new(0.0, 0.0, -3.0), Vector3::new(0.0, -3.0, 0.0)];
    lump(&a, Vector3::x(), 0.5, origins[0]);
    lump(&b, Vector3::new(0.6_f64.cos(), 0.6_f64.sin(), 0.0), 0.13, origins[1]);
    let args = [a.to_str().unwrap(), b.to_str().unwrap(), "--voxel", "0.03"];
    let output = align(&args);
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(1), "{text}");
    assert!(text.contains("contradiction") && text.contains("try: --fused"), "{text}");
    let told = json(&align(&[&args[..], &["--fused", "--json"]].concat()));
    let truth = Se3::new(So3::identity(), origins[1] - origins[0]);
    let text = String::from_utf8(align(&[&args[..], &["--fused"]].concat()).stdout).unwrap();
    assert!(text.contains("free space was not looked at"), "{text}");
    assert!(told["fused"] == true && truth.local(&t_a_b(&told)).amax() < 0.01, "{told}");
}

#[test]
fn bad_input_is_told_with_the_file_and_the_cure() {
    let dir = tempfile::tempdir().unwrap();
    let (a, _) = cloud_of(dir.path(), 6, "a.ply", CloudFormat::Ply);
    let a = a.to_str().unwrap();
    let file = |name: &str, bytes: &[u8]| {
        let path = dir.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path.to_str().unwrap().to_owned()
    };
    let (las, cut) = (file("b.las", b"LASF"), file("cut.bin", &[0; 17]));
    let one = file("one.ply", &cloud::encode(&[[1.0, 2.0, 3.0]], CloudFormat::Ply).unwrap());
    let cases: [(&[&str], &[&str]); 11] = [
        (&[a, &las], &["b.las", "--format"]),
        (&[a, &cut], &["cut.bin"]),
        (&[a, &one], &["one.ply", "no keypoints"]),
        (&[a, "nowhere.ply"], &["nowhere.ply"]),
        (&[a, a, "--sensor", "sonar"], &["points_3d, lidar_3d, laser_2d, landmarks or landmarks_2d"]),
        (&[a, a, "--sensor", "landmarks"], &["a.ply", "landmarks need the property cxx"]),
        (&[a, &cut, "--sensor", "landmarks", "--format", "xyz-bin"], &["a.ply"]),
        (&[a, a, "--scale", "2"], &["metric or unknown"]),
        (&[a, a, "--voxel", "0"], &["0.001 to 100 m"]),
        (&[a, a, "--voxel", "0.1", "--sigma-max", "5"], &["--sigma-max", "voxels"]),
        (&[a, a, "--picture", "both.jpg"], &["both.jpg", ".png or .svg"]),
    ];
    for (args, wanted) in cases {
        let output = align(args);
        let said = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{args:?}: {said}");
        assert!(wanted.iter().all(|part| said.contains(part)), "{args:?}: {said}");
    }
}

/// Two messages as a SLAM sends them, one of each with points that were aligned as clouds above.
#[test]
fn keyframes_as_messages_are_aligned_and_bad_ones_told_by_file_and_field() {
    let dir = tempfile::tempdir().unwrap();
    let recording = Recording::open(Path::new("recordings/alpha")).unwrap();
    let save = |index: usize, name: &str, change: &dyn Fn(&mut Value)| {
        let keyframe = recording.keyframe(index).unwrap();
        let mut message = serde_json::to_value(merganser::observation::KeyframeMessage::from(&keyframe)).unwrap();
        change(&mut message);
        std::fs::write(dir.path().join(name), message.to_string()).unwrap();
        dir.path().join(name).to_str().unwrap().to_owned()
    };
    let (a, b) = (save(6, "a.json", &|_| {}), save(10, "b.json", &|_| {}));
    let output = align(&[&a, &b, "--json"]);
    assert_eq!(output.status.code(), Some(0), "{output:?}");
    let truth = recording.truth().unwrap();
    let error = (truth[6].pose.inverse() * truth[10].pose).local(&relation(&json(&output)).0);
    assert!(error.fixed_rows::<3>(0).norm() < 0.05 && error.fixed_rows::<3>(3).norm() < 0.02, "{error}");
    for (name, change, why) in [
        (
            "c.json",
            (&|m: &mut Value| m["covariance"] = vec![1e-4; 36].into()) as &dyn Fn(&mut Value),
            "covariance: 21 numbers",
        ),
        ("d.json", &|m| m["points"] = Value::Array(Vec::new()), "has no points"),
    ] {
        let bad = align(&[&a, &save(6, name, change)]);
        let told = String::from_utf8_lossy(&bad.stderr).into_owned();
        assert!(bad.status.code() == Some(2) && told.contains(name) && told.contains(why), "{told}");
    }
}

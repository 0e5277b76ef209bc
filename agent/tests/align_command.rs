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
    let cases: [(&[&str], &[&str]); 8] = [
        (&[a, &las], &["b.las", "--format"]),
        (&[a, &cut], &["cut.bin"]),
        (&[a, &one], &["one.ply", "no keypoints"]),
        (&[a, "nowhere.ply"], &["nowhere.ply"]),
        (&[a, a, "--sensor", "sonar"], &["points_3d, lidar_3d or laser_2d"]),
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

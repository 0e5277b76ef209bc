//! A recording is what its format says, and the same bytes each time.

#![allow(clippy::unwrap_used, clippy::panic, reason = "the whole file is a test")]

use merganser_recording::manifest::{
    CloudFormat, FORMAT, KEYFRAMES_HEADER, Manifest, TRUTH_HEADER, VERSION, XYZ_I16_UNIT_M,
};
use merganser_sim::record::record;
use merganser_sim::scenario::Scenario;
use merganser_sim::stage::Stage;
use merganser_sim::world::trajectory::Trajectory;
use std::collections::BTreeMap;
use std::path::Path;

fn demo() -> Scenario {
    Scenario::parse(include_str!("../scenarios/three.toml")).unwrap()
}

/// Every file below a folder, by relative path.
fn files(root: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut all = BTreeMap::new();
    let mut folders = vec![root.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(root).unwrap().to_string_lossy().into_owned();
                all.insert(name, std::fs::read(&path).unwrap());
            }
        }
    }
    all
}

fn rows(text: &str, header: &str) -> Vec<Vec<String>> {
    let mut lines = text.lines();
    assert_eq!(lines.next(), Some(header));
    lines.map(|line| line.split(',').map(str::to_owned).collect()).collect()
}

#[test]
fn what_is_written_is_what_was_driven() {
    let folder = tempfile::tempdir().unwrap();
    let (scenario, seed) = (demo(), 7);
    let done = record(&scenario, None, seed, folder.path(), |_, _| {}).unwrap();
    let stage = Stage::new(&scenario, seed).unwrap();
    assert!(done.iter().map(|d| d.bytes).sum::<u64>() <= 3 << 20);
    for (robot, name) in stage.names().iter().enumerate() {
        let root = folder.path().join(name);
        let read = |file: &str| std::fs::read_to_string(root.join(file)).unwrap();
        let manifest: Manifest = toml::from_str(&read("recording.toml")).unwrap();
        assert_eq!((manifest.format.as_str(), manifest.version), (FORMAT, VERSION));
        assert_eq!((manifest.robot.as_str(), manifest.clouds), (name.as_str(), CloudFormat::XyzI16));
        assert_eq!(manifest.config, scenario.config);
        let keyframes = rows(&read("keyframes.csv"), KEYFRAMES_HEADER);
        let truth = rows(&read("truth.csv"), TRUTH_HEADER);
        let steps = stage.steps(robot);
        assert_eq!((keyframes.len(), truth.len(), manifest.keyframes), (steps.len(), steps.len(), steps.len()));
        let mut before = i64::MIN;
        for (index, step) in steps.iter().enumerate() {
            let row = &keyframes[index];
            assert_eq!((row.len(), truth[index].len(), &row[0]), (30, 8, &truth[index][0]));
            let stamp: i64 = row[0].parse().unwrap();
            assert!(stamp > before);
            before = stamp;
            let number = |text: &String| text.parse::<f64>().unwrap();
            let t = step.t_frame_body.translation;
            let w = step.t_world_body.rotation.xyzw();
            for axis in 0..3 {
                assert!((number(&row[1 + axis]) - t[axis]).abs() < 1e-9);
            }
            for (text, value) in truth[index][4..].iter().zip(w) {
                assert!((number(text) - value).abs() < 1e-9);
            }
            let c55 = step.motion.covariance.matrix()[(5, 5)];
            assert!((number(&row[28]) / c55 - 1.0).abs() < 1e-6);
            let cloud = std::fs::read(root.join(&row[29])).unwrap();
            let (points, _) = stage.scan(robot, index).unwrap();
            assert_eq!(cloud.len(), points.len() * 6);
            let units = cloud.chunks_exact(2).map(|b| f64::from(i16::from_le_bytes([b[0], b[1]])));
            for (unit, value) in units.zip(points.iter().flatten()) {
                assert!((unit * XYZ_I16_UNIT_M - f64::from(*value)).abs() <= 0.5001 * XYZ_I16_UNIT_M);
            }
        }
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes() {
    let [one, two, other] = [3, 3, 4].map(|seed| {
        let folder = tempfile::tempdir().unwrap();
        record(&demo(), None, seed, folder.path(), |_, _| {}).unwrap();
        files(folder.path())
    });
    assert_eq!(one, two);
    assert_ne!(one, other);
}

#[test]
fn a_recorded_drive_is_driven_in_a_town() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("drive.txt");
    // Round a block of 40 m and round it again.
    let corner = |k: i32| [[0, 0], [40, 0], [40, 40], [0, 40]][usize::try_from(k.rem_euclid(4)).unwrap()];
    let line = |k| format!("{k} {} {} 0 0 0 0 1\n", corner(k)[0], corner(k)[1]);
    std::fs::write(&file, (0..=8).map(line).collect::<String>()).unwrap();
    let drive = Trajectory::read(&file).unwrap();
    let mut scenario = Scenario::parse(include_str!("../scenarios/streets.toml")).unwrap();
    scenario.robots = 2;
    let mut last = (0, 0);
    let out = folder.path().join("out");
    let done = record(&scenario, Some(&drive), 5, &out, |done, all| last = (done, all)).unwrap();
    assert_eq!(last, (162, 162), "a keyframe every 2 m of 160 m each, both ends");
    for robot in &done {
        assert_eq!((robot.keyframes, robot.metres), (81, 160.0));
        assert!(robot.points > 81 * 4000, "{}", robot.points);
        let manifest: Manifest =
            toml::from_str(&std::fs::read_to_string(out.join(&robot.robot).join("recording.toml")).unwrap()).unwrap();
        assert!(manifest.origin.contains("along drive.txt, seed 5"), "{}", manifest.origin);
    }
    // The second lap is the other robot's, in the same street.
    let truth = |robot: &str| std::fs::read_to_string(out.join(robot).join("truth.csv")).unwrap();
    let place = |text: String, row: usize| -> [f64; 2] {
        let row = text.lines().nth(row + 1).unwrap().split(',').map(|v| v.parse().unwrap()).collect::<Vec<f64>>();
        [row[1], row[2]]
    };
    for row in [0, 30, 80] {
        let [a, b] = ["alpha", "beta"].map(|robot| place(truth(robot), row));
        assert!((a[0] - b[0]).hypot(a[1] - b[1]) < 1e-6, "{a:?} {b:?}");
    }
}

#[test]
fn a_folder_that_cannot_be_written_is_named() {
    let file = tempfile::NamedTempFile::new().unwrap();
    let error = record(&demo(), None, 1, file.path(), |_, _| {}).unwrap_err().to_string();
    assert!(error.contains(&*file.path().to_string_lossy()), "{error}");
}

use super::import::{Kind, detect, open_all, prepare};
use super::*;
use crate::manifest::{CloudFormat, UP_HEADER};
use merganser_protocol::config::Config;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::{CovarianceOf, Up};
use merganser_protocol::time::Stamp;
use nalgebra::Vector6;
use std::fs;
use tempfile::TempDir;

/// A small good recording.
fn write_good(folder: &Path, robot: &str) {
    let manifest = Manifest {
        format: String::new(),
        version: 0,
        robot: Name::new(robot).unwrap(),
        sensor: "none".into(),
        covariance_of: CovarianceOf::Motion,
        clouds: CloudFormat::XyzBin,
        keyframes: 0,
        origin: "a test".into(),
        unit_m: None,
        begins_ns: Some(900),
        places: None,
        config: Config::default(),
    };
    let mut writer = Writer::create(folder, manifest).unwrap();
    for i in 0..4 {
        let pose = Se3::exp(&Vector6::new(0.3 * f64::from(i), 0.0, 0.1, 0.0, 0.02, 0.7));
        let mut m = *Covariance::from_sigmas([0.1, 0.2, 0.3, 0.01, 0.02, 0.03]).unwrap().matrix();
        m[(0, 5)] = 1e-3;
        m[(5, 0)] = 1e-3;
        let pose = PoseWithCovariance { pose, covariance: Covariance::new(m).unwrap() };
        let points = vec![[1.0, 2.0, 3.0 + i as f32]; 3];
        let keyframe = Keyframe {
            stamp: Stamp(1000 + i64::from(i)),
            session: None,
            pose,
            covariance_of: CovarianceOf::Pose,
            points,
            marks: vec![],
            place: None,
            // A vertical that reads back to the bit: of length 1 without rounding.
            up: (i % 2 == 1).then(|| Up::new([0.0, 0.0, 1.0 - 2.0 * f64::from(i / 2)], 0.03).unwrap()),
        };
        writer.push(&keyframe, Some(&pose.pose.inverse())).unwrap();
    }
    for stamp in [990, 1002, 1002] {
        let (robot, position) = (Name::new("beta").unwrap(), [1.5, -0.25, stamp as f64 * 1e-3]);
        let covariance = [0.01, 1e-3, 0.0, 0.02, 0.0, 1.0];
        writer.push_position(&PositionSighting { stamp: Stamp(stamp), robot, position, covariance });
    }
    writer.finish().unwrap();
}

fn good() -> TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_good(dir.path(), "alpha");
    dir
}

fn edit(path: &Path, from: &str, to: &str) {
    let text = fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{from:?} is not in {text}");
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

/// Replaces one field of a table; line and column are counted from 0, the header being line 0.
fn set_field(path: &Path, line: usize, column: usize, value: &str) {
    let text = fs::read_to_string(path).unwrap();
    let mut lines: Vec<String> = text.lines().map(str::to_owned).collect();
    let mut fields: Vec<&str> = lines[line].split(',').collect();
    fields[column] = value;
    lines[line] = fields.join(",");
    fs::write(path, lines.join("\n") + "\n").unwrap();
}

/// The error of a good recording after `spoil`.
fn refused(spoil: impl FnOnce(&Path)) -> RecordingError {
    let dir = good();
    spoil(dir.path());
    let error = Recording::open(dir.path()).expect_err("must be refused");
    assert!(error.to_string().starts_with(dir.path().to_str().unwrap()), "{error}");
    error
}

/// Checks file, line and message of a refusal.
#[track_caller]
fn expect(error: &RecordingError, file: &str, line: Option<usize>, what: &str) {
    assert_eq!(error.path.file_name().unwrap().to_str(), Some(file), "{error}");
    assert_eq!(error.line, line, "{error}");
    assert!(error.to_string().contains(what), "{error} does not say {what:?}");
    assert!(!error.to_string().contains('\n'), "one line: {error}");
}

#[test]
fn a_written_recording_reads_back_to_the_bit() {
    let dir = good();
    let recording = Recording::open(dir.path()).unwrap();
    assert_eq!(recording.len(), 4);
    assert_eq!(recording.manifest().robot.as_str(), "alpha");
    let third = recording.keyframe(2).unwrap();
    let pose = Se3::exp(&Vector6::new(0.6, 0.0, 0.1, 0.0, 0.02, 0.7));
    assert_eq!(third.pose.pose.translation, pose.translation);
    assert!(third.pose.pose.local(&pose).norm() < 1e-15);
    assert_eq!(third.pose.covariance.matrix()[(5, 0)], 1e-3);
    assert_eq!(third.points, vec![[1.0, 2.0, 5.0]; 3]);
    assert_eq!(third.covariance_of, CovarianceOf::Pose);
    assert_eq!(recording.truth().unwrap()[3].stamp, Stamp(1003));
    assert!(recording.keyframe(4).is_err());
    let up = |index| recording.keyframe(index).unwrap().up.map(|up| (up.direction().z, up.sigma()));
    assert_eq!([0, 1, 2, 3].map(up), [None, Some((1.0, 0.03)), None, Some((-1.0, 0.03))]);
    assert_eq!(recording.begins(), Stamp(900));
    let seen: Vec<(i64, &str, f64)> =
        recording.positions().iter().map(|p| (p.stamp.0, p.robot.as_str(), p.position[2])).collect();
    assert_eq!(seen, [(990, "beta", 0.99), (1002, "beta", 1.002), (1002, "beta", 1.002)]);
    assert_eq!(recording.positions()[0].covariance, [0.01, 1e-3, 0.0, 0.02, 0.0, 1.0]);
}

#[test]
fn bad_positions_are_told() {
    let field = |column, value: &'static str| refused(move |d| set_field(&d.join(POSITIONS), 2, column, value));
    expect(&field(0, "1.5"), POSITIONS, Some(3), "stamp_ns = \"1.5\"");
    expect(&field(0, "7"), POSITIONS, Some(3), "stamp 7 does not come after 990");
    expect(&field(1, "Beta!"), POSITIONS, Some(3), "\"Beta!\" is not a name");
    expect(&field(2, "NaN"), POSITIONS, Some(3), "x is NaN");
    expect(&field(4, "1e9"), POSITIONS, Some(3), "position");
    expect(&field(10, "-1"), POSITIONS, Some(3), "covariance");
    expect(&refused(|d| edit(&d.join(POSITIONS), "robot,x", "who,x")), POSITIONS, Some(1), "the first line must be");
    let begins = |value: &'static str| refused(move |d| edit(&d.join(MANIFEST), "begins_ns = 900", value));
    expect(&begins("begins_ns = 1001"), MANIFEST, None, "begins_ns = 1001");
    expect(&begins("begins_ns = -86400000000000"), MANIFEST, None, "up to a day");
}

#[test]
fn truth_is_optional() {
    let dir = good();
    fs::remove_file(dir.path().join(TRUTH)).unwrap();
    assert!(Recording::open(dir.path()).unwrap().truth().is_none());
}

#[test]
fn missing_files_are_told() {
    expect(&refused(|d| fs::remove_file(d.join(MANIFEST)).unwrap()), MANIFEST, None, "No such file");
    expect(&refused(|d| fs::remove_file(d.join(KEYFRAMES)).unwrap()), KEYFRAMES, None, "No such file");
    let cloud = refused(|d| fs::remove_file(d.join("clouds/000002.bin")).unwrap());
    expect(&cloud, KEYFRAMES, Some(4), "cloud \"clouds/000002.bin\" is missing");
}

#[test]
fn bad_manifests_are_told() {
    let with = |from: &'static str, to: &'static str| refused(move |d| edit(&d.join(MANIFEST), from, to));
    expect(&with("version = 1", "version = 2\nnew_thing = 3"), MANIFEST, None, "version = 2 is unknown");
    expect(&with("merganser-recording", "rosbag"), MANIFEST, None, "\"rosbag\"");
    expect(&with("format = \"merganser-recording\"", ""), MANIFEST, None, "has no line format");
    expect(&with("sensor = ", "senosr = "), MANIFEST, Some(4), "senosr");
    expect(&with("clouds = \"xyz-bin\"", "clouds = \"las\""), MANIFEST, Some(6), "las");
    expect(&with("robot = \"alpha\"", "robot = \"Alpha\""), MANIFEST, Some(3), "\"Alpha\" is not a name");
    expect(&with("keyframes = 4", "keyframes = 0"), MANIFEST, None, "holds 1 to 1000000");
    expect(&with("voxel_m = 0.1", "voxel_m = -1.0"), MANIFEST, None, "config.submap.voxel_m");
    expect(&with("voxel_m = 0.1", "voxel = 0.1"), MANIFEST, Some(13), "voxel");
    expect(&with("format = ", "format == "), MANIFEST, Some(1), "");
    let latin = |d: &Path| {
        let bytes = fs::read(d.join(MANIFEST)).unwrap();
        let at = bytes.windows(6).position(|part| part == b"a test").unwrap();
        fs::write(d.join(MANIFEST), [&bytes[..at], b"caf\xe9", &bytes[at..]].concat()).unwrap();
    };
    expect(&refused(latin), MANIFEST, Some(8), "is no text; save it as UTF-8");
    let padded = |more: u64| {
        move |d: &Path| {
            let mut text = fs::read_to_string(d.join(MANIFEST)).unwrap();
            text.extend(std::iter::repeat_n('\n', (MANIFEST_BYTES_MAX + more) as usize - text.len()));
            fs::write(d.join(MANIFEST), text).unwrap();
        }
    };
    expect(&refused(padded(1)), MANIFEST, None, "MANIFEST_BYTES_MAX");
    let folder = good();
    padded(0)(folder.path());
    assert!(Recording::open(folder.path()).is_ok());
    expect(
        &with("origin = ", "unit_m = 0.5\norigin = "),
        MANIFEST,
        None,
        "unit_m is for SLAMs that do not know the metre",
    );
}

#[test]
fn a_unit_is_a_length() {
    let state = |unit: &str, d: &Path| {
        edit(&d.join(MANIFEST), "origin = ", &format!("unit_m = {unit}\norigin = "));
        edit(&d.join(MANIFEST), "scale = \"metric\"", "scale = \"unknown\"");
    };
    for good_one in ["0.001", "0.7", "1000.0"] {
        let folder = good();
        state(good_one, folder.path());
        let read = Recording::open(folder.path()).unwrap().manifest().unit_m;
        assert_eq!(read, Some(good_one.parse().unwrap()));
    }
    for bad in ["0.000999", "1000.1", "-1.0", "nan", "inf"] {
        expect(&refused(|d| state(bad, d)), MANIFEST, None, "state what one is in this recording");
    }
}

#[test]
fn wrong_counts_are_told() {
    let error = refused(|d| edit(&d.join(MANIFEST), "keyframes = 4", "keyframes = 5"));
    expect(&error, KEYFRAMES, None, "holds 4 keyframes, but recording.toml states keyframes = 5");
    let cut = |name: &'static str| {
        refused(move |d| {
            let text = fs::read_to_string(d.join(name)).unwrap();
            let lines: Vec<&str> = text.lines().take(3).collect();
            fs::write(d.join(name), lines.join("\n")).unwrap();
        })
    };
    expect(&cut(KEYFRAMES), KEYFRAMES, None, "holds 2 keyframes");
    expect(&cut(TRUTH), TRUTH, None, "holds 2 poses for 4 keyframes");
}

#[test]
fn bad_tables_are_told_with_their_line() {
    let field =
        |line, column, value: &'static str| refused(move |d| set_field(&d.join(KEYFRAMES), line, column, value));
    expect(&field(0, 1, "X"), KEYFRAMES, Some(1), "the first line must be");
    expect(&field(2, 1, "NaN"), KEYFRAMES, Some(3), "x is NaN");
    expect(&field(2, 7, "inf"), KEYFRAMES, Some(3), "qw is inf");
    expect(&field(2, 1, "1e300"), KEYFRAMES, Some(3), "beyond 1e7 m");
    expect(&field(2, 2, "1,5"), KEYFRAMES, Some(3), "31 fields instead of 30");
    expect(&field(2, 2, "one"), KEYFRAMES, Some(3), "y = \"one\" is not a number");
    expect(&field(2, 0, "1.5"), KEYFRAMES, Some(3), "stamp_ns = \"1.5\"");
    expect(&field(2, 0, "1000"), KEYFRAMES, Some(3), "stamp 1000 does not come after 1000");
    expect(&field(3, 0, "999"), KEYFRAMES, Some(4), "does not come after");
    expect(&field(1, 7, "9"), KEYFRAMES, Some(2), "the quaternion has length");
    expect(&field(1, 8, "nan"), KEYFRAMES, Some(2), "c00 is NaN");
    expect(&field(1, 8, "-1"), KEYFRAMES, Some(2), "variance outside");
    expect(&field(1, 9, "0.5"), KEYFRAMES, Some(2), "not positive definite");
    expect(&field(1, 29, "../secret"), KEYFRAMES, Some(2), "inside the recording's folder");
    expect(&field(1, 29, "/etc/passwd"), KEYFRAMES, Some(2), "inside the recording's folder");
    expect(&field(1, 29, ""), KEYFRAMES, Some(2), "inside the recording's folder");
    let truth = |column, value: &'static str| refused(move |d| set_field(&d.join(TRUTH), 2, column, value));
    expect(&truth(0, "77"), TRUTH, Some(3), "stamp 77 is not 1001");
    expect(&truth(4, "NaN"), TRUTH, Some(3), "qx is NaN");
    expect(&truth(1, "-1e9"), TRUTH, Some(3), "beyond 1e7 m");
    expect(&refused(|d| fs::write(d.join(KEYFRAMES), "").unwrap()), KEYFRAMES, Some(1), "the first line must be");
    let endless = refused(|d| fs::write(d.join(TRUTH), "x".repeat(1 << 20)).unwrap());
    expect(&endless, TRUTH, Some(1), "longer than 8192 bytes");
    let binary = refused(|d| fs::write(d.join(TRUTH), [0xff, 0xfe, b'\n']).unwrap());
    expect(&binary, TRUTH, Some(1), "UTF-8");
}

#[test]
fn axes_that_a_table_marks_as_not_measured_are_taken_as_very_uncertain() {
    for mark in ["-1", "0"] {
        let dir = good();
        for column in [19, 23, 26] {
            set_field(&dir.path().join("keyframes.csv"), 1, column, mark);
        }
        let recording = Recording::open(dir.path()).unwrap();
        let sigmas = recording.keyframes()[0].pose.covariance.sigmas();
        assert_eq!((sigmas[2], sigmas[3], sigmas[4]), (1e3, 1e3, 1e3));
        assert!(sigmas[0] < 1e3 && sigmas[5] < 1e3);
    }
}

#[test]
fn bad_clouds_are_told_when_they_are_read() {
    let dir = good();
    let recording = Recording::open(dir.path()).unwrap();
    let cloud = dir.path().join("clouds/000001.bin");
    let with = |bytes: &[u8]| {
        fs::write(&cloud, bytes).unwrap();
        recording.keyframe(1).expect_err("must be refused")
    };
    expect(&with(&[]), "000001.bin", None, "empty");
    expect(&with(&[0; 35]), "000001.bin", None, "35 bytes long where 36 are due");
    expect(&with(&f32::NAN.to_le_bytes().repeat(3)), "000001.bin", None, "point 0 ");
    expect(&with(&1e8f32.to_le_bytes().repeat(3)), "000001.bin", None, "point 0 ");
    assert_eq!(recording.check_clouds().unwrap_err().path.file_name().unwrap(), "000001.bin");
    expect(&with(&vec![0; 12 * (cloud::POINTS_MAX + 1)]), "000001.bin", None, "POINTS_MAX");
    let file = fs::File::create(&cloud).unwrap();
    file.set_len(cloud::CLOUD_BYTES_MAX + 1).unwrap();
    expect(&recording.keyframe(1).unwrap_err(), "000001.bin", None, "CLOUD_BYTES_MAX");
}

#[test]
fn what_is_odd_in_clouds_is_told_once_a_kind() {
    let dir = good();
    assert!(Recording::open(dir.path()).unwrap().check_clouds().unwrap().told().is_empty());
    let manifest = dir.path().join(MANIFEST);
    let text = fs::read_to_string(&manifest).unwrap();
    fs::write(&manifest, text.replace("\"xyz-bin\"", "\"kitti-bin\"")).unwrap();
    for k in 0..4 {
        let five = |p: i32| [p as f32, -1.0, 2.0, 30.0, p as f32].map(f32::to_le_bytes).concat();
        let fives: Vec<u8> = (0..8).flat_map(five).collect();
        fs::write(dir.path().join(format!("clouds/{k:06}.bin")), fives).unwrap();
    }
    let recording = Recording::open(dir.path()).unwrap();
    assert_eq!(recording.keyframe(2).unwrap().points[7], [7.0, -1.0, 2.0]);
    let told = recording.check_clouds().unwrap().told();
    let [told] = &told[..] else { panic!("{told:?}") };
    assert!(told.contains("000000.bin (and 3 more files): five numbers a point"), "{told}");
}

#[test]
fn a_folder_of_recordings_needs_two_robots_of_different_names() {
    let dir = tempfile::tempdir().unwrap();
    write_good(&dir.path().join("one"), "beta");
    assert!(open_all(dir.path()).unwrap_err().to_string().contains("holds 1 recordings"));
    write_good(&dir.path().join("two"), "alpha");
    let recordings = open_all(dir.path()).unwrap();
    assert_eq!(recordings[0].manifest().robot.as_str(), "alpha", "sorted by name");
    write_good(&dir.path().join("three"), "beta");
    assert!(open_all(dir.path()).unwrap_err().to_string().contains("is also that of"));
    assert_eq!(detect(dir.path()).unwrap(), Kind::Recordings);
    assert!(detect(&dir.path().join("one")).unwrap_err().to_string().contains("of one robot"));
    // Nobody is left out in silence.
    let three = dir.path().join("three");
    fs::remove_file(three.join(MANIFEST)).unwrap();
    expect(&open_all(dir.path()).unwrap_err(), MANIFEST, None, "No such file");
    fs::create_dir(three.join(MANIFEST)).unwrap();
    assert!(open_all(dir.path()).is_err());
    let empty = tempfile::tempdir().unwrap();
    assert!(detect(empty.path()).unwrap_err().to_string().contains("7-Scenes"));
    assert!(detect(&empty.path().join("nowhere")).unwrap_err().to_string().contains("No such file"));
}

#[test]
fn lidar_scans_of_both_kinds_are_cut_into_robots() {
    let points: Vec<[f32; 3]> = (0..20).map(|i| [i as f32, 1.0, 2.0]).collect();
    let (dump, kitti, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let (mut graph, mut poses) = (String::new(), String::new());
    for i in 0..5 {
        let folder = dump.path().join(format!("{i:06}"));
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join("points.bin"), cloud::encode(&points, CloudFormat::XyzBin).unwrap()).unwrap();
        graph += &format!("v{i} {i} 0 0 0 0 0 1\n");
        let scan = cloud::encode(&points, CloudFormat::KittiBin).unwrap();
        fs::write(kitti.path().join(format!("{i:06}.bin")), scan).unwrap();
        poses += &format!("1 0 0 {i} 0 1 0 0 0 0 1 0\n");
    }
    fs::write(dump.path().join("graph.txt"), graph + "e0 0 1\n").unwrap();
    fs::write(kitti.path().join("poses.txt"), &poses).unwrap();
    for folder in [dump.path(), kitti.path()] {
        assert_eq!(detect(folder).unwrap(), Kind::Lidar);
        let recordings = prepare(folder, out.path(), 1).unwrap().recordings;
        assert_eq!(recordings.iter().map(Recording::len).collect::<Vec<_>>(), [2, 3]);
        assert_eq!(recordings[1].truth().unwrap()[2].pose.translation.x, 4.0);
        assert_eq!(recordings[1].keyframe(2).unwrap().points, points);
        assert_eq!(recordings[1].keyframes()[0].pose.pose, Se3::identity(), "a frame of its own");
    }
    fs::write(kitti.path().join("poses.txt"), poses.replace("1 0 0 3", "1 0.5 0 3")).unwrap();
    let error = prepare(kitti.path(), out.path(), 1).unwrap_err();
    assert_eq!(error.line, Some(4), "{error}");
    let four: Vec<&str> = poses.lines().take(4).collect();
    fs::write(kitti.path().join("poses.txt"), four.join("\n")).unwrap();
    let error = prepare(kitti.path(), out.path(), 1).unwrap_err();
    assert!(error.to_string().contains("scan 000004 has no pose"), "{error}");
}

/// The folder of data sets, or why there is none.
fn shared(path: &str) -> Option<PathBuf> {
    let shared = std::env::var_os("MERGANSER_SHARED").map_or_else(|| PathBuf::from("../../../shared"), PathBuf::from);
    let folder = shared.join("data").join(path);
    if !folder.is_dir() {
        println!("skipped: {} is absent (set MERGANSER_SHARED)", folder.display());
        return None;
    }
    Some(folder)
}

#[test]
fn seven_scenes_become_three_robots() {
    let Some(data) = shared("rgbd_7scenes") else { return };
    let out = tempfile::tempdir().unwrap();
    let recordings = prepare(&data, out.path(), 1).unwrap().recordings;
    assert_eq!(recordings.iter().map(Recording::len).collect::<Vec<_>>(), [33, 33, 34]);
    for recording in &recordings {
        assert!(recording.manifest().origin.contains("seed 1"), "{}", recording.manifest().origin);
        for index in 0..recording.len() {
            let count = recording.keyframe(index).unwrap().points.len();
            assert!((2_000..10_000).contains(&count), "{count} points");
        }
        let truth = recording.truth().unwrap();
        let way = truth[0].pose.inverse() * truth[truth.len() - 1].pose;
        let drifted = recording.keyframes().last().unwrap().pose.pose;
        let error = way.local(&drifted).norm();
        assert!(error > 1e-3 && error < 0.5, "drift of {error}");
    }
    // Points of neighbouring frames of different robots meet in the world: poses, intrinsics and axes are right.
    let last = recordings[0].len() - 1;
    let world = |robot: usize, index: usize| -> Vec<nalgebra::Vector3<f64>> {
        let pose = recordings[robot].truth().unwrap()[index].pose;
        let points = recordings[robot].keyframe(index).unwrap().points;
        points.iter().map(|p| pose * nalgebra::Vector3::from(p.map(f64::from))).collect()
    };
    let (a, b) = (world(0, last), world(1, 0));
    let near = a.iter().step_by(50).filter(|p| b.iter().any(|q| (*p - q).norm() < 0.06)).count();
    let share = near as f64 / a.iter().step_by(50).count() as f64;
    assert!(share > 0.6, "only {share} of the points have a counterpart");
}

#[test]
fn a_lidar_dump_becomes_two_robots() {
    let Some(data) = shared("lidar_gtsam_points/kitti_07_dump") else { return };
    let out = tempfile::tempdir().unwrap();
    let recordings = prepare(&data, out.path(), 1).unwrap().recordings;
    assert_eq!(recordings.iter().map(Recording::len).collect::<Vec<_>>(), [2, 3]);
    assert!(recordings[0].keyframe(0).unwrap().points.len() > 10_000);
}

#[test]
fn real_ply_files_read() {
    let Some(data) = shared("pair_small_gicp") else { return };
    assert_eq!(cloud::read(&data.join("source.ply"), CloudFormat::Ply).unwrap().len(), 69_792);
}

#[test]
fn verticals_are_of_keyframes_in_their_order() {
    let spoilt = |line, column, value| refused(|dir| set_field(&dir.join(UPS), line, column, value));
    expect(&spoilt(1, 0, "1000000"), UPS, Some(2), "no keyframe");
    expect(&spoilt(2, 0, "1001"), UPS, Some(3), "no keyframe");
    expect(&spoilt(2, 3, "9.81"), UPS, Some(3), "length 9.81");
    expect(&spoilt(1, 4, "0.7"), UPS, Some(2), "0.7 rad");
    expect(&spoilt(1, 2, "nan"), UPS, Some(2), "y");
    expect(&spoilt(0, 4, "sigma"), UPS, Some(1), UP_HEADER);
}

//! Dumps of LiDAR SLAMs that people have: read with the poses and times that they mean, or named with the cure.

use super::dump::{Frame, missing};
use super::poses::seconds;
use crate::import::{Kind, Prepared, detect, prepare};
use crate::{Recording, RecordingError};
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::submap::SubmapBuilder;
use nalgebra::{Matrix3, Vector3};
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Scans of a data set.
const SCANS: usize = 14;

/// A vehicle that drives `apart` metres from scan to scan, up a slope and in an arc.
fn way(apart: f64) -> Vec<Se3> {
    let step = Se3::new(So3::exp(&Vector3::new(0.0, 0.002, 0.08)), Vector3::new(apart, 0.02, 0.01));
    (0..SCANS).scan(Se3::identity(), |at, _| Some(std::mem::replace(at, *at * step))).collect()
}

fn points(k: usize) -> Vec<[f32; 3]> {
    (0..60).map(|n| [5.0 + k as f32, n as f32 * 0.5 - 15.0, 0.1 * n as f32]).collect()
}

fn floats(values: impl IntoIterator<Item = f32>) -> Vec<u8> {
    values.into_iter().flat_map(f32::to_le_bytes).collect()
}

/// KITTI's scans, `every`-th of them kept, under `velodyne` or not.
fn bins(folder: &Path, every: usize) {
    fs::create_dir_all(folder).unwrap();
    for k in (0..SCANS).step_by(every) {
        let bytes = floats(points(k).iter().flat_map(|at| [at[0], at[1], at[2], 0.5]));
        fs::write(folder.join(format!("{k:06}.bin")), bytes).unwrap();
    }
}

/// Twelve numbers a line.
fn rows(poses: &[Se3]) -> String {
    poses.iter().fold(String::new(), |mut text, pose| {
        let (r, t) = (pose.rotation.matrix(), pose.translation);
        for row in 0..3 {
            let _ = write!(text, "{:e} {:e} {:e} {:e} ", r[(row, 0)], r[(row, 1)], r[(row, 2)], t[row]);
        }
        text + "\n"
    })
}

/// `key x y z qx qy qz qw`, a line each.
fn table(poses: &[Se3], key: impl Fn(usize) -> String) -> String {
    poses.iter().enumerate().fold(String::new(), |mut text, (k, pose)| {
        let ([x, y, z, w], t) = (pose.rotation.xyzw(), pose.translation);
        let _ = writeln!(text, "{} {} {} {} {x} {y} {z} {w}", key(k), t.x, t.y, t.z);
        text
    })
}

/// How KITTI's LiDAR lies to its camera.
fn t_camera_lidar() -> Se3 {
    let axes = Matrix3::new(0.0, -1.0, 0.0, 0.0, 0.0, -1.0, 1.0, 0.0, 0.0);
    Se3::new(So3::from_matrix(&axes), Vector3::new(-0.01, -0.06, -0.3))
}

fn prepared(write: impl FnOnce(&Path)) -> (Result<Prepared, RecordingError>, TempDir) {
    let (data, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    write(data.path());
    assert_eq!(detect(data.path()).unwrap(), Kind::Lidar);
    (prepare(data.path(), out.path(), 1), out)
}

/// What is told of a good one, whose truth, points and times are seen to be right.
#[track_caller]
fn good(poses: &[Se3], write: impl FnOnce(&Path)) -> (Vec<Recording>, Vec<String>) {
    let (prepared, _out) = prepared(write);
    let Prepared { recordings, remarks } = prepared.unwrap();
    let mut at = 0;
    for recording in &recordings {
        let mut builder = SubmapBuilder::new(recording.manifest().config.submap.clone());
        for (k, truth) in recording.truth().unwrap().iter().enumerate() {
            let off = (truth.pose.inverse() * poses[at]).log();
            assert!(off.norm() < 2e-5, "scan {at}: {off}");
            let keyframe = recording.keyframe(k).unwrap();
            assert!(keyframe.points[0][1] == -15.0 && keyframe.points.len() == 60, "{:?}", keyframe.points[0]);
            builder.push(keyframe).unwrap_or_else(|error| panic!("scan {at}: an agent refuses it: {error}"));
            at += 1;
        }
    }
    assert_eq!(at, poses.len());
    (recordings, remarks)
}

/// The file that a bad one names, the line, and the text.
#[track_caller]
fn bad(write: impl FnOnce(&Path)) -> (String, Option<usize>, String) {
    let error = prepared(write).0.expect_err("it was taken");
    let name = error.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    (name, error.line, error.to_string())
}

#[test]
fn kittis_poses_of_the_camera_become_the_lidars() {
    let truth = way(1.0);
    let t = t_camera_lidar();
    let of_camera: Vec<Se3> = truth.iter().map(|pose| t * *pose * t.inverse()).collect();
    let calibration = format!("P0: {}\nTr: {}", "7 ".repeat(12), rows(&[t]));
    for folder in ["", "velodyne"] {
        let (_, told) = good(&truth, |d| {
            bins(&d.join(folder), 1);
            fs::write(d.join("poses.txt"), rows(&of_camera)).unwrap();
            fs::write(d.join("calib.txt"), &calibration).unwrap();
        });
        assert!(told.len() == 1 && told[0].contains("a camera's (z forward), and were made the LiDAR's"), "{told:?}");
    }
    let camera = |calibration: Option<&'static str>| {
        let of_camera = of_camera.clone();
        move |d: &Path| {
            bins(d, 1);
            fs::write(d.join("poses.txt"), rows(&of_camera)).unwrap();
            calibration.into_iter().for_each(|text| fs::write(d.join("calib.txt"), text).unwrap());
        }
    };
    let (file, _, text) = bad(camera(None));
    assert!(file == "poses.txt" && text.contains("put the sequence's calib.txt"), "{text}");
    let (file, line, text) = bad(camera(Some("P0: 1\nTr: 1 0 0\n")));
    assert!(file == "calib.txt" && line == Some(2) && text.contains("3 fields instead of 12"), "{text}");
    let (file, _, text) = bad(camera(Some("P0: 1 2 3\n")));
    assert!(file == "calib.txt" && text.contains("no line `Tr:`"), "{text}");
    // A LiDAR's own poses stay as they are, calibrated or not; with the index first a camera's are only told.
    for (calibration, told) in [(None, 0), (Some(calibration.as_str()), 1)] {
        let (_, remarks) = good(&truth, |d| {
            bins(d, 1);
            fs::write(d.join("poses.txt"), rows(&truth)).unwrap();
            calibration.into_iter().for_each(|text| fs::write(d.join("calib.txt"), text).unwrap());
        });
        assert!(
            remarks.len() == told && remarks.iter().all(|told| told.contains("calib.txt is not used")),
            "{remarks:?}"
        );
    }
    let (_, told) = good(&of_camera, |d| {
        bins(d, 1);
        fs::write(d.join("poses.txt"), table(&of_camera, |k| k.to_string())).unwrap();
    });
    assert!(told.len() == 1 && told[0].contains("taken for the LiDAR's"), "{told:?}");
}

#[test]
fn poses_are_found_where_kittis_set_keeps_them() {
    let (truth, set) = (way(1.0), tempfile::tempdir().unwrap());
    let data = set.path().join("sequences").join("07");
    bins(&data.join("velodyne"), 1);
    fs::create_dir(set.path().join("poses")).unwrap();
    fs::write(set.path().join("poses").join("07.txt"), rows(&truth)).unwrap();
    let out = tempfile::tempdir().unwrap();
    let recordings = prepare(&data, out.path(), 1).unwrap().recordings;
    assert_eq!(recordings.iter().map(Recording::len).sum::<usize>(), SCANS);
}

#[test]
fn a_thinned_sequence_has_times_that_an_agent_takes() {
    let truth = way(1.5);
    let thin: Vec<Se3> = truth.iter().step_by(3).copied().collect();
    // Numbered as they were, of all poses; numbered anew, six metres in what would be a tenth of a second.
    let (kept, told) = good(&thin, |d| {
        bins(d, 3);
        fs::write(d.join("poses.txt"), rows(&truth)).unwrap();
    });
    assert!(told.is_empty() && kept[0].keyframes()[1].stamp.0 == 300_000_000, "{told:?}");
    let fast = way(6.0);
    let (_, told) = good(&fast, |d| {
        bins(d, 1);
        fs::write(d.join("poses.txt"), rows(&fast)).unwrap();
    });
    assert!(told.len() == 1 && told[0].contains("the time that its way takes"), "{told:?}");
    // Scans and poses were thinned alike, and only the scans kept their numbers.
    let (_, _, text) = bad(|d| {
        bins(d, 3);
        fs::write(d.join("poses.txt"), rows(&thin)).unwrap();
    });
    assert!(text.contains("scan 000006 has no pose") && text.contains("index x y z"), "{text}");
    // As many poses as scans, and another's among them: small whole numbers count scans, and no seconds.
    let (_, _, text) = bad(|d| {
        bins(d, 3);
        fs::write(d.join("poses.txt"), table(&thin, |k| k.to_string())).unwrap();
    });
    assert!(text.contains("has no pose"), "{text}");
}

/// A PCD as FAST-LIO writes its points.
fn pcd(at: &[[f32; 3]]) -> Vec<u8> {
    let head = format!(
        "# .PCD v0.7 - Point Cloud Data file format\nVERSION 0.7\nFIELDS x y z intensity normal_x normal_y normal_z \
         curvature\nSIZE 4 4 4 4 4 4 4 4\nTYPE F F F F F F F F\nCOUNT 1 1 1 1 1 1 1 1\nWIDTH {0}\nHEIGHT 1\nVIEWPOINT 0 0 0 \
         1 0 0 0\nPOINTS {0}\nDATA binary\n",
        at.len()
    );
    let point = |at: &[f32; 3]| [at[0], at[1], at[2], 17.0, 0.0, 0.0, 0.0, 52.5];
    [head.into_bytes(), floats(at.iter().flat_map(point))].concat()
}

fn pcds(folder: &Path, name: impl Fn(usize) -> String) {
    fs::create_dir_all(folder).unwrap();
    (0..SCANS).for_each(|k| fs::write(folder.join(name(k)), pcd(&points(k))).unwrap());
}

#[test]
fn a_cloud_a_frame_is_read_with_matrices_indices_or_times() {
    let truth = way(1.0);
    let numbered = |k| format!("{k:06}.pcd");
    let secs = |k: usize| format!("{}.25", 1_700_000_000 + 2 * k);
    // As pose graphs on top of FAST-LIO write them, and as TUM's tables beside them.
    for (folder, file, text) in [
        ("Scans", "optimized_poses.txt", rows(&truth)),
        ("", "poses.txt", table(&truth, |k| k.to_string())),
        ("", "poses.txt", format!("# stamp x y z qx qy qz qw\n{}", table(&truth, secs))),
    ] {
        let (recordings, told) = good(&truth, |d| {
            pcds(&d.join(folder), numbered);
            fs::write(d.join(file), &text).unwrap();
        });
        assert!(told.is_empty(), "{told:?}");
        let stamp = recordings[0].keyframes()[1].stamp.0;
        assert_eq!(stamp, if text.starts_with('#') { 1_700_000_002_250_000_000 } else { 100_000_000 });
    }
    // Scans that are named by nanoseconds.
    let (_, told) = good(&truth, |d| {
        pcds(d, |k| format!("{}.pcd", 1_561_000_444_390_857_630_u64 + 100_000_000 * k as u64));
        fs::write(d.join("poses.txt"), table(&truth, secs)).unwrap();
    });
    assert!(told.is_empty(), "{told:?}");
    let (file, _, text) = bad(|d| {
        pcds(d, numbered);
        fs::write(d.join("poses.txt"), table(&truth[1..], secs)).unwrap();
    });
    assert!(file == "poses.txt" && text.contains("13 poses by their times for 14 scans"), "{text}");
    let (file, line, text) = bad(|d| {
        pcds(d, numbered);
        fs::write(d.join("poses.txt"), table(&truth, |k| secs(k / 2))).unwrap();
    });
    assert!((file.as_str(), line) == ("poses.txt", Some(2)) && text.contains("does not come after"), "{text}");
    let (_, _, text) = bad(|d| {
        pcds(d, |k| format!("scan{k}.pcd"));
        fs::write(d.join("poses.txt"), rows(&truth)).unwrap();
    });
    assert!(text.contains("holds clouds (scan0.pcd), but none with a number"), "{text}");
    let (file, _, text) = bad(|d| {
        pcds(d, numbered);
        bins(d, 5);
    });
    assert!(text.contains("number of") && file.starts_with("0000"), "{text}");
}

#[test]
fn fast_lios_own_dump_is_named() {
    for (folder, name) in [("PCD", "scans.pcd"), ("PCD", "scans_3.pcd"), ("", "scans_1.pcd"), ("Log", "pos_log.txt")] {
        let (_, _, text) = bad(|d| {
            fs::create_dir_all(d.join(folder)).unwrap();
            fs::write(d.join(folder).join(name), pcd(&points(0))).unwrap();
        });
        assert!(text.contains("FAST-LIO") && text.contains("--cloud /cloud_registered_body"), "{name}: {text}");
    }
}

/// A dump of GLIM: a submap each, of three scans.
fn glim(data: &Path, poses: &[Se3]) {
    for (k, pose) in poses.iter().enumerate() {
        let folder = data.join(format!("{k:06}"));
        fs::create_dir(&folder).unwrap();
        let upper = rows(&[*pose]);
        let words: Vec<&str> = upper.split_whitespace().collect();
        let block: String = words.chunks(4).map(|row| format!("  {}\n", row.join("    "))).collect();
        let mut text = format!("id: {k}\nT_world_origin: \n{block}  0 0 0 1\nT_origin_endpoint_L: \n1 0 0 0\n");
        text += "num_frames: 3\n";
        for frame in 0..3 {
            let _ = write!(text, "frame_{frame}\nid: {frame}\nstamp: {}.{frame}00000000\n", 1_600_000_000 + 5 * k);
            let _ = writeln!(text, "T_world_lidar: \n{block}  0 0 0 1\nv_world_imu: 0 0 0");
        }
        fs::write(folder.join("data.txt"), text).unwrap();
        fs::write(folder.join("points_compact.bin"), floats(points(k).concat())).unwrap();
    }
    fs::write(data.join("graph.txt"), format!("num_submaps: {}\nnum_all_frames: 42\n", poses.len())).unwrap();
    fs::write(data.join("values.bin"), [7; 33]).unwrap();
}

#[test]
fn glims_submaps_are_read_at_the_time_of_their_middle_scan() {
    let truth = way(8.0);
    let (recordings, told) = good(&truth, |d| glim(d, &truth));
    assert!(told.len() == 1 && told[0].contains("GLIM's submaps"), "{told:?}");
    assert_eq!(recordings[0].keyframes()[1].stamp.0, 1_600_000_005_100_000_000);
    assert_eq!(recordings[0].manifest().config.submap.keyframes_max, 1);
    let facts = |d: &Path| d.join("000002").join("data.txt");
    let spoilt = |from: &'static str, to: &'static str| {
        let truth = truth.clone();
        bad(move |d| {
            glim(d, &truth);
            let text = fs::read_to_string(facts(d)).unwrap();
            fs::write(facts(d), text.replace(from, to)).unwrap();
        })
    };
    let (file, _, text) = spoilt("T_world_origin", "T_other");
    assert!(file == "data.txt" && text.contains("has no T_world_origin:"), "{text}");
    let (_, line, text) = spoilt("T_world_origin: \n", "T_world_origin: \n1 2 3\n");
    assert!(line == Some(3) && text.contains("3 fields instead of 4"), "{text}");
    let (_, _, text) = spoilt("stamp: ", "stamps: ");
    assert!(text.contains("has no line stamp:"), "{text}");
    let (_, line, text) = spoilt("stamp: ", "stamp: x");
    assert!(line.is_some() && text.contains("is not a number"), "{text}");
    let (file, _, text) = spoilt("stamp: 1600000010", "stamp: 1500000000");
    assert!(file == "data.txt" && text.contains("does not come after"), "{text}");
}

#[test]
fn nuscenes_scans_are_read_by_number_and_named_by_their_own_names() {
    let (_, _, text) = bad(|d| {
        let five = floats(points(0).iter().flat_map(|at| [at[0], at[1], at[2], 3.0, 1.0]));
        fs::write(d.join("n015-2018-07-24-11-22-45+0800__LIDAR_TOP__1532402927647951.pcd.bin"), five).unwrap();
    });
    assert!(text.contains("is a scan of nuScenes") && text.contains("ego_pose.json"), "{text}");
    let truth = way(1.0);
    let (_, told) = good(&truth, |d| {
        for k in 0..SCANS {
            let ring = |(n, at): (usize, &[f32; 3])| [at[0], at[1], at[2], 3.0, (n % 32) as f32];
            let five = floats(points(k).iter().enumerate().flat_map(ring));
            fs::write(d.join(format!("{k:06}.bin")), five).unwrap();
        }
        fs::write(d.join("poses.txt"), table(&truth, |k| k.to_string())).unwrap();
    });
    assert!(told.len() == 1 && told[0].contains("five numbers a point"), "{told:?}");
}

/// As a table is that a program wrote whose quaternions have w first.
fn w_first(poses: &[Se3], key: impl Fn(usize) -> String) -> String {
    poses.iter().enumerate().fold(String::new(), |mut text, (k, pose)| {
        let ([x, y, z, w], t) = (pose.rotation.xyzw(), pose.translation);
        let _ = writeln!(text, "{} {} {} {} {w} {x} {y} {z}", key(k), t.x, t.y, t.z);
        text
    })
}

/// A way of so many scans, in an arc.
fn long(scans: usize) -> Vec<Se3> {
    let step = Se3::new(So3::exp(&Vector3::new(0.0, 0.002, 0.15)), Vector3::new(1.0, 0.02, 0.01));
    (0..scans).scan(Se3::identity(), |at, _| Some(std::mem::replace(at, *at * step))).collect()
}

#[test]
fn quaternions_that_are_written_w_first_are_told_once_and_others_are_not() {
    let poses = long(30);
    let write = |table: String, name: &'static str| {
        move |d: &Path| {
            for k in 0..30 {
                let bytes = floats(points(k).iter().flat_map(|at| [at[0], at[1], at[2], 0.5]));
                fs::write(d.join(format!("{k:06}.bin")), bytes).unwrap();
            }
            fs::write(d.join(name), table).unwrap();
        }
    };
    for key in [|k: usize| k.to_string(), |k: usize| format!("{}.5", 100 + k)] {
        let (right, _out) = prepared(write(table(&poses, key), "poses.txt"));
        assert_eq!(right.unwrap().remarks, Vec::<String>::new());
        let (wrong, _out) = prepared(write(w_first(&poses, key), "optimized_poses.txt"));
        let told = wrong.unwrap().remarks;
        let order: Vec<&String> = told.iter().filter(|told| told.contains("written w first")).collect();
        assert!(
            order.len() == 1 && order[0].starts_with("optimized_poses.txt: ") && order[0].contains("put w last"),
            "{told:?}"
        );
    }
}

#[test]
fn the_times_of_a_sequence_are_read() {
    let truth = way(1.0);
    let with = |times: String, every: usize| {
        let truth = truth.clone();
        move |d: &Path| {
            bins(d, every);
            fs::write(d.join("poses.txt"), rows(&truth)).unwrap();
            fs::write(d.join("times.txt"), times).unwrap();
        }
    };
    // As KITTI writes them: uneven, with an exponent.
    let secs = |k: usize| 0.1037 * k as f64 + 1e-3 * (k % 3) as f64;
    let times: String = (0..SCANS).map(|k| format!("{:e}\n", secs(k))).collect();
    for every in [1, 2] {
        let (prepared, _out) = prepared(with(times.clone(), every));
        let mut at = (0..SCANS).step_by(every);
        for line in prepared.unwrap().recordings.iter().flat_map(|recording| recording.keyframes().to_vec()) {
            let off = line.stamp.0 as f64 * 1e-9 - secs(at.next().unwrap());
            assert!(off.abs() < 1e-8, "{off} s");
        }
        assert_eq!(at.next(), None);
    }
    let (file, line, text) = bad(with("0.0\n0.1\n0.1\n".repeat(5), 1));
    assert!(file == "times.txt" && line == Some(3), "{text}");
    let (file, line, text) = bad(with("0.0\n1e-1\nsoon\n".repeat(5), 1));
    assert!(file == "times.txt" && line == Some(3) && text.contains("soon"), "{text}");
    let (file, _, text) = bad(with("0.0\n0.1\n".into(), 1));
    assert!(
        file == "times.txt" && text.contains("no time of scan 000002") && text.contains("take times.txt away"),
        "{text}"
    );
}

#[test]
fn times_are_read_as_they_are_written() {
    for (text, nanos) in [
        ("1.036224123456789000e-01", 103_622_412),
        ("1.036224e-01", 103_622_400),
        ("1.5E+01", 15_000_000_000),
        ("1700000000.123456789", 1_700_000_000_123_456_789),
        ("-0.5", -500_000_000),
        ("7", 7_000_000_000),
    ] {
        assert_eq!(seconds(text).unwrap().0, nanos, "{text}");
    }
}

#[test]
fn a_scan_that_is_missing_between_others_is_told_and_a_thinned_sequence_is_none() {
    let truth = way(1.0);
    let told = |every: usize, without: &[usize]| {
        let (prepared, _out) = prepared(|d| {
            bins(d, every);
            fs::write(d.join("poses.txt"), rows(&truth)).unwrap();
            without.iter().for_each(|k| fs::remove_file(d.join(format!("{k:06}.bin"))).unwrap());
        });
        prepared.unwrap().remarks
    };
    assert_eq!([told(1, &[]), told(2, &[])], [vec![], Vec::<String>::new()]);
    let one = told(1, &[7]);
    assert!(one.len() == 1 && one[0].contains("1 scan is missing between the others, the first 000007"), "{one:?}");
    let more = told(1, &[3, 8, 9]);
    assert!(
        more.len() == 1 && more[0].contains("3 scans are missing between the others, the first 000003"),
        "{more:?}"
    );
    // Names that are times step unevenly.
    let numbered = |numbers: &[u64]| -> Vec<Frame> {
        let frame = |&number: &u64| Frame { number, stamp: None, pose: Se3::identity(), source: PathBuf::new() };
        numbers.iter().map(frame).collect()
    };
    assert_eq!(missing(&numbered(&[0, 100, 200, 301, 401, 501])), None);
    assert!(missing(&numbered(&[0, 100, 200, 301, 501, 601])).unwrap().starts_with("1 scan is missing"));
    let thinned = told(2, &[4]);
    assert!(
        thinned.len() == 1 && thinned[0].contains("1 scan is missing between the others, the first 000004"),
        "{thinned:?}"
    );
}

/// In a recording's own tables, too: each is named once, by `demo`, before anything is fed.
#[test]
fn tables_of_a_recording_with_w_first_are_named() {
    let poses = long(90);
    let (made, _out) = prepared(|d| {
        for k in 0..poses.len() {
            let bytes = floats(points(k % 7).iter().flat_map(|at| [at[0], at[1], at[2], 0.5]));
            fs::write(d.join(format!("{k:06}.bin")), bytes).unwrap();
        }
        fs::write(d.join("poses.txt"), table(&poses, |k| k.to_string())).unwrap();
    });
    let recording = made.unwrap().recordings.remove(0);
    let told = |recording: &Recording| recording.check_clouds().unwrap().told();
    assert_eq!(told(&recording), Vec::<String>::new());
    let folder = recording.folder();
    for name in ["keyframes.csv", "truth.csv"] {
        let text = fs::read_to_string(folder.join(name)).unwrap();
        let turned = text.lines().enumerate().map(|(number, line)| {
            let mut fields: Vec<&str> = line.split(',').collect();
            if number > 0 {
                fields[4..8].rotate_right(1);
            }
            fields.join(",") + "\n"
        });
        fs::write(folder.join(name), turned.collect::<String>()).unwrap();
        let told = told(&Recording::open(folder).unwrap());
        assert!(told.len() == 1 && told[0].contains("written w first") && told[0].contains("put w last"), "{told:?}");
        assert!(told[0].contains("keyframes.csv"), "the first that is so: {told:?}");
    }
}

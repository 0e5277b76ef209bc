//! Folders of depth images, of LiDAR scans and of a planar laser's log: good ones become robots, of bad ones the file,
//! the line and the remedy are told.

use super::Recording;
use super::error::RecordingError;
use super::import::{Kind, detect, prepare};
use merganser_protocol::submap::SubmapBuilder;
use std::fmt::Write as _;
use std::fs::{self, File};
use std::io::Write as _;
use std::path::Path;
use tempfile::TempDir;

/// Width and height of the depth images.
const SIZE: [u32; 2] = [64, 48];

/// What comes of a good folder after `spoil`, and where it lies.
fn imported(write: fn(&Path), spoil: impl FnOnce(&Path)) -> Result<(Kind, Vec<Recording>, TempDir), RecordingError> {
    let (data, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    write(data.path());
    spoil(data.path());
    let recordings = prepare(data.path(), out.path(), 1)?.recordings;
    recordings.iter().try_for_each(|recording| recording.check_clouds().map(drop))?;
    Ok((detect(data.path())?, recordings, out))
}

/// The error of a good folder after `spoil`: the file it names, the line, and the text.
fn refused(write: fn(&Path), spoil: impl FnOnce(&Path)) -> (String, Option<usize>, String) {
    let error = imported(write, spoil).expect_err("a bad folder was taken");
    let name = error.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    (name, error.line, error.to_string())
}

fn edit(path: &Path, from: &str, to: &str) {
    let text = fs::read_to_string(path).unwrap();
    assert!(text.contains(from), "{from:?} is not in {text}");
    fs::write(path, text.replacen(from, to, 1)).unwrap();
}

fn robots(recordings: &[Recording]) -> Vec<(&str, usize)> {
    recordings.iter().map(|r| (r.manifest().robot.as_str(), r.len())).collect()
}

/// A grey image of 16 bits: a wall, nearer on the left.
fn write_depth(path: &Path, [width, height]: [u32; 2], depth_mm: impl Fn(u32) -> u16) {
    let mut encoder = png::Encoder::new(File::create(path).unwrap(), width, height);
    encoder.set_color(png::ColorType::Grayscale);
    encoder.set_depth(png::BitDepth::Sixteen);
    let pixels: Vec<u8> = (0..width * height).flat_map(|k| depth_mm(k % width).to_be_bytes()).collect();
    encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
}

/// Nine depth images, a metre apart in all.
fn seven_scenes(data: &Path) {
    fs::write(data.join("camera-intrinsics.txt"), "58.5 0 32\n0 58.5 24\n0 0 1\n").unwrap();
    let mut poses = String::new();
    for k in 0..9 {
        write_depth(&data.join(format!("frame-{k:06}.depth.png")), SIZE, |u| 1000 + 10 * u as u16);
        let _ = writeln!(poses, "{k} 1 0 0 {:.3} 0 1 0 0 0 0 1 0 0 0 0 1", 0.1 * f64::from(k));
    }
    fs::write(data.join("poses_all_1000.txt"), poses).unwrap();
}

/// Fourteen scans of a few points along a street.
fn kitti(data: &Path) {
    let mut poses = String::new();
    for k in 0..14 {
        let points = (0..40).flat_map(|n| [5.0, n as f32 - 20.0, 0.1 * n as f32, 0.5]);
        let bytes: Vec<u8> = points.flat_map(f32::to_le_bytes).collect();
        fs::write(data.join(format!("{k:06}.bin")), bytes).unwrap();
        let _ = writeln!(poses, "1 0 0 {k} 0 1 0 0 0 0 1 0");
    }
    fs::write(data.join("poses.txt"), poses).unwrap();
}

/// A robot that drives straight on between two walls, a scan each 0.1 m.
fn carmen(data: &Path) {
    corridor(data, 60, 0.1);
}

/// The same with so many scans so far apart, m; stamps are 1000 s and a second for each scan.
fn corridor(data: &Path, scans: u32, apart: f64) {
    let mut log = String::from("PARAM robot_frontlaser_offset 0.0\n");
    for k in 0..scans {
        let x = apart * f64::from(k);
        let _ = write!(log, "FLASER 19");
        (0..19).for_each(|n| {
            let _ = write!(log, " {:.2}", 2.0 / (0.2 + f64::from(n) * 0.17).sin().abs().max(0.2));
        });
        let _ = writeln!(log, " {x:.2} 0 0 {x:.2} 0 0 {} robot {}", 1000 + k, 1000 + k);
    }
    fs::write(data.join("corridor.clf"), log).unwrap();
}

#[test]
fn depth_images_become_three_robots_by_thirds() {
    let (kind, recordings, _out) = imported(seven_scenes, |_| {}).unwrap();
    assert_eq!(kind, Kind::SevenScenes);
    assert_eq!(robots(&recordings), [("alpha", 3), ("beta", 3), ("gamma", 3)]);
    let points = recordings[0].keyframe(0).unwrap().points;
    assert_eq!(points.len(), 11 * 8, "every sixth pixel of every sixth row");
    // The first pixel: at 1 m, half an image to the left and above.
    let first = [-32.0 / 58.5, -24.0 / 58.5, 1.0];
    assert!(points[0].iter().zip(first).all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6), "{:?}", points[0]);
}

#[test]
fn bad_depth_images_and_cameras_are_told() {
    let camera = |text: &'static str| move |d: &Path| fs::write(d.join("camera-intrinsics.txt"), text).unwrap();
    let (file, _, text) = refused(seven_scenes, camera("58.5 0 32\n0 -58.5 24\n0 0 1\n"));
    assert!(file == "camera-intrinsics.txt" && text.contains("positive focal lengths"), "{text}");
    let (file, line, text) = refused(seven_scenes, camera("58.5 0 32\n0 nan 24\n0 0 1\n"));
    assert_eq!((file.as_str(), line), ("camera-intrinsics.txt", Some(2)), "{text}");
    let (_, line, text) = refused(seven_scenes, camera("58.5 0 32\n0 wide 24\n0 0 1\n"));
    assert!(line == Some(2) && text.contains("wide"), "{text}");
    // Of another camera, of ten times the size; of one that looks past its image.
    for other in ["5850 0 320\n0 5850 240\n0 0 1\n", "0.585 0 32\n0 0.585 24\n0 0 1\n", "58.5 0 99\n0 58.5 24\n0 0 1\n"]
    {
        let (file, _, text) = refused(seven_scenes, camera(other));
        assert!(file == "frame-000000.depth.png" && text.contains("check camera-intrinsics.txt"), "{text}");
    }
    let (file, _, text) = refused(seven_scenes, |d| fs::remove_file(d.join("camera-intrinsics.txt")).unwrap());
    assert!(file == "camera-intrinsics.txt", "{text}");

    let image = |d: &Path| d.join("frame-000004.depth.png");
    let (file, _, text) = refused(seven_scenes, |d| write_depth(&image(d), SIZE, |_| 0));
    assert!(file == "frame-000004.depth.png" && text.contains("the cloud is empty"), "{text}");
    let (_, _, text) = refused(seven_scenes, |d| fs::write(image(d), b"no image").unwrap());
    assert!(text.contains("frame-000004.depth.png"), "{text}");
    let (_, _, text) = refused(seven_scenes, |d| {
        let bytes = fs::read(image(d)).unwrap();
        fs::write(image(d), &bytes[..bytes.len() / 2]).unwrap();
    });
    assert!(text.contains("frame-000004.depth.png"), "{text}");
    let (_, _, text) = refused(seven_scenes, |d| {
        let mut encoder = png::Encoder::new(File::create(image(d)).unwrap(), 8, 8);
        encoder.set_color(png::ColorType::Rgb);
        encoder.write_header().unwrap().write_image_data(&[0; 192]).unwrap();
    });
    assert!(text.contains("16-bit grey"), "{text}");
    // A header that claims 2³⁰ pixels, of which none follow.
    let (_, _, text) = refused(seven_scenes, |d| {
        let mut encoder = png::Encoder::new(File::create(image(d)).unwrap(), 1 << 15, 1 << 15);
        encoder.set_color(png::ColorType::Grayscale);
        encoder.set_depth(png::BitDepth::Sixteen);
        encoder.write_header().unwrap().write_chunk(png::chunk::IDAT, &[]).unwrap();
    });
    assert!(text.contains("pixels"), "{text}");
}

#[test]
fn bad_camera_poses_are_told_with_their_line() {
    let poses = "poses_all_1000.txt";
    let (file, line, text) = refused(seven_scenes, |d| edit(&d.join(poses), "\n1 1 0 0", "\n1 1 0"));
    assert_eq!((file.as_str(), line), (poses, Some(2)), "{text}");
    assert!(text.contains("16 fields instead of 17"), "{text}");
    let (_, line, text) = refused(seven_scenes, |d| edit(&d.join(poses), "\n1 1 0 0", "\n1 2 0 0"));
    assert!(line == Some(2) && text.contains("not a rotation"), "{text}");
    let (_, line, text) = refused(seven_scenes, |d| edit(&d.join(poses), "\n1 1 0 0", "\n1 inf 0 0"));
    assert!(line == Some(2) && text.contains("finite"), "{text}");
    let (file, _, text) = refused(seven_scenes, |d| edit(&d.join(poses), "\n1 1 0 0", "\n77 1 0 0"));
    assert!(file == "frame-000001.depth.png" && text.contains("has no pose"), "{text}");
    let (_, _, text) = refused(seven_scenes, |d| fs::write(d.join(poses), [0xff, 0xfe, 0x00]).unwrap());
    assert!(text.contains("is no text"), "{text}");
}

#[test]
fn lidar_scans_become_three_robots_or_two() {
    let (kind, recordings, _out) = imported(kitti, |_| {}).unwrap();
    assert_eq!(kind, Kind::Lidar);
    assert_eq!(robots(&recordings), [("alpha", 4), ("beta", 5), ("gamma", 5)]);
    let (_, recordings, _out) =
        imported(kitti, |d| (10..14).for_each(|k| fs::remove_file(d.join(format!("{k:06}.bin"))).unwrap())).unwrap();
    assert_eq!(robots(&recordings), [("alpha", 5), ("beta", 5)]);
}

/// Keyframes of a SLAM, 12 m apart.
fn dump(data: &Path) {
    let mut graph = String::new();
    for k in 0..6 {
        let folder = data.join(format!("{k:06}"));
        fs::create_dir(&folder).unwrap();
        let points = (0..40).flat_map(|n| [5.0, n as f32 - 20.0, 0.1 * n as f32]);
        fs::write(folder.join("points.bin"), points.flat_map(f32::to_le_bytes).collect::<Vec<u8>>()).unwrap();
        let _ = writeln!(graph, "v{k} {} 0 0 0 0 0 1", 12 * k);
    }
    fs::write(data.join("graph.txt"), graph).unwrap();
}

#[test]
fn keyframes_of_a_dump_have_the_time_that_their_way_takes() {
    let (_, recordings, _out) = imported(dump, |_| {}).unwrap();
    assert_eq!(robots(&recordings), [("alpha", 3), ("beta", 3)]);
    for recording in &recordings {
        let mut builder = SubmapBuilder::new(recording.manifest().config.submap.clone());
        (0..recording.len()).for_each(|k| drop(builder.push(recording.keyframe(k).unwrap()).unwrap()));
    }
}

#[test]
fn bad_scans_and_their_poses_are_told() {
    let scan = |d: &Path| d.join("000003.bin");
    let (file, _, text) = refused(kitti, |d| fs::write(scan(d), [0; 17]).unwrap());
    assert!(file == "000003.bin" && text.contains("17 bytes"), "{text}");
    let (_, _, text) = refused(kitti, |d| fs::write(scan(d), []).unwrap());
    assert!(text.contains("the cloud is empty"), "{text}");
    let (_, _, text) = refused(kitti, |d| {
        let nan: Vec<u8> = [1.0, f32::NAN, 0.0, 0.0].into_iter().flat_map(f32::to_le_bytes).collect();
        fs::write(scan(d), nan).unwrap();
    });
    assert!(text.contains("not finite"), "{text}");
    let (file, line, text) = refused(kitti, |d| edit(&d.join("poses.txt"), "1 0 0 2 ", "1 0 2 "));
    assert!((file.as_str(), line) == ("poses.txt", Some(3)) && text.contains("11 fields"), "{text}");
    let (_, line, text) = refused(kitti, |d| edit(&d.join("poses.txt"), "1 0 0 2 ", "1 1 0 2 "));
    assert!(line == Some(3) && text.contains("not a rotation"), "{text}");
    let (_, _, text) = refused(kitti, |d| fs::write(d.join("poses.txt"), "1 0 0 0 0 1 0 0 0 0 1 0\n").unwrap());
    assert!(text.contains("has no pose; state it, or take the scan away"), "{text}");
    let (_, _, text) = refused(kitti, |d| fs::remove_file(d.join("poses.txt")).unwrap());
    assert!(text.contains("state the pose of each scan in poses.txt"), "{text}");
}

/// Seconds of each robot's stamps after 1000.
fn seconds(recordings: &[Recording]) -> Vec<Vec<i64>> {
    let of = |r: &Recording| r.keyframes().iter().map(|line| line.stamp.0 / 1_000_000_000 - 1000).collect();
    recordings.iter().map(of).collect()
}

#[test]
fn a_lasers_log_becomes_three_robots_that_share_no_scan() {
    let (kind, recordings, _out) = imported(|data| corridor(data, 61, 0.1), |_| {}).unwrap();
    assert_eq!(kind, Kind::Carmen);
    // Of 61 scans every third within a third and a tenth to either side: 0.3 m apart, each a keyframe.
    let expected = |from: i64, to: i64| (from..to).step_by(3).collect::<Vec<_>>();
    assert_eq!(seconds(&recordings), [expected(0, 26), expected(16, 46), expected(35, 61)]);
}

#[test]
fn of_a_log_of_few_scans_a_robot_is_given_its_whole_stretch() {
    let (_, recordings, _out) = imported(|data| corridor(data, 61, 1.0), |_| {}).unwrap();
    let [alpha, beta, gamma]: [Vec<i64>; 3] = seconds(&recordings).try_into().unwrap();
    let alternately = |from: i64, to: i64, odd: i64| (from..to).filter(move |k| k % 2 == odd).collect::<Vec<_>>();
    assert_eq!(alpha, [(0..14).collect(), alternately(14, 26, 0)].concat());
    assert_eq!(beta, [alternately(14, 26, 1), (26..34).collect(), alternately(34, 46, 0)].concat());
    assert_eq!(gamma, [alternately(34, 46, 1), (46..61).collect()].concat());
}

#[test]
fn a_log_out_of_order_is_sorted_and_that_is_told() {
    let (data, out) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    carmen(data.path());
    let prepared = prepare(data.path(), out.path(), 1).unwrap();
    assert!(prepared.remarks.is_empty(), "{:?}", prepared.remarks);
    let log = data.path().join("corridor.clf");
    let straight = fs::read_to_string(&log).unwrap();
    let mut lines: Vec<&str> = straight.lines().collect();
    lines.swap(20, 21);
    lines.push(lines[5]);
    fs::write(&log, lines.join("\n")).unwrap();
    let again = prepare(data.path(), out.path(), 1).unwrap();
    assert_eq!(seconds(&again.recordings), seconds(&prepared.recordings));
    let [late, repeated] = again.remarks.as_slice() else { panic!("{:?}", again.remarks) };
    assert!(late.starts_with("2 of 61 scans stand behind a later one"), "{late}");
    assert!(repeated.starts_with("1 of 61 scans have the stamp of one before"), "{repeated}");
    let origin = &again.recordings[0].manifest().origin;
    assert!(origin.contains("60 scans (2 late, 1 repeated)"), "{origin}");
}

#[test]
fn a_packed_log_is_the_same_log() {
    let (_, plain, _out) = imported(carmen, |_| {}).unwrap();
    let pack = |d: &Path| {
        let log = d.join("corridor.clf");
        let file = File::create(d.join("corridor.clf.xz")).unwrap();
        let mut packer = lzma_rust2::XzWriter::new(file, lzma_rust2::XzOptions::with_preset(1)).unwrap();
        packer.write_all(&fs::read(&log).unwrap()).unwrap();
        packer.finish().unwrap();
        fs::remove_file(log).unwrap();
    };
    let (kind, packed, _out) = imported(carmen, pack).unwrap();
    assert_eq!((kind, seconds(&packed)), (Kind::Carmen, seconds(&plain)));
}

#[test]
fn bad_laser_logs_are_told_with_their_line() {
    let log = |d: &Path| d.join("corridor.clf");
    let (file, line, text) = refused(carmen, |d| edit(&log(d), "FLASER 19", "FLASER 20"));
    assert_eq!((file.as_str(), line), ("corridor.clf", Some(2)), "{text}");
    let (_, line, text) = refused(carmen, |d| edit(&log(d), " 1000 robot", " inf robot"));
    assert!(line == Some(2) && text.contains("no usable number"), "{text}");
    let (_, _, text) = refused(carmen, |d| fs::write(log(d), "").unwrap());
    assert!(text.contains("holds 0 scans"), "{text}");
    let (_, _, text) = refused(carmen, |d| fs::write(log(d), [0xff, 0xfe]).unwrap());
    assert!(text.contains("is no text"), "{text}");
    let (_, _, text) = refused(carmen, |d| fs::copy(log(d), d.join("other.clf")).map(drop).unwrap());
    assert!(text.contains("one log at a time"), "{text}");
    for name in ["packed.clf.bz2", "packed.clf.xz"] {
        let (file, _, text) = refused(carmen, |d| {
            fs::remove_file(log(d)).unwrap();
            fs::write(d.join(name), b"not packed").unwrap();
        });
        assert!(file == name, "{text}");
    }
}

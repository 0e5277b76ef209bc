//! What the fuzz targets of `agent/recording/fuzz` do with bytes, shared with the test `readers`, which tries damaged files
//! on a stable compiler. Each function gives the bytes to several readers. A reader may refuse them, by one error that
//! names the file and, in text, the line; what it takes must lie within its limits and be written and read alike. It must
//! not panic, nor ask for more memory at once than the bytes and its named limits account for.
#![allow(
    dead_code,
    missing_docs,
    unused_imports,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    reason = "a failed unwrap in a test is its report"
)]

mod folder;

pub use folder::{good, manifest};

use folder::Folder;
use merganser_protocol::geometry::Se3;
use merganser_protocol::submap::{Keyframe, Mark};
use merganser_recording::depth::{DepthImage, PIXELS_MAX};
use merganser_recording::manifest::CloudFormat;
use merganser_recording::observation::{self, COORDINATE_MAX, Format, KeyframeMessage, ObservationError};
use merganser_recording::{
    KEYFRAMES, MANIFEST, PLACES, POSITIONS, Problem, Recording, RecordingError, TRUTH, UPS, carmen, cloud, import,
    mrclam,
};
use std::fs;
use std::path::Path;

/// Is told when a reader begins and ends, and how much it may ask for at once.
pub trait Meter {
    fn begin(&self) {}
    fn end(&self, _what: &str, _bytes_max: usize) {}
}

/// Measures nothing.
impl Meter for () {}

/// Formats of clouds.
pub const FORMATS: [CloudFormat; 5] =
    [CloudFormat::Ply, CloudFormat::Pcd, CloudFormat::KittiBin, CloudFormat::XyzBin, CloudFormat::XyzI16];
/// Files of a recording that are one each, and a cloud of landmarks.
pub const FILES: [&str; 7] = [KEYFRAMES, TRUTH, POSITIONS, UPS, PLACES, MANIFEST, folder::LANDMARKS];

/// What so many bytes account for: a byte of packed points may unpack to a hundred, of a type that is an eighth of a
/// double, and vectors double as they grow. A number in a head accounts for nothing.
pub fn accounted(bytes: usize) -> usize {
    (64 << 10) + 2000 * bytes
}

/// The bytes as a cloud of each format.
pub fn clouds(bytes: &[u8], meter: &impl Meter) {
    for format in FORMATS {
        cloud_of(bytes, format, meter);
    }
}

pub fn cloud_of(bytes: &[u8], format: CloudFormat, meter: &impl Meter) {
    Folder::with(|folder| {
        let path = folder.path("cloud");
        fs::write(&path, bytes).unwrap();
        meter.begin();
        let read = cloud::read_remarked(&path, format);
        meter.end("a cloud", accounted(bytes.len()));
        match read {
            Err(error) => one_error(&error, &path),
            Ok((points, _)) => {
                assert!((1..=cloud::POINTS_MAX).contains(&points.len()));
                assert!(points.iter().flatten().all(|c| f64::from(c.abs()) <= COORDINATE_MAX));
                fs::write(&path, cloud::encode(&points, CloudFormat::XyzBin).unwrap()).unwrap();
                match cloud::read(&path, CloudFormat::XyzBin) {
                    Ok(again) => assert_eq!(again, points),
                    // Rounded to single precision, what was just accurate enough may no longer be.
                    Err(error) => assert!(matches!(error.problem, Problem::Offset { .. }), "{error}"),
                }
            }
        }
    });
}

/// The bytes in place of each file of a good recording.
pub fn recording(bytes: &[u8], meter: &impl Meter) {
    for file in FILES {
        recording_with(file, bytes, meter);
    }
}

pub fn recording_with(file: &str, bytes: &[u8], meter: &impl Meter) {
    Folder::with(|folder| {
        let recording = folder.recording_with(file, bytes);
        meter.begin();
        let read = Recording::open(&recording).and_then(|opened| {
            (0..opened.len()).map(|index| opened.keyframe(index)).collect::<Result<Vec<Keyframe>, _>>()
        });
        meter.end(file, accounted(bytes.len()) + (1 << 20));
        folder.restore(file);
        match read {
            Ok(keyframes) => {
                assert!(keyframes.windows(2).all(|two| two[0].stamp < two[1].stamp));
                keyframes.iter().for_each(|keyframe| assert_near(&keyframe.pose.pose));
            }
            Err(error) => {
                // A table may be good and contradict another.
                let named = error.path.file_name().unwrap().to_string_lossy().into_owned();
                let of_whole = matches!(error.problem, Problem::Count { .. } | Problem::TruthCount { .. });
                assert!(!named.ends_with(".csv") || error.line.is_some() || of_whole, "no line in: {error}");
                assert!(!matches!(error.problem, Problem::Io(_)), "{error}");
                assert!(error.path.starts_with(&recording), "{error}");
                one_error(&error, &error.path);
            }
        }
    });
}

/// The bytes as a laser's log, plain and packed, and as each of MRCLAM's tables.
pub fn logs(bytes: &[u8], meter: &impl Meter) {
    laser_log(bytes, "log.clf", meter);
    laser_log(bytes, "log.clf.xz", meter);
    laser_log(bytes, "log.clf.bz2", meter);
    mrclam_tables(bytes, meter);
}

pub fn laser_log(bytes: &[u8], name: &str, meter: &impl Meter) {
    Folder::with(|folder| {
        let path = folder.path(name);
        fs::write(&path, bytes).unwrap();
        let unpacks = if name.ends_with(".clf") { 0 } else { cloud::UNPACKING_BYTES_MAX as usize };
        meter.begin();
        let read = import::prepare_log(&path, &folder.path("out"), 2);
        meter.end(name, accounted(bytes.len()) + unpacks);
        match read {
            Ok(prepared) => assert_eq!(prepared.recordings.len(), 2),
            Err(error) => {
                let is_of_whole = error.to_string().contains("scans (FLASER or ROBOTLASER1)");
                let is_packed = matches!(error.problem, Problem::Io(_)) && unpacks > 0;
                assert!(error.line.is_some() || is_of_whole || is_packed, "no line in: {error}");
                one_error(&error, &path);
            }
        }
        fs::remove_file(path).unwrap();
    });
    let Ok(text) = str::from_utf8(bytes) else { return };
    let mut parser = carmen::Parser::default();
    for (index, line) in text.lines().enumerate() {
        if let Err(error) = parser.line(line) {
            assert_eq!(error.line, index + 1);
        }
    }
    let log = parser.finish();
    assert!(log.scans.windows(2).all(|two| two[0].stamp < two[1].stamp));
    log.scans.iter().for_each(|scan| assert!(scan.points.iter().flatten().all(|c| c.is_finite())));
}

pub fn mrclam_tables(bytes: &[u8], meter: &impl Meter) {
    let Ok(text) = str::from_utf8(bytes) else { return };
    let lines = text.lines().count();
    let is_told = |error: mrclam::MrclamError| {
        assert!((1..=lines).contains(&error.line) && !error.to_string().contains('\n'), "{error}");
    };
    meter.begin();
    match mrclam::speeds(text) {
        Ok(all) => assert!(all.windows(2).all(|two| two[0].stamp <= two[1].stamp)),
        Err(error) => is_told(error),
    }
    match mrclam::sightings(text) {
        Ok(all) => assert!(all.iter().all(|seen| mrclam::RANGE_M.contains(&seen.range))),
        Err(error) => is_told(error),
    }
    match mrclam::subjects(text) {
        Ok(all) => assert!(all.len() <= mrclam::SUBJECTS_MAX),
        Err(error) => is_told(error),
    }
    meter.end("a table of MRCLAM", accounted(bytes.len()));
}

/// The bytes as each message, in JSON and in postcard, and as a depth image.
pub fn messages(bytes: &[u8], meter: &impl Meter) {
    for format in [Format::Json, Format::Postcard] {
        // Postcard's own vectors take a MiB at most for what a length promises.
        let most = accounted(bytes.len()) + (1 << 20) + 2 * PIXELS_MAX as usize;
        meter.begin();
        let keyframe = observation::keyframe(format, bytes);
        meter.end("a keyframe", most);
        match keyframe {
            Ok(keyframe) => check_keyframe(&keyframe),
            Err(error) => names_a_field(format, &error),
        }
        meter.begin();
        let (sighting, position) = (observation::sighting(format, bytes), observation::position(format, bytes));
        meter.end("a sighting or position", most);
        sighting.err().iter().chain(position.err().iter()).for_each(|error| names_a_field(format, error));
    }
    depth(bytes, meter);
}

/// What was taken is finite and bounded, and travels on as it is.
fn check_keyframe(keyframe: &Keyframe) {
    assert!(keyframe.points.len() <= observation::POINTS_MAX);
    assert!(keyframe.points.iter().flatten().all(|c| f64::from(c.abs()) <= COORDINATE_MAX));
    assert_near(&keyframe.pose.pose);
    let message = KeyframeMessage::from(keyframe);
    for (format, bytes) in [
        (Format::Json, serde_json::to_vec(&message).unwrap()),
        (Format::Postcard, postcard::to_stdvec(&message).unwrap()),
    ] {
        let again = observation::keyframe(format, &bytes).unwrap();
        assert_eq!((again.stamp, &again.points), (keyframe.stamp, &keyframe.points));
        assert!(are_alike(&again, keyframe), "{again:?}");
        assert_eq!((again.session, again.covariance_of), (keyframe.session, keyframe.covariance_of));
        assert_eq!((again.place.is_some(), again.up.is_some()), (keyframe.place.is_some(), keyframe.up.is_some()));
        assert!(again.pose.pose.local(&keyframe.pose.pose).amax() < 1e-6);
    }
}

/// Whether covariances and marks are the same, but for the last digit, which JSON's reader may round otherwise.
pub fn are_alike(a: &Keyframe, b: &Keyframe) -> bool {
    let near = |(x, y): (&f64, &f64)| (x - y).abs() <= 1e-15 * x.abs().max(y.abs());
    let marks = |(m, n): (&Mark, &Mark)| {
        let covariances = m.covariance.matrix().iter().zip(n.covariance.matrix().iter());
        (m.label, m.descriptor) == (n.label, n.descriptor) && covariances.into_iter().all(near)
    };
    let stated = a.pose.covariance.matrix().iter().zip(b.pose.covariance.matrix().iter());
    a.marks.len() == b.marks.len() && a.marks.iter().zip(&b.marks).all(marks) && stated.into_iter().all(near)
}

fn names_a_field(format: Format, error: &ObservationError) {
    const FIELDS: [&str; 20] = [
        "stamp_ns",
        "translation",
        "rotation",
        "covariance",
        "points",
        "landmark",
        "place",
        "depth",
        "organised",
        "session",
        "up",
        "robot",
        "position",
        "line ",
        "bytes follow",
        "postcard",
        "name",
        "vector",
        "direction",
        "this looks like JSON",
    ];
    let told = error.to_string();
    // Of a field that is none of ours, the sender's name.
    let is_named = told.contains(": every number must be finite") || FIELDS.iter().any(|field| told.contains(field));
    assert!(is_named, "{format:?}: {told}");
    assert!(!told.contains('\n'), "{told}");
}

pub fn depth(bytes: &[u8], meter: &impl Meter) {
    let most = accounted(bytes.len()) + 4 * PIXELS_MAX as usize;
    meter.begin();
    let png = DepthImage::from_png(bytes);
    let raw = bytes.split_at_checked(2).map(|(size, rest)| {
        let size = [0, 1].map(|k| u32::from(size[k]));
        (size, DepthImage::from_raw(size, rest))
    });
    meter.end("a depth image", most);
    if let Ok(image) = png {
        let [width, height] = image.size().map(u64::from);
        assert!((1..=PIXELS_MAX).contains(&(width * height)));
    }
    if let Some((size, Ok(image))) = raw {
        assert_eq!(image.size(), size);
    }
}

fn assert_near(pose: &Se3) {
    assert!(pose.translation.iter().all(|c| c.abs() <= COORDINATE_MAX), "{pose:?}");
    assert!((pose.rotation.xyzw().iter().map(|c| c * c).sum::<f64>() - 1.0).abs() < 1e-9, "{pose:?}");
}

/// One line, which begins with the file's name and says something of it.
fn one_error(error: &RecordingError, path: &Path) {
    let told = error.to_string();
    assert!(told.starts_with(&path.display().to_string()), "{} is not named in: {told}", path.display());
    assert!(!told.trim_end().contains('\n') && told.len() > path.as_os_str().len() + 10, "{told:?}");
}

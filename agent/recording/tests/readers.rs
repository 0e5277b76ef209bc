//! Whatever a file or a message holds, its reader does not panic, asks for no more memory than it may, and says what is
//! wrong by file and line or field ([`reading`] has the properties); and what we write comes back. Fuzzing looks farther
//! with the same functions (`agent/recording/fuzz`).
#![allow(missing_docs, clippy::unwrap_used, clippy::panic, reason = "a failed unwrap in a test is its report")]

mod reading;
#[path = "reading/valid.rs"]
mod valid;

use merganser_protocol::agent::io::PositionSighting;
use merganser_protocol::config::Sensor;
use merganser_protocol::geometry::{Covariance, PoseWithCovariance, Se3};
use merganser_protocol::ids::Name;
use merganser_protocol::submap::place::Metric;
use merganser_protocol::submap::{CovarianceOf, Keyframe, Mark, PlaceDescriptor, Up};
use merganser_protocol::time::Stamp;
use merganser_recording::manifest::CloudFormat;
use merganser_recording::observation::{self, Format, KeyframeMessage};
use merganser_recording::{Recording, Writer, cloud, import};
use nalgebra::Vector6;
use proptest::prelude::*;
use reading::Meter;
use std::cell::Cell;
use tracking_allocator::{AllocationGroupId, AllocationRegistry, AllocationTracker, Allocator};

#[global_allocator]
static ALLOCATOR: Allocator<std::alloc::System> = Allocator::system();

thread_local! {
    static LARGEST: Cell<usize> = const { Cell::new(0) };
}

/// Keeps the largest allocation of each thread.
struct Largest;

impl AllocationTracker for Largest {
    fn allocated(&self, _: usize, object_size: usize, _: usize, _: AllocationGroupId) {
        LARGEST.with(|largest| largest.set(largest.get().max(object_size)));
    }

    fn deallocated(&self, _: usize, _: usize, _: usize, _: AllocationGroupId, _: AllocationGroupId) {}
}

/// Fails where a reader asks for more than it may.
struct Limit;

impl Limit {
    fn new() -> Self {
        // The first thread wins; all install the same.
        let _ = AllocationRegistry::set_global_tracker(Largest);
        AllocationRegistry::enable_tracking();
        Self
    }
}

impl Meter for Limit {
    fn begin(&self) {
        LARGEST.set(0);
    }

    fn end(&self, what: &str, bytes_max: usize) {
        let largest = LARGEST.get();
        assert!(largest <= bytes_max, "the reader of {what} asked for {largest} bytes at once, {bytes_max} at most");
    }
}

/// One thing done to a file: where, as a share of its length, and what.
#[derive(Clone, Debug)]
enum Damage {
    Byte(u8),
    Cut,
    Left(usize),
    Twice(usize),
    /// The number there, or after it, becomes another.
    Number(&'static str),
    Insert(&'static [u8]),
}

/// What numbers are turned to: absurd ones, and such as overflow.
const NUMBERS: [&str; 14] = [
    "-1",
    "0",
    "1e309",
    "nan",
    "-inf",
    "4294967296",
    "18446744073709551615",
    "18446744073709551616",
    "9223372036854775807",
    "1000001",
    "1e7",
    "-1e-320",
    "",
    "0x10",
];
const INSERTED: [&[u8]; 9] =
    [b"\n", b"\r", b" ", b",", b"\xff\xfe", b"\0", b"[[[[", b"element vertex 1\nproperty list uchar int a\n", b"#"];

fn damage() -> impl Strategy<Value = (f64, Damage)> {
    let what = prop_oneof![
        any::<u8>().prop_map(Damage::Byte),
        Just(Damage::Cut),
        (1..40_usize).prop_map(Damage::Left),
        (1..40_usize).prop_map(Damage::Twice),
        prop::sample::select(&NUMBERS[..]).prop_map(Damage::Number),
        prop::sample::select(&INSERTED[..]).prop_map(Damage::Insert),
    ];
    (0.0..1.0_f64, what)
}

fn damaged(bytes: &[u8], all: &[(f64, Damage)]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    for (share, what) in all {
        if bytes.is_empty() {
            break;
        }
        let at = (share * bytes.len() as f64) as usize;
        let to = |length: usize| (at + length).min(bytes.len());
        match what {
            Damage::Byte(byte) => bytes[at] = *byte,
            Damage::Cut => bytes.truncate(at),
            Damage::Left(length) => drop(bytes.drain(at..to(*length))),
            Damage::Twice(length) => {
                let part = bytes[at..to(*length)].to_vec();
                bytes.splice(at..at, part);
            }
            Damage::Number(number) => {
                let is_of_number = |b: &u8| b.is_ascii_digit() || b"+-.eE".contains(b);
                let from = bytes[at..].iter().position(|b| b.is_ascii_digit()).map_or(bytes.len(), |found| at + found);
                let length = bytes[from..].iter().take_while(|b| is_of_number(b)).count();
                bytes.splice(from..from + length, number.bytes());
            }
            Damage::Insert(part) => drop(bytes.splice(at..at, part.iter().copied())),
        }
    }
    bytes
}

/// A valid file of a kind, damaged some times, or bytes that mean nothing.
fn bytes_of(valid: Vec<Vec<u8>>) -> impl Strategy<Value = Vec<u8>> {
    let hurt = (prop::sample::select(valid), prop::collection::vec(damage(), 0..5));
    prop_oneof![
        9 => hurt.prop_map(|(valid, all)| damaged(&valid, &all)),
        1 => prop::collection::vec(any::<u8>(), 0..400),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 1500, max_shrink_iters: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn clouds_are_read_or_refused(bytes in bytes_of(valid::clouds())) {
        reading::clouds(&bytes, &Limit::new());
    }

    #[test]
    fn messages_are_read_or_refused(bytes in bytes_of(valid::messages())) {
        reading::messages(&bytes, &Limit::new());
    }

    #[test]
    fn laser_logs_and_tables_of_mrclam_are_read_or_refused(bytes in bytes_of(valid::logs())) {
        reading::laser_log(&bytes, "log.clf", &Limit::new());
        reading::mrclam_tables(&bytes, &Limit::new());
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, max_shrink_iters: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn packed_logs_are_read_or_refused(bytes in bytes_of(valid::packed_logs())) {
        reading::laser_log(&bytes, "log.clf.xz", &Limit::new());
        reading::laser_log(&bytes, "log.clf.bz2", &Limit::new());
    }

    #[test]
    fn each_file_of_a_recording_is_read_or_refused(
        (file, bytes) in prop::sample::select(&reading::FILES[..])
            .prop_flat_map(|file| (Just(file), bytes_of(vec![reading::good(file)])))
    ) {
        reading::recording_with(file, &bytes, &Limit::new());
    }
}

#[test]
fn undamaged_files_are_taken() {
    for (k, bytes) in valid::clouds().iter().enumerate() {
        let read = |format| {
            let dir = tempfile::tempdir().unwrap();
            std::fs::write(dir.path().join("cloud"), bytes).unwrap();
            cloud::read(&dir.path().join("cloud"), format).is_ok()
        };
        assert!(reading::FORMATS.into_iter().any(read), "cloud {k}");
    }
    let keyframe = |bytes: &Vec<u8>| {
        [Format::Json, Format::Postcard].into_iter().any(|format| observation::keyframe(format, bytes).is_ok())
    };
    assert!(valid::messages().iter().filter(|bytes| keyframe(bytes)).count() >= 6);
    for (packed, name) in valid::packed_logs().iter().zip(["log.clf.xz", "log.clf.bz2"]) {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join(name), packed).unwrap();
        import::prepare_log(&dir.path().join(name), &dir.path().join("out"), 2).unwrap();
    }
    for file in reading::FILES {
        reading::recording_with(file, &reading::good(file), &());
    }
}

/// A file of some bytes must not make us take gigabytes: xz states how large a dictionary it wants.
#[test]
fn a_packed_log_that_wants_a_large_dictionary_is_refused_before_it_is_had() {
    let log = valid::logs().remove(0);
    for (dictionary, fits) in [(8 << 20, true), (64 << 20, true), (192 << 20, false), (1 << 30, false)] {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("log.clf.xz");
        std::fs::write(&path, valid::xz_that_wants(&log, dictionary)).unwrap();
        let limit = Limit::new();
        limit.begin();
        let read = import::prepare_log(&path, &dir.path().join("out"), 2);
        limit.end("a packed log", cloud::UNPACKING_BYTES_MAX as usize + (1 << 20));
        match read {
            Ok(_) => assert!(fits, "{dictionary}"),
            Err(error) => assert!(!fits && error.to_string().contains("dictionary"), "{dictionary}: {error}"),
        }
    }
}

#[test]
#[should_panic(expected = "at once")]
fn an_allocation_over_the_limit_is_seen() {
    let limit = Limit::new();
    limit.begin();
    drop(vec![1_u8; 5000]);
    limit.end("the limit", 5000);
    drop(std::hint::black_box(vec![1_u8; 5001]));
    limit.end("a byte more", 5000);
}

fn pose() -> impl Strategy<Value = Se3> {
    prop::array::uniform6(-3.0..3.0_f64).prop_map(|v| Se3::exp(&Vector6::from(v)))
}

fn covariance<const N: usize>() -> impl Strategy<Value = Covariance<N>> {
    prop::collection::vec(-4.0..1.0_f64, N)
        .prop_map(|powers| Covariance::from_sigmas(core::array::from_fn(|k| libm::pow(10.0, powers[k]))).unwrap())
}

/// Points that every format holds, in steps of 2 mm.
fn points(count: core::ops::Range<usize>) -> impl Strategy<Value = Vec<[f32; 3]>> {
    let step = (-20_000..20_000_i16).prop_map(|steps| (f64::from(steps) * 0.002) as f32);
    prop::collection::vec([step.clone(), step.clone(), step], count)
}

fn mark() -> impl Strategy<Value = Mark> {
    let label = prop::option::of(0..=i32::MAX as u32);
    let descriptor = prop::option::of(prop::array::uniform32(1..=255_u8));
    (covariance::<3>(), label, descriptor).prop_map(|(covariance, label, descriptor)| Mark {
        covariance,
        label,
        descriptor,
    })
}

/// A vertical whose length is 1 to the bit.
fn up() -> impl Strategy<Value = Up> {
    (prop::sample::select(&[-1.0, 1.0][..]), 0.001..0.5_f64)
        .prop_map(|(z, sigma)| Up::new([0.0, 0.0, z], sigma).unwrap())
}

type Drawn = (Se3, Covariance<6>, Vec<[f32; 3]>, Vec<Mark>, Option<[f32; 4]>, Option<Up>);

fn keyframes() -> impl Strategy<Value = Vec<Drawn>> {
    let place = prop::option::of(prop::array::uniform4(0.1..1.0_f32));
    let marks = prop::collection::vec(mark(), 12);
    prop::collection::vec((pose(), covariance::<6>(), points(1..12), marks, place, prop::option::of(up())), 1..5)
}

fn keyframe(k: usize, of: CovarianceOf, with_marks: bool, drawn: Drawn) -> Keyframe {
    let (pose, covariance, points, mut marks, place, up) = drawn;
    marks.truncate(if with_marks { points.len() } else { 0 });
    let place = place.map(|vector| PlaceDescriptor::new("net", Metric::Euclidean, vector.to_vec()).unwrap());
    let (stamp, pose) = (Stamp(1_700_000_000_000_000_000 + k as i64), PoseWithCovariance { pose, covariance });
    Keyframe { stamp, session: None, pose, covariance_of: of, points, marks, place, up }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 100, max_shrink_iters: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn a_recording_that_is_written_is_read_as_it_was(
        drawn in keyframes(),
        format in prop::sample::select(&[CloudFormat::Ply, CloudFormat::KittiBin, CloudFormat::XyzBin, CloudFormat::XyzI16][..]),
        is_of_landmarks: bool,
        of in prop::sample::select(&[CovarianceOf::Motion, CovarianceOf::Pose][..]),
        seen in prop::collection::vec((0..9_i64, prop::array::uniform3(-9.0..9.0_f64)), 0..4),
    ) {
        let dir = tempfile::tempdir().unwrap();
        let (format, sensor) =
            if is_of_landmarks { (CloudFormat::Ply, Sensor::Landmarks) } else { (format, Sensor::Lidar3d) };
        let sent: Vec<Keyframe> =
            drawn.into_iter().enumerate().map(|(k, drawn)| keyframe(k, of, is_of_landmarks, drawn)).collect();
        let mut manifest = reading::manifest(format, sensor);
        manifest.begins_ns = Some(sent[0].stamp.0 - 5);
        let mut writer = Writer::create(dir.path(), manifest).unwrap();
        sent.iter().for_each(|keyframe| writer.push(keyframe, Some(&keyframe.pose.pose.inverse())).unwrap());
        let mut seen: Vec<PositionSighting> = seen.into_iter().map(|(stamp, position)| PositionSighting {
            stamp: Stamp(stamp),
            robot: Name::new("beta").unwrap(),
            position,
            covariance: [0.01, 1e-3, 0.0, 0.02, 0.0, 1.0],
        }).collect();
        seen.sort_by_key(|seen| seen.stamp);
        seen.iter().for_each(|seen| writer.push_position(seen));
        writer.finish().unwrap();
        let recording = Recording::open(dir.path()).unwrap();
        prop_assert_eq!(recording.positions(), &seen[..]);
        for (k, sent) in sent.iter().enumerate() {
            let read = recording.keyframe(k).unwrap();
            prop_assert_eq!((read.stamp, read.covariance_of, &read.marks), (sent.stamp, of, &sent.marks));
            prop_assert_eq!((&read.points, &read.place), (&sent.points, &sent.place));
            prop_assert_eq!(read.up.map(|up| *up.direction()), sent.up.map(|up| *up.direction()));
            prop_assert_eq!(read.up.map(|up| up.sigma()), sent.up.map(|up| up.sigma()));
            prop_assert!(read.pose.pose.local(&sent.pose.pose).amax() < 1e-12);
            prop_assert_eq!(read.pose.covariance.matrix(), sent.pose.covariance.matrix());
            prop_assert!(recording.truth().unwrap()[k].pose.local(&sent.pose.pose.inverse()).amax() < 1e-12);
        }
    }

    #[test]
    fn a_keyframe_that_is_sent_is_read_as_it_was(drawn in keyframes(), with_marks: bool, session: Option<u64>) {
        for (k, drawn) in drawn.into_iter().enumerate() {
            let sent = Keyframe { session, ..keyframe(k, CovarianceOf::Pose, with_marks, drawn) };
            let message = KeyframeMessage::from(&sent);
            for (format, bytes) in [
                (Format::Json, serde_json::to_vec(&message).unwrap()),
                (Format::Postcard, postcard::to_stdvec(&message).unwrap()),
            ] {
                let read = observation::keyframe(format, &bytes).unwrap();
                prop_assert_eq!((read.stamp, &read.points), (sent.stamp, &sent.points));
                prop_assert_eq!((&read.place, read.session), (&sent.place, sent.session));
                prop_assert!(read.pose.pose.local(&sent.pose.pose).amax() < 1e-12);
                prop_assert!(reading::are_alike(&read, &sent), "{:?}", read);
            }
        }
    }
}

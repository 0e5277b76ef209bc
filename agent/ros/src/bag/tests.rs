//! Small bags of each kind are written and read back equal; damaged ones are read as far as they are whole, or
//! refused by name; arbitrary bytes are no danger.

use super::write::{Written, db3, mcap, ros1};
use super::{Bag, BagError, BagProblem, Flow, Topic};
use crate::wire::Serialization;
use proptest::prelude::*;
use std::fs;
use std::path::{Path, PathBuf};

/// Topic, type, time, bytes.
fn drive(cdr: bool) -> Vec<Written> {
    let message = |(k, topic, kind): (u64, &str, &str)| {
        let bytes = (0..40 + k * 3).map(|n| (n * k) as u8).collect();
        let kind = if cdr { kind.replace('/', "/msg/") } else { kind.into() };
        Written { topic: topic.into(), kind, received_ns: 1_700_000_000_000_000_000 + 7 * k as i64, bytes }
    };
    let topics = [("/odom", "nav_msgs/Odometry"), ("/scan", "sensor_msgs/LaserScan"), ("/tf", "tf2_msgs/TFMessage")];
    (0..50).map(|k| (k, topics[k as usize % 3])).map(|(k, (topic, kind))| message((k, topic, kind))).collect()
}

fn read(path: &Path) -> Result<(Bag, Vec<Written>), BagError> {
    let bag = Bag::open(path)?;
    let mut read = Vec::new();
    bag.read(
        |_| true,
        |record| {
            let Topic { name, kind, .. } = &bag.topics()[record.topic];
            read.push(Written {
                topic: name.clone(),
                kind: kind.clone(),
                received_ns: record.received_ns,
                bytes: record.bytes.to_vec(),
            });
            Flow::On
        },
    )?;
    Ok((bag, read))
}

fn plain(mut written: Vec<Written>) -> Vec<Written> {
    written.iter_mut().for_each(|message| message.kind = message.kind.replace("/msg/", "/"));
    written
}

/// Every way to store a bag.
fn kinds(folder: &Path) -> Vec<(PathBuf, bool)> {
    let path = |name: &str| folder.join(name);
    mcap(&path("none.mcap"), &drive(true), None, true, "cdr");
    mcap(&path("flat.mcap"), &drive(true), None, false, "cdr");
    mcap(&path("zstd.mcap"), &drive(true), Some(::mcap::Compression::Zstd), true, "cdr");
    mcap(&path("lz4.mcap"), &drive(true), Some(::mcap::Compression::Lz4), true, "cdr");
    mcap(&path("ros1.mcap"), &drive(false), None, true, "ros1");
    db3(&path("plain.db3"), &drive(true), false, false);
    db3(&path("defined.db3"), &drive(true), true, false);
    db3(&path("packed.db3"), &drive(true), false, true);
    for by in ["none", "bz2", "lz4"] {
        ros1(&path(&format!("{by}.bag")), &drive(false), by);
    }
    let two = ["none.mcap", "flat.mcap", "zstd.mcap", "lz4.mcap", "plain.db3", "defined.db3", "packed.db3"];
    let one = ["ros1.mcap", "none.bag", "bz2.bag", "lz4.bag"];
    let two = two.iter().map(|name| (path(name), true));
    two.chain(one.iter().map(|name| (path(name), false))).collect()
}

#[test]
fn what_is_written_is_read() {
    let folder = tempfile::tempdir().unwrap();
    for (path, cdr) in kinds(folder.path()) {
        let (bag, messages) = read(&path).unwrap();
        assert_eq!(messages, plain(drive(cdr)), "{path:?}");
        assert!(bag.damage().told().is_empty(), "{path:?}: {:?}", bag.damage());
        let counts: Vec<(&str, u64)> = bag.topics().iter().map(|topic| (topic.name.as_str(), topic.count)).collect();
        assert_eq!(counts, [("/odom", 17), ("/scan", 17), ("/tf", 16)], "{path:?}");
        let serialization = if cdr { Serialization::Cdr } else { Serialization::Ros1 };
        assert!(bag.topics().iter().all(|topic| topic.serialization == Some(serialization)));
    }
}

#[test]
fn a_topic_alone_is_read_and_reading_stops_when_told() {
    let folder = tempfile::tempdir().unwrap();
    for (path, _) in kinds(folder.path()) {
        let bag = Bag::open(&path).unwrap();
        let scan = bag.topics().iter().position(|topic| topic.name == "/scan").unwrap();
        let mut count = 0;
        let five = |_: super::Record<'_>| {
            count += 1;
            if count == 5 { Flow::Stop } else { Flow::On }
        };
        bag.read(|topic| topic == scan, five).unwrap();
        assert_eq!(count, 5, "{path:?}");
    }
}

/// What is read of a file that was cut is the beginning of what was written, and is told to be cut.
#[test]
fn a_bag_that_was_cut_is_read_as_far_as_it_is_whole() {
    let folder = tempfile::tempdir().unwrap();
    let mut most = 0;
    for (path, cdr) in kinds(folder.path()).into_iter().filter(|(path, _)| path.extension().unwrap() != "db3") {
        let whole = fs::read(&path).unwrap();
        let cut = path.with_file_name("cut").with_extension(path.extension().unwrap());
        for share in 1..20 {
            fs::write(&cut, &whole[..whole.len() * share / 20]).unwrap();
            match read(&cut) {
                Err(BagError {
                    problem: BagProblem::Damaged(..) | BagProblem::Unknown | BagProblem::Io(_), ..
                }) => {
                    assert!(share < 4, "{path:?} {share}");
                }
                Err(error) => panic!("{error}"),
                Ok((bag, messages)) => {
                    assert_eq!(messages, plain(drive(cdr))[..messages.len()], "{path:?} {share}");
                    most = most.max(messages.len() % 50);
                    // All that may be missing unseen is the index at the end.
                    assert!(messages.len() == 50 || !bag.damage().told().is_empty(), "{path:?} {share}");
                }
            }
        }
    }
    assert!(most > 25, "{most}");
}

#[test]
fn a_damaged_chunk_is_left_out_and_told() {
    let folder = tempfile::tempdir().unwrap();
    for (name, by) in [("a.bag", "bz2"), ("b.bag", "lz4")] {
        let path = folder.path().join(name);
        ros1(&path, &drive(false), by);
        let mut bytes = fs::read(&path).unwrap();
        let at = bytes.windows(4).position(|four| four == b"size").unwrap() + 60;
        bytes[at..at + 8].fill(0xa5);
        fs::write(&path, bytes).unwrap();
        let (bag, messages) = read(&path).unwrap();
        assert!(messages.len() < 50 && bag.damage().told()[0].contains("a chunk is left out"), "{:?}", bag.damage());
    }
    let path = folder.path().join("c.mcap");
    mcap(&path, &drive(true), None, true, "cdr");
    let mut bytes = fs::read(&path).unwrap();
    let at = bytes.windows(5).position(|five| five == b"/scan").unwrap();
    bytes[at] = b'!';
    fs::write(&path, bytes).unwrap();
    let (bag, messages) = read(&path).unwrap();
    assert!(messages.is_empty() && bag.damage().told()[0].contains("does not have the sum"), "{:?}", bag.damage());
}

#[test]
fn a_folder_with_metadata_is_one_bag_of_all_its_files() {
    let folder = tempfile::tempdir().unwrap();
    let parts = drive(true);
    let names: Vec<String> = (0..11).map(|k| format!("run_{k}.db3")).collect();
    let mut metadata = String::from("rosbag2_bagfile_information:\n  relative_file_paths:\n");
    for (name, part) in names.iter().zip(parts.chunks(5)) {
        db3(&folder.path().join(name), part, false, false);
        metadata += &format!("    - {name}\n");
    }
    metadata += "  duration:\n    nanoseconds: 1\n";
    fs::write(folder.path().join("metadata.yaml"), &metadata).unwrap();
    assert_eq!(super::bags_in(folder.path()).unwrap(), [folder.path()]);
    let (_, messages) = read(folder.path()).unwrap();
    assert_eq!(messages, plain(parts), "…_10 comes after …_9");
    fs::remove_file(folder.path().join("run_3.db3")).unwrap();
    let error = read(folder.path()).unwrap_err().to_string();
    assert!(error.contains("metadata.yaml names run_3.db3, which is missing"), "{error}");
    fs::write(folder.path().join("run_3.db3.zstd"), "").unwrap();
    let error = read(folder.path()).unwrap_err().to_string();
    assert!(error.contains("unpack it by `zstd -d --rm run_3.db3.zstd`"), "{error}");
}

fn told(path: &Path) -> (Vec<Written>, Vec<String>) {
    let (bag, messages) = read(path).unwrap();
    (messages, bag.damage().told())
}

/// A recorder that was killed leaves no metadata.yaml.
#[test]
fn a_split_bag_without_metadata_is_one_bag_and_told() {
    let folder = tempfile::tempdir().unwrap();
    let (parts, path) = (drive(true), |name: &str| folder.path().join(name));
    for (k, part) in parts.chunks(5).enumerate() {
        mcap(&path(&format!("run.1_{k}.mcap")), part, None, true, "cdr");
    }
    for robot in 1..3 {
        db3(&path(&format!("robot_{robot}.db3")), &parts, false, false);
    }
    let bags = super::bags_in(folder.path()).unwrap();
    assert_eq!(bags, ["robot_1.db3", "robot_2.db3", "run.1.mcap"].map(path), "parts are counted from 0 on");
    let (messages, remarks) = told(&bags[2]);
    assert_eq!(messages, plain(parts.clone()));
    assert!(remarks[0].starts_with("run.1_0.mcap to run.1_9.mcap (10 files) are taken for one bag"), "{remarks:?}");
    assert!(told(&bags[0]).1.is_empty() && told(&path("run.1_3.mcap")).1.is_empty(), "a file that is named is one bag");
    fs::remove_file(path("run.1_4.mcap")).unwrap();
    assert_eq!(super::bags_in(folder.path()).unwrap().len(), 2 + 9, "one is missing");
    assert!(read(&path("run.1.mcap")).unwrap_err().to_string().contains("No such file"));
}

#[test]
fn folders_of_bags_without_metadata_are_bags_too() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    for within in ["one", "two", "three", "other"] {
        fs::create_dir(path(within)).unwrap();
    }
    fs::write(path("one/metadata.yaml"), "  relative_file_paths:\n    - one_0.db3\n").unwrap();
    for name in ["one/one_0.db3", "two/two_0.db3", "two/two_1.db3", "three/a.db3", "three/b.db3"] {
        db3(&path(name), &drive(true), false, false);
    }
    fs::write(path("other/image.png"), "").unwrap();
    let bags = super::bags_in(folder.path()).unwrap();
    assert_eq!(bags, ["one", "three/a.db3", "three/b.db3", "two"].map(path));
    let (messages, remarks) = told(&bags[3]);
    assert!(messages.len() == 100 && remarks[0].contains("two_0.db3 to two_1.db3 (2 files)"), "{remarks:?}");
}

#[test]
fn the_files_that_metadata_names_are_read_alone_and_in_that_order() {
    let folder = tempfile::tempdir().unwrap();
    let (parts, path) = (drive(true), |name: &str| folder.path().join(name));
    for (name, part) in ["b", "a", "c"].iter().zip(parts.chunks(20)) {
        db3(&path(&format!("{name}.db3")), part, false, false);
    }
    fs::write(path("metadata.yaml"), "relative_file_paths:\n  - run/b.db3\n  - a.db3\n  - a.db3\n").unwrap();
    let (messages, remarks) = told(folder.path());
    assert_eq!(messages, plain(parts[..40].to_vec()));
    assert!(remarks.len() == 1 && remarks[0].contains("does not name 1 of the files beside it (c.db3)"), "{remarks:?}");
}

#[test]
fn a_file_that_is_packed_as_a_whole_is_a_bag_and_refused_with_the_cure() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    for (name, kind) in [("a.mcap.zstd", super::Kind::Mcap), ("b.db3.zst", super::Kind::Sqlite)] {
        fs::write(path(name), "").unwrap();
        assert_eq!(super::kind_of(&path(name)), Some(kind));
        let error = read(&path(name)).unwrap_err().to_string();
        assert!(error.contains(&format!("unpack it by `zstd -d --rm {name}`")), "{error}");
    }
    mcap(&path("a.mcap"), &drive(true), None, true, "cdr");
    assert_eq!(super::bags_in(folder.path()).unwrap(), ["a.mcap", "b.db3.zst"].map(path), "a.mcap is unpacked already");
    assert_eq!(super::kind_of(&path("a.tar.zst")), None);
}

#[test]
fn what_is_no_bag_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let refused = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        fs::write(&path, bytes).unwrap();
        read(&path).unwrap_err().to_string()
    };
    assert!(refused("a.bag", b"nothing").contains("is no bag"));
    assert!(refused("a.bag", b"#ROSBAG V1.2\n").contains("another format than 2.0"));
    assert!(refused("a.mcap", b"").contains("is no bag"));
    assert!(refused("a.db3", b"SQLite format 3\0 and then nothing").contains("SQLite"));
    let path = folder.path().join("other.db3");
    rusqlite::Connection::open(&path).unwrap().execute_batch("CREATE TABLE a (b); CREATE TABLE topics (c)").unwrap();
    let error = read(&path).unwrap_err().to_string();
    assert!(error.contains("there is no table messages"), "{error}");
    // A view that never ends.
    let path = folder.path().join("endless.db3");
    let view = "CREATE TABLE topics (id, name, type, serialization_format); CREATE VIEW messages AS WITH RECURSIVE \
                n (id) AS (SELECT 1 UNION ALL SELECT id + 1 FROM n) SELECT id, id AS topic_id, id AS timestamp FROM n";
    rusqlite::Connection::open(&path).unwrap().execute_batch(view).unwrap();
    assert!(read(&path).unwrap_err().to_string().contains("there is no table messages"));
    assert!(read(&folder.path().join("missing.bag")).unwrap_err().to_string().contains("No such file"));
    let path = folder.path().join("odd.bag");
    ros1(&path, &drive(false), "rar");
    assert!(read(&path).unwrap_err().to_string().contains("a chunk is packed by \"rar\""));
}

/// A length that a file claims is no reason to take memory: this one claims as much as may be, and has nothing.
#[test]
fn claimed_lengths_are_bounded_on_both_sides() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.bag");
    let claim = |length: u32| {
        let mut bytes = super::ros1::MAGIC.to_vec();
        bytes.extend(5_u32.to_le_bytes());
        bytes.extend(b"\x01\0\0\0=");
        bytes.extend(length.to_le_bytes());
        fs::write(&path, bytes).unwrap();
        read(&path).unwrap_err().to_string()
    };
    assert!(claim(super::CHUNK_BYTES_MAX as u32).contains("ends early"));
    assert!(claim(super::CHUNK_BYTES_MAX as u32 + 1).contains("CHUNK_BYTES_MAX"));
    // A chunk that unpacks to more than it states.
    let path = folder.path().join("b.bag");
    ros1(&path, &drive(false), "bz2");
    let mut bytes = fs::read(&path).unwrap();
    let at = bytes.windows(5).position(|five| five == b"size=").unwrap() + 5;
    bytes[at..at + 4].copy_from_slice(&10_u32.to_le_bytes());
    fs::write(&path, bytes).unwrap();
    let (bag, _) = read(&path).unwrap();
    assert!(bag.damage().told()[0].contains("does not have the 10 bytes"), "{:?}", bag.damage());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]
    /// A bag with bytes changed, or bytes that only begin as a bag: messages or a named error.
    #[test]
    fn arbitrary_bytes_do_no_harm(kind in 0..11_usize, changes in prop::collection::vec((any::<u16>(), any::<u8>()), 1..8),
                                  rest in prop::collection::vec(any::<u8>(), 0..200), fresh: bool) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bag");
        let mut bytes = SAMPLES.with(|samples| samples[kind].clone());
        if fresh {
            let head = [16, 13, 8][kind % 3].min(bytes.len());
            bytes.truncate(head);
            bytes.extend(rest);
        } else {
            let length = bytes.len();
            for (at, value) in changes {
                bytes[at as usize % length] = value;
            }
        }
        fs::write(&path, bytes).unwrap();
        if let Ok((bag, messages)) = read(&path) {
            let counted: u64 = bag.topics().iter().map(|topic| topic.count).sum();
            prop_assert!(messages.len() as u64 <= counted + 50);
        }
    }
}

thread_local! {
    static SAMPLES: Vec<Vec<u8>> = {
        let folder = tempfile::tempdir().unwrap();
        kinds(folder.path()).into_iter().map(|(path, _)| fs::read(path).unwrap()).collect()
    };
}

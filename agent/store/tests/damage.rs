//! Bits that flip at rest: what is returned is what was stored, what is missing is counted, a log that may have lost an
//! entry is closed for good, and the store works on.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "a test fails by panicking")]

mod common;

use common::{ROBOT, entry, on, owner, sorted};
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{FrameId, Hash, SubmapId};
use merganser_store::simulated::Disk;
use merganser_store::{CommitError, FileMedium, Medium, Store, StoreError, inspect};
use std::collections::BTreeSet;

const FLIPS: u64 = 1500;

fn records() -> Vec<Record> {
    let blob = |k: u8| vec![k; 900];
    let submap = |index| SubmapId { frame: FrameId { robot: ROBOT, epoch: 9 }, index };
    let entries = (0..60).map(|k| entry(k, &[k as u8; 300]));
    let blobs = (0..6).map(|k| Record::Blob { hash: Hash::of(&blob(k)), bytes: blob(k) });
    let private = (0..6).map(|k| Record::Private { submap: submap(k), bytes: vec![k as u8; 5000] });
    let refused = (0..40).map(|k| Record::Refused { i: submap(k), j: submap(k + 5), evidence: Some(u64::from(k)) });
    let session = Record::Session { epoch: 9, session: 1 << 33, over: vec![1, 2, 3] };
    entries.chain(blobs).chain(private).chain(refused).chain([session]).collect()
}

fn filled() -> Disk {
    let disk = Disk::default();
    let mut store = on(&disk).store;
    for batch in records().chunks(5) {
        store.commit(batch.iter()).unwrap();
    }
    disk
}

fn is_entry(text: &str) -> bool {
    text.starts_with("Entry")
}

#[test]
fn a_flipped_bit_is_found_and_costs_no_more_than_what_it_hit() {
    let disk = filled();
    let image = disk.picture();
    let all: BTreeSet<String> = sorted(records()).into_iter().collect();
    let (mut harmless, mut refused, mut lost_some, mut closed_logs) = (0, 0, 0, 0);
    for seed in 0..FLIPS {
        disk.restore(&image);
        assert!(disk.flip(seed));
        let opened = match Store::open(disk.clone(), owner(), 1) {
            Ok(opened) => opened,
            Err(StoreError::Damaged { .. }) => {
                refused += 1;
                continue;
            }
            Err(other) => panic!("seed {seed}: {other}"),
        };
        let (closed, held): (Vec<_>, Vec<_>) =
            sorted(opened.restored.records).into_iter().partition(|text| text.starts_with("EpochClosed"));
        let held: BTreeSet<String> = held.into_iter().collect();
        assert!(held.is_subset(&all), "seed {seed}: something that was never stored");
        let missing: Vec<&String> = all.difference(&held).collect();
        assert!(missing.is_empty() || opened.report.damaged_count > 0, "seed {seed}: {missing:?} is not told");
        // Which run of the front end the log is of may be what was lost: it must not go on, either.
        if missing.iter().any(|text| is_entry(text) || text.starts_with("Session")) {
            // Of a log that is lost as a whole, not even the epoch is known; what others know of it tells.
            let wanted = if held.iter().any(|text| is_entry(text)) { 9 } else { 1 };
            assert_eq!(
                closed,
                [format!("EpochClosed {{ epoch: {wanted} }}")],
                "seed {seed}: a log with a hole goes on"
            );
        }
        harmless += u64::from(opened.report.damaged_count == 0);
        lost_some += u64::from(!missing.is_empty());
        closed_logs += u64::from(!closed.is_empty());
        assert_eq!(opened.report.unmended, None);

        // What comes back from peers is taken, and the next start finds nothing wrong, but remembers.
        let mut store = opened.store;
        store.commit(records().iter()).unwrap();
        drop(store);
        let again = on(&disk);
        assert_eq!(again.report.damaged_count, 0, "seed {seed}: {:?}", again.report);
        let (still_closed, held): (Vec<_>, Vec<_>) =
            sorted(again.restored.records).into_iter().partition(|text| text.starts_with("EpochClosed"));
        assert_eq!((held.into_iter().collect::<BTreeSet<_>>(), still_closed), (all.clone(), closed), "seed {seed}");
    }
    println!(
        "{FLIPS} flips: {harmless} hit nothing, {lost_some} cost records, {closed_logs} closed the log, {refused} refused"
    );
    assert!(lost_some > 100 && harmless > 100 && refused < FLIPS / 50);
}

#[test]
fn looking_at_a_damaged_store_mends_nothing() {
    let disk = filled();
    let image = disk.picture();
    let seed = (0..).find(|seed| {
        disk.restore(&image);
        disk.flip(*seed) && inspect(&disk).is_ok_and(|seen| seen.damaged.iter().any(|d| d.table == "entries"))
    });
    disk.restore(&image);
    disk.flip(seed.unwrap());
    let first = inspect(&disk).unwrap();
    let second = inspect(&disk).unwrap();
    assert_eq!((first.damaged, first.damaged_count), (second.damaged, second.damaged_count));
    assert!(first.entries_lost && first.records.len() < records().len());
}

#[test]
fn without_room_to_mend_the_sound_part_is_read_and_nothing_written() {
    let disk = filled();
    let image = disk.picture();
    let mut unmended = 0;
    for seed in 0..200 {
        disk.restore(&image);
        disk.flip(seed);
        disk.with_faults(|faults| faults.full = true);
        let Ok(opened) = Store::open(disk.clone(), owner(), 1) else { continue };
        let mut store = opened.store;
        // Nothing is written into what is damaged: it may trip the database so badly that the process ends.
        let refused = store.commit(records().iter());
        assert!(matches!(refused, Err(CommitError::Full(_))), "seed {seed}: {refused:?}");
        // The disk has room again: what was refetched replaces what was damaged.
        disk.with_faults(|faults| faults.full = false);
        store.commit(records().iter()).unwrap();
        drop(store);
        unmended += usize::from(opened.report.unmended.is_some());
        let again = Store::open(disk.clone(), owner(), 1).unwrap();
        assert_eq!(again.report.damaged_count, 0, "seed {seed}");
        let held: BTreeSet<String> = sorted(again.restored.records).into_iter().collect();
        assert!(sorted(records()).iter().all(|text| held.contains(text)), "seed {seed}");
    }
    assert!(unmended > 20, "{unmended}");
}

#[test]
fn the_damaged_file_is_kept_for_whoever_wants_to_look_at_it() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let medium = FileMedium::new(&path);
    let mut store = Store::open(medium.clone(), owner(), 1).unwrap().store;
    store.commit(records().iter()).unwrap();
    drop(store);
    let mut bytes = std::fs::read(&path).unwrap();
    let at = bytes.windows(300).position(|window| window == [33; 300]).unwrap();
    bytes[at + 100] ^= 1;
    std::fs::write(&path, &bytes).unwrap();
    let opened = Store::open(medium.clone(), owner(), 1).unwrap();
    assert!(opened.report.damaged.iter().any(|damage| damage.what.ends_with(":33")), "{:?}", opened.report);
    assert_eq!(opened.restored.records.len(), records().len()); // one less, and the closing
    assert_eq!(opened.report.kept, Some(dir.path().join("s.redb.damaged-1")));
    drop(opened);
    let kept = inspect(&FileMedium::new(dir.path().join("s.redb.damaged-1"))).unwrap();
    assert!(kept.entries_lost);
    assert!(!medium.path().with_extension("redb.new").exists());
    assert_eq!(Store::open(medium, owner(), 1).unwrap().report.damaged_count, 0);
}

/// Each read and write of an opening fails once, alone and with those after it. What the disk does not give now it may
/// give later.
#[test]
fn a_disk_that_cannot_be_read_for_a_while_costs_nothing() {
    let disk = filled();
    let image = disk.picture();
    let all = sorted(records());
    let (mut refused, mut opened) = (0, 0);
    for after in 0..400 {
        for errors in [1, 5, u64::MAX] {
            disk.restore(&image);
            disk.with_faults(|faults| {
                (faults.errors_after, faults.errors, faults.reads) = (after, errors, true);
            });
            let what = format!("{errors} errors after {after} operations");
            match Store::open(disk.clone(), owner(), 1) {
                Ok(store) => {
                    opened += 1;
                    assert_eq!(
                        (store.report.damaged_count, sorted(store.restored.records)),
                        (0, all.clone()),
                        "{what}"
                    );
                }
                Err(StoreError::Failed { .. }) => refused += 1,
                Err(other) => panic!("{what}: {other}"),
            }
            disk.with_faults(|faults| faults.errors = 0);
            let again = on(&disk);
            assert_eq!((again.report.damaged_count, sorted(again.restored.records)), (0, all.clone()), "{what}");
        }
    }
    assert!(refused > 50 && opened > 50, "{refused} refused, {opened} opened");
}

/// Every bit of the database's header, and of what says whose store it is and of which schema.
#[test]
fn no_bit_of_the_header_or_of_whose_it_is_loses_anything_in_silence() {
    const HEADER: usize = 320;
    const NEAR: usize = 40;
    let disk = filled();
    let all: BTreeSet<String> = sorted(records()).into_iter().collect();
    let mut image = disk.picture();
    let bytes = image.bytes().to_vec();
    let names: [&[u8]; 4] = [b"schema", b"owner", b"fresh_epoch", b"session"];
    let named = |at: &usize| names.iter().any(|name| bytes[*at..].starts_with(name));
    let near = (0..bytes.len()).filter(named).flat_map(|at| at..(at + NEAR).min(bytes.len()));
    let places: BTreeSet<usize> = (0..HEADER).chain(near).collect();
    let (mut refused, mut mended, mut harmless) = (0, 0, 0);
    for (at, bit) in places.iter().flat_map(|at| (0..8).map(move |bit| (*at, bit))) {
        let mut hit = image.clone();
        hit.bytes()[at] ^= 1 << bit;
        disk.restore(&hit);
        let what = format!("bit {bit} of byte {at}");
        let opened = match Store::open(disk.clone(), owner(), 1) {
            Ok(opened) => opened,
            Err(StoreError::Damaged { .. }) => {
                refused += 1;
                continue;
            }
            Err(other) => panic!("{what}: {other}"),
        };
        let held: BTreeSet<String> =
            sorted(opened.restored.records).into_iter().filter(|text| !text.starts_with("EpochClosed")).collect();
        let made_up: Vec<&String> = held.difference(&all).collect();
        assert!(made_up.is_empty(), "{what}: {made_up:?} were never stored");
        let lost: Vec<&String> = all.difference(&held).collect();
        assert!(lost.is_empty() || opened.report.damaged_count > 0, "{what}: {lost:?} are gone, untold");
        // Whatever else is lost, the log must not go on; a pair is only tried again.
        let is_pair = |text: &&String| text.starts_with("Refused");
        assert!(
            lost.iter().all(is_pair) || opened.report.entries_lost,
            "{what}: {lost:?} are gone, and the log goes on"
        );
        mended += u64::from(opened.report.damaged_count > 0);
        harmless += u64::from(opened.report.damaged_count == 0);
    }
    println!("{refused} refused, {mended} mended, {harmless} harmless");
    assert!(refused > 100 && mended > 100);
}

//! What was confirmed is there after a crash, whole batches or nothing; foreign, busy and later stores are refused by
//! name, older ones migrate.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{entry, name, on, open, owner, sorted};
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, FrameId, Hash, RobotId, SubmapId};
use merganser_store::simulated::Disk;
use merganser_store::{CommitError, FileMedium, Owner, Schema, Store, StoreError, inspect};
use redb::{Database, ReadableDatabase, TableDefinition};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

const META: TableDefinition<'_, &str, &[u8]> = TableDefinition::new("meta");
const ENTRIES: TableDefinition<'_, [u8; 16], &[u8]> = TableDefinition::new("entries");
const BLOBS: TableDefinition<'_, [u8; 32], &[u8]> = TableDefinition::new("blobs");
const REFUSED: TableDefinition<'_, [u8; 32], &[u8]> = TableDefinition::new("refused");
const PRIVATE: TableDefinition<'_, [u8; 16], &[u8]> = TableDefinition::new("private");

#[test]
fn all_kinds_of_records_survive_a_restart_with_the_epoch() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let submap = SubmapId { frame: FrameId { robot: RobotId([3; 8]), epoch: 9 }, index: 4 };
    let mut records = vec![
        entry(0, b"zero"),
        entry(1, b""),
        Record::Blob { hash: Hash::of(b"blob"), bytes: b"blob".to_vec() },
        Record::Private { submap, bytes: vec![1; 100_000] },
        Record::Fork { frame: submap.frame, proof: [b"one".to_vec(), b"other".to_vec()] },
        Record::EpochClosed { epoch: 7 },
        Record::Session { epoch: 9, session: u64::MAX, over: vec![3, 1 << 40] },
        refused(4, Some(u64::MAX)),
        refused(5, Some(0)),
    ];
    let mut opened = open(&path, 77).unwrap();
    assert_eq!((opened.restored.fresh_epoch, opened.restored.records.len()), (77, 0));
    opened.store.commit(records.iter()).unwrap();
    opened.store.commit(records.iter()).unwrap(); // twice is harmless
    opened.store.commit([Record::EpochClosed { epoch: 5 }].iter()).unwrap(); // the largest counts
    let earlier = Record::Session { epoch: 8, session: 1, over: vec![] };
    opened.store.commit([earlier].iter()).unwrap(); // and the latest epoch's
    drop(opened);
    let again = open(&path, 76).unwrap();
    assert_eq!(again.restored.fresh_epoch, 77, "a clock that went back does not take the epoch with it");
    assert_eq!(sorted(again.restored.records), sorted(std::mem::take(&mut records)));
    assert_eq!(again.report, merganser_store::Report::default());
    drop(again.store);
    assert_eq!(open(&path, 99).unwrap().restored.fresh_epoch, 99);
}

/// A pair of submaps that was refused, or counts no more as such.
fn refused(index: u32, evidence: Option<u64>) -> Record {
    let submap = |robot, index| SubmapId { frame: FrameId { robot: RobotId([robot; 8]), epoch: 9 }, index };
    Record::Refused { i: submap(3, index), j: submap(5, u32::MAX), evidence }
}

#[test]
fn of_sessions_and_refusals_the_last_word_counts() {
    let disk = Disk::default();
    let mut store = on(&disk).store;
    let session = |epoch, session, over: &[u64]| Record::Session { epoch, session, over: over.to_vec() };
    store.commit([session(4, 1, &[]), refused(0, Some(1)), refused(1, Some(1)), refused(2, Some(1))].iter()).unwrap();
    store.commit([session(5, 2, &[1]), refused(1, Some(2)), refused(2, None), refused(3, None)].iter()).unwrap();
    drop(store);
    let again = on(&disk);
    let left = vec![session(5, 2, &[1]), refused(0, Some(1)), refused(1, Some(2))];
    assert_eq!(sorted(again.restored.records), sorted(left));
    assert_eq!(again.report, merganser_store::Report::default());
}

#[test]
fn an_entry_is_never_replaced_by_another() {
    let disk = Disk::default();
    let mut store = on(&disk).store;
    store.commit([entry(0, b"first")].iter()).unwrap();
    let refused = store.commit([entry(1, b"fine"), entry(0, b"second")].iter()).unwrap_err();
    assert!(matches!(refused, CommitError::Conflict(_)), "{refused}");
    store.commit([entry(1, b"other")].iter()).unwrap();
    drop(store);
    assert_eq!(sorted(on(&disk).restored.records), sorted(vec![entry(0, b"first"), entry(1, b"other")]));
}

#[test]
fn what_was_replaced_goes_in_the_commit_that_replaces_it() {
    let disk = Disk::default();
    let mut store = on(&disk).store;
    let frame = |epoch| FrameId { robot: RobotId([3; 8]), epoch };
    let at =
        |epoch, seq, bytes: &[u8]| Record::Entry { id: EntryId { frame: frame(epoch), seq }, bytes: bytes.to_vec() };
    let submap = |index| SubmapId { frame: frame(9), index };
    let private = |index| Record::Private { submap: submap(index), bytes: vec![1; 10] };
    let blob = |bytes: &[u8]| Record::Blob { hash: Hash::of(bytes), bytes: bytes.to_vec() };
    let before = [at(8, 0, b"earlier epoch"), at(9, 0, b"zero"), at(9, 1, b"one"), at(10, 0, b"later epoch")];
    store.commit(before.iter().chain(&[private(0), private(1), blob(b"gone"), blob(b"stays")])).unwrap();
    let replaced = Record::Replaced {
        below: EntryId { frame: frame(9), seq: 2 },
        submaps: vec![submap(1), submap(77)],
        blobs: vec![Hash::of(b"gone"), Hash::of(b"never was")],
    };
    store.commit([at(9, 2, b"floor"), replaced].iter()).unwrap();
    drop(store);
    let left = vec![before[0].clone(), at(9, 2, b"floor"), before[3].clone(), private(0), blob(b"stays")];
    let again = on(&disk);
    assert_eq!(sorted(again.restored.records), sorted(left));
    assert_eq!(again.report, merganser_store::Report::default());
}

#[test]
fn foreign_and_busy_stores_are_refused_with_advice() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let opened = open(&path, 1).unwrap();
    assert!(matches!(open(&path, 1), Err(StoreError::InUse(_))));
    drop(opened);
    let beta = Owner { robot: name("beta"), ..owner() };
    let other = Store::open(FileMedium::new(&path), beta, 1).unwrap_err();
    assert!(other.to_string().contains("belongs to demo/alpha, not to demo/beta"), "{other}");
    for bytes in [&b"no database at all, but some text that is long enough to be looked at"[..], &[7; 9000]] {
        std::fs::write(&path, bytes).unwrap();
        let refused = open(&path, 1).unwrap_err();
        assert!(matches!(refused, StoreError::NotAStore { .. }), "{refused}");
        assert_eq!(std::fs::read(&path).unwrap(), bytes, "somebody else's file is left alone");
    }
    let refused = open(&dir.path().join("none/s.redb"), 1).unwrap_err();
    assert!(matches!(refused, StoreError::Failed { .. }), "{refused}");
}

#[test]
fn a_later_schema_is_refused_and_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    drop(open(&path, 1).unwrap());
    for (schema, says) in [([7, 0, 0, 0], "has schema 7"), ([8, 0, 0, 0], "has schema 8")] {
        let db = Database::open(&path).unwrap();
        let write = db.begin_write().unwrap();
        write.open_table(META).unwrap().insert("schema", &schema[..]).unwrap();
        write.commit().unwrap();
        drop(db);
        let refused = open(&path, 1).unwrap_err();
        assert!(refused.to_string().contains(says) && refused.to_string().contains("reads 4"), "{refused}");
        let db = Database::open(&path).unwrap();
        let kept = db.begin_read().unwrap().open_table(META).unwrap();
        assert_eq!(kept.get("schema").unwrap().unwrap().value(), schema);
    }
}

/// No version writes that, nor a number that is one bit away from ours: where the rest is sealed as we seal, a bit of it turned.
#[test]
fn a_schema_that_nobody_writes_is_damage_in_a_store_of_ours() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let spoil = |key: &str, value: &[u8]| {
        let db = Database::open(&path).unwrap();
        let write = db.begin_write().unwrap();
        write.open_table(META).unwrap().insert(key, value).unwrap();
        write.commit().unwrap();
    };
    drop(open(&path, 1).unwrap());
    for turned in [&b"x"[..], &[5, 0, 0, 0], &[0; 4], &[4, 0, 0, 128]] {
        spoil("schema", turned);
        let opened = open(&path, 1).unwrap();
        assert_eq!((opened.report.damaged_count, opened.report.damaged[0].what.as_str()), (1, "schema"));
        drop(opened);
        assert_eq!(open(&path, 1).unwrap().report.damaged_count, 0, "it was mended");
    }
    spoil("schema", b"x");
    spoil("owner", b"somebody else's");
    let refused = open(&path, 1).unwrap_err();
    assert!(refused.to_string().contains("of unknown form"), "{refused}");
}

/// The tables as version 1 wrote them: values bare.
fn write_version_1(path: &Path, good: &[u8], place: [u8; 16]) {
    let db = Database::create(path).unwrap();
    let write = db.begin_write().unwrap();
    let mut meta = write.open_table(META).unwrap();
    meta.insert("schema", [1, 0, 0, 0].as_slice()).unwrap();
    meta.insert("owner", b"demo/alpha".as_slice()).unwrap();
    meta.insert("fresh_epoch", [40, 0, 0, 0].as_slice()).unwrap();
    drop(meta);
    write.open_table(ENTRIES).unwrap().insert(place, good).unwrap();
    write.open_table(BLOBS).unwrap().insert(Hash::of(b"blob").0, b"blob".as_slice()).unwrap();
    write.open_table(PRIVATE).unwrap().insert([9; 16], b"own".as_slice()).unwrap();
    write.commit().unwrap();
}

#[test]
fn an_older_schema_migrates_and_what_it_could_not_seal_is_checked() {
    let dir = tempfile::tempdir().unwrap();
    let (id, bytes) = common::signed(0);
    let mut place = [0; 16];
    place[..8].copy_from_slice(&id.frame.robot.0);
    place[8..12].copy_from_slice(&id.frame.epoch.to_be_bytes());
    let path = dir.path().join("s.redb");
    write_version_1(&path, &bytes, place);
    assert_eq!(inspect(&FileMedium::new(&path)).unwrap().schema, Schema::Version(1), "looking changes nothing");
    let opened = open(&path, 1).unwrap();
    assert_eq!((opened.report.migrated_from, opened.report.damaged_count), (Some(1), 0));
    assert_eq!((opened.restored.fresh_epoch, opened.restored.records.len()), (40, 3));
    assert!(opened.restored.records.contains(&Record::Entry { id, bytes: bytes.clone() }));
    drop(opened);
    let again = open(&path, 1).unwrap();
    assert_eq!((again.report.migrated_from, again.restored.records.len()), (None, 3));
    assert!(!dir.path().join("s.redb.damaged").exists());

    // An entry in another's place shows, seal or not.
    let path = dir.path().join("t.redb");
    place[15] = 1;
    write_version_1(&path, &bytes, place);
    let opened = open(&path, 1).unwrap();
    assert_eq!((opened.report.migrated_from, opened.report.damaged_count), (Some(1), 1));
    assert!(opened.report.entries_lost && opened.restored.records.contains(&Record::EpochClosed { epoch: 40 }));
}

/// Version 2 sealed what it wrote, but knew no refused pairs.
#[test]
fn a_store_of_version_2_migrates_whole() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let proof = [b"one".to_vec(), b"other".to_vec()];
    let frame = FrameId { robot: RobotId([3; 8]), epoch: 9 };
    let records = vec![entry(0, b"zero"), Record::Fork { frame, proof }, Record::EpochClosed { epoch: 7 }];
    open(&path, 1).unwrap().store.commit(records.iter()).unwrap();
    let db = Database::open(&path).unwrap();
    let write = db.begin_write().unwrap();
    write.open_table(META).unwrap().insert("schema", [2, 0, 0, 0].as_slice()).unwrap();
    assert!(write.delete_table(REFUSED).unwrap());
    write.commit().unwrap();
    drop(db);
    let opened = open(&path, 1).unwrap();
    assert_eq!((opened.report.migrated_from, opened.report.damaged_count), (Some(2), 0));
    assert_eq!(sorted(opened.restored.records), sorted(records));
    let mut store = opened.store;
    store.commit([refused(0, Some(1))].iter()).unwrap();
    drop(store);
    let again = open(&path, 1).unwrap();
    assert_eq!((again.report.migrated_from, again.restored.records.len()), (None, 4));
}

#[test]
fn a_migration_without_room_is_refused_and_loses_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let (_, bytes) = common::signed(0);
    write_version_1(&path, &bytes, [0; 16]);
    std::fs::create_dir(dir.path().join("s.redb.new")).unwrap(); // nothing can be made here
    let refused = open(&path, 1).unwrap_err();
    assert!(refused.to_string().contains("cannot be migrated to schema 4"), "{refused}");
    assert_eq!(inspect(&FileMedium::new(&path)).unwrap().schema, Schema::Version(1));
}

#[test]
fn after_a_power_cut_all_that_was_confirmed_is_there_in_whole_batches() {
    let disk = Disk::default();
    let mut store = on(&disk).store;
    let batch = |number: u32| (0..5).map(move |i| entry(number * 5 + i, &[number as u8; 700])).collect::<Vec<_>>();
    for number in 0..12 {
        store.commit(batch(number).iter()).unwrap();
        for seed in 0..4 {
            let after = Disk::default();
            after.restore(&disk.picture());
            after.cut(seed);
            let wanted = (0..=number).flat_map(batch).collect::<Vec<_>>();
            assert_eq!(sorted(on(&after).restored.records), sorted(wanted), "batch {number}, seed {seed}");
        }
    }
}

#[test]
fn a_cut_in_the_middle_of_a_commit_leaves_the_batch_out_or_in_never_in_part() {
    let mut cut_short = 0;
    for writes in 0..60 {
        let disk = Disk::default();
        let mut store = on(&disk).store;
        store.commit((0..5).map(|i| entry(i, b"durable")).collect::<Vec<_>>().iter()).unwrap();
        disk.with_faults(|faults| faults.dies_after = Some(writes));
        let done = store.commit((5..10).map(|i| entry(i, &[7; 5000])).collect::<Vec<_>>().iter()).is_ok();
        disk.cut(writes);
        drop(store);
        let opened = on(&disk);
        let held = opened.restored.records.len();
        assert!(held == 10 || (held == 5 && !done), "{writes} writes: {held} entries, commit said {done}");
        assert_eq!(opened.report.damaged_count, 0, "{writes}: {:?}", opened.report);
        cut_short += usize::from(!done);
    }
    assert!(cut_short > 5, "only {cut_short} commits were cut: the test tests nothing");
}

#[test]
fn a_failed_commit_is_repeated_and_then_all_is_there() {
    for after in 0..40 {
        for full in [false, true] {
            let disk = Disk::default();
            let mut store = on(&disk).store;
            store.commit((0..5).map(|i| entry(i, b"durable")).collect::<Vec<_>>().iter()).unwrap();
            disk.with_faults(|faults| {
                (faults.errors_after, faults.errors, faults.seed) = (after, u64::from(!full), after);
                faults.full = full;
            });
            let batch = (5..10).map(|i| entry(i, &[7; 5000])).collect::<Vec<_>>();
            let first = store.commit(batch.iter());
            disk.with_faults(|faults| {
                (faults.errors, faults.full) = (0, false);
            });
            if let Err(error) = first {
                assert_eq!(matches!(error, CommitError::Full(_)), full, "{error}");
                store.commit(batch.iter()).unwrap();
            }
            disk.cut(after);
            drop(store);
            let opened = on(&disk);
            assert_eq!(opened.restored.records.len(), 10, "after {after}, full {full}: {:?}", opened.report);
            assert_eq!(opened.report.damaged_count, 0, "after {after}, full {full}: {:?}", opened.report);
        }
    }
}

#[test]
fn a_store_is_its_owners_alone_from_the_start_and_one_that_is_not_is_told() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.redb");
    let medium = FileMedium::new(&path);
    assert_eq!(medium.loose_mode(), None, "not there yet");
    drop(Store::open(medium.clone(), owner(), 1).unwrap());
    let mode = || std::fs::metadata(&path).unwrap().permissions().mode() & 0o7777;
    assert_eq!((mode(), medium.loose_mode()), (0o600, None));
    for (loose, told) in [(0o400, None), (0o640, Some(0o640)), (0o602, Some(0o602))] {
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(loose)).unwrap();
        assert_eq!(medium.loose_mode(), told);
    }
}

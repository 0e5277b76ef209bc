//! What cannot be opened: a damaged store of ours is renewed, under an epoch above all that it can still name, and the
//! damaged file is kept; whatever else is in its place, or keeps it from being read now, is left alone.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

mod common;

use common::{name, owner};
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, FrameId, Hash, RobotId};
use merganser_protocol::wire::{Entry, EntryContent, SwarmTag};
use merganser_store::simulated::Disk;
use merganser_store::{DAMAGED_KEPT_MAX, FileMedium, Medium, Opened, Owner, Store, StoreError, inspect};
use redb::{Builder, Database, DatabaseError, ReadableDatabase, TableDefinition};
use std::io;
use std::path::{Path, PathBuf};

/// What another program keeps.
const SONGS: TableDefinition<'_, &str, &str> = TableDefinition::new("songs");
/// The epoch of the log that is lost.
const EPOCH: u32 = 3_000_000_000;

/// Alpha, with entries that it signed.
fn alpha() -> (Owner, Vec<Record>) {
    let key = ed25519_dalek::SigningKey::from_bytes(&[7; 32]);
    let robot = RobotId::of_key(key.verifying_key().as_bytes());
    let swarm = SwarmTag::of(&name("demo"));
    let entry = |seq| {
        let id = EntryId { frame: FrameId { robot, epoch: EPOCH }, seq };
        let content =
            EntryContent { swarm, id, kind: 99, floor: 0, previous: Hash::default(), payload: vec![seq as u8; 900] };
        Record::Entry { id, bytes: Entry::sign(&key, content).unwrap().encode() }
    };
    let blob = |k: u8| Record::Blob { hash: Hash::of(&[k; 3000]), bytes: vec![k; 3000] };
    (Owner { id: robot, ..owner() }, (0..40).map(entry).chain((0..40).map(blob)).collect())
}

/// A store of alpha's in a file, closed in order, and its bytes.
fn filled(folder: &Path) -> (PathBuf, Vec<u8>) {
    let path = folder.join("s.redb");
    let (owner, records) = alpha();
    let mut store = Store::open(FileMedium::new(&path), owner, 7).unwrap().store;
    records.chunks(8).for_each(|batch| store.commit(batch.iter()).unwrap());
    drop(store);
    let bytes = std::fs::read(&path).unwrap();
    (path, bytes)
}

fn open(path: &Path) -> Result<Opened, StoreError> {
    Store::open(FileMedium::new(path), alpha().0, 7)
}

fn renew(path: &Path, fresh_epoch: u32) -> Result<Opened, StoreError> {
    Store::renew(FileMedium::new(path), alpha().0, fresh_epoch)
}

/// Names of all that lies beside the store.
fn beside(path: &Path) -> Vec<String> {
    let folder = std::fs::read_dir(path.parent().unwrap()).unwrap();
    let mut names: Vec<String> = folder.map(|file| file.unwrap().file_name().into_string().unwrap()).collect();
    names.retain(|found| found != "s.redb");
    names.sort();
    names
}

/// That it is told as damage without being touched, and renewed. Gives the epoch that begins.
fn is_renewed(path: &Path, bytes: &[u8], what: &str) -> u32 {
    std::fs::write(path, bytes).unwrap();
    let refused = open(path);
    assert!(matches!(refused, Err(StoreError::Damaged { .. })), "{what}: {refused:?}");
    let refused = inspect(&FileMedium::new(path));
    assert!(matches!(refused, Err(StoreError::Damaged { .. })), "{what}: {refused:?}");
    assert!(std::fs::read(path).unwrap() == bytes, "{what}: it was changed");
    let Opened { mut store, restored, report } = renew(path, 7).unwrap();
    let kept = report.kept.unwrap();
    assert!(std::fs::read(&kept).unwrap() == bytes, "{what}: what was damaged is kept");
    let renewed = report.renewed.unwrap();
    assert_eq!((renewed.len, renewed.epoch), (bytes.len() as u64, restored.fresh_epoch), "{what}");
    assert!(report.entries_lost && restored.fresh_epoch >= 7, "{what}");
    let closed = Record::EpochClosed { epoch: restored.fresh_epoch - 1 };
    assert_eq!(restored.records, std::slice::from_ref(&closed), "{what}");
    store.commit(alpha().1.iter()).unwrap();
    drop(store);
    let again = open(path).unwrap();
    assert!(again.restored.records.contains(&closed) && again.restored.records.len() == 81, "{what}");
    assert_eq!((again.restored.fresh_epoch, again.report), (restored.fresh_epoch, Default::default()), "{what}");
    std::fs::remove_file(kept).unwrap();
    restored.fresh_epoch
}

/// What a power cut leaves on a disk that lied.
#[test]
fn a_store_that_is_cut_anywhere_is_renewed_and_its_epochs_stay_behind() {
    let dir = tempfile::tempdir().unwrap();
    let (path, whole) = filled(dir.path());
    let first_entry = whole.windows(200).position(|window| window == [0; 200].map(|_: u8| 39)).unwrap();
    let lengths = (0..512).step_by(61).chain([4095, 4096, 4097, whole.len() - 4096, whole.len() - 1]);
    let mut above = 0;
    for len in lengths.chain((512..whole.len()).step_by(whole.len() / 30)) {
        let epoch = is_renewed(&path, &whole[..len], &format!("{len} of {} bytes", whole.len()));
        assert!([7, 8, EPOCH + 1].contains(&epoch), "{len}: {epoch}"); // nothing, `meta`, or an entry was there to be read
        assert!(len <= first_entry + 1000 || epoch == EPOCH + 1, "{len}: the log's epoch is there to be read");
        above += u32::from(epoch > EPOCH);
    }
    assert!(above > 5, "{above}");
}

#[test]
fn a_header_with_wrong_bits_is_renewed() {
    let dir = tempfile::tempdir().unwrap();
    let (path, whole) = filled(dir.path());
    let mut renewed = 0;
    for (at, bit) in (0..320).step_by(3).map(|at| (at, at % 8)) {
        let mut hit = whole.clone();
        hit[at] ^= 1 << bit;
        std::fs::write(&path, &hit).unwrap();
        match open(&path) {
            Ok(_) => {} // it has two of most things, or the rest was mended
            Err(StoreError::Damaged { .. }) => {
                assert_eq!(is_renewed(&path, &hit, &format!("bit {bit} of byte {at}")), EPOCH + 1);
                renewed += 1;
            }
            Err(other) => panic!("bit {bit} of byte {at}: {other}"),
        }
    }
    assert!(renewed > 5, "{renewed}");
    // A first sector, or page, that was never written.
    for lost in [9, 512, 4096] {
        let hit = [&vec![0; lost], &whole[lost..]].concat();
        assert_eq!(is_renewed(&path, &hit, &format!("{lost} zeros")), EPOCH + 1);
    }
    is_renewed(&path, &vec![0; whole.len()], "zeros alone");
    let nameless = [&[0; 9], &whole[9..4096]].concat();
    assert_eq!(is_renewed(&path, &nameless, "a database that was being made"), 7);
}

#[test]
fn epochs_that_the_damaged_file_names_are_passed_even_by_a_clock_that_stands() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    // No entry yet: `meta` alone says which epoch was to begin, and which are closed.
    for (fresh, closed, wanted) in [(50, None, 51), (50, Some(60), 61)] {
        drop(std::fs::remove_file(&path));
        let mut store = Store::open(FileMedium::new(&path), alpha().0, fresh).unwrap().store;
        store.commit(closed.map(|epoch| Record::EpochClosed { epoch }).iter()).unwrap();
        drop(store);
        let mut bytes = std::fs::read(&path).unwrap();
        bytes[..100].fill(0xff);
        std::fs::write(&path, &bytes).unwrap();
        let opened = renew(&path, 0).unwrap();
        assert_eq!(opened.restored.fresh_epoch, wanted);
        assert_eq!(opened.report.renewed.unwrap().last_epoch, Some(wanted - 1));
        // And a clock that goes on passes them by more.
        drop(opened.store);
        std::fs::write(&path, &bytes).unwrap();
        assert_eq!(renew(&path, 1000).unwrap().restored.fresh_epoch, 1000);
    }
}

#[test]
fn so_many_damaged_files_are_kept_and_no_more() {
    let dir = tempfile::tempdir().unwrap();
    let (path, whole) = filled(dir.path());
    let spoil = |len: usize| {
        std::fs::write(&path, &whole[..len]).unwrap();
        renew(&path, 7).unwrap().report.kept.unwrap().file_name().unwrap().to_str().unwrap().to_owned()
    };
    let large = whole.len() - 1;
    for (k, len) in [300, large, 200, 100].into_iter().enumerate() {
        assert_eq!(spoil(len), format!("s.redb.damaged-{}", k + 1));
    }
    assert_eq!(beside(&path).len(), DAMAGED_KEPT_MAX, "all within the bound stay");
    // One more, and the smallest of the others goes; the newest stays, though it is empty.
    assert_eq!(spoil(0), "s.redb.damaged-5");
    assert_eq!(beside(&path), [1, 2, 3, 5].map(|k| format!("s.redb.damaged-{k}")));
    for _ in 0..6 {
        spoil(0);
    }
    assert_eq!(beside(&path), [1, 11, 2, 3].map(|k| format!("s.redb.damaged-{k}")));
    assert!(std::fs::read(dir.path().join("s.redb.damaged-2")).unwrap() == whole[..large], "nothing was overwritten");
    // What else lies there is nobody's to take away.
    std::fs::write(dir.path().join("s.redb.damaged-by-me"), b"").unwrap();
    spoil(0);
    assert_eq!(beside(&path).len(), DAMAGED_KEPT_MAX + 1);
}

#[test]
fn what_is_no_damage_of_ours_is_left_alone() {
    let dir = tempfile::tempdir().unwrap();
    let (path, whole) = filled(dir.path());
    let check = |what: &str, wanted: fn(&StoreError) -> bool| {
        let before = std::fs::read(&path).ok();
        for refused in [open(&path).err(), renew(&path, 7).err()] {
            assert!(refused.as_ref().is_some_and(wanted), "{what}: {refused:?}");
        }
        assert!(std::fs::read(&path).ok() == before, "{what}: it was changed");
    };
    let running = open(&path).unwrap();
    check("another agent", |error| matches!(error, StoreError::InUse(_)));
    drop(running);

    let strangers: [&[u8]; 4] = [b"no", b"# a text of somebody's, with paths/and/more\n", &[7; 9000], &[0xff; 320]];
    for bytes in strangers {
        std::fs::write(&path, bytes).unwrap();
        check("somebody's file", |error| matches!(error, StoreError::NotAStore { .. }));
    }
    std::fs::remove_file(&path).unwrap();
    let db = Database::create(&path).unwrap();
    let write = db.begin_write().unwrap();
    write.open_table(SONGS).unwrap().insert("a", "b").unwrap();
    write.commit().unwrap();
    drop(db);
    for refused in [open(&path).err(), renew(&path, 7).err()] {
        assert!(matches!(refused, Some(StoreError::Schema { .. })), "another program's database: {refused:?}");
    }
    let kept = Database::open(&path).unwrap().begin_read().unwrap().open_table(SONGS).unwrap();
    assert_eq!(kept.get("a").unwrap().unwrap().value(), "b");
    drop(kept);

    // A later version of the file's format: both slots say so.
    let mut later = whole.clone();
    (later[64], later[192]) = (4, 4);
    std::fs::write(&path, &later).unwrap();
    check("a later format", |error| matches!(error, StoreError::Schema { found, .. } if found == "redb file format 4"));
    // Another robot's store, damaged.
    let beta = Owner { robot: name("beta"), id: RobotId([9; 8]), ..owner() };
    std::fs::remove_file(&path).unwrap();
    drop(Store::open(FileMedium::new(&path), beta, 7).unwrap());
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[..9].copy_from_slice(&[0; 9]);
    std::fs::write(&path, &bytes).unwrap();
    check("another robot's", |error| matches!(error, StoreError::Foreign { owner, .. } if owner == "demo/beta"));

    std::fs::remove_file(&path).unwrap();
    std::fs::create_dir(&path).unwrap();
    check("a folder", |error| matches!(error, StoreError::Failed { .. }));
    assert!(beside(&path).is_empty(), "{:?}", beside(&path));
}

/// A file system that refuses.
#[derive(Clone, Debug)]
struct Refusing(Disk, io::ErrorKind);

impl Medium for Refusing {
    fn path(&self) -> &Path {
        Path::new("refusing")
    }
    fn create(&self, _: &Builder) -> Result<Database, DatabaseError> {
        Err(io::Error::from(self.1).into())
    }
    fn create_spare(&self, _: &Builder) -> Result<Database, DatabaseError> {
        panic!("nothing is to be made")
    }
    fn promote_spare(&self, _: bool) -> io::Result<Option<PathBuf>> {
        panic!("nothing is to be moved")
    }
    fn is_emptied(&self) -> io::Result<bool> {
        self.0.is_emptied()
    }
    fn bytes(&self) -> io::Result<Box<dyn io::Read + '_>> {
        self.0.bytes()
    }
}

#[test]
fn what_a_file_system_refuses_now_is_no_damage() {
    use io::ErrorKind::{Interrupted, Other, PermissionDenied, ReadOnlyFilesystem, ResourceBusy, StorageFull};
    for kind in [PermissionDenied, ReadOnlyFilesystem, StorageFull, Interrupted, ResourceBusy, Other] {
        let refused = Store::renew(Refusing(Disk::default(), kind), owner(), 7);
        assert!(matches!(refused, Err(StoreError::Failed { .. })), "{kind}: {refused:?}");
    }
}

#[test]
fn without_room_for_an_empty_store_the_damaged_one_stays_where_it_is() {
    let dir = tempfile::tempdir().unwrap();
    let (path, whole) = filled(dir.path());
    std::fs::write(&path, &whole[..5000]).unwrap();
    std::fs::create_dir(dir.path().join("s.redb.new")).unwrap(); // nothing can be made here
    let refused = renew(&path, 7);
    assert!(matches!(refused, Err(StoreError::Failed { .. })), "{refused:?}");
    assert!(std::fs::read(&path).unwrap() == whole[..5000] && beside(&path) == ["s.redb.new"]);

    let disk = Disk::default();
    drop(Store::open(disk.clone(), owner(), 7).unwrap());
    let mut picture = disk.picture();
    picture.bytes()[..9].fill(0);
    for (full, errors) in [(true, 0), (false, u64::MAX)] {
        disk.restore(&picture);
        disk.with_faults(|faults| (faults.full, faults.errors, faults.reads) = (full, errors, true));
        let refused = Store::renew(disk.clone(), owner(), 7);
        assert!(matches!(refused, Err(StoreError::Failed { .. })), "{refused:?}");
        disk.with_faults(|faults| (faults.full, faults.errors) = (false, 0));
        assert!(matches!(Store::open(disk.clone(), owner(), 7), Err(StoreError::Damaged { .. })));
    }
    let renewed = Store::renew(disk, owner(), 7).unwrap();
    assert_eq!(renewed.report.renewed.unwrap().epoch, 8);
}

#[test]
fn a_store_that_can_be_opened_is_not_renewed() {
    let dir = tempfile::tempdir().unwrap();
    let (path, _) = filled(dir.path());
    let opened = renew(&path, 7).unwrap();
    assert_eq!((opened.restored.records.len(), opened.report), (80, Default::default()));
    assert!(beside(&path).is_empty());
    assert!(renew(&dir.path().join("new.redb"), 7).unwrap().report.renewed.is_none(), "nor one that was not there");
}

//! What was reported durable is there after a crash, whole batches or nothing; foreign stores are refused by name.
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]

use merganser::store::{Store, StoreError, Writer};
use merganser_protocol::agent::io::{Input, Record};
use merganser_protocol::ids::{EntryId, FrameId, Hash, Name, RobotId, SubmapId};
use redb::{Database, StorageBackend};
use std::collections::BTreeSet;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, mpsc};
use std::time::Duration;

fn name(text: &str) -> Name {
    Name::new(text).unwrap()
}

fn entry(seq: u32, bytes: &[u8]) -> Record {
    Record::Entry { id: EntryId { frame: FrameId { robot: RobotId([3; 8]), epoch: 9 }, seq }, bytes: bytes.to_vec() }
}

fn open(path: &Path) -> Result<Store, StoreError> {
    Store::open(path, &name("demo"), &name("alpha"))
}

fn sorted(mut records: Vec<Record>) -> Vec<String> {
    records.sort_by_key(|record| format!("{record:?}"));
    records.iter().map(|record| format!("{record:?}")).collect()
}

#[test]
fn all_kinds_of_records_survive_a_restart_with_the_epoch() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let frame = FrameId { robot: RobotId([3; 8]), epoch: 9 };
    let records = vec![
        entry(0, b"zero"),
        entry(1, b""),
        Record::Blob { hash: Hash::of(b"blob"), bytes: b"blob".to_vec() },
        Record::Private { submap: SubmapId { frame, index: 4 }, bytes: vec![1; 100_000] },
    ];
    let store = open(&path).unwrap();
    let epoch = store.load().unwrap().fresh_epoch;
    assert!(epoch > 0 && store.load().unwrap().records.is_empty());
    store.commit(records.iter()).unwrap();
    store.commit(records.iter()).unwrap(); // twice is harmless
    drop(store);
    let restored = open(&path).unwrap().load().unwrap();
    assert_eq!(restored.fresh_epoch, epoch);
    assert_eq!(sorted(restored.records), sorted(records));
}

#[test]
fn an_entry_is_never_replaced_by_another() {
    let dir = tempfile::tempdir().unwrap();
    let store = open(&dir.path().join("s.redb")).unwrap();
    store.commit([entry(0, b"first")].iter()).unwrap();
    let refused = store.commit([entry(1, b"fine"), entry(0, b"second")].iter()).unwrap_err();
    assert!(refused.contains("already stored with other bytes"), "{refused}");
    assert_eq!(sorted(store.load().unwrap().records), sorted(vec![entry(0, b"first")]), "all or nothing");
}

#[test]
fn foreign_and_busy_stores_are_refused_with_advice() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let store = open(&path).unwrap();
    assert!(matches!(open(&path), Err(StoreError::InUse(_))));
    drop(store);
    let other = Store::open(&path, &name("demo"), &name("beta")).unwrap_err();
    assert!(other.to_string().contains("belongs to demo/alpha, not to demo/beta"), "{other}");
    let meta: redb::TableDefinition<'_, &str, &[u8]> = redb::TableDefinition::new("meta");
    let db = Database::open(&path).unwrap();
    let write = db.begin_write().unwrap();
    write.open_table(meta).unwrap().insert("schema", [2, 0, 0, 0].as_slice()).unwrap();
    write.commit().unwrap();
    drop(db);
    let later = open(&path).unwrap_err();
    assert!(later.to_string().contains("has schema 2, this program reads 1"), "{later}");
    std::fs::write(&path, b"no database at all, but some text that is long enough to be looked at").unwrap();
    assert!(matches!(open(&path), Err(StoreError::Failed { .. })));
}

/// A disk in memory that keeps what was synced apart from what was only written, and can run out of space.
#[derive(Clone, Debug, Default)]
struct Disk(Arc<Mutex<Image>>);

#[derive(Debug, Default)]
struct Image {
    now: Vec<u8>,
    synced: Vec<u8>,
    unsynced: Vec<(usize, Vec<u8>)>,
    writes_left: Option<usize>,
}

impl Disk {
    /// The image after a power cut: what was synced, and some of the later writes, in part torn.
    fn cut(&self, seed: u64) -> Self {
        let image = self.0.lock().unwrap();
        let mut torn = image.synced.clone();
        let mut state = seed;
        let mut draw = |n: usize| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 33) as usize % n.max(1)
        };
        for (offset, data) in &image.unsynced {
            let keep = match draw(3) {
                0 => 0,
                1 => data.len(),
                _ => (draw(data.len()) / 512) * 512,
            };
            if torn.len() < offset + keep {
                torn.resize(offset + keep, 0);
            }
            torn[*offset..offset + keep].copy_from_slice(&data[..keep]);
        }
        torn.resize(torn.len().max(image.now.len()), 0);
        Self(Arc::new(Mutex::new(Image { now: torn.clone(), synced: torn, ..Image::default() })))
    }
}

impl StorageBackend for Disk {
    fn len(&self) -> io::Result<u64> {
        Ok(self.0.lock().unwrap().now.len() as u64)
    }
    fn read(&self, offset: u64, out: &mut [u8]) -> io::Result<()> {
        let image = self.0.lock().unwrap();
        let offset = offset as usize;
        let part = image.now.get(offset..offset + out.len()).ok_or(io::ErrorKind::UnexpectedEof)?;
        out.copy_from_slice(part);
        Ok(())
    }
    fn set_len(&self, len: u64) -> io::Result<()> {
        let mut image = self.0.lock().unwrap();
        image.now.resize(len as usize, 0);
        Ok(())
    }
    fn sync_data(&self) -> io::Result<()> {
        let mut image = self.0.lock().unwrap();
        image.synced = image.now.clone();
        image.unsynced.clear();
        Ok(())
    }
    fn write(&self, offset: u64, data: &[u8]) -> io::Result<()> {
        let mut image = self.0.lock().unwrap();
        if let Some(left) = &mut image.writes_left {
            if *left == 0 {
                return Err(io::ErrorKind::StorageFull.into());
            }
            *left -= 1;
        }
        let offset = offset as usize;
        image.now[offset..offset + data.len()].copy_from_slice(data);
        image.unsynced.push((offset, data.to_vec()));
        Ok(())
    }
}

fn on(disk: &Disk) -> Store {
    let mut builder = Database::builder();
    let db = builder.set_cache_size(1 << 20).create_with_backend(disk.clone()).unwrap();
    Store::with_database(db, Path::new("memory"), &name("demo"), &name("alpha")).unwrap()
}

#[test]
fn after_a_power_cut_all_that_was_durable_is_there_in_whole_batches() {
    let disk = Disk::default();
    let store = on(&disk);
    let batch = |number: u32| (0..5).map(move |i| entry(number * 5 + i, &[number as u8; 700])).collect::<Vec<_>>();
    let mut cuts = 0;
    for number in 0..12 {
        store.commit(batch(number).iter()).unwrap();
        for seed in 0..4 {
            let after = on(&disk.cut(seed)).load().unwrap().records;
            let wanted = (0..=number).flat_map(batch).collect::<Vec<_>>();
            assert_eq!(sorted(after), sorted(wanted), "batch {number}, seed {seed}");
            cuts += 1;
        }
    }
    assert_eq!(cuts, 48);
}

#[test]
fn a_cut_in_the_middle_of_a_commit_leaves_the_batch_out_or_in_never_in_part() {
    let mut torn = 0;
    for writes in 0..60 {
        let disk = Disk::default();
        let store = on(&disk);
        store.commit((0..5).map(|i| entry(i, b"durable")).collect::<Vec<_>>().iter()).unwrap();
        disk.0.lock().unwrap().writes_left = Some(writes);
        let done = store.commit((5..10).map(|i| entry(i, &[7; 5000])).collect::<Vec<_>>().iter()).is_ok();
        let image = disk.cut(writes as u64);
        let held = on(&image).load().unwrap().records.len();
        assert!(held == 10 || (held == 5 && !done), "{writes} writes: {held} entries, commit said {done}");
        torn += usize::from(!done);
        std::mem::forget(store); // a process that was killed closes nothing
    }
    assert!(torn > 5, "only {torn} commits were cut: the test tests nothing");
}

#[test]
fn batches_share_commits_and_are_told_in_order() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("s.redb");
    let (sender, told) = mpsc::channel();
    let writer = Writer::spawn(open(&path).unwrap(), Duration::from_millis(20), move |input| {
        sender.send(input).unwrap();
    });
    let writer = writer.unwrap();
    for number in 1..=200 {
        writer.persist(number, vec![entry(number as u32, b"x")]);
    }
    drop(writer); // waits for the disk
    let up_to: Vec<u64> = told
        .iter()
        .map(|input| match input {
            Input::Persisted { up_to } => up_to,
            other => panic!("{other:?}"),
        })
        .collect();
    assert!(up_to.is_sorted() && up_to.last() == Some(&200), "{up_to:?}");
    assert!(up_to.len() < 100, "{} commits for 200 batches", up_to.len());
    let seqs: BTreeSet<String> = sorted(open(&path).unwrap().load().unwrap().records).into_iter().collect();
    assert_eq!(seqs.len(), 200);
}

#[test]
fn a_full_disk_is_told_once_and_ends_writing() {
    let disk = Disk::default();
    let store = on(&disk);
    disk.0.lock().unwrap().writes_left = Some(0);
    let (sender, told) = mpsc::channel();
    let writer = Writer::spawn(store, Duration::ZERO, move |input| sender.send(input).unwrap()).unwrap();
    writer.persist(1, vec![entry(0, &[1; 1000])]);
    let failed = told.recv_timeout(Duration::from_secs(10)).unwrap();
    assert!(matches!(&failed, Input::PersistFailed { batch: 1, .. }), "{failed:?}");
    disk.0.lock().unwrap().writes_left = None;
    writer.persist(2, vec![entry(1, b"later")]);
    drop(writer);
    assert!(told.recv().is_err(), "a later batch may rest on the lost one");
}

//! Five thousand power cuts, each at some write or sync of some commit, with torn sectors: no entry that was confirmed
//! is lost, and no place in the log is written twice.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "a test fails by panicking")]

mod common;

use common::{ROBOT, on, owner};
use merganser_protocol::agent::io::Record;
use merganser_protocol::ids::{EntryId, FrameId};
use merganser_store::Store;
use merganser_store::simulated::Disk;
use std::collections::BTreeMap;

const CUTS: u64 = 5_000;
/// A disk is replaced after so many lives, so that small and larger stores are cut alike.
const LIVES: u64 = 50;
/// Writes and syncs of a few commits: a life ends somewhere among them.
const OPERATIONS: u64 = 60;

/// An entry that tells which life wrote it: a second one in its place shows.
fn entry(seq: u32, life: u64, len: usize) -> Record {
    let id = EntryId { frame: FrameId { robot: ROBOT, epoch: 9 }, seq };
    let mut bytes = vec![seq as u8; len];
    bytes.extend(life.to_le_bytes());
    Record::Entry { id, bytes }
}

fn held(records: Vec<Record>) -> BTreeMap<u32, Vec<u8>> {
    let one = |record| match record {
        Record::Entry { id, bytes } => (id.seq, bytes),
        other => panic!("{other:?}"),
    };
    records.into_iter().map(one).collect()
}

#[test]
fn five_thousand_power_cuts_lose_nothing_that_was_confirmed() {
    let (mut cuts, mut confirmed, mut lost, mut doubled) = (0_u64, 0_u64, 0_u64, 0_u64);
    let (mut torn, mut in_commit, mut in_recovery, mut appeared) = (0, 0, 0, 0_u64);
    while cuts < CUTS {
        let disk = Disk::default();
        let mut acknowledged: BTreeMap<u32, Vec<u8>> = BTreeMap::new();
        for _ in 0..LIVES {
            // Now and then the power goes again while the store recovers.
            if cuts % 5 == 1 {
                disk.with_faults(|faults| faults.dies_after = Some(cuts % 11));
                in_recovery += u64::from(Store::open(disk.clone(), owner(), 1).is_err());
                torn += disk.cut(!cuts).torn;
                cuts += 1;
            }
            let opened = on(&disk);
            assert_eq!(opened.report.damaged_count, 0, "cut {cuts}: {:?}", opened.report);
            let mut store = opened.store;
            let stored = held(opened.restored.records);
            lost += acknowledged.keys().filter(|seq| !stored.contains_key(seq)).count() as u64;
            doubled +=
                acknowledged.iter().filter(|(seq, bytes)| stored.get(seq).is_some_and(|b| b != *bytes)).count() as u64;
            appeared += (stored.len() - acknowledged.len()) as u64; // the power went after the commit, before its word
            assert!(stored.keys().copied().eq(0..stored.len() as u32), "cut {cuts}: a hole");
            acknowledged = stored;
            disk.with_faults(|faults| faults.dies_after = Some(cuts.wrapping_mul(7_919) % OPERATIONS));
            let mut next = acknowledged.len() as u32;
            loop {
                let batch: Vec<Record> =
                    (0..1 + next % 4).map(|k| entry(next + k, cuts, 100 + 700 * (next % 5) as usize)).collect();
                if store.commit(batch.iter()).is_err() {
                    in_commit += 1;
                    break;
                }
                next += batch.len() as u32;
                confirmed += batch.len() as u64;
                acknowledged.extend(held(batch));
            }
            torn += disk.cut(cuts).torn;
            cuts += 1;
            drop(store);
        }
    }
    println!(
        "{cuts} power cuts, {in_commit} in a commit, {in_recovery} in a recovery, {torn} writes torn; {confirmed} entries confirmed, {appeared} there \
         unconfirmed: {lost} lost, {doubled} sequence numbers doubled"
    );
    assert_eq!((lost, doubled), (0, 0));
    assert!(torn > CUTS / 2 && confirmed > CUTS && in_recovery > CUTS / 20, "the test tests nothing");
}

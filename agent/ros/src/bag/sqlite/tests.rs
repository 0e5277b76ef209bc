//! Numbers that were given, and databases that are damaged.

use super::{Given, MESSAGE_BYTES_MAX};
use crate::bag::write::{Written, db3};
use crate::bag::{Bag, Flow};
use proptest::prelude::*;
use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

proptest! {
    #[test]
    fn a_number_is_given_once(
        numbers in prop::collection::vec(prop_oneof![-8..8_i64, Just(i64::MIN), Just(i64::MAX)], 0..40),
    ) {
        let (mut given, mut all) = (Given::default(), BTreeSet::new());
        for number in numbers {
            prop_assert_eq!(given.insert(number), all.insert(number));
        }
        let begins = |number: &&i64| number.checked_sub(1).is_none_or(|before| !all.contains(&before));
        prop_assert_eq!(given.ranges.len(), all.iter().filter(begins).count());
    }
}

fn drive(count: i64) -> Vec<Written> {
    let message = |k: i64| Written {
        topic: "/odom".into(),
        kind: "nav_msgs/msg/Odometry".into(),
        received_ns: 1_000_000 + k,
        bytes: vec![k as u8; 100],
    };
    (0..count).map(message).collect()
}

/// Times of the messages that a reading gives, what it tells beyond the opening, and what that told.
fn read(path: &Path) -> (Vec<i64>, Vec<String>, Vec<String>) {
    let bag = Bag::open(path).unwrap();
    let mut times = Vec::new();
    let damage = bag.read(
        |_| true,
        |record| {
            times.push(record.received_ns);
            Flow::On
        },
    );
    (times, damage.unwrap().beyond(bag.damage()).told(), bag.damage().told())
}

#[test]
fn a_damaged_index_is_told_and_the_messages_are_read_in_their_order() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.db3");
    let count = 2_000;
    db3(&path, &drive(count), false, false);
    let index = "SELECT rootpage FROM sqlite_master WHERE name = 'timestamp_idx'";
    let database = rusqlite::Connection::open(&path).unwrap();
    let number = |query: &str| database.query_row(query, [], |row| row.get::<_, u32>(0)).unwrap() as usize;
    let (page, size) = (number(index), number("PRAGMA page_size"));
    drop(database);
    let whole = fs::read(&path).unwrap();
    let mut bytes = whole.clone();
    // The first page below the index's root, but one: some messages are found by the index.
    let root = &whole[(page - 1) * size..];
    let cell = usize::from(u16::from_be_bytes([root[12 + 2], root[12 + 3]]));
    let below = u32::from_be_bytes([root[cell], root[cell + 1], root[cell + 2], root[cell + 3]]) as usize;
    bytes[(below - 1) * size..(below - 1) * size + 100].fill(0xff);
    fs::write(&path, bytes).unwrap();
    let (times, told, opening) = read(&path);
    let all: Vec<i64> = drive(count).iter().map(|message| message.received_ns).collect();
    assert_eq!(times, all, "each once");
    assert!(opening.is_empty() && told.len() == 1 && told[0].contains("index of stamps is damaged"), "{told:?}");
}

#[test]
fn what_a_cut_database_has_lost_is_told_and_the_rest_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.db3");
    db3(&path, &drive(2_000), false, false);
    let whole = fs::read(&path).unwrap();
    fs::write(&path, &whole[..whole.len() / 2]).unwrap();
    let bag = Bag::open(&path).unwrap();
    let (times, told, opening) = read(&path);
    assert_eq!(times.len() as u64, bag.topics()[0].count, "as many as were counted");
    assert!(times.len() > 500 && times.windows(2).all(|two| two[0] < two[1]), "{}", times.len());
    assert!(told.is_empty() && opening[0].contains("damaged or was cut off"), "{told:?} {opening:?}");
}

#[test]
fn a_row_that_is_too_long_is_counted_and_the_others_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.db3");
    db3(&path, &drive(20), false, false);
    let long = format!("UPDATE messages SET data = zeroblob({}) WHERE id = 7", MESSAGE_BYTES_MAX + (2 << 20));
    rusqlite::Connection::open(&path).unwrap().execute_batch(&long).unwrap();
    let (times, told, _) = read(&path);
    assert_eq!(times.len(), 19);
    assert!(told.len() == 1 && told[0].contains("1 messages of more than"), "{told:?}");
}

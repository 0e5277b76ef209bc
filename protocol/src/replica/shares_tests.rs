//! Shares on both sides of their bounds: who makes room is heard, wherever and in whatever order; who does not is heard
//! no further.

use super::testing::*;
use super::*;
use crate::config::{GossipConfig, MEMBER_BYTES_MIN};
use crate::ids::{EntryId, FrameId, Hash};
use crate::wire::fact::RetiredFact;
use crate::wire::samples::key;
use crate::wire::{Entry, EntryContent, Fact};
use core::num::NonZero;
use proptest::prelude::*;

fn of_epochs(epochs_per_robot_max: usize) -> Replica {
    replica_with(&GossipConfig { epochs_per_robot_max, ..GossipConfig::default() })
}

/// Each member has the least share there is.
fn small() -> Replica {
    replica_with(&GossipConfig { facts_bytes_max: MEMBER_BYTES_MIN, ..GossipConfig::default() })
}

fn retired(below: u32) -> Fact {
    Fact::Retired(RetiredFact { below: NonZero::new(below).unwrap() })
}

/// Writes as an agent does: what must be given up is said first.
fn write(writer: &mut Replica, n: u8, epoch: u32, fact: &Fact) -> Vec<Vec<u8>> {
    let first = writer.to_retire(frame(n, epoch)).map(retired);
    let facts = first.iter().chain([fact]);
    let entries = facts.map(|fact| writer.append(&key(n), epoch, fact).unwrap().encode()).collect();
    settle(writer);
    entries
}

fn epochs(replica: &Replica, n: u8) -> Vec<u32> {
    replica.epochs_of(frame(n, 0).robot).collect()
}

#[test]
fn the_seventieth_epoch_is_like_the_second() {
    let (mut writer, mut reader) = (replica(), replica());
    let max = GossipConfig::default().epochs_per_robot_max as u32;
    for epoch in 1..=70 {
        let entries = write(&mut writer, 1, epoch, &fact(epoch));
        feed(&mut reader, &entries);
        assert_eq!(view(&reader), view(&writer));
    }
    assert_eq!(epochs(&reader, 1), (71 - max..=70).collect::<Vec<_>>());
    assert_eq!(reader.take_gone(), (1..=70 - max).map(|epoch| frame(1, epoch)).collect::<Vec<_>>());
    // Who held what is given up does not spread it again, and is not asked for it.
    let mut late = replica();
    feed(&mut late, &chain(1, 1, 3, 0));
    assert!(reader.ahead_of_us(&have_of(&reader, &late)).is_empty());
    assert_eq!(reader.ingest(&chain(1, 1, 1, 0)[0]), Ok(Ingested::Known));
    while pull(&mut late, &writer, 65_536) > 0 {}
    assert_eq!(view(&late), view(&writer));
}

#[test]
fn lengths_and_epochs_are_bounded_on_both_sides() {
    let limits = GossipConfig { entries_per_frame_max: 3, epochs_per_robot_max: 2, ..GossipConfig::default() };
    let mut replica = replica_with(&limits);
    let entries = chain(1, 0, 4, 0);
    feed(&mut replica, &entries[..2]);
    assert!(matches!(replica.ingest(&entries[2]), Ok(Ingested::New(_))));
    assert_eq!(replica.ingest(&entries[3]), Err(IngestError::SeqLimit(EntryId { frame: frame(1, 0), seq: 3 })));
    for epoch in 7..10 {
        assert!(matches!(replica.ingest(&chain(1, epoch, 1, 0)[0]), Ok(Ingested::New(_))));
    }
    assert_eq!(
        replica.ingest(&chain(1, 10, 1, 0)[0]),
        Err(IngestError::EpochLimit(frame(1, 0).robot)),
        "they wait for the disk"
    );
    assert!(matches!(replica.ingest(&chain(2, 8, 1, 0)[0]), Ok(Ingested::New(_))));
    settle(&mut replica);
    assert_eq!(replica.epochs_of(frame(1, 0).robot).collect::<Vec<_>>(), [8, 9]);
    assert_eq!(replica.ingest(&chain(1, 6, 1, 0)[0]), Ok(Ingested::Known), "older than those that are held");

    for k in 0..3 {
        replica.append(&key(0), 0, &fact(k)).unwrap();
    }
    assert!(matches!(replica.append(&key(0), 0, &fact(3)), Err(AppendError::NewEpochNeeded(..))));
    replica.append(&key(0), 1, &fact(0)).unwrap();
    settle(&mut replica);
    replica.append(&key(0), 2, &fact(0)).unwrap();
    assert_eq!(replica.epochs_of(frame(0, 0).robot).collect::<Vec<_>>(), [0, 1, 2], "until it is durable");
    settle(&mut replica);
    assert_eq!(replica.epochs_of(frame(0, 0).robot).collect::<Vec<_>>(), [1, 2]);
}

#[test]
fn what_is_given_up_stays_until_that_is_durable_and_there_is_an_end_to_waiting() {
    let mut replica = of_epochs(2);
    feed(&mut replica, &[chain(1, 0, 1, 0), chain(1, 1, 1, 0)].concat());
    let next = |epoch| signed(1, epoch, 0, 0, Hash::default(), &retired(epoch)).encode();
    assert!(matches!(replica.ingest(&next(2)), Ok(Ingested::New(_))));
    assert_eq!(epochs(&replica, 1), [0, 1, 2]);
    assert!(matches!(replica.ingest(&next(3)), Ok(Ingested::New(_))));
    assert_eq!(replica.ingest(&next(4)), Err(IngestError::EpochLimit(frame(1, 0).robot)), "twice the bound");
    settle(&mut replica);
    assert_eq!(epochs(&replica, 1), [3]);
    assert!(matches!(replica.ingest(&next(4)), Ok(Ingested::New(_))));
}

#[test]
fn nobody_gives_up_what_is_to_come_or_anothers() {
    let mut replica = replica();
    feed(&mut replica, &[chain(1, 3, 1, 0), chain(1, 9, 1, 0), chain(2, 1, 1, 0)].concat());
    feed(&mut replica, &[signed(1, 5, 0, 0, Hash::default(), &retired(u32::MAX)).encode()]);
    assert_eq!((epochs(&replica, 1), epochs(&replica, 2)), (vec![5, 9], vec![1]));
    assert_eq!(replica.first_epoch(frame(1, 0).robot), Some(5));
    // An earlier statement of less takes nothing back.
    feed(
        &mut replica,
        &[signed(1, 9, 1, 0, Entry::decode(&chain(1, 9, 1, 0)[0]).unwrap().hash(), &retired(2)).encode()],
    );
    assert_eq!(replica.first_epoch(frame(1, 0).robot), Some(5));
}

/// Later places of logs that are not begun crowd nothing out, and wait in bounded memory.
#[test]
fn a_log_whose_beginning_is_missing_takes_nobodys_place() {
    let mut replica = of_epochs(2);
    feed(&mut replica, &[chain(1, 0, 1, 0), chain(1, 1, 1, 0)].concat());
    for epoch in 2..200 {
        let first = signed(1, epoch, 0, 0, Hash::default(), &fact(0));
        let second = signed(1, epoch, 1, 0, first.hash(), &retired(epoch)).encode();
        let taken = replica.ingest(&second);
        assert_eq!(
            matches!(taken, Ok(Ingested::Early(_))),
            epoch < 2 + EARLY_PER_ROBOT_MAX as u32,
            "{epoch}: {taken:?}"
        );
    }
    let held: Vec<u32> = replica.lengths().map(|(frame, _)| frame.epoch).collect();
    assert_eq!(held, [0, 1]);
    // What begins is taken all the same.
    feed(&mut replica, &chain(1, 300, 1, 0));
    let held: Vec<u32> = replica.lengths().map(|(frame, _)| frame.epoch).collect();
    assert_eq!(held, [1, 300]);
}

/// A robot that lost its past gives up nothing of it, and may never come back: those that hold parts of it agree.
#[test]
fn those_that_heard_of_different_epochs_agree_once_they_met() {
    let mut replicas = [of_epochs(1), of_epochs(1), of_epochs(1)];
    for (replica, epoch) in replicas.iter_mut().zip([7, 5, 6]) {
        feed(replica, &chain(1, epoch, 2, 0));
    }
    let [a, b, c] = &mut replicas;
    let mut round = || pull(b, a, 65_536) + pull(c, b, 65_536) + pull(a, c, 65_536);
    let rounds = (0..16).take_while(|_| round() > 0).count();
    assert!(rounds < 16, "they come to rest");
    assert!(view(a) == view(b) && view(b) == view(c));
    assert_eq!(epochs(a, 1), [7]);
    // A fork of the newest is the newest.
    let [x, y] = [0, 1].map(|story| chain(1, 8, 1, story)[0].clone());
    a.ingest_fork(&x, &y).unwrap();
    assert_eq!((epochs(a, 1), a.first_epoch(frame(1, 0).robot)), (vec![8], Some(8)));
}

#[test]
fn a_proof_of_what_was_given_up_is_no_news() {
    let mut replica = replica();
    feed(&mut replica, &[signed(1, 5, 0, 0, Hash::default(), &retired(5)).encode()]);
    let [a, b] = [0, 1].map(|story| chain(1, 4, 1, story)[0].clone());
    assert_eq!(replica.ingest_fork(&a, &b), Ok((frame(1, 4), false)));
    assert_eq!(replica.forks().count(), 0);
    // One that came before goes with the log.
    let mut replica = testing::replica();
    replica.ingest_fork(&a, &b).unwrap();
    feed(&mut replica, &[signed(1, 5, 0, 0, Hash::default(), &retired(5)).encode()]);
    assert_eq!((replica.forks().count(), replica.take_gone()), (0, vec![frame(1, 4)]));
}

/// The power failed after the new epoch was on the disk, and before the old ones were off it.
#[test]
fn a_store_with_what_was_given_up_loads_without_it() {
    let mut writer = of_epochs(3);
    let entries: Vec<_> = (1..=6).flat_map(|epoch| write(&mut writer, 1, epoch, &fact(epoch))).collect();
    let mut loaded = of_epochs(3);
    loaded.restore(entries.into_iter().rev()).unwrap();
    assert_eq!(view(&loaded), view(&writer));
    assert_eq!(loaded.take_gone(), [1, 2, 3].map(|epoch| frame(1, epoch)));
}

/// Many large entries of one log.
fn large(n: u8, epoch: u32, count: u32) -> Vec<Vec<u8>> {
    let mut previous = Hash::default();
    let entry = |seq| {
        let id = EntryId { frame: frame(n, epoch), seq };
        let swarm = replica().swarm();
        let content = EntryContent { swarm, id, kind: 200, floor: 0, previous, payload: vec![7; 1900] };
        let entry = Entry::sign(&key(n), content).unwrap();
        previous = entry.hash();
        entry.encode()
    };
    (0..count).map(entry).collect()
}

#[test]
fn a_member_fills_its_share_and_no_more_and_others_are_not_touched() {
    let mut replica = small();
    let entries = large(1, 1, 40);
    let robot = frame(1, 0).robot;
    let cost = entries[1].len() + log::HELD_BYTES;
    let fit = MEMBER_BYTES_MIN / cost;
    feed(&mut replica, &entries[..fit]);
    assert_eq!(replica.next_seq(frame(1, 1)) as usize, fit, "up to the last byte");
    let refused = replica.ingest(&entries[fit]).unwrap_err();
    assert_eq!((&refused, refused.culprit()), (&IngestError::BytesLimit(robot), Some(robot)));
    assert_eq!(replica.ingest(&large(1, 2, 1)[0]), Err(IngestError::BytesLimit(robot)), "over all its epochs");
    assert!(matches!(replica.ingest(&large(2, 1, 1)[0]), Ok(Ingested::New(_))), "another's share is its own");
    // Nobody is blamed for what he did not sign.
    let mut forged = entries[fit].clone();
    *forged.last_mut().unwrap() ^= 1;
    assert_eq!(replica.ingest(&forged).unwrap_err().culprit(), None);
    // It is not asked for what would be refused.
    let mut full = testing::replica();
    feed(&mut full, &entries);
    assert!(replica.ahead_of_us(&have_of(&replica, &full)).is_empty());
    // Giving up what fills it makes room at once.
    let first = signed(1, 2, 0, 0, Hash::default(), &retired(2)).encode();
    assert!(matches!(replica.ingest(&first), Ok(Ingested::New(_))));
    settle(&mut replica);
    assert!(replica.bytes_of(robot) < 500);
}

#[test]
fn a_log_that_is_replaced_counts_for_what_replaces_it() {
    let mut replica = small();
    let entries = condensed_chain(1, 1, 100, 0);
    let (log, parts) = entries.split_at(100);
    feed(&mut replica, log);
    let before = replica.bytes_of(frame(1, 0).robot);
    parts.iter().for_each(|part| drop(replica.ingest(part).unwrap()));
    let costs: usize = parts.iter().map(|part| part.len() + log::HELD_BYTES).sum();
    assert!(before > 10 * costs, "{before} {costs}");
    assert_eq!(replica.bytes_of(frame(1, 0).robot), costs, "before it is durable");
    settle(&mut replica);
    assert_eq!(replica.bytes_of(frame(1, 0).robot), costs);
}

#[test]
fn a_writer_whose_share_is_full_goes_on_in_a_new_epoch_with_room_to_write() {
    let (mut writer, mut reader) = (small(), small());
    let mut epoch = 1;
    for k in 0..2000 {
        let entries = match writer.append(&key(1), epoch, &fact(k)) {
            Ok(entry) => vec![entry.encode()],
            Err(AppendError::NewEpochNeeded(of, why)) => {
                assert_eq!((of, why.contains("share of gossip.facts_bytes_max")), (frame(1, epoch), true));
                epoch += 1;
                write(&mut writer, 1, epoch, &fact(k))
            }
            Err(error) => panic!("{error}"),
        };
        settle(&mut writer);
        feed(&mut reader, &entries);
        let bytes = writer.bytes_of(frame(1, 0).robot);
        assert!(
            bytes <= MEMBER_BYTES_MIN && (entries.len() == 1 || bytes <= MEMBER_BYTES_MIN / 4 * 3 + 1000),
            "{bytes}"
        );
    }
    assert!(epoch > 5, "{epoch}");
    assert_eq!(view(&reader), view(&writer));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(32))]

    /// In whatever order, and however often, entries arrive: in the end all hold the same.
    #[test]
    fn all_that_heard_everything_hold_the_same(orders in prop::collection::vec(any::<u64>(), 3), max in 1..5_usize) {
        let mut writer = of_epochs(max);
        let epochs = [1_u32, 2, 5, 6, 9, 10, 30];
        let entries: Vec<_> =
            epochs.iter().flat_map(|epoch| (0..3).flat_map(|k| write(&mut writer, 1, *epoch, &fact(k))).collect::<Vec<_>>()).collect();
        for order in orders {
            let mut shuffled = entries.clone();
            shuffled.sort_by_key(|bytes| Hash::of(&[&order.to_le_bytes()[..], bytes].concat()).0);
            let mut replica = of_epochs(max);
            for _ in 0..entries.len() {
                feed(&mut replica, &shuffled);
            }
            prop_assert_eq!(view(&replica), view(&writer));
            let held: Vec<FrameId> = replica.lengths().map(|(frame, _)| frame).collect();
            prop_assert!(held.len() <= max, "{:?}", held);
        }
    }
}

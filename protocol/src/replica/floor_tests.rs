//! Floors: what a writer replaced goes, on every robot alike, in whatever order things come.

use super::testing::{condensed_chain, feed, frame, have_of, pull, replica, replica_with, settle, view};
use super::{AppendError, IngestError, Ingested};
use crate::config::GossipConfig;
use crate::ids::EntryId;
use crate::replica::testing::fact;
use crate::wire::samples::key;
use proptest::prelude::*;

const LEN: u32 = 6;
const MORE: u32 = 3;

fn id(seq: u32) -> EntryId {
    EntryId { frame: frame(1, 4), seq }
}

fn all() -> Vec<Vec<u8>> {
    condensed_chain(1, 4, LEN, MORE)
}

fn held(replica: &super::Replica) -> Vec<u32> {
    replica.entries().map(|(id, _)| id.seq).collect()
}

#[test]
fn what_is_replaced_is_shown_until_the_floor_is_durable() {
    let (mut replica, all) = (replica(), all());
    feed(&mut replica, &all[..LEN as usize]);
    let before = view(&replica);
    for bytes in &all[LEN as usize..] {
        assert!(matches!(replica.ingest(bytes), Ok(Ingested::New(_))));
    }
    assert_eq!(view(&replica), before);
    assert!(replica.is_floor(id(LEN)) && !replica.is_floor(id(LEN + 1)) && !replica.is_floor(id(0)));
    replica.mark_durable(id(LEN));
    assert_eq!(held(&replica), [LEN], "what follows is not durable yet");
    settle(&mut replica);
    assert_eq!(held(&replica), (LEN..LEN + 2 + MORE).collect::<Vec<_>>());
    assert_eq!(replica.lengths().collect::<Vec<_>>(), [(frame(1, 4), Some(LEN + 2 + MORE))]);
    assert_eq!(replica.settled(frame(1, 4)), Some(LEN..LEN + 2 + MORE));
}

#[test]
fn whoever_was_away_jumps_and_never_shows_less_than_before() {
    let all = all();
    let mut source = replica();
    feed(&mut source, &all);
    for known in 0..=LEN as usize {
        let mut away = replica();
        feed(&mut away, &all[..known]);
        let mut len = known as u32;
        for _ in 0..20 {
            pull(&mut away, &source, 4096);
            let now = away.lengths().next().and_then(|(_, len)| len).unwrap_or(0);
            assert!(now >= len, "{now} after {len}");
            len = now;
        }
        assert_eq!(view(&away), view(&source), "{known}");
        // It has nothing that the source lacks, and the other way round.
        assert!(source.ahead_of_us(&have_of(&source, &away)).is_empty());
        assert_eq!(pull(&mut source, &away, 4096), 0);
    }
}

#[test]
fn a_jump_that_is_not_durable_yet_hides_nothing() {
    let (mut replica, all) = (replica(), all());
    feed(&mut replica, &all[..3]);
    let before = view(&replica);
    assert_eq!(replica.ingest(&all[LEN as usize]), Ok(Ingested::New(vec![id(LEN)])));
    assert_eq!(replica.ingest(&all[LEN as usize + 1]), Ok(Ingested::New(vec![id(LEN + 1)])));
    assert_eq!(replica.ingest(&all[4]), Ok(Ingested::Known), "between what is held and the floor");
    assert_eq!(view(&replica), before);
    replica.mark_durable(id(LEN + 1));
    assert_eq!(view(&replica), before);
    replica.mark_durable(id(LEN));
    assert_eq!(held(&replica), [LEN, LEN + 1]);
}

#[test]
fn nothing_below_a_floor_returns_nor_is_taken_for_a_fork() {
    let (mut replica, all) = (replica(), all());
    feed(&mut replica, &all);
    let before = view(&replica);
    for bytes in &all[..LEN as usize] {
        assert_eq!(replica.ingest(bytes), Ok(Ingested::Known));
    }
    settle(&mut replica);
    assert_eq!(view(&replica), before);
    // A second story above the floor is one all the same.
    let other = condensed_chain(1, 4, LEN, MORE + 1);
    assert!(matches!(replica.ingest(&other[(LEN + 2 + MORE) as usize]), Ok(Ingested::New(_))));
    let mut forger = super::testing::replica();
    feed(&mut forger, &all[..LEN as usize]);
    let second = super::testing::chain(1, 4, LEN + 1, 3);
    assert_eq!(replica.ingest(&second[LEN as usize]), Err(IngestError::Fork(frame(1, 4))));
}

#[test]
fn a_store_gives_back_the_same_with_or_without_leftovers() {
    let all = all();
    let mut whole = replica();
    feed(&mut whole, &all);
    for records in [&all[..], &all[LEN as usize..]] {
        let mut again = replica();
        again.restore(records.to_vec()).unwrap();
        assert_eq!(view(&again), view(&whole));
        assert_eq!(held(&again), held(&whole));
    }
    // What follows a floor that is lost is out of reach, and said to be.
    let mut again = replica();
    assert!(again.restore(all[LEN as usize + 1..].to_vec()).is_err());
    assert_eq!(again.count(), 0);
    // What comes after it can be fetched again.
    feed(&mut again, &all[LEN as usize..]);
    assert_eq!(view(&again), view(&whole));
}

#[test]
fn entries_are_counted_from_the_floor_on() {
    let limits = GossipConfig { entries_per_frame_max: LEN, ..GossipConfig::default() };
    let (mut writer, mut reader) = (replica_with(&limits), replica_with(&limits));
    let mut log = all();
    log.extend(condensed_chain(1, 4, LEN, MORE + 4).into_iter().skip(log.len()));
    for bytes in &log[..2 * LEN as usize] {
        assert!(matches!(reader.ingest(bytes), Ok(Ingested::New(_))), "{:?}", reader.ingest(bytes));
    }
    assert_eq!(reader.ingest(&log[2 * LEN as usize]), Err(IngestError::SeqLimit(id(2 * LEN))));
    for k in 0..LEN {
        writer.append(&key(1), 4, &fact(k)).unwrap();
    }
    assert!(matches!(writer.append(&key(1), 4, &fact(LEN)), Err(AppendError::NewEpochNeeded(..))));
}

proptest! {
    #[test]
    fn in_any_order_the_same_is_held(order in Just((0..(LEN + 2 + MORE) as usize).collect::<Vec<_>>()).prop_shuffle()) {
        let all = all();
        let (mut expected, mut replica) = (replica(), replica());
        feed(&mut expected, &all);
        for _ in 0..2 {
            for &at in &order {
                let _ = replica.ingest(&all[at]);
                settle(&mut replica);
            }
        }
        prop_assert_eq!(view(&replica), view(&expected));
        prop_assert_eq!(held(&replica), held(&expected));
    }
}

//! Properties of the set: order and batching change nothing, forks are proven and spread, nothing undurable shows,
//! deltas keep their budget and converge, a restart loses nothing and reuses no place.

use super::testing::*;
use super::*;
use crate::config::GossipConfig;
use crate::ids::{EntryId, Hash, Name};
use crate::wire::samples::{key, robot};
use crate::wire::{Entry, EntryContent, EntryError, Fact, Head, SwarmTag};
use proptest::prelude::*;

fn id(n: u8, epoch: u32, seq: u32) -> EntryId {
    EntryId { frame: frame(n, epoch), seq }
}

#[test]
fn own_facts_are_chained_and_shown_only_once_durable() {
    let mut replica = replica();
    let first = replica.append(&key(0), 5, &fact(0)).unwrap();
    let second = replica.append(&key(0), 5, &fact(1)).unwrap();
    assert_eq!((first.id(), second.id()), (id(0, 5, 0), id(0, 5, 1)));
    assert_eq!(second.previous(), first.hash());
    assert_eq!(replica.next_seq(frame(0, 5)), 2);

    let empty = view(&testing::replica());
    let shown = |replica: &Replica| {
        (
            replica.count(),
            replica.facts().count(),
            replica.delta_for(&have_of(replica, &testing::replica()), 65_536).entries.len(),
        )
    };
    assert_eq!((view(&replica), shown(&replica)), (empty.clone(), (0, 0, 0)));
    // Out of order: the second is durable, but not all before it.
    replica.mark_durable(second.id());
    assert_eq!((view(&replica), shown(&replica)), (empty, (0, 0, 0)));
    replica.mark_durable(first.id());
    assert_eq!(shown(&replica), (2, 2, 2));
    let (_, tag) = (second.id(), Head::tag_of(&second.hash()));
    assert_eq!(have_of(&replica, &replica).head(frame(0, 5)), Some(Head::Log { len: 2, tag: Some(tag) }));
    let facts: Vec<_> = replica.facts().map(|(id, fact)| (id.seq, fact)).collect();
    assert_eq!(facts, [(0, first.fact().unwrap()), (1, second.fact().unwrap())]);
}

#[test]
fn only_members_of_this_swarm_are_heard() {
    let mut replica = replica();
    let stranger = signed(MEMBERS, 0, 0, 0, Hash::default(), &fact(0));
    assert_eq!(replica.ingest(&stranger.encode()), Err(IngestError::UnknownOrigin(robot(MEMBERS))));

    let content = EntryContent {
        swarm: SwarmTag::of(&Name::new("other").unwrap()),
        id: id(0, 0, 0),
        kind: 1,
        floor: 0,
        previous: Hash::default(),
        payload: fact(0).to_payload().unwrap(),
    };
    let other = Entry::sign(&key(0), content.clone()).unwrap();
    assert_eq!(replica.ingest(&other.encode()).unwrap_err().reason(), "swarm");
    // Signed by a member in another member's name.
    let content = EntryContent { swarm: replica.swarm(), ..content };
    let forged = Entry::sign(&key(1), content).unwrap();
    assert_eq!(replica.ingest(&forged.encode()), Err(IngestError::Entry(EntryError::Signature)));
    assert_eq!(replica.slots.len(), 0, "refusals leave nothing behind");
}

#[test]
fn a_flood_of_unknown_origins_leaves_nothing_behind() {
    let mut replica = replica();
    let bytes = signed(MEMBERS, 0, 0, 0, Hash::default(), &fact(0)).encode();
    for k in 0..10_000u32 {
        let mut bytes = bytes.clone();
        bytes[9..13].copy_from_slice(&k.to_le_bytes());
        assert_eq!(replica.ingest(&bytes).unwrap_err().reason(), "unknown_origin");
    }
    assert_eq!(replica.slots.len(), 0);
}

#[test]
fn replays_are_known() {
    let mut replica = replica();
    let entries = chain(1, 0, 3, 0);
    for (seq, bytes) in (0..).zip(&entries) {
        assert_eq!(replica.ingest(bytes), Ok(Ingested::New(vec![id(1, 0, seq)])));
        assert_eq!(replica.ingest(bytes), Ok(Ingested::Known));
    }
    assert_eq!(replica.ingest(&entries[0]), Ok(Ingested::Known));
}

#[test]
fn early_entries_wait_and_then_all_are_new() {
    let mut replica = replica();
    let entries = chain(1, 0, 4, 0);
    assert_eq!(replica.ingest(&entries[2]), Ok(Ingested::Early(id(1, 0, 2))));
    assert_eq!(replica.ingest(&entries[2]), Ok(Ingested::Early(id(1, 0, 2))));
    assert_eq!(replica.ingest(&entries[1]), Ok(Ingested::Early(id(1, 0, 1))));
    settle(&mut replica);
    assert_eq!((replica.count(), replica.next_seq(frame(1, 0))), (0, 0));
    let all = (0..3).map(|seq| id(1, 0, seq)).collect();
    assert_eq!(replica.ingest(&entries[0]), Ok(Ingested::New(all)));
    assert_eq!(replica.ingest(&entries[3]), Ok(Ingested::New(vec![id(1, 0, 3)])));
}

#[test]
fn early_entries_are_bounded_and_the_nearest_are_kept() {
    let mut replica = replica();
    let max = EARLY_PER_ROBOT_MAX as u32;
    let entries = chain(1, 0, max + 10, 0);
    for bytes in &entries[10..] {
        assert!(matches!(replica.ingest(bytes), Ok(Ingested::Early(_))));
    }
    let other = chain(1, 9, max + 20, 0);
    assert_eq!(replica.ingest(&other[max as usize + 19]).unwrap_err().reason(), "too_early");
    assert!(matches!(replica.ingest(&entries[9]), Ok(Ingested::Early(_))), "nearer than the farthest");
    let waiting: usize = replica.logs().map(|(_, log)| log.early.len()).sum();
    assert_eq!(waiting, EARLY_PER_ROBOT_MAX);
    feed(&mut replica, &entries[..9]);
    assert_eq!(replica.next_seq(frame(1, 0)), max + 9, "the farthest gave way");
    // Another robot's entries have their own bound.
    assert!(matches!(replica.ingest(&chain(2, 0, 2, 0)[1]), Ok(Ingested::Early(_))));
}

#[test]
fn floors_never_fall() {
    let mut replica = replica();
    let a = signed(1, 0, 0, 0, Hash::default(), &fact(0));
    let b = signed(1, 0, 1, 1, a.hash(), &fact(1));
    let falls = signed(1, 0, 2, 0, b.hash(), &fact(2));
    let stays = signed(1, 0, 2, 1, b.hash(), &fact(2));
    feed(&mut replica, &[a.encode(), b.encode()]);
    assert_eq!(replica.ingest(&falls.encode()), Err(IngestError::FloorMoved(id(1, 0, 2))));
    assert!(matches!(replica.ingest(&stays.encode()), Ok(Ingested::New(_))));
}

#[test]
fn a_second_story_quarantines_the_log_however_it_shows() {
    let (x, y) = (chain(1, 0, 4, 0), chain(1, 0, 4, 1));
    // A different entry in a held place; a successor of another predecessor; the same among early ones.
    for (held, other) in [(&x[..3], &y[1]), (&x[..3], &y[3]), (&x[2..3], &y[2])] {
        let mut replica = replica();
        feed(&mut replica, held);
        feed(&mut replica, &chain(2, 0, 1, 0));
        assert_eq!(replica.ingest(other), Err(IngestError::Fork(frame(1, 0))));
        assert_eq!(replica.ingest(&x[0]), Err(IngestError::Quarantined(frame(1, 0))));
        assert!(replica.facts().all(|(id, _)| id.frame == frame(2, 0)));
        assert_eq!(have_of(&replica, &replica).head(frame(1, 0)), Some(Head::Forked));

        // The proof convinces another robot that held nothing, or either story.
        let (_, proof) = replica.forks().next().unwrap();
        for known in [&[][..], &x[..], &y[..]] {
            let mut other = testing::replica();
            feed(&mut other, known);
            assert_eq!(other.ingest_fork(&proof.a, &proof.b), Ok((frame(1, 0), true)));
            assert_eq!(other.ingest_fork(&proof.a, &proof.b), Ok((frame(1, 0), false)));
            assert!(other.is_quarantined(frame(1, 0)));
        }
    }
    // Promotion of early entries that contradict what they waited for.
    let mut replica = replica();
    feed(&mut replica, &y[1..2]);
    assert_eq!(replica.ingest(&x[0]), Err(IngestError::Fork(frame(1, 0))));
}

#[test]
fn what_is_no_fork_proves_none() {
    let mut replica = replica();
    let (x, y) = (chain(1, 0, 3, 0), chain(1, 0, 3, 1));
    let other_epoch = chain(1, 1, 1, 1);
    for (a, b) in [(&x[0], &x[0]), (&x[0], &x[1]), (&x[0], &x[2]), (&x[0], &y[2]), (&x[0], &other_epoch[0])] {
        assert_eq!(replica.ingest_fork(a, b), Err(IngestError::NotAProof));
    }
    let mut forged = y[0].clone();
    *forged.last_mut().unwrap() ^= 1;
    assert_eq!(replica.ingest_fork(&x[0], &forged), Err(IngestError::Entry(EntryError::Signature)));
    assert_eq!(replica.slots.len(), 0);
}

#[test]
fn a_fork_spreads_to_robots_that_saw_one_story_each() {
    // Of equal length only the heads' hash bytes tell the two stories apart.
    one_story_each(3, 3);
    one_story_each(5, 3);
    one_story_each(3, 5);
}

fn one_story_each(x: u32, y: u32) {
    let (x, y) = (chain(1, 0, x, 0), chain(1, 0, y, 1));
    let mut robots = [replica(), replica(), replica()];
    feed(&mut robots[0], &x);
    feed(&mut robots[1], &y);
    for round in 0..3 {
        for (to, from) in [(0, 1), (1, 0), (2, 0), (2, 1), (0, 2), (1, 2)] {
            let [a, b] = robots.get_disjoint_mut([to, from]).unwrap();
            pull(a, b, 4096);
        }
        assert!(round == 0 || robots.iter().all(|robot| robot.is_quarantined(frame(1, 0))), "round {round}");
    }
    assert_eq!(view(&robots[0]), view(&robots[1]));
    assert_eq!(view(&robots[0]), view(&robots[2]));
}

#[test]
fn a_log_that_others_know_better_is_not_continued() {
    let mut replica = replica();
    // Another robot returns an entry of ours that our store lost.
    assert!(matches!(replica.ingest(&chain(0, 5, 1, 0)[0]), Ok(Ingested::New(_))));
    assert!(matches!(replica.append(&key(0), 5, &fact(1)), Err(AppendError::NewEpochNeeded(..))));
    assert!(matches!(replica.append(&key(0), 4, &fact(1)), Err(AppendError::Closed { epoch: 4, latest: 5 })));
    assert_eq!(replica.append(&key(0), 6, &fact(1)).unwrap().id(), id(0, 6, 0));
    assert!(matches!(replica.append(&key(MEMBERS), 0, &fact(1)), Err(AppendError::NotInRoster(_))));
    // Our own entry coming back changes nothing.
    let own = replica.append(&key(0), 6, &fact(2)).unwrap();
    assert_eq!(replica.ingest(&own.encode()), Ok(Ingested::Known));
    assert!(replica.append(&key(0), 6, &fact(3)).is_ok());
}

#[test]
fn rosters_are_checked() {
    let name = |text: &str| Name::new(text).unwrap();
    let public = key(0).verifying_key().to_bytes();
    let with = |roster: Vec<(Name, [u8; 32])>| {
        Replica::new(&name("s"), roster, &GossipConfig::default()).map(|_| ()).map_err(|e| e.to_string())
    };
    assert!(with(vec![(name("a"), public)]).is_ok());
    assert!(with(vec![(name("a"), public), (name("b"), public)]).unwrap_err().contains("same key"));
    let mut neutral = [0; 32];
    neutral[0] = 1;
    let no_point =
        (0..=255).map(|k| [k; 32]).find(|key| ed25519_dalek::VerifyingKey::from_bytes(key).is_err()).unwrap();
    for bad in [[0; 32], neutral, no_point] {
        assert!(with(vec![(name("a"), bad)]).unwrap_err().contains("not a usable"), "{bad:?}");
    }
}

#[test]
fn deltas_keep_their_budget_and_say_when_they_were_cut() {
    let mut full = replica();
    for n in 0..4 {
        feed(&mut full, &chain(n, 0, 6, 0));
    }
    let nothing = have_of(&full, &replica());
    let all = full.delta_for(&nothing, 65_536);
    assert!(!all.more && all.entries.len() == 24);
    let total: usize = all.entries.iter().map(|entry| entry.0.len() + 2).sum();
    assert!(!full.delta_for(&nothing, total).more);
    let cut = full.delta_for(&nothing, total - 1);
    assert!(cut.more && cut.entries.len() < 24);
    let small = full.delta_for(&nothing, 1800);
    let frames: std::collections::BTreeSet<_> =
        small.entries.iter().map(|entry| Entry::decode(&entry.0).unwrap().id().frame).collect();
    assert_eq!(frames.len(), 4, "every log got a turn");
    assert!(small.entries.is_sorted_by_key(|entry| Entry::decode(&entry.0).unwrap().id()), "canonical order");
    let none = full.delta_for(&nothing, 0);
    assert!(none.more && none.entries.is_empty());
    assert!(!full.delta_for(&have_of(&full, &full), 65_536).more);
}

#[test]
fn under_a_small_budget_no_log_is_forgotten() {
    let (mut full, mut asker) = (replica(), replica());
    let frames: Vec<_> = (0..MEMBERS).flat_map(|n| (0..3).map(move |epoch| (n, epoch))).collect();
    frames.iter().for_each(|&(n, epoch)| feed(&mut full, &chain(n, epoch, 40, 0)));
    // 30 answers of about nine entries: a quarter of everything.
    for _ in 0..30 {
        pull(&mut asker, &full, 4096);
    }
    assert!(asker.count() < full.count() / 2);
    for (n, epoch) in frames {
        assert!(asker.next_seq(frame(n, epoch)) >= 3, "{n}/{epoch}");
    }
}

#[test]
fn vectors_beyond_one_message_go_in_windows() {
    let limits = GossipConfig { epochs_per_robot_max: 10_000, ..GossipConfig::default() };
    let (mut full, mut empty) = (replica_with(&limits), replica_with(&limits));
    let entries: Vec<_> = (0..2100).flat_map(|epoch| chain(1, epoch, 1, 0)).collect();
    feed(&mut full, &entries);
    let window = |of: &Replica, after| of.have(asker(), VectorForm { after, ..TAGGED });
    let first = window(&full, None);
    assert_eq!(first.heads.len(), crate::wire::limits::HEADS_MAX);
    let second = window(&full, first.until);
    assert_eq!(first.heads.len() + second.heads.len(), 2100);
    assert_eq!((second.after, second.until), (first.until, None));
    // A window asks only about itself.
    for part in [&first, &second] {
        assert!(full.delta_for(&full.read_have(part).unwrap(), 65_536).entries.is_empty());
    }
    let mut rounds = 0;
    while view(&empty) != view(&full) {
        let mut after = None;
        loop {
            let have = window(&empty, after);
            let delta = full.delta_for(&full.read_have(&have).unwrap(), 65_536);
            feed(&mut empty, &delta.entries.iter().map(|entry| entry.0.clone()).collect::<Vec<_>>());
            after = have.until;
            if after.is_none() {
                break;
            }
        }
        rounds += 1;
        assert!(rounds < 40);
    }
}

#[test]
fn a_restart_keeps_everything_and_continues_the_log() {
    let mut before = replica();
    for k in 0..5 {
        before.append(&key(0), 3, &fact(k)).unwrap();
    }
    feed(&mut before, &chain(1, 0, 7, 0));
    let mut stored: Vec<Vec<u8>> = before.entries().map(|(_, bytes)| bytes.to_vec()).collect();
    stored.reverse();
    stored.push(stored[0].clone());
    let mut after = replica();
    after.restore(stored).unwrap();
    assert_eq!(view(&after), view(&before));
    assert_eq!(after.append(&key(0), 3, &fact(5)).unwrap().id(), id(0, 3, 5));
}

#[test]
fn damage_in_a_store_is_listed_and_the_rest_is_loaded() {
    let entries = chain(1, 0, 6, 0);
    for (what, at) in [("payload", 120), ("signature", usize::MAX)] {
        let mut stored = entries.clone();
        let at = at.min(stored[3].len() - 1);
        stored[3][at] ^= 4;
        let mut replica = replica();
        let error = replica.restore(stored.iter().chain(&chain(2, 0, 2, 0)).cloned()).unwrap_err();
        assert_eq!(replica.next_seq(frame(1, 0)), 3, "{what}");
        assert_eq!(replica.next_seq(frame(2, 0)), 2);
        let listed: Vec<_> = error.damaged.iter().map(|damage| (damage.id, damage.why.is_some())).collect();
        assert_eq!(listed, [(Some(id(1, 0, 3)), true), (Some(id(1, 0, 4)), false), (Some(id(1, 0, 5)), false)]);
        assert!(error.concerns(frame(1, 0)) && !error.concerns(frame(2, 0)));
        // A neighbour's copy of the damaged entry mends the log.
        let all = (3..6).map(|seq| id(1, 0, seq)).collect();
        assert_eq!(replica.ingest(&entries[3]), Ok(Ingested::New(all)), "{what}");
    }
    // The last entry, whose signature stands for the whole log.
    let mut stored = entries.clone();
    let last = stored[5].len() - 1;
    stored[5][last] ^= 1;
    let mut replica = replica();
    assert_eq!(replica.restore(stored).unwrap_err().damaged.len(), 1);
    assert_eq!(replica.next_seq(frame(1, 0)), 5);
    // Bytes that are no entry at all concern every log.
    let error = testing::replica().restore([b"rubbish".to_vec()]).unwrap_err();
    assert!(error.concerns(frame(0, 0)));
}

#[test]
fn an_own_log_with_damage_is_not_continued() {
    let mut stored = chain(0, 3, 4, 0);
    stored[1][130] ^= 1;
    let mut replica = replica();
    assert!(replica.restore(stored).unwrap_err().concerns(frame(0, 3)));
    assert!(matches!(replica.append(&key(0), 3, &fact(9)), Err(AppendError::NewEpochNeeded(..))));
}

#[test]
fn a_fork_in_the_store_is_found_again() {
    let (x, y) = (chain(1, 0, 4, 0), chain(1, 0, 4, 1));
    let mut replica = replica();
    replica.restore(x.into_iter().chain(y)).unwrap();
    assert!(replica.is_quarantined(frame(1, 0)));
}

#[test]
fn unknown_kinds_travel_and_count() {
    let content = EntryContent {
        swarm: SwarmTag::of(&crate::wire::samples::swarm()),
        id: id(1, 0, 0),
        kind: 99,
        floor: 0,
        previous: Hash::default(),
        payload: vec![1, 2, 3],
    };
    let entry = Entry::sign(&key(1), content).unwrap();
    let (mut a, mut b) = (replica(), replica());
    feed(&mut a, &[entry.encode()]);
    pull(&mut b, &a, 4096);
    assert_eq!(view(&a), view(&b));
    assert_eq!((b.count(), b.facts().count()), (1, 0));
    assert_eq!(b.entry(id(1, 0, 0)), Some(entry));
}

/// Logs of several robots and epochs: (robot, epoch, length, story).
fn logs() -> impl Strategy<Value = Vec<Vec<Vec<u8>>>> {
    proptest::collection::btree_map((0..MEMBERS, 0..2u32), 1..12u32, 1..8)
        .prop_map(|logs| logs.into_iter().map(|((n, epoch), len)| chain(n, epoch, len, 0)).collect())
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn order_duplication_and_batching_change_nothing(
        logs in logs(), again in proptest::collection::vec(any::<prop::sample::Index>(), 0..30), seed in any::<u64>()
    ) {
        let mut straight = replica();
        logs.iter().for_each(|log| feed(&mut straight, log));

        let mut entries: Vec<_> = logs.concat();
        again.iter().for_each(|at| entries.push(entries[at.index(entries.len())].clone()));
        // A seeded shuffle: sort by a keyed hash of the place.
        let mut order: Vec<usize> = (0..entries.len()).collect();
        order.sort_by_key(|k| Hash::of(&[seed.to_le_bytes(), (*k as u64).to_le_bytes()].concat()));
        let mut shuffled = replica();
        for (count, k) in order.into_iter().enumerate() {
            prop_assert!(shuffled.ingest(&entries[k]).is_ok());
            if seed % (count as u64 + 1) == 0 {
                settle(&mut shuffled);
            }
        }
        settle(&mut shuffled);
        prop_assert_eq!(view(&straight), view(&shuffled));
        let facts = |replica: &Replica| replica.facts().collect::<Vec<(EntryId, Fact)>>();
        prop_assert_eq!(facts(&straight), facts(&shuffled));
    }

    #[test]
    fn two_replicas_converge_in_as_many_rounds_as_their_difference_needs(
        logs in logs(), split in any::<u64>(), budget in 4096usize..20_000
    ) {
        let (mut a, mut b, mut whole) = (replica(), replica(), replica());
        for (k, log) in logs.iter().enumerate() {
            feed(&mut whole, log);
            // Each side holds its own prefix of each log; one of them all of it.
            let cut = (split >> (7 * k)) as usize % (log.len() + 1);
            let (more, less) = if split >> k & 1 == 0 { (&mut a, &mut b) } else { (&mut b, &mut a) };
            feed(more, log);
            feed(less, &log[..cut]);
        }
        let lacking = |held: &Replica| {
            whole.entries().filter(|(id, _)| held.entry_bytes(*id).is_none()).map(|(_, bytes)| bytes.len()).sum::<usize>()
        };
        // A round leaves at most one entry's length of the budget unused.
        let rounds = lacking(&a).max(lacking(&b)) / (budget - crate::wire::limits::ENTRY_LEN_MAX) + 1;
        for _ in 0..rounds {
            let need = lacking(&a);
            prop_assert!(pull(&mut a, &b, budget) > 0 || need == 0);
            pull(&mut b, &a, budget);
        }
        prop_assert_eq!(view(&a), view(&whole));
        prop_assert_eq!(view(&b), view(&whole));
    }

    #[test]
    fn roots_differ_when_sets_do(logs in logs(), at in any::<prop::sample::Index>()) {
        let (mut a, mut b) = (replica(), replica());
        logs.iter().for_each(|log| feed(&mut a, log));
        let short = at.index(logs.len());
        for (k, log) in logs.iter().enumerate() {
            feed(&mut b, &log[..log.len() - usize::from(k == short)]);
        }
        prop_assert_ne!(a.root(), b.root());
        prop_assert_ne!(a.digest(), b.digest());
    }

    #[test]
    fn a_restart_at_any_point_gives_the_same_set(logs in logs(), order in any::<u64>()) {
        let mut before = replica();
        logs.iter().for_each(|log| feed(&mut before, log));
        let mut stored: Vec<_> = before.entries().map(|(_, bytes)| bytes.to_vec()).collect();
        stored.sort_by_key(|bytes| Hash::of(&[&order.to_le_bytes(), &bytes[..]].concat()));
        let mut after = replica();
        prop_assert!(after.restore(stored).is_ok());
        prop_assert_eq!(view(&after), view(&before));
    }

    #[test]
    fn arbitrary_bytes_never_panic(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let mut replica = replica();
        prop_assert!(replica.ingest(&bytes).is_err());
        prop_assert!(replica.ingest_fork(&bytes, &bytes).is_err());
    }
}

//! A roster has one form, is sound or refused, and of two the same one counts everywhere.

use super::limits::*;
use super::roster::*;
use super::samples::{key, swarm};
use crate::ids::{Name, RobotId};
use core::num::NonZero;
use ed25519_dalek::SigningKey;
use proptest::prelude::*;
use std::collections::BTreeMap;

/// The key of the swarm.
pub fn swarm_key() -> SigningKey {
    SigningKey::from_bytes(&[201; 32])
}

fn public(n: u8) -> Key {
    key(n).verifying_key().to_bytes()
}

fn name(text: impl Into<String>) -> Name {
    Name::new(text).unwrap()
}

fn version(n: u64) -> NonZero<u64> {
    NonZero::new(n).unwrap()
}

/// Robots 0 to 2, of which 1 has an old key; an observer; a struck key and a kept one.
pub fn content() -> RosterContent {
    let member = |n, old| Member { key: public(n), old };
    let kept = [(3, NonZero::<u32>::MIN), (203_000_000, NonZero::new(300).unwrap())].into();
    RosterContent {
        swarm: swarm(),
        version: version(7),
        members: [
            (name("r0"), member(0, None)),
            (name("r1"), member(1, Some(public(11)))),
            (name("r2"), member(2, None)),
        ]
        .into(),
        observers: [(name("lena"), public(20))].into(),
        revoked: [
            (public(30), Revoked { name: name("r3"), kept: Kept::new() }),
            (public(31), Revoked { name: name("r1"), kept }),
        ]
        .into(),
    }
}

fn signed(change: impl FnOnce(&mut RosterContent)) -> Result<Roster, StatementError> {
    let mut content = content();
    change(&mut content);
    Roster::sign(&swarm_key(), content)
}

/// Any sound content. Each key is used once.
fn any_content() -> impl Strategy<Value = RosterContent> {
    let part = || proptest::collection::btree_set(0_u8..8, 0..6);
    let epochs = || proptest::collection::btree_map(any::<u32>(), any::<NonZero<u32>>(), 0..4);
    let kept = proptest::collection::vec(epochs(), 8);
    ("[a-z0-9_-]{1,32}", any::<NonZero<u64>>(), part(), part(), part(), part(), kept).prop_map(
        |(swarm, version, members, old, observers, revoked, kept)| RosterContent {
            swarm: name(swarm),
            version,
            members: members
                .iter()
                .map(|n| {
                    (name(format!("m{n}")), Member { key: public(*n), old: old.contains(n).then(|| public(n + 50)) })
                })
                .collect(),
            observers: observers.iter().map(|n| (name(format!("o{n}")), public(n + 100))).collect(),
            revoked: revoked
                .iter()
                .map(|n| {
                    (public(n + 150), Revoked { name: name(format!("m{n}")), kept: kept[usize::from(*n)].clone() })
                })
                .collect(),
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(64))]

    #[test]
    fn what_is_signed_comes_back_and_no_other_bytes_say_so(content in any_content(), at in any::<prop::sample::Index>(), flip in 1_u8..) {
        let roster = Roster::sign(&swarm_key(), content.clone()).unwrap();
        let bytes = roster.encode();
        let back = Roster::decode(&bytes).unwrap();
        prop_assert_eq!(back.encode(), bytes.clone());
        prop_assert_eq!(back.content(), &content);
        prop_assert_eq!(back, roster);
        let mut changed = bytes.clone();
        changed[at.index(bytes.len())] ^= flip;
        prop_assert!(Roster::decode(&changed).is_err(), "a changed byte");
        prop_assert!(Roster::decode(&bytes[..at.index(bytes.len())]).is_err(), "a cut one");
        prop_assert!(Roster::decode(&[&bytes[..], &[0]].concat()).is_err(), "a longer one");
    }

    /// Whoever hears of the same statements holds the same one, in whatever order, how often and by whom they came.
    #[test]
    fn the_order_of_statements_is_total(contents in proptest::collection::vec((any_content(), 1_u64..4), 1..6), seed in any::<u64>()) {
        let rosters: Vec<Roster> = contents
            .into_iter()
            .map(|(content, v)| Roster::sign(&swarm_key(), RosterContent { version: version(v), ..content }).unwrap())
            .collect();
        fn heard(order: Vec<&Roster>) -> Option<&Roster> {
            order.into_iter().reduce(|held, new| if new.supersedes(held) { new } else { held })
        }
        let mut shuffled: Vec<&Roster> = rosters.iter().chain(&rosters).collect();
        shuffled.rotate_left(seed as usize % rosters.len());
        shuffled.reverse();
        prop_assert_eq!(heard(rosters.iter().collect()), heard(shuffled));
        for (a, b) in rosters.iter().flat_map(|a| rosters.iter().map(move |b| (a, b))) {
            prop_assert_eq!(u8::from(a.supersedes(b)) + u8::from(b.supersedes(a)) + u8::from(a == b), 1);
            prop_assert_eq!(a.is_fork_of(b), a != b && a.content().version == b.content().version);
            prop_assert!(!a.supersedes(b) || a.content().version >= b.content().version);
        }
    }
}

#[test]
fn a_roster_that_contradicts_itself_is_neither_signed_nor_read() {
    let no_key = {
        let mut one = [0; 32];
        one[0] = 1;
        one
    };
    type Change = Box<dyn FnOnce(&mut RosterContent)>;
    let own = swarm_key().verifying_key().to_bytes();
    let cases: [(&str, Change); 10] = [
        ("roster_own_key", Box::new(move |c| c.members.get_mut(&name("r0")).unwrap().key = own)),
        ("roster_own_key", Box::new(move |c| c.members.get_mut(&name("r0")).unwrap().old = Some(own))),
        ("roster_own_key", Box::new(move |c| c.observers.extend([(name("x"), own)]))),
        ("roster_key_twice", Box::new(|c| c.members.get_mut(&name("r0")).unwrap().key = public(2))),
        ("roster_key_twice", Box::new(|c| c.members.get_mut(&name("r0")).unwrap().old = Some(public(0)))),
        ("roster_key_twice", Box::new(|c| c.observers.extend([(name("x"), public(11))]))),
        ("roster_key_twice", Box::new(|c| c.members.get_mut(&name("r0")).unwrap().key = public(30))),
        ("roster_name_twice", Box::new(|c| c.observers.extend([(name("r0"), public(21))]))),
        ("roster_key", Box::new(move |c| c.members.get_mut(&name("r0")).unwrap().key = no_key)),
        ("roster_key", Box::new(move |c| c.observers.extend([(name("x"), no_key)]))),
    ];
    for (wanted, change) in cases {
        let mut bad = content();
        change(&mut bad);
        assert_eq!(Roster::sign(&swarm_key(), bad.clone()).unwrap_err().reason(), wanted);
        assert_eq!(Roster::decode(&forced(&bad)).unwrap_err().reason(), wanted, "signed by another program");
    }
}

/// A statement that nobody checked before it was signed.
fn forced(content: &RosterContent) -> Vec<u8> {
    use ed25519_dalek::Signer;
    let member = |(name, member): (&Name, &Member)| (name.clone(), member.key, member.old);
    let observers: Vec<(Name, Key)> = content.observers.iter().map(|(name, key)| (name.clone(), *key)).collect();
    type Raw = (Key, Name, Vec<(u32, NonZero<u32>)>);
    let revoked: Vec<Raw> = content
        .revoked
        .iter()
        .map(|(key, of)| (*key, of.name.clone(), of.kept.iter().map(|(e, l)| (*e, *l)).collect()))
        .collect();
    let members: Vec<_> = content.members.iter().map(member).collect();
    let key = swarm_key();
    let mut bytes = postcard::to_stdvec(&(
        1_u8,
        &content.swarm,
        key.verifying_key().to_bytes(),
        content.version,
        members,
        observers,
        revoked,
    ))
    .unwrap();
    let signature = key.sign(&[b"merganser roster 1\n", &bytes[..]].concat());
    bytes.extend_from_slice(&signature.to_bytes());
    bytes
}

#[test]
fn two_orders_of_one_list_are_not_two_rosters() {
    assert_eq!(Roster::decode(&forced(&content())).unwrap(), signed(|_| {}).unwrap());
    // The first two members, exchanged and signed: names and keys have one length each.
    let bytes = forced(&content());
    let at = 1 + 1 + swarm().as_str().len() + 32 + 1 + 1;
    let (first, second) = (3 + 32 + 1, 3 + 32 + 1 + 32);
    let mut body = bytes[..bytes.len() - 64].to_vec();
    body[at..at + first + second].rotate_left(first);
    let signature = ed25519_dalek::Signer::sign(&swarm_key(), &[b"merganser roster 1\n", &body[..]].concat());
    body.extend_from_slice(&signature.to_bytes());
    assert_eq!(Roster::decode(&body), Err(StatementError::NonCanonical));
}

#[test]
fn only_the_swarms_own_key_speaks_for_it() {
    let bytes = signed(|_| {}).unwrap().encode();
    let (own, other) = (swarm_key().verifying_key().to_bytes(), key(9));
    assert!(Roster::decode_for(&bytes, &swarm(), &own).is_ok());
    let thief = Roster::sign(&other, content()).unwrap();
    assert_eq!(Roster::decode_for(&thief.encode(), &swarm(), &own).unwrap_err().reason(), "roster_swarm_key");
    assert_eq!(Roster::decode_for(&bytes, &name("other"), &own).unwrap_err().reason(), "roster_swarm");
    // The true key named, and another's signature.
    let mut forged = bytes.clone();
    let (end, theirs) = (bytes.len() - 64, thief.encode());
    forged[end..].copy_from_slice(&theirs[theirs.len() - 64..]);
    assert_eq!(Roster::decode(&forged), Err(StatementError::Signature));
}

#[test]
fn limits_of_rosters_are_checked_on_both_sides() {
    let many = |n: usize, of: u8| {
        (0..n).map(move |k| {
            (name(format!("x{of}{k:04}")), {
                let seed = [of, (k >> 8) as u8, k as u8];
                SigningKey::from_bytes(&core::array::from_fn(|i| seed[i % 3])).verifying_key().to_bytes()
            })
        })
    };
    let empty = || RosterContent::first(swarm());
    let reads = |content: RosterContent| Roster::decode(&forced(&content)).map(|roster| roster.head().version);
    let members = |n| RosterContent {
        members: many(n, 1).map(|(name, key)| (name, Member { key, old: None })).collect(),
        ..empty()
    };
    let observers = |n| RosterContent { observers: many(n, 2).collect(), ..empty() };
    let revoked = |n| RosterContent {
        revoked: many(n, 3).map(|(name, key)| (key, Revoked { name, kept: Kept::new() })).collect(),
        ..empty()
    };
    let epochs = |n: usize| RosterContent {
        revoked: many(1, 3)
            .map(|(name, key)| (key, Revoked { name, kept: (0..n as u32).map(|e| (e, NonZero::<u32>::MIN)).collect() }))
            .collect(),
        ..empty()
    };
    let cases: [(&dyn Fn(usize) -> RosterContent, usize); 4] = [
        (&members, ROSTER_MEMBERS_MAX),
        (&observers, ROSTER_OBSERVERS_MAX),
        (&revoked, ROSTER_REVOKED_MAX),
        (&epochs, KEPT_EPOCHS_MAX),
    ];
    for (of, max) in cases {
        assert_eq!(reads(of(max)), Ok(1), "{max}");
        assert_eq!(Roster::sign(&swarm_key(), of(max + 1)).unwrap_err().reason(), "roster_too_many");
        assert_eq!(reads(of(max + 1)).unwrap_err().reason(), "roster_malformed", "{max}");
    }
    // As long as it may be, and a byte longer.
    let mut all = members(ROSTER_MEMBERS_MAX);
    all.revoked = revoked(ROSTER_REVOKED_MAX).revoked;
    let mut len = forced(&all).len();
    for revoked in all.revoked.values_mut() {
        let room = ROSTER_LEN_MAX - len;
        let more = (room / 2).min(KEPT_EPOCHS_MAX);
        revoked.kept = (0..more as u32).map(|epoch| (epoch, NonZero::<u32>::MIN)).collect();
        len += 2 * more;
    }
    if len < ROSTER_LEN_MAX {
        all.version = version(128); // one byte longer
    }
    assert_eq!(forced(&all).len(), ROSTER_LEN_MAX);
    let roster = Roster::sign(&swarm_key(), all.clone()).unwrap();
    assert_eq!(Roster::decode(&roster.encode()).unwrap(), roster);
    all.version = version(if all.version.get() == 128 { 1 << 14 } else { 128 });
    assert_eq!(Roster::sign(&swarm_key(), all.clone()), Err(StatementError::TooLong(ROSTER_LEN_MAX + 1)));
    assert_eq!(Roster::decode(&forced(&all)), Err(StatementError::TooLong(ROSTER_LEN_MAX + 1)));
}

/// Bytes that operators have in files: what was signed once is read by every later version.
#[test]
fn the_form_is_frozen() {
    let golden: [(&[u8], RosterContent); 2] = [
        (include_bytes!("../../golden/roster/all.bin"), content()),
        (include_bytes!("../../golden/roster/first.bin"), RosterContent::first(swarm())),
    ];
    for (bytes, content) in golden {
        let roster = Roster::sign(&swarm_key(), content).unwrap();
        assert_eq!(roster.encode(), bytes, "the form has changed: it needs another number");
        assert_eq!(Roster::decode(bytes), Ok(roster));
    }
}

#[test]
fn listed_are_members_by_all_their_keys_and_those_of_whom_something_stays() {
    let roster = signed(|_| {}).unwrap();
    let listed: BTreeMap<RobotId, Listed> = roster.listed().map(|listed| (listed.robot, listed)).collect();
    let of = |n: u8| {
        listed.get(&RobotId::of_key(&public(n))).map(|l| (l.name.as_str(), l.frozen.as_ref().map(BTreeMap::len)))
    };
    assert_eq!(listed.len(), 5);
    assert_eq!([0, 1, 11, 2].map(of), [("r0", None), ("r1", None), ("r1", None), ("r2", None)].map(Some));
    assert_eq!((of(31), of(30), of(20)), (Some(("r1", Some(2))), None, None));
}

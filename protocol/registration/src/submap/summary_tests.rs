use super::super::testing::room;
use super::*;
use proptest::prelude::*;

#[test]
fn a_summary_survives_the_wire_and_is_most_like_itself() {
    let (a, b) = (room(1).summary, room(2).summary);
    let bytes = a.encode();
    assert!(bytes.len() <= SUMMARY_LEN_MAX);
    assert_eq!(Summary::decode(&bytes).unwrap(), a);
    assert_eq!(a.similarity(&a), 1.0);
    assert_eq!(a.similarity(&b), b.similarity(&a));
    assert!((0.0..1.0).contains(&a.similarity(&b)));
}

#[test]
fn a_similarity_below_what_is_wanted_is_not_told_and_one_that_is_not_is() {
    let (a, b) = (room(1).summary, room(2).summary);
    let similarity = a.similarity(&b);
    for least in [0.0, similarity / 2.0, similarity] {
        assert_eq!(a.similarity_from(&b, least), Some(Similarity { value: similarity, by: Looks::Summary }));
    }
    for least in [similarity + 1e-12, similarity + 0.1, 1.0] {
        assert_eq!(a.similarity_from(&b, least), None);
    }
    assert_eq!(a.similarity_from(&a, 1.0), Some(Similarity { value: 1.0, by: Looks::Summary }));
}

#[test]
fn empty_submaps_and_other_scales_are_like_nothing() {
    let a = room(1).summary;
    let empty = Summary::new(VERSION, a.voxel, [0; WORDS]);
    assert_eq!((empty.similarity(&empty), empty.similarity(&a)), (0.0, 0.0));
    let with_voxel = |factor: f32| {
        let mut scaled = a.clone();
        scaled.voxel *= factor;
        scaled
    };
    assert!(a.similarity(&with_voxel(1.49)) > 0.0 && a.similarity(&with_voxel(1.0 / 1.49)) > 0.0);
    assert!(a.similarity(&with_voxel(1.51)) == 0.0 && a.similarity(&with_voxel(1.0 / 1.51)) == 0.0);
}

#[test]
fn each_kind_of_damage_is_named() {
    let bytes = room(1).summary.encode();
    for len in 0..bytes.len() {
        assert!(Summary::decode(&bytes[..len]).is_err(), "cut to {len}");
    }
    let damaged = |at: usize, with: &[u8]| {
        let mut bytes = bytes.clone();
        bytes[at..at + with.len()].copy_from_slice(with);
        Summary::decode(&bytes).unwrap_err()
    };
    assert_eq!(damaged(0, &[9]), SummaryError::UnknownLayout { version: 9, numbers: NUMBERS as u8 });
    for voxel in [f32::NAN, f32::INFINITY, 0.0, -0.1, 1e-5, 1e4] {
        assert_eq!(damaged(2, &voxel.to_le_bytes()), SummaryError::NotCanonical, "voxel {voxel}");
    }
    assert_eq!(damaged(HEADER_LEN, &[7; WORDS]), SummaryError::NotCanonical);
    let longer = [bytes.clone(), vec![0]].concat();
    assert_eq!(Summary::decode(&longer), Err(SummaryError::WrongLength { len: LEN + 1 }));
}

#[test]
fn which_way_is_up_survives_the_wire() {
    let plain = room(1).summary;
    assert_eq!((plain.up(), plain.encode().len()), (None, LEN));
    let up = Up::new([0.6, 0.0, -0.8], 0.02).unwrap();
    let upright = plain.clone().upright(Some(up));
    let bytes = upright.encode();
    assert_eq!((bytes.len(), Summary::decode(&bytes).as_ref()), (LEN + gravity::LEN, Ok(&upright)));
    let told = *upright.up().unwrap();
    assert!((told.direction() - up.direction()).norm() < 1e-4 && (0.02..0.0206).contains(&told.sigma()));
    // It says nothing of what the submap looks like.
    assert_eq!(upright.similarity(&plain), 1.0);
    for len in LEN..bytes.len() {
        assert_eq!(Summary::decode(&bytes[..len]), Err(SummaryError::WrongLength { len }));
    }
    let mut damaged = bytes.clone();
    damaged[LEN..LEN + 2].copy_from_slice(&i16::MIN.to_le_bytes());
    assert_eq!(Summary::decode(&damaged), Err(SummaryError::Up));
    let longer = [bytes, vec![0]].concat();
    assert_eq!(Summary::decode(&longer), Err(SummaryError::WrongLength { len: longer.len() }));
}

proptest! {
    #[test]
    fn any_bytes_are_refused_or_come_back_the_same(mut bytes in prop::collection::vec(any::<u8>(), 0..2 * LEN), fix in any::<bool>()) {
        if fix && bytes.len() >= HEADER_LEN {
            bytes.resize(LEN, 3);
            bytes[..2].copy_from_slice(&[VERSION, NUMBERS as u8]);
            bytes[2..HEADER_LEN].copy_from_slice(&0.1f32.to_le_bytes());
            bytes[HEADER_LEN] = 255;
            prop_assert!(Summary::decode(&bytes).is_ok());
        }
        if let Ok(summary) = Summary::decode(&bytes) {
            prop_assert_eq!(summary.encode(), bytes.clone());
        }
        if fix && bytes.len() == LEN {
            bytes[0] |= WITH_UP;
            bytes.extend([1, 2, 3, 4, 5]);
            prop_assert_eq!(Summary::decode(&bytes).map(|summary| summary.encode()), Ok(bytes));
        }
    }
}

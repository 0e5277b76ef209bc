use super::super::landmarks::{Codec, Constellation};
use super::super::testing::room;
use super::super::{Features, Keypoints};
use super::*;
use crate::ids::Hash;
use crate::submap::descriptor::PACKED_LEN;
use crate::submap::features::{ADDRESS_LEN, KEYPOINTS_MAX};
use proptest::prelude::*;

/// Bytes of a keypoint.
const POINT_LEN: usize = Block::<PACKED_LEN>::POINT_LEN;

fn damaged(at: usize, with: &[u8]) -> Result<Keypoints, BlockError> {
    let mut bytes = room(1).keypoints.encode();
    bytes[at..at + with.len()].copy_from_slice(with);
    Keypoints::decode(&bytes)
}

#[test]
fn what_was_described_is_what_was_decoded() {
    let described = room(1);
    assert_eq!(Keypoints::decode(&described.keypoints.encode()).unwrap(), described.keypoints);
    assert_eq!(Features::decode(&described.features.encode()).unwrap(), described.features);
    assert_eq!(described.keypoints.len(), 300);
    assert_eq!(described.keypoints.encode().len(), HEADER_LEN + 300 * POINT_LEN + ADDRESS_LEN);
    let first = described.keypoints.first(100);
    assert_eq!(first.surfels(), described.keypoints.surfels()[..100]);
}

#[test]
fn a_point_costs_21_bytes_and_330_with_an_address_fit_in_7_kb() {
    assert_eq!(POINT_LEN, 21);
    const { assert!(HEADER_LEN + 330 * POINT_LEN + ADDRESS_LEN <= 7000) };
    const { assert!(HEADER_LEN + 331 * POINT_LEN + ADDRESS_LEN > 7000) };
}

#[test]
fn a_blob_names_the_one_that_goes_on_with_it() {
    let described = room(1);
    let (first, further) = (&described.keypoints, described.further.as_ref().unwrap());
    let (bytes, address) = (first.encode(), Hash::of(&further.encode()));
    assert_eq!((first.further(), further.further()), (Some(address), None));
    assert_eq!((bytes[5], &bytes[bytes.len() - ADDRESS_LEN..]), (1, &address.0[..]));
    assert_eq!((Keypoints::address_in(&bytes), Keypoints::address_in(&further.encode())), (Some(address), None));
    let both = first.with_further(further).unwrap();
    assert_eq!((both.len(), both.further()), (first.len() + further.len(), None));
    assert_eq!(both.surfels(), [first.surfels(), further.surfels()].concat());
    // What is not of the same cloud is not added.
    let coarser = Block::new(0.2, 1.0);
    assert_eq!(first.with_further(&Keypoints::of_points(coarser)), None);
    let landmarks = Codec::new(0.1, &Constellation::default());
    assert_eq!(first.with_further(&Keypoints::of_landmarks(landmarks)), None);
}

#[test]
fn a_blob_that_goes_on_nowhere_or_otherwise_is_refused() {
    let bytes = room(1).keypoints.encode();
    for len in 0..bytes.len() {
        assert!(Keypoints::decode(&bytes[..len]).is_err(), "cut to {len}");
    }
    assert!(Keypoints::decode(&[&bytes[..], &[0]].concat()).is_err());
    let expected = bytes.len() - ADDRESS_LEN;
    assert_eq!(damaged(5, &[0]), Err(BlockError::WrongLength { len: bytes.len(), expected }));
    for spare in [2, 255] {
        assert!(matches!(damaged(5, &[spare]), Err(BlockError::UnknownLayout { .. })));
    }
    // The header is not taken for an address.
    let ones = [1; HEADER_LEN + ADDRESS_LEN];
    assert!((0..ones.len()).all(|len| Keypoints::address_in(&ones[..len]).is_none()));
    assert_eq!(Keypoints::address_in(&ones), Some(Hash([1; ADDRESS_LEN])));
}

#[test]
fn every_truncation_and_every_extension_is_refused() {
    let bytes = room(1).keypoints.first(5).encode();
    for len in 0..bytes.len() {
        assert!(Keypoints::decode(&bytes[..len]).is_err(), "cut to {len}");
    }
    let longer = [bytes.clone(), vec![0]].concat();
    let expected = bytes.len();
    assert_eq!(Keypoints::decode(&longer), Err(BlockError::WrongLength { len: expected + 1, expected }));
}

#[test]
fn each_kind_of_damage_is_named() {
    let (found, expected) = (*b"mf", *b"mk");
    assert_eq!(damaged(0, b"mf"), Err(BlockError::WrongKind { found, expected }));
    assert_eq!(damaged(2, &[1]), Err(BlockError::UnknownLayout { version: 1, dimensions: 32, bits: 3 }));
    assert_eq!(damaged(3, &[34]), Err(BlockError::UnknownLayout { version: 2, dimensions: 34, bits: 3 }));
    assert_eq!(damaged(4, &[8]), Err(BlockError::UnknownLayout { version: 2, dimensions: 32, bits: 8 }));
    for scale in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, 0.0, -0.1, f32::MIN_POSITIVE, 1e9] {
        assert_eq!(damaged(6, &scale.to_le_bytes()), Err(BlockError::BadScale), "voxel {scale}");
        assert_eq!(damaged(10, &scale.to_le_bytes()), Err(BlockError::BadScale), "step {scale}");
    }
    for count in [1025, u32::MAX] {
        let refused = Err(BlockError::TooManyPoints { count, max: KEYPOINTS_MAX });
        assert_eq!(damaged(14, &count.to_le_bytes()), refused);
    }
    assert!(matches!(damaged(14, &1024u32.to_le_bytes()), Err(BlockError::WrongLength { .. })));
    let second = HEADER_LEN + POINT_LEN;
    for (at, with) in [(0, &i16::MIN.to_le_bytes()[..]), (6, &[255]), (7, &[255])] {
        assert_eq!(damaged(second + at, with), Err(BlockError::NotCanonical { index: 1 }), "byte {at}");
    }
}

#[test]
fn positions_keep_to_half_a_step_and_far_points_are_left_out() {
    let normal = Normal { direction: Vector3::z(), roughness: Some(0.13), neighbours: 9 };
    let block = Block::<0>::new(0.1, 1.0);
    let at = Vector3::new(0.1234, -51.19, 0.5);
    let surfel = block.surfel(&block.store(&at, &normal, []).unwrap());
    assert!((surfel.position - at).amax() <= 0.5 * 0.1 / STEPS_PER_VOXEL * 1.001);
    assert!((surfel.roughness.unwrap() - 0.013).abs() <= 0.5 * 0.1 / ROUGHNESS_LEVELS_PER_VOXEL * 1.001);
    assert_eq!(block.store(&Vector3::new(51.3, 0.0, 0.0), &normal, []), None);
    // A wider cloud takes a coarser step, but never coarser than a sixteenth of a voxel.
    let wide = Block::<0>::new(0.1, 150.0);
    assert!(wide.store(&Vector3::new(150.0, 0.0, 0.0), &normal, []).is_some());
    let absurd = Block::<0>::new(0.1, 1e6);
    assert!(absurd.store(&Vector3::new(204.0, 0.0, 0.0), &normal, []).is_some());
    assert!(absurd.store(&Vector3::new(206.0, 0.0, 0.0), &normal, []).is_none());
    assert!(absurd.reaches(&[204.0, 0.0, 0.0]) && !absurd.reaches(&[0.0, -206.0, 0.0]));
}

proptest! {
    #[test]
    fn normals_come_back_within_a_degree(x in -1.0..1.0f64, y in -1.0..1.0f64, z in -1.0..1.0f64) {
        let Some(n) = Vector3::new(x, y, z).try_normalize(1e-3) else { return Ok(()) };
        let code = octahedral(&n);
        let back = from_octahedral(code);
        prop_assert!(back.dot(&n) > 1.0_f64.to_radians().cos(), "{n} {back}");
        prop_assert!((back.norm() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn any_bytes_are_refused_or_come_back_the_same(
        mut bytes in prop::collection::vec(any::<u8>(), 0..HEADER_LEN + 4 * POINT_LEN),
        honest_header in any::<bool>(),
        goes_on in any::<bool>(),
    ) {
        if honest_header && bytes.len() >= HEADER_LEN {
            let header = Block::<PACKED_LEN>::new(0.1, 1.0).encode(*b"mk");
            bytes[..HEADER_LEN].copy_from_slice(&header);
            let count = (bytes.len() - HEADER_LEN) / POINT_LEN;
            bytes.truncate(HEADER_LEN + count * POINT_LEN);
            bytes[14..18].copy_from_slice(&(count as u32).to_le_bytes());
            if goes_on {
                bytes[5] = 1;
                bytes.extend([7; ADDRESS_LEN]);
            }
        }
        if let Ok(keypoints) = Keypoints::decode(&bytes) {
            prop_assert_eq!(keypoints.encode(), bytes);
            prop_assert!(keypoints.surfels().iter().all(|s| s.position.iter().chain(&s.normal).all(|x| x.is_finite())));
        }
    }
}

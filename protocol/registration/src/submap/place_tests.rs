use super::super::testing::{keyframe, room};
use super::super::{KeyframeError, Submap, SubmapBuilder, Summary, SummaryError};
use super::*;
use crate::config::SubmapConfig;
use crate::geometry::Se3;
use crate::submap::{Looks, Up};
use nalgebra::Vector3;
use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// A vector of so many numbers, roughly normal.
fn vector(rng: &mut ChaCha8Rng, numbers: usize) -> Vec<f32> {
    let mut uniform = || (rng.next_u32() as f32 / u32::MAX as f32) - 0.5;
    (0..numbers).map(|_| (0..6).map(|_| uniform()).sum()).collect()
}

fn descriptor(metric: Metric, vector: Vec<f32>) -> PlaceDescriptor {
    PlaceDescriptor::new("net", metric, vector).unwrap()
}

fn place_of(descriptors: &[PlaceDescriptor]) -> Option<Place> {
    let mut mean = PlaceMean::default();
    descriptors.iter().for_each(|one| mean.add(one));
    mean.finish()
}

fn place(metric: Metric, vector: &[f32]) -> Place {
    place_of(&[descriptor(metric, vector.to_vec())]).unwrap()
}

fn exact(metric: Metric, a: &[f32], b: &[f32]) -> f64 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(&x, &y)| f64::from(x) * f64::from(y)).sum::<f64>();
    let (of_a, of_b) = (dot(a, a).sqrt(), dot(b, b).sqrt());
    match metric {
        Metric::Cosine => (dot(a, b) / (of_a * of_b)).max(0.0),
        Metric::Euclidean => 1.0 - (of_a * of_a + of_b * of_b - 2.0 * dot(a, b)).max(0.0).sqrt() / (of_a + of_b),
    }
}

#[test]
fn what_travels_is_as_alike_as_what_was_handed_over() {
    let mut rng = ChaCha8Rng::seed_from_u64(5);
    for metric in [Metric::Cosine, Metric::Euclidean] {
        // Rounding to a byte alone, and folding: four standard deviations of it.
        for (numbers, off) in [(2, 0.01), (128, 0.01), (256, 0.01), (257, 0.25), (4096, 0.25)] {
            for mixed in [0.0, 0.5, 0.9] {
                let (a, other) = (vector(&mut rng, numbers), vector(&mut rng, numbers));
                let b: Vec<f32> = a.iter().zip(&other).map(|(a, b)| 3.0 * (a * mixed + b * (1.0 - mixed))).collect();
                let found = place(metric, &a).similarity(&place(metric, &b)).unwrap();
                let expected = exact(metric, &a, &b);
                assert!((found - expected).abs() < off, "{metric:?} {numbers} {mixed}: {found}, not {expected}");
                assert!(place(metric, &a).similarity(&place(metric, &a)).unwrap() > 0.999);
            }
        }
    }
}

#[test]
fn folding_keeps_cosines_on_average() {
    let mut rng = ChaCha8Rng::seed_from_u64(6);
    let (mut sum, mut squares, runs) = (0.0, 0.0, 200);
    for _ in 0..runs {
        let (a, other) = (vector(&mut rng, 1024), vector(&mut rng, 1024));
        let b: Vec<f32> = a.iter().zip(&other).map(|(a, b)| a + b).collect();
        let found = place(Metric::Cosine, &a).similarity(&place(Metric::Cosine, &b)).unwrap();
        let off = found - exact(Metric::Cosine, &a, &b);
        (sum, squares) = (sum + off, squares + off * off);
    }
    let (mean, sigma) = (sum / f64::from(runs), (squares / f64::from(runs)).sqrt());
    assert!(mean.abs() < 0.01 && sigma < 1.0 / 16.0, "off by {mean:.3} with a standard deviation of {sigma:.3}");
}

/// Numbers that are never negative, as of many networks: without signs all would look alike.
#[test]
fn folding_keeps_apart_what_has_a_mean() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    for _ in 0..20 {
        let [a, b] = [(); 2].map(|()| vector(&mut rng, 2048).into_iter().map(f32::abs).collect::<Vec<f32>>());
        let found = place(Metric::Cosine, &a).similarity(&place(Metric::Cosine, &b)).unwrap();
        let expected = exact(Metric::Cosine, &a, &b);
        assert!((found - expected).abs() < 0.15, "{found}, not {expected}");
    }
}

#[test]
fn only_one_kind_is_compared() {
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let numbers = vector(&mut rng, 300);
    let one = place(Metric::Cosine, &numbers);
    let other_model = PlaceDescriptor::new("another", Metric::Cosine, numbers.clone()).unwrap();
    assert_eq!(one.similarity(&place_of(&[other_model]).unwrap()), None);
    assert_eq!(one.similarity(&place(Metric::Euclidean, &numbers)), None);
    assert_eq!(one.similarity(&place(Metric::Cosine, &numbers[..299])), None);
    assert!(one.similarity(&one.clone()).is_some());
}

#[test]
fn vectors_that_say_nothing_are_refused() {
    let refused = |model: &str, vector: Vec<f32>| PlaceDescriptor::new(model, Metric::Cosine, vector).unwrap_err();
    assert_eq!(refused("", vec![1.0]), PlaceError::Length(1));
    assert_eq!(refused("", vec![1.0; VECTOR_LEN_MAX + 1]), PlaceError::Length(VECTOR_LEN_MAX + 1));
    assert_eq!(refused("", vec![1.0, f32::NAN]), PlaceError::Number(1));
    assert_eq!(refused("", vec![f32::INFINITY, 0.0]), PlaceError::Number(0));
    assert_eq!(refused("", vec![0.0, 2.0 * NUMBER_MAX]), PlaceError::Number(1));
    assert_eq!(refused("", vec![0.0; 8]), PlaceError::Zero);
    assert_eq!(refused(&"x".repeat(MODEL_LEN_MAX + 1), vec![1.0; 2]), PlaceError::Model(MODEL_LEN_MAX + 1));
    for (model, vector) in
        [("x".repeat(MODEL_LEN_MAX), vec![NUMBER_MAX; VECTOR_LEN_MAX]), (String::new(), vec![1.0; 2])]
    {
        let descriptor = PlaceDescriptor::new(&model, Metric::Euclidean, vector).unwrap();
        assert!(place_of(&[descriptor.clone(), descriptor]).is_some());
    }
}

#[test]
fn a_submap_has_the_mean_of_its_keyframes() {
    let cosine = |vector: &[f32]| descriptor(Metric::Cosine, vector.to_vec());
    // Only the direction of each counts.
    let mean = place_of(&[cosine(&[10.0, 0.0]), cosine(&[0.0, 0.1])]).unwrap();
    assert_eq!(mean.similarity(&place(Metric::Cosine, &[1.0, 1.0])), Some(1.0));
    let far = |vector: &[f32]| descriptor(Metric::Euclidean, vector.to_vec());
    let mean = place_of(&[far(&[10.0, 0.0]), far(&[0.0, 2.0])]).unwrap();
    assert!(mean.similarity(&place(Metric::Euclidean, &[5.0, 1.0])).unwrap() > 0.99);
    assert_eq!(place_of(&[cosine(&[1.0, 0.0]), cosine(&[-1.0, 0.0])]), None, "they cancel out");
    assert_eq!(place_of(&[]), None);
}

/// Three keyframes of which the second and third have these places.
fn submap(places: [PlaceDescriptor; 2]) -> Result<Submap, KeyframeError> {
    let mut builder = SubmapBuilder::new(SubmapConfig::default());
    let [second, third] = places;
    for (stamp, place) in [(1, None), (2, Some(second)), (3, Some(third))] {
        let keyframe = keyframe(stamp, Se3::identity(), &[Vector3::new(1.0, 2.0, 3.0)]);
        builder.push(crate::submap::Keyframe { place, ..keyframe })?;
    }
    Ok(builder.flush().unwrap())
}

#[test]
fn the_way_through_a_submap_leads_into_its_summary() {
    let made =
        submap([descriptor(Metric::Cosine, vec![1.0, 0.0, 1.0]), descriptor(Metric::Cosine, vec![0.0, 1.0, 1.0])]);
    let described = crate::submap::describe(&made.unwrap(), &SubmapConfig::default());
    let without = room(1).summary;
    let expected = without.clone().at(Some(place(Metric::Cosine, &[1.0, 1.0, 2.0])));
    let similarity = described.summary.similarity_from(&expected, 0.0).unwrap();
    assert!(similarity.by == Looks::Place && similarity.value > 0.999, "{similarity:?}");
    assert_eq!(described.summary.similarity_from(&without, 0.0).unwrap().by, Looks::Summary);
    // A submap whose keyframes say different kinds of things is none.
    let other = submap([descriptor(Metric::Cosine, vec![1.0; 3]), descriptor(Metric::Cosine, vec![1.0; 4])]);
    assert_eq!(other, Err(KeyframeError::OtherPlace { numbers: 4, model: "net".into() }));
}

#[test]
fn what_cannot_be_aligned_is_not_proposed_however_alike_its_place() {
    let here = place(Metric::Cosine, &[1.0, 2.0]);
    let with_voxel = |voxel: f64| {
        let mut shares = [0.0; WORDS];
        shares[0] = 1.0;
        Summary::of_shares(voxel, &shares).at(Some(here.clone()))
    };
    let between = |a: f64, b: f64| with_voxel(a).similarity_from(&with_voxel(b), 0.0).unwrap();
    assert_eq!((between(0.1, 0.1).by, between(0.1, 0.14).by), (Looks::Place, Looks::Place));
    assert_eq!((between(0.1, 0.2).value, between(0.2, 0.1).value), (0.0, 0.0));
}

#[test]
fn a_summary_with_a_place_survives_the_wire_and_is_no_longer_than_it_may_be() {
    let mut rng = ChaCha8Rng::seed_from_u64(8);
    for numbers in [2, 128, 256, 4096] {
        let summary = room(1).summary.at(Some(place(Metric::Euclidean, &vector(&mut rng, numbers))));
        let bytes = summary.encode();
        assert_eq!(Summary::decode(&bytes).unwrap(), summary);
        assert!(bytes.len() <= crate::submap::SUMMARY_LEN_MAX, "{}", bytes.len());
        let plain = room(1).summary.encode().len();
        for len in plain..plain + HEADER_LEN + VECTOR_LEN_MIN {
            assert_eq!(Summary::decode(&bytes[..len]), Err(SummaryError::Place), "cut to {len}");
        }
        let damaged = |at: usize, with: &[u8]| {
            let mut bytes = bytes.clone();
            bytes[plain + at..plain + at + with.len()].copy_from_slice(with);
            Summary::decode(&bytes)
        };
        assert_eq!(damaged(0, &[2]), Err(SummaryError::Place), "no metric");
        for step in [f32::NAN, 0.0, -1.0, f32::INFINITY, 1e-13, 2.0 * STEP_MAX] {
            assert_eq!(damaged(5, &step.to_le_bytes()), Err(SummaryError::Place), "{step}");
        }
        let smaller = vec![3; numbers.min(NUMBERS_MAX)];
        assert_eq!(damaged(HEADER_LEN, &smaller), Err(SummaryError::Place), "not scaled to its largest");
    }
    let longest = room(1).summary.at(Some(place(Metric::Cosine, &vector(&mut rng, 256)))).encode();
    let longer = [longest, vec![0]].concat();
    assert_eq!(Summary::decode(&longer), Err(SummaryError::WrongLength { len: longer.len() }));
}

#[test]
fn the_longest_place_leaves_room_for_what_is_up() {
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let up = Up::new([0.0, 1.0, 0.0], 0.02).unwrap();
    for (numbers, kept) in [(252, 252), (253, 252), (256, 252), (4096, 252)] {
        let (a, b) = (vector(&mut rng, numbers), vector(&mut rng, numbers));
        let mixed: Vec<f32> = a.iter().zip(&b).map(|(a, b)| a + 0.3 * b).collect();
        for metric in [Metric::Cosine, Metric::Euclidean] {
            let at = |vector: &[f32]| room(1).summary.at(Some(place(metric, vector)));
            let (whole, upright) = (at(&a), at(&mixed).upright(Some(up)));
            let bytes = upright.encode();
            assert_eq!(Summary::decode(&bytes).as_ref(), Ok(&upright));
            let spare = crate::submap::SUMMARY_LEN_MAX - bytes.len();
            assert_eq!(spare, NUMBERS_BESIDE_UP_MAX - kept, "{numbers}");
            // The few numbers that are left out hardly matter, and both ways round alike.
            let (found, back) = (whole.similarity_from(&upright, 0.0), upright.similarity_from(&whole, 0.0));
            let exact = whole.similarity_from(&at(&mixed), 0.0).unwrap();
            assert_eq!(found, back);
            assert!(found.unwrap().by == Looks::Place && (found.unwrap().value - exact.value).abs() < 0.03);
        }
    }
    // Places of the same kind, one of which is too short for anything to have been left out of it.
    let mut cut = place(Metric::Cosine, &[1.0; 256]);
    cut.numbers.truncate(251);
    assert_eq!(cut.similarity(&place(Metric::Cosine, &[1.0; 256])), None);
}

proptest! {
    #[test]
    fn any_bytes_are_no_place_or_come_back_the_same(mut bytes in prop::collection::vec(any::<u8>(), 0..LEN_MAX + 9), fix in any::<bool>()) {
        if fix && bytes.len() > HEADER_LEN {
            bytes[0] &= 1;
            bytes[5..HEADER_LEN].copy_from_slice(&0.25f32.to_le_bytes());
            let numbers = &mut bytes[HEADER_LEN..];
            numbers.iter_mut().filter(|x| **x == 0x80).for_each(|x| *x = 0);
            numbers[0] = 127;
        }
        let place = Place::decode(&bytes);
        if fix && (HEADER_LEN + VECTOR_LEN_MIN..=LEN_MAX).contains(&bytes.len()) {
            prop_assert!(place.is_some());
        }
        if let Some(place) = place {
            prop_assert_eq!(place.encode(), bytes);
            let same = place.similarity(&place);
            prop_assert!(same.is_some_and(|same| (0.99..=1.0).contains(&same)), "{:?}", same);
        }
    }
}

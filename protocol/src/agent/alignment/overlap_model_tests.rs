use super::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

const SENSORS: [Sensor; 5] =
    [Sensor::Points3d, Sensor::Lidar3d, Sensor::Laser2d, Sensor::Landmarks, Sensor::Landmarks2d];

fn features(similarity: f64, apart: Option<f64>) -> OverlapFeatures {
    OverlapFeatures { similarity: Similarity { value: similarity, by: Looks::Summary }, apart }
}

#[test]
fn the_more_alike_and_the_nearer_the_more_probable() {
    for sensor in SENSORS {
        let model = OverlapModel::new(sensor);
        let of = |similarity, apart| model.predict(features(similarity, apart)).probability;
        let usual = Usual::of(sensor).similarity;
        assert!(of(usual + 0.1, None) > of(usual, None) && of(usual, None) > of(usual - 0.1, None), "{sensor:?}");
        assert!(of(usual, Some(0.1)) > of(usual, Some(0.5)) && of(usual, Some(0.5)) > of(usual, Some(0.9)));
        assert!(of(usual, Some(0.0)) > of(usual, None));
    }
}

/// Evenly from 0 to 1.
fn unit(rng: &mut ChaCha8Rng) -> f64 {
    (rng.next_u64() >> 11) as f64 / (1u64 << 53) as f64
}

/// A place where similarity tells more than is usual, in which two thirds of all tries are in vain.
fn place(rng: &mut ChaCha8Rng) -> (OverlapFeatures, bool) {
    let similarity = 0.8 + 0.16 * unit(rng);
    let apart = (unit(rng) < 0.5).then(|| unit(rng));
    let odds = -2.0 + 30.0 * (similarity - 0.88) + apart.map_or(0.0, |apart| 4.0 - 9.0 * apart);
    (features(similarity, apart), unit(rng) < logistic(odds))
}

/// Mean squared error of a probability, and by how much what was expected of each fifth of all tries is off, at most.
fn judged(of: &mut [(f64, bool)]) -> (f64, f64) {
    of.sort_by(|a, b| a.0.total_cmp(&b.0));
    let came = |&(_, aligned): &(f64, bool)| f64::from(u8::from(aligned));
    let error = of.iter().map(|one| (one.0 - came(one)).powi(2)).sum::<f64>() / of.len() as f64;
    let off = |part: &[(f64, bool)]| part.iter().map(|one| one.0 - came(one)).sum::<f64>() / part.len() as f64;
    (error, of.chunks(of.len() / 5).map(off).fold(0.0, |most: f64, off| most.max(off.abs())))
}

#[test]
fn what_is_expected_comes_about_in_a_place_that_is_not_as_usual() {
    let (mut learned, mut usual) = (Vec::new(), Vec::new());
    for seed in 0..20 {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (mut model, prior) = (OverlapModel::new(Sensor::Lidar3d), OverlapModel::new(Sensor::Lidar3d));
        for _ in 0..300 {
            let (features, aligned) = place(&mut rng);
            learned.push((model.predict(features).probability, aligned));
            usual.push((prior.predict(features).probability, aligned));
            model.learn(&features, aligned);
        }
    }
    let (error, off) = judged(&mut learned);
    assert!(off < 0.05 && error < 0.15, "off by {off:.3}, error {error:.3}");
    // The judge bites: without learning it is off.
    let (error, off) = judged(&mut usual);
    assert!(off > 0.1 && error > 0.16, "off by {off:.3}, error {error:.3}");
}

#[test]
fn nothing_that_comes_about_breaks_it() {
    for sensor in SENSORS {
        for (aligned, alternating) in [(true, false), (false, false), (true, true)] {
            let mut model = OverlapModel::new(sensor);
            for k in 0..20_000u32 {
                let far =
                    [features(0.0, None), features(1.0, Some(0.0)), features(0.0, Some(1.0)), features(1.0, None)];
                let one = far[k as usize % far.len()];
                model.learn(&one, aligned ^ (alternating && k % 3 == 0));
                let Prediction { probability, .. } = model.predict(one);
                assert!((0.0..=1.0).contains(&probability), "{sensor:?} after {k}: {probability}");
            }
            assert!(model.by_summary.covariance.cholesky().is_some(), "{sensor:?}: {model:?}");
        }
    }
}

/// A robot that has met nobody for long takes few tries to expect something again.
#[test]
fn what_was_learned_is_not_for_ever() {
    let mut model = OverlapModel::new(Sensor::Lidar3d);
    let one = features(0.9, None);
    (0..2_000).for_each(|_| model.learn(&one, false));
    assert!(model.predict(one).probability < 0.02);
    (0..8).for_each(|_| model.learn(&one, true));
    assert!(model.predict(one).probability > 0.2, "{}", model.predict(one).probability);
}

/// What the user's own descriptors are worth is learned apart: neither spoils the other.
#[test]
fn each_kind_of_similarity_is_learned_for_itself() {
    let by_place = |value| OverlapFeatures { similarity: Similarity { value, by: Looks::Place }, apart: None };
    let mut model = OverlapModel::new(Sensor::Lidar3d);
    let before = model.predict(features(0.9, None));
    for k in 0..200 {
        let alike = k % 2 == 0;
        model.learn(&by_place(if alike { 0.6 } else { 0.4 }), alike);
    }
    let of = |value| model.predict(by_place(value)).probability;
    assert!(of(0.6) > 0.9 && of(0.4) < 0.1, "{} {}", of(0.6), of(0.4));
    assert_eq!(model.predict(features(0.9, None)), before);
}

//! Clouds without a header: 32-bit floats, little-endian. KITTI's have four numbers a point, the fourth a reflectance;
//! nuScenes writes a fifth, the number of the laser, and nothing in the file says so. Read as fours such a file is a
//! heap of points that are none, so what the fourth number is gets looked at.

use super::bounded::{Read, bounded};
use super::error::Problem;
use super::remark::Remark;

/// Largest number of a laser: no LiDAR has more.
const RING_MAX: f32 = 255.0;
/// Largest reflectance that is a whole number: 16 bits.
const REFLECTANCE_MAX: f32 = 65_535.0;

/// Points of `x y z reflectance`, or of nuScenes' `x y z intensity ring` where it is certain.
pub(super) fn kitti(bytes: &[u8]) -> Result<Read, Problem> {
    let (words, rest) = bytes.as_chunks::<4>();
    let floats: Vec<f32> = words.iter().map(|word| f32::from_le_bytes(*word)).collect();
    let fours = floats.as_chunks::<4>();
    let fives = floats.as_chunks::<5>();
    let is_whole_fours = rest.is_empty() && fours.1.is_empty();
    let odd = fours.0.iter().position(|point| !is_reflectance(point[3]));
    let is_whole_fives = rest.is_empty() && fives.1.is_empty() && !fives.0.is_empty();
    let is_five = |point: &[f32; 5]| is_reflectance(point[3]) && is_ring(point[4]);
    if is_whole_fives && (odd.is_some() || !is_whole_fours) && fives.0.iter().all(is_five) {
        return read(fives.0, vec![Remark::Five]);
    }
    if !is_whole_fours {
        return Err(Problem::BinLength { found: bytes.len(), fives: is_whole_fives });
    }
    match odd {
        Some(index) => Err(Problem::Reflectance { index, value: fours.0[index][3] }),
        None => read(fours.0, Vec::new()),
    }
}

fn read<const N: usize>(points: &[[f32; N]], remarks: Vec<Remark>) -> Result<Read, Problem> {
    bounded(points.len() as u64)?;
    let points = points.iter().map(|point| [0, 1, 2].map(|axis| f64::from(point[axis]))).collect();
    Ok(Read { points, remarks })
}

/// Not negative, and no larger than sensors state it. Coordinates are negative behind a sensor and at its right.
fn is_reflectance(value: f32) -> bool {
    (0.0..=REFLECTANCE_MAX).contains(&value)
}

fn is_ring(value: f32) -> bool {
    (0.0..=RING_MAX).contains(&value) && value.fract() == 0.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn bytes(floats: &[f32]) -> Vec<u8> {
        floats.iter().flat_map(|x| x.to_le_bytes()).collect()
    }

    /// `n` points all around, each with further numbers.
    fn scan<const N: usize>(seed: u64, n: usize, more: impl Fn(&mut ChaCha8Rng) -> [f32; N]) -> Vec<Vec<f32>> {
        let rng = &mut ChaCha8Rng::seed_from_u64(seed);
        let point = |_| {
            let at = [rng.random_range(-50.0..50.0), rng.random_range(-50.0..50.0), rng.random_range(-2.0_f32..4.0)];
            [&at[..], &more(rng)].concat()
        };
        (0..n).map(point).collect()
    }

    fn told(points: &[Vec<f32>]) -> Result<(usize, Vec<Remark>), Problem> {
        kitti(&bytes(&points.concat())).map(|read| {
            for (point, want) in read.points.iter().zip(points) {
                assert_eq!(point.map(|c| c as f32), want[..3], "each point where it was written");
            }
            (read.points.len(), read.remarks)
        })
    }

    #[test]
    fn fives_are_read_as_such_whatever_their_number_and_fours_as_fours() {
        for seed in 0..40 {
            // Every fourth count of fives divides evenly into fours.
            let n = 20 + seed as usize;
            let five = scan(seed, n, |rng| [rng.random_range(0..256) as f32, rng.random_range(0..32) as f32]);
            assert_eq!(told(&five).unwrap(), (n, vec![Remark::Five]), "seed {seed}");
            for largest in [1.0, 255.0] {
                let four = scan(seed, n, |rng| [rng.random_range(0.0..largest)]);
                assert_eq!(told(&four).unwrap(), (n, vec![]), "seed {seed}");
            }
        }
        let dark = scan(1, 20, |_| [0.0]);
        assert_eq!(told(&dark).unwrap(), (20, vec![]));
    }

    #[test]
    fn other_numbers_of_floats_are_refused_with_the_cure() {
        for seed in 0..20 {
            // Sixes and threes that divide evenly into fours; fives whose fifth is a time.
            let others = [
                scan(seed, 40, |rng| [0.5, rng.random_range(0..32) as f32, rng.random_range(-0.1..0.0)]).concat(),
                scan(seed, 40, |_| []).concat(),
                scan(seed, 40, |rng| [0.5, rng.random_range(0.0..0.1)]).concat(),
            ];
            for floats in others {
                let error = kitti(&bytes(&floats)).err().unwrap();
                assert!(matches!(error, Problem::Reflectance { .. }), "{error}");
                let error = error.to_string();
                assert!(error.contains("xyz-bin") && error.contains("four 32-bit floats"), "{error}");
            }
        }
        let odd = kitti(&bytes(&scan(1, 41, |rng| [0.5, rng.random_range(0.0..0.1)]).concat())).err().unwrap();
        assert!(matches!(odd, Problem::BinLength { found: 820, fives: true }), "{odd}");
        assert!(odd.to_string().contains("41 points of five"), "{odd}");
    }
}

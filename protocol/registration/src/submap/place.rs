//! What a user's own place recognition (NetVLAD and the like) says of a keyframe: a vector that means nothing to us,
//! and how two of them are compared. A submap's is the mean of its keyframes'; it travels in the summary, a byte a
//! number, and where two submaps have one of the same kind it takes our own descriptor's place in proposing what to
//! align.
//!
//! Longer vectors are folded to [`NUMBERS_MAX`] numbers by signed hashing (Weinberger et al. 2009, "Feature hashing"):
//! a cosine c stays what it is but for (1 − c²) / 16, a distance but for 1/23 of itself (one standard deviation).
//! Whiten and shorten them yourself if you can do better.

use super::summary::WORDS;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Numbers of a submap's vector on the wire at most.
pub const NUMBERS_MAX: usize = 256;
/// Numbers of a keyframe's vector at least...
pub const VECTOR_LEN_MIN: usize = 2;
/// ...and at most.
pub const VECTOR_LEN_MAX: usize = 16_384;
/// Bytes of a model's name at most.
pub const MODEL_LEN_MAX: usize = 64;
/// Largest number of a vector, either sign.
pub const NUMBER_MAX: f32 = 1e6;
/// Shortest vector that has a direction.
const LENGTH_MIN: f64 = 1e-6;
/// Numbers at most beside what is known of the vertical, which must find room as well; the last of more are left out.
const NUMBERS_BESIDE_UP_MAX: usize = NUMBERS_MAX - 4;
/// Bytes before the numbers: metric, kind, size of one step.
const HEADER_LEN: usize = 9;
/// Bytes of an encoded place at most.
pub(super) const LEN_MAX: usize = HEADER_LEN + NUMBERS_MAX;
/// The largest number of an encoded place.
const STEPS: i8 = i8::MAX;
/// Smallest step of one...
const STEP_MIN: f64 = 1e-12;
/// ...and largest: [`VECTOR_LEN_MAX`] of the largest numbers in one place.
const STEP_MAX: f32 = 1e9;

/// The same beside what is known of the vertical.
pub(super) const LEN_BESIDE_UP_MAX: usize = HEADER_LEN + NUMBERS_BESIDE_UP_MAX;

const _: () = assert!(super::summary::HEADER_LEN + WORDS + LEN_MAX <= super::SUMMARY_LEN_MAX);
const _: () =
    assert!(super::summary::HEADER_LEN + WORDS + super::gravity::LEN + LEN_BESIDE_UP_MAX <= super::SUMMARY_LEN_MAX);

/// How two vectors are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Metric {
    /// By the angle between them.
    Cosine,
    /// By their distance.
    Euclidean,
}

/// A keyframe's vector.
#[derive(Clone, Debug, PartialEq)]
pub struct PlaceDescriptor {
    model: Box<str>,
    metric: Metric,
    vector: Box<[f32]>,
}

/// Why a vector is refused.
#[derive(Clone, Debug, Error, PartialEq)]
pub enum PlaceError {
    /// Too short or too long.
    #[error("a place vector has {VECTOR_LEN_MIN} to {VECTOR_LEN_MAX} numbers, not {0}")]
    Length(usize),
    /// A number is NaN, infinite or too large.
    #[error("number {0} of the place vector is not finite or beyond {NUMBER_MAX:e}")]
    Number(usize),
    /// Nothing can be told from a vector without a direction.
    #[error("the place vector is zero; leave it out where nothing is recognised")]
    Zero,
    /// The name of what made it is too long.
    #[error("the name of the place vector's model has {0} bytes, more than {MODEL_LEN_MAX}")]
    Model(usize),
}

impl PlaceDescriptor {
    /// What `model` (a name, the same on all robots that run the same network; may be empty) says of a keyframe.
    ///
    /// # Errors
    /// [`PlaceError`].
    pub fn new(model: &str, metric: Metric, vector: Vec<f32>) -> Result<Self, PlaceError> {
        if model.len() > MODEL_LEN_MAX {
            return Err(PlaceError::Model(model.len()));
        }
        if !(VECTOR_LEN_MIN..=VECTOR_LEN_MAX).contains(&vector.len()) {
            return Err(PlaceError::Length(vector.len()));
        }
        let is_sane = |x: &f32| x.abs() <= NUMBER_MAX; // false for NaN
        if let Some(index) = vector.iter().position(|x| !is_sane(x)) {
            return Err(PlaceError::Number(index));
        }
        let made = Self { model: model.into(), metric, vector: vector.into() };
        if made.length() < LENGTH_MIN { Err(PlaceError::Zero) } else { Ok(made) }
    }

    /// What made it.
    pub fn model(&self) -> &str {
        &self.model
    }

    /// How it is compared.
    pub fn metric(&self) -> Metric {
        self.metric
    }

    /// The numbers.
    pub fn vector(&self) -> &[f32] {
        &self.vector
    }

    fn length(&self) -> f64 {
        libm::sqrt(self.vector.iter().map(|&x| f64::from(x) * f64::from(x)).sum())
    }

    fn kind(&self) -> Kind {
        let named = blake3::hash(format!("{} {}", self.vector.len(), self.model).as_bytes());
        let [a, b, c, d, ..] = *named.as_bytes();
        Kind { metric: self.metric, hash: [a, b, c, d] }
    }

    /// Its numbers as they are averaged: folded, and of length 1 where only the direction counts.
    fn folded(&self) -> Vec<f64> {
        let unit = if self.metric == Metric::Cosine { 1.0 / self.length() } else { 1.0 };
        let mut folded = vec![0.0; self.vector.len().min(NUMBERS_MAX)];
        for (index, &x) in (0..).zip(&self.vector) {
            let (place, sign) = if self.vector.len() > NUMBERS_MAX { fold(index) } else { (index as usize, 1.0) };
            folded[place] += f64::from(x) * unit * sign;
        }
        folded
    }
}

/// Where a number of a long vector is added, and with which sign. SplitMix64 (Steele, Lea & Flood 2014) scatters well,
/// and is the same on every robot for all time.
fn fold(index: u64) -> (usize, f64) {
    let mut z = index.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^= z >> 31;
    ((z % NUMBERS_MAX as u64) as usize, if z >> 63 == 0 { 1.0 } else { -1.0 })
}

/// What can be compared with one another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Kind {
    metric: Metric,
    /// Of length and model.
    hash: [u8; 4],
}

/// The mean of keyframes' vectors of one kind.
#[derive(Clone, Debug, Default)]
pub(super) struct PlaceMean {
    kind: Option<Kind>,
    sum: Vec<f64>,
    count: usize,
}

impl PlaceMean {
    /// Whether the vector is of the same kind as those before.
    pub(super) fn takes(&self, descriptor: &PlaceDescriptor) -> bool {
        self.kind.is_none_or(|kind| kind == descriptor.kind())
    }

    /// Adds one that it takes.
    pub(super) fn add(&mut self, descriptor: &PlaceDescriptor) {
        let folded = descriptor.folded();
        self.kind = Some(descriptor.kind());
        self.sum.resize(folded.len(), 0.0);
        self.sum.iter_mut().zip(folded).for_each(|(sum, x)| *sum += x);
        self.count += 1;
    }

    /// `None` without any, or if they cancel out.
    pub(super) fn finish(&self) -> Option<Place> {
        let most = self.sum.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        let step = most / (f64::from(STEPS) * self.count as f64);
        let numbers = self.sum.iter().map(|x| (x / most * f64::from(STEPS)).round() as i8).collect();
        (step >= STEP_MIN).then_some(self.kind).flatten().map(|kind| Place::new(kind, step as f32, numbers))
    }
}

/// A submap's vector, as it travels.
#[derive(Clone, Debug, PartialEq)]
pub struct Place {
    kind: Kind,
    /// Size of one step of the numbers.
    step: f32,
    /// The largest is [`STEPS`], either sign.
    numbers: Vec<i8>,
    /// Sum of their squares.
    square: f64,
}

impl Place {
    fn new(kind: Kind, step: f32, numbers: Vec<i8>) -> Self {
        let square = f64::from(dot(&numbers, &numbers));
        Self { kind, step, numbers, square }
    }

    /// How alike two places are, 0 to 1 (equal), as their metric has it: the cosine, or how far they are from one
    /// another beside how far they can be, `1 − d / (|a| + |b|)`. `None` if they are of different kinds.
    pub(super) fn similarity(&self, other: &Self) -> Option<f64> {
        if self.kind != other.kind {
            return None;
        }
        if self.numbers.len() != other.numbers.len() {
            return self.first(NUMBERS_BESIDE_UP_MAX)?.similarity_of_equals(&other.first(NUMBERS_BESIDE_UP_MAX)?);
        }
        self.similarity_of_equals(other)
    }

    /// The first `count` of its numbers, scaled as they must be; `None` if it has fewer or they are zero.
    fn first(&self, count: usize) -> Option<Self> {
        let numbers = self.numbers.get(..count)?;
        let most = numbers.iter().map(|x| x.unsigned_abs()).max().filter(|&most| most > 0)?;
        let scale = f64::from(STEPS) / f64::from(most);
        let scaled = numbers.iter().map(|&x| (f64::from(x) * scale).round() as i8).collect();
        let step = (f64::from(self.step) / scale).max(STEP_MIN);
        Some(Self::new(self.kind, step as f32, scaled))
    }

    /// What of it finds room beside what is known of the vertical.
    pub(super) fn beside_up(self) -> Option<Self> {
        if self.numbers.len() > NUMBERS_BESIDE_UP_MAX { self.first(NUMBERS_BESIDE_UP_MAX) } else { Some(self) }
    }

    fn similarity_of_equals(&self, other: &Self) -> Option<f64> {
        let dot = f64::from(dot(&self.numbers, &other.numbers));
        Some(match self.kind.metric {
            Metric::Cosine => (dot / (self.square * other.square).sqrt()).clamp(0.0, 1.0),
            Metric::Euclidean => {
                let [a, b] = [self.step, other.step].map(f64::from);
                let [of_a, of_b] = [a * a * self.square, b * b * other.square];
                let apart = (of_a + of_b - 2.0 * a * b * dot).max(0.0).sqrt();
                (1.0 - apart / (of_a.sqrt() + of_b.sqrt())).clamp(0.0, 1.0)
            }
        })
    }

    /// At most [`LEN_MAX`] bytes: metric, hash of what it is, size of a step, numbers.
    pub(super) fn encode(&self) -> Vec<u8> {
        let mut bytes = vec![self.kind.metric as u8];
        bytes.extend(self.kind.hash);
        bytes.extend(self.step.to_le_bytes());
        bytes.extend(self.numbers.iter().map(|&x| x as u8));
        bytes
    }

    /// Accepts exactly what [`Place::encode`] writes.
    pub(super) fn decode(bytes: &[u8]) -> Option<Self> {
        let (&[metric, h0, h1, h2, h3, s0, s1, s2, s3], numbers) = bytes.split_first_chunk::<HEADER_LEN>()?;
        let metric = [Metric::Cosine, Metric::Euclidean].into_iter().find(|known| *known as u8 == metric)?;
        let step = f32::from_le_bytes([s0, s1, s2, s3]);
        let numbers: Vec<i8> = numbers.iter().map(|&x| x as i8).collect();
        let largest = numbers.iter().map(|x| x.unsigned_abs()).max();
        let sound = (VECTOR_LEN_MIN..=NUMBERS_MAX).contains(&numbers.len())
            && (STEP_MIN as f32..=STEP_MAX).contains(&step)
            && largest == Some(STEPS.unsigned_abs());
        sound.then(|| Self::new(Kind { metric, hash: [h0, h1, h2, h3] }, step, numbers))
    }
}

/// Exact in 32 bits, and a loop that vectorises.
fn dot(a: &[i8], b: &[i8]) -> i32 {
    a.iter().zip(b).map(|(&a, &b)| i32::from(a) * i32::from(b)).sum()
}

#[cfg(test)]
#[path = "place_tests.rs"]
mod tests;

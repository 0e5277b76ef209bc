//! Measurements of a pose graph as payloads: what an optimum depends on, to the last bit but one.
//!
//! A rotation is the three smaller components of its quaternion (the fourth follows), a translation three numbers, and
//! of an information matrix comes what differs from the measurement before.

use anyhow::{Context, ensure};
use merganser_protocol::estimate::posegraph::{Measurement, isotropic_weights};
use merganser_protocol::geometry::{Se3, So3};
use merganser_protocol::wire::limits::PAYLOAD_LEN_MAX;
use nalgebra::Matrix6;
use serde::{Deserialize, Serialize};

/// A payload under way: the bytes, and what the next measurement is told relative to.
#[derive(Default)]
struct Payload {
    bytes: Vec<u8>,
    count: usize,
    i: u64,
    information: [f64; 21],
}

/// One measurement, before its translation and changed information.
#[derive(Serialize, Deserialize)]
struct Packed {
    /// From the measurement before (the first: from 0), and from `i`.
    i_step: i64,
    j_step: i64,
    /// Which component of the quaternion is left out (two bits), and which numbers of the information's upper triangle
    /// differ from the measurement before (the first: from 0).
    left_out_and_changed: u32,
    rotation: [f64; 3],
}

/// What stands where a decimal number has its power of ten.
const BINARY: i8 = i8::MAX;

/// As few payloads as hold them.
pub fn pack<'a>(measurements: impl IntoIterator<Item = &'a Measurement>) -> anyhow::Result<Vec<Vec<u8>>> {
    let mut out = Vec::new();
    let mut payload = Payload::default();
    for m in measurements {
        if !payload.push(m)? {
            ensure!(payload.count > 0, "a single measurement does not fit in a payload");
            out.push(core::mem::take(&mut payload).bytes);
            ensure!(payload.push(m)?, "a single measurement does not fit in a payload");
        }
    }
    out.extend((payload.count > 0).then_some(payload.bytes));
    Ok(out)
}

/// What a payload holds.
pub fn unpack(mut bytes: &[u8]) -> anyhow::Result<Vec<Measurement>> {
    let (mut i, mut triangle) = (0u64, [0.0; 21]);
    let mut out = Vec::new();
    while !bytes.is_empty() {
        let packed: Packed;
        (packed, bytes) = postcard::take_from_bytes(bytes)?;
        let mut number = || -> anyhow::Result<f64> {
            let x;
            (x, bytes) = take_number(bytes)?;
            Ok(x)
        };
        let translation = [number()?, number()?, number()?];
        for (k, x) in triangle.iter_mut().enumerate() {
            if packed.left_out_and_changed >> (k + 2) & 1 == 1 {
                *x = number()?;
            }
        }
        i = i.wrapping_add_signed(packed.i_step);
        let j = i.wrapping_add_signed(packed.j_step);
        let information = square(&triangle);
        let (kappa, tau) = isotropic_weights(&information).context("information is singular")?;
        ensure!(translation.iter().all(|x| x.is_finite()), "a translation is not finite");
        let t_i_j = Se3::new(rotation(packed.left_out_and_changed & 3, packed.rotation)?, translation.into());
        let printed = t_i_j.rotation.matrix();
        out.push(Measurement { i, j, t_i_j, printed, information, kappa, tau, line: 0 });
    }
    Ok(out)
}

impl Payload {
    /// Adds a measurement; false, and unchanged, if there is no room for it.
    fn push(&mut self, m: &Measurement) -> anyhow::Result<bool> {
        let mut triangle = [0.0; 21];
        let places = (0..6).flat_map(|r| (r..6).map(move |c| (r, c)));
        triangle.iter_mut().zip(places).for_each(|(x, place)| *x = m.information[place]);
        let changed = || (0..21).filter(|k| triangle[*k] != self.information[*k]);
        let xyzw = m.t_i_j.rotation.xyzw();
        let largest = (0..4).fold(0, |best, k| if xyzw[k].abs() > xyzw[best].abs() { k } else { best });
        let mut others = (0..4).filter(|k| *k != largest).map(|k| xyzw[k] * xyzw[largest].signum());
        let step = |to: u64, from: u64| to.wrapping_sub(from).cast_signed();
        let packed = Packed {
            i_step: step(m.i, self.i),
            j_step: step(m.j, m.i),
            left_out_and_changed: changed().fold(largest as u32, |bits, k| bits | 1 << (k + 2)),
            rotation: core::array::from_fn(|_| others.next().unwrap_or_default()),
        };
        let mut bytes = postcard::to_allocvec(&packed)?;
        for x in m.t_i_j.translation.iter().copied().chain(changed().map(|k| triangle[k])) {
            put_number(x, &mut bytes)?;
        }
        if self.bytes.len() + bytes.len() > PAYLOAD_LEN_MAX {
            return Ok(false);
        }
        self.bytes.extend(bytes);
        self.count += 1;
        (self.i, self.information) = (m.i, triangle);
        Ok(true)
    }
}

/// A number of a file has few digits, and takes four bytes or five so: its power of ten, and the digits. Others take
/// nine. What is read is the very number that was written.
fn put_number(x: f64, out: &mut Vec<u8>) -> anyhow::Result<()> {
    match decimal(x) {
        Some((digits, power)) => out.extend(postcard::to_allocvec(&(power, digits))?),
        None => out.extend(postcard::to_allocvec(&(BINARY, x))?),
    }
    Ok(())
}

fn take_number(bytes: &[u8]) -> anyhow::Result<(f64, &[u8])> {
    let (power, rest): (i8, _) = postcard::take_from_bytes(bytes)?;
    if power == BINARY {
        return Ok(postcard::take_from_bytes(rest)?);
    }
    let (digits, rest): (i32, _) = postcard::take_from_bytes(rest)?;
    Ok((value(digits, power), rest))
}

fn decimal(x: f64) -> Option<(i32, i8)> {
    let text = format!("{x:e}");
    let (digits, power) = text.split_once('e')?;
    let places = digits.split_once('.').map_or(0, |(_, places)| places.len());
    let power = i8::try_from(power.parse::<i32>().ok()? - i32::try_from(places).ok()?).ok()?;
    let digits = digits.replace('.', "").parse::<i32>().ok()?;
    (power != BINARY && value(digits, power).to_bits() == x.to_bits()).then_some((digits, power))
}

/// Correctly rounded, as the file's own number was.
fn value(digits: i32, power: i8) -> f64 {
    format!("{digits}e{power}").parse().unwrap_or(f64::NAN)
}

fn rotation(largest: u32, others: [f64; 3]) -> anyhow::Result<So3> {
    let squares: f64 = others.iter().map(|x| x * x).sum();
    let mut others = others.into_iter();
    let left_out = (1.0 - squares).max(0.0).sqrt();
    let xyzw =
        core::array::from_fn(|k| if k == largest as usize { left_out } else { others.next().unwrap_or_default() });
    So3::from_xyzw(xyzw).context("not a rotation")
}

fn square(triangle: &[f64; 21]) -> Matrix6<f64> {
    let mut numbers = triangle.iter();
    let mut out = Matrix6::zeros();
    for r in 0..6 {
        for c in r..6 {
            let x = numbers.next().copied().unwrap_or_default();
            (out[(r, c)], out[(c, r)]) = (x, x);
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dice::Dice;
    use nalgebra::{Vector3, Vector6};

    fn measurements(count: u64, matrices: u64) -> Vec<Measurement> {
        let mut dice = Dice::new(3, "pack");
        let one = |k: u64| {
            let axis = Vector3::from_fn(|_, _| dice.range(-2.0, 2.0));
            let t_i_j = Se3::new(So3::exp(&axis), Vector3::from_fn(|_, _| dice.range(-50.0, 50.0)));
            let information = Matrix6::from_diagonal(&Vector6::repeat(1.0 + (k % matrices) as f64));
            let (kappa, tau) = isotropic_weights(&information).unwrap();
            let j = if k.is_multiple_of(3) { k.saturating_sub(1000) } else { k + 1 };
            Measurement { i: k, j, t_i_j, printed: t_i_j.rotation.matrix(), information, kappa, tau, line: 0 }
        };
        (0..count).map(one).collect()
    }

    #[test]
    fn what_is_packed_comes_back() {
        for matrices in [1, 3, 200] {
            let before = measurements(400, matrices);
            let payloads = pack(&before).unwrap();
            assert!(payloads.iter().all(|payload| payload.len() <= PAYLOAD_LEN_MAX));
            let after: Vec<Measurement> = payloads.iter().flat_map(|payload| unpack(payload).unwrap()).collect();
            assert_eq!(after.len(), before.len());
            for (a, b) in before.iter().zip(&after) {
                assert_eq!((a.i, a.j, &a.information), (b.i, b.j, &b.information));
                assert_eq!(a.t_i_j.translation, b.t_i_j.translation);
                assert!((a.t_i_j.rotation.inverse() * b.t_i_j.rotation).angle() < 1e-15);
            }
        }
    }

    #[test]
    fn numbers_of_files_are_short_and_all_are_exact() {
        let mut dice = Dice::new(5, "numbers");
        let read = |x: f64| {
            let mut bytes = Vec::new();
            put_number(x, &mut bytes).unwrap();
            let (back, rest) = take_number(&bytes).unwrap();
            assert_eq!((back.to_bits(), rest.len()), (x.to_bits(), 0), "{x}");
            bytes.len()
        };
        for x in [0.0, 1.0, -0.341895, 400.021, 0.00193512, 1e-7, 12345.6] {
            assert!(read(x) <= 5, "{x}: {}", read(x));
        }
        for x in [-0.0, f64::MIN_POSITIVE, f64::MAX, 1.0 / 3.0] {
            read(x);
        }
        (0..1000).for_each(|_| {
            read(dice.normal());
        });
    }

    #[test]
    fn rubbish_is_refused() {
        let payloads = pack(&measurements(10, 1)).unwrap();
        let whole = unpack(&payloads[0]).unwrap().len();
        for len in 0..payloads[0].len() {
            // Cut between two measurements it is a shorter payload.
            assert!(
                unpack(&payloads[0][..len]).is_ok_and(|read| read.len() < whole)
                    || unpack(&payloads[0][..len]).is_err()
            );
        }
        let (mut packed, rest): (Packed, _) = postcard::take_from_bytes(&payloads[0]).unwrap();
        let with = |packed: &Packed, rest: &[u8]| [&postcard::to_allocvec(packed).unwrap()[..], rest].concat();
        assert!(unpack(&with(&packed, rest)).is_ok());
        let infinite = postcard::to_allocvec(&(BINARY, f64::INFINITY)).unwrap();
        let (_, after) = take_number(rest).unwrap();
        assert!(unpack(&with(&packed, &[&infinite, after].concat())).is_err(), "not finite");
        packed.rotation = [f64::NAN; 3];
        assert!(unpack(&with(&packed, rest)).is_err(), "not a rotation");
        (packed.rotation, packed.left_out_and_changed) = ([0.0; 3], 0);
        assert!(unpack(&with(&packed, &[0; 6])).is_err(), "no information");
    }
}

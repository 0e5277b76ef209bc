//! How files store a number, and what its bytes are worth.

/// A type of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Scalar {
    /// Whole numbers of so many bytes that may be negative.
    Signed(usize),
    /// Whole numbers of so many bytes that may not.
    Unsigned(usize),
    F32,
    F64,
}

/// Which byte of a number comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    Little,
    Big,
}

impl Scalar {
    pub fn bytes(self) -> usize {
        match self {
            Self::Signed(bytes) | Self::Unsigned(bytes) => bytes,
            Self::F32 => 4,
            Self::F64 => 8,
        }
    }

    pub fn is_whole(self) -> bool {
        matches!(self, Self::Signed(_) | Self::Unsigned(_))
    }

    /// The value of [`Scalar::bytes`] bytes; of another number of them, NaN.
    pub fn value(self, bytes: &[u8], order: Order) -> f64 {
        let mut word = [0; 8];
        let Some(low) = word.get_mut(..bytes.len()).filter(|low| low.len() == self.bytes() && !low.is_empty()) else {
            return f64::NAN;
        };
        low.copy_from_slice(bytes);
        if order == Order::Big {
            low.reverse();
        }
        let bits = u64::from_le_bytes(word);
        let unused = 64 - 8 * bytes.len() as u32;
        match self {
            Self::Signed(_) => ((bits << unused).cast_signed() >> unused) as f64,
            Self::Unsigned(_) => bits as f64,
            Self::F32 => f64::from(f32::from_bits(bits as u32)),
            Self::F64 => f64::from_bits(bits),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_are_those_of_their_bytes_in_either_order() {
        let check = |scalar: Scalar, little: &[u8], want: f64| {
            assert_eq!(scalar.value(little, Order::Little), want, "{scalar:?}");
            let big: Vec<u8> = little.iter().rev().copied().collect();
            assert_eq!(scalar.value(&big, Order::Big), want, "{scalar:?}");
        };
        for x in [0_i16, 1, -1, i16::MIN, i16::MAX, 258] {
            check(Scalar::Signed(1), &(x as i8).to_le_bytes(), f64::from(x as i8));
            check(Scalar::Signed(2), &x.to_le_bytes(), f64::from(x));
            check(Scalar::Signed(4), &(i32::from(x) * 60_000).to_le_bytes(), f64::from(i32::from(x) * 60_000));
            check(Scalar::Signed(8), &(i64::from(x) << 33).to_le_bytes(), (i64::from(x) << 33) as f64);
            check(Scalar::Unsigned(1), &(x as u8).to_le_bytes(), f64::from(x as u8));
            check(Scalar::Unsigned(2), &(x as u16).to_le_bytes(), f64::from(x as u16));
            check(Scalar::Unsigned(8), &(u64::MAX - x as u64).to_le_bytes(), (u64::MAX - x as u64) as f64);
            check(Scalar::F32, &(f32::from(x) * 0.3).to_le_bytes(), f64::from(f32::from(x) * 0.3));
            check(Scalar::F64, &(f64::from(x) * 0.3).to_le_bytes(), f64::from(x) * 0.3);
        }
        assert!(Scalar::F32.value(&[0; 3], Order::Little).is_nan() && Scalar::F64.value(&[0; 9], Order::Big).is_nan());
        assert!(Scalar::Unsigned(0).value(&[], Order::Little).is_nan());
    }
}

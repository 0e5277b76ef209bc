//! Bands of seeds, as they are written on a command line.

/// Seeds from the first up to, but without, the second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Band(pub u64, pub u64);

/// Reads `FIRST..END`.
///
/// # Errors
/// What to write instead.
pub fn parse_band(text: &str) -> Result<Band, String> {
    let mend = || format!("{text:?} is no band of seeds: write 0..64");
    let (first, end) = text.split_once("..").ok_or_else(mend)?;
    let band = Band(first.parse().map_err(|_| mend())?, end.parse().map_err(|_| mend())?);
    if band.0 < band.1 { Ok(band) } else { Err(mend()) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bands_have_a_first_and_an_end_beyond_it() {
        assert_eq!(parse_band("1000..1064"), Ok(Band(1000, 1064)));
        assert_eq!(parse_band("0..1"), Ok(Band(0, 1)));
        for bad in ["", "5", "5..", "..5", "5..5", "6..5", "a..b", "-1..4", "0..99999999999999999999"] {
            assert!(parse_band(bad).unwrap_err().contains("write 0..64"), "{bad}");
        }
    }
}

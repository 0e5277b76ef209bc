//! Quantiles of χ², by degrees of freedom from 1: the squared normalised error of an honest estimate lies below the
//! quantile at p in a share p of all cases. Computed to the last digit from the regularised incomplete gamma function;
//! the test computes their tails another way.

/// At 95 %.
pub const P95: [f64; 7] = [
    3.841_458_820_694_126,
    5.991_464_547_107_982,
    7.814_727_903_251_18,
    9.487_729_036_781_158,
    11.070_497_693_516_355,
    12.591_587_243_743_98,
    14.067_140_449_340_169,
];
/// At 99.9 %.
pub const P999: [f64; 7] = [
    10.827_566_170_662_733,
    13.815_510_557_964_274,
    16.266_236_196_238_133,
    18.466_826_952_903_173,
    20.515_005_652_432_88,
    22.457_744_484_825_326,
    24.321_886_347_856_854,
];
/// At 99.99 %.
pub const P9999: [f64; 7] = [
    15.136_705_226_623_397,
    18.420_680_743_952_367,
    21.107_513_466_160_214,
    23.512_742_444_990_838,
    25.744_831_959_055_876,
    27.856_341_236_013_918,
    29.877_503_909_224_906,
];
/// At all but one in a million.
pub const P999999: [f64; 7] = [
    23.928_126_976_934_83,
    27.631_021_115_928_547,
    30.664_849_706_213_598,
    33.376_841_581_719_84,
    35.888_186_879_672_87,
    38.258_336_377_209_69,
    40.521_831_234_179_864,
];

#[cfg(test)]
mod tests {
    use super::*;
    use statrs::distribution::{ChiSquared, ContinuousCDF};

    #[test]
    fn tails_beyond_the_quantiles_are_as_named() {
        for (table, tail) in [(P95, 0.05), (P999, 1e-3), (P9999, 1e-4), (P999999, 1e-6)] {
            for (k, &x) in table.iter().enumerate() {
                let found = ChiSquared::new((k + 1) as f64).unwrap().sf(x);
                assert!((found / tail - 1.0).abs() < 1e-9, "{tail} at {} degrees of freedom: {found}", k + 1);
            }
        }
    }
}

//! Equal facts come to equal maps only on robots that estimate alike: with the same code and the same `core.estimate`.
//! [`fingerprint`] names both in a few characters, which `view/status` shows, so that whoever looks at two robots sees
//! whether their maps can be equal.

use crate::config::EstimateConfig;
use crate::ids::Hash;

/// Version of what the code makes of facts. It rises with every change that makes another map of equal facts: of a
/// constant, of an order of sums, of what counts. `sim/fingerprints.txt` shows such a change.
pub const ESTIMATE_VERSION: u32 = 3;

/// `{version}-{16 hexadecimal digits}`: the digits are of the options of `core.estimate` that change the map. How often
/// a robot solves (`interval_secs`) does not.
pub fn fingerprint(config: &EstimateConfig) -> String {
    let EstimateConfig { alignments_min, log10_nfa_max, covariance_scale_max, iterations_max, interval_secs: _ } =
        config;
    let numbers =
        [*alignments_min as u64, log10_nfa_max.to_bits(), covariance_scale_max.to_bits(), *iterations_max as u64];
    let bytes: Vec<u8> = numbers.iter().flat_map(|number| number.to_le_bytes()).collect();
    format!("{ESTIMATE_VERSION}-{}", &Hash::of(&bytes).to_string()[..16])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_option_that_changes_the_map_shows_and_no_other() {
        let usual = EstimateConfig::default();
        let shown = fingerprint(&usual);
        assert!(shown.starts_with(&format!("{ESTIMATE_VERSION}-")) && shown.len() == 18, "{shown}");
        let others = [
            EstimateConfig { alignments_min: 4, ..usual.clone() },
            EstimateConfig { log10_nfa_max: -5.0, ..usual.clone() },
            EstimateConfig { covariance_scale_max: 2.0, ..usual.clone() },
            EstimateConfig { iterations_max: 51, ..usual.clone() },
        ];
        for (k, other) in others.iter().enumerate() {
            assert_ne!(fingerprint(other), shown);
            assert!(others[..k].iter().all(|before| fingerprint(before) != fingerprint(other)));
        }
        assert_eq!(fingerprint(&EstimateConfig { interval_secs: 9.0, ..usual }), shown);
    }
}

//! A merged frame's error fits the covariance claimed for it: at the end of a run, the squared normalised error of every
//! pair of frames must be one that χ² with 6 degrees of freedom exceeds with a chance above 1e-4, all pairs of the run
//! taken together (Bonferroni).

use super::{Check, Phase, Sample};
use crate::truth::frame_errors;

/// The chance that an honest swarm fails this check.
const FALSE_ALARM: f64 = 1e-4;

/// See the module.
#[derive(Debug)]
pub struct HonestCovariance;

impl Check for HonestCovariance {
    fn name(&self) -> &'static str {
        "honest covariance"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        if sample.phase != Phase::End {
            return Ok(());
        }
        let errors = frame_errors(sample);
        // Each pair is seen from both sides.
        let pairs = errors.len().div_ceil(2).max(1) as f64;
        for e in errors {
            let Some(d2) = e.d2 else { continue };
            let chance = puruspe::gammq(3.0, 0.5 * d2.min(1e6));
            if chance.is_nan() || chance * pairs < FALSE_ALARM {
                return Err(format!(
                    "{} places {} {:.4} m and {:.3}° off: d² = {d2:.1}, of which honest covariances have a chance of \
                     {chance:.1e}",
                    e.own, e.frame, e.metres, e.degrees
                ));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{relation, robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use merganser_protocol::geometry::Se3;
    use nalgebra::Vector6;
    use std::collections::BTreeMap;

    #[test]
    fn it_bites_at_the_stated_chance() {
        let truth = BTreeMap::from([("alpha/1".to_owned(), Se3::identity()), ("beta/1".to_owned(), Se3::identity())]);
        let expect = Expect::default();
        let verdict = |d2: f64, phase| {
            let sigma = 0.01;
            let off = Se3::exp(&Vector6::new(d2.sqrt() * sigma, 0.0, 0.0, 0.0, 0.0, 0.0));
            let robots = vec![robot("alpha", 1, &[("beta/1", relation(off, sigma))])];
            HonestCovariance.sample(&Sample { phase, ..sample(robots, &truth, &expect) })
        };
        // χ²₆ at 99.99 % is 27.856.
        assert!(verdict(27.8, Phase::End).is_ok());
        assert!(verdict(27.9, Phase::End).is_err());
        assert!(verdict(27.9, Phase::Calm).is_ok());
        assert!(verdict(f64::INFINITY, Phase::End).is_err());
    }
}

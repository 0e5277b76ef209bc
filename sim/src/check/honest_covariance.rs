//! A merged frame's error fits the covariance claimed for it: at the end of a run, the squared normalised error of
//! every pair of frames must be one that χ² with 6 degrees of freedom (7 where a unit is unknown) exceeds with a chance
//! above 1e-4, all pairs of the run taken together (Bonferroni).

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
            let d2 = e.d2;
            let chance = puruspe::gammq(0.5 * f64::from(e.degrees_of_freedom), 0.5 * d2.min(1e6));
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
    use merganser_protocol::geometry::{Covariance, Relative, Se3, Sim3, SimWithCovariance};
    use merganser_protocol::snapshot::RelationView;
    use nalgebra::{SVector, Vector6};
    use std::collections::BTreeMap;

    #[test]
    fn it_bites_at_the_stated_chance() {
        let truth = BTreeMap::from(["alpha/1", "beta/1"].map(|frame| (frame.to_owned(), Sim3::identity())));
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

    #[test]
    fn a_unit_is_one_value_more() {
        let beta = Sim3::exp(&SVector::<f64, 7>::from([1.0, 2.0, 0.5, 0.1, -0.2, 1.0, 0.7]));
        let truth = BTreeMap::from([("alpha/1".to_owned(), Sim3::identity()), ("beta/1".to_owned(), beta)]);
        let expect = Expect::default();
        let verdict = |d2: f64| {
            let sigma = 0.01;
            let off = SVector::<f64, 7>::from([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, d2.sqrt() * sigma]);
            let covariance = Covariance::from_sigmas([sigma; 7]).unwrap();
            let relation = Relative::Similarity(SimWithCovariance { sim: beta.retract(&off), covariance });
            let robots = vec![robot("alpha", 1, &[("beta/1", RelationView::from(&relation))])];
            HonestCovariance.sample(&sample(robots, &truth, &expect))
        };
        // χ²₇ at 99.99 % is 29.878.
        assert!(verdict(29.8).is_ok());
        assert!(verdict(29.95).is_err());
    }
}

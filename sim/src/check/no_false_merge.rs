//! No false merge (DESIGN §8.12): whatever a robot takes for another frame's place in its own lies near the truth, at
//! any time, whatever its covariance says.

use super::{Check, Sample};
use crate::truth::frame_errors;

/// See the module. The bounds are the scenario's `expect.error_max_m` and `expect.error_max_deg`; scales are held to
/// the factor that such an error would make of ten metres.
#[derive(Debug)]
pub struct NoFalseMerge;

impl Check for NoFalseMerge {
    fn name(&self) -> &'static str {
        "no false merge"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        let expect = sample.expect;
        for e in frame_errors(sample) {
            let scale_off = (e.scale - 1.0).abs() * 10.0;
            // NaN must not pass.
            let good = e.metres <= expect.error_max_m && e.degrees <= expect.error_max_deg;
            if !(good && scale_off <= expect.error_max_m) {
                return Err(format!(
                    "{} places {} {:.3} m and {:.2}° off (allowed {} m, {}°), scale {:.4}",
                    e.own, e.frame, e.metres, e.degrees, expect.error_max_m, expect.error_max_deg, e.scale
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
    use merganser_protocol::geometry::{Se3, Sim3};
    use nalgebra::Vector6;
    use std::collections::BTreeMap;

    #[test]
    fn it_bites_just_beyond_each_bound() {
        let t_alpha_beta = Se3::exp(&Vector6::new(3.0, -1.0, 0.0, 0.0, 0.0, 2.0));
        let t_world_alpha = Se3::exp(&Vector6::new(9.0, 5.0, 0.0, 0.0, 0.0, -1.0));
        let truth = BTreeMap::from([
            ("alpha/1".to_owned(), Sim3::from_se3(&t_world_alpha)),
            ("beta/1".to_owned(), Sim3::from_se3(&(t_world_alpha * t_alpha_beta))),
        ]);
        let expect = Expect { error_max_m: 0.5, error_max_deg: 5.0, ..Expect::default() };
        let verdict = |metres: f64, degrees: f64| {
            let off = Vector6::new(0.0, metres, 0.0, 0.0, 0.0, degrees.to_radians());
            let relation = relation(t_alpha_beta * Se3::exp(&off), 1.0);
            NoFalseMerge.sample(&sample(vec![robot("alpha", 1, &[("beta/1", relation)])], &truth, &expect))
        };
        assert!(verdict(0.0, 0.0).is_ok());
        assert!(verdict(0.49, 0.0).is_ok() && verdict(0.51, 0.0).is_err());
        assert!(verdict(0.0, 4.9).is_ok() && verdict(0.0, 5.1).is_err());
    }

    #[test]
    fn a_false_scale_is_a_false_merge() {
        let truth = BTreeMap::from(["alpha/1", "beta/1"].map(|frame| (frame.to_owned(), Sim3::identity())));
        let expect = Expect { error_max_m: 0.5, error_max_deg: 5.0, ..Expect::default() };
        let verdict = |scale: f64| {
            let mut relation = relation(Se3::identity(), 1.0);
            relation.pose.scale = scale;
            NoFalseMerge.sample(&sample(vec![robot("alpha", 1, &[("beta/1", relation)])], &truth, &expect))
        };
        assert!(verdict(1.049).is_ok() && verdict(0.951).is_ok());
        assert!(verdict(1.051).is_err() && verdict(0.949).is_err() && verdict(f64::NAN).is_err());
    }

    #[test]
    fn a_liar_may_deceive_itself_of_itself_alone() {
        let truth = BTreeMap::from(["alpha/1", "alpha/2", "beta/1"].map(|frame| (frame.to_owned(), Sim3::identity())));
        let expect = Expect { error_max_m: 0.5, error_max_deg: 5.0, ..Expect::default() };
        let verdict = |lies: bool, frame: &str| {
            let off = Se3::exp(&Vector6::new(9.0, 0.0, 0.0, 0.0, 0.0, 0.0));
            let mut robot = robot("alpha", 1, &[(frame, relation(off, 1.0))]);
            robot.lies = lies;
            NoFalseMerge.sample(&sample(vec![robot], &truth, &expect))
        };
        assert!(verdict(true, "alpha/2").is_ok());
        assert!(verdict(false, "alpha/2").is_err());
        assert!(verdict(true, "beta/1").is_err());
    }
}

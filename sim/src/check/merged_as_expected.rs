//! Where the scenario expects it, every running robot has merged with every other at the end.

use super::{Check, Phase, Sample};

/// See the module.
#[derive(Debug)]
pub struct MergedAsExpected;

impl Check for MergedAsExpected {
    fn name(&self) -> &'static str {
        "merged as expected"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        if sample.phase != Phase::End || !sample.expect.merged {
            return Ok(());
        }
        for robot in &sample.robots {
            let Some(snapshot) = &robot.snapshot else { return Err(format!("{} shows no state", robot.name)) };
            let merged = &snapshot.status.merged_with;
            let missing = sample.robots.iter().find(|other| other.name != robot.name && !merged.contains(&other.name));
            if let Some(other) = missing {
                return Err(format!("{} has not merged with {} (only with {merged:?})", robot.name, other.name));
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
    use std::collections::BTreeMap;

    #[test]
    fn it_bites_when_one_is_left_out() {
        let (truth, expect) = (BTreeMap::new(), Expect { merged: true, ..Expect::default() });
        let one = |name: &str, other| robot(name, 1, &[(other, relation(Se3::identity(), 0.1))]);
        let both = vec![one("alpha", "beta/1"), one("beta", "alpha/2")];
        assert!(MergedAsExpected.sample(&sample(both.clone(), &truth, &expect)).is_ok());
        let left_out = vec![both[0].clone(), robot("beta", 1, &[])];
        assert!(MergedAsExpected.sample(&sample(left_out.clone(), &truth, &expect)).is_err());
        assert!(MergedAsExpected.sample(&sample(left_out, &truth, &Expect::default())).is_ok());
    }
}

//! When faults stop, all converge in the stated time (DESIGN §8.6): at the end of a run every robot that is running
//! holds the same digest.

use super::{Check, Phase, Sample};
use std::collections::BTreeSet;

/// See the module. The stated time is the scenario's `settle_secs`.
#[derive(Debug)]
pub struct Converged;

impl Check for Converged {
    fn name(&self) -> &'static str {
        "converged"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        let digests: BTreeSet<_> = sample.robots.iter().map(|robot| robot.digest).collect();
        if sample.phase != Phase::End || digests.len() <= 1 {
            return Ok(());
        }
        let of = |robot: &super::RobotSample| {
            let status = robot.snapshot.as_ref().map(|s| (s.status.entries, s.status.pending));
            let (entries, pending) = status.unwrap_or_default();
            format!("{} {:?} ({entries} entries, {pending} pending)", robot.name, robot.digest)
        };
        let all: Vec<String> = sample.robots.iter().map(of).collect();
        Err(format!("{} different sets: {}", digests.len(), all.join(", ")))
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use std::collections::BTreeMap;

    #[test]
    fn it_bites_only_at_the_end() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let end = sample(vec![robot("alpha", 1, &[]), robot("beta", 2, &[])], &truth, &expect);
        assert!(Converged.sample(&end).is_err());
        assert!(Converged.sample(&Sample { phase: Phase::Calm, ..end }).is_ok());
        let end = sample(vec![robot("alpha", 1, &[]), robot("beta", 1, &[])], &truth, &expect);
        assert!(Converged.sample(&end).is_ok());
    }
}

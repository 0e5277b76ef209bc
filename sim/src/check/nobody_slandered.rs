//! Nobody slandered: whoever is said to be wrong for certain is a liar.

use super::{Check, Sample};

/// See the module.
#[derive(Debug)]
pub struct NobodySlandered;

impl Check for NobodySlandered {
    fn name(&self) -> &'static str {
        "nobody slandered"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        let lies = |name: &str| {
            sample.adversaries.contains(name) || sample.robots.iter().any(|robot| robot.lies && robot.name == name)
        };
        for (robot, snapshot) in sample.robots.iter().filter_map(|robot| Some((robot, robot.snapshot.as_ref()?))) {
            // A liar may say what it likes.
            if lies(&robot.name) {
                continue;
            }
            if let Some(slandered) = snapshot.frames.suspects.iter().find(|one| one.certain && !lies(&one.robot)) {
                return Err(format!("{} says of {}: {}", robot.name, slandered.robot, slandered.reason));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use merganser_protocol::snapshot::SuspectView;
    use std::collections::{BTreeMap, BTreeSet};

    #[test]
    fn it_bites_where_an_honest_robot_is_named_for_certain() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let verdict = |certain: bool, liars: &[&str]| {
            let mut alpha = robot("alpha", 1, &[]);
            let suspect = SuspectView { robot: "beta".into(), reason: "contradicts".into(), certain };
            alpha.snapshot.as_mut().unwrap().frames.suspects.push(suspect);
            let adversaries: BTreeSet<String> = liars.iter().map(|liar| (*liar).to_owned()).collect();
            NobodySlandered.sample(&Sample { adversaries: &adversaries, ..sample(vec![alpha], &truth, &expect) })
        };
        assert!(verdict(true, &[]).is_err());
        assert!(verdict(false, &[]).is_ok() && verdict(true, &["beta"]).is_ok() && verdict(true, &["alpha"]).is_ok());
    }
}

//! Equal digests mean equal sets (DESIGN §8.1): robots of one digest hold the same number of entries and know the same
//! frames with the same numbers of submaps.

use super::{Check, RobotSample, Sample};
use std::collections::BTreeMap;

/// See the module.
#[derive(Debug)]
pub struct SameFacts;

impl Check for SameFacts {
    fn name(&self) -> &'static str {
        "same digest, same facts"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        let mut known: BTreeMap<_, (&str, Facts)> = BTreeMap::new();
        for robot in &sample.robots {
            let Some(facts) = facts(robot) else { continue };
            let (first, expected) = known.entry(robot.digest).or_insert_with(|| (&robot.name, facts.clone()));
            if *expected != facts {
                return Err(format!("{first} and {} hold one digest but {expected:?} and {facts:?}", robot.name));
            }
        }
        Ok(())
    }
}

/// Entries, and submaps by frame.
type Facts = (u64, BTreeMap<String, u64>);

fn facts(robot: &RobotSample) -> Option<Facts> {
    let snapshot = robot.snapshot.as_ref()?;
    // Every robot knows its own frame, even before it wrote its first fact into it.
    let frames = snapshot.frames.frames.iter().filter(|frame| frame.submaps > 0);
    Some((snapshot.status.entries, frames.map(|frame| (frame.frame.clone(), frame.submaps)).collect()))
}

#[cfg(test)]
mod tests {
    use super::super::tests::{robot, sample};
    use super::*;
    use crate::scenario::Expect;

    #[test]
    fn it_bites_when_one_digest_covers_two_sets() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let mut robots = vec![robot("alpha", 1, &[]), robot("beta", 1, &[])];
        assert!(SameFacts.sample(&sample(robots.clone(), &truth, &expect)).is_ok());
        robots[1].snapshot.as_mut().unwrap().status.entries += 1;
        assert!(SameFacts.sample(&sample(robots.clone(), &truth, &expect)).is_err());
        robots[1].digest.0[0] ^= 1;
        assert!(SameFacts.sample(&sample(robots, &truth, &expect)).is_ok());
    }
}

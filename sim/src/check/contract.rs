//! The contract between core and shell (DESIGN §2): batches are numbered from 1 without holes, every question is
//! answered once, and only questions are answered.

use super::{Check, Seen};
use merganser_protocol::agent::io::Output;
use std::collections::{BTreeMap, BTreeSet};

/// See the module.
#[derive(Debug, Default)]
pub struct Contract {
    robots: BTreeMap<usize, Run>,
}

#[derive(Debug, Default)]
struct Run {
    batches: u64,
    asked: BTreeSet<u64>,
}

impl Check for Contract {
    fn name(&self) -> &'static str {
        "contract"
    }

    fn see(&mut self, robot: usize, seen: &Seen<'_>) -> Result<(), String> {
        let run = self.robots.entry(robot).or_default();
        match seen {
            Seen::Started(_) => *run = Run::default(),
            Seen::Asked(token) => {
                run.asked.insert(*token);
            }
            Seen::Output(Output::Persist { batch, .. }) => {
                run.batches += 1;
                if *batch != run.batches {
                    return Err(format!("robot {robot}: batch {batch} came where {} was due", run.batches));
                }
            }
            Seen::Output(Output::Answer { token, .. }) if !run.asked.remove(&token.0) => {
                return Err(format!(
                    "robot {robot}: answered {token:?}, which nobody asked or which it answered before"
                ));
            }
            _ => {}
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use merganser_protocol::agent::io::AskToken;
    use merganser_protocol::ids::RobotId;

    fn persist(batch: u64) -> Output {
        Output::Persist { batch, records: Vec::new() }
    }

    #[test]
    fn it_bites_on_a_hole_and_starts_over_with_the_process() {
        let mut check = Contract::default();
        assert!(check.see(0, &Seen::Output(&persist(1))).is_ok());
        assert!(check.see(0, &Seen::Started(RobotId([1; 8]))).is_ok());
        assert!(check.see(0, &Seen::Output(&persist(1))).is_ok());
        assert!(check.see(0, &Seen::Output(&persist(3))).is_err());
    }

    #[test]
    fn it_bites_on_a_second_answer() {
        let mut check = Contract::default();
        let answer = Output::Answer { token: AskToken(7), bytes: Vec::new() };
        assert!(check.see(0, &Seen::Asked(7)).is_ok());
        assert!(check.see(0, &Seen::Output(&answer)).is_ok());
        assert!(check.see(0, &Seen::Output(&answer)).is_err());
    }
}

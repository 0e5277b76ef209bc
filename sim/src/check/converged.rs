//! When faults stop, all converge in the stated time (DESIGN §8.6): at the end of a run every robot that is running
//! holds the same digest. A swarm that is still at work then writes on, and its last facts may be on their way: what
//! any robot held a stated time before, all must hold, and equal logs must have equal digests. Nobody is excused by
//! being down.

use super::{Check, Phase, RobotSample, Sample};
use core::time::Duration;
use merganser_protocol::ids::FrameId;
use merganser_protocol::time::Instant;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// What a fact may take to reach everyone: so long among few...
const LAG_SECS: f64 = 10.0;
/// ...so much more for each of them beyond five, for what they all write goes over the same links...
const LAG_SECS_PER_ROBOT: f64 = 2.0;
/// ...but no more than this, or than this for each row of a crowd.
const LAG_SECS_MAX: f64 = 20.0;
const LAG_SECS_PER_ROW: f64 = 3.0;

/// Logs that a report names, of those that a robot has not enough of.
const NAMED_MAX: usize = 3;

/// Lengths of logs; `None` for those with two histories.
type Logs = BTreeMap<FrameId, Option<u32>>;

/// See the module. The stated time is the scenario's `settle_secs`.
#[derive(Debug, Default)]
pub struct Converged {
    /// What anybody held since the healing, and when: all of the last while, and the latest of what came before.
    held: VecDeque<(Instant, Logs)>,
}

impl Check for Converged {
    fn name(&self) -> &'static str {
        "converged"
    }

    fn sample(&mut self, sample: &Sample<'_>) -> Result<(), String> {
        let robots = &sample.robots;
        let is_old = |at: Instant| at.after(lag(robots.len())) <= sample.at;
        if sample.phase == Phase::Calm {
            self.held.push_back((sample.at, all_logs(robots)));
            while self.held.get(1).is_some_and(|(at, _)| is_old(*at)) {
                self.held.pop_front();
            }
        }
        let digests: BTreeSet<_> = robots.iter().map(|robot| robot.digest).collect();
        if sample.phase == Phase::End && !sample.down.is_empty() {
            return Err(format!("never came back: {}", sample.down.join(", ")));
        }
        if sample.phase != Phase::End || digests.len() <= 1 {
            return Ok(());
        }
        let logs: BTreeSet<&Logs> = robots.iter().map(|robot| &robot.logs).collect();
        let old = self.held.iter().rev().find(|(at, _)| is_old(*at)).map(|(_, logs)| logs);
        if logs.len() == digests.len() && old.is_some_and(|old| robots.iter().all(|robot| holds(&robot.logs, old))) {
            return Ok(());
        }
        let all: Vec<String> = robots.iter().map(|robot| state(robot, old)).collect();
        Err(format!("{} different sets: {}", digests.len(), all.join(", ")))
    }
}

/// What a robot holds, and how much of what it should have is missing.
fn state(robot: &RobotSample, old: Option<&Logs>) -> String {
    let status = robot.snapshot.as_ref().map(|s| (s.status.entries, s.status.pending));
    let (entries, pending) = status.unwrap_or_default();
    let late = old.into_iter().flatten().filter(|(frame, old)| !reaches(&robot.logs, **frame, **old));
    let late: Vec<String> = late
        .take(NAMED_MAX)
        .map(|(frame, old)| format!("{frame} has {:?} of {old:?}", robot.logs.get(frame).copied().flatten()))
        .collect();
    let late = if late.is_empty() { String::new() } else { format!(", late: {}", late.join("; ")) };
    format!("{} {:?} ({entries} entries, {pending} pending{late})", robot.name, robot.digest)
}

fn lag(robots: usize) -> Duration {
    let n = robots as f64;
    let few = (LAG_SECS + LAG_SECS_PER_ROBOT * (n - 5.0)).clamp(LAG_SECS, LAG_SECS_MAX);
    Duration::from_secs_f64(few.max(LAG_SECS_PER_ROW * libm::sqrt(n)))
}

fn all_logs(robots: &[RobotSample]) -> Logs {
    let mut all = Logs::new();
    for (frame, len) in robots.iter().flat_map(|robot| &robot.logs) {
        let one = all.entry(*frame).or_insert(Some(0));
        *one = one.zip(*len).map(|(a, b)| a.max(b));
    }
    all
}

fn holds(logs: &Logs, old: &Logs) -> bool {
    old.iter().all(|(frame, old)| reaches(logs, *frame, *old))
}

/// Whether these logs hold so much of one log, or know of its two histories.
fn reaches(logs: &Logs, frame: FrameId, old: Option<u32>) -> bool {
    match (logs.get(&frame), old) {
        (Some(None), _) => true,
        (Some(Some(len)), Some(old)) => *len >= old,
        (None, Some(old)) => old == 0,
        (_, None) => false,
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{robot, sample};
    use super::*;
    use crate::scenario::Expect;
    use merganser_protocol::ids::RobotId;

    const FRAME: FrameId = FrameId { robot: RobotId([1; 8]), epoch: 4 };

    #[test]
    fn it_bites_only_at_the_end() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let end = sample(vec![robot("alpha", 1, &[]), robot("beta", 2, &[])], &truth, &expect);
        assert!(Converged::default().sample(&end).is_err());
        assert!(Converged::default().sample(&Sample { phase: Phase::Calm, ..end }).is_ok());
        let end = sample(vec![robot("alpha", 1, &[]), robot("beta", 1, &[])], &truth, &expect);
        assert!(Converged::default().sample(&end).is_ok());
    }

    #[test]
    fn who_is_down_may_be_until_the_end() {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let alone = sample(vec![robot("alpha", 1, &[])], &truth, &expect);
        let end = Sample { down: vec!["beta".into()], ..alone };
        assert!(Converged::default().sample(&Sample { phase: Phase::Calm, ..end.clone() }).is_ok());
        assert!(Converged::default().sample(&end).is_err_and(|why| why.contains("beta")));
    }

    /// Whether it bites when alpha held so much of a log for so many seconds, more at the end, and beta this.
    fn bites(before: Option<u32>, secs: u64, beta: Option<u32>) -> bool {
        let (truth, expect) = (BTreeMap::new(), Expect::default());
        let two = |alpha: Option<u32>, beta: Option<u32>| {
            let mut robots = vec![robot("alpha", 1, &[]), robot("beta", 2, &[])];
            robots[0].logs.insert(FRAME, alpha);
            robots[1].logs.insert(FRAME, beta);
            robots
        };
        let mut check = Converged::default();
        let at = |secs: u64| Instant::ZERO.after(Duration::from_secs(secs));
        for now in 0..secs {
            let calm = sample(two(before, Some(0)), &truth, &expect);
            check.sample(&Sample { at: at(now), phase: Phase::Calm, ..calm }).unwrap();
        }
        check.sample(&Sample { at: at(secs), ..sample(two(Some(9), beta), &truth, &expect) }).is_err()
    }

    #[test]
    fn the_last_facts_of_a_swarm_at_work_may_be_on_their_way_and_no_others() {
        let lag = lag(2).as_secs();
        assert!(!bites(Some(7), lag, Some(7)));
        assert!(bites(Some(7), lag, Some(6)), "it was there long enough");
        assert!(bites(Some(7), lag - 1, Some(7)), "nobody knows how long it was there");
        assert!(bites(Some(7), lag, Some(9)), "equal logs, different digests");
        assert!(bites(None, lag, Some(9)) && bites(None, lag, Some(8)), "a quarantine reaches all");
    }

    #[test]
    fn facts_may_take_longer_where_there_are_more_robots() {
        assert_eq!([2, 5, 8, 10, 100, 1000].map(|n| lag(n).as_secs()), [10, 10, 16, 20, 30, 94]);
    }
}

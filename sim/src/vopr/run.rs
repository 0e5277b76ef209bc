//! Running drawn scenarios, one seed or a band of them, and counting what was survived.

use super::draw;
use crate::check::Violation;
use crate::core::Restartable;
use crate::faults::FaultCounts;
use crate::swarm::{Outcome, Swarm};
use merganser_protocol::agent::Agent;
use std::collections::BTreeMap;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// What became of one seed.
#[derive(Clone, Debug)]
pub struct SeedReport {
    /// The seed.
    pub seed: u64,
    /// The trace, hexadecimal.
    pub trace: String,
    /// The first broken invariant.
    pub violation: Option<Violation>,
    /// Robots of the run.
    pub robots: usize,
    /// Virtual time at the end, s.
    pub ended_secs: f64,
    /// From the healing until all held the same facts for good, s.
    pub settled_secs: f64,
    /// Entries held at the end.
    pub entries: u64,
    /// Faults that fired.
    pub faults: FaultCounts,
}

/// Runs one seed, with so many robots if that is given; `twice` also checks that a second run leaves the same trace.
pub fn run_seed(seed: u64, robots: Option<usize>, twice: bool) -> SeedReport {
    run_with::<Agent>(seed, robots, twice)
}

fn run_with<C: Restartable>(seed: u64, robots: Option<usize>, twice: bool) -> SeedReport {
    let mut report = one::<C>(seed, robots);
    if twice && report.violation.is_none() {
        let again = one::<C>(seed, robots);
        if again.trace != report.trace {
            let what = format!("a second run left the trace {}, not {}", again.trace, report.trace);
            let invariant = "same seed, same trace".to_owned();
            report.violation = Some(Violation { invariant, at_secs: report.ended_secs, what });
        }
    }
    report
}

fn one<C: Restartable>(seed: u64, robots: Option<usize>) -> SeedReport {
    let scenario = draw(seed, robots);
    let storm = scenario.duration_secs + scenario.machine.start_within_secs;
    let robots = scenario.robots;
    let broken = |invariant: &str, what: String| SeedReport {
        seed,
        trace: String::new(),
        violation: Some(Violation { invariant: invariant.to_owned(), at_secs: 0.0, what }),
        robots,
        ended_secs: 0.0,
        settled_secs: 0.0,
        entries: 0,
        faults: FaultCounts::default(),
    };
    let run = || Swarm::<C>::new(scenario, seed)?.run(|_| {});
    let outcome: Outcome<C> = match catch_unwind(AssertUnwindSafe(run)) {
        Ok(Ok(outcome)) => outcome,
        Ok(Err(error)) => return broken("every agent starts", error.to_string()),
        Err(panic) => {
            let text = panic.downcast_ref::<String>().cloned();
            let text = text.or_else(|| panic.downcast_ref::<&str>().map(ToString::to_string));
            return broken("no panic", text.unwrap_or_default());
        }
    };
    let ended_secs = outcome.ended.as_secs_f64();
    let entries =
        outcome.robots.iter().flat_map(|robot| robot.logs.values().flatten()).map(|len| u64::from(*len)).sum();
    SeedReport {
        seed,
        trace: outcome.trace.to_string(),
        violation: outcome.violation,
        robots,
        ended_secs,
        settled_secs: (outcome.agreed_since.unwrap_or(outcome.ended).as_secs_f64() - storm).max(0.0),
        entries,
        faults: outcome.counts,
    }
}

/// Many seeds together.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct Tally {
    /// How many ran.
    pub seeds: u64,
    /// Virtual seconds in all.
    pub virtual_secs: f64,
    /// The longest that any took to settle, s, and which.
    pub slowest: (f64, u64),
    /// What fired: how often in all, and in how many runs.
    pub fired: BTreeMap<String, (u64, u64)>,
    /// Runs that broke an invariant.
    pub broken: Vec<(u64, Violation)>,
}

impl Tally {
    /// Adds a run.
    pub fn add(&mut self, report: &SeedReport) {
        self.seeds += 1;
        self.virtual_secs += report.ended_secs;
        if report.settled_secs > self.slowest.0 {
            self.slowest = (report.settled_secs, report.seed);
        }
        let counts = serde_json::to_value(&report.faults).unwrap_or_default();
        for (name, count) in counts.as_object().into_iter().flatten() {
            let count = count.as_u64().unwrap_or(0);
            let row = self.fired.entry(name.clone()).or_default();
            *row = (row.0 + count, row.1 + u64::from(count > 0));
        }
        if let Some(violation) = &report.violation {
            self.broken.push((report.seed, violation.clone()));
        }
    }

    /// The faults that fired, a line each.
    pub fn table(&self) -> String {
        let mut text = format!("{:<20} {:>12} {:>8}\n", "fault", "times", "runs");
        for (name, (times, runs)) in &self.fired {
            text += &format!("{:<20} {times:>12} {runs:>8}\n", name.replace('_', " "));
        }
        text
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::swarm::fake::{Bug, Fake, with_bug};

    /// The first seeds that an honest fake survives: it knows nothing of forks, so not all of them.
    fn survived(count: usize) -> Vec<u64> {
        (0..40).filter(|seed| run_with::<Fake>(*seed, None, true).violation.is_none()).take(count).collect()
    }

    #[test]
    fn what_is_not_drawn_from_the_seed_and_what_panics_is_found() {
        let seeds = survived(4);
        assert_eq!(seeds.len(), 4, "{seeds:?}");
        let broken = |bug| {
            let run = || seeds.iter().find_map(|seed| run_with::<Fake>(*seed, None, true).violation);
            with_bug(bug, run).map(|violation| violation.invariant)
        };
        assert_eq!(broken(Bug::Unseeded).as_deref(), Some("same seed, same trace"));
        assert_eq!(broken(Bug::Panics).as_deref(), Some("no panic"));
        assert_eq!(broken(Bug::None), None);
    }

    #[test]
    fn a_tally_adds_up() {
        let mut tally = Tally::default();
        let mut report = run_with::<Fake>(survived(1)[0], None, false);
        tally.add(&report);
        report.violation = Some(Violation { invariant: "x".into(), at_secs: 1.0, what: "y".into() });
        report.settled_secs = 1e3;
        tally.add(&report);
        assert_eq!((tally.seeds, tally.broken.len(), tally.slowest), (2, 1, (1e3, report.seed)));
        assert!(tally.fired.values().all(|(times, runs)| times % 2 == 0 && runs % 2 == 0));
        assert_eq!(tally.table().lines().count(), tally.fired.len() + 1);
    }
}

//! What a run has to tell: `report.json` and `trajectories.svg`. Both are functions of the scenario and the seed alone,
//! so two runs of one seed leave equal files; how long the run took is printed, not kept.

use crate::check::{Phase, Sample, Violation};
use crate::faults::FaultCounts;
use crate::scenario::Scenario;
use crate::swarm::{Outcome, Usage};
use crate::truth::{FrameError, frame_errors};
use merganser_protocol::agent::io::Event;
use serde::Serialize;
use std::collections::BTreeMap;

/// Everything about a run, as plain values.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
    /// What was run, with every default filled in.
    pub scenario: Scenario,
    /// With which seed.
    pub seed: u64,
    /// BLAKE3 over every input and output of every robot, hexadecimal.
    pub trace: String,
    /// Number of inputs and outputs.
    pub trace_lines: u64,
    /// The first broken invariant.
    pub violation: Option<Violation>,
    /// Virtual time at the end, s.
    pub ended_secs: f64,
    /// All held the same facts and had nothing left to do.
    pub idle: bool,
    /// Events handled.
    pub events: u64,
    /// The robots that ran at the end.
    pub robots: Vec<RobotReport>,
    /// Each robot's error about each other frame that it merged.
    pub frame_errors: Vec<FrameError>,
    /// Mean of `d2` over `frame_errors`; about 6 for honest covariances, 7 where units are unknown. `None` without
    /// merged frames.
    pub mean_d2: Option<f64>,
    /// Messages by kind, for each robot of the scenario.
    pub sent: BTreeMap<String, BTreeMap<&'static str, Usage>>,
    /// Faults that fired.
    pub faults: FaultCounts,
    /// What agents told people.
    pub told: Vec<Told>,
}

/// One robot at the end.
#[derive(Clone, Debug, Serialize)]
pub struct RobotReport {
    /// Its name.
    pub name: String,
    /// Digest of the facts it holds, hexadecimal.
    pub digest: String,
    /// Facts held.
    pub entries: u64,
    /// Own submaps.
    pub submaps: u64,
    /// Work it has left, by its own account.
    pub pending: u64,
    /// Its estimate is of the present set, and nothing is pending.
    pub idle: bool,
    /// Whom it has merged with.
    pub merged_with: Vec<String>,
}

/// Something an agent told people.
#[derive(Clone, Debug, Serialize)]
pub struct Told {
    /// When, s.
    pub at_secs: f64,
    /// Who.
    pub robot: String,
    /// What.
    #[serde(flatten)]
    pub event: Event,
}

impl Report {
    /// The report of a run.
    pub fn of<C>(outcome: &Outcome<C>) -> Self {
        let adversaries = outcome.scenario.adversaries();
        let sample = Sample {
            at: outcome.ended,
            phase: Phase::End,
            robots: outcome.robots.clone(),
            down: Vec::new(),
            truth: &outcome.truth,
            expect: &outcome.scenario.expect,
            adversaries: &adversaries,
        };
        let frame_errors = frame_errors(&sample);
        let d2: Vec<f64> = frame_errors.iter().map(|e| e.d2).collect();
        let names = outcome.stage.names();
        Self {
            scenario: outcome.scenario.clone(),
            seed: outcome.seed,
            trace: outcome.trace.to_string(),
            trace_lines: outcome.trace_lines,
            violation: outcome.violation.clone(),
            ended_secs: outcome.ended.as_secs_f64(),
            idle: outcome.idle,
            events: outcome.events,
            robots: outcome.robots.iter().map(RobotReport::of).collect(),
            mean_d2: (!d2.is_empty()).then(|| d2.iter().sum::<f64>() / d2.len() as f64),
            frame_errors,
            sent: names.iter().cloned().zip(outcome.usage.iter().cloned()).collect(),
            faults: outcome.counts.clone(),
            told: outcome
                .told
                .iter()
                .map(|(at_secs, robot, event)| Told {
                    at_secs: *at_secs,
                    robot: names[*robot].clone(),
                    event: event.clone(),
                })
                .collect(),
        }
    }

    /// Payload bytes that one robot sent, in all.
    pub fn bytes_sent(&self, robot: &str) -> u64 {
        self.sent.get(robot).map_or(0, |kinds| kinds.values().map(|usage| usage.bytes).sum())
    }
}

impl RobotReport {
    fn of(sample: &crate::check::RobotSample) -> Self {
        let status = sample.snapshot.as_ref().map(|snapshot| &snapshot.status);
        Self {
            name: sample.name.clone(),
            digest: sample.digest.to_string(),
            entries: status.map_or(0, |s| s.entries),
            submaps: status.map_or(0, |s| s.submaps),
            pending: status.map_or(0, |s| s.pending),
            idle: status.is_none_or(|s| s.idle),
            merged_with: status.map_or_else(Vec::new, |s| s.merged_with.clone()),
        }
    }
}

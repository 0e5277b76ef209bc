//! Problems without a single true match, drawn by the same law as the files: what is accepted here is a false alarm.

use super::cpu::thread_seconds;
use super::solve::{Refinement, config};
use super::table::median;
use crate::dice::Dice;
use anyhow::Context;
use merganser_protocol::align::{Model, Problem, Refusal, Standing, align};
use merganser_protocol::geometry::So3;
use nalgebra::Vector3;
use std::fmt;

/// Noise per axis, as in the files.
const SIGMA: f64 = 0.01;

/// What became of a number of such problems.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FalseAlarms {
    /// Matches of each.
    pub n: usize,
    /// Problems.
    pub problems: u32,
    /// Accepted.
    pub accepted: u32,
    /// Given as provisional.
    pub provisional: u32,
    /// Called ambiguous.
    pub ambiguous: u32,
    /// Median time, ms.
    pub cpu_ms: f64,
    /// Longest, ms.
    pub cpu_ms_max: f64,
}

/// Solves `count` problems of `n` false matches; calls `done` after each.
///
/// # Errors
/// A size or σ_max that the estimator does not take.
pub fn measure(
    count: u32,
    n: usize,
    sigma_max: f64,
    refinement: Refinement,
    mut done: impl FnMut(),
) -> anyhow::Result<FalseAlarms> {
    let config = config(Model::Rigid, sigma_max, refinement);
    let mut alarms = FalseAlarms { n, problems: count, ..FalseAlarms::default() };
    let mut times = Vec::new();
    for seed in 0..count {
        let (source, target) = draw(u64::from(seed), n);
        let problem = Problem { source: &source, target: &target, ..Problem::default() };
        let began = thread_seconds();
        let result = align(&problem, &config).with_context(|| format!("{n} false matches"))?;
        times.push(1e3 * (thread_seconds() - began));
        match result {
            Ok(found) if found.standing == Standing::Accepted => alarms.accepted += 1,
            Ok(_) => alarms.provisional += 1,
            Err(Refusal::Ambiguous { .. }) => alarms.ambiguous += 1,
            Err(_) => {}
        }
        done();
    }
    alarms.cpu_ms_max = times.iter().copied().fold(0.0, f64::max);
    alarms.cpu_ms = median(times);
    Ok(alarms)
}

/// Points in the unit cube, each matched with the place of another, fresh point.
fn draw(seed: u64, n: usize) -> (Vec<[f64; 3]>, Vec<[f64; 3]>) {
    let dice = &mut Dice::new(seed, &format!("pure outliers {n}"));
    let axis = Vector3::from_fn(|_, _| dice.normal());
    let rotation = So3::exp(&(axis.normalize() * dice.range(0.0, core::f64::consts::PI)));
    let translation = Vector3::from_fn(|_, _| dice.range(-1.0, 1.0));
    (0..n)
        .map(|_| {
            let source = core::array::from_fn(|_| dice.uniform());
            let other = Vector3::from_fn(|_, _| dice.uniform());
            let noise = Vector3::from_fn(|_, _| SIGMA * dice.normal());
            let target: [f64; 3] = (rotation * other + translation + noise).into();
            (source, target)
        })
        .unzip()
}

impl fmt::Display for FalseAlarms {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "pure outliers, N={}: {} of {} accepted, {} provisional, {} ambiguous; {:.2} ms, at most {:.2}",
            self.n, self.accepted, self.problems, self.provisional, self.ambiguous, self.cpu_ms, self.cpu_ms_max
        )
    }
}

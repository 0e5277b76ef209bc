//! What the cross-crate tests share: running a scenario of the simulator with the real core.

use merganser_protocol::agent::Agent;
use merganser_sim::report::Report;
use merganser_sim::scenario::Scenario;
use merganser_sim::swarm::Swarm;

/// Runs a scenario with a seed to its end.
///
/// # Errors
/// Text, if the scenario cannot be read or run.
pub fn simulate(scenario: &str, seed: u64) -> Result<Report, String> {
    let scenario = Scenario::parse(scenario).map_err(|error| error.to_string())?;
    let swarm = Swarm::<Agent>::new(scenario, seed).map_err(|error| error.to_string())?;
    let outcome = swarm.run(|_| {}).map_err(|error| error.to_string())?;
    Ok(Report::of(&outcome))
}

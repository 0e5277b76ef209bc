//! What the cross-crate tests share: running a scenario of the simulator with the real core.

pub use merganser_sim::wires;

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

/// The folder of real data, or `None` (saying so) where it is absent: `MERGANSER_SHARED`, or `shared` beside the
/// workspace.
#[allow(clippy::print_stderr, reason = "a test that was skipped must say so")]
pub fn real_data(name: &str) -> Option<std::path::PathBuf> {
    let beside = std::path::PathBuf::from("../../shared");
    let folder = std::env::var_os("MERGANSER_SHARED").map_or(beside, Into::into).join("data").join(name);
    if !folder.is_dir() {
        eprintln!("skipped: no real data at {} (set MERGANSER_SHARED)", folder.display());
        return None;
    }
    Some(folder)
}

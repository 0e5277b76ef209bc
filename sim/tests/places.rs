//! What a place-recognition network of the robots' own knows is made use of.

#![allow(clippy::unwrap_used, clippy::panic, reason = "the whole file is a test")]

use merganser_protocol::agent::Agent;
use merganser_protocol::agent::io::Event;
use merganser_sim::scenario::Scenario;
use merganser_sim::swarm::Swarm;

/// Clouds that all look alike, so that only the network tells places apart.
const BLIND: &str = "
name = \"blind\"
robots = 3
duration_secs = 40
settle_secs = 60
[summary]
points = 200
reach_m = 3.0
";
const NETWORK: &str = "
[places]
reach_m = 2.0
";

/// Mean squared error of what robots expect of a try, and how many they made.
fn surprise(scenario: &str, seed: u64) -> (f64, usize) {
    let outcome = Swarm::<Agent>::new(Scenario::parse(scenario).unwrap(), seed).unwrap().run(|_| {}).unwrap();
    assert_eq!(outcome.violation, None, "seed {seed}");
    let squared = |event: &Event| match event {
        Event::AlignmentTried { expected, found, .. } => Some((expected - f64::from(u8::from(*found))).powi(2)),
        _ => None,
    };
    let tries: Vec<f64> = outcome.told.iter().filter_map(|(_, _, event)| squared(event)).collect();
    (tries.iter().sum::<f64>() / tries.len() as f64, tries.len())
}

#[test]
fn robots_that_know_places_know_what_to_expect() {
    let with_network = format!("{BLIND}{NETWORK}");
    let mut sums = [0.0; 2];
    for seed in 1..4 {
        for (sum, scenario) in sums.iter_mut().zip([&with_network[..], BLIND]) {
            let (error, tries) = surprise(scenario, seed);
            println!("seed {seed}: mean squared error {error:.3} in {tries} tries");
            assert!(tries > 50, "seed {seed}: {tries}");
            *sum += error;
        }
    }
    assert!(sums[0] < 0.8 * sums[1], "{sums:?}");
}

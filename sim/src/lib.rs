//! The Merganser core on a virtual network, in virtual time: a generated world that robots drive through, links that
//! lose, delay, double and block messages, disks and processes that fail, and invariants that are checked all the
//! while.
//!
//! A run is a pure function of a [`scenario::Scenario`] and a seed: the same pair gives the same trace hash, bit for
//! bit. First a storm (robots drive, faults rage), then calm: the network heals and the swarm must converge in a stated
//! time.
//!
//! ```text
//!  scenario, seed ─► world, drives ─► queue of virtual time ◄─► cores, disks, links, faults
//!                                        │
//!                          checks of every invariant ─► outcome, report, trace hash
//! ```
//!
//! ```no_run
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use merganser_sim::{report::Report, scenario::Scenario, swarm::Swarm};
//!
//! let scenario = Scenario::parse(&std::fs::read_to_string("sim/scenarios/three.toml")?)?;
//! let swarm = Swarm::<merganser_protocol::agent::Agent>::new(scenario, 1)?;
//! let outcome = swarm.run(|_| {})?;
//! println!("{:?}, trace {}", outcome.violation, Report::of(&outcome).trace);
//! # Ok(()) }
//! ```

pub mod adversary;
pub mod band;
pub mod bar;
pub mod bench;
pub mod check;
pub mod core;
pub mod dice;
pub mod faults;
pub mod field;
pub mod fingerprint;
pub mod network;
pub mod queue;
pub mod record;
pub mod report;
pub mod run;
pub mod scenario;
pub mod stage;
pub mod svg;
pub mod swarm;
pub mod truth;
pub mod vopr;
pub mod wires;
pub mod world;

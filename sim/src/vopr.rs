//! The attacker: one seed draws a whole run (how many robots, which network, which machines, what goes wrong and when),
//! and the run must break no invariant. After the storm everything heals, and the swarm must converge in a stated time.
//! The drawn options are a [`Scenario`](crate::scenario::Scenario) like any other, so that what a seed does can be
//! read, and changed by hand.

pub mod command;
mod draw;
mod run;

pub use draw::{draw, settle_secs};
pub use run::{SeedReport, Tally, run_seed};

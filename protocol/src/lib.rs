//! The core of Merganser: all that a robot decides, and nothing else. No clock, no socket, no thread, no async, no
//! global randomness: same inputs, same outputs, to the bit.
//!
//! ```text
//!  SLAM ─ keyframe ─► submap ─► describe ─► facts in signed logs ◄─ gossip ─► peers
//!                                             │            ▲
//!                                  summaries  │            │  alignments, verdicts
//!                                             ▼            │
//!                                         shortlist ─► registration of pairs
//!
//!  facts ─► which pairs of frames merge ─► joint estimate ─► views, live poses
//! ```
//!
//! # The contract
//! An [`agent::Agent`] is driven by a shell that owns the network, the disk and the clock:
//! 1. call [`agent::Agent::handle`] once with the present time and one [`agent::io::Input`];
//! 2. drain [`agent::Agent::poll_output`] until it is empty, and carry out each [`agent::io::Output`];
//! 3. wait until [`agent::Agent::poll_timeout`] or the next input.
//!
//! ```no_run
//! # use merganser_protocol::{agent::{Agent, io::{Input, Output}}, time::Instant};
//! # fn shell(mut agent: Agent, mut next: impl FnMut() -> (Instant, Input)) {
//! loop {
//!     let (now, input) = next(); // from the SLAM, the network, the disk, or a timer
//!     agent.handle(now, input);
//!     while let Some(output) = agent.poll_output() {
//!         match output {
//!             Output::Run { id, job } => agent.handle(now, Input::JobDone { job: id, result: job.run() }),
//!             Output::Persist { batch, .. } => agent.handle(now, Input::Persisted { up_to: batch }), // once durable
//!             Output::Ask { query, .. } => agent.handle(now, Input::Answered { query, bytes: None }), // or the answer
//!             Output::Publish { .. } | Output::Answer { .. } | Output::Event(_) => {} // to the network and the log
//!         }
//!     }
//! }
//! # }
//! ```
//! `examples/drive_a_core.rs` is a whole one.
//!
//! Only `handle` changes anything. Heavy work is an output ([`agent::io::Output::Run`]) whose result comes back as an
//! input; the shell runs it where it likes, or not at all for a while. Records become facts for others only after the
//! shell says that they are durable. An error is somebody's bad input, counted and reported as an event; a panic is our
//! bug. `tests/agents/contract.rs` holds the core to all of this.
//!
//! What this crate builds on has crates of its own, so that the compiler keeps the arrows: `types` and `geometry` ←
//! `registration` ([`align`], [`submap`]) and `estimation` ([`estimate`]) ← this crate, whose modules point one way,
//! too: [`wire`], [`snapshot`] ← [`replica`] ← [`gossip`] ← [`agent`].

pub mod agent;
pub mod gossip;
pub mod replica;
pub mod snapshot;
pub mod wire;

pub use merganser_estimation as estimate;
pub use merganser_geometry as geometry;
pub use merganser_registration::{align, submap};
pub use merganser_types::{config, ids, kinds, time};

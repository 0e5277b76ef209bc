//! The Merganser agent: one robot's share of a swarm's map. All decisions are taken by the core
//! ([`merganser_protocol::agent::Agent`]); this crate gives it a clock, a disk, a Zenoh session and a voice.
//!
//! ```text
//!  SLAM ─ in/keyframe ─► link ─► queue ─► driver ◄─► core        views, log ─► people
//!  peers ◄─── Zenoh ───► link               │
//!                            jobs and the store, each on threads of its own
//! ```
//!
//! [`host::Host`] puts it together, and `merganser run` is little more than this:
//!
//! ```no_run
//! # async fn run() -> Result<(), Box<dyn std::error::Error>> {
//! use merganser::{config::FileConfig, host::{Host, Options}};
//!
//! let config = FileConfig::load(std::path::Path::new("alpha.toml"))?;
//! let host = Host::start(config, Options { journal: None, seed: None }).await?;
//! tokio::signal::ctrl_c().await?;
//! let finished = host.stop().await?;
//! println!("digest {}", finished.digest);
//! # Ok(()) }
//! ```

pub mod certificates;
pub mod cli;
pub mod commands;
pub mod config;
pub mod demo;
pub mod driver;
pub mod host;
pub mod journal;
pub mod keys;
pub mod link;
pub mod picture;
pub mod queue;
pub mod store;
pub mod telemetry;
pub mod trust;
mod vain;

pub use merganser_recording::{self as recording, observation};

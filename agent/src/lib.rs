//! The Merganser agent: one robot's share of a swarm's map. All decisions are taken by the core
//! ([`merganser_protocol::agent::Agent`]); this crate gives it a clock, a disk, a Zenoh session and a voice.

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

pub use merganser_recording::{self as recording, observation};

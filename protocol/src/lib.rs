//! The core of Merganser: all that a robot decides, and nothing else. No clock, no socket, no thread, no async, no
//! global randomness: same inputs, same outputs, to the bit.

pub mod agent;
pub mod align;
pub mod config;
pub mod estimate;
pub mod geometry;
pub mod ids;
pub mod recording;
pub mod replica;
pub mod snapshot;
pub mod submap;
pub mod time;
pub mod wire;

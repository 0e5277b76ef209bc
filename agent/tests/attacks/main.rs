//! Attacks on the real program over real Zenoh, on loopback: it is killed at any moment, and flooded by strangers. A
//! plain `cargo test` runs some of each; how many more is for the environment to say:
//!
//! ```sh
//! MERGANSER_KILLS=500 cargo test --release -p merganser --test attacks -- --ignored --test-threads=1 --nocapture
//! ```
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test fails by panicking")]
#![allow(clippy::print_stdout, reason = "what a test saw is worth a line")]

#[path = "../common/mod.rs"]
mod common;
mod flood;
mod kill;
mod outsider;

/// A number that the environment may set.
fn number(variable: &str, default: u64) -> u64 {
    std::env::var(variable).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{variable}={text}")))
}

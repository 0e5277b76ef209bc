//! Whole cores, joined by perfect wires. One program: the tests of several would run one program after the other.
#![allow(
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    clippy::print_stdout,
    reason = "a test fails by panicking, and what it prints is its report"
)]

mod allowance;
mod common;
mod condensing;
mod contract;
mod epochs;
mod front_ends;
mod link_budget;
mod lookalikes;
mod outsiders;
mod recorded;
mod restarts;
mod second_looks;
mod sightings;
mod third_parties;

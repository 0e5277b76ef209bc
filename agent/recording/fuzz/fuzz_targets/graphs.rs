//! Arbitrary bytes as pose graphs and tables of poses.
#![no_main]

#[path = "../../../../protocol/estimation/tests/reading/mod.rs"]
mod reading;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| reading::graphs(bytes));

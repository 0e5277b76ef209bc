//! Arbitrary bytes as clouds of every format.
#![no_main]

#[path = "../../tests/reading/mod.rs"]
mod reading;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| reading::clouds(bytes, &()));

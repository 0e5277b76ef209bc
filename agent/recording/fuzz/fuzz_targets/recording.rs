//! Arbitrary bytes in place of each file of a recording.
#![no_main]

#[path = "../../tests/reading/mod.rs"]
mod reading;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| reading::recording(bytes, &()));

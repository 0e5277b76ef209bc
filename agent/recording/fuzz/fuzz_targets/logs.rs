//! Arbitrary bytes as logs of lasers, plain and packed, and as tables of MRCLAM.
#![no_main]

#[path = "../../tests/reading/mod.rs"]
mod reading;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| reading::logs(bytes, &()));

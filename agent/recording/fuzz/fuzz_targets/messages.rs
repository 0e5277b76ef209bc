//! Arbitrary bytes as keyframes, sightings and positions, and as depth images.
#![no_main]

#[path = "../../tests/reading/mod.rs"]
mod reading;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| reading::messages(bytes, &()));

//! Arbitrary bytes as bags of each kind, and as each message of ROS that is read.
#![no_main]

#[path = "../../../ros/tests/reading/mod.rs"]
mod reading;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    reading::bags(bytes);
    reading::messages(bytes);
});

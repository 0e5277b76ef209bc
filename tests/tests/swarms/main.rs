//! Whole swarms, simulated or on recorded data. One program: the tests of several would run one program after the
//! other.
#![allow(clippy::unwrap_used, clippy::panic, clippy::print_stdout, reason = "the whole program is a test")]

mod calibration;
mod hostile;
mod landmarks;
mod laser;
mod mirror;
mod real_data;
mod scales;
mod swarm;
mod unmeasured;

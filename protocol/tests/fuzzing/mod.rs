//! What the fuzz targets of `protocol/fuzz` do with bytes, shared with the test `fuzz_corpus`, which replays their
//! corpus on a stable compiler. [`decode`] gives bytes to every decoder; [`handle`] reads them as a story of two
//! agents, a liar who is a member, a thief of keys, and a bad network (DESIGN §8.7, §8.8).
#![allow(
    dead_code,
    missing_docs,
    clippy::unwrap_used,
    clippy::expect_used,
    clippy::panic,
    unused_imports,
    reason = "a failed unwrap in a test is its report"
)]

mod checks;
mod decode;
mod forge;
pub mod people;
mod reader;
mod story;

pub use decode::decode;
pub use story::handle;

use merganser_protocol::wire::limits::{MESSAGE_LEN_MAX, MESSAGE_OVERHEAD_MAX};

/// No bytes from outside may make the core ask for more than this at once: a buffer that holds the longest message and
/// grew by doubling.
pub const ALLOCATION_MAX: usize = 2 * (MESSAGE_LEN_MAX + MESSAGE_OVERHEAD_MAX);

/// Is told when the core begins and ends its work on one input.
pub trait Meter {
    fn begin(&self) {}
    fn end(&self, _what: &str) {}
}

/// Measures nothing.
impl Meter for () {}

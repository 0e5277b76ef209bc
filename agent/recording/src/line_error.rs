//! Where in a text log something is wrong.

use core::fmt::{Debug, Display};
use thiserror::Error;

/// A line that cannot be used, and how to mend it.
#[derive(Clone, Debug, Error, PartialEq)]
#[error("line {line}: {what}")]
pub struct LineError<W: Debug + Display> {
    /// Which line, from 1.
    pub line: usize,
    /// What is wrong with it.
    pub what: W,
}

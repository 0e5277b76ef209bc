//! Heavy work as a value: a pure function of its data, run by the shell wherever it likes.

/// A piece of heavy work.
#[derive(Clone, Debug)]
pub enum Job {}

/// What a [`Job`] gave.
#[derive(Clone, Debug)]
pub enum JobResult {}

impl Job {
    /// Does the work. Deterministic: the same job gives the same result.
    pub fn run(self) -> JobResult {
        match self {}
    }

    /// A short name for logs and statistics.
    pub fn kind(&self) -> &'static str {
        match *self {}
    }
}

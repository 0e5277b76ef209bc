//! The gossiped summary.
use super::features::Features;
use thiserror::Error;
/// Bytes of an encoded summary at most.
pub const SUMMARY_LEN_MAX: usize = 400;
/// x
#[derive(Clone, Debug, PartialEq)]
pub struct Summary {}
/// x
#[derive(Clone, Debug, Error, PartialEq, Eq)]
pub enum SummaryError {
    /// x
    #[error("x")]
    X,
}
impl Summary {
    /// x
    pub fn of(_f: &Features) -> Self { Self {} }
}

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
    pub fn encode(&self) -> Vec<u8> { vec![1] }
    /// x
    pub fn decode(_: &[u8]) -> Result<Self, SummaryError> { Ok(Self {}) }
    /// x
    pub fn similarity(&self, _: &Self) -> f64 { 0.5 }

    /// x
    pub fn of(_f: &Features) -> Self { Self {} }
}

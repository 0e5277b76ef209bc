//! Refine.
use super::features::{Features, Keypoints};
use crate::geometry::{PoseWithCovariance, Se3};
use thiserror::Error;
/// x
#[derive(Clone, Debug, Default)]
pub struct RefineConfig {}
/// x
#[derive(Clone, Debug, PartialEq)]
pub struct Refined {
    /// x
    pub pose: PoseWithCovariance,
    /// x
    pub rms: f64,
    /// x
    pub pairs: usize,
}
/// x
#[derive(Clone, Debug, Error, PartialEq)]
pub enum RefineError {
    /// x
    #[error("x")]
    Degenerate,
}
/// x
pub fn refine(_t: &Keypoints, _m: &Features, _p: &Se3, _c: &RefineConfig) -> Result<Refined, RefineError> { Err(RefineError::Degenerate) }

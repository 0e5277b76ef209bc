//! estimate

pub mod frames;
pub mod residual;
pub mod trajectory;

//! Where two submaps lie by one another: keyframes become submaps ([`submap`]), submaps become features, and matched
//! features become an alignment with an honest covariance, or a refusal ([`align`]: σ-consensus).

pub mod align;
mod simd;
pub mod submap;

use merganser_geometry as geometry;
use merganser_types::{config, ids, kinds, time};

//! Where two submaps lie by one another: keyframes become submaps ([`submap`]), submaps become features, and matched
//! features become an alignment with an honest covariance, or a refusal ([`align`]: σ-consensus).
//!
//! ```text
//!  keyframes ─► SubmapBuilder ─► describe ─► summary (gossiped), keypoints (sent on demand), features (own)
//!
//!  their keypoints, my features ─► matches ─► σ-consensus ─► verifier ─► refine ─► t_mine_theirs with covariance
//! ```
//!
//! ```
//! use merganser_registration::align::{Problem, SolverConfig, align};
//!
//! let source: Vec<[f64; 3]> = (0..40).map(|k| [f64::from(k % 5), f64::from(k % 7), f64::from(k % 3)]).collect();
//! let target: Vec<[f64; 3]> = source.iter().map(|[x, y, z]| [x + 0.5, *y, z - 1.0]).collect();
//! let problem = Problem { source: &source, target: &target, ..Problem::default() };
//! let config = SolverConfig { sigma_max: 0.1, ..SolverConfig::default() };
//! match align(&problem, &config)? {
//!     Ok(found) => println!("{:?}, supported by {:.0} matches", found.t_target_source, found.support),
//!     Err(refusal) => println!("refused: {refusal}"),
//! }
//! # Ok::<(), merganser_registration::align::AlignError>(())
//! ```

pub mod align;
mod simd;
pub mod submap;

use merganser_geometry as geometry;
use merganser_types::{config, ids, kinds, time};

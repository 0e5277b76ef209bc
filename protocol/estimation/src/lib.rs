//! From the set of facts to the map: frame-level consensus, factor graph, joint estimate and its covariances.
//!
//! ```text
//!  chains of submaps, alignments, sightings ─► admission ─► consensus of each pair of frames ─► graph
//!                                                                                                │
//!  covariances, live poses, certificate ◄─ joint estimate ◄─ drop what contradicts the rest ◄─ solve
//! ```
//!
//! ```
//! use merganser_estimation::posegraph::{g2o::Parser, solve::Start};
//!
//! let mut parser = Parser::default();
//! for line in ["VERTEX_SE2 0 0 0 0", "VERTEX_SE2 1 1 0 0", "EDGE_SE2 0 1 1.1 0 0 100 0 0 100 0 400"] {
//!     parser.line(line)?;
//! }
//! let graph = parser.finish();
//! let start = graph.start(Start::Relaxed, 100)?;
//! let solved = graph.solve(&start, 100)?;
//! assert!((solved.values[1].translation.x - 1.1).abs() < 1e-6);
//! println!("as sure as {:?}", solved.marginals()[1].1.sigmas());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod admission;
pub mod blame;
pub mod certificate;
pub mod chordal;
mod cloud_covariance;
pub mod distortion;
mod drift_model;
pub mod extrapolation;
mod forest;
pub mod frames;
pub mod graph;
pub mod incremental;
pub mod joint;
pub mod joint_covariance;
mod loops;
pub mod marginals;
mod minimise;
pub mod misfits;
pub mod node;
mod odometry_correlation;
pub mod optimality;
mod pairs;
#[cfg(test)]
mod pairs_tests;
mod places;
pub mod posegraph;
pub mod position;
mod relative_odometry;
pub mod residual;
mod reweight;
pub mod solve;
mod solve_error;
mod sparse;
pub mod trajectory;
pub mod verdicts;

use merganser_geometry as geometry;
use merganser_types::{config, ids, kinds};

pub use admission::Kind as EdgeKind;
pub use joint::{AgreedAlignment, EdgeEstimate, FrameChain, JointEstimate, MapProblem, Unused, solve_map};
pub use pairs::{Middle, PairEstimate};

#[cfg(test)]
mod hostile_tests;
#[cfg(test)]
mod joint_tests;
#[cfg(test)]
mod solve_tests;
#[doc(hidden)]
pub mod test_graphs;
#[cfg(test)]
mod test_walks;
#[doc(hidden)]
pub mod test_world;

//! From the set of facts to the map: frame-level consensus, factor graph, joint estimate and its covariances.

mod admission;
pub mod certificate;
pub mod chordal;
pub mod distortion;
mod drift_model;
pub mod extrapolation;
pub mod frames;
pub mod graph;
pub mod incremental;
pub mod joint;
pub mod joint_covariance;
mod loops;
pub mod marginals;
mod minimise;
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
mod sparse;
pub mod trajectory;

use merganser_geometry as geometry;
use merganser_types::{config, ids, kinds};

pub use admission::Kind as EdgeKind;
pub use joint::{
    AgreedAlignment, EdgeEstimate, FrameChain, JointEstimate, MapProblem, PairEstimate, Unused, solve_map,
};

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

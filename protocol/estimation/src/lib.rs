//! From the set of facts to the map: frame-level consensus, factor graph, joint estimate and its covariances.

pub mod among;
mod bend;
pub mod certificate;
pub mod chordal;
pub mod distortion;
pub mod ends;
pub mod frames;
pub mod graph;
pub mod incremental;
mod intake;
pub mod joint;
mod loops;
pub mod marginals;
mod minimise;
pub mod optimality;
mod pairs;
#[cfg(test)]
mod pairs_tests;
mod places;
pub mod posegraph;
pub mod position;
pub mod residual;
mod reweight;
pub mod solve;
mod sparse;
pub mod trajectory;
mod walk;
mod ways;

use merganser_geometry as geometry;
use merganser_types::{config, ids, kinds};

pub use intake::Kind as EdgeKind;
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

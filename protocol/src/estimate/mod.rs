//! From the set of facts to the map: frame-level consensus, factor graph, joint estimate and its covariances.

pub mod frames;
pub mod graph;
pub mod marginals;
pub mod residual;
pub mod solve;
mod sparse;
pub mod trajectory;

#[cfg(test)]
mod solve_tests;
#[cfg(test)]
mod test_graphs;

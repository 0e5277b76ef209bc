//! From the set of facts to the map: frame-level consensus, factor graph, joint estimate and its covariances.

pub mod graph;
pub mod marginals;
pub mod solve;
mod sparse;

#[cfg(test)]
mod solve_tests;
#[cfg(test)]
mod test_graphs;

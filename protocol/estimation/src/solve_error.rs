//! Why something could not be solved: what the minimiser, the factorisation and the solver say alike, of variables, and
//! what is told of a graph, in its user's names.

use crate::graph::{Graph, Key};
use thiserror::Error;

/// Why sparse equations could not be solved.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum SolveError {
    /// The measurements leave a variable free, or are too ill-conditioned to tell.
    #[error("variable {variable} of the component is not determined by its measurements")]
    Underconstrained {
        /// Its place; of a graph's, in canonical order (nodes without the first, then scales).
        variable: usize,
    },
    /// An intermediate number overflowed.
    #[error("numbers overflowed; check the measurements' magnitudes")]
    NotFinite,
    /// The start has another number of poses than the component has anchors.
    #[error("the start has {got} poses, the component {want} anchors")]
    Start {
        /// Anchors.
        want: usize,
        /// Poses given.
        got: usize,
    },
    /// So much is tied to so much that the factorisation would outgrow its limit
    /// ([`FACTOR_BYTES_MAX`](crate::solve::FACTOR_BYTES_MAX)). Nothing was allocated.
    #[error(
        "too densely tied: the factorisation takes at least {} MiB, {} are allowed; leave out measurements between \
         far parts, or solve the parts by themselves",
        .bytes.div_ceil(1 << 20),
        .limit >> 20
    )]
    TooDense {
        /// Bytes that it takes at least.
        bytes: u64,
        /// Bytes that it may take.
        limit: u64,
    },
    /// Memory for the factorisation could not be had.
    #[error("not enough memory for the factorisation; free some, or solve fewer poses at a time")]
    OutOfMemory,
}

/// Why a component of a graph could not be solved.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum ComponentError<K: Key> {
    /// The measurements leave a node free, or are too ill-conditioned to tell.
    #[error("{0} is not determined by its measurements")]
    UnderconstrainedNode(K),
    /// The measurements leave a unit, such as a frame's, free, or are too ill-conditioned to tell.
    #[error("the scale of frame {0} is not determined by its measurements")]
    UnderconstrainedScale(K::Unit),
    /// For a reason that has nothing to do with a single node.
    #[error(transparent)]
    Solve(#[from] SolveError),
}

impl<K: Key> ComponentError<K> {
    /// The error of solving `graph`, with what its variable belongs to.
    pub(super) fn of(error: SolveError, graph: &Graph<K>) -> Self {
        let SolveError::Underconstrained { variable } = error else { return Self::Solve(error) };
        let free = graph.nodes().len().saturating_sub(1);
        let node = graph.nodes().get(variable + 1).map(|&node| Self::UnderconstrainedNode(node));
        let has_scale = |k: &usize| variable >= free && graph.scale_of(*k) == Some(variable - free);
        let scale = || (0..graph.nodes().len()).find(has_scale).map(|k| graph.nodes()[k].unit());
        node.or_else(|| scale().map(Self::UnderconstrainedScale)).unwrap_or(Self::Solve(error))
    }
}

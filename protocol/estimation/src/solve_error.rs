//! Why a component could not be solved: what the minimiser, the factorisation and the solver say alike.

use crate::graph::Graph;
use crate::ids::{FrameId, SubmapId};
use thiserror::Error;

/// Why a component could not be solved.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum SolveError {
    /// The measurements leave a variable free, or are too ill-conditioned to tell.
    #[error("variable {variable} of the component is not determined by its measurements")]
    Underconstrained {
        /// Variable in canonical order (anchors without the first, then scales).
        variable: usize,
    },
    /// The measurements leave a submap's anchor free, or are too ill-conditioned to tell.
    #[error("submap {0} is not determined by its measurements")]
    UnderconstrainedAnchor(SubmapId),
    /// The measurements leave a frame's unit free, or are too ill-conditioned to tell.
    #[error("the scale of frame {0} is not determined by its measurements")]
    UnderconstrainedScale(FrameId),
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

impl SolveError {
    /// The error with its submap named otherwise.
    #[must_use]
    pub fn renamed(self, name: impl Fn(SubmapId) -> SubmapId) -> Self {
        match self {
            Self::UnderconstrainedAnchor(id) => Self::UnderconstrainedAnchor(name(id)),
            other => other,
        }
    }

    /// The error of solving `graph`, with what its variable belongs to.
    pub(super) fn of(self, graph: &Graph) -> Self {
        let Self::Underconstrained { variable } = self else { return self };
        let anchors = graph.nodes().len().saturating_sub(1);
        let anchor = graph.nodes().get(variable + 1).map(|&id| Self::UnderconstrainedAnchor(id));
        let has_scale = |k: &usize| variable >= anchors && graph.scale_of(*k) == Some(variable - anchors);
        let scale = || (0..graph.nodes().len()).find(has_scale).map(|k| graph.nodes()[k].frame);
        anchor.or_else(|| scale().map(Self::UnderconstrainedScale)).unwrap_or(self)
    }
}

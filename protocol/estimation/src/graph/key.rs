//! How the users of a graph name its nodes and factors, and why their factors are no graph.

use crate::ids::{FrameId, SubmapId};
use core::fmt;
use thiserror::Error;

/// The name of a node. Its order is that of a graph's nodes, and so decides which one is held fixed and how sums are
/// ordered.
pub trait Key: Copy + Ord + fmt::Debug {
    /// What nodes have in common whose lengths are in one unit, such as their frame.
    type Unit: Copy + Ord + fmt::Debug;
    /// Where a factor comes from; part of the canonical order.
    type Label: Copy + Ord + fmt::Debug;

    /// The unit of the node's lengths.
    fn unit(self) -> Self::Unit;

    /// Degrees of freedom of a rigid measurement with this label: fewer than six where part of it was filled in.
    fn rigid_dimension(_label: Self::Label) -> usize {
        6
    }
}

/// Poses named by numbers, all in one unit; nothing tells their measurements apart but what they say.
impl Key for u64 {
    type Unit = ();
    type Label = ();

    fn unit(self) {}
}

/// Anchors alone, whose measurements are counted by whoever makes the graph.
impl Key for SubmapId {
    type Unit = FrameId;
    type Label = Source;

    fn unit(self) -> FrameId {
        self.frame
    }
}

/// Where a factor between two anchors comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Source {
    /// The owner's own motion estimate.
    Odometry,
    /// A measurement, by its place in the list of whoever makes the graph.
    Measurement(usize),
}

/// Why a set of factors is no graph.
#[derive(Clone, Copy, Debug, Error, PartialEq, Eq)]
pub enum GraphError<K: Key> {
    /// A mean or weight is NaN, infinite, or a scale or weight is not positive.
    #[error("factor {i:?} -> {j:?} holds a NaN, infinite or non-positive number; leave it out")]
    NotFinite {
        /// Target.
        i: K,
        /// Source.
        j: K,
    },
    /// A factor names a node that is not among the nodes.
    #[error("factor {i:?} -> {j:?} names an unknown node; add it first")]
    UnknownNode {
        /// Target.
        i: K,
        /// Source.
        j: K,
    },
    /// A factor ties a node to itself.
    #[error("factor ties {i:?} to itself; leave it out")]
    SelfLoop {
        /// The node.
        i: K,
    },
    /// A rigid measurement between nodes of different units, or a similarity where units are equal.
    #[error("factor {i:?} -> {j:?}: SE(3) needs equal units at both ends, SIM(3) different ones")]
    Units {
        /// Target.
        i: K,
        /// Source.
        j: K,
    },
}
